"""A silhouette made ready for bit masks: its pixels, and a band's, numbered row after row.

The silhouette's pixels of a span have consecutive numbers, so the mask's prefix sums tell which run
of bits a span sets, and a mask of a body of 20,000 pixels is 300 words.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

WORD = 64
NEAREST_STRIDE = 32768
"""Of rows in BitView.nearest."""


class BitView(NamedTuple):
    """One silhouette and the band around it, cropped to a window of the picture.

    camera: (8,) kernel parameters; X_CW: (4, 4); window: (4,) int64 first row, first column,
    height h and width w; inside: (h, w + 1) int32 the number of silhouette pixels before each
    pixel, row after row; band: the same of the band's pixels, (0, 0) where there is no band;
    nearest: (h, w) int32 row * NEAREST_STRIDE + column [picture] of about the nearest pixel of the
    picture outside the silhouette for each silhouette pixel, -1 where there is none; sums:
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
    """The bits of a silhouette (H, W) bool that is not empty; X_CW (4, 4).

    ``band`` is the band's width [pixel]; 0: none, and only bodies that stay inside the silhouette
    can be told apart by their bits.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask[rows[0] : rows[-1] + 1].any(axis=0))
    margin = max(1, band)
    top, left = max(0, rows[0] - margin), max(0, columns[0] - margin)
    bottom = min(mask.shape[0], rows[-1] + 1 + margin)
    right = min(mask.shape[1], columns[-1] + 1 + margin)
    pixels = np.ascontiguousarray(mask[top:bottom, left:right]).view(np.uint8)
    around = np.zeros((0, 0), dtype=np.int32)
    if band:
        square = np.ones((2 * band + 1, 2 * band + 1), dtype=np.uint8)
        around = _number_pixels(cv2.dilate(pixels, square) - pixels)
    return BitView(
        camera=camera_parameters,
        X_CW=np.ascontiguousarray(X_CW, dtype=np.float64),
        window=np.array([top, left, *pixels.shape], dtype=np.int64),
        inside=_number_pixels(pixels),
        band=around,
        nearest=_find_nearest(pixels, int(top), int(left)),
        sums=cv2.integral(pixels),
    )


def _number_pixels(mask: np.ndarray) -> np.ndarray:
    """(h, w + 1) int32: how many pixels of a mask (h, w) uint8 come before each."""
    ends = np.cumsum(mask, dtype=np.int32).reshape(mask.shape)
    return np.concatenate([ends[:, :1] - mask[:, :1], ends], axis=1)


def _find_nearest(mask: np.ndarray, top: int, left: int) -> np.ndarray:
    """BitView.nearest of a mask (h, w) uint8."""
    if mask.all():
        return np.full(mask.shape, -1, dtype=np.int32)
    _, labels = cv2.distanceTransformWithLabels(
        mask, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    rows, columns = np.nonzero(mask == 0)
    places = np.full(labels.max() + 1, -1, dtype=np.int32)
    places[labels[rows, columns]] = (top + rows) * NEAREST_STRIDE + left + columns
    return np.where(mask, places[labels], np.int32(-1))
