"""One camera's lens and the board's poses before it, from pictures of the board alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.calibration.board import Detection
from drake_pose.camera.calibration.lens import COEFFICIENTS, Lens
from drake_pose.errors import CameraError

Array = NDArray[np.float64]

LENS_MODELS = ("none", "standard", "full")
"""No distortion; k1, k2, p1 and p2; and k3 besides."""

FEWEST_PICTURES = 3


@dataclass(frozen=True, eq=False)
class LensEstimate:
    """A lens as one camera's pictures alone give it.

    Args:
        lens: the lens.
        X_CB: (4, 4) by frame: the board's pose in the camera [m].
        errors: by frame: root mean square distance of the corners [pixel].
        focal_deviation: standard deviation of the focal length over the focal length.
    """

    lens: Lens
    X_CB: Mapping[str, Array]
    errors: Mapping[str, float]
    focal_deviation: float


def estimate_lens(
    name: str,
    points: Array,
    detections: Mapping[str, Detection],
    size: tuple[int, int],
    model: str = "standard",
) -> LensEstimate:
    """Estimates a camera's lens (Zhang's method, OpenCV's calibrateCamera).

    Args:
        name: the camera's name, for messages.
        points: (n, 3) the board's corners in its frame B [m].
        detections: the board in the camera's pictures, by frame.
        size: the pictures' width and height [pixel].
        model: one of LENS_MODELS.

    Raises:
        CameraError: when there are fewer than three pictures of the board, or OpenCV finds no lens.
    """
    if len(detections) < FEWEST_PICTURES:
        found = ", ".join(f"'{frame}'" for frame in detections) or "none"
        raise CameraError(
            f"camera '{name}': the board was found in {len(detections)} pictures ({found}), but at "
            f"least {FEWEST_PICTURES} are needed, better 15, with the board tilted"
        )
    frames = list(detections)
    objects = [points[detections[frame].corners].astype(np.float32) for frame in frames]
    images = [detections[frame].uv.astype(np.float32) for frame in frames]
    try:
        _, matrix, distortion, turns, shifts, deviations, _, errors = cv2.calibrateCameraExtended(
            objects, images, size, np.eye(3), np.zeros(5), flags=lens_flags(model)
        )
    except cv2.error as error:
        raise CameraError(f"camera '{name}': OpenCV finds no lens: {error.err}") from error
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
        raise CameraError(f"camera '{name}': its pictures give no lens; tilt the board more")
    coefficients = np.zeros(len(COEFFICIENTS))
    coefficients[:] = np.ravel(distortion)[: len(COEFFICIENTS)]
    lens = Lens(
        width=size[0],
        height=size[1],
        focal_x=float(matrix[0, 0]),
        focal_y=float(matrix[1, 1]),
        center_x=float(matrix[0, 2]),
        center_y=float(matrix[1, 2]),
        distortion=coefficients,
    )
    poses = {
        frame: pose_matrix(np.ravel(turn), np.ravel(shift))
        for frame, turn, shift in zip(frames, turns, shifts, strict=True)
    }
    per_frame = {frame: float(e) for frame, e in zip(frames, np.ravel(errors), strict=True)}
    spread = float(np.ravel(deviations)[0] / lens.focal_x)
    return LensEstimate(lens, poses, per_frame, spread)


def lens_flags(model: str) -> int:
    """OpenCV's flags for one of LENS_MODELS.

    Raises:
        CameraError: when there is no such model.
    """
    if model not in LENS_MODELS:
        raise CameraError(f"the lens model must be one of {', '.join(LENS_MODELS)}, not '{model}'")
    flags = 0
    if model != "full":
        flags |= cv2.CALIB_FIX_K3
    if model == "none":
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_ZERO_TANGENT_DIST
    return int(flags)


def pose_matrix(turn: Array, shift: Array) -> Array:
    """Returns the pose (4, 4) of a rotation vector (3,) [rad] and a position (3,) [m]."""
    X = np.eye(4)
    X[:3, :3] = cv2.Rodrigues(np.asarray(turn, dtype=np.float64))[0]
    X[:3, 3] = shift
    return X


def pose_vector(X: Array) -> Array:
    """Returns (6,) rotation vector [rad] and position [m] of a pose (4, 4)."""
    return np.concatenate([np.ravel(cv2.Rodrigues(X[:3, :3])[0]), X[:3, 3]])


def inverse_pose(X_AB: Array) -> Array:
    """Returns X_BA (4, 4) of a pose (4, 4)."""
    X_BA = np.eye(4)
    X_BA[:3, :3] = X_AB[:3, :3].T
    X_BA[:3, 3] = -X_AB[:3, :3].T @ X_AB[:3, 3]
    return X_BA
