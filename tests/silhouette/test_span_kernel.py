"""Masks and labels of the span kernel against ray casting."""

import numpy as np
import pytest

from drake_pose.body import TriangleMesh
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.scoring import draw_labels, draw_mask, prefix_sums, score_bodies
from tests.silhouette.shapes import (
    CAMERAS,
    box,
    brute_force_depth,
    brute_force_mask,
    each_camera,
    random_pose,
    soup,
)


def require_exact(mesh, X_CN, camera):
    """Compare a mesh's mask with ray casting, and return the mask."""
    mask = draw_mask([outline_from_mesh(mesh)], X_CN[None], camera)
    np.testing.assert_array_equal(mask, brute_force_mask(mesh, X_CN, camera))
    return mask


@each_camera
def test_masks_of_triangle_soups_are_exact(camera):
    """Before the camera, cut by its near plane, and with many crossings of a row."""
    rng = np.random.default_rng(1)
    for low, high in ((3.0, 3.0), (-0.6, 0.8)):
        covered = partly = 0
        for _ in range(25):
            mesh = soup(rng, 12, int(rng.integers(1, 30)), 0.4)
            X_CN = random_pose(rng, (0.1, -0.1, rng.uniform(low, high)))
            mask = require_exact(mesh, X_CN, camera)
            covered += int(mask.sum())
            partly += 0 < mask.sum() < mask.size
        assert (covered > 400) & (partly > 6)
    for count in (60, 400):
        corners = 0.03 * rng.normal(size=(count, 3, 3)) + 0.4 * rng.normal(size=(count, 1, 3))
        indices = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
        small = TriangleMesh(corners.reshape(-1, 3), indices)
        require_exact(small, random_pose(rng, (0.0, 0.0, 3.0)), camera)


@pytest.mark.parametrize("far", [1e3, 1e9, 1e300])
def test_surfaces_far_outside_the_image_have_no_area(far):
    camera = CAMERAS[0]
    outline = outline_from_mesh(box(1.0))
    X_CN = np.tile(np.eye(4), (5, 1, 1))
    X_CN[:4, :2, 3] = [[far, 0], [-far, 0], [0, far], [0, -far]]
    full = np.ones((1, camera.height, camera.width), dtype=bool)
    areas = score_bodies([outline], X_CN[:, None], camera, np.array([prefix_sums(m) for m in full]))
    assert (areas[:4] == 0).all()
    assert areas[4, 0] == areas[4, 1] > 3000


def test_large_surfaces_fill_the_image_and_empty_ones_have_no_area():
    X_CN = np.eye(4)
    X_CN[2, 3] = 600.0
    for camera in CAMERAS:
        assert draw_mask([outline_from_mesh(box(1000.0))], X_CN[None], camera).all()
    empty = outline_from_mesh(TriangleMesh.empty())
    cube, camera = outline_from_mesh(box(0.5)), CAMERAS[0]
    assert not draw_mask([empty], np.eye(4)[None], camera).any()
    assert not draw_mask([], np.zeros((0, 4, 4)), camera).any()
    both = draw_mask([empty, cube], np.tile(np.eye(4), (2, 1, 1)), camera)
    np.testing.assert_array_equal(both, draw_mask([cube], np.eye(4)[None], camera))
    none = np.zeros((0, camera.height, camera.width + 1), dtype=np.int32)
    assert score_bodies([cube], np.zeros((0, 1, 4, 4)), camera, none).shape == (0, 1)


def require_nearest(meshes, X_CN, camera):
    """Compare labels 1, 2, ... with ray casting.

    Returns the labels, and the number of pixels covered by several surfaces.
    """
    labels = range(1, 1 + len(meshes))
    outlines = [outline_from_mesh(mesh) for mesh in meshes]
    image = draw_labels(outlines, labels, X_CN, camera)
    depths = np.array([brute_force_depth(m, X, camera) for m, X in zip(meshes, X_CN, strict=True)])
    is_covered = np.isfinite(depths).any(axis=0)
    np.testing.assert_array_equal(image != 0, is_covered)
    own = np.take_along_axis(depths, np.where(is_covered, image - 1, 0)[None], axis=0)[0]
    # The kernel's depths are 32-bit floats: either surface may win where depths are equal.
    assert (own[is_covered] <= depths.min(axis=0)[is_covered] * (1.0 + 1e-5)).all()
    return image, int((np.isfinite(depths).sum(axis=0) > 1).sum())


@each_camera
def test_nearest_of_triangle_soups_is_labelled(camera):
    rng, shared = np.random.default_rng(4), 0
    for _ in range(15):
        meshes = [soup(rng, 12, int(rng.integers(1, 20)), 0.4) for _ in range(3)]
        X_CN = np.array([random_pose(rng, (0.1, -0.1, rng.uniform(2.5, 3.5))) for _ in meshes])
        shared += require_nearest(meshes, X_CN, camera)[1]
    assert shared > 1000


@each_camera
@pytest.mark.parametrize("inside_out", [False, True])
def test_nearest_of_closed_bodies_is_labelled(camera, inside_out):
    # The bodies intersect, and the near plane cuts some.
    rng, shared = np.random.default_rng(5), 0
    for trial in range(10):
        middle = 2.0 if trial % 2 else 0.4
        meshes = [box(float(rng.uniform(0.3, 0.9))) for _ in range(4)]
        if inside_out:
            meshes[0] = TriangleMesh(meshes[0].vertices, meshes[0].triangles[:, ::-1])
        assert [outline_from_mesh(m).is_closed for m in meshes] == [not inside_out, *3 * [True]]
        places = rng.uniform(-0.4, 0.4, (4, 3))
        places[:, 2] += middle
        X_CN = np.array([random_pose(rng, (x, y, z)) for x, y, z in places])
        shared += require_nearest(meshes, X_CN, camera)[1]
    assert shared > 1000
