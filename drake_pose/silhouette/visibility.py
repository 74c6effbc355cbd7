"""Whether a camera can see a body at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drake_pose.camera import Camera, PinholeCamera
from drake_pose.errors import CameraError
from drake_pose.silhouette.outline import Outline
from drake_pose.silhouette.scoring import draw_mask


def require_visible(outlines: Sequence[Outline], X_CN: np.ndarray, camera: Camera) -> None:
    """Refuses a camera that cannot show a body.

    Args:
        outlines: the body's surfaces.
        X_CN: (nodes, 4, 4) their poses in the camera.
        camera: the camera.

    Raises:
        CameraError: names the camera; when the body is wholly behind it, when the camera is inside
            one of the surfaces, or when the body lies wholly outside the picture.
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
    mask = draw_mask([outline for outline, _ in solid], np.array([X for _, X in solid]), camera)
    if not mask.any():
        raise CameraError(
            f"{where} shows nothing of the body: it lies outside the picture of "
            f"{camera.width} x {camera.height} pixels; check X_WC and the body's position"
        )


def _in_camera(outline: Outline, X_CN: np.ndarray) -> np.ndarray:
    """Returns the vertices (n, 3) of a surface in the camera's frame."""
    return outline.vertices @ X_CN[:3, :3].T + X_CN[:3, 3]


def _winding_at_origin(corners: np.ndarray) -> float:
    """Returns how often triangles (m, 3, 3) enclose the origin: 1 inside a closed surface.

    The solid angle of a triangle is that of van Oosterom and Strackee (1983), equation 8. Surfaces
    with holes give fractions (Jacobson, Kavan and Sorkine-Hornung 2013).
    """
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
