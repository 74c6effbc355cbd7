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

from drake_pose.compiled import compiled, multiply
from drake_pose.fit.evidence import Evidence
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.contours.contour_points import sample_contour

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

REACH = 4.0
"""Distances beyond this many scales do not correspond."""

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
    squares: int,
    side: float,
    widths: bool,
) -> tuple[Array, Array, Array, Array, Array]:
    """What each camera says of the nodes' affine motions.

    The cost is x^T A x - 2 b^T x and what it is now, for x the rows of a node's affine motion
    (3, 4), which moves a point at p_W by M p_W + v.

    Args:
        packed: the nodes' surfaces.
        X_WN: (nodes, 4, 4).
        cameras: X_CW (c, 4, 4) and kernel parameters (c, 8).
        edges: of their silhouettes.
        weights: (c, 4) of each camera: units of length a pixel, the cost's scale and the spacing of
            the body's contour [pixel], and what a pixel of contour is worth.
        squares: k, so many squares of each picture's rows and columns are told apart; 0: none.
        side: of the squares [pixel]; beyond k they are counted from 0 again.
        widths: whether it is told what follows the silhouettes' widths.

    Returns:
        A (c, nodes, 12, 12), lower triangles, and b (c, nodes, 12); sums (c, nodes + 1, 6) of each
        node's contour, and of all edges in the last row: COMPARED, the length; FITTING, how much of
        it fits to within the scale; CLOSE, one minus the cost in squares of the scale, summed along
        it [all in units of length]; COST, and SQUARES of the distances, both as weighted in A and
        b; WEIGHT, of these; (c, k, k) the COST by squares of the picture; and (c, nodes, 13)
        by how much b grows as silhouettes grow by a pixel, then so much their cost, over two;
        0 where it is not told.
    """
    count, nodes = len(weights), len(X_WN)
    A, b = np.zeros((count, nodes, 12, 12)), np.zeros((count, nodes, 12))
    sums, pieces = np.zeros((count, nodes + 1, 6)), np.zeros((count, squares, squares))
    wide = np.zeros((count, nodes, 13))
    rows, p, w = np.empty((2, 3)), np.empty(3), np.empty(12)
    for c in range(count):
        begin, end = edges.starts[c], edges.starts[c + 1]
        if begin == end:
            continue
        camera = (cameras[0][c], cameras[1][c])
        own_A, own_b, own_sums = A[c], b[c], sums[c]
        unit, scale, spacing, worth = weights[c, 0], weights[c, 1], weights[c, 2], weights[c, 3]
        contour = sample_contour(packed, seen_from(camera[0], X_WN), camera[1], spacing)
        uv, normals = contour.uv, contour.normals
        edge_uv, edge_normals = edges.uv[begin:end], edges.normals[begin:end]
        of_point, of_edge = nearest_alike(uv, normals, edge_uv, edge_normals, REACH * scale)
        n = len(uv)
        for pair in range(n + len(edge_uv)):
            i = pair if pair < n else of_edge[pair - n]
            j = of_point[pair] if pair < n else pair - n
            length = contour.lengths[i] if pair < n else edges.lengths[begin + j]
            counted = own_sums[contour.nodes[i] if pair < n else nodes]
            cost = worth * length * scale * scale
            if i < 0 or j < 0:
                counted[COMPARED] += length * unit
                counted[COST] += cost
            else:
                n0, n1 = normals[i, 0] + edge_normals[j, 0], normals[i, 1] + edge_normals[j, 1]
                size = math.sqrt(n0 * n0 + n1 * n1)
                n0, n1 = n0 / size, n1 / size
                r = (edge_uv[j, 0] - uv[i, 0]) * n0 + (edge_uv[j, 1] - uv[i, 1]) * n1
                grows = edge_normals[j, 0] * n0 + edge_normals[j, 1] * n1 if widths else 0.0
                node = contour.nodes[i]
                cost = add_residual(
                    own_A[node], own_b[node], counted, wide[c, node], X_WN[node], contour.p_N[i],
                    camera, n0, n1, r, grows, length, weights[c], (rows, p, w),
                )  # fmt: skip
            if squares > 0:
                u, v = (uv[i, 0], uv[i, 1]) if pair < n else (edge_uv[j, 0], edge_uv[j, 1])
                pieces[c, math.floor(v / side) % squares, math.floor(u / side) % squares] += cost
    return A, b, sums, pieces, wide


@compiled
def seen_from(X_CW: Array, X_WN: Array) -> Array:
    """X_CN (nodes, 4, 4)."""
    X_CN = np.zeros_like(X_WN)
    for node in range(len(X_WN)):
        multiply(X_CW, X_WN[node], X_CN[node])
        X_CN[node, 3, 3] = 1.0
    return X_CN


@compiled
def _picture_rows(p_W: Array, X_CW: Array, camera: Array, rows: Array) -> None:
    """Writes du/dp_W and dv/dp_W (2, 3) of a point."""
    x, y, z = X_CW[0, 3], X_CW[1, 3], X_CW[2, 3]
    for k in range(3):
        x += X_CW[0, k] * p_W[k]
        y += X_CW[1, k] * p_W[k]
        z += X_CW[2, k] * p_W[k]
    for k in range(3):
        if camera[0] == 1.0:
            rows[0, k] = camera[1] * X_CW[0, k]
            rows[1, k] = camera[2] * X_CW[1, k]
        else:
            rows[0, k] = camera[1] * (X_CW[0, k] - X_CW[2, k] * x / z) / z
            rows[1, k] = camera[2] * (X_CW[1, k] - X_CW[2, k] * y / z) / z


@compiled
def add_residual(
    A: Array,
    b: Array,
    sums: Array,
    wide: Array,
    X_WN: Array,
    p_N: Array,
    camera: tuple[Array, Array],
    n0: float,
    n1: float,
    r: float,
    grows: float,
    length: float,
    weights: Array,
    scratch: tuple[Array, Array, Array],
) -> float:
    """Adds one distance in a picture to a node's A (12, 12), lower triangle, and b (12,).

    Args:
        A, b, sums, wide: added to, as of `compare_contours`.
        X_WN: (4, 4) of the node.
        p_N: (3,) its point.
        camera: X_CW (4, 4) and kernel parameters (8,).
        n0, n1: the direction along which the point is to move.
        r: by how much [pixel].
        grows: by how much more as the silhouette grows by a pixel on all sides; 0: not told.
        length: of the contour that the point stands for [pixel].
        weights: (4,) as of `compare_contours`.
        scratch: (2, 3), (3,) and (12,).

    Returns:
        The cost.
    """
    unit, scale, worth = weights[0], weights[1], weights[3]
    t = (r / scale) ** 2
    cost = worth * length * r * r / (1.0 + t)
    weight = worth * length / (1.0 + t) ** 2
    sums[COMPARED] += length * unit
    if t < 1.0:
        sums[FITTING] += length * unit
    sums[CLOSE] += length * unit / (1.0 + t)
    sums[COST] += cost
    sums[SQUARES] += weight * r * r
    sums[WEIGHT] += weight
    add_row(A, b, X_WN, p_N, camera, n0, n1, r, weight, scratch)
    if grows != 0.0:
        for k in range(12):
            wide[k] += weight * grows * scratch[2][k]
        wide[12] += weight * grows * r
    return cost


@compiled
def add_row(
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
    """As add_residual, of a distance that has its weight."""
    rows, p, w = scratch
    for k in range(3):
        p[k] = X_WN[k, 3]
        for c in range(3):
            p[k] += X_WN[k, c] * p_N[c]
    _picture_rows(p, camera[0], camera[1], rows)
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
        if A[node, 3, 3] + A[node, 7, 7] + A[node, 11, 11] == 0.0:
            continue
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
