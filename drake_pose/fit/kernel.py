"""The inner loop of the fit: a body's contour and a silhouette's edge, compared both ways.

Every point of the body's contour is drawn to the nearest point of the silhouette's edge that faces
alike, and every point of the edge draws the nearest point of the contour. The cost of a distance r
saturates (Geman and McClure 1987): c^2 r^2 / (r^2 + c^2), so that what has no counterpart costs
something and pulls at nothing.

How a distance changes is linear in the affine motion, 12 numbers, of the node that the point lies
on. So the points of a node add up to a 12 x 12 matrix, however many unknowns move it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drake_pose.compiled import compiled
from drake_pose.fit.evidence import Evidence
from drake_pose.fit.point_motion import picture_rows
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.contours.contour_points import ContourPoints, sample_contour

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Contours correspond only where their normals point alike: at least this cosine.
_ALIKE = 0.3

COMPARED, FITTING, CLOSE, COST, SQUARES, WEIGHT = range(6)
"""The columns of compare_contours' sums."""


@compiled
def nearest_alike(
    uv: Array, normals: Array, edge_uv: Array, edge_normals: Array, reach: float
) -> tuple[Indices, Indices]:
    """The nearest edge point of each contour point, and the other way round; -1 where none is.

    Args:
        uv, normals: (n, 2) points of the body's contour.
        edge_uv, edge_normals: (k, 2) points of the silhouette's edge, downwards (v ascends).
        reach: farther points do not correspond [pixel].

    Returns:
        (n,) and (k,) indices.
    """
    n, k = len(uv), len(edge_uv)
    of_point, of_edge = np.full(n, -1, dtype=np.int64), np.full(k, -1, dtype=np.int64)
    nearest = np.full(k, reach * reach)
    rows = np.ascontiguousarray(edge_uv[:, 1])
    for i in range(n):
        best = reach * reach
        x, y, n0, n1 = uv[i, 0], uv[i, 1], normals[i, 0], normals[i, 1]
        for j in range(np.searchsorted(rows, y - reach), k):
            dv = rows[j] - y
            if dv > reach:
                break
            du = edge_uv[j, 0] - x
            square = du * du + dv * dv
            if square < best or square < nearest[j]:
                if n0 * edge_normals[j, 0] + n1 * edge_normals[j, 1] < _ALIKE:
                    continue
                if square < best:
                    best = square
                    of_point[i] = j
                if square < nearest[j]:
                    nearest[j] = square
                    of_edge[j] = i
    return of_point, of_edge


@compiled
def compare_contours(
    packed: PackedOutlines,
    X_WN: Array,
    cameras: tuple[Array, Array],
    edges: Evidence,
    weights: Array,
    reach: float,
    A: Array,
    b: Array,
    sums: Array,
    pieces: Array,
    side: float,
) -> None:
    """Adds what each camera says of the nodes' affine motions.

    The cost is x^T A x - 2 b^T x and what it is now, for x the rows of a node's affine motion
    (3, 4), which moves a point at p_W by M p_W + v.

    Args:
        packed: the nodes' surfaces.
        X_WN: (nodes, 4, 4).
        cameras: X_CW (c, 4, 4) and kernel parameters (c, 8).
        edges: of their silhouettes.
        weights: (c, 4) of each camera: units of length a pixel, the cost's scale and the spacing of
            the body's contour [pixel], and what a pixel of contour is worth.
        reach: farther points do not correspond [scales].
        A, b: (c, nodes, 12, 12), lower triangles, and (c, nodes, 12) added to.
        sums: (c, nodes + 1, 6) added to, of each node's contour, and of all edges in the last row:
            COMPARED, the length; FITTING, how much of it fits to within the scale; CLOSE, one minus
            the cost in squares of the scale, summed along it [all in units of length]; COST, and
            SQUARES of the distances, both as weighted in A and b; WEIGHT, of these.
        pieces: (c, k, k) the COST by squares of the picture added to; beyond k squares they are
            counted from 0 again. (c, 0, 0): it is not asked for.
        side: of the squares [pixel].
    """
    uv, normals, lengths, starts = edges
    for c in range(len(weights)):
        begin, end = starts[c], starts[c + 1]
        if begin == end:
            continue
        X_CN = seen_from(cameras[0][c], X_WN)
        contour = sample_contour(packed, X_CN, cameras[1][c], weights[c, 2])
        edge = (uv[begin:end], normals[begin:end], lengths[begin:end])
        camera = (cameras[0][c], cameras[1][c])
        add = (A[c], b[c], sums[c], pieces[c])
        _add_camera(contour, edge, X_WN, camera, weights[c], reach, add, side)


@compiled
def _add_camera(
    contour: ContourPoints,
    edge: tuple[Array, Array, Array],
    X_WN: Array,
    camera: tuple[Array, Array],
    weights: Array,
    reach: float,
    add: tuple[Array, Array, Array, Array],
    side: float,
) -> None:
    """compare_contours for one camera; add: its outputs."""
    A, b, sums, pieces = add
    unit, scale, _, worth = weights
    uv, normals, lengths, nodes, p_N, _ = contour
    edge_uv, edge_normals, edge_lengths = edge
    of_point, of_edge = nearest_alike(uv, normals, edge_uv, edge_normals, reach * scale)
    rows, p, w = np.empty((2, 3)), np.empty(3), np.empty(12)
    n = len(uv)
    for pair in range(n + len(edge_uv)):
        i = pair if pair < n else of_edge[pair - n]
        j = of_point[pair] if pair < n else pair - n
        length = lengths[i] if pair < n else edge_lengths[j]
        counted = nodes[i] if pair < n else len(sums) - 1
        sums[counted, COMPARED] += length * unit
        u, v = (uv[i, 0], uv[i, 1]) if pair < n else (edge_uv[j, 0], edge_uv[j, 1])
        if i < 0 or j < 0:
            cost = worth * length * scale * scale
            sums[counted, COST] += cost
            _add_piece(pieces, u / side, v / side, cost)
            continue
        n0, n1 = normals[i, 0] + edge_normals[j, 0], normals[i, 1] + edge_normals[j, 1]
        size = math.sqrt(n0 * n0 + n1 * n1)
        n0, n1 = n0 / size, n1 / size
        r = (edge_uv[j, 0] - uv[i, 0]) * n0 + (edge_uv[j, 1] - uv[i, 1]) * n1
        t = (r / scale) ** 2
        if t < 1.0:
            sums[counted, FITTING] += length * unit
        sums[counted, CLOSE] += length * unit / (1.0 + t)
        cost = worth * length * r * r / (1.0 + t)
        sums[counted, COST] += cost
        _add_piece(pieces, u / side, v / side, cost)
        weight = worth * length / (1.0 + t) ** 2
        sums[counted, SQUARES] += weight * r * r
        sums[counted, WEIGHT] += weight
        node = nodes[i]
        add_residual(A[node], b[node], X_WN[node], p_N[i], camera, n0, n1, r, weight, (rows, p, w))


@compiled
def seen_from(X_CW: Array, X_WN: Array) -> Array:
    """X_CN (nodes, 4, 4)."""
    X_CN = np.zeros_like(X_WN)
    for node in range(len(X_WN)):
        for row in range(3):
            for column in range(4):
                for k in range(4):
                    X_CN[node, row, column] += X_CW[row, k] * X_WN[node, k, column]
        X_CN[node, 3, 3] = 1.0
    return X_CN


@compiled
def add_residual(
    A: Array,
    b: Array,
    X_WN: Array,
    p_N: Array,
    camera: tuple[Array, Array],
    n0: float,
    n1: float,
    r: float,
    weight: float,
    scratch: tuple[Array, Array, Array],
) -> None:
    """Adds one distance in a picture to a node's A (12, 12), lower triangle, and b (12,).

    Args:
        A, b: added to.
        X_WN: (4, 4) of the node.
        p_N: (3,) its point.
        camera: X_CW (4, 4) and kernel parameters (8,).
        n0, n1: the direction along which the point is to move.
        r: by how much [pixel].
        weight: its weight.
        scratch: (2, 3), (3,) and (12,).
    """
    rows, p, w = scratch
    for k in range(3):
        p[k] = X_WN[k, 3]
        for c in range(3):
            p[k] += X_WN[k, c] * p_N[c]
    picture_rows(p, camera[0], camera[1], rows)
    for k in range(3):
        along = n0 * rows[0, k] + n1 * rows[1, k]
        w[4 * k], w[4 * k + 1] = along * p[0], along * p[1]
        w[4 * k + 2], w[4 * k + 3] = along * p[2], along
    for k in range(12):
        share = weight * w[k]
        b[k] += share * r
        for c in range(k + 1):
            A[k, c] += share * w[c]


@compiled
def _add_piece(pieces: Array, column: float, row: float, cost: float) -> None:
    """Adds a cost to the square of a picture that it arises in."""
    size = len(pieces)
    if size > 0:
        pieces[math.floor(row) % size, math.floor(column) % size] += cost


@compiled
def collect(
    A: Array, b: Array, motions: Array, starts: Indices, owners: Indices, parameters: Indices,
    size: int,
) -> tuple[Array, Array]:  # fmt: skip
    """The normal equations H dx = -g of all parameters.

    Args:
        A, b: of compare_contours.
        motions: (k, 12) affine motions.
        starts: (nodes + 1,) which motions, of owners, are those of each node.
        owners: (s,) motions, node after node.
        parameters: (s,) the parameter that makes each.
        size: how many parameters there are.

    Returns:
        (size, size) and (size,).
    """
    H, g = np.zeros((size, size)), np.zeros(size)
    pull = np.empty(12)
    for node in range(len(A)):
        begin, end = starts[node], starts[node + 1]
        for s in range(begin, end):
            motion = motions[owners[s]]
            for k in range(12):
                pull[k] = 0.0
                for c in range(12):
                    pull[k] += (A[node, k, c] if c <= k else A[node, c, k]) * motion[c]
                g[parameters[s]] -= motion[k] * b[node, k]
            for t in range(begin, s + 1):
                product = 0.0
                for k in range(12):
                    product += motions[owners[t], k] * pull[k]
                H[parameters[s], parameters[t]] += product
                if t < s:
                    H[parameters[t], parameters[s]] += product
    return H, g
