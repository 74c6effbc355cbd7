"""What silhouettes say of each continuous value: an interval, or that it is free.

Three things bound what can be said. The boundaries' distances have the noise of pixels, and the
curvature of their sum of squares turns it into a covariance of the values. Other local optima may
be as good: what the search came by or, part after part, placed anew or mirrored in depth, seen by
one camera even half of the body with left and right exchanged, and what comes as close to the
silhouettes once refined belongs to the answer. And where more pixels are wrong than a found pose
leaves, the pose may be another one altogether: nothing is known then.

Where intervals missed the truth on drawn bodies it was not by a little: the pose was another local
optimum, mirrored as a whole with one limb that limits kept from being mirrored, and no margin would
have held it; intervals about the true optimum held 99 % and were too wide. So the search takes over
what it comes by here that is better, mends mirrored bodies (see ``starts.neighbourhood``) and draws
the pose into the bounds of the pixels (``LAST_PASSES``), after which a true pose leaves the share
0.004 to 0.02 of the border's pixels wrong and most others leave more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import SettingsError
from drake_pose.search.estimates import JointEstimate, PoseFamily, PoseSet
from drake_pose.search.refinement import FINE_PASSES, Freedom, RefinementProblem

# The variance of a border that lies anywhere between two pixel centres [pixel^2].
_PIXEL_VARIANCE = 1.0 / 12.0


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
        same: poses none of whose values differ by more are of one family [rad or m].

    Raises:
        SettingsError: if a value is out of its range.
    """

    confidence: float = 0.95
    widest_angle: float = np.radians(10.0)
    widest_length: float = 0.02
    noise_factor: float = 1.4
    tolerance: float = 0.03
    misfit: float = 0.025
    same: float = 0.1

    def __post_init__(self) -> None:
        if not 0.0 < self.confidence < 1.0:
            raise SettingsError(f"confidence must lie between 0 and 1, not {self.confidence}")
        for name in ("widest_angle", "widest_length", "noise_factor", "same"):
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"{name} must be positive, not {getattr(self, name)}")
        if self.tolerance < 0.0 or self.misfit < 0.0:
            raise SettingsError("tolerance and misfit must not be negative")


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
    others: Sequence[np.ndarray],
    parameters: np.ndarray,
    settings: IntervalSettings,
) -> Intervals:
    """What the silhouettes say of each value.

    Args:
        problem: the silhouettes.
        others: (m + 4,) each: other poses that are as good, best first.
        parameters: (m + 4,) the best pose, refined.
        settings: the parameters.
    """
    covariance = _covariance(problem, parameters, problem.body.freedom(), settings)
    z = float(ndtri(0.5 + 0.5 * settings.confidence))
    margins = z * np.sqrt(np.diag(covariance))
    tolerance = settings.tolerance * problem.border_length
    poses = [parameters]
    for other in others:
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
    equations = problem.equations(parameters, freedom, FINE_PASSES[-1])
    variance = max(_PIXEL_VARIANCE, equations.squares / max(equations.weight, 1e-9))
    variance *= settings.noise_factor**2
    lower, upper = problem.body.lower[freedom.columns], problem.body.upper[freedom.columns]
    # Limits are worth what a value spread evenly between them is.
    spans = np.clip(upper - lower, 1e-6, 2.0 * np.pi)
    information = equations.H[0] / variance + np.diag(12.0 / spans**2)
    inverse = np.linalg.inv(information)
    covariance = np.zeros((len(parameters), len(parameters)))
    covariance[np.ix_(freedom.columns, freedom.columns)] = inverse
    count = len(problem.body.kinematics.names)
    return covariance[:count, :count]


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
