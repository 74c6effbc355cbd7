"""Viewing rays of pixels, where they meet (Date et al., 3.1.2), and pictures at points in space."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.compiled import compiled


def viewing_rays(camera: Camera, uv: Array) -> tuple[Array, Array]:
    """Origins (n, 3) [m] and unit directions (n, 3) in the world of the rays of pixels (n, 2)."""
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
) -> tuple[Array, Array, Mask]:
    """Middles (n, 3) where pairs of rays come nearest, distances (n,) [m], and whether they meet.

    Rays (n,) meet where both points lie in front of their origins and they are not parallel.
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
    cameras: Sequence[Camera],
    pixels: Sequence[Array],
    threshold: float,
    free: Sequence[Mask] | None = None,
) -> Array:
    """The points (m, 3) [m] where rays of two views pass each other by less than a threshold [m].

    Args:
        pixels: (n_k, 2) in each camera's view; all pairs of pixels of all pairs are tried.
        free: (n_k,) pairs of which neither pixel is free are left out; None: all are.
    """
    rays = [viewing_rays(camera, uv) for camera, uv in zip(cameras, pixels, strict=True)]
    sides: list[list[Array]] = [[], [], [], []]
    for a, b in combinations(range(len(rays)), 2):
        i, j = np.indices((len(rays[a][0]), len(rays[b][0]))).reshape(2, -1)
        if free is not None:
            wanted = free[a][i] | free[b][j]
            i, j = i[wanted], j[wanted]
        ends = rays[a][0][i], rays[a][1][i], rays[b][0][j], rays[b][1][j]
        for side, end in zip(sides, ends, strict=True):
            side.append(end)
    if not sides[0]:
        return np.empty((0, 3))
    points, distance, usable = nearest_points(*(np.concatenate(side) for side in sides))
    return points[usable & (distance <= threshold)]


def triangulate(cameras: Sequence[Camera], pixels: Sequence[Array]) -> Array:
    """(3,) the point nearest to the rays of one pixel (2,) in each camera [m]; nan has no say."""
    seen = [k for k, uv in enumerate(pixels) if not np.isnan(uv).any()]
    rays = [viewing_rays(cameras[k], pixels[k]) for k in seen]
    origins, directions = np.array(rays).reshape(-1, 2, 3).transpose(1, 0, 2)
    # Each ray tells where the point is across it.
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    told = (across @ origins[..., None])[..., 0]
    return np.asarray(np.linalg.lstsq(across.sum(axis=0), told.sum(axis=0), rcond=None)[0])


def sum_at_points(
    camera: Camera, picture: NDArray[np.int8], points: Array, weights: Array
) -> tuple[Array, Array]:
    """(n,) sums of a picture (H, W) at points (n, m, 3) [m], weighted (n, m), and weights in it."""
    X_CW = np.ascontiguousarray(camera.X_CW)
    total: tuple[Array, Array] = _sum_at_points(
        camera.kernel_parameters(), X_CW, picture, points, weights
    )
    return total


@compiled
def _sum_at_points(
    camera: Array, X_CW: Array, picture: NDArray[np.int8], points: Array, weights: Array
) -> tuple[Array, Array]:
    height, width = picture.shape
    sums, seen, P = np.zeros(points.shape[0]), np.zeros(points.shape[0]), np.empty((3, 4))
    # Row and column of a point, times its depth: lens and pose in one matrix.
    parallel = camera[0] != 0.0
    for c in range(4):
        P[2, c] = X_CW[2, c] if not parallel else 1.0 * (c == 3)
        for r in range(2):
            P[r, c] = camera[1 + r] * X_CW[r, c] + (camera[3 + r] + 0.5) * P[2, c]
    p00, p01, p02, p03 = P[0, 0], P[0, 1], P[0, 2], P[0, 3]
    p10, p11, p12, p13 = P[1, 0], P[1, 1], P[1, 2], P[1, 3]
    p20, p21, p22, p23 = P[2, 0], P[2, 1], P[2, 2], P[2, 3]
    nearest = 0.0 if parallel else max(camera[5], 1e-300)
    for n in range(points.shape[0]):
        total = within = 0.0
        for m in range(points.shape[1]):
            x, y, z = points[n, m, 0], points[n, m, 1], points[n, m, 2]
            depth = p20 * x + p21 * y + p22 * z + p23
            share = 1.0 / depth if depth >= nearest else -1.0
            u = (p00 * x + p01 * y + p02 * z + p03) * share
            v = (p10 * x + p11 * y + p12 * z + p13) * share
            if share > 0.0 and 0.0 <= u < width and 0.0 <= v < height:
                total += weights[n, m] * picture[int(v), int(u)]
                within += weights[n, m]
        sums[n], seen[n] = total, within
    return sums, seen
