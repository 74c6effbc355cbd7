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
def _project_ball(
    view: CoarseView,
    X_CP: np.ndarray,
    p_PB: np.ndarray,
    columns: np.ndarray,
    rows: np.ndarray,
    scales: np.ndarray,
) -> None:
    """Writes where a ball is seen at all samples: (n,) columns and rows [cell], scales [pixel/m].

    The scale is 0 where it is not seen. Single precision, and no branches: the processor does many
    samples at once.
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
    for k in range(rows.shape[0]):
        p, q, r = p_PB[0, k], p_PB[1, k], p_PB[2, k]
        depth = one if parallel else zx * p + zy * q + zz * r + z0
        nearness = one / max(depth, least)
        column = focal_x * (xx * p + xy * q + xz * r + x0) * nearness + center_x
        row = focal_y * (yx * p + yy * q + yz * r + y0) * nearness + center_y
        seen = (depth >= least) & (column > low_x) & (column < high_x)
        seen = seen & (row > low_y) & (row < high_y)
        columns[k] = column
        rows[k] = row
        scales[k] = pixels * nearness if seen else np.float32(0.0)


@compiled
def _look_at_samples(
    view: CoarseView,
    X_CP: np.ndarray,
    balls: Balls,
    seen: tuple[np.ndarray, np.ndarray, np.ndarray],
    costs: np.ndarray,
    covered: np.ndarray,
) -> None:
    """Writes what a node at all samples costs (n,) [pixel] and covers (n, 4); scratch: ``seen``."""
    seen_columns, seen_rows, scales = seen
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    tiny = np.float32(1e-9)
    slack, parts = np.float32(view.slack), np.float32(view.parts)
    levels, rows, columns = view.cover.shape[:3]
    least = np.float32(view.radii[0])
    steps = np.float32((levels - 1) / (view.radii[levels - 1] - view.radii[0]))
    area = np.float32(balls.area * view.camera[2] / view.camera[1])
    costs[:] = zero
    covered[:] = np.uint64(0)
    for ball in range(balls.radii.shape[0]):
        _project_ball(view, X_CP, balls.p_PB[ball], seen_columns, seen_rows, scales)
        for k in range(costs.shape[0]):
            scale = scales[k]
            if scale == zero:
                continue
            column, row = seen_columns[k], seen_rows[k]
            radius = scale * balls.radii[ball]
            share = one
            if zero <= column < columns and zero <= row < rows:
                beyond = view.distances[int(row * parts), int(column * parts)] + radius - slack
                share = max(zero, min(one, half * beyond / max(radius, tiny)))
                level = int(
                    max(zero, min(np.float32(levels - 1), (radius + slack - least) * steps))
                )
                i, j = int(row), int(column)
                covered[k, 0] |= view.cover[level, i, j, 0]
                covered[k, 1] |= view.cover[level, i, j, 1]
                covered[k, 2] |= view.cover[level, i, j, 2]
                covered[k, 3] |= view.cover[level, i, j, 3]
            costs[k] += scale * scale * area * share


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
    seen = (
        np.empty(count, dtype=np.float32),
        np.empty(count, dtype=np.float32),
        np.empty(count, dtype=np.float32),
    )
    costs, covered = np.empty(count, dtype=np.float32), np.empty((count, 4), dtype=np.uint64)
    united = np.empty((X_CP.shape[0], count, 4), dtype=np.uint64)
    for h in range(X_CP.shape[0]):
        _look_at_samples(view, X_CP[h], balls, seen, costs, covered)
        for k in range(count):
            gain = 0
            for word in range(4):
                gain += int(count_bits(covered[k, word] & ~masks[h, word]))
                united[h, k, word] = masks[h, word] | covered[k, word]
            scores[h, k] += outside_weight * costs[k] - gain * view.point_area
    return united


@dataclass(frozen=True)
class CoarseSettings:
    """Numbers of the coarse search; sizes are fractions of the root of the mean area."""

    hypotheses: int = 2500  # Kept after each node,
    again: int = 300  # and where a limb of a pose is searched again.
    evaluations: int = 150_000  # Fewer are kept where the next node would take more,
    least_hypotheses: int = 64  # but not fewer than this.
    spares: tuple[int, ...] = (2, 8)  # Hypotheses compared for likeness, times those kept.
    together: int = 5000  # Samples that a worker scores at once.
    outside_weight: float = 0.8  # Cost of a pixel outside; one newly covered gains one.
    slack: float = 0.05  # Distances up to this do not count.
    alike: float = 0.04  # Frames stand alike if nearer [fraction of the body's reach].
    cells: float = 40.0  # Of a cover, along the size.
    most_cells: int = 500  # Rows and columns of a cover: 80 MB.
    parts: int = 4  # Of a cell's side, whose distances are known.
    nearer: float = 0.7  # Nodes come nearer to a camera than the root by this factor.


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


class CoarseSearch:
    """Finds coarse poses of a sampled body in views of one instant."""

    def __init__(
        self,
        body: SampledBody,
        views: Sequence[View],
        hypotheses: int | None = None,
        settings: CoarseSettings | None = None,
    ) -> None:
        self.body, self._settings = body, settings or CoarseSettings()
        self._hypotheses = hypotheses or self._settings.hypotheses
        self._size = math.sqrt(float(np.mean([np.count_nonzero(view.mask) for view in views])))
        self.views = map_ordered(self._prepare, views)
        self._cameras = [view.camera for view in views]
        self._nodes = body.sampled.tree.nodes
        self._reach = max(
            float(body.reach_balls[i, 3]) for i, node in enumerate(self._nodes) if node.parent < 0
        )
        self._p_NB = [
            (p_PB[0] - X_PN[0, :3, 3]) @ X_PN[0, :3, :3]
            for p_PB, X_PN in zip(body.p_PB, body.sampled.X_PN, strict=True)
        ]
        self.balls = [
            Balls(
                _by_ball(body.p_PB[i]),
                radii.astype(np.float32),
                body.surface_areas[i] / max(1, len(radii)),
            )
            for i, radii in enumerate(body.ball_radii)
        ]

    def _prepare(self, view: View, levels: int = 10) -> CoarseView:
        """A silhouette as the coarse search sees it, with points within ``levels`` radii."""
        own, body = self._settings, self.body
        points = spread_points(view.mask)
        slack, least_cell = own.slack * self._size, max(1.0, self._size / own.cells)
        largest = max(max((float(r.max(initial=0.0)) for r in body.ball_radii), default=0.0), 1e-6)
        # No ball counts whose middle is outside the picture, and one as large as it covers all.
        scale = float(view.camera.kernel_parameters()[1])
        if not isinstance(view.camera, ParallelCamera):
            nearest = float(body.root_distances(view.camera).min())
            scale /= max(1e-6, own.nearer * nearest)
        reach = min(largest * scale, math.hypot(*view.mask.shape)) + slack
        radii = np.linspace(0.15, 1.0, levels) * reach
        origin = np.maximum(points.min(axis=0) - reach, -1.0)
        end = np.minimum(points.max(axis=0) + reach, np.add(view.mask.shape, 1.0))
        cell = max(least_cell, float((end - origin).max()) / own.most_cells)
        rows, columns = np.ceil((end - origin) / cell).astype(int)
        parts = max(1, min(own.parts, round(cell)))
        cover = np.zeros((levels, rows, columns, 4), dtype=np.uint64)
        fill_cover(cover, points, origin, cell, radii)
        # Signed distances in the middles of the cells' parts.
        counts = zip(origin, (parts * rows, parts * columns), view.mask.shape, strict=True)
        places = [
            np.clip(np.rint(first + cell / parts * (np.arange(n) + 0.5)), 0, size - 1).astype(int)
            for first, n, size in counts
        ]
        # What is nearest to a place lies between the places, the silhouette and what is just beside
        # it.
        left, top, width, height = cv2.boundingRect(view.mask.view(np.uint8))
        boxes = zip(places, (top, left), (top + height, left + width), strict=True)
        window = [
            (max(0, min(one[0], low - 1)), max(one[-1], high) + 1) for one, low, high in boxes
        ]
        distances = signed_distances(view.mask[tuple(slice(*ends) for ends in window)])
        shifted = [one - first for one, (first, _) in zip(places, window, strict=True)]
        return CoarseView(
            camera=view.camera.kernel_parameters(),
            X_CW=np.ascontiguousarray(view.camera.X_CW),
            origin=origin,
            cell=cell,
            radii=radii,
            cover=cover,
            parts=parts,
            distances=np.ascontiguousarray(distances[np.ix_(*shifted)]),
            point_area=np.count_nonzero(view.mask) / len(points),
            slack=slack,
        )

    def find(self) -> CoarsePoses:
        """Search all nodes."""
        nodes = range(len(self._nodes))
        start = np.tile(np.eye(4), (len(self._nodes), 1, 1))
        return self._find(start, set(nodes), self._hypotheses)

    def find_again(self, X_WN: np.ndarray, again: Sequence[int]) -> CoarsePoses:
        """Search some nodes of a pose X_WN (nodes, 4, 4) again, with all their descendants."""
        return self._find(X_WN, set(again), self._settings.again)

    def _find(self, start: np.ndarray, wanted: set[int], hypotheses: int) -> CoarsePoses:
        nodes, weight = self._nodes, self._settings.outside_weight
        poses = CoarsePoses(np.full((1, len(nodes)), -1), start[None].copy(), np.zeros(1))
        masks = [np.zeros((1, 4), dtype=np.uint64) for _ in self.views]
        placed = set(range(len(nodes))) - wanted
        for node in placed:
            # What one hypothesis covers together with a node that has its place.
            still = self.balls[node]._replace(p_PB=_by_ball(self._p_NB[node][None]))
            for k, view in enumerate(self.views):
                X_CN = (view.X_CW @ start[node])[None]
                united = score_samples(view, X_CN, still, masks[k], weight, np.zeros((1, 1)))
                masks[k] = united[:, 0]
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
        kept = np.array(chosen, dtype=np.int64)
        return CoarsePoses(poses.samples[kept], poses.X_WN[kept], poses.costs[kept])

    def _grow(
        self,
        node: int,
        poses: CoarsePoses,
        masks: list[np.ndarray],
        placed: set[int],
        hypotheses: int,
    ) -> tuple[CoarsePoses, list[np.ndarray]]:
        """Place one more node in every hypothesis and keep the best."""
        own, balls, X_PN = self._settings, self.balls[node], self.body.sampled.X_PN[node]
        parent = self._nodes[node].parent
        X_WP = np.tile(np.eye(4), (len(poses), 1, 1)) if parent < 0 else poses.X_WN[:, parent]
        X_CPs = [np.ascontiguousarray(view.X_CW @ X_WP) for view in self.views]
        added = np.zeros((len(poses), len(X_PN)))

        def score(part: slice) -> list[np.ndarray]:
            weight = own.outside_weight
            return [
                score_samples(view, X_CP[part], balls, mask[part], weight, added[part])
                for view, X_CP, mask in zip(self.views, X_CPs, masks, strict=True)
            ]

        step = max(1, own.together // len(X_PN))
        parts = [slice(k, k + step) for k in range(0, len(poses), step)]
        united = [np.concatenate(one) for one in zip(*map_ordered(score, parts), strict=True)]
        costs = (poses.costs[:, None] + added).ravel()
        if self.body.sampled.tree.source(node) == parent:
            # No other sample than its parent's.
            costs[(np.arange(len(X_PN)) != poses.samples[:, parent, None]).ravel()] = np.inf
        following = [i for i in self.body.limb_order if i not in placed]
        widest = len(self.body.sampled.X_PN[following[0]]) if following else 1
        width = min(hypotheses, max(own.least_hypotheses, own.evaluations // widest))
        possible = int(np.count_nonzero(costs < np.inf))
        for spare in own.spares:
            pool = min(possible, spare * width)
            best = np.argpartition(costs, pool - 1)[:pool]
            best = best[np.lexsort((best, costs[best]))]
            of, sample = best // len(X_PN), best % len(X_PN)
            X_WN = X_WP[of] @ X_PN[sample]
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
        side = self._settings.alike * self._reach
        cells = np.rint(np.hstack(points) / side).astype(np.int64)
        # Any odd numbers will do; always the same, so that answers are.
        keys = np.random.default_rng(2718).integers(1, 2**62, cells.shape[1]) | 1
        return np.sort(np.unique((cells * keys).sum(axis=1), return_index=True)[1])


def _by_ball(p_PB: np.ndarray) -> np.ndarray:
    """(k, 3, n) float32 of centres (n, k, 3)."""
    return np.ascontiguousarray(p_PB.transpose(1, 2, 0), dtype=np.float32)


def spread_points(mask: np.ndarray, most: int = 256) -> np.ndarray:
    """At most ``most`` points (n, 2) row, column of a mask, evenly spread; at least one."""
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
