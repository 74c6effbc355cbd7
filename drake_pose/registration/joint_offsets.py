"""Whether the zeros of joints and the lengths of links are right, which are the same in all frames.

A zero is added to an encoder's readings; a length is a factor of a link's joints' distances from
its own. They are fitted together with the cameras' poses. What turns with the camera, such as the
zero of a first joint whose base looks alike from all sides, cannot be told, and is named instead of
guessed.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr, stdtrit
from scipy.stats import multivariate_normal

from drake_pose.arrays import Array, Mask
from drake_pose.body import TARGET_POSITIONS, PoseTree
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError, UnknownNameError
from drake_pose.fit.parameters import POSE_NAMES, carried_joints, link_scale_name
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import RegisteredCamera, RegistrationBody
from drake_pose.registration.shared_fit import SHARED, Shared, SharedFit


@dataclass(frozen=True)
class KinematicParameter:
    """What is added to an encoder's positions, or by what share of it a link is longer.

    Args:
        value: what is to be added [rad, m or 1], 0 where it is not determined.
        deviation: its standard deviation; infinite where it is not determined.
        low, high: the ends of its 95 % interval.
        significant: whether it is not 0, at 5 % over all that were asked for (Bonferroni). So it
            may be insignificant although its 95 % interval does not hold 0.
        gauge: what it cannot be told from, or, where it is determined, by still parts alone.
    """

    name: str
    value: float
    deviation: float
    low: float
    high: float
    significant: bool
    gauge: tuple[str, ...] = ()

    @property
    def determined(self) -> bool:
        """Whether the silhouettes tell it."""
        return math.isfinite(self.deviation)


@dataclass(frozen=True, eq=False)
class JointCalibration:
    """Zeros and lengths, and the cameras with them.

    Args:
        zeros, lengths: of the joints and links that were asked for.
        cameras: with the poses and focal lengths that fit these.
        covariances: (cameras, 6, 6), see ``RegisteredCamera``.
        focal_deviations: (cameras,) standard deviations over the focal lengths; 0: held.
        inlier_ratios, agrees: of each camera (frames,), judged with all that was found.
        object_values: (6,) by how much an object stands elsewhere whose place is not known,
            TARGET_POSITIONS, and object_covariance: (6, 6); empty where there is none.
    """

    zeros: tuple[KinematicParameter, ...]
    lengths: tuple[KinematicParameter, ...]
    cameras: tuple[PinholeCamera, ...]
    covariances: Array
    focal_deviations: Array
    object_values: Array
    object_covariance: Array
    inlier_ratios: tuple[Array, ...]
    agrees: tuple[Mask, ...]


def links_with_length(tree: PoseTree) -> tuple[str, ...]:
    """The links that carry a joint at a distance from their own."""
    return tuple(dict.fromkeys(one.link for one in carried_joints(tree)))


def require_known(tree: PoseTree, names: Sequence[str], lengths: Sequence[str]) -> None:
    """Refuses names of which there is no position, or no link with a length.

    Raises UnknownNameError: says which there are.
    """
    own = [name for node in tree.nodes for name in node.value_names]
    positions = [name for name in own if name not in TARGET_POSITIONS]
    for what, asked, known in (
        ("joint", names, positions),
        ("link with a length", lengths, links_with_length(tree)),
    ):
        for name in asked:
            if name not in known:
                raise UnknownNameError(what, name, known, str(tree.model.path))


def require_enough(count: int, zeros: int, lengths: int) -> None:
    """Refuses fewer frames than a number of zeros and lengths needs.

    Raises RegistrationError: says how many there are.
    """
    if count < max(2, zeros + lengths):
        raise RegistrationError(
            f"{zeros} joints' zeros and {lengths} links' lengths need as many frames of "
            f"differing poses, and two or more; there are {count}: give more frames, or name fewer"
        )


def require_explained_still(ratio: float, before: float, most_lost: float = 0.05) -> None:
    """Refuses a fit whose mean inlier ratio is smaller than where it began.

    most_lost: by more: 0.3 and more where the fit went to another optimum.

    Raises RegistrationError: says both ratios.
    """
    if ratio < before - most_lost:
        raise RegistrationError(
            f"the fit of cameras and joint offsets ends where {ratio:.0%} of the contours fit, and "
            f"began where {before:.0%} did: it has lost the robot; ask for fewer offsets, or give "
            "more frames. Nothing was written"
        )


def calibrate_joints(
    body: RegistrationBody,
    cameras: Sequence[RegisteredCamera],
    frames: Sequence[Sequence[PosedFrame]],
    names: Sequence[str],
    focal: bool = False,
    lengths: Sequence[str] = (),
    level: float = 0.05,
    start: Mapping[str, float] | None = None,
    still_factor: float = 1.0,
) -> JointCalibration:
    """The zeros of some joints and lengths of links, fitted together with the cameras' poses.

    All that are determined stay in the fit, significant or not: one that is held at 0 because
    chance could explain it would move the cameras. In the end they are drawn towards 0 as far as
    their own sizes say (``drawn_together``); the covariance stays that of the fit.

    Args:
        cameras: as they were registered with the model's zeros and lengths; no two of one name.
        frames: what each of them sees.
        names: of the positions whose zeros are asked for.
        focal: whether the cameras' focal lengths are asked for, too.
        lengths: the links whose lengths are asked for.
        level: probability that a calibration finds anything significant by chance.
        start: zeros that the cameras were found with, by name, where the fit begins [rad or m].
        still_factor: of the standard deviation of what goes with a camera, such as the offset of a
            first joint. Parts that stand still alone tell the two apart, and pictures show those
            parts badly: 2.5 there (six rooms with an SO-101, whose first offset was off by .1 to 3
            standard deviations).

    Raises:
        UnknownNameError: a name that is no position of the body's, or no link with a length.
        RegistrationError: fewer frames than zeros and lengths, or the fit ends where it explains
            less than where it began.
    """
    require_known(body.tree, names, lengths)
    require_enough(sum(len(one) for one in frames), len(names), len(lengths))
    seen = [
        PosedFrames(body.kinematics, body.all, one.camera, each)
        for one, each in zip(cameras, frames, strict=True)
    ]
    X_CW = [one.camera.X_CW for one in cameras]
    offsets = carried_joints(body.tree, lengths)
    asked, looks = [*names, *map(link_scale_name, lengths)], len(POSE_NAMES) + focal
    standing = [name for name in body.kinematics.names if name in TARGET_POSITIONS]
    told: dict[str, KinematicParameter] = {}
    sought: list[str] | None = None
    kept = asked
    while kept != sought:
        sought = kept
        fit = SharedFit(seen, X_CW, [*standing, *sought], offsets=offsets, looks=looks)
        begin = fit.start
        begin.shared[:] = [(start or {}).get(name, 0.0) for name in fit.names]
        if sought == asked:
            before = float(fit.inlier_ratios(begin).mean())
        # Constants that are off let good frames contradict, so all count at first.
        fit, found = fit.from_found(fit.fit(SHARED.rounds_with_constants, begin))
        which = fit.agreeing(fit.inlier_ratios(found))
        fit, found = fit.from_found(fit.fit(SHARED.rounds_with_constants, found, which))
        # Each picture tells how large errors are by six motions.
        freedom = max(1, 6 * int(np.count_nonzero(which)) - len(fit.names))
        own, shared = fit.covariances(found, which)
        covariance, least = own + shared, level / max(1, len(asked))
        values = describe_constants(fit, found, freedom, least, covariance, sought)
        if all(one.determined for one in values.values()):
            covariance = as_the_cost_bends(fit, found, which, own) + shared
            values = describe_constants(fit, found, freedom, least, covariance, sought)
            if all(one.determined for one in values.values()):
                # Significant is what is so beside the others, once all can be told.
                most = float(stdtrit(freedom, 1.0 - 0.5 * least))
                beside = significant_constants(fit, found, covariance, sought, most)
                values = {k: replace(one, significant=k in beside) for k, one in values.items()}
        told |= values
        kept = [name for name in sought if values[name].determined]
    found = found._replace(shared=drawn_together(fit, found, covariance, sought))
    covariance, gauges = wider_with_cameras(fit, covariance, still_factor)
    again = describe_constants(
        fit, found, freedom, least, covariance, sought, determined=0.2 * still_factor
    )
    told |= {
        k: replace(one, significant=told[k].significant, gauge=gauges.get(k, one.gauge))
        for k, one in again.items()
    }
    ratios = fit.inlier_ratios(found)
    require_explained_still(float(ratios.mean()), before)
    deviations = np.sqrt(np.diag(covariance))[: len(seen) * fit.per_camera]
    first = len(fit.names) - len(fit.constants)
    stands = slice(first, first + len(standing))
    return JointCalibration(
        tuple(told[name] for name in names),
        tuple(replace(told[link_scale_name(link)], name=link) for link in lengths),
        tuple(fit.cameras(found)),
        fit.camera_covariances(found, covariance),
        deviations[fit.per_camera - 1 :: fit.per_camera] if focal else np.zeros(len(seen)),
        found.shared[stands],
        covariance[stands, stands],
        tuple(ratios[fit.rows == c] for c in range(len(seen))),
        tuple(fit.agreeing(ratios)[fit.rows == c] for c in range(len(seen))),
    )


def drawn_together(fit: SharedFit, found: Shared, covariance: Array, names: Sequence[str]) -> Array:
    """(u,) what is shared, if constants are as large as those of their kind seem to be.

    Joint offsets of angles, those of slides, and link scales have a standard deviation each, the
    most likely one by their estimates (empirical Bayes; Efron and Morris 1975): where most offsets
    are small one that hardly shows is likely to be, and the cameras follow.
    """
    kinematics, told = fit.seen[0].kinematics, np.zeros(len(fit.names))
    kinds = dict(zip(kinematics.names, kinematics.is_angle.tolist(), strict=True))
    for kind in (True, False, None):
        rows = [fit.names.index(name) for name in names if kinds.get(name) is kind]
        if rows:
            x, C = found.shared[rows], covariance[np.ix_(rows, rows)]
            # From a hundredth of a degree or a fiftieth of a millimetre to what was assumed.
            sizes = np.geomspace(1e-4, 1.0, 60) * SHARED.constant_deviation
            likely = [
                multivariate_normal(cov=C + size**2 * np.eye(len(x))).logpdf(x) for size in sizes
            ]
            told[rows] = sizes[int(np.argmax(likely))] ** -2 - SHARED.constant_deviation**-2
    known = told > 0.0
    # The posterior by what is known more of these constants.
    gain = covariance[:, known] @ np.linalg.inv(
        covariance[np.ix_(known, known)] + np.diag(1.0 / told[known])
    )
    return np.asarray(found.shared - gain @ found.shared[known])


def significant_constants(
    fit: SharedFit, found: Shared, covariance: Array, names: Sequence[str], most: float
) -> list[str]:
    """Those of some constants that are off by more deviations once the others are held at 0.

    The least significant one is held first, and the others follow it (backward elimination).
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


def as_the_cost_bends(fit: SharedFit, found: Shared, which: Mask, covariance: Array) -> Array:
    """(u, u) the covariance, larger along constants whose cost bends less than it should.

    A round base that turns looks as before, but the edges of its mesh's facets seem to move until
    others take their place: what they tell is not true, and the slope of the cost knows it.
    """
    found_covariance = covariance.copy()
    for k in range(len(fit.names) - len(fit.constants), len(fit.names)):
        along = covariance[:, k] / math.sqrt(covariance[k, k])
        # It is looked two standard deviations to either side; no bend is a thousandth.
        bends, said = fit.bend(found, 2.0 * along, SHARED.rounds_with_constants[-1], which)
        share = min(1.0, max(1e-3, bends / said))
        found_covariance += (1.0 / share - 1.0) * np.outer(along, along)
    return found_covariance


def wider_with_cameras(
    fit: SharedFit, covariance: Array, factor: float, goes_with: float = 0.9
) -> tuple[Array, dict[str, tuple[str, ...]]]:
    """(u, u) the covariance, wider by a factor along constants that go with a camera.

    Which these are, each with the camera's unknowns that it goes with; none if the factor is 1.

    Args:
        goes_with: least correlation.
    """
    deviations, cameras = np.sqrt(np.diag(covariance)), len(fit.names) - len(fit.constants)
    wider, gauges = covariance.copy(), dict[str, tuple[str, ...]]()
    for k in range(cameras, len(fit.names)) if factor > 1.0 else ():
        correlations = covariance[k, :cameras] / (deviations[k] * deviations[:cameras])
        with_it = np.flatnonzero(np.abs(correlations) > goes_with)
        if len(with_it):
            along = covariance[:, k] / deviations[k]
            wider += (factor**2 - 1.0) * np.outer(along, along)
            gauges[fit.names[k]] = tuple(fit.names[j] for j in with_it)
    return wider, gauges


def describe_constants(
    fit: SharedFit,
    found: Shared,
    freedom: int,
    level: float,
    covariance: Array,
    names: Sequence[str],
    *,
    determined: float = 0.2,
    goes_with: float = 0.9,
) -> dict[str, KinematicParameter]:
    """Some constants by name, each with its 95 % interval, or what it goes with.

    Args:
        level: p-value below which a constant is significant.
        determined: largest deviation of what is determined, over that of what was known before.
        goes_with: least correlation with what a constant cannot be told from.
    """
    deviations = np.sqrt(np.diag(covariance))
    told = {}
    for name in names:
        k = fit.names.index(name)
        value, deviation = float(found.shared[k]), float(deviations[k])
        at_bound = abs(value) > 0.98 * SHARED.largest_constant
        if at_bound or deviation > determined * SHARED.constant_deviation:
            goes = np.abs(covariance[:, k]) > goes_with * deviations * deviation
            gauge = tuple(fit.names[j] for j in np.flatnonzero(goes) if j != k)
            ends = (-math.inf, math.inf)
            told[name] = KinematicParameter(name, 0.0, math.inf, *ends, False, gauge)
            continue
        width = float(stdtrit(freedom, 1.0 - 0.5 * 0.05)) * deviation
        p_value = 2.0 * float(stdtr(freedom, -abs(value) / deviation))
        low, middle, high = value - width, value, value + width
        if name not in fit.seen[0].kinematics.names:
            # A length was fitted as a logarithm.
            deviation *= math.exp(value)
            low, middle, high = math.expm1(low), math.expm1(middle), math.expm1(high)
        told[name] = KinematicParameter(name, middle, deviation, low, high, p_value < level)
    return told
