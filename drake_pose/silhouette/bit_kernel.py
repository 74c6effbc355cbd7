"""Bit masks of a surface's silhouettes at many poses, equal to the span kernel's masks.

The pixels of a silhouette have consecutive numbers, row after row. Prefix sums along the rows give
the run of bits that a span sets, so a mask of 20,000 pixels takes about 300 words. Contour edges
are searched among the few candidates of a cell of viewing directions (``CelledOutline``).
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

from drake_pose.compiled import compiled, grow_rows, multiply
from drake_pose.silhouette.contour_points import CELLS_PER_SIDE, CelledOutline
from drake_pose.silhouette.outline import bend, viewpoint_in_node
from drake_pose.silhouette.span_kernel import (
    BIAS,
    SHIFT,
    Rows,
    add_surface,
    fill_rows,
    find_spans,
    make_rows,
)

WORD = 64
"""Number of bits of a word."""


class BitView(NamedTuple):
    """A silhouette and the margin around it, cropped to a window of the image."""

    camera: np.ndarray  # (8,) ``Camera.kernel_parameters()``.
    X_CW: np.ndarray  # (4, 4) pose of the world in the camera.
    window: np.ndarray  # (4,) int64 first row, first column, height h and width w [pixel].
    # (h, w + 1) int32 number of silhouette pixels before each pixel, row after row.
    inside: np.ndarray
    # (h, w + 1) int32 the same for the pixels of the margin; (0, 0) without a margin.
    margin: np.ndarray
    # (h + 1, w + 1) int32 number of silhouette pixels above and left of each corner.
    sums: np.ndarray


def make_bit_view(
    mask: np.ndarray, camera_parameters: np.ndarray, X_CW: np.ndarray, width: int
) -> BitView:
    """Return the bit view of a silhouette.

    Args:
        mask: (H, W) bool, not empty.
        camera_parameters: (8,) ``Camera.kernel_parameters()``.
        X_CW: (4, 4) pose of the world in the camera.
        width: width of the margin around the silhouette [pixel]; 0: no margin, and only bodies that
            stay inside the silhouette are distinguished by their bits.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask[rows[0] : rows[-1] + 1].any(axis=0))
    padding = max(1, width)
    top, left = max(0, rows[0] - padding), max(0, columns[0] - padding)
    bottom = min(mask.shape[0], rows[-1] + 1 + padding)
    right = min(mask.shape[1], columns[-1] + 1 + padding)
    pixels = np.ascontiguousarray(mask[top:bottom, left:right]).view(np.uint8)
    margin = np.zeros((0, 0), dtype=np.int32)
    if width:
        square = np.ones((2 * width + 1, 2 * width + 1), dtype=np.uint8)
        margin = _number_pixels(cv2.dilate(pixels, square) - pixels)
    return BitView(
        camera=camera_parameters,
        X_CW=np.ascontiguousarray(X_CW, dtype=np.float64),
        window=np.array([top, left, *pixels.shape], dtype=np.int64),
        inside=_number_pixels(pixels),
        margin=margin,
        sums=cv2.integral(pixels),
    )


def _number_pixels(mask: np.ndarray) -> np.ndarray:
    """Return (h, w + 1) int32, the number of set pixels of a mask (h, w) uint8 before each."""
    ends = np.cumsum(mask, dtype=np.int32).reshape(mask.shape)
    return np.concatenate([ends[:, :1] - mask[:, :1], ends], axis=1)


@compiled
def draw_bits(
    celled: CelledOutline,
    view: BitView,
    X_WP: np.ndarray,
    X_PN: np.ndarray,
    pairs: np.ndarray,
    limit: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draw a node's surface at many poses as bits of one camera's silhouette pixels.

    Poses with too much area outside the silhouette are skipped.

    Args:
        celled: the surface; its skin band, if any, is deformed to the pair's sample.
        view: the camera's silhouette.
        X_WP: (g, 4, 4) poses of the parent in the world.
        X_PN: (n, 4, 4) poses of the node in its parent at its samples.
        pairs: (m, 2) int32 indices of a parent pose and a sample.
        limit: largest area outside the silhouette, margin included [pixel].

    Returns:
        kept: (m,) bool, whether the pair is within the limit. The other arrays are about the m'
            kept pairs, in order.
        areas: (m', 3) int32 area inside the silhouette, in the margin, and outside both [pixel].
        runs: (m', 2, 3) int64 for the bits of the silhouette's pixels and of the margin's: index of
            the first word that is not 0, number of words stored, and their start in ``words``.
        words: (n,) uint64 stored words; bit k of a mask is bit k % 64 of its word k // 64.
    """
    camera, packed, e = view.camera, celled.packed, celled.edges.shape[0] + 1
    rows, crossings = make_rows(packed, camera)
    # Edge index, weight, first row and row after the last of contour edges; upper and lower end of
    # the edges that cross a row.
    scratch = (np.empty((4, e), dtype=np.int32), np.empty((e, 4)))
    bends, part = celled.bands.shape[0] > 0, np.array([[1, 0, 0, 0]])
    X_WN, X_CN = np.zeros((4, 4)), np.empty((2, 3, 4))
    X_WN[3, 3] = 1.0
    kept = np.zeros(pairs.shape[0], dtype=np.bool_)
    areas = np.empty((pairs.shape[0], 3), dtype=np.int32)
    runs = np.zeros((pairs.shape[0], 2, 3), dtype=np.int64)
    inside_size = view.inside[-1, -1] // WORD + 1
    margin_size = view.margin[-1, -1] // WORD + 1 if view.margin.shape[0] else 0
    words = np.empty(16 * (inside_size + margin_size) + pairs.shape[0], dtype=np.uint64)
    spans = np.empty((4 * int(camera[7]) + int(camera[6]), 3), dtype=np.int32)
    found, used = 0, 0
    for i in range(pairs.shape[0]):
        multiply(X_WP[pairs[i, 0]], X_PN[pairs[i, 1]], X_WN)
        multiply(view.X_CW, X_WN, X_CN[0])
        multiply(view.X_CW, X_WN, X_CN[1])
        if bends:
            bend(packed, part, celled.bands[pairs[i, 1]])
        rows.row_range[0], rows.row_range[1], rows.row_range[2] = rows.counts.shape[0], 0, 0
        filled = _walk_cell(celled, X_CN[0], camera, crossings, rows, scratch)
        if filled:
            add_surface(packed, 1, X_CN, camera, crossings, rows)
        if rows.row_range[2] != 0 or not filled:
            for row in range(rows.row_range[0], rows.row_range[1]):
                rows.counts[row] = 0
            crossings = fill_rows(packed, 0, 2, X_CN, camera, crossings, rows)
        count, spans = _gather_spans(view, crossings, rows, limit, spans, areas[found])
        if count < 0:
            continue
        if words.shape[0] < used + inside_size + margin_size:
            words = grow_rows(words, used, 2 * words.shape[0] + inside_size + margin_size)
        used = write_runs(view.inside, spans, count, words, used, runs[found, 0])
        if margin_size:
            used = write_runs(view.margin, spans, count, words, used, runs[found, 1])
        kept[i] = True
        found += 1
    return kept, areas[:found].copy(), runs[:found].copy(), words[:used].copy()


@compiled
def _walk_cell(
    celled: CelledOutline, X: np.ndarray, camera: np.ndarray, crossings: np.ndarray, rows: Rows,
    scratch: tuple[np.ndarray, np.ndarray],
) -> bool:  # fmt: skip
    """Append the crossings of a surface's contour edges, found by the viewing direction's cell.

    The skin band is left out. The crossings equal those of the span kernel.

    Args:
        celled, X: the surface, and its (3, 4) pose in the camera.
        camera: (8,) ``Camera.kernel_parameters()``.
        crossings: (height, capacity) output, as in ``add_surface``.
        rows: scratch of the span kernel; ``counts`` and ``row_range`` are updated.
        scratch: (4, e + 1) int32 and (e + 1, 4) float64 scratch, for e edges of the surface.

    Returns whether the cells are valid at this pose; if not, nothing is written.
    """
    counts, row_range = rows.counts, rows.row_range
    if celled.edges.shape[0] == 0:
        return True
    ball, parallel, cx, cy = celled.packed.balls[0], camera[0] == 1.0, camera[3], camera[4]
    e0, e1, e2, w = viewpoint_in_node(X, camera)
    d0, d1, d2 = e0 - w * ball[0], e1 - w * ball[1], e2 - w * ball[2]
    c0, c1, c2, c3 = X[2, 0], X[2, 1], X[2, 2], X[2, 3]
    if not parallel:
        distance = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        depth = c0 * ball[0] + c1 * ball[1] + c2 * ball[2] + c3
        if depth - 1.000001 * ball[3] < camera[5] or ball[3] > celled.max_sine[0] * distance:
            return False
    # The face of the cube that the direction meets, and its cell on it.
    a0, a1, a2 = abs(d0), abs(d1), abs(d2)
    if a0 >= a1 and a0 >= a2:
        face, s, t = 0, d1 / d0, d2 / d0
    elif a1 >= a2:
        face, s, t = 1, d0 / d1, d2 / d1
    else:
        face, s, t = 2, d0 / d2, d1 / d2
    column = min(int((s + 1.0) * 0.5 * CELLS_PER_SIDE), CELLS_PER_SIDE - 1)
    row = min(int((t + 1.0) * 0.5 * CELLS_PER_SIDE), CELLS_PER_SIDE - 1)
    cell = (face * CELLS_PER_SIDE + row) * CELLS_PER_SIDE + column
    begin, end = celled.cell_starts[cell], celled.cell_starts[cell + 1]
    fx, fy, width, height = camera[1], camera[2], camera[6], camera[7]
    a0, a1, a2, a3 = fx * X[0, 0], fx * X[0, 1], fx * X[0, 2], fx * X[0, 3]
    b0, b1, b2, b3 = fy * X[1, 0], fy * X[1, 1], fy * X[1, 2], fy * X[1, 3]
    if parallel:
        a3, b3 = a3 + cx, b3 + cy
    planes, edges, points, listed = celled.planes, celled.edges, celled.points, celled.cell_edges
    # The first two of three passes have no unpredictable branches, each as dear as an edge.
    contour, weights, number, crossing = scratch[0][0], scratch[0][1], 0, 0
    firsts, lasts, lines = scratch[0][2], scratch[0][3], scratch[1]
    for k in range(begin, end):
        e = listed[k]
        p = edges[e, 2]
        side = planes[p, 0] * e0 + planes[p, 1] * e1 + planes[p, 2] * e2 - planes[p, 3] * w
        weight = int(side > 0.0) - int(side < 0.0)
        p = edges[e, 3]
        side = planes[p, 0] * e0 + planes[p, 1] * e1 + planes[p, 2] * e2 - planes[p, 3] * w
        weight += edges[e, 4] * (int(side > 0.0) - int(side < 0.0))
        contour[number], weights[number] = e, weight
        number += weight != 0
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
    lowest, highest, capacity = row_range[0], row_range[1], crossings.shape[1]
    for k in range(crossing):
        u0, v0 = lines[k, 0], lines[k, 1]
        slope = (lines[k, 2] - u0) / (lines[k, 3] - v0)
        first, last, mark = firsts[k], lasts[k], weights[k] + BIAS
        lowest, highest = min(lowest, first), max(highest, last)
        for row in range(first, last):
            u = u0 + (row - v0) * slope
            pixel = math.ceil(min(max(u, 0.0), width))
            count = counts[row]
            if count < capacity:
                crossings[row, count] = (pixel << SHIFT) + mark
            else:
                row_range[2] = 1
            counts[row] = count + 1
    row_range[0], row_range[1] = lowest, highest
    return True


@compiled
def _gather_spans(
    view: BitView,
    crossings: np.ndarray,
    rows: Rows,
    limit: float,
    spans: np.ndarray,
    areas: np.ndarray,
) -> tuple[int, np.ndarray]:
    """Collect the spans of all rows inside the window of the view, and empty the rows.

    Args:
        crossings, rows: output of the span kernel.
        limit: largest area outside the silhouette, margin included [pixel].
        spans: (k, 3) output: row and columns [a, b) in the window; grown as needed.
        areas: (3,) output: area inside the silhouette, in the margin, and outside both [pixel].

    Returns the number of spans, or -1 if the limit is exceeded, and the spans.
    """
    window, inside, margin = view.window, view.inside, view.margin
    first_row, end_row = window[0], window[0] + window[2]
    first_column, width = window[1], window[3]
    has_margin = margin.shape[0] > 0
    covered, in_margin, total, count = 0, 0, 0, 0
    for row in range(rows.row_range[0], rows.row_range[1]):
        number = find_spans(row, crossings, rows.counts, rows.changes, rows.spans)
        if count + number > spans.shape[0]:
            spans = grow_rows(spans, count, 2 * spans.shape[0] + number)
        for k in range(number):
            a, b = rows.spans[k, 0], rows.spans[k, 1]
            total += b - a
            if row < first_row or row >= end_row:
                continue
            r = row - first_row
            a, b = max(0, a - first_column), min(width, b - first_column)
            if a < b:
                covered += inside[r, b] - inside[r, a]
                if has_margin:
                    in_margin += margin[r, b] - margin[r, a]
                spans[count, 0], spans[count, 1], spans[count, 2] = r, a, b
                count += 1
        if total - covered > limit:
            for later in range(row + 1, rows.row_range[1]):
                rows.counts[later] = 0
            return -1, spans
    areas[0], areas[1], areas[2] = covered, in_margin, total - covered - in_margin
    return count, spans


@compiled
def write_runs(
    numbers: np.ndarray,
    spans: np.ndarray,
    count: int,
    words: np.ndarray,
    used: int,
    run: np.ndarray,
) -> int:
    """Write the bits of spans behind the used words; return the new number of used words.

    Args:
        numbers: (h, w + 1) number of counted pixels before each pixel of the window, such as
            ``BitView.inside``; a counted pixel's number is the index of its bit.
        spans: (k, 3) row and columns [a, b) in the window, row after row.
        count: number of spans.
        words: (n,) uint64 output, with room for the new words.
        used: number of used words.
        run: (3,) output: index of the mask's first stored word, number of stored words, and their
            start in ``words``.
    """
    first, last, full = -1, -1, np.uint64(0xFFFFFFFFFFFFFFFF)
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
        low_bits = full << np.uint64(a % WORD)
        high_bits = full >> np.uint64(WORD - 1 - (b - 1) % WORD)
        place = used + low - first
        if low == high:
            words[place] |= low_bits & high_bits
        else:
            words[place] |= low_bits
            for word in range(low + 1, high):
                words[used + word - first] = full
            words[used + high - first] |= high_bits
    run[0], run[1], run[2] = max(first, 0), 0 if first < 0 else last - first + 1, used
    return used + run[1]


@compiled
def prune_by_balls(
    view: BitView,
    X_WP: np.ndarray,
    p_PB: np.ndarray,
    radii: np.ndarray,
    pairs: np.ndarray,
    limit: float,
) -> np.ndarray:
    """Return (m,) bool, which pairs to keep: no ball proves that they exceed the limit.

    No pair within the limit is pruned. The node's projection must contain each ball's.

    Args:
        view: one camera's silhouette.
        X_WP: (g, 4, 4) poses of the node's parent P in the world.
        p_PB: (n, k, 3) centres of k balls in the parent's frame at each sample of the node [m].
        radii: (k,) radii of the balls [m].
        pairs: (m, 2) int32 indices of a parent pose and a sample.
        limit: largest area outside the silhouette [pixel].
    """
    camera, window, X_CW, sums = view.camera, view.window, view.X_CW, view.sums
    kept = np.ones(pairs.shape[0], dtype=np.bool_)
    scale, parallel = min(camera[1], camera[2]), camera[0] == 1.0
    X_CP = np.empty((3, 4))
    group = -1
    for i in range(pairs.shape[0]):
        if pairs[i, 0] != group:
            group = pairs[i, 0]
            multiply(X_CW, X_WP[group], X_CP)
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
            # Pixels of the square in the disc that are in the image and not in the silhouette.
            half = 0.7071 * radius
            a, b = max(0, math.ceil(u - half)), min(int(camera[6]), math.ceil(u + half))
            c, d = max(0, math.ceil(v - half)), min(int(camera[7]), math.ceil(v + half))
            area = max(b - a, 0) * max(d - c, 0)
            a, b = max(0, a - window[1]), min(window[3], b - window[1])
            c, d = max(0, c - window[0]), min(window[2], d - window[0])
            if a < b and c < d:
                area -= sums[d, b] - sums[c, b] - sums[d, a] + sums[c, a]
            if area > limit:
                kept[i] = False
                break
    return kept


@compiled
def draw_discs(
    view: BitView, X_WP: np.ndarray, p_PB: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draw discs that contain the image of a ball, as bits of the silhouette's pixels.

    Args:
        view: one camera's silhouette.
        X_WP: (g, 4, 4) poses of the frame P that the ball is fixed in.
        p_PB: (3,) the ball's centre in frame P [m].
        radius: the ball's radius [m].

    Returns:
        runs: (g, 3) int64 index of the first stored word of each disc's bit mask, number of stored
            words, and their start in ``words``.
        words: (n,) uint64.
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
        multiply(view.X_CW, X_WP[i], X_CP)
        for j in range(3):
            p_C[j] = X_CP[j, 3]
            for k in range(3):
                p_C[j] += X_CP[j, k] * p_PB[k]
        u, v = camera[1] * p_C[0], camera[2] * p_C[1]
        extent = max(camera[1], camera[2]) * radius
        if camera[0] != 1.0:
            u, v = u / p_C[2], v / p_C[2]
            distance = np.sqrt((p_C**2).sum())
            extent *= distance / (p_C[2] * (p_C[2] - radius))
            if p_C[2] - radius < camera[5]:
                u, v, extent = 0.0, 0.0, 1e9
        u, v, extent = u + camera[3] - window[1], v + camera[4] - window[0], extent + 1.0
        count = 0
        for row in range(max(0, math.ceil(v - extent)), min(height, math.floor(v + extent) + 1)):
            half = np.sqrt(max(0.0, extent * extent - (row - v) ** 2))
            a, b = max(0, math.ceil(u - half)), min(width, math.floor(u + half) + 1)
            if a < b:
                spans[count, 0], spans[count, 1], spans[count, 2] = row, a, b
                count += 1
        used = write_runs(view.inside, spans, count, words, used, runs[i])
    return runs, words[:used].copy()
