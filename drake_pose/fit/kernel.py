"""The inner loop of the fit: residuals between a body's contour and the edges of silhouettes.

Every point of the body's contour is matched to the nearest edge point with a similar normal, and
every edge point to the nearest contour point. The cost of a distance r saturates (Geman and McClure
1987), c^2 r^2 / (r^2 + c^2), so an unmatched point costs c^2 and exerts no pull.

A distance changes linearly in the affine motion (12 numbers) of the node on which its point lies,
so the points of a node add up to one 12 x 12 matrix, independent of the number of unknowns.
"""

import math
from enum import IntEnum

import numpy as np

from drake_pose.arrays import Array, Indices
from drake_pose.compiled import compiled
from drake_pose.fit.evidence import Evidence
from drake_pose.silhouette.contour_points import sample_contour
from drake_pose.silhouette.outline import PackedOutlines

REACH = 4.0
"""Maximum distance of matched points [scales of the cost]."""


class Sum(IntEnum):
    """Columns of the sums of ``compare_contours``.

    COMPARED: length of contour. FITTING: length of contour with a residual below the scale. CLOSE:
    integral of 1 / (1 + (r / scale)^2) along the contour [all in units of length]. COST: the cost.
    SQUARES: weighted sum of squared residuals. WEIGHT: sum of these weights.
    """

    COMPARED = 0
    FITTING = 1
    CLOSE = 2
    COST = 3
    SQUARES = 4
    WEIGHT = 5


@compiled
def match_points(
    uv: Array, normals: Array, other_uv: Array, others: Array, reach: float,
    min_cosine: float = 0.3, max_cells: float = 64.0,
) -> Indices:  # fmt: skip
    """Return for each point the nearest other point with a similar normal.

    The other points are sorted into a grid of square cells, which is searched in growing rings.

    Args:
        uv, normals: (n, 2) points [pixel] and unit normals of a contour or an edge.
        other_uv, others: (k, 2) points [pixel] and unit normals of the other one.
        reach: maximum distance of a match [pixel].
        min_cosine: minimum cosine of the angle between matched normals.
        max_cells: maximum number of cells along a side of the grid.

    Returns (n,) indices of the matched points; -1: no match.
    """
    found = np.full(len(uv), -1, dtype=np.int64)
    if len(other_uv) == 0:
        return found
    left = right = other_uv[0, 0]
    top = bottom = other_uv[0, 1]
    for j in range(len(other_uv)):
        left, right = min(left, other_uv[j, 0]), max(right, other_uv[j, 0])
        top, bottom = min(top, other_uv[j, 1]), max(bottom, other_uv[j, 1])
    side = max(reach / 8.0, max(right - left, bottom - top) / max_cells)
    per_pixel = 1.0 / side  # Cells per pixel.
    columns, rows = int((right - left) * per_pixel) + 1, int((bottom - top) * per_pixel) + 1
    cells = np.empty(len(other_uv), dtype=np.int64)
    starts = np.zeros(rows * columns + 2, dtype=np.int64)
    for j in range(len(other_uv)):
        row = int((other_uv[j, 1] - top) * per_pixel)
        column = int((other_uv[j, 0] - left) * per_pixel)
        cells[j] = row * columns + column
        starts[cells[j] + 1] += 1
    for cell in range(rows * columns + 1):
        starts[cell + 1] += starts[cell]
    order, sorted_others = np.empty(len(other_uv), dtype=np.int64), np.empty((len(other_uv), 4))
    for j in range(len(other_uv) - 1, -1, -1):
        # The end index of a cell is decremented down to its start index.
        starts[cells[j] + 1] -= 1
        k = starts[cells[j] + 1]
        order[k], sorted_others[k, 0], sorted_others[k, 1] = j, other_uv[j, 0], other_uv[j, 1]
        sorted_others[k, 2], sorted_others[k, 3] = others[j, 0], others[j, 1]
    for i in range(len(uv)):
        best, x, y, nearest = reach * reach, uv[i, 0], uv[i, 1], -1
        row, column = math.floor((y - top) * per_pixel), math.floor((x - left) * per_pixel)
        for ring in (1, 2, 4, math.ceil(reach * per_pixel)):
            first, end = max(column - ring, 0), min(column + ring + 1, columns)
            for v in range(max(row - ring, 0), min(row + ring + 1, rows) if first < end else 0):
                for k in range(starts[v * columns + first + 1], starts[v * columns + end + 1]):
                    du, dv = sorted_others[k, 0] - x, sorted_others[k, 1] - y
                    square = du * du + dv * dv
                    alike = (
                        normals[i, 0] * sorted_others[k, 2] + normals[i, 1] * sorted_others[k, 3]
                    )
                    # Branch-free, because the branch would be mispredicted often.
                    is_nearer = (square < best) & (alike >= min_cosine)
                    best, nearest = (square, k) if is_nearer else (best, nearest)
            # All points within the ring's radius have been compared.
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
    tiles_per_side: int,
    side: float,
    with_bias: bool,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the quadratic cost of the nodes' affine motions for each camera.

    The cost is x^T A x - 2 b^T x plus the current cost. x (12,) are the rows of a node's affine
    motion (M v) (3, 4), which moves a point at p_W by M p_W + v. Points are matched within REACH
    scales of the cost; an unmatched one adds its maximum cost.

    Args:
        packed: surfaces of the nodes.
        X_WN: (nodes, 4, 4) poses of the nodes.
        cameras: X_CW (c, 4, 4) and `Camera.kernel_parameters` (c, 8).
        edges: edges of the c silhouettes; a camera without edge points contributes 0.
        weights: (c, 4) per camera: units of length per pixel, scale of the cost [pixel], spacing of
            the body's contour points [pixel], and weight per pixel of contour length.
        tiles_per_side: k, number of tiles per row and column in which the cost is summed; 0: none.
        side: side of a tile [pixel]; tile indices are taken modulo k.
        with_bias: compute derivatives by the silhouettes' boundary bias.

    Returns a (c, nodes, 12, 12), lower triangles. b (c, nodes, 12). Sums (c, nodes + 1, 6) by
    ``Sum`` of each node's contour, and of the camera's edge in the last row. Cost (c, k, k) in
    tiles (row, column) of the image. Derivatives (c, nodes, 13) of b (12,) and of half the cost by
    the boundary bias [pixel].
    """
    count, nodes = len(weights), len(X_WN)
    A, b = np.zeros((count, nodes, 12, 12)), np.zeros((count, nodes, 12))
    sums, tiles = np.zeros((count, nodes + 1, 6)), np.zeros((count, tiles_per_side, tiles_per_side))
    bias_terms = np.zeros((count, nodes, 13))
    for c in range(count):
        begin, end = edges.starts[c], edges.starts[c + 1]
        if begin == end:
            continue
        camera, own_sums, own_weights = (cameras[0][c], cameras[1][c]), sums[c], weights[c]
        unit, scale, spacing = weights[c, 0], weights[c, 1], weights[c, 2]
        length_weight = weights[c, 3]
        contour = sample_contour(packed, X_WN, camera, spacing)
        # Local names avoid numba's reference counting in the inner loop.
        uv, normals, lengths, owners = contour.uv, contour.normals, contour.lengths, contour.nodes
        edge_uv, edge_normals = edges.uv[begin:end], edges.normals[begin:end]
        edge_lengths = edges.lengths[begin:end]
        of_point = match_points(uv, normals, edge_uv, edge_normals, REACH * scale)
        of_edge = match_points(edge_uv, edge_normals, uv, normals, REACH * scale)
        n = len(uv)
        point_sums = np.zeros((n, 7))
        for pair in range(n + len(edge_uv)):
            i = pair if pair < n else of_edge[pair - n]
            j = of_point[pair] if pair < n else pair - n
            length = lengths[i] if pair < n else edge_lengths[j]
            counted = owners[i] if pair < n else nodes
            cost = length_weight * length * scale * scale
            if i < 0 or j < 0:
                own_sums[counted, Sum.COMPARED] += length * unit
                own_sums[counted, Sum.COST] += cost
            else:
                n0, n1 = normals[i, 0] + edge_normals[j, 0], normals[i, 1] + edge_normals[j, 1]
                factor = 1.0 / math.sqrt(n0 * n0 + n1 * n1)
                n0, n1 = factor * n0, factor * n1
                r = (edge_uv[j, 0] - uv[i, 0]) * n0 + (edge_uv[j, 1] - uv[i, 1]) * n1
                weight, cost = robust_weight(own_sums, counted, own_weights, length, r)
                add_residual(point_sums, i, n0, n1, r, weight)
                if with_bias:
                    grows = weight * (edge_normals[j, 0] * n0 + edge_normals[j, 1] * n1)
                    point_sums[i, 5] += grows * n0
                    point_sums[i, 6] += grows * n1
                    bias_terms[c, owners[i], 12] += grows * r
            if tiles_per_side > 0:
                u, v = (uv[i, 0], uv[i, 1]) if pair < n else (edge_uv[j, 0], edge_uv[j, 1])
                tiles[
                    c, math.floor(v / side) % tiles_per_side, math.floor(u / side) % tiles_per_side
                ] += cost
        accumulate_residuals(
            A[c], b[c], bias_terms[c], X_WN, camera, contour.p_N, owners, owners, point_sums
        )
    return A, b, sums, tiles, bias_terms


@compiled
def robust_weight(
    sums: Array, row: int, weights: Array, length: float, r: float
) -> tuple[float, float]:
    """Return the weight and cost of a residual, and add it to a row of the sums.

    Args:
        sums: (rows, 6) columns by ``Sum``, added to.
        row: row of the sums, such as the index of a node.
        weights: (4,) units of length per pixel, scale of the cost [pixel], an unused element, and
            weight per pixel of contour length.
        length: length of contour that the point represents [pixel].
        r: the residual [pixel].

    Returns the weight of the squared residual, and the cost.
    """
    unit, scale, length_weight = weights[0], weights[1], weights[3]
    t = (r / scale) ** 2
    attenuation = 1.0 / (1.0 + t)
    cost = length_weight * length * r * r * attenuation
    weight = length_weight * length * attenuation * attenuation
    sums[row, Sum.COMPARED] += length * unit
    sums[row, Sum.FITTING] += length * unit * (t < 1.0)
    sums[row, Sum.CLOSE] += length * unit * attenuation
    sums[row, Sum.COST] += cost
    sums[row, Sum.SQUARES] += weight * r * r
    sums[row, Sum.WEIGHT] += weight
    return weight, cost


@compiled
def add_residual(point_sums: Array, i: int, n0: float, n1: float, r: float, weight: float) -> None:
    """Add a weighted squared residual to the first five columns of a row of point sums, in place.

    Args:
        point_sums: (n, 7) one row per point, columns n0^2, n0 n1, n1^2, n0 r, n1 r, and two that
            stay.
        i: the row.
        n0, n1: elements along u and v of the unit normal along which the point should move.
        r: the residual [pixel], the distance to move.
        weight: weight of the squared residual.
    """
    point_sums[i, 0] += weight * n0 * n0
    point_sums[i, 1] += weight * n0 * n1
    point_sums[i, 2] += weight * n1 * n1
    point_sums[i, 3] += weight * n0 * r
    point_sums[i, 4] += weight * n1 * r


@compiled
def accumulate_residuals(
    A: Array, b: Array, bias_terms: Array, X_WN: Array, camera: tuple[Array, Array], p_N: Array,
    nodes: Indices, owners: Indices, point_sums: Array,
) -> None:  # fmt: skip
    """Add the residuals at points of an image to the nodes' A (lower triangles) and b.

    All residuals at one point of a contour must have been summed by `add_residual` first.

    Args:
        A, b: (nodes, 12, 12) and (nodes, 12), added to: the quadratic cost x^T A x - 2 b^T x of
            each node's affine motion x (12,), the rows of (M v).
        bias_terms: (nodes, 13), whose first 12 columns, the derivative of b by the boundary bias,
            are added to.
        X_WN: (nodes, 4, 4) poses of the nodes.
        camera: X_CW (4, 4) and `Camera.kernel_parameters` (8,).
        p_N: (n, 3) positions of the points in their nodes [m].
        nodes, owners: (n,) the node in which a point is given, and the node that moves it.
        point_sums: (n, 7) weighted sums over the residuals r [pixel] with normal n (2,) at each
            point: n n^T (elements 00, 01, 11), n r (2), and n times the derivative of r by the
            boundary bias (2).
    """
    X_CW, lens = camera
    p, rows, H = np.ones(4), np.zeros((2, 3)), np.zeros((3, 3))
    for i in range(len(point_sums)):
        if point_sums[i, 0] + point_sums[i, 2] == 0.0:
            continue
        node, owner = nodes[i], owners[i]
        for k in range(3):
            p[k] = X_WN[node, k, 3]
            for c in range(3):
                p[k] += X_WN[node, k, c] * p_N[i, c]
        # du/dp_W and dv/dp_W.
        u = v = 0.0
        inverse_depth = 1.0
        if lens[0] != 1.0:
            for k in range(4):
                u, v = u + X_CW[0, k] * p[k], v + X_CW[1, k] * p[k]
            z = X_CW[2, 0] * p[0] + X_CW[2, 1] * p[1] + X_CW[2, 2] * p[2] + X_CW[2, 3]
            inverse_depth = 1.0 / z
            u, v = u * inverse_depth, v * inverse_depth
        for k in range(3):
            rows[0, k] = lens[1] * inverse_depth * (X_CW[0, k] - X_CW[2, k] * u)
            rows[1, k] = lens[2] * inverse_depth * (X_CW[1, k] - X_CW[2, k] * v)
        for k in range(3):
            across = point_sums[i, 0] * rows[0, k] + point_sums[i, 1] * rows[1, k]
            along = point_sums[i, 1] * rows[0, k] + point_sums[i, 2] * rows[1, k]
            for c in range(k + 1):
                H[k, c] = across * rows[0, c] + along * rows[1, c]
        for k in range(3):
            row_sum = point_sums[i, 3] * rows[0, k] + point_sums[i, 4] * rows[1, k]
            for c in range(4):
                b[owner, 4 * k + c] += row_sum * p[c]
            for m in range(k + 1):
                for j in range(4):
                    slope = H[k, m] * p[j]
                    for c in range(4):
                        A[owner, 4 * k + j, 4 * m + c] += slope * p[c]
        if point_sums[i, 5] != 0.0 or point_sums[i, 6] != 0.0:
            for k in range(3):
                grows = point_sums[i, 5] * rows[0, k] + point_sums[i, 6] * rows[1, k]
                for c in range(4):
                    bias_terms[owner, 4 * k + c] += grows * p[c]
    for node in range(len(A)):
        for k in range(11):
            for c in range(k + 1, 12):
                A[node, k, c] = 0.0


@compiled
def assemble_normal_equations(
    A: Array, b: Array, motions: Array, starts: Indices, owners: Indices, parameters: Indices,
    size: int,
) -> tuple[Array, Array]:  # fmt: skip
    """Return the normal equations H dx = -g of all parameters.

    Args:
        A, b: (nodes, 12, 12) lower triangles and (nodes, 12), one camera's of `compare_contours`
            or summed over cameras.
        motions: (k, 12) affine motions.
        starts: (nodes + 1,) index of each node's first entry in owners.
        owners: (s,) indices of the motions that move each node, ordered by node.
        parameters: (s,) index of the parameter that causes each of these motions.
        size: number of parameters.

    Returns:
        H (size, size) and g (size,).
    """
    H, g = np.zeros((size, size)), np.zeros(size)
    row_sum = np.empty(12)
    for node in range(len(A)):
        begin, end = starts[node], starts[node + 1]
        if A[node, 3, 3] + A[node, 7, 7] + A[node, 11, 11] == 0.0:
            continue
        for s in range(begin, end):
            motion = motions[owners[s]]
            for k in range(12):
                row_sum[k] = 0.0
                for c in range(12):
                    row_sum[k] += (A[node, k, c] if c <= k else A[node, c, k]) * motion[c]
                g[parameters[s]] -= motion[k] * b[node, k]
            for t in range(begin, s + 1):
                product = 0.0
                for k in range(12):
                    product += motions[owners[t], k] * row_sum[k]
                H[parameters[s], parameters[t]] += product
                if t < s:
                    H[parameters[t], parameters[s]] += product
    return H, g
