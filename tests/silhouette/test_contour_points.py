"""Contour points against brute force and known shapes."""

import numpy as np
import pytest

from drake_pose.body import TriangleMesh
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.silhouette.contour_points import sample_contour
from drake_pose.silhouette.outline import outline_from_mesh, pack
from tests.silhouette.shapes import box, random_pose, soup

CAMERAS = [
    ParallelCamera("parallel", 90, 70, 40.0, 44.3, 35.2, np.eye(4)),
    PinholeCamera("pinhole", 90, 70, 80.0, 84.0, 44.3, 35.2, np.eye(4)),
]


def find_contour_points(outlines, X_CN, camera, spacing=1.0):
    view = np.eye(4), camera.kernel_parameters()
    return sample_contour(pack(tuple(outlines)), np.ascontiguousarray(X_CN), view, spacing)


def covered(meshes, X_CN, camera, uv):
    """(n,) whether image points (n, 2) lie in any projected triangle."""
    inside = np.zeros(len(uv), dtype=bool)
    for mesh, X in zip(meshes, X_CN, strict=True):
        p_C = mesh.vertices @ X[:3, :3].T + X[:3, 3]
        projected, _ = camera.project(p_C)  # X_WC is the identity
        for a, b, c in projected[mesh.triangles]:
            M = np.column_stack([b - a, c - a])
            if abs(np.linalg.det(M)) < 1e-12:
                continue
            s, t = np.linalg.solve(M, (uv - a).T)
            inside |= (s >= 0) & (t >= 0) & (s + t <= 1)
    return inside


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
@pytest.mark.parametrize("kind", ["boxes", "soup"])
def test_points_are_on_the_border_of_the_union(camera, kind):
    rng = np.random.default_rng(5)
    for _ in range(4):
        meshes = [box(s) if kind == "boxes" else soup(rng, 5, 4, 0.5 * s) for s in (0.9, 0.6, 0.5)]
        X = np.array([random_pose(rng, tuple(rng.normal((0.0, 0.0, 3.0), 0.3))) for _ in meshes])
        outlines = tuple(outline_from_mesh(mesh) for mesh in meshes)
        points = find_contour_points(outlines, X, camera)
        assert len(points.uv) > 50
        out = covered(meshes, X, camera, points.uv + 1e-4 * points.normals)
        into = covered(meshes, X, camera, points.uv - 1e-4 * points.normals)
        # The step may cross a corner.
        assert out.mean() < 0.01
        assert into.mean() > 0.99
        p_C = np.einsum("nij,nj->ni", X[points.nodes][:, :3, :3], points.p_N)
        projected, _ = camera.project(p_C + X[points.nodes][:, :3, 3])
        assert np.abs(projected - points.uv).max() < 1e-9
        assert np.allclose(np.linalg.norm(points.normals, axis=1), 1.0)
        assert np.all(points.uv > -0.5)
        assert np.all(points.uv < [camera.width - 0.5, camera.height - 0.5])


def test_lengths_sum_to_the_perimeter():
    camera = CAMERAS[0]
    angles = np.linspace(0, 2 * np.pi, 65)[:-1]
    ring = 0.7 * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    triangles = [[64, i, (i + 1) % 64] for i in range(64)]
    disc = outline_from_mesh(TriangleMesh(np.vstack([ring, np.zeros(3)]), np.array(triangles)))
    X = np.eye(4)[None]
    points = find_contour_points((disc,), X, camera, spacing=0.1)
    assert abs(points.lengths.sum() - 2 * np.pi * 0.7 * 40.0) < 1.0
    center = np.array([44.3, 35.2])
    assert np.all(((points.uv - center) * points.normals).sum(axis=1) > 27.9)


def test_clearances_are_distances_between_parallel_edges():
    camera = CAMERAS[0]
    X = np.tile(np.eye(4), (2, 1, 1))
    # Two boxes side by side, 20 pixels wide, rotated in the image; the gap is 7 pixels.
    turn = np.radians(20.0)
    X[:, :2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    half = 0.5 * (20.0 + 7.0) / 40.0
    X[0, :3, 3] = np.array([*(-half * X[0, :2, 0]), 2.0])
    X[1, :3, 3] = np.array([*(half * X[0, :2, 0]), 2.0])
    found = find_contour_points((outline_from_mesh(box(0.5)),) * 2, X, camera)
    across = (found.uv - [camera.center_x, camera.center_y]) @ X[0, :2, :2]
    # Exclude points near corners.
    middle = np.abs(across[:, 1]) < 2.0
    within = middle & (np.abs(np.abs(across[:, 0]) - 3.5) < 0.1)
    without = middle & (np.abs(np.abs(across[:, 0]) - 23.5) < 0.1)
    assert within.sum() > 5
    assert without.sum() > 5
    np.testing.assert_allclose(found.clearances[within], [[20.0, 7.0]] * within.sum(), rtol=1e-6)
    np.testing.assert_allclose(found.clearances[without][:, 0], 20.0, rtol=1e-6)
    assert np.all(np.isinf(found.clearances[without][:, 1]))


def test_occluded_surfaces_have_no_points():
    camera = CAMERAS[0]
    X = np.tile(np.eye(4), (2, 1, 1))
    X[1, :3, 3] = [0.05, 0.02, 4.0]
    X[:, :3, :3] = random_pose(np.random.default_rng(1), (0, 0, 0))[:3, :3]
    outlines = (outline_from_mesh(box(1.0)), outline_from_mesh(box(0.3)))
    assert set(find_contour_points(outlines, X, camera).nodes) == {0}
    # Two equal surfaces have one contour.
    twice = find_contour_points((outlines[0], outlines[0]), X[[0, 0]], camera)
    once = find_contour_points(outlines[:1], X[:1], camera)
    assert np.allclose(np.sort(twice.uv, axis=0), np.sort(once.uv, axis=0))


def test_body_outside_the_image_has_no_points():
    beside, behind = np.eye(4)[None], np.eye(4)[None]
    beside[0, 0, 3], behind[0, 2, 3] = 50.0, -2.0
    one = (outline_from_mesh(box(0.5)),)
    for outlines, X, k in ((one, beside, 0), (one, behind, 1), ((), np.zeros((0, 4, 4)), 0)):
        assert len(find_contour_points(outlines, X, CAMERAS[k]).uv) == 0
