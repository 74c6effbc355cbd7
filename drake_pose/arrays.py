"""Type aliases of the numpy arrays used in all subpackages, by element type."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]
