"""The continuous search: the beam search's best poses on grids, refined between their samples."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.search.beam_search import BeamSearch
from drake_pose.search.estimates import PoseEstimate, SearchStatistics, View
from drake_pose.search.parts import NeighbourhoodSearch, PartSearch
from drake_pose.search.refinement import (
    COARSE_PASSES,
    FINE_PASSES,
    LAST_PASSES,
    RefinementBody,
    RefinementProblem,
    descend,
)
from drake_pose.search.settings import BeamSearchSettings, Stage
from drake_pose.search.views_fit import SAME, TOLERANCE, find_intervals

# The grids that begin [deg]; the next one searches only where none before has led to a good pose.
# What one grid and order of nodes misses, another often has.
_GRIDS = (
    (20.0, Stage(60, 0.3, 5)),
    (15.0, Stage(60, 1.0, 2)),
    (15.0, Stage(60, 1.0, 2, limb_by_limb=True)),
    (15.0, Stage(60, 0.3, 5, limb_by_limb=True)),
)
# So many poses of each that do not look alike (``BeamSearch.best_poses``) are refined.
_STARTS, _ALIKE = 4, 0.5
# Wrong pixels, as a share of the length of the silhouettes' borders, of a pose that is not searched
# on; a little more than the pixels' own noise. With so many times that, no other grid is searched.
_ENOUGH, _FAIR = 0.03, 6.0
# Two grids agree where the worse one's J is no more than this many times the better one's: the body
# fits no better.
_AGREEING = 1.1
# How often another pose found may take the best one's place.
_BETTER = 3


class _Reached(NamedTuple):
    """Where descents led: parameters and J, the first J, the steps, what was found about them."""

    parameters: np.ndarray
    J: float
    first_J: float
    steps: int
    about: NeighbourhoodSearch


class ContinuousSearch:
    """Matches exact silhouettes with a pose tree whose values are continuous."""

    def __init__(self, tree: PoseTree) -> None:
        self.tree = tree
        self._grids = [
            BeamSearch(
                tree,
                BeamSearchSettings(
                    interval=math.radians(interval), stages=(stage,), research_hypotheses=0
                ),
            )
            for interval, stage in _GRIDS
        ]
        self.sampled = self._grids[0].sampled
        self.body = RefinementBody(tree)
        self._parts = PartSearch(self.body, self.sampled.values)

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show, with intervals; see ``PoseSearch``.

        Raises:
            SettingsError: if there is no view.
        """
        begin = time.perf_counter()
        problem = RefinementProblem(self.body, views)
        fair = _FAIR * _ENOUGH * problem.border_length
        reached: _Reached | None = None
        for grid in self._grids:
            starts = grid.best_poses(views, root_position, _STARTS, _ALIKE)
            poses = [self.body.parameters(start, root_position) for start in starts]
            pair = [*([reached] if reached else []), self._descend(problem, poses)]
            reached, worse = min(pair, key=lambda one: one.J), max(one.J for one in pair)
            if reached.J <= fair or (len(pair) > 1 and worse <= _AGREEING * reached.J):
                break
        assert reached is not None, "there are grids"
        last, _ = reached.about.improve(reached.parameters, 0.0, everywhere=True)
        reached = self._end(problem, reached, last)
        middle = time.perf_counter()
        others: list[np.ndarray] = []
        for _ in range(_BETTER):
            limit = reached.J + TOLERANCE * problem.border_length
            others = reached.about.others(reached.parameters, limit, SAME)
            if not others or problem.J(others[0]) >= reached.J:
                break
            reached = self._end(problem, reached, others[0])
        parameters, tree, root = reached.parameters, self.tree, None
        if parameters[-4:-1].any():
            root = self.body.poses(parameters)[0, :3, 3]
            tree = tree.with_root_position(root)
        pose_set, covariance = find_intervals(problem, others, parameters, tree)
        return PoseEstimate.of_values(
            tree,
            self.body.node_values(parameters),
            reached.J,
            problem.area,
            stopped_by="end",
            seconds=middle - begin,
            root_position=root,
            covariance=covariance,
            pose_set=pose_set,
            statistics=SearchStatistics(
                reached.steps, reached.first_J, interval_seconds=time.perf_counter() - middle
            ),
        )

    def _descend(self, problem: RefinementProblem, poses: Sequence[np.ndarray]) -> _Reached:
        """The best pose reached from some, its parts placed anew."""
        freedom = self.body.freedom()
        coarse = [descend(problem, pose, freedom, COARSE_PASSES) for pose in poses]
        start = min((parameters for parameters, _, _ in coarse), key=problem.J)
        first_J = float(problem.J(start))
        parameters, _, count = descend(problem, start, freedom, FINE_PASSES)
        about = NeighbourhoodSearch(problem, self._parts)
        parameters, J = about.improve(parameters, _ENOUGH * problem.border_length)
        if first_J <= J:
            parameters, J = start, first_J
        steps = count + sum(steps for _, _, steps in coarse)
        return _Reached(parameters, J, first_J, steps, about)

    def _end(
        self, problem: RefinementProblem, reached: _Reached, parameters: np.ndarray
    ) -> _Reached:
        """What was reached from there, if it is better, where answers are given."""
        last, _, steps = descend(problem, parameters, self.body.freedom(), LAST_PASSES)
        best = min((reached.parameters, parameters, last), key=problem.J)
        return reached._replace(
            parameters=self.body.nearest_turns(best),
            J=float(problem.J(best)),
            steps=steps + reached.steps,
        )
