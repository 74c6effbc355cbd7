"""The continuous search: the beam search's best poses on grids, refined between their samples."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import SettingsError
from drake_pose.search.continuous.intervals import IntervalSettings, find_intervals
from drake_pose.search.estimates import PoseEstimate, SearchStatistics, View
from drake_pose.search.grid.beam_search import BeamSearch
from drake_pose.search.refinement import (
    COARSE_PASSES,
    FINE_PASSES,
    LAST_PASSES,
    RefinementBody,
    RefinementProblem,
    descend,
)
from drake_pose.search.settings import BeamSearchSettings, Stage
from drake_pose.search.starts.neighbourhood import NeighbourhoodSearch
from drake_pose.search.starts.part_placement import PartSearch

# No other start is searched on where one has led to this many times what is enough.
_FAIR = 6.0
# Rounds agree where the worse one's J is no more than this many times the better one's.
_AGREEING = 1.1
# How often another pose found may take the best one's place.
_BETTER = 3


def _grid(interval_deg: float, stage: Stage) -> BeamSearchSettings:
    return BeamSearchSettings(
        interval=math.radians(interval_deg), stages=(stage,), research_hypotheses=0
    )


# What one grid and order of nodes misses, another often has.
_GRIDS = (
    _grid(20.0, Stage(60, 0.3, 5)),
    _grid(15.0, Stage(60, 1.0, 2)),
    _grid(15.0, Stage(60, 1.0, 2, limb_by_limb=True)),
    _grid(15.0, Stage(60, 0.3, 5, limb_by_limb=True)),
)


@dataclass(frozen=True)
class ContinuousSearchSettings:
    """Parameters of the continuous search.

    Args:
        grids: of the beam searches that find where to start, at least one; the next one searches
            only where none before has led to a good pose.
        starts: how many poses of each that do not look alike are refined.
        alike: as in ``BeamSearch.best_poses``.
        enough: wrong pixels, as a share of the length of the silhouettes' borders, of a pose that
            is not searched on; a little more than the pixels' own noise.
        intervals: how intervals are found; None: they are not.
        time_limit: the search returns its best pose so far after this time [s]; None: no limit.
    """

    grids: tuple[BeamSearchSettings, ...] = _GRIDS
    starts: int = 4
    alike: float = 0.5
    enough: float = 0.03
    intervals: IntervalSettings | None = field(default_factory=IntervalSettings)
    time_limit: float | None = None

    def __post_init__(self) -> None:
        if self.starts < 1:
            raise SettingsError(f"starts must be 1 or more, not {self.starts}")
        if not self.enough >= 0.0:
            raise SettingsError(f"enough must be 0 or more, not {self.enough}")
        if not self.grids:
            raise SettingsError("a continuous search needs at least one grid")


class _Reached(NamedTuple):
    """Where descents led: parameters and J, the first J, the steps, what was found about them."""

    parameters: np.ndarray
    J: float
    first_J: float
    steps: int
    about: NeighbourhoodSearch


class ContinuousSearch:
    """Matches silhouettes with a pose tree whose values are continuous.

    Args:
        tree: the pose tree.
        settings: the parameters.
    """

    def __init__(self, tree: PoseTree, settings: ContinuousSearchSettings | None = None) -> None:
        self.tree = tree
        self.settings = settings or ContinuousSearchSettings()
        self._grids = [BeamSearch(tree, grid) for grid in self.settings.grids]
        self.sampled = self._grids[0].sampled
        self.body = RefinementBody(tree)
        self._parts = PartSearch(self.body, self.sampled.values)

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show.

        Args:
            views: one or several silhouettes of the same instant.
            root_position: (3,), the root's known position in the world [m], where it is not the
                pose tree's own.

        Raises:
            SettingsError: if there is no view.
        """
        begin = time.perf_counter()
        limit = self.settings.time_limit
        deadline = math.inf if limit is None else begin + limit
        rounds = self._starts(views, root_position)
        starts = next((starts for starts in rounds if starts), ())
        if not starts:
            seconds = time.perf_counter() - begin
            return PoseEstimate.nothing(self.tree, stopped_by="time_limit", seconds=seconds)
        grid_seconds = time.perf_counter() - begin
        refined = self.refine(views, starts, root_position, deadline, rounds)
        return replace(refined, seconds=refined.seconds + grid_seconds)

    def _starts(
        self, views: Sequence[View], root_position: np.ndarray | None
    ) -> Iterator[Sequence[Sequence[np.ndarray]]]:
        """Each grid's best poses, made when they are asked for."""
        for grid in self._grids:
            yield grid.best_poses(
                views, root_position, self.settings.starts, self.settings.alike
            ).node_values

    def refine(
        self,
        views: Sequence[View],
        starts: Sequence[Sequence[np.ndarray]],
        root_position: np.ndarray | None = None,
        deadline: float = math.inf,
        others: Iterable[Sequence[Sequence[np.ndarray]]] = (),
    ) -> PoseEstimate:
        """The best pose reached from some poses.

        Args:
            views: one or several silhouettes of the same instant.
            starts: node values of each pose to start from, at least one.
            root_position: (3,) the root's position [m], where it is not the tree's own.
            deadline: what has begun then is ended by the shortest way (``time.perf_counter``).
            others: more poses to start from, taken one round after another while none has led to a
                good pose. Two rounds that end equally well end the search: the body fits no better.

        Raises:
            SettingsError: if there is no view or no start.
        """
        if not starts:
            raise SettingsError("a refinement needs at least one pose to start from")
        begin = time.perf_counter()
        poses = [self.body.parameters(start, root_position) for start in starts]
        problem = RefinementProblem(self.body, views)
        reached = self._descend_all(problem, poses, deadline)
        rounds = iter(others)
        fair = _FAIR * self.settings.enough * problem.border_length
        while reached.J > fair and time.perf_counter() < deadline:
            more = next(rounds, None)
            if more is None:
                break
            poses = [self.body.parameters(start, root_position) for start in more]
            if not poses:
                continue
            again = self._descend_all(problem, poses, deadline)
            reached, worse = sorted((reached, again), key=lambda one: one.J)
            if worse.J <= _AGREEING * reached.J:
                break
        in_time = time.perf_counter() <= deadline
        if in_time:
            reached = self._descend_last(problem, reached, deadline)
        nearest = self.body.nearest_turns(reached.parameters)
        reached = reached._replace(parameters=nearest)
        middle = time.perf_counter()
        as_good: list[np.ndarray] = []
        if self.settings.intervals is not None:
            reached, as_good = self._find_others(problem, reached, self.settings.intervals)
        found = self._answer(problem, reached, as_good)
        return replace(
            found,
            seconds=middle - begin,
            stopped_by="end" if in_time else "time_limit",
            statistics=replace(found.statistics, interval_seconds=time.perf_counter() - middle),
        )

    def _descend_all(
        self, problem: RefinementProblem, poses: Sequence[np.ndarray], deadline: float
    ) -> _Reached:
        """The best pose reached, its parts placed anew."""
        freedom = self.body.freedom()
        steps = 0
        coarse: list[tuple[int, int, np.ndarray]] = []
        for pose in poses:
            if coarse and time.perf_counter() > deadline:
                break
            parameters, _, count = descend(problem, pose, freedom, COARSE_PASSES)
            coarse.append((problem.J(parameters), len(coarse), parameters))
            steps += count
        first_J, _, start = min(coarse, key=lambda entry: entry[:2])
        parameters, _, count = descend(problem, start, freedom, FINE_PASSES)
        about = NeighbourhoodSearch(problem, self._parts)
        enough = self.settings.enough * problem.border_length
        parameters, J = about.improve(parameters, enough, deadline)
        if first_J <= J:
            parameters, J = start, first_J
        return _Reached(parameters, J, first_J, steps + count, about)

    def _descend_last(
        self, problem: RefinementProblem, reached: _Reached, deadline: float
    ) -> _Reached:
        """What was reached, improved all over, as near its optimum as there is time."""
        parameters, _ = reached.about.improve(reached.parameters, 0.0, deadline, everywhere=True)
        return self._end(problem, reached, parameters)

    def _end(
        self, problem: RefinementProblem, reached: _Reached, parameters: np.ndarray
    ) -> _Reached:
        """What was reached from there, if it is better."""
        freedom = self.body.freedom()
        last, _, steps = descend(problem, parameters, freedom, LAST_PASSES)
        steps += reached.steps
        best = min((reached.parameters, parameters, last), key=problem.J)
        return reached._replace(parameters=best, J=float(problem.J(best)), steps=steps)

    def _find_others(
        self, problem: RefinementProblem, reached: _Reached, settings: IntervalSettings
    ) -> tuple[_Reached, list[np.ndarray]]:
        """The best of all poses found, and the others that are as good."""
        others: list[np.ndarray] = []
        for _ in range(_BETTER):
            limit = reached.J + settings.tolerance * problem.border_length
            others = reached.about.others(reached.parameters, limit, settings.same)
            if not others or problem.J(others[0]) >= reached.J:
                break
            reached = self._end(problem, reached, others[0])
            nearest = self.body.nearest_turns(reached.parameters)
            reached = reached._replace(parameters=nearest)
        return reached, others

    def _answer(
        self, problem: RefinementProblem, reached: _Reached, others: Sequence[np.ndarray]
    ) -> PoseEstimate:
        """The result, with intervals where these are asked for."""
        parameters = reached.parameters
        tree, root_position = self.tree, None
        if parameters[-4:-1].any():
            root_position = self.body.poses(parameters)[0, :3, 3]
            tree = tree.with_root_position(root_position)
        pose_set, covariance, settings = None, None, self.settings.intervals
        if settings is not None:
            pose_set, covariance = find_intervals(problem, others, parameters, settings, tree)
        return PoseEstimate.of_values(
            tree,
            self.body.node_values(parameters),
            reached.J,
            problem.area,
            stopped_by="end",
            root_position=root_position,
            scale=float(np.exp(parameters[-1])),
            covariance=covariance,
            pose_set=pose_set,
            statistics=SearchStatistics(reached.steps, reached.first_J),
        )
