"""Whether a camera can see a body at all."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import CameraError
from drake_pose.silhouette.areas.outline import Outline
from drake_pose.silhouette.areas.scoring import draw_mask

# A body that is as large as this many pictures is not what they show.
_LARGER = 10.0


def require_visible(outlines: Sequence[Outline], X_CN: np.ndarray, camera: Camera) -> None:
    """Refuses a camera that cannot show a body whose surfaces are at X_CN (nodes, 4, 4).

    Raises:
        CameraError: names the camera; when the body is wholly behind it, when the camera is inside
            one of the surfaces, when the body is far larger than the picture, or wholly outside.
    """
    solid = [
        (outline, np.asarray(X))
        for outline, X in zip(outlines, X_CN, strict=True)
        if len(outline.triangles)
    ]
    where = f"camera '{camera.name}'"
    placed = [(outline, _in_camera(outline, X)) for outline, X in solid]
    if isinstance(camera, PinholeCamera):
        if all((p_C[:, 2] < camera.near).all() for _, p_C in placed):
            raise CameraError(
                f"{where} has the whole body behind it (z forward is the viewing direction); "
                "check X_WC, which is the camera's pose in the world and not its inverse"
            )
        if any(_winding_at_origin(p_C[outline.triangles]) > 0.5 for outline, p_C in placed):
            raise CameraError(f"{where} is inside the body; check X_WC and the body's position")
    size, picture = _least_size(placed, camera), math.hypot(camera.width, camera.height)
    if size > _LARGER * picture:
        raise CameraError(
            f"{where}: the body is larger than the picture, at least {size:.3g} pixels across, "
            f"the picture {picture:.0f}; check the focal length [pixel], X_WC and the model's "
            "scale [m]"
        )
    mask = draw_mask([outline for outline, _ in solid], np.array([X for _, X in solid]), camera)
    if not mask.any():
        raise CameraError(
            f"{where} shows nothing of the body: it lies outside the picture of "
            f"{camera.width} x {camera.height} pixels; check X_WC and the body's position"
        )


def _least_size(placed: Sequence[tuple[Outline, np.ndarray]], camera: Camera) -> float:
    """The diagonal of a body's box as it would look at its farthest point [pixel]."""
    corners = np.vstack([p_C for _, p_C in placed])
    scale = float(camera.kernel_parameters()[1])
    if isinstance(camera, PinholeCamera):
        scale /= float(corners[:, 2].max())
    return scale * float(np.linalg.norm(np.ptp(corners, axis=0)))


def _in_camera(outline: Outline, X_CN: np.ndarray) -> np.ndarray:
    """Returns the vertices (n, 3) of a surface in the camera's frame."""
    return outline.vertices @ X_CN[:3, :3].T + X_CN[:3, 3]


def _winding_at_origin(corners: np.ndarray) -> float:
    """Returns how often triangles (m, 3, 3) enclose the origin: 1 inside a closed surface."""
    # Solid angles: van Oosterom and Strackee (1983), equation 8.
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
    denominator = (
        la * lb * lc
        + np.einsum("ij,ij->i", a, b) * lc
        + np.einsum("ij,ij->i", b, c) * la
        + np.einsum("ij,ij->i", c, a) * lb
    )
    return float(abs(np.arctan2(numerator, denominator).sum()) / (2.0 * np.pi))
