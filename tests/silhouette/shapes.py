"""Small surfaces, and an independent brute-force renderer."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from drake_pose.body import TriangleMesh
from drake_pose.camera.models import Camera, ParallelCamera, PinholeCamera

CAMERAS: list[Camera] = [
    ParallelCamera("parallel", 90, 70, 60.0, 44.3, 33.1, np.eye(4)),
    PinholeCamera("pinhole", 90, 70, 100.0, 110.0, 44.3, 33.1, np.eye(4), near=0.1),
    PinholeCamera("off_centre", 61, 83, 150.0, 140.0, -20.3, 91.7, np.eye(4), near=0.1),
]
each_camera = pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)


def random_pose(rng: np.random.Generator, position: tuple[float, float, float]) -> np.ndarray:
    """A pose (4, 4) with a random rotation at a position."""
    X = np.eye(4)
    X[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    X[:3, 3] = position
    return X


def soup(rng: np.random.Generator, vertices: int, triangles: int, size: float) -> TriangleMesh:
    """Random triangles between random points, neither closed nor oriented."""
    points = rng.normal(size=(vertices, 3)) * size
    return TriangleMesh(points, rng.integers(0, vertices, (triangles, 3)).astype(np.int32))


def box(size: float) -> TriangleMesh:
    """A closed cube about the origin with outward normals."""
    cube = trimesh.creation.box((size, size, size))
    return TriangleMesh(np.array(cube.vertices), np.array(cube.faces, dtype=np.int32))


def brute_force_mask(mesh: TriangleMesh, X_CN: np.ndarray, camera: Camera) -> np.ndarray:
    """The mask (H, W) of a mesh by ray casting."""
    return np.isfinite(brute_force_depth(mesh, X_CN, camera))


def brute_force_depth(mesh: TriangleMesh, X_CN: np.ndarray, camera: Camera) -> np.ndarray:
    """Intersect the ray of every pixel centre with every triangle (Moeller and Trumbore 1997).

    Returns (H, W) the depth of the nearest intersection along the camera's z; inf where none is.
    """
    kind, fx, fy, cx, cy, near = camera.kernel_parameters()[:6]
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y = ((u - cx) / fx).ravel(), ((v - cy) / fy).ravel()
    one, nought = np.ones_like(x), np.zeros_like(x)
    if kind == 0:
        origins, directions = np.zeros((len(x), 3)), np.column_stack([x, y, one])
    else:
        origins = np.column_stack([x, y, nought - 100.0])
        directions = np.column_stack([nought, nought, one])
    nearest = np.full(len(x), np.inf)
    corners = (mesh.vertices @ X_CN[:3, :3].T + X_CN[:3, 3])[mesh.triangles]
    for a, b, c in corners:
        p = np.cross(directions, c - a)
        determinant = p @ (b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.einsum("ij,ij->i", origins - a, p) / determinant
            q = np.cross(origins - a, b - a)
            t = np.einsum("ij,ij->i", directions, q) / determinant
            depth = q @ (c - a) / determinant  # along z, as every direction has z = 1
        hit = (s >= 0) & (t >= 0) & (s + t <= 1) & ((kind == 1) | (depth >= near))
        nearest[hit] = np.minimum(nearest[hit], depth[hit])
    return nearest.reshape(camera.height, camera.width)
