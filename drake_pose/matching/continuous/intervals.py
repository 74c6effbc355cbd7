"""What silhouettes say of each continuous value: an interval, or that it is free.

Three things bound what can be said. The boundaries' distances have the noise of pixels, and the
curvature of their sum of squares turns it into a covariance of the values. Other local optima may
be as good: every part of the body is placed anew or mirrored in depth, seen by one camera even the
whole body with left and right exchanged, and what comes as close to the silhouettes once refined
belongs to the answer. And where more pixels are wrong than a found pose leaves, the pose may be
another one altogether: nothing is known then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from drake_pose.body import PoseTree
from drake_pose.errors import SettingsError
from drake_pose.matching.pose_families import JointEstimate, PoseFamily, PoseSet
from drake_pose.matching.raster_fit.body import Freedom
from drake_pose.matching.raster_fit.passes import FINE_PASSES, descend
from drake_pose.matching.raster_fit.problem import RefinementProblem
from drake_pose.matching.starts.escape import OTHER_PASSES
from drake_pose.matching.starts.part_placement import PartSearch

# The variance of a border that lies anywhere between two pixel centres [pixel^2].
_PIXEL_VARIANCE = 1.0 / 12.0
# Wrong pixels of a refined true pose, as a share of its contour's length; found on drawn bodies.
_PIXEL_SHARE = 0.02
# Other poses are left that are, after the first pass, more than this many times the tolerance above
# what they may have.
_HOPEFUL = 4.0


@dataclass(frozen=True)
class IntervalSettings:
    """Parameters of the intervals.

    Args:
        confidence: how often the truth shall lie in a determined value's interval.
        widest_angle, widest_length: values whose interval is wider on either side are free [rad],
            [m].
        noise_factor: how much larger the standard deviation is than if the distances of all rows
            and columns were independent; found on drawn bodies.
        tolerance: poses are as good as the best whose J is larger by no more than this share of
            the contour's length, at most [pixel/pixel].
        misfit: wrong pixels, as a share of the contour's length, that a pose that was found does
            not leave: no value is determined then; found on drawn bodies.
        alternatives: how many other placements of each part are refined; 0: none is looked for.
        same: poses none of whose values differ by more are of one family [rad or m].

    Raises:
        SettingsError: if a value is out of its range.
    """

    confidence: float = 0.95
    widest_angle: float = np.radians(10.0)
    widest_length: float = 0.02
    noise_factor: float = 1.7
    tolerance: float = 0.03
    misfit: float = 0.03
    alternatives: int = 3
    same: float = 0.1

    def __post_init__(self) -> None:
        if not 0.0 < self.confidence < 1.0:
            raise SettingsError(f"confidence must lie between 0 and 1, not {self.confidence}")
        for name in ("widest_angle", "widest_length", "noise_factor", "same"):
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"{name} must be positive, not {getattr(self, name)}")
        if self.tolerance < 0.0 or self.misfit < 0.0 or self.alternatives < 0:
            raise SettingsError("tolerance, misfit and alternatives must not be negative")


@dataclass(frozen=True, eq=False)
class RefinedFamily:
    """Poses that differ by small steps.

    Attributes:
        members: their parameters, best first.
        joints: each of the tree's values, as far as these go.
    """

    members: tuple[np.ndarray, ...]
    joints: tuple[JointEstimate, ...]


@dataclass(frozen=True, eq=False)
class Intervals:
    """What is known of the tree's values.

    Attributes:
        joints: an estimate of each value, node after node.
        covariance: (m, m) of the tree's values about the best pose; 0 where they are held.
        families: the poses that are as good; the best pose leads the first.
        tolerance: by how much their J may be larger than the best pose's [pixel].
    """

    joints: tuple[JointEstimate, ...]
    covariance: np.ndarray
    families: tuple[RefinedFamily, ...]
    tolerance: float

    @property
    def alternatives(self) -> tuple[np.ndarray, ...]:
        """The parameters of all poses as good but the best one."""
        return tuple(p for family in self.families for p in family.members)[1:]


def find_intervals(
    problem: RefinementProblem,
    search: PartSearch,
    parameters: np.ndarray,
    settings: IntervalSettings,
    extra: Sequence[int] = (),
) -> Intervals:
    """What the silhouettes say of each value.

    Args:
        problem: the silhouettes.
        search: finds other placements of parts.
        parameters: (m + 4,) the best pose, refined.
        settings: the parameters.
        extra: of the four parameters after the tree's values those that are unknown.
    """
    covariance = _covariance(problem, parameters, problem.body.freedom(None, extra), settings)
    z = float(ndtri(0.5 + 0.5 * settings.confidence))
    # More wrong pixels than those of the masks' own noise: what is wrong elsewhere pulls here.
    wrong = problem.J(parameters) / (_PIXEL_SHARE * problem.border_length)
    margins = z * max(1.0, wrong) * np.sqrt(np.diag(covariance))
    tolerance = settings.tolerance * problem.border_length
    poses = [parameters]
    for other in _find_alternatives(problem, search, parameters, tolerance, settings):
        # The same pose is not another one for a full turn.
        other = problem.body.nearest_turns(other, parameters)
        # What differs less is the same optimum, not quite reached.
        if np.abs(other - parameters).max() > settings.same:
            poses.append(other)
    fits = problem.J(parameters) <= settings.misfit * problem.border_length
    families = []
    for members in _group(poses, margins, settings):
        first = problem.body.nearest_turns(members[0])
        members = [problem.body.nearest_turns(member, first) for member in members]
        joints = _estimates(problem, members, margins, fits, settings)
        families.append(RefinedFamily(tuple(members), joints))
    joints = _estimates(problem, poses, margins, fits, settings)
    return Intervals(joints, covariance, tuple(families), tolerance)


def _group(
    poses: Sequence[np.ndarray], margins: np.ndarray, settings: IntervalSettings
) -> list[list[np.ndarray]]:
    """Poses in groups whose members all differ little from the first."""
    groups: list[list[np.ndarray]] = []
    near = np.maximum(margins, settings.same)
    for pose in poses:
        for group in groups:
            if np.all(np.abs(pose - group[0])[: len(near)] <= near):
                group.append(pose)
                break
        else:
            groups.append([pose])
    return groups


def _estimates(
    problem: RefinementProblem,
    poses: Sequence[np.ndarray],
    margins: np.ndarray,
    fits: bool,
    settings: IntervalSettings,
) -> tuple[JointEstimate, ...]:
    """What some poses say of each value.

    Args:
        problem: gives the body.
        poses: their parameters, the best first.
        margins: (m,) how far the truth may be from a pose.
        fits: whether the best pose may be the true one; else nothing is known.
        settings: the parameters.
    """
    kinematics = problem.body.kinematics
    ends = kinematics.reach(poses[0][: len(kinematics.names)])
    estimates = []
    for j, name in enumerate(kinematics.names):
        node = int(kinematics.value_nodes[j])
        seen = np.array(sorted({float(pose[j]) for pose in poses}))
        lower, upper = float(ends[0][j]), float(ends[1][j])
        low, high = max(seen[0] - margins[j], lower), min(seen[-1] + margins[j], upper)
        widest = settings.widest_angle if kinematics.is_angle[j] else settings.widest_length
        determined = bool(high - low <= 2.0 * widest and fits)
        if not fits:
            low, high = lower, upper
        estimates.append(
            JointEstimate(
                name,
                node,
                determined,
                float(low),
                float(high),
                seen,
                bool(kinematics.turns_around[j]),
            )
        )
    return tuple(estimates)


def _covariance(
    problem: RefinementProblem,
    parameters: np.ndarray,
    freedom: Freedom,
    settings: IntervalSettings,
) -> np.ndarray:
    """The covariance (m, m) of the tree's values about the best pose."""
    equations = problem.equations(parameters, freedom, 1, 0, FINE_PASSES[-1].scale)
    variance = max(_PIXEL_VARIANCE, equations.squares / max(equations.weight, 1e-9))
    variance *= settings.noise_factor**2
    lower, upper = problem.body.lower[freedom.columns], problem.body.upper[freedom.columns]
    # Limits are worth what a value spread evenly between them is.
    spans = np.clip(upper - lower, 1e-6, 2.0 * np.pi)
    information = equations.H / variance + np.diag(12.0 / spans**2)
    inverse = np.linalg.inv(information)
    covariance = np.zeros((len(parameters), len(parameters)))
    covariance[np.ix_(freedom.columns, freedom.columns)] = inverse
    count = len(problem.body.kinematics.names)
    return covariance[:count, :count]


def _find_alternatives(
    problem: RefinementProblem,
    search: PartSearch,
    parameters: np.ndarray,
    tolerance: float,
    settings: IntervalSettings,
) -> list[np.ndarray]:
    """Other local optima that are as good, found by placing parts anew, best first."""
    if settings.alternatives == 0:
        return []
    views = problem.views
    limit = problem.J(parameters) + tolerance
    found: list[tuple[int, np.ndarray]] = []

    def gather(starts: Sequence[np.ndarray], freedom: Freedom) -> None:
        still = problem.still(parameters, freedom.nodes)
        for start in starts:
            refined, apart, _ = descend(problem, start, freedom, OTHER_PASSES[:1], still)
            if apart > limit + _HOPEFUL * tolerance:
                continue
            refined, apart, _ = descend(problem, refined, freedom, OTHER_PASSES[1:], still)
            if apart <= 1.5 * limit:
                J = problem.J(refined)
                if J <= limit:
                    found.append((J, refined))

    for part in search.parts:
        starts = [search.mirror(parameters, part, view) for view in views]
        if not part.held:
            starts += search.propose(problem, parameters, part, settings.alternatives)
        gather(starts, problem.body.freedom(search.moving(part)))
    if len(views) == 1:
        # What is mirrored in the depth of one camera another one sees.
        for reflection in search.reflections:
            starts = [search.reflect(parameters, reflection, views[0])]
            gather(starts, problem.body.freedom((*reflection.nodes, *reflection.held)))
    found.sort(key=lambda pair: pair[0])
    return [refined for _, refined in found]


def pose_set(problem: RefinementProblem, tree: PoseTree, intervals: Intervals) -> PoseSet:
    """The intervals with the poses that they come from, as other searches give them.

    Args:
        problem: the silhouettes.
        tree: the pose tree, with its root where the body is.
        intervals: what is known.
    """
    families = []
    for family in intervals.families:
        node_values = problem.body.node_values(family.members[0])
        q, X_WB = tree.positions_from(node_values)
        J = float(problem.J(family.members[0]))
        size = float(len(family.members))
        families.append(PoseFamily(q, X_WB, node_values, J, family.joints, size))
    return PoseSet(
        families=tuple(families),
        joints=intervals.joints,
        tolerance=intervals.tolerance,
        complete=False,
        family_count=len(families),
    )
