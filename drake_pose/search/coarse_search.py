"""Find approximate poses on a coarse grid as starts of a continuous refinement.

On a coarse grid the pose nearest to the true one may cover less of the silhouette than a wrong one:
a thin limb half a step off lies outside it. This search therefore compares distances instead of
areas, and distances below about half a step cost nothing. Nodes are placed one after another, and
thousands of hypotheses are kept. Of hypotheses in which all nodes with children still to be placed
have nearly the same pose, only the best is kept, since the further search is the same.

A node is represented by a few inscribed balls; nothing is drawn. Each ball stands for an equal part
A of the node's mean projected area. With the signed distance d of its centre from the silhouette's
edge (positive outside), its projected radius r and the slack s, it costs

    A clip((d + r - s) / (2 r), 0, 1),

and it covers those of up to 256 points spread over the silhouette that are within about r + s of
its centre.
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
    """One silhouette with the lookup tables of the coarse search."""

    camera: np.ndarray  # (8,) ``Camera.kernel_parameters()``.
    X_CW: np.ndarray  # (4, 4) pose of the world in the camera.
    origin: np.ndarray  # (2,) row and column of the corner of the first cell of the cover [pixel].
    cell: float  # Side of the cover's cells [pixel].
    radii: np.ndarray  # (levels,) radii for which the cover is tabulated, equally spaced [pixel].
    # (levels, rows, columns, 4) uint64 for each radius and cell the set of points of the silhouette
    # within that radius of the cell's centre, one bit for each point.
    cover: np.ndarray
    parts: int  # Number of distances along a cell's side.
    # (parts * rows, parts * columns) float32 signed distance of each part's centre from the
    # silhouette's edge, positive outside [pixel].
    distances: np.ndarray
    point_area: float  # Silhouette area for which a point stands [pixel].
    slack: float  # Distance that costs nothing [pixel].


class Balls(NamedTuple):
    """The k inscribed balls of a node."""

    # (k, 3, n) float32 their centres in the parent's frame at each of n samples [m].
    p_PB: np.ndarray
    radii: np.ndarray  # (k,) float32 their radii [m].
    area: float  # The part of the node's mean projected area for which each stands [m^2].


@compiled
def fill_cover(
    cover: np.ndarray, points: np.ndarray, origin: np.ndarray, cell: float, radii: np.ndarray
) -> None:
    """Write the table ``CoarseView.cover`` of points.

    Args:
        cover: (levels, rows, columns, words) uint64 zeros, written in place.
        points: (n, 2) row and column of the points [pixel].
        origin: (2,) row and column of the corner of the first cell [pixel].
        cell: side of the cells [pixel].
        radii: (levels,) radii within which points are covered [pixel].
    """
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
    """Project a ball at all samples, in single precision and without branches, for SIMD.

    ``X_CP``: (4, 4) of the node's parent. ``p_PB``: (3, n) the ball's centre at all samples [m].
    Written: ``columns``, ``rows`` (n,), the centre's projection [cell], and ``scales`` (n,), the
    scale there [pixel/m]; 0 if it is outside the image or behind the camera.
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
        visible = (depth >= least) & (column > low_x) & (column < high_x)
        visible = visible & (row > low_y) & (row < high_y)
        columns[k] = column
        rows[k] = row
        scales[k] = pixels * nearness if visible else np.float32(0.0)


@compiled
def _score_node(
    view: CoarseView,
    X_CP: np.ndarray,
    balls: Balls,
    scratch: tuple[np.ndarray, np.ndarray, np.ndarray],
    costs: np.ndarray,
    covered: np.ndarray,
) -> None:
    """Write the cost of a node at all samples, and the points that it covers.

    Args:
        view: the silhouette.
        X_CP: (4, 4) pose of the node's parent in the camera.
        balls: the node's balls.
        scratch: three arrays (n,) float32 that are overwritten.
        costs: (n,) written: area outside the silhouette [pixel].
        covered: (n, 4) uint64 written: the covered points, one bit for each point.
    """
    ball_columns, ball_rows, scales = scratch
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
        _project_ball(view, X_CP, balls.p_PB[ball], ball_columns, ball_rows, scales)
        for k in range(costs.shape[0]):
            scale = scales[k]
            if scale == zero:
                continue
            column, row = ball_columns[k], ball_rows[k]
            radius = scale * balls.radii[ball]
            fraction = one
            if zero <= column < columns and zero <= row < rows:
                beyond = view.distances[int(row * parts), int(column * parts)] + radius - slack
                fraction = max(zero, min(one, half * beyond / max(radius, tiny)))
                level = int(
                    max(zero, min(np.float32(levels - 1), (radius + slack - least) * steps))
                )
                i, j = int(row), int(column)
                covered[k, 0] |= view.cover[level, i, j, 0]
                covered[k, 1] |= view.cover[level, i, j, 1]
                covered[k, 2] |= view.cover[level, i, j, 2]
                covered[k, 3] |= view.cover[level, i, j, 3]
            costs[k] += scale * scale * area * fraction


@compiled
def score_samples(
    view: CoarseView,
    X_CP: np.ndarray,
    balls: Balls,
    masks: np.ndarray,
    outside_weight: float,
    scores: np.ndarray,
) -> np.ndarray:
    """Add to scores the cost of a node at all its n samples, for B hypotheses in one view.

    Args:
        view: the silhouette.
        X_CP: (B, 4, 4) poses of the node's parent in the camera.
        balls: the node's balls.
        masks: (B, 4) uint64 the points that the hypotheses cover.
        outside_weight: cost of a pixel outside, relative to the gain of a newly covered one.
        scores: (B, n) the costs, to which those of the node are added [pixel].

    Returns (B, n, 4) uint64 the points that the hypotheses cover with the node.
    """
    count = scores.shape[1]
    scratch = (
        np.empty(count, dtype=np.float32),
        np.empty(count, dtype=np.float32),
        np.empty(count, dtype=np.float32),
    )
    costs, covered = np.empty(count, dtype=np.float32), np.empty((count, 4), dtype=np.uint64)
    united = np.empty((X_CP.shape[0], count, 4), dtype=np.uint64)
    for h in range(X_CP.shape[0]):
        _score_node(view, X_CP[h], balls, scratch, costs, covered)
        for k in range(count):
            gain = 0
            for word in range(4):
                gain += int(count_bits(covered[k, word] & ~masks[h, word]))
                united[h, k, word] = masks[h, word] | covered[k, word]
            scores[h, k] += outside_weight * costs[k] - gain * view.point_area
    return united


@dataclass(frozen=True)
class CoarseSettings:
    """Parameters of the coarse search; lengths are fractions of the mean area's square root."""

    hypotheses: int = 2500  # Hypotheses kept after each node,
    hypotheses_again: int = 300  # and when a limb of a pose is searched again.
    evaluations: int = 150_000  # Fewer are kept if the next node would need more evaluations,
    least_hypotheses: int = 64  # but at least this number.
    # Hypotheses compared for equality, as multiples of those kept; the second if the first leaves
    # too few.
    spares: tuple[int, ...] = (2, 8)
    batch: int = 5000  # Number of samples scored at a time by a worker.
    outside_weight: float = 0.8  # Cost of a pixel outside, relative to the gain of a covered one.
    slack: float = 0.05  # Distance from the silhouette that costs nothing.
    same: float = 0.04  # Poses of nodes are equal below this distance [fraction of body's reach].
    cells: float = 40.0  # Number of cells of a cover along the silhouettes' size.
    most_cells: int = 500  # Greatest number of rows or columns of a cover, which has 80 MB then.
    parts: int = 4  # Number of distances along a cell's side.
    nearest: float = 0.7  # Least distance of nodes from a camera, as a fraction of the root's.


@dataclass(frozen=True)
class CoarsePoses:
    """Poses of the grid, best first."""

    samples: np.ndarray  # (n, nodes) samples of all nodes; -1 for nodes that were not searched.
    X_WN: np.ndarray  # (n, nodes, 4, 4) poses of the nodes.
    costs: np.ndarray  # (n,) costs [pixel], comparable within one search.

    def __len__(self) -> int:
        return len(self.samples)


class CoarseSearch:
    """Searches approximate poses of a sampled body in the views of one frame.

    Attributes:
        views: the silhouettes with their lookup tables.
        balls: each node's balls.

    Args:
        body: the sampled body.
        views: the silhouettes, one per camera.
        hypotheses: number of hypotheses kept after each node; None: that of the settings.
    """

    def __init__(
        self, body: SampledBody, views: Sequence[View], hypotheses: int | None = None
    ) -> None:
        self.body, self._settings = body, CoarseSettings()
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
        """Return a silhouette with its lookup tables; ``levels``: number of tabulated radii."""
        settings, body = self._settings, self.body
        points = spread_points(view.mask)
        slack, least_cell = settings.slack * self._size, max(1.0, self._size / settings.cells)
        largest = max(max((float(r.max(initial=0.0)) for r in body.ball_radii), default=0.0), 1e-6)
        # Balls with their centre outside the image do not count, and a ball as large as the image
        # covers all points, so larger radii are not needed.
        scale = float(view.camera.kernel_parameters()[1])
        if not isinstance(view.camera, ParallelCamera):
            nearest = float(body.root_distances(view.camera).min())
            scale /= max(1e-6, settings.nearest * nearest)
        reach = min(largest * scale, math.hypot(*view.mask.shape)) + slack
        radii = np.linspace(0.15, 1.0, levels) * reach
        origin = np.maximum(points.min(axis=0) - reach, -1.0)
        end = np.minimum(points.max(axis=0) + reach, np.add(view.mask.shape, 1.0))
        cell = max(least_cell, float((end - origin).max()) / settings.most_cells)
        rows, columns = np.ceil((end - origin) / cell).astype(int)
        parts = max(1, min(settings.parts, round(cell)))
        cover = np.zeros((levels, rows, columns, 4), dtype=np.uint64)
        fill_cover(cover, points, origin, cell, radii)
        # Signed distances at the centres of the cells' parts.
        counts = zip(origin, (parts * rows, parts * columns), view.mask.shape, strict=True)
        places = [
            np.clip(np.rint(first + cell / parts * (np.arange(n) + 0.5)), 0, size - 1).astype(int)
            for first, n, size in counts
        ]
        # Distances are computed only in a window that contains the places and the silhouette with a
        # margin of a pixel: the nearest edge of any place lies in it.
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
        """Return the best poses of all nodes."""
        nodes = range(len(self._nodes))
        start = np.tile(np.eye(4), (len(self._nodes), 1, 1))
        return self._find(start, set(nodes), self._hypotheses)

    def find_again(self, X_WN: np.ndarray, again: Sequence[int]) -> CoarsePoses:
        """Return the best poses when some nodes are searched again, with the others fixed.

        Args:
            X_WN: (nodes, 4, 4) poses; those of the nodes searched again are ignored.
            again: the nodes that are searched again, with all their descendants.
        """
        return self._find(X_WN, set(again), self._settings.hypotheses_again)

    def _find(self, start: np.ndarray, wanted: set[int], hypotheses: int) -> CoarsePoses:
        """Return the best poses of the wanted nodes, with the others fixed.

        Args:
            start: (nodes, 4, 4) X_WN, of which the fixed nodes' are used.
            wanted: indices of the nodes that are placed, with all their descendants.
            hypotheses: greatest number of hypotheses kept after each node.
        """
        nodes, weight = self._nodes, self._settings.outside_weight
        poses = CoarsePoses(np.full((1, len(nodes)), -1), start[None].copy(), np.zeros(1))
        masks = [np.zeros((1, 4), dtype=np.uint64) for _ in self.views]
        placed = set(range(len(nodes))) - wanted
        for node in placed:
            # Add the points that a node with a fixed pose covers.
            fixed = self.balls[node]._replace(p_PB=_by_ball(self._p_NB[node][None]))
            for k, view in enumerate(self.views):
                X_CN = (view.X_CW @ start[node])[None]
                united = score_samples(view, X_CN, fixed, masks[k], weight, np.zeros((1, 1)))
                masks[k] = united[:, 0]
        for node in self.body.limb_order:
            if node in wanted:
                placed.add(node)
                poses, masks = self._grow(node, poses, masks, placed, hypotheses)
        return poses

    def choose_distinct(self, poses: CoarsePoses, count: int, apart: float) -> CoarsePoses:
        """Return the best poses that differ visibly from all better ones.

        Args:
            poses: the poses, best first.
            count: greatest number of poses that are returned.
            apart: poses differ if, in some view, a node's first ball or the mean of its balls is
                projected farther than this in u or v from its place in the other pose [square root
                of the silhouettes' mean area].
        """
        marks = [
            np.vstack([p_NB.mean(axis=0), p_NB[0]]) @ np.swapaxes(X[:, :3, :3], 1, 2)
            + X[:, None, :3, 3]
            for p_NB, X in zip(self._p_NB, poses.X_WN.swapaxes(0, 1), strict=True)
            if len(p_NB)
        ]
        p_WB = np.concatenate(marks, axis=1).reshape(-1, 3)
        places = [camera.project(p_WB)[0].reshape(len(poses), -1) for camera in self._cameras]
        # Points behind a camera have no projection: they get a far one.
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
        """Place one more node in every hypothesis and keep the best.

        Args:
            node: index of the node.
            poses: the B hypotheses before.
            masks: for each view (B, 4) uint64 the points that the hypotheses cover.
            placed: the nodes that are placed, this one included.
            hypotheses: greatest number that is kept.

        Returns the new hypotheses, best first, and the points that they cover, like ``masks``.
        """
        settings, balls, X_PN = self._settings, self.balls[node], self.body.sampled.X_PN[node]
        parent = self._nodes[node].parent
        X_WP = np.tile(np.eye(4), (len(poses), 1, 1)) if parent < 0 else poses.X_WN[:, parent]
        X_CPs = [np.ascontiguousarray(view.X_CW @ X_WP) for view in self.views]
        added = np.zeros((len(poses), len(X_PN)))

        def score(part: slice) -> list[np.ndarray]:
            weight = settings.outside_weight
            return [
                score_samples(view, X_CP[part], balls, mask[part], weight, added[part])
                for view, X_CP, mask in zip(self.views, X_CPs, masks, strict=True)
            ]

        step = max(1, settings.batch // len(X_PN))
        parts = [slice(k, k + step) for k in range(0, len(poses), step)]
        united = [np.concatenate(one) for one in zip(*map_ordered(score, parts), strict=True)]
        costs = (poses.costs[:, None] + added).ravel()
        if self.body.sampled.tree.source(node) == parent:
            # A node whose joints mimic its parent's takes the parent's sample.
            costs[(np.arange(len(X_PN)) != poses.samples[:, parent, None]).ravel()] = np.inf
        following = [i for i in self.body.limb_order if i not in placed]
        widest = len(self.body.sampled.X_PN[following[0]]) if following else 1
        width = min(hypotheses, max(settings.least_hypotheses, settings.evaluations // widest))
        possible = int(np.count_nonzero(costs < np.inf))
        for spare in settings.spares:
            pool = min(possible, spare * width)
            best = np.argpartition(costs, pool - 1)[:pool]
            best = best[np.lexsort((best, costs[best]))]
            of, sample = best // len(X_PN), best % len(X_PN)
            X_WN = X_WP[of] @ X_PN[sample]
            kept = self._distinct(poses.X_WN, of, node, X_WN, placed)[:width]
            if pool == possible or len(kept) == width:
                break
        of, sample = of[kept], sample[kept]
        samples, together = poses.samples[of], poses.X_WN[of]
        samples[:, node], together[:, node] = sample, X_WN[kept]
        return CoarsePoses(samples, together, costs[best[kept]]), [
            one[of, sample] for one in united
        ]

    def _distinct(
        self, X_WN: np.ndarray, of: np.ndarray, node: int, own: np.ndarray, placed: set[int]
    ) -> np.ndarray:
        """Return indices of the hypotheses whose open nodes differ in pose from all better ones.

        Open nodes have children that are still to be placed. Two of a node's poses are equal if its
        origin and a point on its x and z axis round to equal cells of ``settings.same`` times the
        body's reach.

        Args:
            X_WN: (B, nodes, 4, 4) poses before the node was placed.
            of: (n,) index into these of each new hypothesis, best first.
            node: index of the node that was placed.
            own: (n, 4, 4) its poses in the new hypotheses.
            placed: the nodes that are placed, this one included.
        """
        open_nodes = [i for i in sorted(placed) if not placed.issuperset(self._nodes[i].children)]
        if not open_nodes:
            return np.arange(len(of))
        lever, points = 0.15 * self._reach, []
        for i in open_nodes:
            X = own if i == node else X_WN[of, i]
            p = X[:, :3, 3]
            points += [p, p + lever * X[:, :3, 0], p + lever * X[:, :3, 2]]
        side = self._settings.same * self._reach
        cells = np.rint(np.hstack(points) / side).astype(np.int64)
        # The keys of the hash are odd, and the seed is fixed so that results are repeatable.
        keys = np.random.default_rng(2718).integers(1, 2**62, cells.shape[1]) | 1
        return np.sort(np.unique((cells * keys).sum(axis=1), return_index=True)[1])


def _by_ball(p_PB: np.ndarray) -> np.ndarray:
    """Return centres (n, k, 3) of balls as (k, 3, n) float32."""
    return np.ascontiguousarray(p_PB.transpose(1, 2, 0), dtype=np.float32)


def spread_points(mask: np.ndarray, most: int = 256) -> np.ndarray:
    """Return from 1 to ``most`` points (n, 2) row, column, evenly spread over a mask (H, W)."""
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
