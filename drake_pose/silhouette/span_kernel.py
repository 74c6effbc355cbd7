"""The span kernel: exact areas of projected triangle surfaces without rendering.

Each projected triangle is traversed counter-clockwise in the image. The winding number of all
triangles at a point is the number of triangles that cover it, for any set of triangles. Along an
edge, the traversals of its two triangles cancel except on the contour, so only contour edges are
walked. In every row of pixel centres that it crosses, a contour edge leaves a crossing: the first
pixel to its right, and a weight. An edge crosses rows v0 <= v < v1 between its upper and lower end.

A span of covered pixels [a, b) lies where the sum of the weights along a row is not zero. The area
of a set under the span is P[row, b] - P[row, a], with P the set's prefix sums along the row.
Crossings of all surfaces in common rows give the exact union of the surfaces.

Arrays are passed whole, with an index, because numba pays for every slice and every argument.
"""

import math
from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.silhouette.outline import PackedOutlines, bend, clip_triangle, place_surface

SHIFT, BIAS = 3, 4
"""A crossing is stored as 8 * pixel + weight + BIAS; a weight is an integer from -2 to 2."""


class Rows(NamedTuple):
    """Scratch arrays for one body at one pose."""

    # u, v: (points,) image coordinates of one surface's points [pixel].
    u: np.ndarray
    v: np.ndarray
    facings: np.ndarray  # (triangles + 1,) int8 output of ``place_surface``.
    counts: np.ndarray  # (height,) int32 number of crossings of each row.
    # (3,) int64 first row touched, row after the last, and whether a row overflowed.
    row_range: np.ndarray
    changes: np.ndarray  # (width + 1,) int32 difference array, zero between calls.
    spans: np.ndarray  # (width + 1, 2) int32 spans [a, b) of one row.


@compiled
def make_rows(packed: PackedOutlines, camera: np.ndarray) -> tuple[Rows, np.ndarray]:
    """Return scratch for the largest of packed surfaces, and crossings (height, capacity) int32.

    ``camera``: (8,) ``Camera.kernel_parameters()``. The capacity is 8; ``fill_rows`` enlarges it.
    """
    width, height = int(camera[6]), int(camera[7])
    points, triangles = 0, 0
    for node in range(packed.starts.shape[0] - 1):
        points = max(points, packed.starts[node + 1, 0] - packed.starts[node, 0])
        triangles = max(triangles, packed.starts[node + 1, 1] - packed.starts[node, 1])
    rows = Rows(
        np.empty(points), np.empty(points), np.empty(triangles + 1, dtype=np.int8),
        np.zeros(height, dtype=np.int32), np.array([height, 0, 0]),
        np.zeros(width + 1, dtype=np.int32), np.empty((width + 1, 2), dtype=np.int32),
    )  # fmt: skip
    return rows, np.empty((height, 8), dtype=np.int32)


@compiled
def _walk_edge(
    ua: float,
    va: float,
    ub: float,
    vb: float,
    weight: int,
    width: float,
    height: float,
    crossings: np.ndarray,
    counts: np.ndarray,
    row_range: np.ndarray,
) -> None:
    """Append the crossings of the edge from (ua, va) to (ub, vb) [pixel] to the rows.

    Args:
        weight: change of the winding number across the edge from left to right if it runs
            downwards.
        width, height: size of the image [pixel].
        crossings: (height, capacity) output; a row without room sets ``row_range[2]``.
        counts, row_range: as in ``Rows``, updated.
    """
    # Always downwards, so that both directions of an edge cross rows at identical places.
    if va > vb:
        ua, va, ub, vb = ub, vb, ua, va
        weight = -weight
    if not (vb > 0.0 and va <= height - 1.0):
        return
    first = math.ceil(max(va, 0.0))
    end = math.ceil(min(vb, height))
    if first >= end:
        return
    row_range[0] = min(row_range[0], first)
    row_range[1] = max(row_range[1], end)
    capacity = crossings.shape[1]
    columns = int(width)
    slope = (ub - ua) / (vb - va)
    mark = weight + BIAS
    for row in range(first, end):
        u = ua + (row - va) * slope
        # Clamp to the image before rounding, since u may be too large for an integer.
        pixel = math.ceil(u) if 0.0 < u < width else (0 if u < width else columns)
        count = counts[row]
        if count < capacity:
            crossings[row, count] = (pixel << SHIFT) + mark
        else:
            row_range[2] = 1
        counts[row] = count + 1


@compiled
def _clip_near(
    packed: PackedOutlines,
    node: int,
    X_CN: np.ndarray,
    camera: np.ndarray,
    crossings: np.ndarray,
    rows: Rows,
) -> None:
    """Append the crossings of one surface's triangles that the near plane cuts.

    The facings of these triangles, and of those wholly nearer than the near plane, become 0, so
    that the caller skips them. Arguments as for ``add_surface``, with the surface's facings in
    ``rows``.
    """
    X, points = X_CN[node], packed.points
    begin, first = packed.starts[node, 0], packed.starts[node, 1]
    hidden = np.empty(packed.starts[node + 1, 0] - begin, dtype=np.bool_)
    for i in range(hidden.shape[0]):
        x, y, z = points[0, begin + i], points[1, begin + i], points[2, begin + i]
        hidden[i] = X[2, 0] * x + X[2, 1] * y + X[2, 2] * z + X[2, 3] < camera[5]
    corners = np.empty((4, 3))
    for t in range(packed.starts[node + 1, 1] - first):
        near_count = 0
        for k in range(3):
            near_count += hidden[packed.triangles[first + t, k]]
        # A plain integer, so that _walk_edge is not compiled for another type.
        weight = int(np.int64(rows.facings[t]))
        if near_count == 0 or weight == 0:
            continue
        rows.facings[t] = 0
        if near_count == 3:
            continue
        size = clip_triangle(packed, node, t, X_CN, camera, corners)
        for a in range(size):
            b = (a + 1) % size
            _walk_edge(
                corners[a, 0], corners[a, 1], corners[b, 0], corners[b, 1], weight,
                camera[6], camera[7], crossings, rows.counts, rows.row_range,
            )  # fmt: skip


@compiled
def add_surface(
    packed: PackedOutlines,
    node: int,
    X_CN: np.ndarray,
    camera: np.ndarray,
    crossings: np.ndarray,
    rows: Rows,
) -> None:
    """Append the crossings of one surface to the rows.

    Args:
        packed: the surfaces of all nodes, each in its node's frame N.
        node: index of the surface.
        X_CN: (nodes, 3, 4) poses of the nodes in the camera.
        camera: (8,) ``Camera.kernel_parameters()``.
        crossings: (height, capacity) int32 output, 8 * pixel + weight + BIAS. Crossings beyond the
            capacity are only counted, and ``rows.row_range[2]`` is set to 1.
        rows: scratch; ``counts`` and ``row_range`` are updated.
    """
    if packed.starts[node, 1] == packed.starts[node + 1, 1]:
        return
    cut = False
    if camera[0] == 0.0:
        X, ball = X_CN[node], packed.balls[node]
        depth = X[2, 0] * ball[0] + X[2, 1] * ball[1] + X[2, 2] * ball[2] + X[2, 3]
        radius = 1.000001 * ball[3]
        if depth + radius < camera[5]:
            return
        cut = depth - radius < camera[5]
    u, v, facings, edges = rows.u, rows.v, rows.facings, packed.edges
    place_surface(packed, node, X_CN, camera, u, v, facings)
    width, height, counts, row_range = camera[6], camera[7], rows.counts, rows.row_range
    if cut:
        _clip_near(packed, node, X_CN, camera, crossings, rows)
    ordinary_end = packed.ordinary_ends[node]
    for e in range(packed.starts[node, 2], ordinary_end):
        weight = int(facings[edges[2, e]]) - int(facings[edges[3, e]])
        if weight != 0:
            a, b = edges[0, e], edges[1, e]
            _walk_edge(u[a], v[a], u[b], v[b], weight, width, height, crossings, counts, row_range)
    for e in range(ordinary_end, packed.starts[node + 1, 2]):
        weight = int(facings[edges[2, e]]) + int(packed.sides[e]) * int(facings[edges[3, e]])
        if weight != 0:
            a, b = edges[0, e], edges[1, e]
            _walk_edge(u[a], v[a], u[b], v[b], weight, width, height, crossings, counts, row_range)


@compiled
def fill_rows(
    packed: PackedOutlines,
    first: int,
    end: int,
    X_CN: np.ndarray,
    camera: np.ndarray,
    crossings: np.ndarray,
    rows: Rows,
) -> np.ndarray:
    """Write the crossings of the surfaces with indices [first, end) into empty rows.

    The other arguments are those of ``add_surface``.

    Returns the crossings, reallocated until every row has room.
    """
    counts, row_range = rows.counts, rows.row_range
    while True:
        row_range[0], row_range[1], row_range[2] = counts.shape[0], 0, 0
        for node in range(first, end):
            add_surface(packed, node, X_CN, camera, crossings, rows)
        if row_range[2] == 0:
            return crossings
        max_count = 0
        for row in range(row_range[0], row_range[1]):
            max_count = max(max_count, counts[row])
            counts[row] = 0
        crossings = np.empty((counts.shape[0], 2 * max_count), dtype=np.int32)


@compiled(inline="always")
def find_spans(
    row: int, crossings: np.ndarray, counts: np.ndarray, changes: np.ndarray, spans: np.ndarray
) -> int:
    """Write one row's covered spans [a, b), and empty the row.

    Args:
        row: index of the row.
        crossings: (height, capacity) int32 crossings, 8 * pixel + weight + BIAS.
        counts: (height,) number of crossings of each row; the row's entry is set to 0.
        changes: (width + 1,) zeros, used as scratch.
        spans: (width + 1, 2) output, first columns and columns after the last.

    Returns the number of spans.
    """
    count = counts[row]
    counts[row] = 0
    if count == 2:
        first, second = crossings[row, 0] >> SHIFT, crossings[row, 1] >> SHIFT
        spans[0, 0] = min(first, second)
        spans[0, 1] = max(first, second)
        return int(first != second)
    return _find_many_spans(row, count, crossings, changes, spans)


@compiled
def _find_many_spans(
    row: int, count: int, crossings: np.ndarray, changes: np.ndarray, spans: np.ndarray
) -> int:
    """As ``find_spans``, for any number ``count`` of the row's crossings."""
    found, winding, start = 0, 0, 0
    if count <= 24:  # Few crossings are sorted; many are summed in a difference array.
        for i in range(1, count):
            crossing, k = crossings[row, i], i
            while k > 0 and crossings[row, k - 1] > crossing:
                crossings[row, k] = crossings[row, k - 1]
                k -= 1
            crossings[row, k] = crossing
        for k in range(count):
            pixel = crossings[row, k] >> SHIFT
            if winding == 0:
                start = pixel
            winding += (crossings[row, k] & 7) - BIAS
            if winding == 0 and pixel > start:
                spans[found, 0], spans[found, 1] = start, pixel
                found += 1
        return found
    lowest, highest = changes.shape[0] - 1, 0
    for k in range(count):
        pixel = crossings[row, k] >> SHIFT
        changes[pixel] += (crossings[row, k] & 7) - BIAS
        lowest, highest = min(lowest, pixel), max(highest, pixel)
    for pixel in range(lowest, highest + 1):
        change = changes[pixel]
        if change != 0:
            changes[pixel] = 0
            if winding == 0:
                start = pixel
            winding += change
            if winding == 0:
                spans[found, 0], spans[found, 1] = start, pixel
                found += 1
    return found


@compiled
def score(
    packed: PackedOutlines,
    parts: np.ndarray,
    bands: np.ndarray,
    X_CN: np.ndarray,
    camera: np.ndarray,
    prefixes: np.ndarray,
) -> np.ndarray:
    """Return the areas of a whole body at many poses, and of its intersections with pixel sets.

    Args:
        packed: the surfaces of the body's nodes; their bands are deformed in place.
        parts: (b, 4) int64 the skin bands, as in ``bend``; b may be 0.
        bands: (n, v, 3) all bands' vertices at each pose, in the frames of the bands' nodes [m].
        X_CN: (n, nodes, 3, 4) poses of the surfaces in the camera.
        camera: (8,) ``Camera.kernel_parameters()``.
        prefixes: (k, H, W + 1) int32 row-wise ``prefix_sums`` of the pixel sets' masks.

    Returns:
        (n, 1 + k) int64 area inside the image, then area of the intersection with each set [pixel].
    """
    rows, crossings = make_rows(packed, camera)
    areas = np.zeros((X_CN.shape[0], 1 + prefixes.shape[0]), dtype=np.int64)
    spans = rows.spans
    for n in range(X_CN.shape[0]):
        if parts.shape[0] > 0:
            bend(packed, parts, bands[n])
        crossings = fill_rows(packed, 0, X_CN.shape[1], X_CN[n], camera, crossings, rows)
        for row in range(rows.row_range[0], rows.row_range[1]):
            for k in range(find_spans(row, crossings, rows.counts, rows.changes, spans)):
                a, b = spans[k, 0], spans[k, 1]
                areas[n, 0] += b - a
                for s in range(prefixes.shape[0]):
                    areas[n, 1 + s] += prefixes[s, row, b] - prefixes[s, row, a]
    return areas


@compiled
def paint(
    packed: PackedOutlines, X_CN: np.ndarray, camera: np.ndarray, mask: np.ndarray, value: int
) -> np.ndarray:
    """Set the pixels of a body in a mask to a value.

    Args:
        packed: the surfaces of the body's nodes.
        X_CN: (nodes, 3, 4) poses of the nodes in the camera.
        camera: (8,) ``Camera.kernel_parameters()``.
        mask: (H, W) uint8, changed in place; pixels outside the body are kept.
        value: the value, 0 to 255.

    Returns (2,) int64 first row touched, and row after the last one.
    """
    rows, crossings = make_rows(packed, camera)
    crossings = fill_rows(packed, 0, X_CN.shape[0], X_CN, camera, crossings, rows)
    for row in range(rows.row_range[0], rows.row_range[1]):
        for k in range(find_spans(row, crossings, rows.counts, rows.changes, rows.spans)):
            mask[row, rows.spans[k, 0] : rows.spans[k, 1]] = value
    return rows.row_range[:2]


# Binary logarithm of the side [pixel] of tiles, which record where pixels are contested.
_TILE = 3


@compiled
def paint_labels(
    packed: PackedOutlines,
    labels: np.ndarray,
    closed: np.ndarray,
    X_CN: np.ndarray,
    camera: np.ndarray,
    empty: int,
    image: np.ndarray,
) -> None:
    """Draw the label of the nearest surface at each pixel centre into ``image`` (H, W) int16.

    Pixels that only one label covers are filled by spans. Only contested pixels need a depth test,
    for which triangles are rasterised.

    Args:
        packed: the surfaces of the body's nodes.
        labels: (nodes,) int16 non-negative labels, all different from ``empty``.
        closed: (nodes,) bool, whether a surface is closed with outward normals; only its front
            faces are then drawn.
        X_CN: (nodes, 3, 4) poses of the surfaces in the camera.
        camera: (8,) ``Camera.kernel_parameters()``.
        empty: label of pixels without a surface.
        image: (H, W) int16 output.
    """
    height, width = image.shape
    for row in range(height):
        for column in range(width):
            image[row, column] = empty
    # A pixel is contested if surfaces of different labels cover it; image then holds -1 - label.
    # sums: first marks of contested tiles, then their number above and left of each corner (the
    # first row and column stay zero). bounds: rows and columns [first, end) with contested pixels.
    sums = np.zeros(((height >> _TILE) + 2, (width >> _TILE) + 2), dtype=np.int32)
    bounds = np.array([height, 0, width, 0])
    rows, crossings = make_rows(packed, camera)
    for node in range(X_CN.shape[0]):
        label = labels[node]
        crossings = fill_rows(packed, node, node + 1, X_CN, camera, crossings, rows)
        for row in range(rows.row_range[0], rows.row_range[1]):
            for k in range(find_spans(row, crossings, rows.counts, rows.changes, rows.spans)):
                a, b, contested = rows.spans[k, 0], rows.spans[k, 1], False
                for column in range(a, b):
                    before = image[row, column]
                    differs = (before != empty) & (before != label)
                    image[row, column] = np.int16(-1 - label) if differs else label
                    contested |= differs
                if not contested:
                    continue
                bounds[0], bounds[1] = min(bounds[0], row), max(bounds[1], row + 1)
                for column in range(a, b):
                    if image[row, column] < 0:
                        sums[(row >> _TILE) + 1, (column >> _TILE) + 1] = 1
                        bounds[2], bounds[3] = min(bounds[2], column), max(bounds[3], column + 1)
    if bounds[0] >= bounds[1]:
        return
    for i in range(1, sums.shape[0]):
        along = 0
        for j in range(1, sums.shape[1]):
            along += sums[i, j]
            sums[i, j] = sums[i - 1, j] + along
    top, left = bounds[0], bounds[2]
    # Nearness of the surface drawn so far; infinite where a pixel is not contested.
    depths = np.empty((bounds[1] - top, bounds[3] - left), dtype=np.float32)
    for i in range(depths.shape[0]):
        for j in range(depths.shape[1]):
            depths[i, j] = -np.inf if image[top + i, left + j] < 0 else np.inf
    tiles = (sums, bounds, depths)
    for node in range(X_CN.shape[0]):
        _draw_node(packed, node, labels[node], closed[node], X_CN, camera, image, tiles, rows)
    for row in range(bounds[0], bounds[1]):
        for column in range(bounds[2], bounds[3]):
            if image[row, column] < 0:  # No triangle covers the pixel, because of rounding.
                image[row, column] = -1 - image[row, column]


@compiled
def _draw_node(
    packed: PackedOutlines, node: int, label: int, closed: bool, X_CN: np.ndarray,
    camera: np.ndarray, image: np.ndarray, contested: tuple[np.ndarray, np.ndarray, np.ndarray],
    rows: Rows,
) -> None:  # fmt: skip
    """Draw the label of one surface at the contested pixels where it is the nearest so far.

    Args:
        packed, node, X_CN, camera, rows: as for ``add_surface``.
        label: the surface's label.
        closed: whether it is closed with outward normals; then only front faces are drawn.
        image: (H, W) int16, changed in place.
        contested: number of contested tiles above and left of each tile corner, bounds (4,) of the
            contested pixels, and nearness of the surface drawn so far at each pixel in the bounds.
    """
    u, v, facings, X = rows.u, rows.v, rows.facings, X_CN[node]
    sums, bounds, depths = contested
    place_surface(packed, node, X_CN, camera, u, v, facings)
    begin = packed.starts[node, 0]
    count = packed.starts[node + 1, 0] - begin
    x, y, z = packed.points[0, begin:], packed.points[1, begin:], packed.points[2, begin:]
    nearness = np.empty(count)
    down, right = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.int32)
    height, width = image.shape
    lowest = np.inf
    for i in range(count):
        down[i] = int(min(max(v[i], 0.0), height - 1.0)) >> _TILE
        right[i] = int(min(max(u[i], 0.0), width - 1.0)) >> _TILE
        nearness[i] = X[2, 0] * x[i] + X[2, 1] * y[i] + X[2, 2] * z[i] + X[2, 3]
        lowest = min(lowest, nearness[i])
    parallel = camera[0] == 1.0
    whole = parallel or lowest >= camera[5]
    for i in range(count):
        nearness[i] = -nearness[i] if parallel else 1.0 / nearness[i]
    # The facings of a parallel camera have opposite signs: see viewpoint_in_node.
    hidden = 1 if parallel else -1
    corners = np.empty((4, 3))
    first = packed.starts[node, 1]
    for t in range(packed.starts[node + 1, 1] - first):
        if facings[t] == 0 or (closed and whole and facings[t] == hidden):
            continue
        size = 3
        if whole:
            a, b = packed.triangles[first + t, 0], packed.triangles[first + t, 1]
            c = packed.triangles[first + t, 2]
            above, below = min(down[a], down[b], down[c]), max(down[a], down[b], down[c]) + 1
            left = min(right[a], right[b], right[c])
            beside = max(right[a], right[b], right[c]) + 1
            if sums[below, beside] - sums[above, beside] == sums[below, left] - sums[above, left]:
                continue
            for k in range(3):
                i = packed.triangles[first + t, k]
                corners[k, 0], corners[k, 1], corners[k, 2] = u[i], v[i], nearness[i]
        else:
            size = clip_triangle(packed, node, t, X_CN, camera, corners)
        for k in range(2, size):
            # Nearness is linear in the image: 1 / z, or -z (parallel).
            ua, va, da = corners[0, 0], corners[0, 1], corners[0, 2]
            ub, vb, db = corners[k - 1, 0], corners[k - 1, 1], corners[k - 1, 2]
            uc, vc, dc = corners[k, 0], corners[k, 1], corners[k, 2]
            v_first, v_last = (
                max(min(va, vb, vc), float(bounds[0])),
                min(max(va, vb, vc), bounds[1] - 0.5),
            )
            u_first, u_last = (
                max(min(ua, ub, uc), float(bounds[2])),
                min(max(ua, ub, uc), bounds[3] - 0.5),
            )
            twice_area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
            if v_first <= v_last and u_first <= u_last and twice_area != 0.0:
                along_u = ((db - da) * (vc - va) - (dc - da) * (vb - va)) / twice_area
                along_v = ((dc - da) * (ub - ua) - (db - da) * (uc - ua)) / twice_area
                at_origin = da - ua * along_u - va * along_v
                nearest, farthest = max(da, db, dc), min(da, db, dc)
                # Sort corners downwards, so that common edges cross rows at equal places.
                if va > vb:
                    ua, va, ub, vb = ub, vb, ua, va
                if vb > vc:
                    ub, vb, uc, vc = uc, vc, ub, vb
                if va > vb:
                    ua, va, ub, vb = ub, vb, ua, va
                slope_long = (uc - ua) / (vc - va)
                slope_upper, slope_lower = (ub - ua) / (vb - va), (uc - ub) / (vc - vb)
                for row in range(math.ceil(v_first), min(math.ceil(vc), bounds[1])):
                    long = ua + (row - va) * slope_long
                    short = (
                        ua + (row - va) * slope_upper if row < vb else ub + (row - vb) * slope_lower
                    )
                    start = max(math.ceil(min(long, short)), bounds[2])
                    stop = min(math.ceil(max(long, short)), bounds[3])
                    at_row = at_origin + row * along_v
                    i = row - bounds[0]
                    for column in range(start, stop):
                        # Clamp, because the plane of a sliver is steep and amplifies rounding.
                        depth = np.float32(min(max(at_row + column * along_u, farthest), nearest))
                        if depth > depths[i, column - bounds[2]]:
                            depths[i, column - bounds[2]] = depth
                            image[row, column] = label
