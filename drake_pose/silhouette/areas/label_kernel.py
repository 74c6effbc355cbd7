"""The span kernel for label images: which of several surfaces each pixel shows.

The surfaces' spans are painted one after the other; triangles are drawn with a depth buffer only
where two labels contend. Both see the same pixels, as they begin and end a row alike.
"""

import math

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.areas.projection import clip_triangle, find_facings, project
from drake_pose.silhouette.areas.span_kernel import Rows, fill_rows, find_spans, make_rows

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
