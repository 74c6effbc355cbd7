"""Type aliases of numpy arrays by element type, used in all subpackages; and even points."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers of any shape."""

Floats = NDArray[np.float32]
"""Single-precision numbers, for images and large tables."""

Indices = NDArray[np.int64]
"""Indices into other arrays."""

Mask = NDArray[np.bool_]
"""Flags, such as a silhouette (H, W) that is true on the body."""

Picture = NDArray[np.uint8]
"""An image (H, W, 3): red, green, blue."""


def halton_sequence(count: int, dimensions: int) -> Array:
    """Return the first `count` points (count, dimensions) of Halton's sequence, each in 0..1.

    They fill the unit cube evenly, as scipy.stats.qmc.Halton without scrambling does, whose import
    takes half a second.
    """
    points, base = np.zeros((count, dimensions)), 1
    for axis in range(dimensions):
        base = next(n for n in range(base + 1, 2 * base + 2) if all(n % k for k in range(2, n)))
        left, scale = np.arange(count), 1.0
        while left.any():
            scale /= base
            points[:, axis] += scale * (left % base)
            left //= base
    return points
