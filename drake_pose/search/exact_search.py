"""The search where masks are exact: the beam search's best poses, refined by pixels.

A pose that leaves hardly a pixel of the silhouettes' borders wrong certifies itself and the masks.
Where masks are damaged, or the body is another one, ``multi_start`` does not call this search.
"""

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from drake_pose.body import PoseTree
from drake_pose.search.beam_search import BeamSearch
from drake_pose.search.estimates import PoseSet
from drake_pose.search.parts import NeighbourhoodSearch, PartSearch
from drake_pose.search.refinement import (
    RefinementBody,
    RefinementProblem,
    descend,
)
from drake_pose.search.settings import PASSES, ExactSearchSettings
from drake_pose.search.views_fit import FittedPose, describe_modes


class ExactPose(NamedTuple):
    """A pose reached by pixels: parameters, J and first J [pixel], steps, and what is about it."""

    parameters: np.ndarray
    J: float
    first_J: float
    steps: int
    about: NeighbourhoodSearch


class ExactSearch:
    """Searches exact silhouettes on grids of 20 and 15 degrees and refines what it finds."""

    def __init__(
        self, grids: Sequence[BeamSearch], settings: ExactSearchSettings | None = None
    ) -> None:
        self._settings = settings or ExactSearchSettings()
        self._grids = [grids[k].with_stages(stage) for k, stage in self._settings.stages]
        self.body = RefinementBody(grids[0].tree)
        self._parts = PartSearch(self.body, grids[0].sampled.values)

    def find(
        self, problem: RefinementProblem, root_position: np.ndarray | None, deadline: float
    ) -> ExactPose | None:
        """The best pose reached; None where none comes near, or the time is up."""
        own, length, reached = self._settings, problem.border_length, None
        for grid in self._grids:
            left = deadline - time.perf_counter()
            if left <= 0.0:
                return None
            views = problem.views
            starts = grid.best_poses(views, root_position, own.starts, own.overlap, left)
            poses = [self.body.parameters(start, root_position) for start in starts]
            found = self._descend(problem, poses, deadline)
            if found is None:
                return None
            pair = [*([reached] if reached else []), found]
            reached, worse = min(pair, key=lambda one: one.J), max(one.J for one in pair)
            enough = own.exact * length
            if reached.J <= enough or (len(pair) > 1 and worse <= own.agreement * reached.J):
                break
        if reached is None:
            return None
        last, _ = reached.about.improve(reached.parameters, 0.0, deadline, everywhere=True)
        return self._end(problem, reached, last)

    def _descend(
        self, problem: RefinementProblem, poses: Sequence[np.ndarray], deadline: float
    ) -> ExactPose | None:
        """The best pose reached from some, its parts placed anew; None where none comes near."""
        freedom, length = self.body.freedom(), problem.border_length
        coarse = [descend(problem, pose, freedom, PASSES.coarse) for pose in poses]
        start = min((parameters for parameters, _, _ in coarse), key=problem.J)
        first_J = float(problem.J(start))
        size = float(np.sqrt(problem.area / len(problem.views)))
        hopeless = max(self._settings.hopeless, self._settings.hopeless_fraction * size)
        if first_J > hopeless * length:
            return None
        reached = self.escape(problem, start, deadline)
        if first_J <= reached.J:
            reached = reached._replace(parameters=start, J=first_J)
        return reached._replace(steps=reached.steps + sum(steps for _, _, steps in coarse))

    def escape(self, problem: RefinementProblem, start: np.ndarray, deadline: float) -> ExactPose:
        """The pose reached from parameters (m + 4,), parts placed anew where that is better."""
        fine, _, steps = descend(problem, start, self.body.freedom(), PASSES.fine)
        about = NeighbourhoodSearch(problem, self._parts)
        enough = self._settings.good * problem.border_length
        parameters, J = about.improve(fine, enough, deadline)
        return ExactPose(parameters, J, float(problem.J(start)), steps, about)

    def _end(
        self, problem: RefinementProblem, reached: ExactPose, parameters: np.ndarray
    ) -> ExactPose:
        """What was reached from there, if it is better, where answers are given."""
        last, _, steps = descend(problem, parameters, self.body.freedom(), PASSES.last)
        best = min((reached.parameters, parameters, last), key=problem.J)
        return reached._replace(
            parameters=self.body.nearest_turns(best),
            J=float(problem.J(best)),
            steps=steps + reached.steps,
        )

    def modes(
        self, problem: RefinementProblem, reached: ExactPose, tree: PoseTree
    ) -> tuple[ExactPose, PoseSet]:
        """The best pose, and all that are as good, of a tree with its root where it is."""
        own, others = self._settings, []
        for _ in range(own.replacements):
            limit = reached.J + own.tolerance * problem.border_length
            others = reached.about.others(reached.parameters, limit, own.same)
            if not others or problem.J(others[0]) >= reached.J:
                break
            reached = self._end(problem, reached, others[0])
        return reached, find_intervals(problem, others, reached.parameters, tree, own)


def find_intervals(
    problem: RefinementProblem,
    others: Sequence[np.ndarray],
    parameters: np.ndarray,
    tree: PoseTree | None = None,
    settings: ExactSearchSettings | None = None,
) -> PoseSet:
    """What exact silhouettes say of each value.

    Where more pixels are wrong than a found pose leaves, the pose may be another one altogether:
    nothing is known then. Where intervals missed the truth on drawn bodies, it was by another
    optimum, and no margin would have held it; about the true optimum they held 99 %.

    Args:
        problem: the silhouettes.
        others: (m + 4,) each: other poses that are as good, best first.
        parameters: (m + 4,) the best pose, refined.
        tree: the pose tree, with its root where the body is; None: the body's.

    Returns:
        The poses that are as good, the best leading the first mode.
    """
    own = settings or ExactSearchSettings()
    body, kinematics = problem.body, problem.body.kinematics
    count = len(kinematics.names)
    free = body.freedom()
    equations, squares = problem.equations(parameters, free, PASSES.fine[-1])
    # At least that of a border that lies anywhere between two pixel centres [pixel^2]; and larger
    # than if the distances of all rows and columns were independent.
    variance = own.noise_factor**2 * max(1.0 / 12.0, squares)
    # Limits are worth what a value spread evenly between them is.
    spans = np.clip(body.upper[free.columns] - body.lower[free.columns], 1e-6, 2.0 * np.pi)
    information = equations.H[0] / variance + np.diag(12.0 / spans**2)
    covariance = np.zeros((count, count))
    covariance[np.ix_(free.columns, free.columns)] = np.linalg.inv(information)
    margins = float(ndtri(0.5 + 0.5 * own.confidence)) * np.sqrt(np.diag(covariance))
    fits = problem.J(parameters) <= own.misfit * problem.border_length
    near = np.maximum(margins, own.same)
    groups = [[parameters]]
    for other in others:
        # The same pose is not another one for a full turn.
        pose = body.nearest_turns(other, parameters)
        # What differs less is the same optimum, not quite reached.
        if np.abs(pose - parameters).max() <= own.same:
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
    tolerance = own.tolerance * problem.border_length
    return describe_modes(kinematics, tree or body.tree, modes, Js, tolerance, fits)
