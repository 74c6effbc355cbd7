"""The span kernel: exact areas of projected triangle surfaces without drawing them.

Every projected triangle is run around counter-clockwise as the picture shows it. The sum of these
closed curves winds around a point exactly as many times as triangles cover it, for any set of
triangles. Along an edge the runs of its triangles cancel except on the contour, so only contour
edges are walked: each leaves, in every row of pixel centres it crosses (half-open: a row on the
upper end counts, on the lower end does not), the first pixel to the right of the crossing and a
weight. Where the sum of weights along a row is not zero lies a span of covered pixels; the area of
a set under the span [a, b) is P[row, b] - P[row, a] with P the row's prefix sums.

A whole body is the crossings of all its surfaces in the same rows: an exact union.

Arrays are passed whole with an index where a slice would read better, and the innermost functions
take the few arrays they use or are inlined: numba pays for every slice and every array passed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.areas.viewpoint import viewpoint_in_node

# Crossings are kept as 8 * pixel + weight + 4; a weight is a whole number from -2 to 2.
_SHIFT = 3
_BIAS = 4
_FIRST_CAPACITY = 8
_LONGEST_SORT = 24


class _Work(NamedTuple):
    """What one body at one pose needs for a moment; made once a call.

    u, v: (points,) the projected points of one surface [pixel]; facings: (triangles + 1,) int8;
    counts: (height,) int32 the number of every row's crossings; reach: (3,) int64 first row
    touched, row after the last, whether a row had no room; changes: (width + 1,) int32 zeros;
    spans: (width + 1, 2) int32. The crossings (height, capacity) int32 travel beside it, because
    they are replaced when a row needs more room.
    """

    u: np.ndarray
    v: np.ndarray
    facings: np.ndarray
    counts: np.ndarray
    reach: np.ndarray
    changes: np.ndarray
    spans: np.ndarray


@compiled
def _make_work(packed: PackedOutlines, camera: np.ndarray) -> _Work:
    """Returns room for the greatest of some surfaces."""
    width, height = int(camera[6]), int(camera[7])
    points, triangles = 0, 0
    for node in range(packed.starts.shape[0] - 1):
        points = max(points, packed.starts[node + 1, 0] - packed.starts[node, 0])
        triangles = max(triangles, packed.starts[node + 1, 1] - packed.starts[node, 1])
    return _Work(
        np.empty(points),
        np.empty(points),
        np.empty(triangles + 1, dtype=np.int8),
        np.zeros(height, dtype=np.int32),
        np.zeros(3, dtype=np.int64),
        np.zeros(width + 1, dtype=np.int32),
        np.empty((width + 1, 2), dtype=np.int32),
    )


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
    mark = weight + _BIAS
    for row in range(first, end):
        u = ua + (row - va) * slope
        # Beyond the picture's sides all places are one; no float is too large for this test.
        pixel = math.ceil(u) if 0.0 < u < width else (0 if u < width else columns)
        count = counts[row]
        if count < capacity:
            crossings[row, count] = (pixel << _SHIFT) + mark
        else:
            reach[2] = 1
        counts[row] = count + 1


@compiled
def _project(
    packed: PackedOutlines, node: int, X_CN: np.ndarray, camera: np.ndarray, work: _Work
) -> None:
    """Projects the points of one surface to u, v."""
    fx, fy, cx, cy = camera[1], camera[2], camera[3], camera[4]
    begin, end = packed.starts[node, 0], packed.starts[node + 1, 0]
    x, y = packed.points[0, begin:end], packed.points[1, begin:end]
    z = packed.points[2, begin:end]
    u, v = work.u, work.v
    X = X_CN[node]
    a0, a1, a2, a3 = fx * X[0, 0], fx * X[0, 1], fx * X[0, 2], fx * X[0, 3]
    b0, b1, b2, b3 = fy * X[1, 0], fy * X[1, 1], fy * X[1, 2], fy * X[1, 3]
    if camera[0] == 1.0:
        a3, b3 = a3 + cx, b3 + cy
        for i in range(x.shape[0]):
            u[i] = a0 * x[i] + a1 * y[i] + a2 * z[i] + a3
            v[i] = b0 * x[i] + b1 * y[i] + b2 * z[i] + b3
        return
    d0, d1, d2, d3 = X[2, 0], X[2, 1], X[2, 2], X[2, 3]
    for i in range(x.shape[0]):
        inverse = 1.0 / (d0 * x[i] + d1 * y[i] + d2 * z[i] + d3)
        u[i] = (a0 * x[i] + a1 * y[i] + a2 * z[i] + a3) * inverse + cx
        v[i] = (b0 * x[i] + b1 * y[i] + b2 * z[i] + b3) * inverse + cy


@compiled
def _find_facings(
    packed: PackedOutlines, node: int, X_CN: np.ndarray, camera: np.ndarray, work: _Work
) -> None:
    """Writes which side of each triangle the camera sees: +1, 0 or -1; 0 after the last."""
    e0, e1, e2, share = viewpoint_in_node(X_CN[node], camera)
    begin, end = packed.starts[node, 1], packed.starts[node + 1, 1]
    n0, n1 = packed.planes[0, begin:end], packed.planes[1, begin:end]
    n2, offset = packed.planes[2, begin:end], packed.planes[3, begin:end]
    facings = work.facings
    for i in range(n0.shape[0]):
        side = n0[i] * e0 + n1[i] * e1 + n2[i] * e2 - offset[i] * share
        facings[i] = np.int8(side > 0.0) - np.int8(side < 0.0)
    facings[n0.shape[0]] = 0


@compiled
def _walk_clipped(
    corners: np.ndarray, weight: int, camera: np.ndarray, crossings: np.ndarray, work: _Work
) -> None:
    """Walks the part of one triangle (3, 3) [m, camera frame] beyond the near plane."""
    fx, fy, cx, cy, near = camera[1], camera[2], camera[3], camera[4], camera[5]
    width, height, counts, reach = camera[6], camera[7], work.counts, work.reach
    pu, pv, size = np.empty(4), np.empty(4), 0
    for a in range(3):
        b = (a + 1) % 3
        visible = corners[a, 2] >= near
        if visible:
            pu[size] = fx * corners[a, 0] / corners[a, 2] + cx
            pv[size] = fy * corners[a, 1] / corners[a, 2] + cy
            size += 1
        if visible != (corners[b, 2] >= near):
            # From the visible end to the hidden one, whichever way the triangle runs.
            i, o = (a, b) if visible else (b, a)
            share = (near - corners[i, 2]) / (corners[o, 2] - corners[i, 2])
            x = corners[i, 0] + share * (corners[o, 0] - corners[i, 0])
            y = corners[i, 1] + share * (corners[o, 1] - corners[i, 1])
            pu[size] = fx * x / near + cx
            pv[size] = fy * y / near + cy
            size += 1
    for a in range(size):
        b = (a + 1) % size
        _walk_edge(pu[a], pv[a], pu[b], pv[b], weight, width, height, crossings, counts, reach)


@compiled
def _clip_near(
    packed: PackedOutlines,
    node: int,
    X_CN: np.ndarray,
    camera: np.ndarray,
    crossings: np.ndarray,
    work: _Work,
) -> None:
    """Takes triangles nearer than the near plane out of facings, and walks those it cuts."""
    near, X, points = camera[5], X_CN[node], packed.points
    begin, first = packed.starts[node, 0], packed.starts[node, 1]
    hidden = np.empty(packed.starts[node + 1, 0] - begin, dtype=np.bool_)
    for i in range(hidden.shape[0]):
        x, y, z = points[0, begin + i], points[1, begin + i], points[2, begin + i]
        hidden[i] = X[2, 0] * x + X[2, 1] * y + X[2, 2] * z + X[2, 3] < near
    corners = np.empty((3, 3))
    for t in range(packed.starts[node + 1, 1] - first):
        lost = 0
        for k in range(3):
            lost += hidden[packed.triangles[first + t, k]]
        if lost == 0:
            continue
        facing = int(work.facings[t])
        work.facings[t] = 0
        if lost == 3 or facing == 0:
            continue
        for k in range(3):
            i = begin + packed.triangles[first + t, k]
            x, y, z = points[0, i], points[1, i], points[2, i]
            for j in range(3):
                corners[k, j] = X[j, 0] * x + X[j, 1] * y + X[j, 2] * z + X[j, 3]
        _walk_clipped(corners, facing, camera, crossings, work)


@compiled
def _walk_contour(
    packed: PackedOutlines, node: int, camera: np.ndarray, crossings: np.ndarray, work: _Work
) -> None:
    """Walks the contour edges of one projected surface."""
    width, height, counts, reach = camera[6], camera[7], work.counts, work.reach
    u, v, facings, edges = work.u, work.v, work.facings, packed.edges
    begin, end = packed.starts[node, 2], packed.starts[node + 1, 2]
    ordinary_end = packed.ordinary_ends[node]
    for e in range(begin, ordinary_end):
        weight = int(facings[edges[2, e]]) - int(facings[edges[3, e]])
        if weight != 0:
            a, b = edges[0, e], edges[1, e]
            _walk_edge(u[a], v[a], u[b], v[b], weight, width, height, crossings, counts, reach)
    for e in range(ordinary_end, end):
        weight = int(facings[edges[2, e]]) + int(packed.sides[e]) * int(facings[edges[3, e]])
        if weight != 0:
            a, b = edges[0, e], edges[1, e]
            _walk_edge(u[a], v[a], u[b], v[b], weight, width, height, crossings, counts, reach)


@compiled
def _fill_rows(
    packed: PackedOutlines, X_CN: np.ndarray, camera: np.ndarray, crossings: np.ndarray, work: _Work
) -> None:
    """Leaves the crossings of a whole body at poses X_CN (nodes, 3, 4) in the rows."""
    work.reach[0], work.reach[1], work.reach[2] = int(camera[7]), 0, 0
    for node in range(X_CN.shape[0]):
        if packed.starts[node, 1] == packed.starts[node + 1, 1]:
            continue
        cut = False
        if camera[0] == 0.0:
            X, ball = X_CN[node], packed.balls[node]
            depth = X[2, 0] * ball[0] + X[2, 1] * ball[1] + X[2, 2] * ball[2] + X[2, 3]
            radius = 1.000001 * ball[3]
            if depth + radius < camera[5]:
                continue
            cut = depth - radius < camera[5]
        _project(packed, node, X_CN, camera, work)
        _find_facings(packed, node, X_CN, camera, work)
        if cut:
            _clip_near(packed, node, X_CN, camera, crossings, work)
        _walk_contour(packed, node, camera, crossings, work)


@compiled
def _fill_safely(
    packed: PackedOutlines, X_CN: np.ndarray, camera: np.ndarray, crossings: np.ndarray, work: _Work
) -> np.ndarray:
    """As _fill_rows, and returns the crossings, made wider until every row has room."""
    _fill_rows(packed, X_CN, camera, crossings, work)
    while work.reach[2] != 0:
        most = 0
        for row in range(work.reach[0], work.reach[1]):
            most = max(most, work.counts[row])
            work.counts[row] = 0
        crossings = np.empty((work.counts.shape[0], 2 * most), dtype=np.int32)
        _fill_rows(packed, X_CN, camera, crossings, work)
    return crossings


@compiled(inline="always")
def _find_spans(
    row: int, crossings: np.ndarray, counts: np.ndarray, changes: np.ndarray, spans: np.ndarray
) -> int:
    """Writes one row's covered spans [a, b), empties the row, and returns the spans' number."""
    count = counts[row]
    counts[row] = 0
    if count == 2:
        one, other = crossings[row, 0] >> _SHIFT, crossings[row, 1] >> _SHIFT
        spans[0, 0] = min(one, other)
        spans[0, 1] = max(one, other)
        return int(one != other)
    if count > _LONGEST_SORT:
        return _find_many_spans(row, count, crossings, changes, spans)
    return _find_some_spans(row, count, crossings, spans)


@compiled
def _find_some_spans(row: int, count: int, crossings: np.ndarray, spans: np.ndarray) -> int:
    """As _find_spans by sorting the row's crossings."""
    for i in range(1, count):
        moving, k = crossings[row, i], i
        while k > 0 and crossings[row, k - 1] > moving:
            crossings[row, k] = crossings[row, k - 1]
            k -= 1
        crossings[row, k] = moving
    found, winding, start = 0, 0, 0
    for k in range(count):
        pixel = crossings[row, k] >> _SHIFT
        if winding == 0:
            start = pixel
        winding += (crossings[row, k] & 7) - _BIAS
        if winding == 0 and pixel > start:
            spans[found, 0] = start
            spans[found, 1] = pixel
            found += 1
    return found


@compiled
def _find_many_spans(
    row: int, count: int, crossings: np.ndarray, changes: np.ndarray, spans: np.ndarray
) -> int:
    """As _find_spans by passing along the row, where sorting many crossings would take longer."""
    lowest, highest = changes.shape[0] - 1, 0
    for k in range(count):
        pixel = crossings[row, k] >> _SHIFT
        changes[pixel] += (crossings[row, k] & 7) - _BIAS
        lowest, highest = min(lowest, pixel), max(highest, pixel)
    found, winding, start = 0, 0, 0
    for pixel in range(lowest, highest + 1):
        change = changes[pixel]
        if change != 0:
            changes[pixel] = 0
            if winding == 0:
                start = pixel
            winding += change
            if winding == 0:
                spans[found, 0] = start
                spans[found, 1] = pixel
                found += 1
    return found


@compiled
def _add_areas(work: _Work, crossings: np.ndarray, prefixes: np.ndarray, areas: np.ndarray) -> None:
    """Adds the area of a filled body, and of its intersection with each set, to areas (1 + k,)."""
    spans = work.spans
    for row in range(work.reach[0], work.reach[1]):
        for k in range(_find_spans(row, crossings, work.counts, work.changes, spans)):
            a, b = spans[k, 0], spans[k, 1]
            areas[0] += b - a
            for s in range(prefixes.shape[0]):
                areas[1 + s] += prefixes[s, row, b] - prefixes[s, row, a]


@compiled
def score(
    packed: PackedOutlines, X_CN: np.ndarray, camera: np.ndarray, prefixes: np.ndarray
) -> np.ndarray:
    """Areas of whole bodies, and of their intersections with sets.

    Args:
        packed: the body's surfaces.
        X_CN: (n, nodes, 3, 4) their poses in the camera.
        camera: (8,) kernel parameters of the camera.
        prefixes: (k, H, W + 1) int32 prefix sums of the sets.

    Returns:
        (n, 1 + k) int64 area inside the picture, then area of intersection with each set [pixel].
    """
    work = _make_work(packed, camera)
    crossings = np.empty((int(camera[7]), _FIRST_CAPACITY), dtype=np.int32)
    areas = np.zeros((X_CN.shape[0], 1 + prefixes.shape[0]), dtype=np.int64)
    for n in range(X_CN.shape[0]):
        crossings = _fill_safely(packed, X_CN[n], camera, crossings, work)
        _add_areas(work, crossings, prefixes, areas[n])
    return areas


@compiled
def paint(
    packed: PackedOutlines, X_CN: np.ndarray, camera: np.ndarray, mask: np.ndarray, value: int
) -> np.ndarray:
    """Sets the pixels of a body at poses X_CN (nodes, 3, 4) in mask (H, W) uint8 to value.

    Returns:
        (2,) int64 first row touched, and the row after the last.
    """
    work = _make_work(packed, camera)
    crossings = np.empty((int(camera[7]), _FIRST_CAPACITY), dtype=np.int32)
    crossings = _fill_safely(packed, X_CN, camera, crossings, work)
    spans = work.spans
    for row in range(work.reach[0], work.reach[1]):
        for k in range(_find_spans(row, crossings, work.counts, work.changes, spans)):
            mask[row, spans[k, 0] : spans[k, 1]] = value
    return work.reach[:2]
