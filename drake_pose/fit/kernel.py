"""The inner loop of the fit: a body's contour and a silhouette's edge, compared both ways.

Every point of the body's contour is drawn to the nearest point of the silhouette's edge that faces
alike, and every point of the edge draws the nearest point of the contour. The cost of a distance r
saturates (Geman and McClure 1987): c^2 r^2 / (r^2 + c^2), so that what has no counterpart costs
something and pulls at nothing.

How a distance changes is linear in the affine motion, 12 numbers, of the node that the point lies
on. So the points of a node add up to a 12 x 12 matrix, however many unknowns move it.
"""

import math
from enum import IntEnum

import numpy as np

from drake_pose.arrays import Array, Indices
from drake_pose.compiled import compiled, multiply
from drake_pose.fit.evidence import Evidence
from drake_pose.silhouette.contour_points import sample_contour
from drake_pose.silhouette.outline import PackedOutlines

REACH = 4.0
"""Distances beyond this many scales do not correspond."""


class Sum(IntEnum):
    """Columns of the sums of ``compare_contours``.

    COMPARED: length of contour. FITTING: length of what fits to within the scale. CLOSE: one minus
    the cost in squares of the scale, along the contour [all in units of length]. COST, and SQUARES
    of the distances, both weighted as in A and b. WEIGHT: the weights' sum.
    """

    COMPARED = 0
    FITTING = 1
    CLOSE = 2
    COST = 3
    SQUARES = 4
    WEIGHT = 5


@compiled
def nearest_alike(
    uv: Array, normals: Array, other_uv: Array, others: Array, reach: float,
    least_cosine: float = 0.3, most_squares: float = 64.0,
) -> Indices:  # fmt: skip
    """The nearest point that faces alike; -1 where none is.

    The others are put into squares, and squares are looked at from each point outwards.

    Args:
        uv, normals: (n, 2) points of a contour or an edge.
        other_uv, others: (k, 2) points of the other one, and their normals.
        reach: farther points do not correspond [pixel].
        least_cosine: of the angle between the normals of points that correspond.
        most_squares: in a row.

    Returns:
        (n,) indices.
    """
    found = np.full(len(uv), -1, dtype=np.int64)
    if len(other_uv) == 0:
        return found
    left = right = other_uv[0, 0]
    top = bottom = other_uv[0, 1]
    for j in range(len(other_uv)):
        left, right = min(left, other_uv[j, 0]), max(right, other_uv[j, 0])
        top, bottom = min(top, other_uv[j, 1]), max(bottom, other_uv[j, 1])
    side = max(reach / 8.0, max(right - left, bottom - top) / most_squares)
    share = 1.0 / side
    columns, rows = int((right - left) * share) + 1, int((bottom - top) * share) + 1
    squares = np.empty(len(other_uv), dtype=np.int64)
    starts = np.zeros(rows * columns + 2, dtype=np.int64)
    for j in range(len(other_uv)):
        row, column = int((other_uv[j, 1] - top) * share), int((other_uv[j, 0] - left) * share)
        squares[j] = row * columns + column
        starts[squares[j] + 1] += 1
    for square in range(rows * columns + 1):
        starts[square + 1] += starts[square]
    order, sorted_others = np.empty(len(other_uv), dtype=np.int64), np.empty((len(other_uv), 4))
    for j in range(len(other_uv) - 1, -1, -1):
        # Where a square ends is counted down to where it begins.
        starts[squares[j] + 1] -= 1
        k = starts[squares[j] + 1]
        order[k], sorted_others[k, 0], sorted_others[k, 1] = j, other_uv[j, 0], other_uv[j, 1]
        sorted_others[k, 2], sorted_others[k, 3] = others[j, 0], others[j, 1]
    for i in range(len(uv)):
        best, x, y, nearest = reach * reach, uv[i, 0], uv[i, 1], -1
        row, column = math.floor((y - top) * share), math.floor((x - left) * share)
        for ring in (1, 2, 4, math.ceil(reach * share)):
            first, end = max(column - ring, 0), min(column + ring + 1, columns)
            for v in range(max(row - ring, 0), min(row + ring + 1, rows) if first < end else 0):
                for k in range(starts[v * columns + first + 1], starts[v * columns + end + 1]):
                    du, dv = sorted_others[k, 0] - x, sorted_others[k, 1] - y
                    square = du * du + dv * dv
                    alike = (
                        normals[i, 0] * sorted_others[k, 2] + normals[i, 1] * sorted_others[k, 3]
                    )
                    # No branch, which the processor would guess wrong.
                    is_nearer = (square < best) & (alike >= least_cosine)
                    best, nearest = (square, k) if is_nearer else (best, nearest)
            # All points that are nearer than the ring is wide have been compared.
            if best <= (ring * side) ** 2:
                break
        if nearest >= 0:
            found[i] = order[nearest]
    return found


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
            the body's contour [pixel], and the weight of a pixel of contour.
        squares: k, number of squares of each picture's rows and columns; 0: none.
        side: of the squares [pixel]; beyond k they are counted from 0 again.
        widths: whether derivatives by the silhouettes' widths are wanted.

    Returns:
        A (c, nodes, 12, 12), lower triangles, and b (c, nodes, 12); sums (c, nodes + 1, 6) by
        ``Sum`` of each node's contour, and of all edges in the last row; (c, k, k) the cost by
        squares of the picture; and (c, nodes, 13)
        the derivatives of b, and of half the cost, by the silhouettes' growth [pixel].
    """
    count, nodes = len(weights), len(X_WN)
    A, b = np.zeros((count, nodes, 12, 12)), np.zeros((count, nodes, 12))
    sums, pieces = np.zeros((count, nodes + 1, 6)), np.zeros((count, squares, squares))
    wide = np.zeros((count, nodes, 13))
    for c in range(count):
        begin, end = edges.starts[c], edges.starts[c + 1]
        if begin == end:
            continue
        camera, own_sums, own_weights = (cameras[0][c], cameras[1][c]), sums[c], weights[c]
        unit, scale, spacing, worth = weights[c, 0], weights[c, 1], weights[c, 2], weights[c, 3]
        contour = sample_contour(packed, seen_from(camera[0], X_WN), camera[1], spacing)
        # Named here, arrays are not counted as used again for each pair.
        uv, normals, lengths, owners = contour.uv, contour.normals, contour.lengths, contour.nodes
        edge_uv, edge_normals = edges.uv[begin:end], edges.normals[begin:end]
        edge_lengths = edges.lengths[begin:end]
        of_point = nearest_alike(uv, normals, edge_uv, edge_normals, REACH * scale)
        of_edge = nearest_alike(edge_uv, edge_normals, uv, normals, REACH * scale)
        n = len(uv)
        pulls = np.zeros((n, 7))
        for pair in range(n + len(edge_uv)):
            i = pair if pair < n else of_edge[pair - n]
            j = of_point[pair] if pair < n else pair - n
            length = lengths[i] if pair < n else edge_lengths[j]
            counted = owners[i] if pair < n else nodes
            cost = worth * length * scale * scale
            if i < 0 or j < 0:
                own_sums[counted, Sum.COMPARED] += length * unit
                own_sums[counted, Sum.COST] += cost
            else:
                n0, n1 = normals[i, 0] + edge_normals[j, 0], normals[i, 1] + edge_normals[j, 1]
                share = 1.0 / math.sqrt(n0 * n0 + n1 * n1)
                n0, n1 = share * n0, share * n1
                r = (edge_uv[j, 0] - uv[i, 0]) * n0 + (edge_uv[j, 1] - uv[i, 1]) * n1
                weight, cost = count_distance(own_sums, counted, own_weights, length, r)
                add_pull(pulls, i, n0, n1, r, weight)
                if widths:
                    grows = weight * (edge_normals[j, 0] * n0 + edge_normals[j, 1] * n1)
                    pulls[i, 5] += grows * n0
                    pulls[i, 6] += grows * n1
                    wide[c, owners[i], 12] += grows * r
            if squares > 0:
                u, v = (uv[i, 0], uv[i, 1]) if pair < n else (edge_uv[j, 0], edge_uv[j, 1])
                pieces[c, math.floor(v / side) % squares, math.floor(u / side) % squares] += cost
        add_pulls(A[c], b[c], wide[c], X_WN, camera, contour.p_N, owners, owners, pulls)
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
def count_distance(
    sums: Array, row: int, weights: Array, length: float, r: float
) -> tuple[float, float]:
    """Counts a distance in a row of the sums of `compare_contours`.

    Args:
        sums: (rows, 6) added to.
        row: the node's.
        weights: (4,) as of `compare_contours`.
        length: of the contour that the point stands for [pixel].
        r: the distance [pixel].

    Returns:
        What its square weighs, and the cost.
    """
    unit, scale, worth = weights[0], weights[1], weights[3]
    t = (r / scale) ** 2
    share = 1.0 / (1.0 + t)
    cost = worth * length * r * r * share
    weight = worth * length * share * share
    sums[row, Sum.COMPARED] += length * unit
    sums[row, Sum.FITTING] += length * unit * (t < 1.0)
    sums[row, Sum.CLOSE] += length * unit * share
    sums[row, Sum.COST] += cost
    sums[row, Sum.SQUARES] += weight * r * r
    sums[row, Sum.WEIGHT] += weight
    return weight, cost


@compiled
def add_pull(pulls: Array, i: int, n0: float, n1: float, r: float, weight: float) -> None:
    """Adds a weighted distance r [pixel] along (n0, n1) to a row of the pulls of `add_pulls`."""
    pulls[i, 0] += weight * n0 * n0
    pulls[i, 1] += weight * n0 * n1
    pulls[i, 2] += weight * n1 * n1
    pulls[i, 3] += weight * n0 * r
    pulls[i, 4] += weight * n1 * r


@compiled
def add_pulls(
    A: Array, b: Array, wide: Array, X_WN: Array, camera: tuple[Array, Array], p_N: Array,
    nodes: Indices, owners: Indices, pulls: Array,
) -> None:  # fmt: skip
    """Adds what pulls at points in a picture to the nodes' A, lower triangles, and b.

    All that pulls at one point of a contour is added up in the picture first.

    Args:
        A, b, wide: (nodes, 12, 12), (nodes, 12) and (nodes, 13) added to, as of
            `compare_contours`.
        X_WN: (nodes, 4, 4).
        camera: X_CW (4, 4) and kernel parameters (8,).
        p_N: (n, 3) the points.
        nodes, owners: (n,) the nodes in which they are given, and with which they are moved.
        pulls: (n, 7) sums over what pulls at each, weighted: of n n^T (00, 01, 11), of n r and of
            n times by how much r grows as the silhouette grows by a pixel.
    """
    X_CW, lens = camera
    p, rows, H = np.ones(4), np.zeros((2, 3)), np.zeros((3, 3))
    for i in range(len(pulls)):
        if pulls[i, 0] + pulls[i, 2] == 0.0:
            continue
        node, owner = nodes[i], owners[i]
        for k in range(3):
            p[k] = X_WN[node, k, 3]
            for c in range(3):
                p[k] += X_WN[node, k, c] * p_N[i, c]
        # du/dp_W and dv/dp_W.
        u = v = 0.0
        share = 1.0
        if lens[0] != 1.0:
            for k in range(4):
                u, v = u + X_CW[0, k] * p[k], v + X_CW[1, k] * p[k]
            z = X_CW[2, 0] * p[0] + X_CW[2, 1] * p[1] + X_CW[2, 2] * p[2] + X_CW[2, 3]
            share = 1.0 / z
            u, v = u * share, v * share
        for k in range(3):
            rows[0, k] = lens[1] * share * (X_CW[0, k] - X_CW[2, k] * u)
            rows[1, k] = lens[2] * share * (X_CW[1, k] - X_CW[2, k] * v)
        for k in range(3):
            across = pulls[i, 0] * rows[0, k] + pulls[i, 1] * rows[1, k]
            along = pulls[i, 1] * rows[0, k] + pulls[i, 2] * rows[1, k]
            for c in range(k + 1):
                H[k, c] = across * rows[0, c] + along * rows[1, c]
        for k in range(3):
            pull = pulls[i, 3] * rows[0, k] + pulls[i, 4] * rows[1, k]
            for c in range(4):
                b[owner, 4 * k + c] += pull * p[c]
            for m in range(k + 1):
                for j in range(4):
                    slope = H[k, m] * p[j]
                    for c in range(4):
                        A[owner, 4 * k + j, 4 * m + c] += slope * p[c]
        if pulls[i, 5] != 0.0 or pulls[i, 6] != 0.0:
            for k in range(3):
                grows = pulls[i, 5] * rows[0, k] + pulls[i, 6] * rows[1, k]
                for c in range(4):
                    wide[owner, 4 * k + c] += grows * p[c]
    for node in range(len(A)):
        for k in range(11):
            for c in range(k + 1, 12):
                A[node, k, c] = 0.0


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
