"""Balls inside and around a surface: they leave out poses undrawn, and tell what can be reached."""

import math

import numpy as np

from drake_pose.compiled import compiled, multiply
from drake_pose.silhouette.bits.bit_kernel import NEAREST_STRIDE, WORD, BitView, write_runs


@compiled
def prune_by_balls(
    view: BitView,
    X_WP: np.ndarray,
    p_PB: np.ndarray,
    radii: np.ndarray,
    pairs: np.ndarray,
    limit: float,
) -> np.ndarray:
    """Which pairs (m,) bool no ball inside the surface shows to lie outside by more than the limit.

    Args:
        X_WP: (g, 4, 4) poses of the parent.
        p_PB: (n, k, 3) places of k balls in the parent's frame at each sample of the node [m].
        radii: (k,) of the balls [m].
        pairs: (m, 2) int32 parent pose and sample.
        limit: the area that may lie outside the silhouette [pixel]; no pair within it is lost.
    """
    camera, window, X_CW = view.camera, view.window, view.X_CW
    left = np.ones(pairs.shape[0], dtype=np.bool_)
    scale, parallel = min(camera[1], camera[2]), camera[0] == 1.0
    X_CP = np.empty((3, 4))
    group = -1
    for i in range(pairs.shape[0]):
        if pairs[i, 0] != group:
            group = pairs[i, 0]
            multiply(X_CW, X_WP[group], X_CP)
        sample = pairs[i, 1]
        for k in range(radii.shape[0]):
            x, y, z = p_PB[sample, k, 0], p_PB[sample, k, 1], p_PB[sample, k, 2]
            u = X_CP[0, 0] * x + X_CP[0, 1] * y + X_CP[0, 2] * z + X_CP[0, 3]
            v = X_CP[1, 0] * x + X_CP[1, 1] * y + X_CP[1, 2] * z + X_CP[1, 3]
            radius = scale * radii[k]
            if parallel:
                u, v = camera[1] * u + camera[3], camera[2] * v + camera[4]
            else:
                depth = X_CP[2, 0] * x + X_CP[2, 1] * y + X_CP[2, 2] * z + X_CP[2, 3]
                if depth - radii[k] < camera[5]:
                    continue
                u, v = camera[1] * u / depth + camera[3], camera[2] * v / depth + camera[4]
                radius /= depth
            if not (-0.5 < u < camera[6] - 0.5 and -0.5 < v < camera[7] - 0.5):
                continue
            if limit < 1.0:
                # A disc that leaves the silhouette: a pixel outside lies in it.
                row, column = round(v), round(u)
                r, c = row - window[0], column - window[1]
                if 0 <= r < window[2] and 0 <= c < window[3] and view.nearest[r, c] >= 0:
                    row = view.nearest[r, c] // NEAREST_STRIDE
                    column = view.nearest[r, c] % NEAREST_STRIDE
                outside = (u - column) ** 2 + (v - row) ** 2 < max(0.0, radius - 1e-6) ** 2
            else:
                outside = _square_outside(view.sums, window, camera, u, v, 0.7071 * radius) > limit
            if outside:
                left[i] = False
                break
    return left


@compiled
def _square_outside(
    sums: np.ndarray, window: np.ndarray, camera: np.ndarray, u: float, v: float, half: float
) -> int:
    """Returns how many pixels of the picture under a square are not in the silhouette."""
    a, b = max(0, int(np.ceil(u - half))), min(int(camera[6]), int(np.ceil(u + half)))
    c, d = max(0, int(np.ceil(v - half))), min(int(camera[7]), int(np.ceil(v + half)))
    if a >= b or c >= d:
        return 0
    area = (b - a) * (d - c)
    a, b = max(0, a - window[1]), min(window[3], b - window[1])
    c, d = max(0, c - window[0]), min(window[2], d - window[0])
    if a >= b or c >= d:
        return area
    return area - (sums[d, b] - sums[c, b] - sums[d, a] + sums[c, a])


@compiled
def draw_discs(
    view: BitView, X_WP: np.ndarray, p_PB: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draws discs that hold the picture of a ball (p_PB (3,), radius [m]) as the silhouette's bits.

    ``X_WP``: (g, 4, 4) poses of the frame that the ball is fixed in.

    Returns:
        runs (g, 3) int64 first word, number of words, where they begin in words; words (n,) uint64.
    """
    camera, window = view.camera, view.window
    height, width = window[2], window[3]
    size = view.inside[-1, -1] // WORD + 1
    X_CP = np.empty((3, 4))
    p_C = np.empty(3)
    spans = np.empty((height, 3), dtype=np.int32)
    runs = np.zeros((X_WP.shape[0], 3), dtype=np.int64)
    words = np.empty(size * X_WP.shape[0], dtype=np.uint64)
    used = 0
    for i in range(X_WP.shape[0]):
        multiply(view.X_CW, X_WP[i], X_CP)
        for j in range(3):
            p_C[j] = X_CP[j, 3]
            for k in range(3):
                p_C[j] += X_CP[j, k] * p_PB[k]
        u, v, reach = camera[1] * p_C[0], camera[2] * p_C[1], max(camera[1], camera[2]) * radius
        if camera[0] != 1.0:
            u, v = u / p_C[2], v / p_C[2]
            distance = np.sqrt((p_C**2).sum())
            reach *= distance / (p_C[2] * (p_C[2] - radius))
            if p_C[2] - radius < camera[5]:
                u, v, reach = 0.0, 0.0, 1e9
        u, v, reach = u + camera[3] - window[1], v + camera[4] - window[0], reach + 1.0
        count = 0
        for row in range(max(0, math.ceil(v - reach)), min(height, math.floor(v + reach) + 1)):
            half = np.sqrt(max(0.0, reach * reach - (row - v) ** 2))
            a, b = max(0, math.ceil(u - half)), min(width, math.floor(u + half) + 1)
            if a < b:
                spans[count, 0], spans[count, 1], spans[count, 2] = row, a, b
                count += 1
        used = write_runs(view.inside, spans, count, words, used, runs[i])
    return runs, words[:used].copy()
