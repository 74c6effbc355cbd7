"""The inner loops of the rough search: what balls inside a node cover of silhouettes, and leave.

A node is a handful of balls that its picture surely covers. A ball outside the silhouette costs its
share of the node's area, one that leaves it in part costs part of that; what it covers is looked up
among points spread over the silhouette. Nothing is drawn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled, copy_into
from drake_pose.matching.grid.pair_kernel import count_bits


class RoughView(NamedTuple):
    """One silhouette as the rough search sees it.

    camera: (8,) kernel parameters; X_CW: (4, 4); distances: (H, W) float32 signed distance from the
    silhouette's edge, positive outside [pixel]; origin: (2,) first row and column of the cover
    [pixel]; cell: the side of the cover's cells [pixel]; radii: (levels,) [pixel], increasing;
    cover: (levels, rows, columns, words) uint64 the points of the silhouette within a radius of
    each cell's middle; point_area: what a point stands for [pixel]; slack: distances up to this do
    not count [pixel].
    """

    camera: np.ndarray
    X_CW: np.ndarray
    distances: np.ndarray
    origin: np.ndarray
    cell: float
    radii: np.ndarray
    cover: np.ndarray
    point_area: float
    slack: float


class Balls(NamedTuple):
    """A node's balls.

    p_PB: (n, k, 3) their centres in the parent's frame at each sample [m]; radii: (k,) [m];
    areas: (k,) what each stands for of the node's mean projected area [m^2].
    """

    p_PB: np.ndarray
    radii: np.ndarray
    areas: np.ndarray


@compiled
def fill_cover(
    cover: np.ndarray, points: np.ndarray, origin: np.ndarray, cell: float, radii: np.ndarray
) -> None:
    """Writes RoughView.cover of points (n, 2) row, column."""
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
def _look_at_ball(
    view: RoughView, X_CP: np.ndarray, balls: Balls, sample: int, ball: int, covered: np.ndarray
) -> float:
    """Returns what one ball costs [pixel] and adds what it covers (words,)."""
    camera, p = view.camera, balls.p_PB[sample, ball]
    x = X_CP[0, 0] * p[0] + X_CP[0, 1] * p[1] + X_CP[0, 2] * p[2] + X_CP[0, 3]
    y = X_CP[1, 0] * p[0] + X_CP[1, 1] * p[1] + X_CP[1, 2] * p[2] + X_CP[1, 3]
    scale_u, scale_v = camera[1], camera[2]
    if camera[0] == 0.0:
        depth = X_CP[2, 0] * p[0] + X_CP[2, 1] * p[1] + X_CP[2, 2] * p[2] + X_CP[2, 3]
        if depth < camera[5]:
            return 0.0
        scale_u, scale_v = scale_u / depth, scale_v / depth
    u, v = scale_u * x + camera[3], scale_v * y + camera[4]
    if not (-0.5 < u < camera[6] - 0.5 and -0.5 < v < camera[7] - 0.5):
        return 0.0
    radius, cost = scale_u * balls.radii[ball], 0.0
    beyond = view.distances[int(v + 0.5), int(u + 0.5)] + radius - view.slack
    if beyond > 0.0:
        share = min(1.0, beyond / (2.0 * radius + 1e-9))
        cost = scale_u * scale_v * balls.areas[ball] * share
    i, j = int((v - view.origin[0]) / view.cell), int((u - view.origin[1]) / view.cell)
    if 0 <= i < view.cover.shape[1] and 0 <= j < view.cover.shape[2]:
        level = 0
        while level + 1 < view.radii.shape[0] and view.radii[level + 1] <= radius + view.slack:
            level += 1
        for word in range(covered.shape[0]):
            covered[word] |= view.cover[level, i, j, word]
    return cost


@compiled
def score_samples(
    view: RoughView,
    X_CP: np.ndarray,
    balls: Balls,
    masks: np.ndarray,
    outside_weight: float,
    scores: np.ndarray,
) -> None:
    """Adds what a node at all its samples would add to hypotheses in one view.

    Args:
        view: the view.
        X_CP: (B, 4, 4) poses of the node's parent in the camera.
        balls: the node's.
        masks: (B, words) uint64 the points that the hypotheses cover.
        outside_weight: what a pixel outside counts; one newly covered counts -1.
        scores: (B, n) added to [pixel].
    """
    covered = np.zeros(masks.shape[1], dtype=np.uint64)
    for h in range(X_CP.shape[0]):
        for sample in range(balls.p_PB.shape[0]):
            covered[:] = 0
            cost = 0.0
            for ball in range(balls.radii.shape[0]):
                cost += _look_at_ball(view, X_CP[h], balls, sample, ball, covered)
            gain = 0
            for word in range(covered.shape[0]):
                gain += int(count_bits(covered[word] & ~masks[h, word]))
            scores[h, sample] += outside_weight * cost - gain * view.point_area


@compiled
def unite_pairs(
    view: RoughView, X_CP: np.ndarray, balls: Balls, masks: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """The points (m, words) that pairs (m, 2) of a hypothesis and a sample cover in one view."""
    united = np.empty((pairs.shape[0], masks.shape[1]), dtype=np.uint64)
    for k in range(pairs.shape[0]):
        copy_into(united[k], masks[pairs[k, 0]])
        for ball in range(balls.radii.shape[0]):
            _look_at_ball(view, X_CP[pairs[k, 0]], balls, pairs[k, 1], ball, united[k])
    return united
