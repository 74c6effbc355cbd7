"""Bit masks of one surface at many poses, and quick tests that leave most of them undrawn.

The pixels are those of the span kernel, decided by the same arithmetic; only the contour edges are
looked for among the few that can be on the contour (contour_cells).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from drake_pose.silhouette.bit_view import WORD, BitView
from drake_pose.silhouette.contour_cells import CelledOutline, find_cell
from drake_pose.silhouette.kernel import (
    _BIAS,
    _SHIFT,
    _fill_safely,
    _find_spans,
    _make_work,
    _Work,
)

_FIRST_CAPACITY = 8
_FULL = np.uint64(0xFFFFFFFFFFFFFFFF)
_WIDTH_LIMIT = 32768


class _Scratch(NamedTuple):
    """What one surface at one pose needs for a moment.

    contour: (e,) int32 contour edges; weights: (e,) int32 of the edges; lines: (e, 4) upper and
    lower end u, v [pixel] of those that cross a row; firsts, lasts: (e,) int32 first row crossed
    and the row after the last.
    """

    contour: np.ndarray
    weights: np.ndarray
    lines: np.ndarray
    firsts: np.ndarray
    lasts: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def _make_scratch(edges: int) -> _Scratch:
    """Returns room for a surface of so many edges."""
    return _Scratch(
        np.empty(edges + 1, dtype=np.int32),
        np.empty(edges + 1, dtype=np.int32),
        np.empty((edges + 1, 4)),
        np.empty(edges + 1, dtype=np.int32),
        np.empty(edges + 1, dtype=np.int32),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def sift_by_balls(
    view: BitView,
    X_WP: np.ndarray,
    p_PB: np.ndarray,
    radii: np.ndarray,
    pairs: np.ndarray,
    limit: float,
) -> np.ndarray:
    """Leaves out poses at which a ball inside the surface shows that too much lies outside.

    Args:
        view: the silhouette.
        X_WP: (g, 4, 4) poses of the parent.
        p_PB: (n, k, 3) places of k balls in the parent's frame at each sample of the node [m].
        radii: (k,) of the balls [m].
        pairs: (m, 2) int32 parent pose and sample.
        limit: the area that may lie outside the silhouette [pixel].

    Returns:
        (m,) bool: the pairs that are left. None is lost whose surface lies outside by the limit or
        less.
    """
    camera, window, X_CW = view.camera, view.window, view.X_CW
    left = np.ones(pairs.shape[0], dtype=np.bool_)
    scale, parallel = min(camera[1], camera[2]), camera[0] == 1.0
    X_CP = np.empty((3, 4))
    group = -1
    for i in range(pairs.shape[0]):
        if pairs[i, 0] != group:
            group = pairs[i, 0]
            _multiply(X_CW, X_WP[group], X_CP)
        sample = pairs[i, 1]
        for k in range(radii.shape[0]):
            x, y, z = p_PB[sample, k, 0], p_PB[sample, k, 1], p_PB[sample, k, 2]
            u = X_CP[0, 0] * x + X_CP[0, 1] * y + X_CP[0, 2] * z + X_CP[0, 3]
            v = X_CP[1, 0] * x + X_CP[1, 1] * y + X_CP[1, 2] * z + X_CP[1, 3]
            radius = scale * radii[k]
            if parallel:
                u, v = camera[1] * u + camera[3], camera[2] * v + camera[4]
            else:
                depth = X_CP[2, 0] * x + X_CP[2, 1] * y + X_CP[2, 2] * z + X_CP[2, 3]
                if depth - radii[k] < camera[5]:
                    continue
                u, v = camera[1] * u / depth + camera[3], camera[2] * v / depth + camera[4]
                radius /= depth
            if not (-0.5 < u < camera[6] - 0.5 and -0.5 < v < camera[7] - 0.5):
                continue
            if limit < 1.0:
                if _disc_leaves(view.nearest, window, u, v, radius - 1e-6):
                    left[i] = False
                    break
            elif _square_outside(view.sums, window, camera, u, v, 0.7071 * radius) > limit:
                left[i] = False
                break
    return left


@njit(cache=True, nogil=True, error_model="numpy")
def _disc_leaves(
    nearest: np.ndarray, window: np.ndarray, u: float, v: float, radius: float
) -> bool:
    """Returns whether a disc whose centre is in the picture surely leaves the silhouette."""
    row, column = round(v), round(u)
    r, c = row - window[0], column - window[1]
    if 0 <= r < window[2] and 0 <= c < window[3]:
        place = nearest[r, c]
        if place >= 0:
            row, column = place // _WIDTH_LIMIT, place % _WIDTH_LIMIT
    return (u - column) ** 2 + (v - row) ** 2 < radius * radius and radius > 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _square_outside(
    sums: np.ndarray, window: np.ndarray, camera: np.ndarray, u: float, v: float, half: float
) -> int:
    """Returns how many pixels of the picture under a square are not in the silhouette."""
    a, b = max(0, int(np.ceil(u - half))), min(int(camera[6]), int(np.ceil(u + half)))
    c, d = max(0, int(np.ceil(v - half))), min(int(camera[7]), int(np.ceil(v + half)))
    if a >= b or c >= d:
        return 0
    area = (b - a) * (d - c)
    a, b = max(0, a - window[1]), min(window[3], b - window[1])
    c, d = max(0, c - window[0]), min(window[2], d - window[0])
    if a >= b or c >= d:
        return area
    return area - (sums[d, b] - sums[c, b] - sums[d, a] + sums[c, a])


@njit(cache=True, nogil=True, error_model="numpy")
def _multiply(X_AB: np.ndarray, X_BC: np.ndarray, X_AC: np.ndarray) -> None:
    """Writes the upper three rows of X_AB X_BC."""
    for i in range(3):
        for j in range(4):
            total = X_AB[i, 0] * X_BC[0, j]
            for k in range(1, 4):
                total += X_AB[i, k] * X_BC[k, j]
            X_AC[i, j] = total


@njit(cache=True, nogil=True, error_model="numpy")
def draw_bits(
    celled: CelledOutline,
    view: BitView,
    X_WP: np.ndarray,
    X_PN: np.ndarray,
    pairs: np.ndarray,
    limit: float,
    one_enough: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draws a surface at many poses as bits.

    Args:
        celled: the surface.
        view: the silhouette.
        X_WP: (g, 4, 4) poses of the parent.
        X_PN: (n, 4, 4) poses of the node in its parent at its samples.
        pairs: (m, 2) int32 parent pose and sample.
        limit: the area that may lie outside the silhouette [pixel].
        one_enough: (g,) bool the parent poses for which one pose that stays inside will do.

    Returns:
        kept (m,) bool: the pairs that stay inside the limit. The rest is about them alone, in the
        order of the pairs: areas (m', 3) int32 inside the silhouette, in the band, and outside of
        both; runs (m', 2, 3) int64 for the silhouette and the band the first word, the number of
        words, and where they begin in words; words (n,) uint64.
    """
    packed, camera = celled.packed, view.camera
    work, scratch = _make_work(packed, camera), _make_scratch(packed.edges.shape[1])
    crossings = np.empty((int(camera[7]), _FIRST_CAPACITY), dtype=np.int32)
    X_WN, X_CN = np.zeros((4, 4)), np.empty((1, 3, 4))
    X_WN[3, 3] = 1.0
    kept = np.zeros(pairs.shape[0], dtype=np.bool_)
    areas = np.empty((pairs.shape[0], 3), dtype=np.int32)
    runs = np.zeros((pairs.shape[0], 2, 3), dtype=np.int64)
    inside_size = view.inside[-1, -1] // WORD + 1
    band_size = view.band[-1, -1] // WORD + 1 if view.band.shape[0] else 0
    words = np.empty(16 * (inside_size + band_size) + pairs.shape[0], dtype=np.uint64)
    spans = np.empty((4 * int(camera[7]) + int(camera[6]), 3), dtype=np.int32)
    found, used, satisfied = 0, 0, -1
    for i in range(pairs.shape[0]):
        if pairs[i, 0] == satisfied:
            continue
        _multiply(X_WP[pairs[i, 0]], X_PN[pairs[i, 1]], X_WN)
        _multiply(view.X_CW, X_WN, X_CN[0])
        if not _fill_celled(celled, X_CN, camera, crossings, work, scratch):
            crossings = _fill_safely(packed, X_CN, camera, crossings, work)
        count, spans = _gather_spans(view, crossings, work, limit, spans, areas[found])
        if count < 0:
            continue
        if words.shape[0] < used + inside_size + band_size:
            wider = np.empty(2 * words.shape[0] + inside_size + band_size, dtype=np.uint64)
            wider[:used] = words[:used]
            words = wider
        used = _write_runs(view.inside, view.window, spans, count, words, used, runs[found, 0])
        if band_size:
            used = _write_runs(view.band, view.window, spans, count, words, used, runs[found, 1])
        kept[i] = True
        found += 1
        if one_enough[pairs[i, 0]]:
            satisfied = pairs[i, 0]
    return kept, areas[:found].copy(), runs[:found].copy(), words[:used].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_celled(
    celled: CelledOutline,
    X_CN: np.ndarray,
    camera: np.ndarray,
    crossings: np.ndarray,
    work: _Work,
    scratch: _Scratch,
) -> bool:
    """As the kernel's _fill_rows; False (and nothing done) where the cell's edges will not do."""
    packed = celled.packed
    work.reach[0], work.reach[1], work.reach[2] = int(camera[7]), 0, 0
    if packed.planes.shape[1] == 0:
        return True
    X, ball, parallel = X_CN[0], packed.balls[0], camera[0] == 1.0
    e0, e1, e2, share = X[2, 0], X[2, 1], X[2, 2], 0.0
    d0, d1, d2 = e0, e1, e2
    if not parallel:
        t0, t1, t2, share = X[0, 3], X[1, 3], X[2, 3], 1.0
        e0 = -(X[0, 0] * t0 + X[1, 0] * t1 + X[2, 0] * t2)
        e1 = -(X[0, 1] * t0 + X[1, 1] * t1 + X[2, 1] * t2)
        e2 = -(X[0, 2] * t0 + X[1, 2] * t1 + X[2, 2] * t2)
        d0, d1, d2 = e0 - ball[0], e1 - ball[1], e2 - ball[2]
        distance = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        depth = X[2, 0] * ball[0] + X[2, 1] * ball[1] + X[2, 2] * ball[2] + X[2, 3]
        if depth - 1.000001 * ball[3] < camera[5] or ball[3] > celled.reach[0] * distance:
            return False
    facing = (e0, e1, e2, share)
    view_matrix = _picture_rows(X, camera)
    cell = find_cell(d0, d1, d2)
    begin, end = celled.cell_starts[cell], celled.cell_starts[cell + 1]
    _walk_cell(
        celled, begin, end, facing, view_matrix, camera, crossings, work.counts, work.reach, scratch
    )
    if work.reach[2] != 0:
        for row in range(work.reach[0], work.reach[1]):
            work.counts[row] = 0
        return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _picture_rows(X: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Returns (3, 4): a point's u and v [pixel], before the division by the third of a pinhole."""
    rows = np.empty((3, 4))
    for j in range(4):
        rows[0, j], rows[1, j], rows[2, j] = camera[1] * X[0, j], camera[2] * X[1, j], X[2, j]
    if camera[0] == 1.0:
        rows[0, 3] += camera[3]
        rows[1, 3] += camera[4]
    return rows


@njit(cache=True, nogil=True, error_model="numpy")
def _walk_cell(
    celled: CelledOutline,
    begin: int,
    end: int,
    facing: tuple[float, float, float, float],
    rows: np.ndarray,
    camera: np.ndarray,
    crossings: np.ndarray,
    counts: np.ndarray,
    reach: np.ndarray,
    scratch: _Scratch,
) -> None:
    """Walks the contour edges among cell_edges[begin:end] exactly as the span kernel does."""
    parallel, cx, cy = camera[0] == 1.0, camera[3], camera[4]
    width, height, capacity = camera[6], camera[7], crossings.shape[1]
    a0, a1, a2, a3 = rows[0, 0], rows[0, 1], rows[0, 2], rows[0, 3]
    b0, b1, b2, b3 = rows[1, 0], rows[1, 1], rows[1, 2], rows[1, 3]
    c0, c1, c2, c3 = rows[2, 0], rows[2, 1], rows[2, 2], rows[2, 3]
    e0, e1, e2, share = facing
    planes, edges, points, chosen = celled.planes, celled.edges, celled.points, celled.cell_edges
    # Three passes without unforeseeable branches in the first two: a mispredicted branch costs as
    # much as all the arithmetic of an edge.
    contour, weights, number = scratch.contour, scratch.weights, 0
    for k in range(begin, end):
        e = chosen[k]
        t = edges[e, 2]
        side = planes[t, 0] * e0 + planes[t, 1] * e1 + planes[t, 2] * e2 - planes[t, 3] * share
        weight = int(side > 0.0) - int(side < 0.0)
        t = edges[e, 3]
        side = planes[t, 0] * e0 + planes[t, 1] * e1 + planes[t, 2] * e2 - planes[t, 3] * share
        weight += edges[e, 4] * (int(side > 0.0) - int(side < 0.0))
        contour[number], weights[number] = e, weight
        number += weight != 0
    lines, firsts, lasts, crossing = scratch.lines, scratch.firsts, scratch.lasts, 0
    for k in range(number):
        e = contour[k]
        i, j = edges[e, 0], edges[e, 1]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        ua, va = a0 * x + a1 * y + a2 * z + a3, b0 * x + b1 * y + b2 * z + b3
        if not parallel:
            inverse = 1.0 / (c0 * x + c1 * y + c2 * z + c3)
            ua, va = ua * inverse + cx, va * inverse + cy
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        ub, vb = a0 * x + a1 * y + a2 * z + a3, b0 * x + b1 * y + b2 * z + b3
        if not parallel:
            inverse = 1.0 / (c0 * x + c1 * y + c2 * z + c3)
            ub, vb = ub * inverse + cx, vb * inverse + cy
        down = va <= vb
        u0, v0 = (ua if down else ub), (va if down else vb)
        u1, v1 = (ub if down else ua), (vb if down else va)
        first = math.ceil(min(max(v0, 0.0), height))
        last = math.ceil(min(max(v1, 0.0), height))
        lines[crossing, 0], lines[crossing, 1] = u0, v0
        lines[crossing, 2], lines[crossing, 3] = u1, v1
        firsts[crossing], lasts[crossing] = first, last
        weights[crossing] = weights[k] if down else -weights[k]
        crossing += first < last
    lowest, highest = reach[0], reach[1]
    for k in range(crossing):
        u0, v0 = lines[k, 0], lines[k, 1]
        slope = (lines[k, 2] - u0) / (lines[k, 3] - v0)
        first, last, mark = firsts[k], lasts[k], weights[k] + _BIAS
        lowest, highest = min(lowest, first), max(highest, last)
        for row in range(first, last):
            u = u0 + (row - v0) * slope
            pixel = math.ceil(min(max(u, 0.0), width))
            count = counts[row]
            if count < capacity:
                crossings[row, count] = (pixel << _SHIFT) + mark
            else:
                reach[2] = 1
            counts[row] = count + 1
    reach[0], reach[1] = lowest, highest


@njit(cache=True, nogil=True, error_model="numpy")
def _gather_spans(
    view: BitView,
    crossings: np.ndarray,
    work: _Work,
    limit: float,
    spans: np.ndarray,
    areas: np.ndarray,
) -> tuple[int, np.ndarray]:
    """Reads the rows' spans and empties the rows.

    Returns:
        The number of spans in the window, -1 where more than the limit lies outside, and the spans
        (n, 3) row, a, b [window].
    """
    window, inside, band = view.window, view.inside, view.band
    first_row, end_row = window[0], window[0] + window[2]
    first_column, width = window[1], window[3]
    has_band = band.shape[0] > 0
    covered, near, total, count = 0, 0, 0, 0
    for row in range(work.reach[0], work.reach[1]):
        number = _find_spans(row, crossings, work.counts, work.changes, work.spans)
        if count + number > spans.shape[0]:
            wider = np.empty((2 * spans.shape[0] + number, 3), dtype=np.int32)
            wider[:count] = spans[:count]
            spans = wider
        for k in range(number):
            a, b = work.spans[k, 0], work.spans[k, 1]
            total += b - a
            if row < first_row or row >= end_row:
                continue
            r = row - first_row
            a, b = max(0, a - first_column), min(width, b - first_column)
            if a < b:
                covered += inside[r, b] - inside[r, a]
                if has_band:
                    near += band[r, b] - band[r, a]
                spans[count, 0], spans[count, 1], spans[count, 2] = r, a, b
                count += 1
        if total - covered > limit:
            for later in range(row + 1, work.reach[1]):
                work.counts[later] = 0
            return -1, spans
    areas[0], areas[1], areas[2] = covered, near, total - covered - near
    return count, spans


@njit(cache=True, nogil=True, error_model="numpy")
def _write_runs(
    numbers: np.ndarray,
    window: np.ndarray,
    spans: np.ndarray,
    count: int,
    words: np.ndarray,
    used: int,
    run: np.ndarray,
) -> int:
    """Writes the bits of spans behind the words in use; returns how many words are then in use."""
    first, last = -1, -1
    for k in range(count):
        row = spans[k, 0]
        a, b = numbers[row, spans[k, 1]], numbers[row, spans[k, 2]]
        if a == b:
            continue
        low, high = a // WORD, (b - 1) // WORD
        if first < 0:
            first, last = low, low - 1
        for word in range(last + 1, high + 1):
            words[used + word - first] = 0
        last = max(last, high)
        low_bits = _FULL << np.uint64(a % WORD)
        high_bits = _FULL >> np.uint64(WORD - 1 - (b - 1) % WORD)
        place = used + low - first
        if low == high:
            words[place] |= low_bits & high_bits
        else:
            words[place] |= low_bits
            for word in range(low + 1, high):
                words[used + word - first] = _FULL
            words[used + high - first] |= high_bits
    run[0], run[1], run[2] = max(first, 0), 0 if first < 0 else last - first + 1, used
    return used + run[1]


@njit(cache=True, nogil=True, error_model="numpy")
def draw_discs(
    view: BitView, X_WP: np.ndarray, p_PB: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draws discs that hold the picture of a ball as bits of the silhouette.

    Args:
        view: the silhouette.
        X_WP: (g, 4, 4) poses of the frame that the ball is fixed in.
        p_PB: (3,) its centre [m].
        radius: its radius [m].

    Returns:
        runs (g, 3) int64 first word, number of words, where they begin in words; words (n,) uint64.
    """
    camera, window = view.camera, view.window
    height, width = window[2], window[3]
    size = view.inside[-1, -1] // WORD + 1
    X_CP = np.empty((3, 4))
    p_C = np.empty(3)
    spans = np.empty((height, 3), dtype=np.int32)
    runs = np.zeros((X_WP.shape[0], 3), dtype=np.int64)
    words = np.empty(size * X_WP.shape[0], dtype=np.uint64)
    used = 0
    for i in range(X_WP.shape[0]):
        _multiply(view.X_CW, X_WP[i], X_CP)
        for j in range(3):
            p_C[j] = X_CP[j, 3]
            for k in range(3):
                p_C[j] += X_CP[j, k] * p_PB[k]
        u, v, reach = camera[1] * p_C[0], camera[2] * p_C[1], max(camera[1], camera[2]) * radius
        if camera[0] != 1.0:
            u, v = u / p_C[2], v / p_C[2]
            distance = np.sqrt((p_C**2).sum())
            reach *= distance / (p_C[2] * (p_C[2] - radius))
            if p_C[2] - radius < camera[5]:
                u, v, reach = 0.0, 0.0, 1e9
        u, v, reach = u + camera[3] - window[1], v + camera[4] - window[0], reach + 1.0
        count = 0
        for row in range(max(0, math.ceil(v - reach)), min(height, math.floor(v + reach) + 1)):
            half = np.sqrt(max(0.0, reach * reach - (row - v) ** 2))
            a, b = max(0, math.ceil(u - half)), min(width, math.floor(u + half) + 1)
            if a < b:
                spans[count, 0], spans[count, 1], spans[count, 2] = row, a, b
                count += 1
        used = _write_runs(view.inside, window, spans, count, words, used, runs[i])
    return runs, words[:used].copy()
