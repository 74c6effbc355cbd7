"""Read and write the intrinsics and poses of cameras in `meta/info.json` of LeRobot data sets.

The format has no fields for them. DROID's data sets call them camera_intrinsics and
camera_extrinsics, and so are they called here, in the `info` of the camera's feature.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from drake_pose.camera.episode import EpisodeCamera
from drake_pose.camera.models import PinholeCamera, check_number, check_pose
from drake_pose.errors import CameraError


def camera_fields(camera: PinholeCamera, link: str | None = None) -> dict[str, Any]:
    """Return the fields of a camera for its feature's `info`.

    camera_intrinsics is the camera matrix [pixel], pixel centres at integers; camera_extrinsics is
    X_WC (4 x 4) [m], x right, y down, z forward, in the robot's base or in ``link``.
    """
    fx, fy, cx, cy = camera.focal_x, camera.focal_y, camera.center_x, camera.center_y
    return {
        "camera_intrinsics": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "camera_extrinsics": camera.X_WC.tolist(),
        **({} if link is None else {"camera_link": link}),
    }


def with_fields(camera: EpisodeCamera, fields: Mapping[str, Any], where: str) -> EpisodeCamera:
    """Return a recorded camera with the intrinsics and pose in its feature's fields, if any.

    ``camera``: the recorded camera. ``fields``: fields of its feature and of the feature's `info`,
    as of `camera_fields`. ``where``: the file, for messages. Raises CameraError: a field is
    invalid, or there is a pose without intrinsics.
    """
    matrix, pose = fields.get("camera_intrinsics"), fields.get("camera_extrinsics")
    if matrix is None and pose is None:
        return camera
    where = f"{where}: camera '{camera.name}'"
    try:
        K = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        K = np.zeros(0)
    if K.shape != (3, 3) or not (K[0, 0] > 0.0 and K[1, 1] > 0.0):
        raise CameraError(
            f"{where}: camera_intrinsics must be [[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]] [pixel]"
        )
    fx, fy, cx, cy = (
        check_number(float(K[place]), "camera_intrinsics", where)
        for place in ((0, 0), (1, 1), (0, 2), (1, 2))
    )
    X_WC = np.eye(4) if pose is None else check_pose(pose, "camera_extrinsics", where)
    link = fields.get("camera_link")
    found = PinholeCamera(camera.name, camera.width, camera.height, fx, fy, cx, cy, X_WC)
    is_posed = pose is not None and link is None
    return replace(camera, camera=found, link=link, is_posed=is_posed)
