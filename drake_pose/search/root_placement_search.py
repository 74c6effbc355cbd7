"""The beam search where nobody knows where the root is, nor the scale of a parallel camera.

The root's samples are the product of its rotations and of positions all over the silhouettes. For
every scale or depth a beam of hypotheses is grown of which no root position may keep more than its
quota: what covers most at first is not what fits best at last. Whole poses compare fairly whatever
their scale. The best are refined with the root free; where the roots of the best of these are, the
beam search is run as with a known root; and in what comes of that what still fits badly is placed
anew.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.search.beam_search import BeamSearch, grow
from drake_pose.search.estimates import PoseEstimate, SearchStatistics, View
from drake_pose.search.partial_poses import (
    PartialPoses,
    Pictures,
    PoseStore,
    coarsen,
)
from drake_pose.search.parts import NeighbourhoodSearch, PartSearch
from drake_pose.search.refinement import (
    COARSE_PASSES,
    FINE_PASSES,
    Pass,
    RefinementBody,
    RefinementProblem,
    descend,
)
from drake_pose.search.root_placement import (
    Layer,
    choose_root_samples,
    find_layers,
    place_body,
    scale_camera,
    slide_root,
    whereabouts,
)
from drake_pose.search.settings import BeamSearchSettings, Stage
from drake_pose.workers import map_ordered

# What may lie outside, as in the beam search's tolerant stages; the root is off by half a step.
_OUTSIDE_SHARE, _OUTSIDE_WEIGHT = 0.6, 2
# How many hypotheses are kept, shared among the scales or depths, and the share of them that may
# have the root at one position.
_HYPOTHESES, _QUOTA = 500, 0.05
# How many poses are refined from far; at how many of the root positions reached the poses are
# searched again, and how many are refined to the end; and how many of each search again.
_STARTS, _FINALISTS, _AGAIN = 24, 3, 4
# The silhouettes are looked at with about this many pixels.
_PIXELS = 1500
# How many times the width are kept of the root alone.
_ROOT_FACTOR = 2
# How many times a position's quota of the root's rotations are grown at it.
_ROOT_SPARE = 2
# How many times the width are grown, before the quota.
_SPARE = 8
# The search about a root that has been found, and which of its poses differ (best_poses).
_STAGES, _ALIKE = (Stage(60, 1.0, 2),), 0.5
# The share of the silhouettes' area that may be wrong in a pose that is not searched on.
_ENOUGH = 0.004
# Parameters of the refinement after the tree's values.
_TRANSLATION, _GROWTH = (0, 1, 2), (3,)

_Result = TypeVar("_Result")


@dataclass(frozen=True, eq=False)
class _Placed:
    """A pose somewhere: parameters of the refinement, the body of its own size, and J (1) [pixel].

    ``views``: the silhouettes, their camera scaled; ``scale``: times what it was given as.
    """

    views: tuple[View, ...]
    scale: float
    parameters: np.ndarray
    J: float


class RootPlacementSearch:
    """Matches silhouettes with a pose tree whose root can be anywhere.

    Args:
        tree: the pose tree; where its root is makes no difference.
        settings: the grids and the time limit; its stages are not used.
        scale_unknown: the camera is parallel and its pixels_per_metre is not known.

    Raises:
        SettingsError: if the tree has several roots.
        ModelError: if the model's joints do not let the root be anywhere.
    """

    def __init__(
        self,
        tree: PoseTree,
        settings: BeamSearchSettings | None = None,
        scale_unknown: bool = False,
    ) -> None:
        if sum(node.parent < 0 for node in tree.nodes) != 1:
            raise SettingsError("a root position can be searched only of a tree with one root")
        self.settings = settings or BeamSearchSettings()
        self.scale_unknown = scale_unknown
        p_WR = tree.node_poses(tree.default_values())[0, :3, 3]
        self.tree = tree.with_root_position(p_WR)
        self._grid = BeamSearch(
            self.tree,
            replace(self.settings, stages=_STAGES, research_hypotheses=0, time_limit=None),
        )
        self.body = self._grid.body
        self.sampled = self.body.sampled
        self._refined = RefinementBody(self.tree)
        self._parts = PartSearch(self._refined, self.sampled.values)
        growth = _GROWTH if self.scale_unknown else ()
        self._free = {
            True: self._refined.freedom(extra=(*_TRANSLATION, *growth)),
            False: self._refined.freedom(extra=growth),
        }

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show, and where it is; see ``PoseSearch``.

        Raises:
            SettingsError: if there is no view, or a scale cannot be searched with these
                cameras.
        """
        if not views:
            raise SettingsError("a match needs at least one view, but none was given")
        begin = time.perf_counter()
        limit = self.settings.time_limit
        deadline = math.inf if limit is None else begin + limit
        layers = find_layers(self.body, views, self.scale_unknown, root_position)
        placed: list[_Placed] = []
        width = math.ceil(_HYPOTHESES / len(layers))
        # How many poses each search of a layer has found.
        counts: list[int] = []

        def search(outside_share: float, layer: Layer) -> list[_Placed]:
            if any(counts) and time.perf_counter() >= deadline:
                return []
            found = self._search_layer(layer, width, outside_share)
            counts.append(len(found))
            return found

        for outside_share in (_OUTSIDE_SHARE, math.inf):
            if not placed:
                searched = map_ordered(partial(search, outside_share), layers)
                placed += itertools.chain.from_iterable(searched)
        runs = len(counts) * len(self.tree.nodes)
        if not placed:
            found = PoseEstimate.nothing(
                self.tree, stopped_by="end", statistics=SearchStatistics(runs)
            )
            return replace(found, seconds=time.perf_counter() - begin)
        placed.sort(key=_by_J)
        best = self._improve(placed[:_STARTS], root_position is None, deadline)
        first_J = placed[0].J / _area(views) * _area(best.views)
        found = self._answer(best, SearchStatistics(runs, first_J))
        now = time.perf_counter()
        stopped_by = "time_limit" if now >= deadline else "end"
        return replace(found, stopped_by=stopped_by, seconds=now - begin)

    def _search_layer(self, layer: Layer, width: int, outside_share: float) -> list[_Placed]:
        """The best whole poses of a scale or depth, of each root placement the best."""
        if len(layer.positions) == 0:
            return []
        views = [coarsen(view, _PIXELS) for view in layer.views]
        quota = math.ceil(_QUOTA * width)
        turns = _ROOT_SPARE * _ROOT_FACTOR * quota
        chosen = choose_root_samples(self.body, views, layer.positions, turns, _OUTSIDE_WEIGHT)
        body = place_body(self.body, layer.positions, chosen)
        store = PoseStore(body, Pictures(body, views), outside_share)
        last = self._grow(store, width, quota, chosen // len(self.sampled.X_PN[0]))
        if last is None:
            return []
        # As many pixels as in the silhouettes themselves.
        Js = _area(layer.views) / store.pictures.area * store.objectives(last)
        samples = store.samples(last.poses)
        order = np.argsort(Js, kind="stable")
        firsts = np.sort(np.unique(samples[order, 0], return_index=True)[1])[:_STARTS]
        found = []
        for i in order[firsts]:
            p_WR = body.sampled.X_PN[0][samples[i, 0], :3, 3]
            parameters = self._refined.parameters(body.sampled.values_at(samples[i]), p_WR)
            found.append(_Placed(layer.views, layer.scale, parameters, float(Js[i])))
        return found

    def _grow(
        self, store: PoseStore, width: int, quota: int, places: np.ndarray
    ) -> PartialPoses | None:
        """Whole poses, no root position having more than its quota at any time.

        ``places``: the position of each of the root's samples.
        """
        hypotheses: PartialPoses | None = store.start()
        factor = _ROOT_FACTOR
        for node in self.body.order:
            if hypotheses is None:
                break
            spare = _SPARE * factor * width
            grown, _ = grow(store, hypotheses, node, spare, _OUTSIDE_WEIGHT)
            hypotheses = None
            if grown is not None:
                roots = store.nodes[0].samples[grown.poses[:, 0]]
                kept = _within_quota(places[roots], factor * quota)[: factor * width]
                hypotheses = grown.chosen(kept)
            factor = 1
        return hypotheses

    def _improve(self, starts: Sequence[_Placed], moves: bool, deadline: float) -> _Placed:
        """The best pose reached from some; the root moves, too, if its position is unknown."""

        def before(step: Callable[[_Placed], _Result], one: _Placed) -> _Result | None:
            return step(one) if time.perf_counter() < deadline else None

        settle = partial(before, lambda one: self._settle(one, COARSE_PASSES, moves))
        pool = [one for one in map_ordered(settle, starts) if one is not None]
        pool.sort(key=_by_J)
        again = partial(before, lambda one: self._search_again(one, moves))
        for found in map_ordered(again, self._elsewhere(pool)[:_FINALISTS]):
            pool += found or []
        pool.sort(key=_by_J)
        best = min([*pool, *starts], key=_by_J)
        enough, ends = _ENOUGH * _area(best.views), [best]

        def finish(one: _Placed) -> _Placed | None:
            # One that fits well enough ends it; what is finished beside that one is left out below.
            if min(end.J for end in ends) <= enough:
                return None
            # Not what is last in the list: another thread may have added its own.
            end = self._finish(one, moves, deadline)
            ends.append(end)
            return end

        for end in map_ordered(partial(before, finish), pool[:_FINALISTS]):
            if end is not None and best.J > enough:
                best = min(best, end, key=_by_J)
        return best

    def _elsewhere(self, pool: Sequence[_Placed]) -> list[_Placed]:
        """Those whose root is not near that of one before them."""
        chosen: list[tuple[_Placed, np.ndarray]] = []
        for one in pool:
            here = whereabouts(one.views, self._root_of(one))
            if all(np.abs(here - there).max() >= 1.0 for _, there in chosen):
                chosen.append((one, here))
        return [one for one, _ in chosen]

    def _settle(self, start: _Placed, passes: Sequence[Pass], moves: bool) -> _Placed:
        """The pose refined with its root free, growth turned into the camera's scale."""
        problem = RefinementProblem(self._refined, start.views)
        parameters, _, _ = descend(problem, start.parameters, self._free[moves], passes)
        refined = replace(start, parameters=parameters, J=float(problem.J(parameters)))
        growth, camera = math.exp(parameters[-1]), start.views[0].camera
        if growth == 1.0 or not isinstance(camera, ParallelCamera):
            return refined
        p_WR = slide_root(camera, self._root_of(refined), 1.0 / growth)
        values = self._refined.node_values(parameters)
        return _Placed(
            (View(scale_camera(camera, growth), start.views[0].mask),),
            start.scale * growth,
            self._refined.parameters(values, p_WR),
            refined.J,
        )

    def _root_of(self, placed: _Placed) -> np.ndarray:
        """(3,) where its root is [m]."""
        return np.array(self._refined.poses(placed.parameters)[0, :3, 3])

    def _search_again(self, start: _Placed, moves: bool) -> list[_Placed]:
        """Poses that the beam search finds with the root where it is, refined."""
        p_WR = self._root_of(start)
        poses = self._grid.best_poses(start.views, p_WR, _AGAIN, _ALIKE)
        return [
            self._settle(
                replace(start, parameters=self._refined.parameters(values, p_WR)),
                COARSE_PASSES,
                moves,
            )
            for values in poses
        ]

    def _finish(self, start: _Placed, moves: bool, deadline: float) -> _Placed:
        """The pose refined to the end, and what fits badly placed anew."""
        near = self._settle(start, FINE_PASSES[:2], moves)
        problem = RefinementProblem(self._refined, near.views)
        enough = _ENOUGH * problem.area
        about = NeighbourhoodSearch(problem, self._parts)
        parameters, J = about.improve(near.parameters, enough, deadline)
        better = replace(near, parameters=parameters, J=float(J))
        end = self._settle(better, FINE_PASSES, moves)
        return min(start, near, better, end, key=_by_J)

    def _answer(self, best: _Placed, statistics: SearchStatistics) -> PoseEstimate:
        """The result."""
        p_WR = self._root_of(best)
        tree = self.tree.with_root_position(p_WR)
        parameters = self._refined.nearest_turns(best.parameters)
        # The plant's own joints hold the root where it is now.
        bounds = [tree.value_bounds(i) for i in range(len(tree.nodes))]
        values = [
            np.where(lower == upper, lower, own)
            for own, (lower, upper) in zip(
                self._refined.node_values(parameters), bounds, strict=True
            )
        ]
        return PoseEstimate.of_values(
            tree,
            values,
            RefinementProblem(self._refined, best.views).J(parameters),
            _area(best.views),
            stopped_by="end",
            root_position=p_WR,
            scale=best.scale,
            statistics=statistics,
        )


def _by_J(placed: _Placed) -> float:
    return placed.J


def _area(views: Sequence[View]) -> float:
    """The silhouettes' area [pixel]."""
    return float(sum(view.mask.sum() for view in views))


def _within_quota(groups: np.ndarray, quota: int) -> np.ndarray:
    """Indices of the first ``quota`` elements of every group, in their order."""
    order = np.argsort(groups, kind="stable")
    ordered = groups[order]
    first = np.searchsorted(ordered, ordered)
    rank = np.empty(len(groups), dtype=np.int64)
    rank[order] = np.arange(len(groups)) - first
    return np.flatnonzero(rank < quota)
