"""Areas and masks of projected surfaces, by the span kernel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drake_pose.camera.models import Camera
from drake_pose.silhouette.areas.bending import BendingOutline
from drake_pose.silhouette.areas.label_kernel import paint_labels
from drake_pose.silhouette.areas.outline import Outline, PackedOutlines, own_copy, pack
from drake_pose.silhouette.areas.span_kernel import paint, score


def prefix_sums(mask: np.ndarray) -> np.ndarray:
    """Returns (H, W + 1) int32: how many pixels of a mask (H, W) lie left of each pixel."""
    prefix = np.zeros((mask.shape[0], mask.shape[1] + 1), dtype=np.int32)
    np.cumsum(mask != 0, axis=1, out=prefix[:, 1:])
    return prefix


def score_bodies(
    surfaces: Sequence[Outline | BendingOutline],
    X_CN: np.ndarray,
    camera: Camera,
    prefixes: np.ndarray,
    bands: Sequence[np.ndarray] = (),
) -> np.ndarray:
    """Areas of a body at many poses, its surfaces united exactly, and of intersections with sets.

    Args:
        X_CN: (n, nodes, 4, 4) the surfaces' poses in the camera.
        prefixes: (k, H, W + 1) int32 prefix sums of the sets; k may be 0.
        bands: for each of the bending surfaces (n, v, 3) its band's vertices in its frame N at each
            pose [m].

    Returns:
        (n, 1 + k) int64 area inside the picture, then of the intersection with each set [pixel].

    Raises:
        ValueError: when poses, bands or sums have the wrong shape, or are not finite.
    """
    packed, poses = _check_body(surfaces, X_CN)
    parts, sizes = [], [0]
    for node, surface in enumerate(surfaces):
        if isinstance(surface, BendingOutline):
            rigid = surface.rigid
            parts.append((node, len(rigid.vertices), len(rigid.triangles), sum(sizes)))
            sizes.append(len(surface.rest.vertices) - len(rigid.vertices))
    given = [band.shape for band in bands]
    if given != [(len(poses), size, 3) for size in sizes[1:]]:
        raise ValueError(f"bands of {sizes[1:]} vertices at {len(poses)} poses, not {given}")
    vertices = np.concatenate([np.empty((len(poses), 0, 3)), *bands], axis=1)
    if not np.all(np.isfinite(vertices)):
        raise ValueError("bands must be finite")
    sums = np.require(prefixes, dtype=np.int32, requirements=["C", "W"])
    if sums.ndim != 3 or sums.shape[1:] != (camera.height, camera.width + 1):
        raise ValueError(
            f"prefixes of camera '{camera.name}' must be (k, {camera.height}, {camera.width + 1}), "
            f"not {sums.shape}"
        )
    numbers = np.array(parts, dtype=np.int64).reshape(-1, 4)
    packed = own_copy(packed) if len(parts) else packed
    return score(packed, numbers, vertices, poses, camera.kernel_parameters(), sums)


def draw_mask(outlines: Sequence[Outline], X_CN: np.ndarray, camera: Camera) -> np.ndarray:
    """Returns the mask (H, W) bool of a body at poses X_CN (nodes, 4, 4) in the camera."""
    packed, poses = _check_body(outlines, np.asarray(X_CN)[None])
    return draw_packed(packed, poses[0], camera)


def draw_packed(packed: PackedOutlines, X_CN: np.ndarray, camera: Camera) -> np.ndarray:
    """As draw_mask, for surfaces that are packed, as ``PackedSurfaces`` gives them."""
    poses = np.ascontiguousarray(X_CN[:, :3], dtype=np.float64)
    mask = np.zeros((camera.height, camera.width), dtype=np.uint8)
    paint(packed, poses, camera.kernel_parameters(), mask, 1)
    return mask.view(np.bool_)


def draw_labels(
    outlines: Sequence[Outline],
    labels: Sequence[int] | np.ndarray,
    X_CN: np.ndarray,
    camera: Camera,
    empty: int = 0,
) -> np.ndarray:
    """The label (H, W) int16 of the nearest surface in each pixel, or ``empty``.

    ``labels``: (nodes,); ``X_CN``: (nodes, 4, 4) the surfaces' poses in the camera.
    """
    packed, poses = _check_body(outlines, np.asarray(X_CN)[None])
    image = np.empty((camera.height, camera.width), dtype=np.int16)
    numbers = np.asarray(labels, dtype=np.int16)
    closed = np.array([outline.is_closed for outline in outlines], dtype=np.bool_)
    paint_labels(packed, numbers, closed, poses[0], camera.kernel_parameters(), empty, image)
    return image


def subtract_body(
    mask: np.ndarray,
    prefix: np.ndarray,
    outlines: Sequence[Outline],
    X_CN: np.ndarray,
    camera: Camera,
) -> None:
    """Takes a body's picture out of a mask and brings the mask's prefix sums up to date.

    Args:
        mask: (H, W) bool; changed in place.
        prefix: (H, W + 1) int32 its prefix sums; changed in place.
        X_CN: (nodes, 4, 4) the surfaces' poses in the camera.
    """
    packed, poses = _check_body(outlines, np.asarray(X_CN)[None])
    first, end = paint(packed, poses[0], camera.kernel_parameters(), mask.view(np.uint8), 0)
    prefix[first:end] = prefix_sums(mask[first:end])


def _check_body(
    surfaces: Sequence[Outline | BendingOutline], X_CN: np.ndarray
) -> tuple[PackedOutlines, np.ndarray]:
    """The kernel's arrays, and poses (n, nodes, 4, 4) as (n, nodes, 3, 4)."""
    poses = np.asarray(X_CN)
    if poses.ndim != 4 or poses.shape[1] != len(surfaces) or poses.shape[2:] != (4, 4):
        raise ValueError(f"poses must be (n, {len(surfaces)}, 4, 4), not {poses.shape}")
    if not np.all(np.isfinite(poses)):
        raise ValueError("poses must be finite")
    outlines = tuple(s.rest if isinstance(s, BendingOutline) else s for s in surfaces)
    return pack(outlines), np.array(poses[:, :, :3], dtype=np.float64, order="C")
