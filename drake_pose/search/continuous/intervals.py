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
from drake_pose.search.estimates import JointEstimate, PoseFamily, PoseSet, joint_estimates
from drake_pose.search.refinement import FINE_PASSES, RefinementProblem

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


def find_intervals(
    problem: RefinementProblem,
    others: Sequence[np.ndarray],
    parameters: np.ndarray,
    settings: IntervalSettings,
    tree: PoseTree | None = None,
) -> tuple[PoseSet, np.ndarray]:
    """What the silhouettes say of each value.

    Args:
        problem: the silhouettes.
        others: (m + 4,) each: other poses that are as good, best first.
        parameters: (m + 4,) the best pose, refined.
        settings: the parameters.
        tree: the pose tree, with its root where the body is; None: the body's.

    Returns:
        The poses that are as good, the best leading the first family, and the covariance (m, m) of
        the tree's values about the best pose, 0 where they are held.
    """
    body = problem.body
    tree, count = tree or body.tree, len(body.kinematics.names)
    covariance = _covariance(problem, parameters, settings)
    z = float(ndtri(0.5 + 0.5 * settings.confidence))
    margins = z * np.sqrt(np.diag(covariance))
    fits = problem.J(parameters) <= settings.misfit * problem.border_length
    near = np.maximum(margins, settings.same)
    poses, groups = [parameters], [[parameters]]
    for other in others:
        # The same pose is not another one for a full turn.
        pose = body.nearest_turns(other, parameters)
        # What differs less is the same optimum, not quite reached.
        if np.abs(pose - parameters).max() <= settings.same:
            continue
        poses.append(pose)
        of_group = (g for g in groups if np.all(np.abs(pose - g[0])[:count] <= near))
        group = next(of_group, None)
        if group is None:
            groups.append([pose])
        else:
            group.append(pose)

    def estimates(members: Sequence[np.ndarray]) -> tuple[JointEstimate, ...]:
        return _estimates(problem, [m[:count] for m in members], margins, fits, settings)

    families = []
    for group in groups:
        first = body.nearest_turns(group[0])
        joints = estimates([body.nearest_turns(member, first) for member in group])
        J, size = float(problem.J(first)), float(len(group))
        families.append(PoseFamily.of_values(tree, body.node_values(first), J, joints, size))
    tolerance = settings.tolerance * problem.border_length
    pose_set = PoseSet(tuple(families), estimates(poses), tolerance, False, len(families))
    return pose_set, covariance


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
        poses: (m,) values of each, the best first.
        margins: (m,) how far the truth may be from a pose.
        fits: whether the best pose may be the true one; else nothing is known.
        settings: the parameters.
    """
    kinematics = problem.body.kinematics
    lower, upper = kinematics.reach(poses[0])
    low = np.maximum(np.min(poses, axis=0) - margins, lower)
    high = np.minimum(np.max(poses, axis=0) + margins, upper)
    widest = np.where(kinematics.is_angle, settings.widest_angle, settings.widest_length)
    determined = (high - low <= 2.0 * widest) & fits
    if not fits:
        low, high = lower, upper
    return joint_estimates(kinematics, low, high, determined, np.array(poses))


def _covariance(
    problem: RefinementProblem, parameters: np.ndarray, settings: IntervalSettings
) -> np.ndarray:
    """The covariance (m, m) of the tree's values about the best pose."""
    body = problem.body
    free = body.freedom()
    equations = problem.equations(parameters, free, FINE_PASSES[-1])
    variance = max(_PIXEL_VARIANCE, equations.squares / max(equations.weight, 1e-9))
    variance *= settings.noise_factor**2
    # Limits are worth what a value spread evenly between them is.
    spans = np.clip(body.upper[free.columns] - body.lower[free.columns], 1e-6, 2.0 * np.pi)
    information = equations.H[0] / variance + np.diag(12.0 / spans**2)
    covariance = np.zeros((len(body.kinematics.names),) * 2)
    covariance[np.ix_(free.columns, free.columns)] = np.linalg.inv(information)
    return covariance
