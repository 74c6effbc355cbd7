"""The coarse search: poses from which a continuous refinement has a chance.

On a grid as coarse as is affordable, the pose nearest to the truth may show less of the silhouette
than a wrong one: a thin limb half a step off leaves it altogether. So this search compares places,
not areas, and lets a distance of less than half a step pass. It places one node after another and
keeps thousands of hypotheses; of those whose nodes with children to come stand alike only the best,
because their future is the same.

A node is a few balls that its picture surely covers; nothing is drawn. A ball outside the
silhouette costs its part of the node's area, a ball partly outside costs a part of that. What a
ball covers is looked up among points spread over the silhouette.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from drake_pose.camera.models import ParallelCamera
from drake_pose.compiled import compiled
from drake_pose.search.estimates import View
from drake_pose.search.pair_kernel import count_bits
from drake_pose.search.sampled_body import SampledBody
from drake_pose.silhouette.pictures.masks import signed_distances
from drake_pose.workers import map_ordered


class CoarseView(NamedTuple):
    """One silhouette as the coarse search sees it.

    camera: (8,) kernel parameters; X_CW: (4, 4); origin: (2,) first row and column of the cover
    [pixel]; cell: the side of the cover's cells [pixel]; radii: (levels,) [pixel], in equal steps;
    cover: (levels, rows, columns, 4) uint64 the points of the silhouette within a radius of each
    cell's middle; parts: how many distances are known along a cell's side; distances: (parts *
    rows, parts * columns) float32 signed distance of each part's middle from the silhouette's edge,
    positive outside [pixel]; point_area: what a point stands for [pixel]; slack: distances up to
    this do not count [pixel].
    """

    camera: np.ndarray
    X_CW: np.ndarray
    origin: np.ndarray
    cell: float
    radii: np.ndarray
    cover: np.ndarray
    parts: int
    distances: np.ndarray
    point_area: float
    slack: float


class ScratchBuffers(NamedTuple):
    """What one hypothesis's samples are seen to do; see _make_buffers.

    columns, rows: (n,) float32 [cell], column -1: not seen; scales: (n,) float32 [pixel/m]; costs:
    (n,) float32 [pixel]; covered: (n, 4) uint64.
    """

    columns: np.ndarray
    rows: np.ndarray
    scales: np.ndarray
    costs: np.ndarray
    covered: np.ndarray


class Balls(NamedTuple):
    """A node's balls.

    p_PB: (k, 3, n) float32 their centres in the parent's frame at each of n samples [m]; radii:
    (k,) float32 [m]; area: what each stands for of the node's mean projected area [m^2].
    """

    p_PB: np.ndarray
    radii: np.ndarray
    area: float


@compiled
def fill_cover(
    cover: np.ndarray, points: np.ndarray, origin: np.ndarray, cell: float, radii: np.ndarray
) -> None:
    """Writes CoarseView.cover of points (n, 2) row, column."""
    for level in range(cover.shape[0]):
        limit = radii[level] ** 2
        for i in range(cover.shape[1]):
            row = origin[0] + (i + 0.5) * cell
            for j in range(cover.shape[2]):
                column = origin[1] + (j + 0.5) * cell
                for p in range(points.shape[0]):
                    if (points[p, 0] - row) ** 2 + (points[p, 1] - column) ** 2 <= limit:
                        cover[level, i, j, p // 64] |= np.uint64(1) << np.uint64(p % 64)


@compiled
def _make_buffers(count: int) -> ScratchBuffers:
    """Buffers for this many samples."""
    return ScratchBuffers(
        np.empty(count, dtype=np.float32),
        np.empty(count, dtype=np.float32),
        np.empty(count, dtype=np.float32),
        np.empty(count, dtype=np.float32),
        np.empty((count, 4), dtype=np.uint64),
    )


@compiled
def _project_ball(
    view: CoarseView, X_CP: np.ndarray, p_PB: np.ndarray, buffers: ScratchBuffers
) -> None:
    """Writes where a ball is seen at all samples: columns, rows, scales.

    Single precision, and no branches: the processor does many samples at once.
    """
    camera, one, least = view.camera, np.float32(1.0), np.float32(view.camera[5])
    focal_x = np.float32(camera[1] / view.cell)
    focal_y = np.float32(camera[2] / view.cell)
    center_x = np.float32((camera[3] - view.origin[1]) / view.cell)
    center_y = np.float32((camera[4] - view.origin[0]) / view.cell)
    left, right = view.origin[1] + 0.5, view.origin[1] - camera[6] + 0.5
    low_x, high_x = np.float32(-left / view.cell), np.float32(-right / view.cell)
    top, bottom = view.origin[0] + 0.5, view.origin[0] - camera[7] + 0.5
    low_y, high_y = np.float32(-top / view.cell), np.float32(-bottom / view.cell)
    pixels = np.float32(camera[1])
    xx, xy, xz = np.float32(X_CP[0, 0]), np.float32(X_CP[0, 1]), np.float32(X_CP[0, 2])
    yx, yy, yz = np.float32(X_CP[1, 0]), np.float32(X_CP[1, 1]), np.float32(X_CP[1, 2])
    zx, zy, zz = np.float32(X_CP[2, 0]), np.float32(X_CP[2, 1]), np.float32(X_CP[2, 2])
    x0, y0, z0 = np.float32(X_CP[0, 3]), np.float32(X_CP[1, 3]), np.float32(X_CP[2, 3])
    parallel = camera[0] != 0.0
    for k in range(buffers.rows.shape[0]):
        p, q, r = p_PB[0, k], p_PB[1, k], p_PB[2, k]
        depth = one if parallel else zx * p + zy * q + zz * r + z0
        nearness = one / max(depth, least)
        column = focal_x * (xx * p + xy * q + xz * r + x0) * nearness + center_x
        row = focal_y * (yx * p + yy * q + yz * r + y0) * nearness + center_y
        seen = (depth >= least) & (column > low_x) & (column < high_x)
        seen = seen & (row > low_y) & (row < high_y)
        buffers.columns[k] = column
        buffers.rows[k] = row
        buffers.scales[k] = pixels * nearness if seen else np.float32(0.0)


@compiled
def _look_at_samples(
    view: CoarseView, X_CP: np.ndarray, balls: Balls, buffers: ScratchBuffers
) -> None:
    """Writes what a node costs and covers at all samples: costs, covered."""
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    tiny = np.float32(1e-9)
    slack, parts = np.float32(view.slack), np.float32(view.parts)
    levels, rows, columns = view.cover.shape[:3]
    least = np.float32(view.radii[0])
    steps = np.float32((levels - 1) / (view.radii[levels - 1] - view.radii[0]))
    area = np.float32(balls.area * view.camera[2] / view.camera[1])
    for k in range(buffers.costs.shape[0]):
        buffers.costs[k] = zero
        for word in range(4):
            buffers.covered[k, word] = np.uint64(0)
    for ball in range(balls.radii.shape[0]):
        _project_ball(view, X_CP, balls.p_PB[ball], buffers)
        for k in range(buffers.costs.shape[0]):
            scale = buffers.scales[k]
            if scale == zero:
                continue
            column, row = buffers.columns[k], buffers.rows[k]
            radius = scale * balls.radii[ball]
            share = one
            if zero <= column < columns and zero <= row < rows:
                beyond = view.distances[int(row * parts), int(column * parts)] + radius - slack
                share = max(zero, min(one, half * beyond / max(radius, tiny)))
                level = int(
                    max(zero, min(np.float32(levels - 1), (radius + slack - least) * steps))
                )
                i, j = int(row), int(column)
                buffers.covered[k, 0] |= view.cover[level, i, j, 0]
                buffers.covered[k, 1] |= view.cover[level, i, j, 1]
                buffers.covered[k, 2] |= view.cover[level, i, j, 2]
                buffers.covered[k, 3] |= view.cover[level, i, j, 3]
            buffers.costs[k] += scale * scale * area * share


@compiled
def score_samples(
    view: CoarseView,
    X_CP: np.ndarray,
    balls: Balls,
    masks: np.ndarray,
    outside_weight: float,
    scores: np.ndarray,
) -> np.ndarray:
    """Adds what a node at all its samples would add to hypotheses in one view.

    Args:
        X_CP: (B, 4, 4) poses of the node's parent in the camera.
        masks: (B, 4) uint64 the points that the hypotheses cover.
        outside_weight: what a pixel outside counts; one newly covered counts -1.
        scores: (B, n) added to [pixel].

    Returns:
        (B, n, 4) the points that the hypotheses would cover.
    """
    count = scores.shape[1]
    buffers = _make_buffers(count)
    united = np.empty((X_CP.shape[0], count, 4), dtype=np.uint64)
    for h in range(X_CP.shape[0]):
        _look_at_samples(view, X_CP[h], balls, buffers)
        for k in range(count):
            gain = 0
            for word in range(4):
                gain += int(count_bits(buffers.covered[k, word] & ~masks[h, word]))
                united[h, k, word] = masks[h, word] | buffers.covered[k, word]
            scores[h, k] += outside_weight * buffers.costs[k] - gain * view.point_area
    return united


_WORDS = 4
_LEVELS = 10
# How many cells of a cover are as wide as the root of the silhouettes' area.
_CELLS = 40.0
# A cover has this many rows and columns at most: 80 MB.
_MOST_CELLS = 500
# A cell is divided into this many parts along its side, where it has as many pixels.
_PARTS = 4
_LEAST_HYPOTHESES = 64
# How many times the hypotheses kept are looked at for some that do not stand alike: at first, and
# where these are too few.
_SPARES = 2, 8
INTERVAL, LENGTH_INTERVAL = math.radians(15.0), 0.05
"""Sampling intervals of every angle [rad] and of every prismatic position [m]."""

HYPOTHESES, _AGAIN = 2500, 300
"""At most this many are kept after each node; fewer where a limb of a pose is searched again."""

# So many are scored by a worker at once.
_AT_ONCE = 5000
# Fewer are kept where a node's samples times the hypotheses exceed this.
_EVALUATIONS = 150_000
# Distances that do not count, as a share of the root of the silhouette's area.
_SLACK = 0.05
# What a pixel outside counts; one newly covered counts one.
_OUTSIDE_WEIGHT = 0.8
# Frames stand alike if points in them differ by less than about this share of the body's reach.
_ALIKE = 0.04
# Nodes come nearer to a camera than the root by this factor at most.
_NEARER = 0.7


@dataclass(frozen=True)
class CoarsePoses:
    """Poses on the grid, best first: X_WN (n, nodes, 4, 4), costs (n,), comparable in one search.

    ``samples``: (n, nodes) of each node; -1 where it was not searched.
    """

    samples: np.ndarray
    X_WN: np.ndarray
    costs: np.ndarray

    def __len__(self) -> int:
        return len(self.samples)

    def only(self, chosen: np.ndarray) -> CoarsePoses:
        """Those at indices."""
        return CoarsePoses(self.samples[chosen], self.X_WN[chosen], self.costs[chosen])


class CoarseSearch:
    """Finds coarse poses of a body, sampled at the intervals above, in views of one instant."""

    def __init__(
        self, body: SampledBody, views: Sequence[View], hypotheses: int = HYPOTHESES
    ) -> None:
        self.body = body
        self._hypotheses = hypotheses
        self._views = _prepare_views(body, views)
        self._cameras = [view.camera for view in views]
        self._size = _mean_size(views)
        self._nodes = body.sampled.tree.nodes
        self._reach = max(
            float(body.reach_balls[i, 3]) for i, node in enumerate(self._nodes) if node.parent < 0
        )
        self._p_NB = [
            (p_PB[0] - X_PN[0, :3, 3]) @ X_PN[0, :3, :3]
            for p_PB, X_PN in zip(body.p_PB, body.sampled.X_PN, strict=True)
        ]
        self._balls = [
            Balls(
                _by_ball(body.p_PB[i]),
                radii.astype(np.float32),
                body.surface_areas[i] / max(1, len(radii)),
            )
            for i, radii in enumerate(body.ball_radii)
        ]

    def find(self) -> CoarsePoses:
        """Search all nodes."""
        nodes = range(len(self._nodes))
        start = np.tile(np.eye(4), (len(self._nodes), 1, 1))
        return self._find(start, set(nodes), self._hypotheses)

    def find_again(self, X_WN: np.ndarray, again: Sequence[int]) -> CoarsePoses:
        """Search some nodes of a pose X_WN (nodes, 4, 4) again, with all their descendants."""
        return self._find(X_WN, set(again), _AGAIN)

    def _find(self, start: np.ndarray, wanted: set[int], hypotheses: int) -> CoarsePoses:
        nodes = self._nodes
        poses = CoarsePoses(np.full((1, len(nodes)), -1), start[None].copy(), np.zeros(1))
        masks = [np.zeros((1, _WORDS), dtype=np.uint64) for _ in self._views]
        placed = set(range(len(nodes))) - wanted
        for node in placed:
            masks = self._cover(node, start, masks)
        for node in self.body.limb_order:
            if node in wanted:
                placed.add(node)
                poses, masks = self._grow(node, poses, masks, placed, hypotheses)
        return poses

    def choose_distinct(self, poses: CoarsePoses, count: int, apart: float) -> CoarsePoses:
        """The best poses some ball of which is seen apart from where it is in any better one.

        ``apart``: in some view, as a share of the root of the silhouettes' area.
        """
        marks = [
            np.vstack([p_NB.mean(axis=0), p_NB[0]]) @ np.swapaxes(X[:, :3, :3], 1, 2)
            + X[:, None, :3, 3]
            for p_NB, X in zip(self._p_NB, poses.X_WN.swapaxes(0, 1), strict=True)
            if len(p_NB)
        ]
        p_WB = np.concatenate(marks, axis=1).reshape(-1, 3)
        places = [camera.project(p_WB)[0].reshape(len(poses), -1) for camera in self._cameras]
        # What is behind a camera is nowhere near.
        together = np.nan_to_num(np.hstack(places), nan=1e9)
        chosen: list[int] = []
        left = np.arange(len(together))
        while len(left) and len(chosen) < count:
            chosen.append(left[0])
            gaps = np.abs(together[left] - together[left[0]]).max(axis=1, initial=0.0)
            left = left[gaps > apart * self._size]
        return poses.only(np.array(chosen, dtype=np.int64))

    def _parent_in(self, view: CoarseView, node: int, X_WN: np.ndarray) -> np.ndarray:
        """X_CP (n, 4, 4) of a node's parent at poses X_WN (n, nodes, 4, 4)."""
        parent = self._nodes[node].parent
        X_WP = np.tile(np.eye(4), (len(X_WN), 1, 1)) if parent < 0 else X_WN[:, parent]
        return np.ascontiguousarray(view.X_CW @ X_WP)

    def _cover(self, node: int, X_WN: np.ndarray, masks: list[np.ndarray]) -> list[np.ndarray]:
        """What one hypothesis covers together with a node that has its place."""
        still = self._balls[node]._replace(p_PB=_by_ball(self._p_NB[node][None]))
        covered = []
        for view, mask in zip(self._views, masks, strict=True):
            X_CN = (view.X_CW @ X_WN[node])[None]
            united = score_samples(view, X_CN, still, mask, _OUTSIDE_WEIGHT, np.zeros((1, 1)))
            covered.append(united[:, 0])
        return covered

    def _grow(
        self,
        node: int,
        poses: CoarsePoses,
        masks: list[np.ndarray],
        placed: set[int],
        hypotheses: int,
    ) -> tuple[CoarsePoses, list[np.ndarray]]:
        """Place one more node in every hypothesis and keep the best."""
        balls = self._balls[node]
        X_PN = self.body.sampled.X_PN[node]
        X_CPs = [self._parent_in(view, node, poses.X_WN) for view in self._views]
        added = np.zeros((len(poses), len(X_PN)))

        def score(part: slice) -> list[np.ndarray]:
            return [
                score_samples(view, X_CP[part], balls, mask[part], _OUTSIDE_WEIGHT, added[part])
                for view, X_CP, mask in zip(self._views, X_CPs, masks, strict=True)
            ]

        step = max(1, _AT_ONCE // len(X_PN))
        parts = [slice(k, k + step) for k in range(0, len(poses), step)]
        united = [np.concatenate(one) for one in zip(*map_ordered(score, parts), strict=True)]
        costs = (poses.costs[:, None] + added).ravel()
        parent = self._nodes[node].parent
        if self.body.sampled.tree.source(node) == parent:
            # No other sample than its parent's.
            costs[(np.arange(len(X_PN)) != poses.samples[:, parent, None]).ravel()] = np.inf
        following = [i for i in self.body.limb_order if i not in placed]
        widest = len(self.body.sampled.X_PN[following[0]]) if following else 1
        width = min(hypotheses, max(_LEAST_HYPOTHESES, _EVALUATIONS // widest))
        possible = int(np.count_nonzero(costs < np.inf))
        for spare in _SPARES:
            pool = min(possible, spare * width)
            best = np.argpartition(costs, pool - 1)[:pool]
            best = best[np.lexsort((best, costs[best]))]
            of, sample = best // len(X_PN), best % len(X_PN)
            X_WP = np.eye(4) if parent < 0 else poses.X_WN[of, parent]
            X_WN = X_WP @ X_PN[sample]
            kept = self._unlike(poses.X_WN, of, node, X_WN, placed)[:width]
            if pool == possible or len(kept) == width:
                break
        of, sample = of[kept], sample[kept]
        samples, together = poses.samples[of], poses.X_WN[of]
        samples[:, node], together[:, node] = sample, X_WN[kept]
        return CoarsePoses(samples, together, costs[best[kept]]), [
            one[of, sample] for one in united
        ]

    def _unlike(
        self, X_WN: np.ndarray, of: np.ndarray, node: int, own: np.ndarray, placed: set[int]
    ) -> np.ndarray:
        """Indices of the poses whose open nodes stand unlike those of any better pose.

        Each is that of ``X_WN`` that ``of`` says, but for a node's own pose (n, 4, 4).
        """
        is_open = [i for i in sorted(placed) if not placed.issuperset(self._nodes[i].children)]
        if not is_open:
            return np.arange(len(of))
        lever, points = 0.15 * self._reach, []
        for i in is_open:
            X = own if i == node else X_WN[of, i]
            p = X[:, :3, 3]
            points += [p, p + lever * X[:, :3, 0], p + lever * X[:, :3, 2]]
        cells = np.rint(np.hstack(points) / (_ALIKE * self._reach)).astype(np.int64)
        # Any odd numbers will do; always the same, so that answers are.
        keys = np.random.default_rng(2718).integers(1, 2**62, cells.shape[1]) | 1
        return np.sort(np.unique((cells * keys).sum(axis=1), return_index=True)[1])


def _distances_at(
    mask: np.ndarray, origin: np.ndarray, side: float, rows: int, columns: int
) -> np.ndarray:
    """(rows, columns) signed distances in the middles of squares, from an origin (2,) on."""
    places = [
        np.clip(np.rint(first + side * (np.arange(count) + 0.5)), 0, size - 1).astype(int)
        for first, count, size in zip(origin, (rows, columns), mask.shape, strict=True)
    ]
    # What is nearest to a place lies between the places, the silhouette and what is just beside it.
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    boxes = zip(places, (top, left), (top + height, left + width), strict=True)
    window = [(max(0, min(own[0], low - 1)), max(own[-1], high) + 1) for own, low, high in boxes]
    distances = signed_distances(mask[tuple(slice(*ends) for ends in window)])
    shifted = [own - first for own, (first, _) in zip(places, window, strict=True)]
    return np.ascontiguousarray(distances[np.ix_(*shifted)])


def _by_ball(p_PB: np.ndarray) -> np.ndarray:
    """(k, 3, n) float32 of centres (n, k, 3)."""
    return np.ascontiguousarray(p_PB.transpose(1, 2, 0), dtype=np.float32)


def _mean_size(views: Sequence[View]) -> float:
    """The root of the silhouettes' mean area [pixel]."""
    return math.sqrt(float(np.mean([np.count_nonzero(view.mask) for view in views])))


def _prepare_views(body: SampledBody, views: Sequence[View]) -> list[CoarseView]:
    """The silhouettes as the coarse search sees them."""
    size = _mean_size(views)
    slack, least_cell = _SLACK * size, max(1.0, size / _CELLS)
    largest = max(max((float(r.max(initial=0.0)) for r in body.ball_radii), default=0.0), 1e-6)

    def prepare(view: View) -> CoarseView:
        points = _spread_points(view.mask)
        # No ball counts whose middle is outside the picture, and one as large as it covers all.
        scale = float(view.camera.kernel_parameters()[1])
        if not isinstance(view.camera, ParallelCamera):
            nearest = float(body.root_distances(view.camera).min())
            scale /= max(1e-6, _NEARER * nearest)
        reach = min(largest * scale, math.hypot(*view.mask.shape)) + slack
        radii = np.linspace(0.15, 1.0, _LEVELS) * reach
        origin = np.maximum(points.min(axis=0) - reach, -1.0)
        end = np.minimum(points.max(axis=0) + reach, np.add(view.mask.shape, 1.0))
        cell = max(least_cell, float((end - origin).max()) / _MOST_CELLS)
        rows, columns = np.ceil((end - origin) / cell).astype(int)
        parts = max(1, min(_PARTS, round(cell)))
        cover = np.zeros((_LEVELS, rows, columns, _WORDS), dtype=np.uint64)
        fill_cover(cover, points, origin, cell, radii)
        side = cell / parts
        return CoarseView(
            camera=view.camera.kernel_parameters(),
            X_CW=np.ascontiguousarray(view.camera.X_CW),
            origin=origin,
            cell=cell,
            radii=radii,
            cover=cover,
            parts=parts,
            distances=_distances_at(view.mask, origin, side, parts * rows, parts * columns),
            point_area=np.count_nonzero(view.mask) / len(points),
            slack=slack,
        )

    return map_ordered(prepare, views)


def _spread_points(mask: np.ndarray) -> np.ndarray:
    """At most 64 * words points (n, 2) row, column of a mask, evenly spread; at least one."""
    most = 64 * _WORDS
    step = max(1.0, math.sqrt(np.count_nonzero(mask) / most))
    while True:
        rows = np.arange(0.5 * (step - 1.0), mask.shape[0] - 0.5, step)
        columns = np.arange(0.5 * (step - 1.0), mask.shape[1] - 0.5, step)
        grid = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
        index = np.rint(grid).astype(int)
        points = grid[mask[index[:, 0], index[:, 1]]]
        if 0 < len(points) <= most:
            return points
        if len(points) == 0:
            places = np.argwhere(mask)
            return places[:: -(-len(places) // most)].astype(np.float64)
        step *= 1.02
