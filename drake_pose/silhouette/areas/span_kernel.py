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
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.areas.projection import bend, clip_triangle, find_facings, project

SHIFT, BIAS = 3, 4
"""A crossing is kept as 8 * pixel + weight + BIAS; a weight is a whole number from -2 to 2."""

_FIRST_CAPACITY = 8
_LONGEST_SORT = 24


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
    return rows, np.empty((height, _FIRST_CAPACITY), dtype=np.int32)


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
    if count <= _LONGEST_SORT:
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
