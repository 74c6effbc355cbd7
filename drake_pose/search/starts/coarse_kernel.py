"""The inner loops of the coarse search: what balls inside a node cover of silhouettes, and leave.

A node is a handful of balls that its picture surely covers. A ball outside the silhouette costs its
share of the node's area, one that leaves it in part costs part of that; what it covers is looked up
among points spread over the silhouette. Nothing is drawn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.search.grid.pair_kernel import count_bits


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
