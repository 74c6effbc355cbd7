"""A silhouette made ready for bit masks: its pixels numbered, row after row.

Only the silhouette's pixels, and those in a band around it, get a bit. The pixels of a span of a
row that are in the silhouette have consecutive numbers, so that the prefix sums of the mask tell
which run of bits a span sets, and a mask of a body of 20,000 pixels is 300 words.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled

WORD = 64
_FAR = 1 << 14


class BitView(NamedTuple):
    """One silhouette and the band around it, cropped to a window of the picture.

    camera: (8,) kernel parameters; X_CW: (4, 4); window: (4,) int64 first row, first column,
    height h and width w; inside: (h, w + 1) int32 the number of silhouette pixels before each
    pixel, row after row; band: the same of the band's pixels, (0, 0) where there is no band;
    nearest: (h, w) int32 row * 32768 + column [picture] of the pixel nearest to each silhouette
    pixel that is in the picture and not in the silhouette, -1 where there is none; sums:
    (h + 1, w + 1) int32 the number of silhouette pixels above and left of each corner.
    """

    camera: np.ndarray
    X_CW: np.ndarray
    window: np.ndarray
    inside: np.ndarray
    band: np.ndarray
    nearest: np.ndarray
    sums: np.ndarray


def make_bit_view(
    mask: np.ndarray, camera_parameters: np.ndarray, X_CW: np.ndarray, band: int
) -> BitView:
    """Returns the silhouette's bits.

    Args:
        mask: (H, W) bool, not empty.
        camera_parameters: (8,) the camera's kernel parameters.
        X_CW: (4, 4) the world's pose in the camera.
        band: the width of the band [pixel]; 0: none, and only bodies that stay inside the
            silhouette can be told apart by their bits.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask[rows[0] : rows[-1] + 1].any(axis=0))
    margin = max(1, band)
    top, left = max(0, rows[0] - margin), max(0, columns[0] - margin)
    bottom = min(mask.shape[0], rows[-1] + 1 + margin)
    right = min(mask.shape[1], columns[-1] + 1 + margin)
    pixels = np.ascontiguousarray(mask[top:bottom, left:right]).view(np.uint8)
    nothing = np.zeros((0, 0), dtype=np.int32)
    around = nothing
    if band:
        near = _widen(pixels, band)
        around = _number_pixels(near & ~pixels & 1)
    return BitView(
        camera=camera_parameters,
        X_CW=np.ascontiguousarray(X_CW, dtype=np.float64),
        window=np.array([top, left, *pixels.shape], dtype=np.int64),
        inside=_number_pixels(pixels),
        band=around,
        nearest=_find_nearest(pixels, int(top), int(left)),
        sums=_sum_corners(pixels),
    )


@compiled
def _number_pixels(mask: np.ndarray) -> np.ndarray:
    """Returns (h, w + 1) int32: how many pixels of a mask (h, w) uint8 come before each."""
    numbers = np.empty((mask.shape[0], mask.shape[1] + 1), dtype=np.int32)
    count = 0
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            numbers[row, column] = count
            count += mask[row, column]
        numbers[row, mask.shape[1]] = count
    return numbers


@compiled
def _sum_corners(mask: np.ndarray) -> np.ndarray:
    """Returns (h + 1, w + 1) int32: the pixels of a mask (h, w) above and left of each corner."""
    sums = np.zeros((mask.shape[0] + 1, mask.shape[1] + 1), dtype=np.int32)
    for row in range(mask.shape[0]):
        count = 0
        for column in range(mask.shape[1]):
            count += mask[row, column]
            sums[row + 1, column + 1] = sums[row, column + 1] + count
    return sums


@compiled
def _widen(mask: np.ndarray, distance: int) -> np.ndarray:
    """Returns the pixels (h, w) uint8 within a distance of a mask, along rows and columns."""
    height, width = mask.shape
    wide = np.zeros_like(mask)
    for row in range(height):
        last = -_FAR
        for column in range(width):
            last = column if mask[row, column] else last
            wide[row, column] = column - last <= distance
        last = _FAR
        for column in range(width - 1, -1, -1):
            last = column if mask[row, column] else last
            if last - column <= distance:
                wide[row, column] = 1
    result = np.zeros_like(mask)
    last_rows = np.full(width, -_FAR)
    for row in range(height):
        for column in range(width):
            if wide[row, column]:
                last_rows[column] = row
            result[row, column] = row - last_rows[column] <= distance
    last_rows[:] = _FAR
    for row in range(height - 1, -1, -1):
        for column in range(width):
            if wide[row, column]:
                last_rows[column] = row
            if last_rows[column] - row <= distance:
                result[row, column] = 1
    return result


@compiled
def _find_nearest(mask: np.ndarray, top: int, left: int) -> np.ndarray:
    """Returns BitView.nearest of a mask (h, w) uint8: first along columns, then along rows.

    Along a row the pixel nearest to (row, column) minimises (column - c)^2 + d(c)^2, the lower
    envelope of parabolas, with d(c) the distance along column c (Felzenszwalb and Huttenlocher).
    """
    height, width = mask.shape
    beside = np.full((height, width), _FAR, dtype=np.int32)
    last = np.full(width, -_FAR, dtype=np.int32)
    for row in range(height):
        for column in range(width):
            if mask[row, column] == 0:
                last[column] = row
            beside[row, column] = last[column]
    last[:] = _FAR
    for row in range(height - 1, -1, -1):
        for column in range(width):
            if mask[row, column] == 0:
                last[column] = row
            if last[column] - row < row - beside[row, column]:
                beside[row, column] = last[column]
    nearest = np.full((height, width), -1, dtype=np.int32)
    apex, begin = np.empty(width, dtype=np.int32), np.empty(width + 1)
    for row in range(height):
        count = 0
        for column in range(width):
            distance = abs(beside[row, column] - row)
            if distance >= _FAR // 2:
                continue
            place = -1e9
            while count > 0:
                other = apex[count - 1]
                d = abs(beside[row, other] - row)
                place = (distance * distance + column * column - d * d - other * other) / (
                    2.0 * (column - other)
                )
                if place > begin[count - 1]:
                    break
                count -= 1
                place = -1e9
            apex[count], begin[count] = column, place
            count += 1
        if count == 0:
            continue
        begin[count] = 1e9
        k = 0
        for column in range(width):
            while begin[k + 1] < column:
                k += 1
            if mask[row, column]:
                nearest[row, column] = (top + beside[row, apex[k]]) * 32768 + left + apex[k]
    return nearest
