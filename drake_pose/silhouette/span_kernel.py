"""The span kernel: exact areas of projected triangle surfaces without drawing them.

Every projected triangle is run around counter-clockwise as the picture shows it. The sum of these
closed curves winds around a point exactly as many times as triangles cover it, for any set of
triangles. Along an edge the runs of its triangles cancel except on the contour, so only contour
edges are walked: each leaves, in every row of pixel centres it crosses (half-open: a row on the
upper end counts, on the lower end does not), the first pixel to the right of the crossing and a
weight. Where the sum of weights along a row is not zero lies a span of covered pixels; the area of
a set under the span [a, b) is P[row, b] - P[row, a] with P the row's prefix sums. The crossings of
all surfaces in the same rows give the exact union.

Numba pays for every slice and every array passed: arrays are passed whole, with an index.
"""

import math
from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.silhouette.outline import PackedOutlines, bend, clip_triangle, find_facings, project

SHIFT, BIAS = 3, 4
"""A crossing is kept as 8 * pixel + weight + BIAS; a weight is a whole number from -2 to 2."""


class Rows(NamedTuple):
    """What one body at one pose needs for a moment; made once a call.

    u, v: (points,) the projected points of one surface [pixel]; facings: (triangles + 1,) int8;
    counts: (height,) int32 the number of every row's crossings; reach: (3,) int64 first row
    touched, row after the last, whether a row had no room; changes: (width + 1,) int32 zeros;
    spans: (width + 1, 2) int32.
    """

    u: np.ndarray
    v: np.ndarray
    facings: np.ndarray
    counts: np.ndarray
    reach: np.ndarray
    changes: np.ndarray
    spans: np.ndarray


@compiled
def make_rows(packed: PackedOutlines, camera: np.ndarray) -> tuple[Rows, np.ndarray]:
    """Room for the greatest of some surfaces, and for crossings (height, capacity)."""
    width, height = int(camera[6]), int(camera[7])
    points, triangles = 0, 0
    for node in range(packed.starts.shape[0] - 1):
        points = max(points, packed.starts[node + 1, 0] - packed.starts[node, 0])
        triangles = max(triangles, packed.starts[node + 1, 1] - packed.starts[node, 1])
    rows = Rows(
        np.empty(points),
        np.empty(points),
        np.empty(triangles + 1, dtype=np.int8),
        np.zeros(height, dtype=np.int32),
        np.array([height, 0, 0]),
        np.zeros(width + 1, dtype=np.int32),
        np.empty((width + 1, 2), dtype=np.int32),
    )
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
    reach: np.ndarray,
) -> None:
    """Leaves the crossings of the edge from a to b in the rows."""
    if va > vb:  # always downwards, so that both runs of an edge cross at the very same places
        ua, va, ub, vb = ub, vb, ua, va
        weight = -weight
    if not (vb > 0.0 and va <= height - 1.0):
        return
    first = math.ceil(max(va, 0.0))
    end = math.ceil(min(vb, height))
    if first >= end:
        return
    reach[0] = min(reach[0], first)
    reach[1] = max(reach[1], end)
    capacity = crossings.shape[1]
    columns = int(width)
    slope = (ub - ua) / (vb - va)
    mark = weight + BIAS
    for row in range(first, end):
        u = ua + (row - va) * slope
        # Beyond the picture's sides all places are one; no float is too large for this test.
        pixel = math.ceil(u) if 0.0 < u < width else (0 if u < width else columns)
        count = counts[row]
        if count < capacity:
            crossings[row, count] = (pixel << SHIFT) + mark
        else:
            reach[2] = 1
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
    """Takes triangles nearer than the near plane out of facings, and walks those it cuts."""
    X, points = X_CN[node], packed.points
    begin, first = packed.starts[node, 0], packed.starts[node, 1]
    hidden = np.empty(packed.starts[node + 1, 0] - begin, dtype=np.bool_)
    for i in range(hidden.shape[0]):
        x, y, z = points[0, begin + i], points[1, begin + i], points[2, begin + i]
        hidden[i] = X[2, 0] * x + X[2, 1] * y + X[2, 2] * z + X[2, 3] < camera[5]
    corners = np.empty((4, 3))
    for t in range(packed.starts[node + 1, 1] - first):
        lost = 0
        for k in range(3):
            lost += hidden[packed.triangles[first + t, k]]
        # As a plain integer, or the kernel that walks is compiled once more.
        weight = int(np.int64(rows.facings[t]))
        if lost == 0 or weight == 0:
            continue
        rows.facings[t] = 0
        if lost == 3:
            continue
        size = clip_triangle(packed, node, t, X_CN, camera, corners)
        for a in range(size):
            b = (a + 1) % size
            _walk_edge(
                corners[a, 0], corners[a, 1], corners[b, 0], corners[b, 1], weight,
                camera[6], camera[7], crossings, rows.counts, rows.reach,
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
    """Leaves the crossings of one surface at poses X_CN (nodes, 3, 4) in the rows."""
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
    project(packed, node, X_CN, camera, u, v)
    find_facings(packed, node, X_CN, camera, facings)
    if cut:
        _clip_near(packed, node, X_CN, camera, crossings, rows)
    width, height, counts, reach = camera[6], camera[7], rows.counts, rows.reach
    ordinary_end = packed.ordinary_ends[node]
    for e in range(packed.starts[node, 2], ordinary_end):
        weight = int(facings[edges[2, e]]) - int(facings[edges[3, e]])
        if weight != 0:
            a, b = edges[0, e], edges[1, e]
            _walk_edge(u[a], v[a], u[b], v[b], weight, width, height, crossings, counts, reach)
    for e in range(ordinary_end, packed.starts[node + 1, 2]):
        weight = int(facings[edges[2, e]]) + int(packed.sides[e]) * int(facings[edges[3, e]])
        if weight != 0:
            a, b = edges[0, e], edges[1, e]
            _walk_edge(u[a], v[a], u[b], v[b], weight, width, height, crossings, counts, reach)


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
    """Leaves the crossings of surfaces first to end at poses X_CN (nodes, 3, 4) in empty rows.

    Returns the crossings, made wider until every row had room.
    """
    counts, reach = rows.counts, rows.reach
    while True:
        reach[0], reach[1], reach[2] = counts.shape[0], 0, 0
        for node in range(first, end):
            add_surface(packed, node, X_CN, camera, crossings, rows)
        if reach[2] == 0:
            return crossings
        most = 0
        for row in range(reach[0], reach[1]):
            most = max(most, counts[row])
            counts[row] = 0
        crossings = np.empty((counts.shape[0], 2 * most), dtype=np.int32)


@compiled(inline="always")
def find_spans(
    row: int, crossings: np.ndarray, counts: np.ndarray, changes: np.ndarray, spans: np.ndarray
) -> int:
    """Writes one row's covered spans [a, b), empties the row, and returns the spans' number."""
    count = counts[row]
    counts[row] = 0
    if count == 2:
        one, other = crossings[row, 0] >> SHIFT, crossings[row, 1] >> SHIFT
        spans[0, 0] = min(one, other)
        spans[0, 1] = max(one, other)
        return int(one != other)
    return _find_many_spans(row, count, crossings, changes, spans)


@compiled
def _find_many_spans(
    row: int, count: int, crossings: np.ndarray, changes: np.ndarray, spans: np.ndarray
) -> int:
    """As find_spans for any number of crossings."""
    found, winding, start = 0, 0, 0
    if count <= 24:  # Few are sorted.
        for i in range(1, count):
            moving, k = crossings[row, i], i
            while k > 0 and crossings[row, k - 1] > moving:
                crossings[row, k] = crossings[row, k - 1]
                k -= 1
            crossings[row, k] = moving
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
    """Areas of whole bodies, and of their intersections with sets.

    Args:
        packed: the surfaces, whose bands are bent in place.
        parts: (b, 4) int64 the bands of skin, as in ``bend``; b may be 0.
        bands: (n, v, 3) the vertices of all bands, one band after the other, at each pose [m].
        X_CN: (n, nodes, 3, 4) the surfaces' poses in the camera.
        prefixes: (k, H, W + 1) int32 prefix sums of the sets.

    Returns:
        (n, 1 + k) int64 area inside the picture, then area of intersection with each set [pixel].
    """
    rows, crossings = make_rows(packed, camera)
    areas = np.zeros((X_CN.shape[0], 1 + prefixes.shape[0]), dtype=np.int64)
    spans = rows.spans
    for n in range(X_CN.shape[0]):
        if parts.shape[0] > 0:
            bend(packed, parts, bands[n])
        crossings = fill_rows(packed, 0, X_CN.shape[1], X_CN[n], camera, crossings, rows)
        for row in range(rows.reach[0], rows.reach[1]):
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
    """Sets the pixels of a body at poses X_CN (nodes, 3, 4) in mask (H, W) uint8 to value.

    Returns (2,) int64 the first row touched, and the row after the last.
    """
    rows, crossings = make_rows(packed, camera)
    crossings = fill_rows(packed, 0, X_CN.shape[0], X_CN, camera, crossings, rows)
    for row in range(rows.reach[0], rows.reach[1]):
        for k in range(find_spans(row, crossings, rows.counts, rows.changes, rows.spans)):
            mask[row, rows.spans[k, 0] : rows.spans[k, 1]] = value
    return rows.reach[:2]


# Contested pixels are noted by tiles of 8 x 8, too: most triangles are far from any.
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
    """Draws which surface is nearest at each pixel centre into image (H, W) int16.

    Args:
        labels: (nodes,) int16 their labels, not negative, none of them the empty one.
        closed: (nodes,) bool which of them are closed and have their triangles run around
            counter-clockwise seen from outside: only what is turned to the camera is drawn.
        X_CN: (nodes, 3, 4) their poses in the camera.
        empty: the label of pixels that show none.
    """
    height, width = image.shape
    for row in range(height):
        for column in range(width):
            image[row, column] = empty
    # Of pixels for which surfaces of different labels contend, -1 - label in the image: by tiles,
    # then how many tiles above and left of each (the first row and column stay zero), and the rows
    # and columns [first, end) that hold them.
    sums = np.zeros(((height >> _TILE) + 2, (width >> _TILE) + 2), dtype=np.int32)
    bounds = np.array([height, 0, width, 0])
    rows, crossings = make_rows(packed, camera)
    for node in range(X_CN.shape[0]):
        crossings = fill_rows(packed, node, node + 1, X_CN, camera, crossings, rows)
        for row in range(rows.reach[0], rows.reach[1]):
            for k in range(find_spans(row, crossings, rows.counts, rows.changes, rows.spans)):
                a, b = rows.spans[k, 0], rows.spans[k, 1]
                _paint_span(image, row, a, b, labels[node], empty, sums, bounds)
    if bounds[0] >= bounds[1]:
        return
    for i in range(1, sums.shape[0]):
        along = 0
        for j in range(1, sums.shape[1]):
            along += sums[i, j]
            sums[i, j] = sums[i - 1, j] + along
    top, left = bounds[0], bounds[2]
    # How near what is drawn so far is, infinite where nothing contends.
    depths = np.empty((bounds[1] - top, bounds[3] - left), dtype=np.float32)
    for i in range(depths.shape[0]):
        for j in range(depths.shape[1]):
            depths[i, j] = -np.inf if image[top + i, left + j] < 0 else np.inf
    contest = (sums, bounds, depths)
    for node in range(X_CN.shape[0]):
        _draw_node(packed, node, labels[node], closed[node], X_CN, camera, image, contest, rows)
    for row in range(bounds[0], bounds[1]):
        for column in range(bounds[2], bounds[3]):
            if image[row, column] < 0:  # By rounding no triangle covers it.
                image[row, column] = -1 - image[row, column]


@compiled
def _paint_span(
    image: np.ndarray,
    row: int,
    a: int,
    b: int,
    label: int,
    empty: int,
    tiles: np.ndarray,
    bounds: np.ndarray,
) -> None:
    """Writes a label to a row's pixels [a, b), and 1 to the tiles of those that had another."""
    met = False
    for column in range(a, b):
        before = image[row, column]
        other = (before != empty) & (before != label)
        image[row, column] = np.int16(-1 - label) if other else np.int16(label)
        met |= other
    if not met:
        return
    while image[row, a] >= 0:
        a += 1
    while image[row, b - 1] >= 0:
        b -= 1
    for column in range(a, b):
        if image[row, column] < 0:
            tiles[(row >> _TILE) + 1, (column >> _TILE) + 1] = 1
    bounds[0], bounds[1] = min(bounds[0], row), max(bounds[1], row + 1)
    bounds[2], bounds[3] = min(bounds[2], a), max(bounds[3], b)


@compiled
def _draw_node(
    packed: PackedOutlines,
    node: int,
    label: int,
    closed: bool,
    X_CN: np.ndarray,
    camera: np.ndarray,
    image: np.ndarray,
    contest: tuple[np.ndarray, np.ndarray, np.ndarray],
    rows: Rows,
) -> None:
    """Draws the triangles of one surface where pixels are contested."""
    u, v, facings, X, sums = rows.u, rows.v, rows.facings, X_CN[node], contest[0]
    project(packed, node, X_CN, camera, u, v)
    find_facings(packed, node, X_CN, camera, facings)
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
    # Where rays are parallel, facings tell the way that the camera looks: they have opposite signs.
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
            _draw_triangle(corners, k - 1, k, label, image, contest[1], contest[2])


@compiled(inline="always")
def _draw_triangle(
    p: np.ndarray,
    b: int,
    c: int,
    label: int,
    image: np.ndarray,
    bounds: np.ndarray,
    depths: np.ndarray,
) -> None:
    """Draws the triangle 0, b, c of points p (n, 3) of pixel and nearness where it contends."""
    # Nearness grows towards the camera and is linear in the picture: 1 / z, or -z (parallel).
    ua, va, da = p[0, 0], p[0, 1], p[0, 2]
    ub, vb, db = p[b, 0], p[b, 1], p[b, 2]
    uc, vc, dc = p[c, 0], p[c, 1], p[c, 2]
    top, bottom = max(min(va, vb, vc), float(bounds[0])), min(max(va, vb, vc), bounds[1] - 0.5)
    left, right = max(min(ua, ub, uc), float(bounds[2])), min(max(ua, ub, uc), bounds[3] - 0.5)
    twice_area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
    if top <= bottom and left <= right and twice_area != 0.0:
        along_u = ((db - da) * (vc - va) - (dc - da) * (vb - va)) / twice_area
        along_v = ((dc - da) * (ub - ua) - (db - da) * (uc - ua)) / twice_area
        at_origin = da - ua * along_u - va * along_v
        nearest, farthest = max(da, db, dc), min(da, db, dc)
        # From top to bottom, so that neighbours' common edges cross rows at the very same places.
        if va > vb:
            ua, va, ub, vb = ub, vb, ua, va
        if vb > vc:
            ub, vb, uc, vc = uc, vc, ub, vb
        if va > vb:
            ua, va, ub, vb = ub, vb, ua, va
        slope_long = (uc - ua) / (vc - va)
        slope_upper, slope_lower = (ub - ua) / (vb - va), (uc - ub) / (vc - vb)
        for row in range(math.ceil(top), min(math.ceil(vc), bounds[1])):
            one = ua + (row - va) * slope_long
            other = ua + (row - va) * slope_upper if row < vb else ub + (row - vb) * slope_lower
            start = max(math.ceil(min(one, other)), bounds[2])
            stop = min(math.ceil(max(one, other)), bounds[3])
            at_row = at_origin + row * along_v
            i, first = row - bounds[0], bounds[2]
            for column in range(start, stop):
                # A sliver's plane is steep: rounding must not carry it beyond its corners.
                depth = np.float32(min(max(at_row + column * along_u, farthest), nearest))
                if depth > depths[i, column - first]:
                    depths[i, column - first] = depth
                    image[row, column] = label
