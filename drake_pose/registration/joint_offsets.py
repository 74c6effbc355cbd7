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
from drake_pose.errors import RegistrationError, require_known
from drake_pose.fit.parameters import POSE_NAMES, carried_joints, link_scale_name
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
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
    where = str(tree.model.path)
    require_known("joint", joints, positions, where)
    require_known("link with a length", links, scalable_links(tree), where)


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

    All have a prior (``SHARED.constant_deviation``), so that what is not determined widens all that
    moves with it. In the end values shrink towards 0 (``shrink_constants``), and the cameras are
    fitted to them; the covariance stays that of the fit.

    Args:
        body: the robot's surfaces and pose tree.
        cameras: as registered with the model's offsets and scales, with distinct names.
        frames: for each camera its frames.
        joints: names of the positions whose offsets are fitted.
        focal: whether the cameras' focal lengths are fitted.
        links: the links whose scales are fitted.
        start: offsets by name [rad or m] that the cameras were fitted with, 0 for other names.
        static: offsets that look like a rotation of a camera, as edges of static parts show them,
            and standard deviations [rad], by name (``locate_base``). Masks of static parts then say
            nothing about them, since they follow the assumed pose.

    Raises UnknownNameError: the body has no such position, or no such scalable link;
    RegistrationError: there are fewer frames than parameters, or the fit lost the robot.
    """
    require_parameters(body.tree, joints, links)
    require_frame_count(sum(len(one) for one in frames), len(joints), len(links))
    views = [
        PosedFrames(body.kinematics, body.full, one.camera, each)
        for one, each in zip(cameras, frames, strict=True)
    ]
    requested = [*joints, *map(link_scale_name, links)]
    # The mean of a measurement and the prior is where the fit begins.
    prior, static = SHARED.constant_deviation, static or {}
    static = {name: (value / (1.0 + (sd / prior) ** 2), sd) for name, (value, sd) in static.items()}
    target_positions = [name for name in body.kinematics.names if name in TARGET_POSITIONS]
    fit = SharedFit(
        views, [one.camera.X_CW for one in cameras], [*target_positions, *requested],
        offsets=carried_joints(body.tree, links), camera_unknowns=len(POSE_NAMES) + focal,
        turned=static, expected={name: value for name, (value, _) in static.items()},
    )  # fmt: skip
    begin = fit.start
    begin.shared[:] = [(start or {}).get(name, 0.0) for name in fit.names]
    before = float(fit.inlier_ratios(begin).mean())
    # One camera and its offsets may have been fitted together before.
    known = bool(start) and not links and len(views) == 1
    fit, found, included = _fit_to_inliers(fit, begin, known)
    # Each mask contributes six affine motions to the estimate of the error sizes.
    freedom = max(1, 6 * int(np.count_nonzero(included)) - len(fit.names))
    covariance = np.sum(fit.covariances(found, included), axis=0)
    found, covariance = with_measured(fit, found, covariance, static)
    least = SHARED.level / max(1, len(requested))
    describe = partial(describe_constants, fit, freedom=freedom, level=least, measured=static)
    values = describe(found, covariance=covariance, names=requested)
    determined = [name for name, one in values.items() if one.determined]
    most = float(stdtrit(freedom, 1.0 - 0.5 * least))
    beside = significant_constants(fit, found, covariance, determined, most)
    shrunk = shrink_constants(fit, found, covariance, determined, values)
    found = fit.fitted_cameras(shrunk, included)
    parameters = values | describe(found, covariance=covariance, names=determined)
    for k in determined:
        # Shrunk values may have an interval with 0.
        one = parameters[k]
        significant = k in beside and not one.low <= 0.0 <= one.high
        parameters[k] = replace(one, significant=significant)
    ratios = fit.inlier_ratios(found)
    require_fit_kept(float(ratios.mean()), before)
    deviations = np.sqrt(np.diag(covariance))[: len(views) * fit.per_camera]
    target_rows = np.arange(len(target_positions)) + len(fit.names) - len(fit.constants)
    return JointCalibration(
        tuple(parameters[name] for name in joints),
        tuple(replace(parameters[link_scale_name(link)], name=link) for link in links),
        tuple(fit.cameras(found)), fit.camera_covariances(found, covariance),
        deviations[fit.per_camera - 1 :: fit.per_camera] if focal else np.zeros(len(views)),
        found.shared[target_rows], covariance[np.ix_(target_rows, target_rows)],
        tuple(ratios[fit.rows == c] for c in range(len(views))),
        tuple(fit.inliers(ratios)[fit.rows == c] for c in range(len(views))),
    )  # fmt: skip


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
    found = fit.fit_to_end(fit.fit(stages, found, included), included)
    return *fit.from_found(found), included


def with_measured(
    fit: SharedFit,
    found: SharedValues,
    covariance: Array,
    measured: Mapping[str, tuple[float, float]],
) -> tuple[SharedValues, Array]:
    """Return a fit's values and covariance (u, u) with measured constants (Kalman update).

    ``fit``, ``found``, ``covariance``: the fit, its values, and their covariance (u, u).
    ``measured``: values and standard deviations by name; those of other constants do not count.
    """
    for name, (value, deviation) in measured.items():
        if name in fit.names:
            k = fit.names.index(name)
            gain = covariance[:, k] / (covariance[k, k] + deviation**2)
            found = found._replace(shared=found.shared + gain * (value - found.shared[k]))
            covariance = covariance - np.outer(gain, covariance[k])
    return found, covariance


def shrink_constants(
    fit: SharedFit,
    found: SharedValues,
    covariance: Array,
    names: Sequence[str],
    every: Collection[str] = (),
) -> SharedValues:
    """Return a fit's values with the named constants shrunk towards 0.

    Angular offsets, linear offsets and link scales each get a prior standard deviation, the most
    likely one given their estimates (empirical Bayes; Efron and Morris 1975). Correlated values,
    such as the cameras', follow.

    Args:
        fit, found, covariance: the fit, its values, and their covariance (u, u).
        names: of the constants.
        every: names of constants; those that are not among ``names`` become 0.
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
    information[[fit.names.index(name) for name in every if name not in names]] = np.inf
    known = information > 0.0
    # Kalman update with the additional prior information.
    gain = covariance[:, known] @ np.linalg.inv(
        covariance[np.ix_(known, known)] + np.diag(1.0 / information[known])
    )
    return found._replace(shared=found.shared - gain @ found.shared[known])


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

    A constant is determined if the data say more about it than its prior.

    Args:
        fit, found, covariance: the fit, its values, and their covariance (u, u).
        names: of the constants.
        freedom: degrees of freedom of Student's t distribution.
        level: p-value below which a constant is significant.
        measured: names of constants that something else than the fit determines.
        min_correlation: minimum correlation of the unknowns listed for an undetermined constant,
            or a measured one.
    """
    deviations = np.sqrt(np.diag(covariance))
    parameters = {}
    for name in names:
        k = fit.names.index(name)
        value, deviation = float(found.shared[k]), float(deviations[k])
        correlated = np.abs(covariance[:, k]) > min_correlation * deviations * deviation
        gauge = tuple(fit.names[j] for j in np.flatnonzero(correlated) if j != k)
        if deviation**2 > 0.5 * SHARED.constant_deviation**2:
            parameters[name] = undetermined(name, gauge)
            continue
        width = float(stdtrit(freedom, 1.0 - 0.5 * SHARED.level)) * deviation
        p_value = 2.0 * float(stdtr(freedom, -abs(value) / deviation))
        low, middle, high = value - width, value, value + width
        if name not in fit.views[0].kinematics.names:
            # The unknown of a link scale is its logarithm.
            deviation *= math.exp(value)
            low, middle, high = math.expm1(low), math.expm1(middle), math.expm1(high)
        parameters[name] = KinematicParameter(
            name, middle, deviation, low, high, p_value < level, gauge if name in measured else ()
        )
    return parameters
