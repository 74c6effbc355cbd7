"""Viewing rays of pixels, and where two of them meet (Date et al., 3.1.2)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera, ParallelCamera

Array = NDArray[np.float64]


def viewing_rays(camera: Camera, uv: Array) -> tuple[Array, Array]:
    """The rays on which pixels lie.

    Args:
        camera: the camera.
        uv: (n, 2) pixels.

    Returns:
        Origins (n, 3) [m] and directions (n, 3) of length 1, in the world.
    """
    pixels = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    R, p = camera.X_WC[:3, :3], camera.X_WC[:3, 3]
    off = pixels - [camera.center_x, camera.center_y]
    if isinstance(camera, ParallelCamera):
        origins = p + (off / camera.pixels_per_metre) @ R[:, :2].T
        return origins, np.tile(R[:, 2], (len(pixels), 1))
    local = np.column_stack([off / [camera.focal_x, camera.focal_y], np.ones(len(pixels))])
    directions = local @ R.T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.tile(p, (len(pixels), 1)), directions


def nearest_points(
    origins_a: Array, directions_a: Array, origins_b: Array, directions_b: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Where pairs of rays come nearest to each other.

    Args:
        origins_a, directions_a: (n, 3) the first rays; directions of length 1.
        origins_b, directions_b: (n, 3) the second rays.

    Returns:
        Middles (n, 3) of the nearest points, their distances (n,) [m], and whether (n,) both points
        lie in front of their origins and the rays are not parallel.
    """
    across = origins_b - origins_a
    cosine = np.einsum("ij,ij->i", directions_a, directions_b)
    along_a = np.einsum("ij,ij->i", directions_a, across)
    along_b = np.einsum("ij,ij->i", directions_b, across)
    sine_squared = 1.0 - cosine**2
    usable = sine_squared > 1e-6
    divisor = np.where(usable, sine_squared, 1.0)
    t_a = (along_a - cosine * along_b) / divisor
    t_b = (cosine * along_a - along_b) / divisor
    p_a = origins_a + t_a[:, None] * directions_a
    p_b = origins_b + t_b[:, None] * directions_b
    distance = np.linalg.norm(p_a - p_b, axis=1)
    return 0.5 * (p_a + p_b), distance, usable & (t_a > 0.0) & (t_b > 0.0)


def meeting_points(
    cameras: Sequence[Camera], centroids: Sequence[Array], threshold: float
) -> Array:
    """3-D points where rays of blobs in two views meet.

    For all pairs of views, all pairs of blobs: rays nearer than a threshold are taken for the same
    skin, and the middle of their nearest points for its place.

    Args:
        cameras: the cameras.
        centroids: (n_k, 2) the blobs' centroids in each camera [pixel].
        threshold: largest distance of two rays [m].

    Returns:
        (m, 3) points [m].
    """
    rays = [viewing_rays(camera, uv) for camera, uv in zip(cameras, centroids, strict=True)]
    firsts, seconds = [], []
    for a, b in combinations(range(len(rays)), 2):
        i, j = np.indices((len(rays[a][0]), len(rays[b][0]))).reshape(2, -1)
        firsts.append((rays[a][0][i], rays[a][1][i]))
        seconds.append((rays[b][0][j], rays[b][1][j]))
    if not firsts:
        return np.empty((0, 3))
    parts = [
        np.concatenate([pair[k] for pair in side]) for side in (firsts, seconds) for k in (0, 1)
    ]
    points, distance, usable = nearest_points(*parts)
    return points[usable & (distance <= threshold)]


def meeting_of_all(cameras: Sequence[Camera], pixels: Sequence[Array]) -> Array:
    """(3,) the point nearest to the rays of one pixel (2,) in each camera [m]; nan has no say."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for camera, uv in zip(cameras, pixels, strict=True):
        if np.isnan(uv).any():
            continue
        origin, direction = viewing_rays(camera, uv[None])
        across = np.eye(3) - np.outer(direction[0], direction[0])
        A += across
        b += across @ origin[0]
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0])
