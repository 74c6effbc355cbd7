"""The span kernel for label images: which of several surfaces each pixel shows.

The surfaces' spans are painted one after the other. Only pixels that two surfaces of different
labels cover need depths: there the triangles are drawn with a depth buffer. Both see the same
pixels, as a triangle's rows begin and end where the span kernel's crossings do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.areas.span_kernel import (
    _FIRST_CAPACITY,
    _fill_safely,
    _find_facings,
    _find_spans,
    _make_work,
    _project,
    _Work,
)

# Contested pixels are noted by tiles of 8 x 8, too: most triangles are far from any.
_TILE = 3


class _Contest(NamedTuple):
    """The pixels for which surfaces of different labels contend, until depths have decided.

    In the image such a pixel is -1 - label. sums: (H / 8 + 2, W / 8 + 2) int32 how many tiles above
    and left of each hold some; bounds: (4,) int64 the rows [first, end) and the columns
    [first, end) that hold them; depths: (rows, columns) float32 of these, how near what is drawn so
    far is, infinite where nothing contends.
    """

    sums: np.ndarray
    bounds: np.ndarray
    depths: np.ndarray


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
    """Draws which surface is nearest at each pixel centre.

    Args:
        packed: the surfaces.
        labels: (nodes,) int16 their labels, not negative, none of them the empty one.
        closed: (nodes,) bool which of them are closed and have their triangles run around
            counter-clockwise seen from outside: only what is turned to the camera is drawn.
        X_CN: (nodes, 3, 4) their poses in the camera.
        camera: (8,) kernel parameters of the camera.
        empty: the label of pixels that show none.
        image: (H, W) int16, written.
    """
    height, width = image.shape
    for row in range(height):
        for column in range(width):
            image[row, column] = empty
    # The first row and column stay zero, for sums.
    tiles = np.zeros(((height >> _TILE) + 2, (width >> _TILE) + 2), dtype=np.int32)
    bounds = np.array([height, 0, width, 0])
    boxes = np.zeros((X_CN.shape[0], 4), dtype=np.int64)
    work = _make_work(packed, camera)
    _paint_spans(packed, labels, X_CN, camera, empty, image, tiles, bounds, boxes, work)
    if bounds[0] >= bounds[1]:
        return
    for i in range(1, tiles.shape[0]):
        along = 0
        for j in range(1, tiles.shape[1]):
            along += tiles[i, j]
            tiles[i, j] = tiles[i - 1, j] + along
    contest = _Contest(tiles, bounds, _begin_depths(image, bounds))
    for node in range(X_CN.shape[0]):
        box = boxes[node]
        top, bottom = box[0] >> _TILE, (box[1] - 1) >> _TILE
        left, right = box[2] >> _TILE, (box[3] - 1) >> _TILE
        if box[0] < box[1] and _is_contested(tiles, top, bottom, left, right):
            _draw_node(packed, node, labels[node], closed[node], X_CN, camera, image, contest, work)
    for row in range(bounds[0], bounds[1]):
        for column in range(bounds[2], bounds[3]):
            if image[row, column] < 0:  # By rounding no triangle covers it.
                image[row, column] = -1 - image[row, column]


@compiled
def _paint_spans(
    packed: PackedOutlines,
    labels: np.ndarray,
    X_CN: np.ndarray,
    camera: np.ndarray,
    empty: int,
    image: np.ndarray,
    tiles: np.ndarray,
    bounds: np.ndarray,
    boxes: np.ndarray,
    work: _Work,
) -> None:
    """Paints all surfaces, and marks where they contend.

    Writes the rows and columns (first, after the last, first, after the last) of each surface to
    boxes (nodes, 4). Adds 1 to tiles where there are contested pixels.
    """
    crossings = np.empty((int(camera[7]), _FIRST_CAPACITY), dtype=np.int32)
    spans = work.spans
    for node in range(X_CN.shape[0]):
        one = PackedOutlines(
            packed.points,
            packed.planes,
            packed.balls[node : node + 1],
            packed.triangles,
            packed.edges,
            packed.sides,
            packed.starts[node : node + 2],
            packed.ordinary_ends[node : node + 1],
        )
        crossings = _fill_safely(one, X_CN[node : node + 1], camera, crossings, work)
        first, last = image.shape[1], 0
        for row in range(work.reach[0], work.reach[1]):
            for k in range(_find_spans(row, crossings, work.counts, work.changes, spans)):
                a, b = spans[k, 0], spans[k, 1]
                first, last = min(first, a), max(last, b)
                if _paint_span(image[row], a, b, labels[node], empty):
                    _note_contested(image, row, a, b, tiles, bounds)
        if first < last:
            boxes[node, 0], boxes[node, 1] = work.reach[0], work.reach[1]
            boxes[node, 2], boxes[node, 3] = first, last


@compiled
def _paint_span(image: np.ndarray, a: int, b: int, label: int, empty: int) -> bool:
    """Writes a label to a row's pixels [a, b); returns whether another was there."""
    met = False
    for column in range(a, b):
        before = image[column]
        other = (before != empty) & (before != label)
        image[column] = np.int16(-1 - label) if other else np.int16(label)
        met |= other
    return met


@compiled
def _note_contested(
    image: np.ndarray, row: int, a: int, b: int, tiles: np.ndarray, bounds: np.ndarray
) -> None:
    """Notes which of a row's pixels [a, b) are contested, some of which are."""
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
def _begin_depths(image: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Returns depths within bounds that anything beats where an image is contested."""
    top, left = bounds[0], bounds[2]
    depths = np.empty((bounds[1] - top, bounds[3] - left), dtype=np.float32)
    for i in range(depths.shape[0]):
        for j in range(depths.shape[1]):
            depths[i, j] = -np.inf if image[top + i, left + j] < 0 else np.inf
    return depths


@compiled(inline="always")
def _is_contested(sums: np.ndarray, top: int, bottom: int, left: int, right: int) -> bool:
    """Whether tiles top to bottom, left to right, the last included, hold contested pixels."""
    below, beside = bottom + 1, right + 1
    return sums[below, beside] - sums[top, beside] - sums[below, left] + sums[top, left] != 0


@compiled(inline="always")
def _tile(place: float, size: int) -> int:
    """The tile of a place [pixel] along a picture's side of some size; the nearest to others."""
    return int(min(max(place, 0.0), size - 1.0)) >> _TILE


@compiled
def _draw_node(
    packed: PackedOutlines,
    node: int,
    label: int,
    closed: bool,
    X_CN: np.ndarray,
    camera: np.ndarray,
    image: np.ndarray,
    contest: _Contest,
    work: _Work,
) -> None:
    """Draws the triangles of one surface where pixels are contested."""
    _project(packed, node, X_CN, camera, work)
    _find_facings(packed, node, X_CN, camera, work)
    u, v, facings, X = work.u, work.v, work.facings, X_CN[node]
    begin = packed.starts[node, 0]
    count = packed.starts[node + 1, 0] - begin
    x, y, z = packed.points[0, begin:], packed.points[1, begin:], packed.points[2, begin:]
    nearness = np.empty(count)
    rows, columns = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.int32)
    height, width = image.shape
    lowest = np.inf
    for i in range(count):
        rows[i], columns[i] = _tile(v[i], height), _tile(u[i], width)
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
            top, bottom = min(rows[a], rows[b], rows[c]), max(rows[a], rows[b], rows[c])
            left = min(columns[a], columns[b], columns[c])
            right = max(columns[a], columns[b], columns[c])
            if not _is_contested(contest.sums, top, bottom, left, right):
                continue
            for k in range(3):
                i = packed.triangles[first + t, k]
                corners[k, 0], corners[k, 1], corners[k, 2] = u[i], v[i], nearness[i]
        else:
            size = _clip(packed, begin, first + t, X, camera, corners)
        for k in range(2, size):
            _draw_triangle(corners, k - 1, k, label, image, contest)


@compiled
def _clip(
    packed: PackedOutlines,
    begin: int,
    t: int,
    X: np.ndarray,
    camera: np.ndarray,
    pixels: np.ndarray,
) -> int:
    """Writes pixel and nearness of the corners of a triangle's part beyond the near plane.

    Returns:
        How many of the four rows of pixels (4, 3) are written.
    """
    near, size = camera[5], 0
    p_C = np.empty((3, 3))
    for k in range(3):
        i = begin + packed.triangles[t, k]
        x, y, z = packed.points[0, i], packed.points[1, i], packed.points[2, i]
        for j in range(3):
            p_C[k, j] = X[j, 0] * x + X[j, 1] * y + X[j, 2] * z + X[j, 3]
    for a in range(3):
        b = (a + 1) % 3
        visible = p_C[a, 2] >= near
        if visible:
            pixels[size, 0] = camera[1] * p_C[a, 0] / p_C[a, 2] + camera[3]
            pixels[size, 1] = camera[2] * p_C[a, 1] / p_C[a, 2] + camera[4]
            pixels[size, 2] = 1.0 / p_C[a, 2]
            size += 1
        if visible != (p_C[b, 2] >= near):
            # From the visible end to the hidden one, as the span kernel does.
            i, o = (a, b) if visible else (b, a)
            share = (near - p_C[i, 2]) / (p_C[o, 2] - p_C[i, 2])
            x = p_C[i, 0] + share * (p_C[o, 0] - p_C[i, 0])
            y = p_C[i, 1] + share * (p_C[o, 1] - p_C[i, 1])
            pixels[size, 0] = camera[1] * x / near + camera[3]
            pixels[size, 1] = camera[2] * y / near + camera[4]
            pixels[size, 2] = 1.0 / near
            size += 1
    return size


@compiled(inline="always")
def _draw_triangle(
    p: np.ndarray, b: int, c: int, label: int, image: np.ndarray, contest: _Contest
) -> None:
    """Draws the triangle 0, b, c of points p (n, 3) of pixel and nearness where it contends.

    Nearness grows towards the camera and is linear in the picture: 1 / z, or -z where rays are
    parallel.
    """
    bounds, depths = contest.bounds, contest.depths
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
