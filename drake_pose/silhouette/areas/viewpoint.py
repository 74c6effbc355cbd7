"""Where a camera stands in a node's frame."""

from __future__ import annotations

import numpy as np

from drake_pose.compiled import compiled


@compiled
def viewpoint_in_node(X: np.ndarray, camera: np.ndarray) -> tuple[float, float, float, float]:
    """Returns where a camera stands, or the way it looks, in a node's frame, times a last number.

    That is 0 where it is the way that a parallel camera looks. A pinhole stands there: opposite
    signs, which only turn the winding number's sign. The last number is 1 but where the pose X
    (4, 4) has grown.
    """
    if camera[0] != 0.0:
        return X[2, 0], X[2, 1], X[2, 2], 0.0
    t0, t1, t2 = X[0, 3], X[1, 3], X[2, 3]
    return (
        -(X[0, 0] * t0 + X[1, 0] * t1 + X[2, 0] * t2),
        -(X[0, 1] * t0 + X[1, 1] * t1 + X[2, 1] * t2),
        -(X[0, 2] * t0 + X[1, 2] * t1 + X[2, 2] * t2),
        X[0, 0] * X[0, 0] + X[1, 0] * X[1, 0] + X[2, 0] * X[2, 0],
    )
