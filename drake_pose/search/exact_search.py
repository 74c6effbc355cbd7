"""Search the pose in exact masks: refine the best poses of beam searches by pixels.

A pose that leaves hardly a border pixel wrong is certainly right, and so are the masks. For damaged
masks, or a model that does not fit the object, ``multi_start`` uses the robust fit instead.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from drake_pose.body import PoseTree
from drake_pose.search.beam_search import BeamSearch, Stage
from drake_pose.search.estimates import PoseSet
from drake_pose.search.parts import NeighbourhoodSearch, NeighbourhoodSettings, PartSearch
from drake_pose.search.refinement import (
    COARSE_PASSES,
    FINE_PASSES,
    LAST_PASSES,
    RefinementBody,
    RefinementProblem,
    descend,
)
from drake_pose.search.self_motions import flips
from drake_pose.search.views_fit import FittedPose, RobustSettings, describe_modes


@dataclass(frozen=True)
class ExactSearchSettings:
    """Parameters of the search in exact masks; limits of J are fractions of the border length.

    The beam searches use grids of 20 degrees (index 0) and 15 degrees (index 1). Each runs only if
    those before it found no good pose: a pose missed on one grid or in one order of nodes is often
    found on another.
    """

    stages: tuple[tuple[int, Stage], ...] = (
        (0, Stage(60, 0.3, 5)),
        (1, Stage(60, 1.0, 2)),
        (1, Stage(60, 1.0, 2, limb_by_limb=True)),
        (1, Stage(60, 0.3, 5, limb_by_limb=True)),
    )
    # Masks may be exact if at least this fraction of their border pixels coincides with the border
    # of a fitted pose. Bodies drawn by Drake have .54 to .99 (``tests/silhouettes``), real arms and
    # people .1 to .51.
    coinciding: float = 0.53
    # The search gives up if J after the coarse passes exceeds the larger of these two: the second
    # is a fraction of the square root of the mean silhouette area [pixel].
    hopeless: float = 1.5
    hopeless_fraction: float = 0.017
    exact: float = 0.18  # A pose with a smaller J is the answer.
    plausible: float = 0.5  # Above this J the pose of the robust fit is the answer.
    same: float = 0.1  # Poses are equal if no value differs by more [rad or m].
    # Ratio of the actual standard deviation to that of statistically independent distances.
    noise_factor: float = 1.4
    misfit: float = 0.025  # Above this J no value is determined: another pose may be right.


class ExactPose(NamedTuple):
    """A pose refined by pixels."""

    parameters: np.ndarray  # (m + 4,) parameters of the pose, as in ``RefinementBody``.
    J: float  # Its objective [pixel].
    first_J: float  # Objective of the start [pixel].
    steps: int  # Number of steps of the refinement.
    neighbourhood: NeighbourhoodSearch  # The search around the pose, which holds alternative poses.


class ExactSearch:
    """Searches poses in exact silhouettes by beam searches and refinement by pixels.

    ``grids``: beam searches on grids of 20 and of 15 degrees, which the settings' stages refer to.
    """

    def __init__(self, grids: Sequence[BeamSearch]) -> None:
        self.settings = ExactSearchSettings()
        self._grids = [grids[k].with_stages(stage) for k, stage in self.settings.stages]
        self.body = RefinementBody(grids[0].tree)
        self._parts = PartSearch(self.body, grids[0].sampled.values)

    def find(
        self, problem: RefinementProblem, root_position: np.ndarray | None, deadline: float
    ) -> ExactPose | None:
        """Return the best pose found.

        ``problem``: the silhouettes and the body. ``root_position``: (3,) the root's position [m];
        None: that of the tree. ``deadline``: time.perf_counter() at which the search ends [s].

        Returns the pose; None if J of all poses of some grid is hopelessly large, or the time is
        up.
        """
        settings, length, reached = self.settings, problem.border_length, None
        views, freedom = problem.views, self.body.freedom()
        size = float(np.sqrt(problem.area / len(views)))
        hopeless = max(settings.hopeless, settings.hopeless_fraction * size)
        for grid in self._grids:
            left = deadline - time.perf_counter()
            if left <= 0.0:
                return None
            starts = grid.best_poses(views, root_position, time_limit=left)
            poses = [self.body.parameters(start, root_position) for start in starts]
            coarse = [descend(problem, pose, freedom, COARSE_PASSES) for pose in poses]
            start = min((parameters for parameters, _, _ in coarse), key=problem.J)
            first_J = float(problem.J(start))
            if first_J > hopeless * length:
                return None
            found = self.refine(problem, start, deadline)
            if first_J <= found.J:
                found = found._replace(parameters=start, J=first_J)
            found = found._replace(steps=found.steps + sum(steps for _, _, steps in coarse))
            reached = min((one for one in (reached, found) if one), key=lambda one: one.J)
            if reached.J <= settings.exact * length:
                break
        if reached is None:
            return None
        last, _ = reached.neighbourhood.improve(reached.parameters, 0.0, deadline, everywhere=True)
        return self._end(problem, reached, last)

    def refine(self, problem: RefinementProblem, start: np.ndarray, deadline: float) -> ExactPose:
        """Refine ``start`` (m + 4,), and place parts anew until ``deadline`` (perf_counter)."""
        fine, _, steps = descend(problem, start, self.body.freedom(), FINE_PASSES)
        neighbourhood = NeighbourhoodSearch(problem, self._parts)
        good = NeighbourhoodSettings.noise * problem.border_length
        parameters, J = neighbourhood.improve(fine, good, deadline)
        return ExactPose(parameters, J, float(problem.J(start)), steps, neighbourhood)

    def _end(
        self, problem: RefinementProblem, reached: ExactPose, parameters: np.ndarray
    ) -> ExactPose:
        """Refine parameters (m + 4,) by the last passes.

        Returns:
            ``reached`` with the parameters and J of the best of three poses: its own, the given
            parameters, and their refinement.
        """
        last, _, steps = descend(problem, parameters, self.body.freedom(), LAST_PASSES)
        best = min((reached.parameters, parameters, last), key=problem.J)
        return reached._replace(
            parameters=self.body.nearest_turns(best),
            J=float(problem.J(best)),
            steps=steps + reached.steps,
        )

    def modes(
        self, problem: RefinementProblem, reached: ExactPose, tree: PoseTree
    ) -> tuple[ExactPose, PoseSet]:
        """Return the best pose, which may be a stored alternative, and its pose set.

        ``reached``: from ``find`` or ``refine``. ``tree``: with its root where the body is.
        """
        settings, others = self.settings, []
        flipped = flips(self.body.kinematics, reached.parameters[:-4])
        reached.neighbourhood.consider(
            [np.r_[one.values, reached.parameters[-4:]] for one in flipped], reached.J
        )
        while True:
            limit = reached.J + NeighbourhoodSettings.noise * problem.border_length
            others = reached.neighbourhood.others(reached.parameters, limit, settings.same)
            if not others or problem.J(others[0]) >= reached.J:
                break
            reached = self._end(problem, reached, others[0])
        return reached, find_intervals(problem, others, reached.parameters, tree)


def find_intervals(
    problem: RefinementProblem, others: Sequence[np.ndarray], parameters: np.ndarray, tree: PoseTree
) -> PoseSet:
    """Return the pose set of exact silhouettes: modes, and an interval for each value.

    The limits of the values are a prior with the variance of a uniform distribution. The covariance
    of the values is

        C = (H / s^2 + diag(12 / span^2))^-1,   s = noise_factor max(1 / sqrt(12), rms distance)

    with H of the normal equations, the span between a value's limits, and distances [pixel].
    If J is above ``settings.misfit``, another pose may be right and no value is determined. On
    drawn bodies 99 % of the intervals around the true optimum contained the true value.

    Args:
        problem: the silhouettes and the body.
        others: alternative poses (m + 4,) that are as good, best first.
        parameters: (m + 4,) the best pose, refined, as in ``RefinementBody``.
        tree: the pose tree, with its root where the body is.

    Returns the set, with the best pose as the representative of the first mode.
    """
    settings = ExactSearchSettings()
    body, kinematics = problem.body, problem.body.kinematics
    count = len(kinematics.names)
    free = body.freedom()
    equations, squares = problem.equations(parameters, free, FINE_PASSES[-1], 0)
    # The variance [pixel^2] is at least that of a border distributed uniformly between two pixel
    # centres. The factor accounts for the correlation of neighbouring distances.
    variance = settings.noise_factor**2 * max(1.0 / 12.0, squares)
    # The limits are a prior with the variance of a uniform distribution between them.
    spans = np.clip(body.upper[free.columns] - body.lower[free.columns], 1e-6, 2.0 * np.pi)
    information = equations.H[0] / variance + np.diag(12.0 / spans**2)
    covariance = np.zeros((count, count))
    covariance[np.ix_(free.columns, free.columns)] = np.linalg.inv(information)
    margins = float(ndtri(0.5 + 0.5 * RobustSettings().confidence)) * np.sqrt(np.diag(covariance))
    fits = problem.J(parameters) <= settings.misfit * problem.border_length
    near = np.maximum(margins, settings.same)
    groups = [[parameters]]
    for other in others:
        # Poses that differ by full turns are equal.
        pose = body.nearest_turns(other, parameters)
        # A pose this near is the same optimum, not fully converged.
        if np.abs(pose - parameters).max() <= settings.same:
            continue
        of_group = (g for g in groups if np.all(np.abs(pose - g[0])[:count] <= near))
        group = next(of_group, None)
        if group is None:
            groups.append([pose])
        else:
            group.append(pose)
    modes, Js = [], []
    for group in groups:
        first = body.nearest_turns(group[0])
        poses = [body.nearest_turns(member, first)[:count] for member in group]
        ends = np.min(poses, axis=0) - margins, np.max(poses, axis=0) + margins
        if not fits:
            ends = np.full(count, -np.inf), np.full(count, np.inf)
        modes.append(FittedPose(poses[0], 0.0, *ends, len(poses)))
        Js.append(float(problem.J(first)))
    tolerance = NeighbourhoodSettings.noise * problem.border_length
    return describe_modes(kinematics, tree, modes, Js, tolerance, fits)
