"""Masks, areas and labels of the span kernel against ray casting."""

from contextlib import nullcontext

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import TriangleMesh
from drake_pose.camera.models import Camera, ParallelCamera, PinholeCamera
from drake_pose.errors import CameraError
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.scoring import (
    draw_labels,
    draw_mask,
    prefix_sums,
    require_visible,
    score_bodies,
    subtract_body,
)
from tests.silhouette.shapes import box, brute_force_depth, brute_force_mask, random_pose, soup

CAMERAS: list[Camera] = [
    ParallelCamera("parallel", 90, 70, 60.0, 44.3, 33.1, np.eye(4)),
    PinholeCamera("pinhole", 90, 70, 100.0, 110.0, 44.3, 33.1, np.eye(4), near=0.1),
    PinholeCamera("off_centre", 61, 83, 150.0, 140.0, -20.3, 91.7, np.eye(4), near=0.1),
]
each_camera = pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)


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
        for _ in range(60):
            mesh = soup(rng, 12, int(rng.integers(1, 30)), 0.4)
            X_CN = random_pose(rng, (0.1, -0.1, rng.uniform(low, high)))
            mask = require_exact(mesh, X_CN, camera)
            covered += int(mask.sum())
            partly += 0 < mask.sum() < mask.size
        assert (covered > 1000) & (partly > 15)
    for count in (60, 400):
        corners = 0.03 * rng.normal(size=(count, 3, 3)) + 0.4 * rng.normal(size=(count, 1, 3))
        indices = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
        small = TriangleMesh(corners.reshape(-1, 3), indices)
        require_exact(small, random_pose(rng, (0.0, 0.0, 3.0)), camera)


@each_camera
def test_scores_equal_sums_over_masks(camera):
    rng = np.random.default_rng(4)
    size = (camera.height, camera.width)
    sets = rng.random((3, *size)) < np.array([0.1, 0.5, 0.9])[:, None, None]
    prefixes = np.array([prefix_sums(region) for region in sets])
    outlines = [outline_from_mesh(soup(rng, 20, 25, 0.3)) for _ in range(4)]
    poses = [random_pose(rng, (*rng.uniform(-0.5, 0.5, 2), 2.0)) for _ in range(60)]
    X_CN = np.reshape(poses, (15, 4, 4, 4))
    whole = score_bodies(outlines, X_CN, camera, prefixes)
    single = score_bodies([outlines[1]], X_CN[:, 1:2], camera, prefixes)
    assert whole.dtype == single.dtype == np.int64
    for n in range(len(X_CN)):
        parts = [draw_mask([o], X[None], camera) for o, X in zip(outlines, X_CN[n], strict=True)]
        union = np.any(parts, axis=0)
        np.testing.assert_array_equal(draw_mask(outlines, X_CN[n], camera), union)
        assert whole[n].tolist() == [union.sum(), *((union & region).sum() for region in sets)]
        alone = parts[1]
        assert single[n].tolist() == [alone.sum(), *((alone & region).sum() for region in sets)]


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


@each_camera
def test_subtracting_a_body_updates_prefix_sums(camera):
    rng = np.random.default_rng(7)
    mask = rng.random((camera.height, camera.width)) < 0.7
    prefix = prefix_sums(mask)
    expected = mask.copy()
    for _ in range(6):
        outline = outline_from_mesh(soup(rng, 8, 6, 0.3))
        X_CN = random_pose(rng, (*rng.uniform(-0.6, 0.6, 2), 2.0))
        subtract_body(mask, prefix, [outline], X_CN[None], camera)
        expected &= ~draw_mask([outline], X_CN[None], camera)
        np.testing.assert_array_equal(mask, expected)
        np.testing.assert_array_equal(prefix[:, 1:], np.cumsum(expected, axis=1))
        assert not prefix[:, 0].any()


def test_wrong_shapes_are_refused():
    for poses, columns, words in (
        (np.eye(4)[None, None], 90, "prefixes of camera 'parallel'"),
        (np.eye(4)[None, None, :3, :3], 91, "poses"),
        (np.tile(np.eye(4), (1, 2, 1, 1)), 91, "poses"),
        (np.full((1, 1, 4, 4), np.nan), 91, "finite"),
    ):
        prefixes = np.zeros((0, 70, columns), dtype=np.int32)
        with pytest.raises(ValueError, match=words):
            score_bodies([outline_from_mesh(box(1.0))], poses, CAMERAS[0], prefixes)


PINHOLE = PinholeCamera("eye", 64, 48, 60.0, 60.0, 31.5, 23.5, np.eye(4))
PARALLEL = ParallelCamera("flat", 64, 48, 20.0, 31.5, 23.5, np.eye(4))
CUBE = outline_from_mesh(box(1.0))


def test_a_body_that_a_camera_cannot_show_is_refused():
    for camera, places, refused in (
        (PINHOLE, [(0, 0, 3)], None),
        (PARALLEL, [(0, 0, -3)], None),
        (PINHOLE, [(0, 0, 3), (0, 0, -3)], None),
        (PINHOLE, [(0.6, 0, 0)], None),  # Beside the camera, in part before it.
        (PINHOLE, [(0, 0, -3), (1, 0, -2)], "'eye'.*behind"),
        (PINHOLE, [(0, 0, 3), (0.1, 0.2, 0.3)], "'eye' is inside"),
        (PINHOLE, [(50, 0, 3)], "'eye'.*outside the picture"),
        (PARALLEL, [(0, 50, 3)], "'flat'.*outside the picture"),
    ):
        X_CN = np.tile(np.eye(4), (len(places), 1, 1))
        X_CN[:, :3, 3] = places
        with nullcontext() if refused is None else pytest.raises(CameraError, match=refused):
            require_visible([CUBE] * len(places), X_CN, camera)


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


def test_open_and_inconsistent_surfaces_are_not_closed():
    cube = box(1.0)
    turned = np.vstack([cube.triangles[:1, ::-1], cube.triangles[1:]])
    for triangles in (cube.triangles[1:], turned):
        assert not outline_from_mesh(TriangleMesh(cube.vertices, triangles)).is_closed


def test_surfaces_of_one_label_are_united():
    camera = CAMERAS[1]
    X_CN = np.tile(np.eye(4), (3, 1, 1))
    X_CN[:, :3, :3] = Rotation.random(3, random_state=6).as_matrix()
    X_CN[:, 2, 3] = 2.0, 2.1, 2.2
    outlines = [outline_from_mesh(box(0.6))] * 3
    labels = draw_labels(outlines, [5, 5, 5], X_CN, camera)
    np.testing.assert_array_equal(labels == 5, draw_mask(outlines, X_CN, camera))
    assert set(np.unique(labels)) == {0, 5}


def directed_edges(triangles):
    """Every use of an edge: from, to, triangle, sorted."""
    numbered = enumerate(triangles.tolist())
    return sorted((t[k], t[(k + 1) % 3], i) for i, t in numbered for k in range(3))


def uses_of_records(edges):
    uses = []
    for v0, v1, t0, t1, s1 in edges.tolist():
        uses.append((v0, v1, t0))
        if s1 != 0:
            uses.append((v0, v1, t1) if s1 > 0 else (v1, v0, t1))
        else:
            assert t1 == -1
    return sorted(uses)


def test_edge_records_contain_every_use_once():
    rng = np.random.default_rng(0)
    for _ in range(30):
        # Few vertices give edges of many triangles, and duplicate triangles.
        outline = outline_from_mesh(soup(rng, 7, 40, 1.0))
        assert uses_of_records(outline.edges) == directed_edges(outline.triangles)


CORNERS = box(1.0).vertices[box(1.0).triangles].reshape(-1, 3)


def test_numbers_of_vertices_triangles_and_edge_records():
    for points, triangles, found in (
        # Three triangles on one edge, two of which traverse it alike: two records of it.
        (np.vstack([np.eye(3), -np.eye(2, 3)]), [[0, 1, 2], [0, 1, 3], [1, 0, 4]], (5, 3, 8)),
        # Equal vertices are merged; unused ones and degenerate triangles are left out.
        (np.vstack([CORNERS, [[9.0, 9.0, 9.0]]]), np.arange(36).reshape(-1, 3), (8, 12, 18)),
        (np.eye(3), [[0, 1, 2], [0, 0, 1], [2, 2, 2]], (3, 1, 3)),
    ):
        outline = outline_from_mesh(TriangleMesh(points, np.array(triangles, dtype=np.int32)))
        assert (len(outline.vertices), len(outline.triangles), len(outline.edges)) == found
