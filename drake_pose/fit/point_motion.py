"""How the picture of a point moves with the point."""

from __future__ import annotations

import numpy as np

from drake_pose.compiled import compiled


@compiled
def picture_rows(p_W: np.ndarray, X_CW: np.ndarray, camera: np.ndarray, rows: np.ndarray) -> None:
    """Writes du/dp_W and dv/dp_W (2, 3) of a point."""
    x, y, z = X_CW[0, 3], X_CW[1, 3], X_CW[2, 3]
    for k in range(3):
        x += X_CW[0, k] * p_W[k]
        y += X_CW[1, k] * p_W[k]
        z += X_CW[2, k] * p_W[k]
    for k in range(3):
        if camera[0] == 1.0:
            rows[0, k] = camera[1] * X_CW[0, k]
            rows[1, k] = camera[2] * X_CW[1, k]
        else:
            rows[0, k] = camera[1] * (X_CW[0, k] - X_CW[2, k] * x / z) / z
            rows[1, k] = camera[2] * (X_CW[1, k] - X_CW[2, k] * y / z) / z


@compiled
def speed_along(row: np.ndarray, p: np.ndarray, twist: np.ndarray) -> float:
    """The speed of a point (3,) along a row (3,)."""
    s = twist[6]
    return (
        row[0] * (twist[1] * p[2] - twist[2] * p[1] + twist[3] + s * p[0])
        + row[1] * (twist[2] * p[0] - twist[0] * p[2] + twist[4] + s * p[1])
        + row[2] * (twist[0] * p[1] - twist[1] * p[0] + twist[5] + s * p[2])
    )
