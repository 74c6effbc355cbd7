"""How sure a camera's pose is, where contours do not err point by point.

As for a pose of the body (``matching.fit.covariance``) there are the noise of points, the surface
of a part in all frames alike, its edge in one mask, and each frame as a whole, whose joint
positions or picture may be a little off. How large these are is told by what is left of the
distances. How wide each mask is was fitted, and is as unsure as that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.matching.fit.contour_fit import pack_cameras, pixels_per_metre
from drake_pose.matching.fit.covariance import (
    ErrorSizes,
    Picture,
    distances_in_pictures,
    estimate_sizes,
    values_covariance,
    widening,
)
from drake_pose.matching.fit.levenberg_marquardt import Round
from drake_pose.registration.calibration_fit import Calibration, CalibrationFit
from drake_pose.registration.camera_fit import CameraFit

Array = NDArray[np.float64]

_FINE = Round(0.025, 0.01)
# Where parts err by so much [pixel], a calibration is no better than this [pixel].
_PARTS_ERR, _NO_BETTER = 0.2, 1.0


class Uncertainty(NamedTuple):
    """How sure a calibration is.

    Attributes:
        covariance: (u, u) of the shared unknowns, by the names of the fit.
        information: (u, u) what the contours say of them, if each point erred by itself.
    """

    covariance: Array
    information: Array


def calibration_uncertainty(fit: CalibrationFit, found: Calibration) -> Uncertainty:
    """How sure the shared unknowns of a calibration are.

    Args:
        fit: what fitted it.
        found: the calibration.
    """
    rows = [(c, int(k)) for c, frames in enumerate(fit.which) for k in frames]
    shared = len(fit.names)
    pictures = []
    for place, (c, k) in enumerate(rows):
        own, width, X_CW = fit.fits[c], float(found.widths[c][k]), found.X_CW[c]
        values = fit.values(found, c, k)
        compared = own.compare(X_CW, k, _FINE, width, values, found.log_focal[c])
        X_WN = compared.placement.X_WN
        camera = own.frames.camera.with_pose(np.linalg.inv(X_CW))
        size = 1.0 / float(pixels_per_metre(pack_cameras([camera]), X_WN[:, :3, 3].mean(axis=0))[0])
        moves = np.zeros((len(X_WN), shared + len(rows), 12))
        moves[:, :shared] = fit.motions(found, c, compared.placement.dense(len(values)))
        for n, (outline, X) in enumerate(zip(own.contours.outlines, X_WN, strict=True)):
            if len(outline.vertices):
                moves[n, shared + place] = widening(outline.vertices, X) * size
        pictures.append(Picture(compared.A[0], compared.b[0], X_WN, X_CW, moves, size))
    seen = distances_in_pictures(fit.fits[0].contours.outlines, pictures)
    is_angle = np.zeros(shared + len(rows), bool)
    sizes = estimate_sizes(seen, is_angle, least_camera=0.0)
    covariance = values_covariance(seen, sizes, np.arange(len(is_angle)), is_angle)
    trusted = _calibration_error(sizes)
    for c in range(len(fit.fits)):
        unseen = _unseen_errors(fit, found, c, trusted)
        at = np.arange(len(unseen)) + c * len(unseen)
        covariance[at, at] += unseen**2
    H = seen.information
    width_gain = np.linalg.solve(
        H[shared:, shared:] + 1e-9 * np.eye(len(rows)), H[shared:, :shared]
    )
    return Uncertainty(
        covariance[:shared, :shared], H[:shared, :shared] - H[:shared, shared:] @ width_gain
    )


def _calibration_error(sizes: ErrorSizes) -> float:
    """By how much a calibration may be off that no frame contradicts [pixel].

    Intrinsics that are wrong, and a lens that was not quite undone, err alike in all frames: the
    pose follows, and nothing is left of it. Where parts are seen to err, a calibration is not
    trusted beyond a pixel either; where all else is exact, it is taken to be.
    """
    return min(_NO_BETTER, _NO_BETTER * (sizes.surface**2 + sizes.mask**2) / _PARTS_ERR**2)


def _unseen_errors(fit: CalibrationFit, found: Calibration, camera: int, pixels: float) -> Array:
    """(6 or 7,) by how much a camera's turn, shift and focal length are off then: deviations."""
    frames = fit.fits[camera].frames
    X_CW = found.X_CW[camera]
    depth = float(X_CW[2, :3] @ frames.middle + X_CW[2, 3])
    size = pixels * depth / frames.camera.focal_x
    turn = size / frames.extent
    return np.array([turn, turn, turn, size, size, size * depth / frames.extent, turn])[
        : fit.per_camera
    ]


def pose_covariance(fit: CameraFit, X_CW: Array, covariance: Array) -> Array:
    """(6, 6) of a camera's error in the world: a rotation vector [rad], a shift [m].

    Args:
        fit: the camera's.
        X_CW: (4, 4) its pose.
        covariance: (6, 6) of its turn and shift as they were fitted.
    """
    J = _in_world(fit, X_CW)
    return J @ covariance @ J.T


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
