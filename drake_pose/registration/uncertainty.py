"""How sure a camera's pose is, where contours do not err point by point.

As for a pose of the body (``matching.fit.covariance``) there are the noise of points, the surface
of a part in all frames alike, its edge in one mask, and each frame as a whole, whose joint
positions or picture may be a little off, and whose mask a little too wide. How large these are is
told by what is left of the distances.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_pose.matching.fit.contour_fit import pixels_per_metre
from drake_pose.matching.fit.covariance import (
    Picture,
    distances_in_pictures,
    estimate_sizes,
    values_covariance,
)
from drake_pose.matching.fit.levenberg_marquardt import Round
from drake_pose.registration.camera_fit import POSE_NAMES, CameraFit

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_FINE = Round(0.025, 0.01)
_IS_ANGLE = np.array([name.startswith("turn") for name in POSE_NAMES])


def camera_covariance(fit: CameraFit, X_CW: Array, which: Indices) -> Array:
    """(6, 6) of a fitted camera's error: a rotation vector [rad], a shift [m], in the world.

    Args:
        fit: what fitted it.
        X_CW: (4, 4) its pose.
        which: the frames that counted.
    """
    motions = fit.motions(X_CW)
    pictures = []
    for k, views in enumerate(fit.views(X_CW)):
        if k in which:
            compared = fit.contours.compare_views(views, fit.values[k], _FINE)
            X_WN = compared.placement.X_WN
            size = 1.0 / float(pixels_per_metre(views.cameras, X_WN[:, :3, 3].mean(axis=0))[0])
            moves = np.tile(motions, (len(X_WN), 1, 1))
            pictures.append(Picture(compared.A[0], compared.b[0], X_WN, X_CW, moves, size))
    seen = distances_in_pictures(fit.contours.outlines, pictures, wider=True)
    sizes = estimate_sizes(seen, _IS_ANGLE, least_camera=0.0)
    own = values_covariance(seen, sizes, np.arange(6), _IS_ANGLE)
    return _in_world(fit, X_CW) @ own @ _in_world(fit, X_CW).T


def _in_world(fit: CameraFit, X_CW: Array) -> Array:
    """(6, 6) how the error of the camera's pose in the world follows POSE_NAMES."""
    R_WC, p_WC = X_CW[:3, :3].T, -X_CW[:3, :3].T @ X_CW[:3, 3]
    J = np.zeros((6, 6))
    step = 1e-6
    for k in range(6):
        moved = np.linalg.inv(fit.moved(X_CW, step * np.eye(6)[k]))
        turn = moved[:3, :3] @ R_WC.T
        J[:3, k] = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / step
        J[3:, k] = (moved[:3, 3] - p_WC) / step
    return J
