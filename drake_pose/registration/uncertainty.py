"""How sure a camera's pose is, where contours do not err point by point.

As for a pose of the body (``matching.fit.covariance``) there are the noise of points, the surface
of a part in all frames alike, its edge in one mask, and each frame as a whole, whose joint
positions or picture may be a little off. How large these are is told by what is left of the
distances. How wide each mask is was fitted, and is as unsure as that.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_pose.matching.fit.contour_fit import pack_cameras, pixels_per_metre
from drake_pose.matching.fit.covariance import (
    Picture,
    distances_in_pictures,
    estimate_sizes,
    values_covariance,
    widening,
)
from drake_pose.matching.fit.levenberg_marquardt import Round
from drake_pose.registration.camera_fit import POSE_NAMES, CameraFit, FittedCamera

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_FINE = Round(0.025, 0.01)
_IS_ANGLE = np.array([name.startswith("turn") for name in POSE_NAMES])


def camera_covariance(fit: CameraFit, fitted: FittedCamera, which: Indices) -> Array:
    """(6, 6) of a fitted camera's error: a rotation vector [rad], a shift [m], in the world.

    Args:
        fit: what fitted it.
        fitted: its pose, and the silhouettes' widths.
        which: the frames that counted.
    """
    X_CW, motions = fitted.X_CW, fit.motions(fitted.X_CW)
    outlines = fit.contours.outlines
    camera = pack_cameras([fit.frames.camera.with_pose(np.linalg.inv(X_CW))])
    pictures = []
    for place, k in enumerate(which):
        compared = fit.compare(X_CW, int(k), _FINE, float(fitted.widths[k]))
        X_WN = compared.placement.X_WN
        size = 1.0 / float(pixels_per_metre(camera, X_WN[:, :3, 3].mean(axis=0))[0])
        moves = np.zeros((len(X_WN), len(POSE_NAMES) + len(which), 12))
        moves[:, : len(POSE_NAMES)] = motions
        for n, (outline, X) in enumerate(zip(outlines, X_WN, strict=True)):
            moves[n, len(POSE_NAMES) + place] = widening(outline.vertices, X) * size
        pictures.append(Picture(compared.A[0], compared.b[0], X_WN, X_CW, moves, size))
    seen = distances_in_pictures(outlines, pictures)
    is_angle = np.append(_IS_ANGLE, np.zeros(len(which), bool))
    sizes = estimate_sizes(seen, is_angle, least_camera=0.0)
    own = values_covariance(seen, sizes, np.arange(len(is_angle)), is_angle)
    J = _in_world(fit, X_CW)
    return J @ own[: len(J), : len(J)] @ J.T


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
