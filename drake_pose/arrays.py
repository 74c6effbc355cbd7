"""Type aliases of the numpy arrays used in all subpackages, by element type."""

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
