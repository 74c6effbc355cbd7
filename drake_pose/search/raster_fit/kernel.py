"""Normal equations of the distances between a body's contour and a silhouette's border.

What ``lines`` finds on each line of the raster is summed here with how fast the contour
moves with the parameters.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.fit.kernel import picture_rows, seen_from, speed_along
from drake_pose.search.raster_fit.lines import Border, compare_line, pixels_apart
from drake_pose.silhouette.contours.contour_body import ContourBody, find_body_segments
from drake_pose.silhouette.contours.contour_segments import (
    Segments,
    find_crossings,
    find_line_spans,
)


class Movements(NamedTuple):
    """A body's pose and what moves it.

    X_WS: (surfaces, 4, 4); twists: (m, 7) as Motions; columns: (c,) int64 those of the m parameters
    that may change; movers: (k,) int64 which of these move each surface, surface after surface;
    own: (k,) whether a mover is a value of the surface's own node, which a band of skin follows
    only part of the way; mover_starts: (surfaces + 1,); moved: (surfaces,) whether any does.
    """

    X_WS: np.ndarray
    twists: np.ndarray
    columns: np.ndarray
    movers: np.ndarray
    own: np.ndarray
    mover_starts: np.ndarray
    moved: np.ndarray


@compiled
def write_row(
    body: ContourBody,
    segments: Segments,
    s: int,
    share: float,
    sign: float,
    movements: Movements,
    X_CW: np.ndarray,
    camera: np.ndarray,
    row: np.ndarray,
) -> None:
    """Writes how fast a point of a contour segment moves outwards with its node's movers.

    Args:
        body, segments: the surfaces and their contour edges.
        s: the segment.
        share: how far along it the point is seen.
        sign: 1 if outwards is to the left of the way from its start to its end in the picture.
        movements, X_CW, camera: pose and motions, and the camera's.
        row: (m,) written from its beginning.
    """
    ends, surface = segments.ends, segments.nodes[s]
    du, dv = ends[s, 2] - ends[s, 0], ends[s, 3] - ends[s, 1]
    size = sign / math.sqrt(du * du + dv * dv)
    n0, n1 = dv * size, -du * size
    near, far = segments.depths[s, 0], segments.depths[s, 1]
    share = share * near / (share * near + (1.0 - share) * far)
    a, b = segments.vertices[s, 0], segments.vertices[s, 1]
    p, p_W = np.empty(3), np.empty(3)
    for i in range(3):
        p[i] = (1.0 - share) * body.points[a, i] + share * body.points[b, i]
    X = movements.X_WS[surface]
    for i in range(3):
        p_W[i] = X[i, 0] * p[0] + X[i, 1] * p[1] + X[i, 2] * p[2] + X[i, 3]
    rows, normal = np.empty((2, 3)), np.empty(3)
    picture_rows(p_W, X_CW, camera, rows)
    for i in range(3):
        normal[i] = n0 * rows[0, i] + n1 * rows[1, i]
    follows = (1.0 - share) * body.weights[a] + share * body.weights[b]
    begin = movements.mover_starts[surface]
    for k in range(begin, movements.mover_starts[surface + 1]):
        speed = speed_along(normal, p_W, movements.twists[movements.columns[movements.movers[k]]])
        row[k - begin] = follows * speed if movements.own[k] else speed


@compiled
def unite_spans(
    segments: Segments,
    across: int,
    spans: np.ndarray,
    found: int,
    places: np.ndarray,
    owners: np.ndarray,
    still: np.ndarray,
    first: int,
    end: int,
    crossings: np.ndarray,
    slopes: np.ndarray,
    chosen: np.ndarray,
) -> int:
    """Writes where a line enters and leaves the union of moving and still surfaces.

    Args:
        segments, across: the moving surfaces' contour edges, and which lines.
        spans, found, places, owners: the line's moving spans, as from ``find_line_spans``.
        still: the still surfaces' crossings; this line's are those from ``first`` to ``end``.
        crossings: written: the places.
        slopes: written: cosines between the line and the contour's normal.
        chosen: written: the segments, -1 for still surfaces.

    Returns:
        The number of crossings.
    """
    ends = segments.ends
    count, depth, i, j = 0, 0, 0, first
    while i < 2 * found or j < end:
        k = spans[i // 2, i % 2] if i < 2 * found else -1
        if j >= end or (k >= 0 and places[k] < still[j]):
            place, s, step = places[k], owners[k], 1 - 2 * (i % 2)
            i += 1
        else:
            place, s, step = still[j], -1, 1 - 2 * ((j - first) % 2)
            j += 1
        if depth == 0 or depth + step == 0:
            crossings[count], chosen[count] = place, s
            if s >= 0:
                du, dv = ends[s, 2] - ends[s, 0], ends[s, 3] - ends[s, 1]
                slopes[count] = abs(dv if across == 0 else du) / math.sqrt(du * du + dv * dv)
            else:
                slopes[count] = 1.0
            count += 1
        depth += step
    return count


@compiled
def add_normal_equations(
    body: ContourBody,
    still: Border,
    border: Border,
    movements: Movements,
    X_CW: np.ndarray,
    camera: np.ndarray,
    stride: int,
    offset: int,
    scale: float,
    slack: float,
    H: np.ndarray,
    g: np.ndarray,
) -> tuple[float, float, float]:
    """Adds one view's normal equations H step = -g of the weighted residuals.

    Args:
        body: the surfaces.
        still: the border of the union of those that do not.
        border: the silhouette's border.
        movements: pose and motions.
        X_CW, camera: the camera's pose and parameters.
        stride, offset: every so many rows and columns are looked at, from this one on.
        scale: residuals beyond it lose weight [pixel].
        slack: distances up to this hardly count [pixel]; 0: all do.
        H: (c, c) symmetric, added to.
        g: (c,) added to.

    Returns:
        The pixels that body or silhouette covers, but not both, as the rows looked at show them;
        the sum of all weights; and that of the weighted squares of the residuals.
    """
    segments = find_body_segments(body, seen_from(X_CW, movements.X_WS), camera, movements.moved)
    ends = segments.ends
    apart, total, squares = 0.0, 0.0, 0.0
    row = np.empty(movements.columns.shape[0])
    spans = np.empty((ends.shape[0] + 1, 2), dtype=np.int64)
    most = 2 * ends.shape[0] + 2 + max(still.row_places.shape[0], still.column_places.shape[0])
    chosen = np.empty(most, dtype=np.int64)
    places, slopes = np.empty(most), np.empty(most)
    weights, residuals = np.empty(most), np.empty(most)
    for across in range(2):
        border_starts = border.row_starts if across == 0 else border.column_starts
        border_places = border.row_places if across == 0 else border.column_places
        still_starts = still.row_starts if across == 0 else still.column_starts
        still_places = still.row_places if across == 0 else still.column_places
        lines = (int(camera[7 - across]) - 1 - offset) // stride + 1
        starts, all_places, owners = find_crossings(
            segments, across, float(offset), float(stride), lines
        )
        extent = camera[6 + across] - 0.5
        for line in range(lines):
            at = offset + line * stride
            first, end = border_starts[at], border_starts[at + 1]
            found = find_line_spans(segments, across, starts, all_places, owners, line, spans)
            if found == 0:
                if across == 0:
                    apart += still.row_apart[at]
                continue
            count = unite_spans(
                segments, across, spans, found, all_places, owners,
                still_places, still_starts[at], still_starts[at + 1], places, slopes, chosen,
            )  # fmt: skip
            if across == 0:
                apart += pixels_apart(places, count, border_places, first, end, int(camera[6]))
            if first == end:
                continue
            compare_line(
                places,
                slopes,
                count,
                border_places,
                first,
                end,
                extent,
                scale,
                slack,
                weights,
                residuals,
            )
            for k in range(count):
                s = chosen[k]
                if s < 0 or weights[k] == 0.0:
                    continue
                surface = segments.nodes[s]
                begin = movements.mover_starts[surface]
                movers = movements.mover_starts[surface + 1] - begin
                a, b = ends[s, 1 - across], ends[s, 3 - across]
                # The normal that points on along the line, as the residuals do.
                rising = b > a
                sign = 1.0 if rising == (across == 0) else -1.0
                write_row(body, segments, s, (at - a) / (b - a), sign, movements, X_CW, camera, row)
                weight, residual = stride * weights[k], stride * residuals[k]
                total += weight
                squares += residual * residuals[k] / weights[k]
                for i in range(movers):
                    mi, scaled = movements.movers[begin + i], weight * row[i]
                    g[mi] += residual * row[i]
                    for j in range(i + 1):
                        H[mi, movements.movers[begin + j]] += scaled * row[j]
    for i in range(H.shape[0]):
        for j in range(i):
            H[j, i] = H[i, j]
    return stride * apart, total, squares


@compiled
def find_contour_border(
    body: ContourBody,
    X_CW: np.ndarray,
    X_WS: np.ndarray,
    camera: np.ndarray,
    wanted: np.ndarray,
    border: Border,
) -> Border:
    """Where rows and columns of pixel centres enter and leave the union of some surfaces.

    Args:
        body: the surfaces.
        X_CW, camera: the camera's pose and parameters.
        X_WS: (surfaces, 4, 4) their poses.
        wanted: (surfaces,) bool which.
        border: the silhouette's border.
    """
    segments = find_body_segments(body, seen_from(X_CW, X_WS), camera, wanted)
    borders = []
    spans = np.empty((segments.ends.shape[0] + 1, 2), dtype=np.int64)
    for across in range(2):
        lines = int(camera[7 - across])
        starts, places, owners = find_crossings(segments, across, 0.0, 1.0, lines)
        kept = np.empty_like(places)
        kept_starts = np.zeros(lines + 1, dtype=np.int64)
        count = 0
        for line in range(lines):
            found = find_line_spans(segments, across, starts, places, owners, line, spans)
            for k in range(2 * found):
                kept[count] = places[spans[k // 2, k % 2]]
                count += 1
            kept_starts[line + 1] = count
        borders.append((kept_starts, kept[:count].copy()))
    row_starts, row_places = borders[0]
    row_apart = np.empty(row_starts.shape[0] - 1)
    for row in range(row_apart.shape[0]):
        begin, after = row_starts[row], row_starts[row + 1]
        first, end = border.row_starts[row], border.row_starts[row + 1]
        row_apart[row] = pixels_apart(
            row_places[begin:after], after - begin, border.row_places, first, end, int(camera[6])
        )
    return Border(row_starts, row_places, borders[1][0], borders[1][1], row_apart)


@compiled
def count_apart(
    body: ContourBody, X_CW: np.ndarray, X_WS: np.ndarray, camera: np.ndarray, border: Border
) -> int:
    """The number of pixels that either body or silhouette covers, but not both.

    Args:
        body: the surfaces.
        X_CW, camera: the camera's pose and parameters.
        X_WS: (surfaces, 4, 4) their poses.
        border: the silhouette's border.
    """
    everything = np.ones(X_WS.shape[0], dtype=np.bool_)
    segments = find_body_segments(body, seen_from(X_CW, X_WS), camera, everything)
    width, height = int(camera[6]), int(camera[7])
    starts, places, owners = find_crossings(segments, 0, 0.0, 1.0, height)
    spans = np.empty((segments.ends.shape[0] + 1, 2), dtype=np.int64)
    crossings = np.empty(2 * spans.shape[0])
    total = 0.0
    for row in range(height):
        count = 2 * find_line_spans(segments, 0, starts, places, owners, row, spans)
        for k in range(count):
            crossings[k] = places[spans[k // 2, k % 2]]
        first, end = border.row_starts[row], border.row_starts[row + 1]
        total += pixels_apart(crossings, count, border.row_places, first, end, width)
    return round(total)
