"""Distances between a body's contour and a silhouette's border along the lines of a raster.

Along every row (and column) the contour of the body and the border of the silhouette are crossed a
few times, each time into or out of the covered part. Each crossing of the one is compared with the
nearest of the same sense of the other, in both directions; their distance along the line times the
cosine between line and contour normal is a residual of least squares [pixel]. A silhouette drawn by
pixels has its border half way between two pixels there, which is where the truth is on average.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled

_FAR = 1e9
# What distances within the slack weigh: enough to choose among the poses that all bounds allow.
_WITHIN = 0.03


class Border(NamedTuple):
    """Where a silhouette's border crosses rows and columns of pixel centres.

    row_starts: (H + 1,) where each row's crossings begin; row_places: (n,) u, half way between two
    pixels; column_starts: (W + 1,) and column_places: (m,) v likewise; row_apart: (H,) the pixels
    by which each row of a body differs from the silhouette's, 0 in a silhouette itself.
    """

    row_starts: np.ndarray
    row_places: np.ndarray
    column_starts: np.ndarray
    column_places: np.ndarray
    row_apart: np.ndarray


def find_border(mask: np.ndarray) -> Border:
    """The border of a silhouette (H, W) bool; what lies beyond the picture counts as outside."""
    pixels = np.ascontiguousarray(mask).view(np.uint8)
    rows, row_places = _find_changes(pixels)
    columns, column_places = _find_changes(np.ascontiguousarray(pixels.T))
    return Border(rows, row_places, columns, column_places, np.zeros(len(mask)))


def _find_changes(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the lines of pixels (n, m) change between 0 and 1: Border's starts and places."""
    lines, places = np.nonzero(np.diff(np.pad(pixels, ((0, 0), (1, 1)))))
    return np.searchsorted(lines, np.arange(len(pixels) + 1)), places - 0.5


@compiled
def _nearest(place: float, places: np.ndarray, first: int, end: int) -> float:
    """The signed distance from the nearest of every second place; _FAR where there is none."""
    best = _FAR
    for k in range(first, end, 2):
        distance = place - places[k]
        if abs(distance) < abs(best):
            best = distance
    return best


@compiled
def pixels_apart(
    places: np.ndarray, count: int, border: np.ndarray, first: int, end: int, width: int
) -> float:
    """The number of a line's pixels that either body or silhouette covers, but not both.

    As ``kernel.score`` counts: a pixel is covered if its centre is.

    Args:
        places: (count,) the body's crossings.
        count: their number.
        border: the silhouette's crossings; this line's are those from ``first`` to ``end``.
        width: the line's length [pixel].
    """
    length, open_at, inside = 0.0, -0.5, False
    i, j = 0, first
    while i < count or j < end:
        place = min(max(math.ceil(places[i]), 0), width) - 0.5 if i < count else _FAR
        if j < end and border[j] <= place:
            place = border[j]
            j += 1
        else:
            i += 1
        if inside:
            length += place - open_at
        inside, open_at = not inside, place
    return length


@compiled
def compare_line(
    places: np.ndarray,
    slopes: np.ndarray,
    count: int,
    border: np.ndarray,
    first: int,
    end: int,
    extent: float,
    scale: float,
    slack: float,
    weights: np.ndarray,
    residuals: np.ndarray,
) -> None:
    """Writes each contour crossing's weight and weighted residual.

    Args:
        places: (count,) the contour's crossings, in turns in and out.
        slopes: (count,) cosines between the line and the contour's normal there.
        border: the silhouette's crossings; this line's are those from ``first`` to ``end``.
        extent: the picture's end [pixel].
        scale: residuals beyond it lose weight (Geman and McClure 1987) [pixel].
        slack: distances up to this hardly count [pixel]; 0: all do.
        weights, residuals: written.
    """
    for k in range(count):
        weights[k] = residuals[k] = 0.0
        if -0.5 <= places[k] <= extent:
            distance = _nearest(places[k], border, first + k % 2, end)
            if distance < _FAR:
                _add_distance(distance, slopes[k], scale, slack, k, weights, residuals)
    for m in range(first, end):
        best, nearest = _FAR, -1
        for k in range((m - first) % 2, count, 2):
            distance = places[k] - border[m]
            if abs(distance) < abs(best):
                best, nearest = distance, k
        if nearest >= 0 and -0.5 <= places[nearest] <= extent:
            _add_distance(best, slopes[nearest], scale, slack, nearest, weights, residuals)


@compiled(inline="always")
def _add_distance(
    distance: float,
    slope: float,
    scale: float,
    slack: float,
    k: int,
    weights: np.ndarray,
    residuals: np.ndarray,
) -> None:
    """Adds one distance along a line to a crossing's weight and weighted residual."""
    residual = distance * slope
    weight = 0.5 * slope / (1.0 + (residual / scale) ** 2)
    if slack > 0.0:
        beyond = abs(distance) - slack
        if beyond > 0.0:
            hinge = math.copysign(beyond, distance) * slope
            residuals[k] += weight * hinge
            weights[k] += weight
        weight *= _WITHIN
    weights[k] += weight
    residuals[k] += weight * residual


@compiled
def clear_spans(border: Border, stride: int, free: np.ndarray) -> None:
    """Clears what a body covers from a picture of every so many rows and columns (h, w) bool.

    Args:
        border: the body's.
        stride: every so many rows and columns are in the picture.
        free: written.
    """
    for row in range(free.shape[0]):
        first, end = border.row_starts[row * stride], border.row_starts[row * stride + 1]
        for k in range(first, end, 2):
            begin = max(math.ceil(border.row_places[k] / stride), 0)
            after = min(math.ceil(border.row_places[k + 1] / stride), free.shape[1])
            for column in range(begin, after):
                free[row, column] = False


@compiled
def add_apart_near(
    body: Border, border: Border, discs: np.ndarray, stride: int, areas: np.ndarray
) -> None:
    """Adds the pixels within each disc that either body or silhouette covers, but not both.

    Args:
        body, border: the body's border and the silhouette's.
        discs: (n, 3) centres and radii [pixel].
        stride: every so many rows are looked at.
        areas: (n,) added to [pixel].
    """
    for row in range(0, border.row_starts.shape[0] - 1, stride):
        i, i_end = body.row_starts[row], body.row_starts[row + 1]
        j, j_end = border.row_starts[row], border.row_starts[row + 1]
        inside, open_at = False, 0.0
        while i < i_end or j < j_end:
            if j >= j_end or (i < i_end and body.row_places[i] < border.row_places[j]):
                # Pixels count whole.
                place = math.ceil(body.row_places[i]) - 0.5
                i += 1
            else:
                place = border.row_places[j]
                j += 1
            if inside and place > open_at:
                for d in range(discs.shape[0]):
                    half = discs[d, 2] ** 2 - (row - discs[d, 1]) ** 2
                    if half > 0.0:
                        half = math.sqrt(half)
                        low = max(open_at, discs[d, 0] - half)
                        areas[d] += stride * max(min(place, discs[d, 0] + half) - low, 0.0)
            inside, open_at = not inside, place
