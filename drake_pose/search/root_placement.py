"""Estimate a pose with unknown root position, or unknown scale of a parallel camera.

The root's samples are the product of its rotations and the candidate positions (``root_places``).
For every scale or depth a beam search is run in which the number of hypotheses with the same root
position is limited by a quota, since the positions that cover most at first do not always fit best
in the end. The best whole poses of all scales are refined with a free root. At the root positions
of the best ones the beam search with a known root is run, its poses are refined, and parts that fit
badly are placed anew.
"""

import copy
import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.search.beam_search import BeamSearch, BeamSearchSettings, Stage, grow
from drake_pose.search.estimates import PoseEstimate, View, require_views
from drake_pose.search.partial_poses import PoseStore, SilhouetteBits, coarsen
from drake_pose.search.parts import NeighbourhoodSearch, PartSearch
from drake_pose.search.refinement import (
    COARSE_PASSES,
    FINE_PASSES,
    Pass,
    RefinementBody,
    RefinementProblem,
    descend,
)
from drake_pose.search.root_places import (
    RootPlacementSettings,
    RootPlaces,
    find_root_places,
    in_camera,
    root_steps,
    scale_camera,
    slide_root,
)
from drake_pose.search.sampled_body import SampledBody
from drake_pose.workers import map_ordered


def most_connected_node(tree: PoseTree) -> str:
    """Return the name of the node with geometry that has the most neighbours, the first if tied."""
    counts = [
        len(node.children) + (node.parent >= 0) if len(node.mesh.triangles) else -1
        for node in tree.nodes
    ]
    return tree.nodes[int(np.argmax(counts))].name


def root_rotates_freely(tree: PoseTree) -> bool:
    """Return whether the plant's joints at the tree's only root can give it every rotation.

    They must be three angles, besides fixed ones, with ranges of at least pi, 2 pi and 2 pi.
    """
    if sum(node.parent < 0 for node in tree.nodes) != 1 or not tree.nodes[0].positions:
        return False
    kinds = [tree.model.position_kinds[position] for position in tree.nodes[0].positions]
    lower, upper = tree.value_bounds(0)
    ranges = np.sort((upper - lower)[[kind == "angle" for kind in kinds]])
    # Joints without a range do not turn the root.
    ranges = ranges[ranges > 0.0]
    wanted = np.array([np.pi, 2.0 * np.pi, 2.0 * np.pi])
    return len(ranges) == 3 and bool(np.all(ranges >= wanted - 1e-6))


def place_body(body: SampledBody, positions: np.ndarray, chosen: np.ndarray) -> SampledBody:
    """Return a body whose root has samples at combinations of positions and its r rotations.

    ``body``: the body, whose root has r samples, its rotations. ``positions``: (n, 3) positions of
    the root in the world [m]. ``chosen``: (m,) the new samples: i is rotation i % r at position i
    // r.
    """
    placed, sampled = copy.copy(body), copy.copy(body.sampled)
    places, turns = np.divmod(chosen, len(sampled.X_PN[0]))
    shifts = positions[places] - sampled.X_PN[0][0, :3, 3]
    X_WR = sampled.X_PN[0][turns]
    X_WR[:, :3, 3] += shifts
    sampled.X_PN = [X_WR, *sampled.X_PN[1:]]
    sampled.values = [sampled.values[0][turns], *sampled.values[1:]]
    if sampled.bands[0] is not None:
        sampled.bands = [sampled.bands[0][turns], *sampled.bands[1:]]
    placed.sampled = sampled
    placed.p_PB = [np.ascontiguousarray(body.p_PB[0][turns] + shifts[:, None]), *body.p_PB[1:]]
    return placed


def choose_root_samples(
    body: SampledBody,
    views: Sequence[View],
    positions: np.ndarray,
    count: int,
    outside_weight: float,
    farthest: int = 60,
) -> np.ndarray:
    """Choose the rotations of the root node whose projection fits best at each position.

    In one view the projection hardly depends on the position in the image, so the root is drawn
    once for each rotation and shifted by whole pixels. In several views, or if there are no more
    than ``count`` rotations, all are chosen.

    Args:
        body: the body, whose root has r samples, its rotations.
        views: the silhouettes, one per camera.
        positions: (n, 3) positions of the root in the world, of one depth [m].
        count: number of rotations at each position.
        outside_weight: cost of a pixel outside, relative to the gain of a covered one.
        farthest: the root is drawn only up to this distance from its origin [pixel].

    Returns (m,) chosen combinations, in increasing order: i is rotation i % r at position i // r.
    """
    rotations = len(body.sampled.X_PN[0])
    if len(views) > 1 or count >= rotations:
        return np.arange(len(positions) * rotations)
    (view,) = views
    places = np.atleast_2d(view.camera.project(positions)[0])
    middle = int(np.argmin(np.abs(places - places.mean(axis=0)).sum(axis=1)))
    # Images (r, side, side) of the root at its rotations, with its origin at the centre.
    camera, ball, p_WR = view.camera, body.sampled.outlines[0].ball, positions[middle]
    depth = float(in_camera(camera, p_WR)[2])
    scale = float(camera.kernel_parameters()[1])
    reach = float(np.linalg.norm(ball[:3]) + ball[3])
    if not isinstance(camera, ParallelCamera):
        scale /= max(depth - reach, 0.2 * depth)
    half = min(farthest, math.ceil(scale * reach) + 1)
    side, inner = 2 * half + 1, 2 * half - 1
    window = dataclasses.replace(
        camera,
        width=side,
        height=side,
        center_x=camera.center_x - float(places[middle, 0]) + half,
        center_y=camera.center_y - float(places[middle, 1]) + half,
    )
    everywhere = np.pad(np.ones((inner, inner), dtype=np.bool_), 1)
    placed = place_body(body, p_WR[None], np.arange(rotations))
    bits = SilhouetteBits(placed, [View(window, everywhere)], band=1)
    masks = np.zeros((rotations, int(bits.part_starts[-1])), dtype=np.uint64)
    bits.draw_node(0, np.arange(rotations), placed.sampled.X_PN[0], masks)
    pixels = np.unpackbits(masks.view(np.uint8), axis=1, count=inner**2, bitorder="little")
    pictures = np.zeros((rotations, side, side), dtype=np.float32)
    pictures[:, 1:-1, 1:-1] = pixels.reshape(rotations, inner, inner)
    # The cost of covering each pixel; it is 0 beyond the image border.
    pixel_costs = np.pad(outside_weight - (1.0 + outside_weight) * view.mask, side)
    pixel_costs = pixel_costs.astype(np.float32)
    corners = np.rint(places).astype(np.int64) - side // 2 + side
    corners = np.clip(corners, 0, np.array(pixel_costs.shape)[::-1] - side)
    windows = np.lib.stride_tricks.sliding_window_view(pixel_costs, (side, side))
    window_costs = windows[corners[:, 1], corners[:, 0]].reshape(len(places), -1)
    costs = window_costs @ pictures.reshape(rotations, -1).T
    best = np.argpartition(costs, count - 1, axis=1)[:, :count]
    return np.sort((best + rotations * np.arange(len(places))[:, None]).ravel())


@dataclass(frozen=True, eq=False)
class _PlacedPose:
    """A pose with its root position and camera scale."""

    views: tuple[View, ...]  # The silhouettes; a parallel camera has its estimated scale.
    scale: float  # Ratio of that scale to the given one.
    parameters: np.ndarray  # (m + 4,) parameters of the refinement, with log scale 0.
    J: float  # The objective [pixel].


class RootPlacementSearch:
    """Estimates poses with unknown root position, or unknown scale of a parallel camera.

    ``tree``: the pose tree; its root position is not used. ``settings``: the grids and the time
    limit; the stages are not used. None: the defaults. ``scale_unknown``: whether the
    ``pixels_per_metre`` of the one parallel camera is unknown.

    Raises SettingsError: if the tree has several roots; ModelError: if the model's joints do not
    let the root be anywhere.
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
        one_stage = replace(self.settings, stages=(Stage(60, 1.0, 2),), research_hypotheses=0)
        self._grid = BeamSearch(self.tree, replace(one_stage, time_limit=None))
        self.body = self._grid.body
        self.sampled = self.body.sampled
        self._refined = RefinementBody(self.tree)
        self._parts = PartSearch(self._refined, self.sampled.values)
        # Indices into ROOT_NAMES: the three coordinates of the shift, and the log scale.
        log_scale = (3,) if self.scale_unknown else ()
        self._free = {
            True: self._refined.freedom(extra=(0, 1, 2, *log_scale)),
            False: self._refined.freedom(extra=log_scale),
        }
        self._placement = RootPlacementSettings()

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show, and its root position.

        ``views``: the silhouettes, one per camera. ``root_position``: (3,) the root's position in
        the world [m], if it is known; None: it is estimated.

        Returns the best pose found, with ``root_position`` and ``scale``; ``stopped_by`` is "end"
        or "time_limit".

        Raises SettingsError: if there is no view, or a scale cannot be searched with these cameras.
        """
        require_views(views)
        begin = time.perf_counter()
        limit = self.settings.time_limit
        deadline = math.inf if limit is None else begin + limit
        layers = find_root_places(self.body, views, self.scale_unknown, root_position)
        placed: list[_PlacedPose] = []
        settings, width = self._placement, math.ceil(self._placement.hypotheses / len(layers))
        # Number of poses found by each search of a layer.
        counts: list[int] = []

        def search(outside_fraction: float, layer: RootPlaces) -> list[_PlacedPose]:
            if any(counts) and time.perf_counter() >= deadline:
                return []
            found = self._search_layer(layer, width, outside_fraction)
            counts.append(len(found))
            return found

        for outside_fraction in (settings.outside_fraction, math.inf):
            if not placed:
                searched = map_ordered(partial(search, outside_fraction), layers)
                placed += itertools.chain.from_iterable(searched)
        runs = len(counts) * len(self.tree.nodes)
        if not placed:
            found = PoseEstimate.nothing(self.tree, stopped_by="end", runs=runs)
            return replace(found, seconds=time.perf_counter() - begin)
        placed.sort(key=attrgetter("J"))
        best = self._improve(placed[: settings.starts], root_position is None, deadline)
        first_J = placed[0].J / _area(views) * _area(best.views)
        p_WR = self._root_of(best)
        tree = self.tree.with_root_position(p_WR)
        values = self._refined.node_values(self._refined.nearest_turns(best.parameters))
        # Values of the root that the tree now fixes take the fixed value exactly.
        bounds = [tree.value_bounds(i) for i in range(len(tree.nodes))]
        limited = zip(values, bounds, strict=True)
        held = [np.where(lower == upper, lower, one) for one, (lower, upper) in limited]
        J = RefinementProblem(self._refined, best.views).J(best.parameters)
        now = time.perf_counter()
        return PoseEstimate.of_values(
            tree,
            held,
            J,
            _area(best.views),
            stopped_by="time_limit" if now >= deadline else "end",
            seconds=now - begin,
            root_position=p_WR,
            scale=best.scale,
            runs=runs,
            first_J=first_J,
        )

    def _search_layer(
        self, layer: RootPlaces, width: int, outside_fraction: float
    ) -> list[_PlacedPose]:
        """Return the best whole poses of one scale or depth, at most one for each root sample.

        ``layer``: the candidate positions, and the views with the scale that is tried. ``width``:
        beam width. ``outside_fraction``: greatest area of a node outside the silhouettes, as a
        fraction of its mean projected area; infinite: no limit.
        """
        if len(layer.positions) == 0:
            return []
        settings = self._placement
        views = [coarsen(view, settings.coarse_pixels) for view in layer.views]
        quota, factor = math.ceil(settings.quota * width), settings.root_factor
        most = settings.root_spare * factor * quota
        chosen = choose_root_samples(
            self.body, views, layer.positions, most, settings.outside_weight
        )
        body = place_body(self.body, layer.positions, chosen)
        store = PoseStore(body, SilhouetteBits(body, views), outside_fraction)
        # Index of the position of each of the root's samples, for the quota.
        places, hypotheses = chosen // len(self.sampled.X_PN[0]), store.start()
        for node in self.body.order:
            spare = settings.spare * factor * width
            grown = grow(store, hypotheses, node, spare, settings.outside_weight)
            if grown is None:
                return []
            groups = places[store.nodes[0].samples[grown.poses[:, 0]]]
            order = np.argsort(groups, kind="stable")
            ordered = groups[order]
            rank = np.empty(len(groups), dtype=np.int64)
            rank[order] = np.arange(len(groups)) - np.searchsorted(ordered, ordered)
            kept = np.flatnonzero(rank < factor * quota)[: factor * width]
            hypotheses, factor = grown.chosen(kept), 1
        # Convert J to pixels of the full-size silhouettes.
        Js = _area(layer.views) / store.bits.area * store.objectives(hypotheses)
        samples = store.samples(hypotheses.poses)
        order = np.argsort(Js, kind="stable")
        firsts = np.sort(np.unique(samples[order, 0], return_index=True)[1])[: settings.starts]
        found = []
        for i in order[firsts]:
            p_WR = body.sampled.X_PN[0][samples[i, 0], :3, 3]
            parameters = self._refined.parameters(body.sampled.values_at(samples[i]), p_WR)
            found.append(_PlacedPose(layer.views, layer.scale, parameters, float(Js[i])))
        return found

    def _improve(self, starts: Sequence[_PlacedPose], moves: bool, deadline: float) -> _PlacedPose:
        """Return the best pose reached from some starts.

        ``starts``: the starts, best first; at least one. ``moves``: whether the root's position is
        refined, too. ``deadline``: time.perf_counter() after which no further refinement is begun
        [s].
        """

        def before(step: Callable[[_PlacedPose], Any], one: _PlacedPose) -> Any:
            return step(one) if time.perf_counter() < deadline else None

        settle = partial(before, lambda one: self._settle(one, COARSE_PASSES, moves))
        pool = [one for one in map_ordered(settle, starts) if one is not None]
        pool.sort(key=attrgetter("J"))

        def search_again(one: _PlacedPose) -> list[_PlacedPose]:
            # The beam search with the root where it is.
            p_WR = self._root_of(one)
            starts = (
                replace(one, parameters=self._refined.parameters(values, p_WR))
                for values in self._grid.best_poses(one.views, p_WR)
            )
            return [self._settle(start, COARSE_PASSES, moves) for start in starts]

        again = partial(before, search_again)
        # The best pose for each distinct root position.
        elsewhere: list[tuple[_PlacedPose, np.ndarray]] = []
        for one in pool:
            here = root_steps(one.views, self._root_of(one))
            if all(np.abs(here - there).max() >= 1.0 for _, there in elsewhere):
                elsewhere.append((one, here))
        finalists = self._placement.finalists
        for found in map_ordered(again, [one for one, _ in elsewhere[:finalists]]):
            pool += found or []
        pool.sort(key=attrgetter("J"))
        best = min([*pool, *starts], key=attrgetter("J"))
        good, ends = self._placement.good_E_total * _area(best.views), [best]

        def finish(one: _PlacedPose) -> _PlacedPose | None:
            # A pose that fits well ends the search; poses finished in parallel to it are ignored.
            if min(end.J for end in ends) <= good:
                return None
            # Not the last item of the list, which another thread may have added.
            end = self._finish(one, moves, deadline)
            ends.append(end)
            return end

        for end in map_ordered(partial(before, finish), pool[:finalists]):
            if end is not None and best.J > good:
                best = min(best, end, key=attrgetter("J"))
        return best

    def _settle(self, start: _PlacedPose, passes: Sequence[Pass], moves: bool) -> _PlacedPose:
        """Refine a pose by passes, with the camera's scale if that is unknown.

        The refinement scales the body; the result has the scale in its parallel camera instead.
        ``moves``: whether the root's position is refined, too.
        """
        problem = RefinementProblem(self._refined, start.views)
        parameters, _, _ = descend(problem, start.parameters, self._free[moves], passes)
        refined = replace(start, parameters=parameters, J=float(problem.J(parameters)))
        factor, camera = math.exp(parameters[-1]), start.views[0].camera
        if factor == 1.0 or not isinstance(camera, ParallelCamera):
            return refined
        p_WR = self._root_of(refined)
        if moves:
            p_WR = slide_root(camera, p_WR, 1.0 / factor)
        views = (View(scale_camera(camera, factor), start.views[0].mask),)
        parameters = self._refined.parameters(self._refined.node_values(parameters), p_WR)
        J = float(RefinementProblem(self._refined, views).J(parameters))
        return _PlacedPose(views, start.scale * factor, parameters, J)

    def _root_of(self, placed: _PlacedPose) -> np.ndarray:
        """Return the position (3,) of a pose's root in the world [m]."""
        return np.array(self._refined.poses(placed.parameters)[0, :3, 3])

    def _finish(self, start: _PlacedPose, moves: bool, deadline: float) -> _PlacedPose:
        """Refine a pose to the end, and place bad parts anew; return the pose of least J.

        ``moves``: whether the root's position is refined. ``deadline``: perf_counter() [s] after
        which no further part is placed anew.
        """
        near = self._settle(start, FINE_PASSES[:2], moves)
        problem = RefinementProblem(self._refined, near.views)
        good = self._placement.good_E_total * problem.area
        neighbourhood = NeighbourhoodSearch(problem, self._parts)
        parameters, J = neighbourhood.improve(near.parameters, good, deadline)
        better = replace(near, parameters=parameters, J=float(J))
        end = self._settle(better, FINE_PASSES, moves)
        return min(start, near, better, end, key=attrgetter("J"))


def _area(views: Sequence[View]) -> float:
    """Return the total area of the silhouettes [pixel]."""
    return float(sum(view.mask.sum() for view in views))
