"""Prefix sums of the rows of a mask: the area of a set under a span costs one subtraction."""

from __future__ import annotations

import numpy as np

from drake_pose.compiled import compiled


@compiled
def sum_rows(mask: np.ndarray, prefix: np.ndarray, first: int, end: int) -> None:
    """Writes the prefix sums of rows first to end of mask (H, W) uint8 to prefix (H, W + 1)."""
    for row in range(first, end):
        total = 0
        prefix[row, 0] = 0
        for pixel in range(mask.shape[1]):
            total += mask[row, pixel] != 0
            prefix[row, pixel + 1] = total
