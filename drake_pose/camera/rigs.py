"""Ready rigs of several cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError

Array = NDArray[np.float64]

FACE_CAMERA = "face"
"""The name of the camera that looks at the face."""

# As high as a grown person's face; a narrow view, for the face should fill the picture.
_FACE_HEIGHT, _FACE_VIEW = 1.6, math.radians(22.0)


def circle_of_cameras(
    count: int = 8,
    *,
    radius: float = 3.0,
    height: float = 1.3,
    target: Sequence[float] = (0.0, 0.0, 0.95),
    field_of_view: float = math.radians(46.0),
    size: tuple[int, int] = (640, 480),
    face_camera: bool = True,
) -> dict[str, PinholeCamera]:
    """Cameras evenly on a circle that look at its middle, and one that looks at the face.

    Date et al. (figure 1) have eight "horizontal" cameras about 45 degrees apart and one for the
    face. The world's z is up; a person in the middle who faces +x looks into the face camera.

    Args:
        count: cameras on the circle, camera_0, camera_1 ... counterclockwise from above; the x axis
            lies half-way between the last and the first.
        radius, height: where the cameras of the circle are [m].
        target: (3,) the point they look at [m].
        field_of_view: of a camera on the circle, upright [rad].
        size: width and height of the pictures [pixel].

    Raises CameraError when there is no camera, or a number is out of its range.
    """
    if count < 1 and not face_camera:
        raise CameraError("a rig needs at least one camera")
    if not (0.0 < radius < math.inf and 0.0 < field_of_view < math.pi):
        raise CameraError("a rig's radius must be positive, its field of view below 180 degrees")
    cameras = {}
    for k in range(count):
        angle = 2.0 * math.pi * (k + 0.5) / count
        eye = [radius * math.cos(angle), radius * math.sin(angle), height]
        name = f"camera_{k}"
        cameras[name] = _camera(name, look_at(eye, target), field_of_view, size)
    if face_camera:
        face = [target[0], target[1], _FACE_HEIGHT]
        eye = [target[0] + radius, target[1], _FACE_HEIGHT]
        cameras[FACE_CAMERA] = _camera(FACE_CAMERA, look_at(eye, face), _FACE_VIEW, size)
    return cameras


def look_at(
    eye: Sequence[float] | Array, target: Sequence[float] | Array, up: Sequence[float] = (0, 0, 1)
) -> Array:
    """The pose X_WC (4, 4) of a camera at `eye` (3,) that looks at `target` (3,) [m].

    Raises CameraError when both points coincide, or the camera looks along `up`.
    """
    forward = np.asarray(target, dtype=np.float64) - np.asarray(eye, dtype=np.float64)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
        raise CameraError(f"a camera at {list(eye)} cannot look at {list(target)} with {up} up")
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    X_WC[:3, 3] = eye
    return X_WC


def _camera(name: str, X_WC: Array, field_of_view: float, size: tuple[int, int]) -> PinholeCamera:
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * field_of_view)
    center = 0.5 * (width - 1), 0.5 * (height - 1)
    return PinholeCamera(name, width, height, focal, focal, *center, X_WC)
