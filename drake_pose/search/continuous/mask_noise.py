"""Silhouettes full of specks: what their edges are cannot be told before the specks are gone."""

from __future__ import annotations

import cv2
import numpy as np

# Connected pixels, or holes, no larger than this are specks [pixel].
_SPECK = 6
# Masks are left alone whose specks have a smaller share of the silhouette's area.
_SPECKLED = 0.02
_WINDOW = 5


def without_specks(mask: np.ndarray) -> np.ndarray:
    """A mask without salt and pepper noise; one with few specks stays as it is.

    A median over 5 x 5 pixels takes specks away, but also what is thinner than three pixels, so it
    is only used where specks are many.

    Args:
        mask: (H, W) bool.

    Returns:
        (H, W) bool, not empty if the mask is not.
    """
    inside = mask.astype(np.uint8)
    specks = sum(_speck_area(side) for side in (inside, 1 - inside))
    if specks <= _SPECKLED * np.count_nonzero(mask):
        return mask
    cleaned = cv2.medianBlur(inside, _WINDOW) > 0
    return cleaned if cleaned.any() else mask


def _speck_area(inside: np.ndarray) -> int:
    """The area of all small connected parts of a mask [pixel]."""
    _, _, statistics, _ = cv2.connectedComponentsWithStats(inside, connectivity=4)
    areas = statistics[1:, cv2.CC_STAT_AREA]
    return int(areas[areas <= _SPECK].sum())
