"""Calibrate joint offsets and link scales, the same in all frames, together with camera poses.

A joint offset is added to an encoder's positions. A link scale multiplies the distances of the
joints that a link carries from its own joint. A parameter that the silhouettes cannot separate from
others, such as the offset of a first joint whose base is round, is reported as not determined,
together with the parameters that it is correlated with.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import stdtr, stdtrit

from drake_pose.arrays import Array, Mask
from drake_pose.body import TARGET_POSITIONS, PoseTree
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError, UnknownNameError
from drake_pose.fit.base_edges import BASE
from drake_pose.fit.parameters import POSE_NAMES, carried_joints, link_scale_name
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames, joints_like_cameras
from drake_pose.registration.register import RegisteredCamera, RegistrationBody
from drake_pose.registration.shared_fit import SHARED, SharedFit, SharedValues


@dataclass(frozen=True)
class KinematicParameter:
    """An estimated joint offset, or the relative change of a link's scale."""

    name: str  # Of the joint or link.
    value: float  # The offset [rad or m] or the relative change of the scale; 0 if not determined.
    deviation: float  # Its standard deviation; infinite if not determined.
    # low, high: its 95 % interval.
    low: float
    high: float
    # Whether it differs from 0 at the 5 % level over all requested parameters (Bonferroni). Its 95
    # % interval may exclude 0 although it is not significant.
    significant: bool
    # Names of the unknowns that it is strongly correlated with; for a determined parameter, those
    # that only static parts separate it from; often empty.
    gauge: tuple[str, ...] = ()

    @property
    def determined(self) -> bool:
        """Whether the silhouettes determine it."""
        return math.isfinite(self.deviation)


@dataclass(frozen=True, eq=False)
class JointCalibration:
    """Joint offsets, link scales, and the cameras fitted with them."""

    # offsets, link_scales: of the requested joints and links.
    offsets: tuple[KinematicParameter, ...]
    link_scales: tuple[KinematicParameter, ...]
    cameras: tuple[PinholeCamera, ...]  # The cameras with their fitted poses and focal lengths.
    covariances: Array  # (cameras, 6, 6), see ``RegisteredCamera``.
    focal_deviations: Array  # (cameras,) standard deviations over the focal lengths; 0: not fitted.
    object_values: Array  # (6,) the calibration target's TARGET_POSITIONS; empty without a target.
    object_covariance: Array  # (6, 6) their covariance; empty without a target.
    # inlier_ratios, is_inlier: for each camera (frames,), with the fitted parameters.
    inlier_ratios: tuple[Array, ...]
    is_inlier: tuple[Mask, ...]


def undetermined(name: str, gauge: tuple[str, ...]) -> KinematicParameter:
    """Return the description of a parameter that is not determined; gauge: its attribute."""
    return KinematicParameter(name, 0.0, math.inf, -math.inf, math.inf, False, gauge)


def scalable_links(tree: PoseTree) -> tuple[str, ...]:
    """Return names of links that carry a joint away from their own joint, so that scales matter."""
    return tuple(dict.fromkeys(one.link for one in carried_joints(tree)))


def require_parameters(tree: PoseTree, joints: Sequence[str], links: Sequence[str]) -> None:
    """Raise UnknownNameError for `joints` that are no positions, and `links` not scalable."""
    own = [name for node in tree.nodes for name in node.value_names]
    positions = [name for name in own if name not in TARGET_POSITIONS]
    for what, names, known in (
        ("joint", joints, positions),
        ("link with a length", links, scalable_links(tree)),
    ):
        for name in names:
            if name not in known:
                raise UnknownNameError(what, name, known, str(tree.model.path))


def require_frame_count(count: int, joints: int, links: int) -> None:
    """Refuse fewer frames than parameters, or fewer than two.

    ``count``: number of frames, all cameras together. ``joints``, ``links``: number of joints with
    an offset, and of links with a scale. Raises RegistrationError: states the numbers.
    """
    if count < max(2, joints + links):
        raise RegistrationError(
            f"the offsets of {joints} joints and the lengths of {links} links need as many frames "
            f"with different poses, and at least two; there are {count}: give more frames, or name "
            "fewer joints and links"
        )


def require_fit_kept(ratio: float, before: float, most_lost: float = 0.05) -> None:
    """Refuse a fit whose mean inlier ratio fell from `before` to `ratio`, by over `most_lost`.

    A fit that converged to another optimum loses 0.3 or more.

    Raises RegistrationError: states both ratios.
    """
    if ratio < before - most_lost:
        raise RegistrationError(
            f"the fit of cameras and joint offsets lost the robot: {ratio:.0%} of the contours fit "
            f"at its end, {before:.0%} at its start; ask for fewer offsets, or give more frames. "
            "Nothing was written"
        )


def calibrate_joints(
    body: RegistrationBody,
    cameras: Sequence[RegisteredCamera],
    frames: Sequence[Sequence[PosedFrame]],
    joints: Sequence[str],
    focal: bool = False,
    links: Sequence[str] = (),
    start: Mapping[str, float] | None = None,
    static: Mapping[str, tuple[float, float]] | None = None,
) -> JointCalibration:
    """Fit joint offsets and link scales together with the cameras' poses.

    Parameters that are not determined are dropped one fit after another. Insignificant ones stay:
    holding them at 0 would bias the cameras. In the end values shrink towards 0
    (``shrink_constants``); the covariance stays that of the fit.

    Args:
        body: the robot's surfaces and pose tree.
        cameras: as registered with the model's offsets and scales, with distinct names.
        frames: for each camera its frames.
        joints: names of the positions whose offsets are fitted.
        focal: whether the cameras' focal lengths are fitted.
        links: the links whose scales are fitted.
        start: offsets by name [rad or m] that the cameras were fitted with, 0 for other names.
            Only parameters that a camera hides are then dropped, and its covariance includes them.
        static: offsets that look like a rotation of a camera, as edges of static parts show them,
            and standard deviations [rad], by name (``locate_base``); uncertain ones are held at 0.

    Raises UnknownNameError: the body has no such position, or no such scalable link;
    RegistrationError: there are fewer frames than parameters, or the fit lost the robot.
    """
    require_parameters(body.tree, joints, links)
    require_frame_count(sum(len(one) for one in frames), len(joints), len(links))
    views = [
        PosedFrames(body.kinematics, body.full, one.camera, each)
        for one, each in zip(cameras, frames, strict=True)
    ]
    X_CW = [one.camera.X_CW for one in cameras]
    offsets = carried_joints(body.tree, links)
    requested, per_camera = [*joints, *map(link_scale_name, links)], len(POSE_NAMES) + focal
    target_positions = [name for name in body.kinematics.names if name in TARGET_POSITIONS]
    static = static or {}
    parameters = unseen_rotations(static, views)
    sought: list[str] | None = None
    kept = first = [name for name in requested if name not in parameters]
    describe = partial(describe_constants, measured=static)
    while kept != sought:
        sought = kept
        names = [*target_positions, *sought]
        fit = SharedFit(views, X_CW, names, offsets=offsets, camera_unknowns=per_camera)
        begin = fit.start
        begin.shared[:] = [(start or {}).get(name, 0.0) for name in fit.names]
        if sought == first:
            before = float(fit.inlier_ratios(begin).mean())
        # One camera and its offsets may have been fitted together before.
        known = bool(start) and sought == first and not links and len(views) == 1
        fit, found, included = _fit_to_inliers(fit, begin, known)
        # Each mask contributes six affine motions to the estimate of the error sizes.
        freedom = max(1, 6 * int(np.count_nonzero(included)) - len(fit.names))
        own, shared = fit.covariances(found, included)
        covariance, least = own + shared, SHARED.level / max(1, len(requested))
        values = describe(fit, found, freedom, least, covariance, sought)
        kept = _kept(values, fit if start else None)
        if kept == sought:
            covariance = widen_to_cost_curvature(fit, found, included, own) + shared
            values = describe(fit, found, freedom, least, covariance, sought)
            kept = _kept(values, fit if start else None)
        if kept == sought:
            most = float(stdtrit(freedom, 1.0 - 0.5 * least))
            tested = [name for name, one in values.items() if one.determined]
            beside = significant_constants(fit, found, covariance, tested, most)
            values = {k: replace(one, significant=k in beside) for k, one in values.items()}
        parameters |= values
    found, covariance, gauges = shrink_measured(fit, found, covariance, sought, static)
    again = describe(fit, found, freedom, least, covariance, sought)
    doubtful = ambiguous_constants(fit, found, included, covariance, sought)
    again |= {k: undetermined(k, one.gauge) for k, one in again.items() if k in doubtful}
    found = fit_cameras_alone(fit, found, included)
    for k, one in again.items():
        # Shrunk values may have an interval with 0.
        significant = parameters[k].significant and not one.low <= 0.0 <= one.high
        parameters[k] = replace(one, gauge=gauges.get(k, one.gauge), significant=significant)
    ratios = fit.inlier_ratios(found)
    require_fit_kept(float(ratios.mean()), before)
    deviations = np.sqrt(np.diag(covariance))[: len(views) * fit.per_camera]
    target_rows = np.arange(len(target_positions)) + len(fit.names) - len(fit.constants)
    held = {k for k in joints if not parameters[k].determined} if start else set[str]()
    covariances = fit.camera_covariances(found, covariance)
    covariances += _unknown_rotations(views, fit.cameras(found), held)
    return JointCalibration(
        tuple(parameters[name] for name in joints),
        tuple(replace(parameters[link_scale_name(link)], name=link) for link in links),
        tuple(fit.cameras(found)), covariances,
        deviations[fit.per_camera - 1 :: fit.per_camera] if focal else np.zeros(len(views)),
        found.shared[target_rows], covariance[np.ix_(target_rows, target_rows)],
        tuple(ratios[fit.rows == c] for c in range(len(views))),
        tuple(fit.inliers(ratios)[fit.rows == c] for c in range(len(views))),
    )  # fmt: skip


def _kept(values: Mapping[str, KinematicParameter], fit: SharedFit | None) -> list[str]:
    """Return the names of the parameters that stay in a fit, from their descriptions by name.

    fit: one that began at known offsets. Parameters that are not determined then stay, too, near
        their expected 0, unless they are correlated with a camera: held at exactly 0, they would
        bias the others. None: they go.
    """
    cameras = set() if fit is None else set(fit.names) - set(fit.constants)
    return [
        name
        for name, one in values.items()
        if one.determined or (fit is not None and not set(one.gauge) & cameras)
    ]


def _fit_to_inliers(
    fit: SharedFit, begin: SharedValues, known: bool
) -> tuple[SharedFit, SharedValues, Mask]:
    """Return the fit to inliers about the found cameras, its values, and the masks (rows,) used.

    ``known``: whether ``begin`` has fitted values, which large steps may lose.
    """
    found, stages = begin, SHARED.stages_with_constants
    if known:
        stages = stages[-SHARED.last_stages :]
    else:
        # Wrong parameters make outliers of good frames, so this fit includes all frames.
        fit, found = fit.from_found(fit.fit(stages, begin))
    included = fit.inliers(fit.inlier_ratios(found))
    return *fit.from_found(fit.fit(stages, found, included)), included


def _unknown_rotations(
    views: Sequence[PosedFrames], cameras: Sequence[PinholeCamera], held: Collection[str]
) -> Array:
    """Return what cameras' covariances (cameras, 6, 6) lack where unknown offsets are held at 0.

    An offset that looks like a rotation of the camera has its prior's standard deviation.

    ``views``: for each camera its frames. ``cameras``: at their poses. ``held``: names of the
    joints whose offsets are held.
    """
    missing = np.zeros((len(views), 6, 6))
    for k, (view, camera) in enumerate(zip(views, cameras, strict=True)):
        kinematics = view.kinematics
        values = np.array([one.values for one in view.frames])
        shown = np.array([len(one.vertices) > 0 for one in view.outlines])
        for name in {*joints_like_cameras(kinematics, values, shown)} & {*held}:
            twist = kinematics.motions(values[0]).twists[kinematics.names.index(name), :6]
            moved = np.append(twist[:3], np.cross(twist[:3], camera.X_WC[:3, 3]) + twist[3:])
            missing[k] += SHARED.constant_deviation**2 * np.outer(moved, moved)
    return missing


def shrink_measured(
    fit: SharedFit,
    found: SharedValues,
    covariance: Array,
    names: Sequence[str],
    static: Mapping[str, tuple[float, float]],
    *,
    factor: float = 2.5,
    floor: float = 0.014,
) -> tuple[SharedValues, Array, dict[str, tuple[str, ...]]]:
    """Combine constants with what edges of static parts show, then shrink them.

    In this order, constants that are less certain than the fit says shrink further. The covariance
    is first enlarged along these constants, since masks of static parts follow the assumed pose.

    Args:
        fit, found, covariance: the fit, its values, and their covariance (u, u).
        names: of the constants that shrink.
        static: see ``calibrate_joints``.
        factor, floor: factor of the fit's standard deviation of these constants, and what is added
            in quadrature, at least the measured deviation [rad]; errors of 0.1 to 3 standard
            deviations were seen in ten rooms.

    Returns the shrunk values; their covariance; and by name of each of these constants the names of
    the cameras' unknowns that it is correlated with.
    """
    C, shared, gauges = covariance.copy(), found.shared.copy(), dict[str, tuple[str, ...]]()
    cameras = len(fit.names) - len(fit.constants)
    for name, (value, deviation) in static.items():
        if name not in names:
            continue
        k = fit.names.index(name)
        along = C[:, k] / np.sqrt(C[k, k])
        wider = (factor**2 - 1.0) + max(floor, deviation) ** 2 / C[k, k]
        C += wider * np.outer(along, along)
        sizes = np.sqrt(np.diag(C))
        with_it = np.flatnonzero(np.abs(C[k, :cameras]) > 0.9 * sizes[k] * sizes[:cameras])
        gauges[name] = tuple(fit.names[j] for j in with_it)
        # Kalman update with the measured value; a contradiction makes both less certain.
        off = value - shared[k]
        noise = max(deviation**2, 0.25 * off**2 - C[k, k])
        gain = C[:, k] / (C[k, k] + noise)
        shared = shared + gain * off
        C -= np.outer(gain, C[k])
    found = found._replace(shared=shared)
    return found._replace(shared=shrink_constants(fit, found, C, names)), C, gauges


def shrink_constants(
    fit: SharedFit, found: SharedValues, covariance: Array, names: Sequence[str]
) -> Array:
    """Return a fit's shared values (u,) with the named constants shrunk towards 0.

    Angular offsets, linear offsets and link scales each get a prior standard deviation, the most
    likely one given their estimates (empirical Bayes; Efron and Morris 1975). Correlated values,
    such as the cameras', follow.

    Args:
        fit, found, covariance: the fit, its values, and their covariance (u, u).
        names: of the constants.
    """
    from scipy.stats import multivariate_normal  # Slow to import: a third of a second.

    kinematics, information = fit.views[0].kinematics, np.zeros(len(fit.names))
    kinds = dict(zip(kinematics.names, kinematics.is_angle.tolist(), strict=True))
    for kind in (True, False, None):
        rows = [fit.names.index(name) for name in names if kinds.get(name) is kind]
        if rows:
            x, C = found.shared[rows], covariance[np.ix_(rows, rows)]
            # From 0.001 degrees or 0.02 mm up to the prior of the fit.
            sizes = np.geomspace(1e-4, 1.0, 60) * SHARED.constant_deviation
            likely = [
                multivariate_normal(cov=C + size**2 * np.eye(len(x))).logpdf(x) for size in sizes
            ]
            information[rows] = sizes[int(np.argmax(likely))] ** -2 - SHARED.constant_deviation**-2
    known = information > 0.0
    # Kalman update with the additional prior information.
    gain = covariance[:, known] @ np.linalg.inv(
        covariance[np.ix_(known, known)] + np.diag(1.0 / information[known])
    )
    return np.asarray(found.shared - gain @ found.shared[known])


def significant_constants(
    fit: SharedFit, found: SharedValues, covariance: Array, names: Sequence[str], most: float
) -> list[str]:
    """Return the names of the constants that exceed `most` standard deviations.

    Backward elimination: the least significant constant is held at 0, correlated ones follow, and
    the rest is tested again, until all that remain exceed the limit.

    Args:
        fit, found, covariance: the fit, its values, and their covariance (u, u).
        names: of the constants.
    """
    rows, kept = [fit.names.index(name) for name in names], list(names)
    x, C = found.shared[rows], covariance[np.ix_(rows, rows)]
    while kept:
        off = np.abs(x) / np.sqrt(np.diag(C))
        k = int(np.argmin(off))
        if off[k] >= most:
            break
        follow = C[:, k] / C[k, k]
        rest = np.arange(len(kept)) != k
        x, C = (x - follow * x[k])[rest], (C - np.outer(follow, C[k]))[np.ix_(rest, rest)]
        del kept[k]
    return kept


def unseen_rotations(
    static: Mapping[str, tuple[float, float]], views: Sequence[PosedFrames]
) -> dict[str, KinematicParameter]:
    """Return descriptions, by name, of offsets that edges of static parts do not determine.

    They are correlated with the rotations of all cameras. ``static``: see ``calibrate_joints``.
    """
    gauge = tuple(f"{one.camera.name}.{turn}" for one in views for turn in POSE_NAMES[:3])
    unseen = (name for name, (_, deviation) in static.items() if deviation > BASE.max_deviation)
    return {name: undetermined(name, gauge) for name in unseen}


def ambiguous_constants(
    fit: SharedFit,
    found: SharedValues,
    included: Mask,
    covariance: Array,
    names: Sequence[str],
    *,
    away: Sequence[float] = (0.1, 0.2, 0.3, 0.4, 0.5),
    min_sds: float = 4.0,
    threshold: float = 2.0,
) -> list[str]:
    """Return names of angular constants of a last link that other values explain about as well.

    A round flange looks alike at several angles. Its facets and holes let the fit stop at one.

    Args:
        fit, found, included, covariance: see ``widen_to_cost_curvature``.
        names: of the constants that are tested.
        away: differences from the found value that are tried, to both sides [rad].
        min_sds: those within this many standard deviations are not.
        threshold: minimum of the costs' increase over its standard deviation, from the scatter
            between masks.
    """
    view, doubtful = fit.views[0], list[str]()
    shown = np.array([len(one.vertices) > 0 for one in view.outlines])
    kinematics, values = view.kinematics, view.frames[0].values
    moves = kinematics.motions(values).moves[shown]
    before = fit.costs(found)[included]
    for name in names:
        if name not in kinematics.names:
            continue
        k, joint = fit.names.index(name), kinematics.names.index(name)
        if not kinematics.is_angle[joint] or np.count_nonzero(moves[:, joint]) > 1:
            continue
        for by in np.outer([-1.0, 1.0], away).ravel().tolist():
            if abs(by) < min_sds * math.sqrt(covariance[k, k]):
                continue
            shared = found.shared.copy()
            shared[k] += by
            more = fit.costs(found._replace(shared=shared))[included] - before
            if more.sum() < threshold * math.sqrt(len(more)) * float(more.std()):
                doubtful.append(name)
                break
    return doubtful


def fit_cameras_alone(
    fit: SharedFit, found: SharedValues, included: Mask, steps: int = 3
) -> SharedValues:
    """Return the values with the cameras' unknowns fitted again, and all others held.

    Shrunk offsets move the cameras by the covariance, which has parts for errors that are not
    fitted. Contours then fit badly.

    ``fit``, ``found``: the fit, and its values after ``shrink_constants``. ``included``: (rows,)
    which masks enter. ``steps``: number of Gauss-Newton steps at each of two scales.
    """
    first = fit.problem.own_count
    rows = slice(first, first + fit.per_camera * len(fit.views))
    for stage in (SHARED.inlier_stage, SHARED.final_stage):
        for _ in range(steps):
            equations = fit.equations(found, stage, included)
            H, g = equations.H.sum(axis=0)[rows, rows], equations.g.sum(axis=0)[rows]
            shared = found.shared.copy()
            shared[: rows.stop - first] -= np.linalg.solve(H, g)
            found = found._replace(shared=shared)
    return found


def widen_to_cost_curvature(
    fit: SharedFit, found: SharedValues, included: Mask, covariance: Array
) -> Array:
    """Return the covariance (u, u) enlarged along constants whose cost has too little curvature.

    When a round base turns, the edges of its mesh's facets seem to move until others take their
    place. They add information to the normal equations which the cost itself does not have.

    Args:
        fit, found, covariance: the fit, its values, and their covariance (u, u).
        included: (rows,) masks that entered the fit.
    """
    found_covariance = covariance.copy()
    for k in range(len(fit.names) - len(fit.constants), len(fit.names)):
        along = covariance[:, k] / math.sqrt(covariance[k, k])
        # Differences over two standard deviations; without any curvature only the prior is left.
        measured, predicted = fit.cost_curvature(
            found, 2.0 * along, SHARED.stages_with_constants[-1], included
        )
        ratio = min(1.0, max(1e-3, measured / predicted)) if predicted > 1e-6 else 1.0
        found_covariance += (1.0 / ratio - 1.0) * np.outer(along, along)
    return found_covariance


def describe_constants(
    fit: SharedFit,
    found: SharedValues,
    freedom: int,
    level: float,
    covariance: Array,
    names: Sequence[str],
    *,
    measured: Collection[str] = (),
    min_correlation: float = 0.9,
) -> dict[str, KinematicParameter]:
    """Describe constants by name: 95 % interval, significance, and correlated unknowns.

    A constant at the fit's bound is not determined.

    Args:
        fit, found, covariance: the fit, its values, and their covariance (u, u).
        names: of the constants.
        freedom: degrees of freedom of Student's t distribution.
        level: p-value below which a constant is significant.
        measured: names of constants that something else determines, too.
        min_correlation: minimum correlation of the unknowns listed for an undetermined constant.
    """
    deviations = np.sqrt(np.diag(covariance))
    parameters = {}
    for name in names:
        k = fit.names.index(name)
        value, deviation = float(found.shared[k]), float(deviations[k])
        at_bound = abs(value) > 0.98 * SHARED.max_constant
        wide = at_bound or deviation > SHARED.determined * SHARED.constant_deviation
        if wide and name not in measured:
            correlated = np.abs(covariance[:, k]) > min_correlation * deviations * deviation
            gauge = tuple(fit.names[j] for j in np.flatnonzero(correlated) if j != k)
            parameters[name] = undetermined(name, gauge)
            continue
        width = float(stdtrit(freedom, 1.0 - 0.5 * SHARED.level)) * deviation
        p_value = 2.0 * float(stdtr(freedom, -abs(value) / deviation))
        low, middle, high = value - width, value, value + width
        if name not in fit.views[0].kinematics.names:
            # The unknown of a link scale is its logarithm.
            deviation *= math.exp(value)
            low, middle, high = math.expm1(low), math.expm1(middle), math.expm1(high)
        parameters[name] = KinematicParameter(name, middle, deviation, low, high, p_value < level)
    return parameters
