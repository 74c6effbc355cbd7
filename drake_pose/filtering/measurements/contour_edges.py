"""Where a mask's edge lies beside the contour of a model."""

import math

import numpy as np
from numpy.typing import NDArray

from drake_pose.compiled import compiled

Array = NDArray[np.float64]

_STEP = 0.5


@compiled
def _is_inside(mask: NDArray[np.bool_], u: float, v: float) -> int:
    """1 inside of the mask, 0 outside of it, -1 beyond the picture; nearest pixel."""
    row, column = math.floor(v + 0.5), math.floor(u + 0.5)
    if row < 0 or column < 0 or row >= mask.shape[0] or column >= mask.shape[1]:
        return -1
    return 1 if mask[row, column] else 0


@compiled
def find_edges(mask: NDArray[np.bool_], uv: Array, normals: Array, reach: float) -> Array:
    """How far the mask's edge is from points of a contour, along their normals.

    An edge counts only if the mask is left there when one goes outwards; the nearest one is taken.

    Args:
        mask: (H, W) true inside.
        uv: (n, 2) points, pixel centres at integers.
        normals: (n, 2) unit normals out of the model's silhouette.
        reach: how far to look [pixel].

    Returns:
        (n,) signed distances [pixel], positive outwards; NaN where there is no edge within reach.
    """
    steps = math.ceil(reach / _STEP)
    found = np.full(len(uv), np.nan)
    for k in range(len(uv)):
        u, v, du, dv = uv[k, 0], uv[k, 1], normals[k, 0], normals[k, 1]
        here = _is_inside(mask, u, v)
        inner, outer = here, here
        for i in range(1, steps + 1):
            t = i * _STEP
            # Outwards: from inside to outside.
            following = _is_inside(mask, u + t * du, v + t * dv)
            if outer == 1 and following == 0:
                found[k] = t - 0.5 * _STEP
                break
            outer = following
            # Inwards: seen from there, the same.
            following = _is_inside(mask, u - t * du, v - t * dv)
            if following == 1 and inner == 0:
                found[k] = -(t - 0.5 * _STEP)
                break
            inner = following
    return found
