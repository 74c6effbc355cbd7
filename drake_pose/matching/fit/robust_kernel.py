"""The inner loops of the robust refinement: how far two contours are apart, and which way to go.

Two sums of saturating costs: over the body's contour, how far each point is from the silhouette's
edge, and over the silhouette's edge, how far each pixel is from the body's contour. A stretch
that has no counterpart (an occluder, a shadow, a part that was not segmented) costs its length,
however far it is, and pulls at nothing. The cost of a distance r is that of Geman and McClure,
r^2 / (r^2 + c^2), with c the scale.
"""

from __future__ import annotations

import numpy as np

from drake_pose.compiled import compiled

# Contours correspond only where their normals point alike: at least this cosine.
_ALIKE = 0.2
# Nearer than this [pixel] the direction to a point is no better than the contour's normal.
_NEAR = 2.0


@compiled
def add_body_contour(
    distances: np.ndarray,
    uv: np.ndarray,
    normals: np.ndarray,
    lengths: np.ndarray,
    motion: np.ndarray,
    scale: float,
    H: np.ndarray,
    g: np.ndarray,
) -> float:
    """Adds what the points of the body's contour say to the normal equations H dx = -g.

    Args:
        distances: (H, W) float32 signed distance from the silhouette's edge, positive outside
            [pixel].
        uv: (n, 2) the points [pixel]; normals: (n, 2); lengths: (n,) [pixel].
        motion: (n, 2, m) how they move with the parameters.
        scale: c [pixel].
        H, g: (m, m), (m,) added to.

    Returns:
        Their cost [pixel].
    """
    height, width = distances.shape
    size, cost = motion.shape[2], 0.0
    row = np.empty(size)
    for i in range(uv.shape[0]):
        x = min(max(uv[i, 0], 1.0), width - 2.001)
        y = min(max(uv[i, 1], 1.0), height - 2.001)
        k, j = int(y), int(x)
        a, b = y - k, x - j
        near, far = distances[k, j], distances[k + 1, j]
        side, corner = distances[k, j + 1], distances[k + 1, j + 1]
        r = (1 - a) * ((1 - b) * near + b * side) + a * ((1 - b) * far + b * corner)
        k, j = int(y + 0.5), int(x + 0.5)
        du = 0.5 * (distances[k, j + 1] - distances[k, j - 1])
        dv = 0.5 * (distances[k + 1, j] - distances[k - 1, j])
        along = du * normals[i, 0] + dv * normals[i, 1]
        if r < 0.0 and along < _ALIKE:
            cost += lengths[i]
            continue
        t = (r / scale) ** 2
        cost += lengths[i] * t / (1.0 + t)
        weight = lengths[i] / (1.0 + t) ** 2
        for m in range(size):
            speed = normals[i, 0] * motion[i, 0, m] + normals[i, 1] * motion[i, 1, m]
            row[m] = along * speed
        _add(H, g, row, weight, r)
    return cost


@compiled
def add_silhouette_edge(
    edge: np.ndarray,
    edge_normals: np.ndarray,
    edge_length: float,
    uv: np.ndarray,
    normals: np.ndarray,
    motion: np.ndarray,
    scale: float,
    H: np.ndarray,
    g: np.ndarray,
) -> float:
    """Adds what the silhouette's edge says; arguments as in add_body_contour.

    Args:
        edge: (k, 2) points of the edge [pixel]; edge_normals: (k, 2) out of the silhouette.
        edge_length: the length of edge that each stands for [pixel].
    """
    size, cost = motion.shape[2], 0.0
    row = np.empty(size)
    for i in range(edge.shape[0]):
        best, nearest = np.inf, -1
        x, y = edge[i, 0], edge[i, 1]
        for j in range(uv.shape[0]):
            square = (x - uv[j, 0]) ** 2 + (y - uv[j, 1]) ** 2
            if square < best:
                facing = edge_normals[i, 0] * normals[j, 0] + edge_normals[i, 1] * normals[j, 1]
                if facing > _ALIKE:
                    best, nearest = square, j
        if nearest < 0:
            cost += edge_length
            continue
        j, r = nearest, np.sqrt(best)
        if r < _NEAR:
            n0, n1 = normals[j, 0], normals[j, 1]
            r = (x - uv[j, 0]) * n0 + (y - uv[j, 1]) * n1
        else:
            n0, n1 = (x - uv[j, 0]) / r, (y - uv[j, 1]) / r
        t = (r / scale) ** 2
        cost += edge_length * t / (1.0 + t)
        weight = edge_length / (1.0 + t) ** 2
        for m in range(size):
            row[m] = -n0 * motion[j, 0, m] - n1 * motion[j, 1, m]
        _add(H, g, row, weight, r)
    return cost


@compiled(inline="always")
def _add(H: np.ndarray, g: np.ndarray, row: np.ndarray, weight: float, r: float) -> None:
    """Adds one weighted residual and its derivatives."""
    for m in range(row.shape[0]):
        share = weight * row[m]
        if share != 0.0:
            g[m] += share * r
            for n in range(m + 1):
                H[m, n] += share * row[n]
