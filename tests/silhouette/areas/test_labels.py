"""Label images by the span kernel, against rays cast at every triangle."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body.surfaces.meshes import TriangleMesh
from drake_pose.silhouette.areas.outline import outline_from_mesh
from drake_pose.silhouette.areas.scoring import draw_labels, draw_mask
from tests.silhouette.areas.test_span_kernel import CAMERAS, name_of
from tests.silhouette.shapes import box, brute_force_depth, random_pose, soup

EMPTY = 32766


def require_nearest(meshes, X_CN, camera):
    """Compares labels 1, 2, ... with cast rays; returns them, and how many pixels two share."""
    labels = range(1, 1 + len(meshes))
    outlines = [outline_from_mesh(mesh) for mesh in meshes]
    image = draw_labels(outlines, labels, X_CN, camera, EMPTY)
    depths = np.array([brute_force_depth(m, X, camera) for m, X in zip(meshes, X_CN, strict=True)])
    seen = np.isfinite(depths).any(axis=0)
    np.testing.assert_array_equal(image != EMPTY, seen)
    own = np.take_along_axis(depths, np.where(seen, image - 1, 0)[None], axis=0)[0]
    # The kernel's depths are 32 bit floats: where two are as near, either may be seen.
    assert (own[seen] <= depths.min(axis=0)[seen] * (1.0 + 1e-5)).all()
    return image, int((np.isfinite(depths).sum(axis=0) > 1).sum())


@pytest.mark.parametrize("camera", CAMERAS, ids=name_of)
def test_the_nearest_of_any_triangles_is_seen(camera):
    rng = np.random.default_rng(4)
    shared = 0
    for _ in range(15):
        meshes = [soup(rng, 12, int(rng.integers(1, 20)), 0.4) for _ in range(3)]
        X_CN = np.array([random_pose(rng, (0.1, -0.1, rng.uniform(2.5, 3.5))) for _ in meshes])
        shared += require_nearest(meshes, X_CN, camera)[1]
    assert shared > 1000


@pytest.mark.parametrize("camera", CAMERAS, ids=name_of)
@pytest.mark.parametrize("inside_out", [False, True])
def test_the_nearest_of_closed_bodies_is_seen(camera, inside_out):
    # They run into each other, and a part is cut by the near plane.
    rng = np.random.default_rng(5)
    shared = 0
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


def test_surfaces_that_are_not_closed_hide_nothing_behind_them():
    cube = box(1.0)
    assert outline_from_mesh(cube).is_closed
    assert not outline_from_mesh(TriangleMesh(cube.vertices, cube.triangles[1:])).is_closed
    turned = cube.triangles.copy()
    turned[0] = turned[0, ::-1]
    assert not outline_from_mesh(TriangleMesh(cube.vertices, turned)).is_closed


def test_parts_of_one_label_are_one():
    camera = CAMERAS[1]
    X_CN = np.tile(np.eye(4), (3, 1, 1))
    X_CN[:, :3, :3] = Rotation.random(3, random_state=6).as_matrix()
    X_CN[:, 2, 3] = 2.0, 2.1, 2.2
    outlines = [outline_from_mesh(box(0.6))] * 3
    labels = draw_labels(outlines, [5, 5, 5], X_CN, camera)
    np.testing.assert_array_equal(labels == 5, draw_mask(outlines, X_CN, camera))
    assert set(np.unique(labels)) == {0, 5}


def test_nothing_to_draw():
    assert (draw_labels([], [], np.empty((0, 4, 4)), CAMERAS[0], EMPTY) == EMPTY).all()


def directed_edges(triangles):
    """Every use of an edge: from, to, triangle."""
    return sorted(
        (int(t[k]), int(t[(k + 1) % 3]), i) for i, t in enumerate(triangles) for k in range(3)
    )


def uses_of_records(edges):
    uses = []
    for v0, v1, t0, t1, s1 in edges.tolist():
        uses.append((v0, v1, t0))
        if s1 != 0:
            uses.append((v0, v1, t1) if s1 > 0 else (v1, v0, t1))
        else:
            assert t1 == -1
    return sorted(uses)


def test_records_hold_every_use_of_an_edge_once():
    rng = np.random.default_rng(0)
    for _ in range(30):
        # Few vertices, many triangles: edges of many triangles, and triangles given twice.
        outline = outline_from_mesh(soup(rng, 7, 40, 1.0))
        assert uses_of_records(outline.edges) == directed_edges(outline.triangles)


def test_records_are_as_few_as_can_be():
    # Three triangles on one edge, two of them running the same way.
    triangles = np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]], dtype=np.int32)
    points = np.random.default_rng(1).normal(size=(5, 3))
    outline = outline_from_mesh(TriangleMesh(points, triangles))
    assert len(outline.edges) == 2 + 6


def test_vertices_at_one_place_are_merged():
    mesh = box(1.0)
    split = TriangleMesh(
        np.vstack([mesh.vertices[mesh.triangles].reshape(-1, 3), [[9.0, 9.0, 9.0]]]),
        np.arange(36, dtype=np.int32).reshape(-1, 3),
    )
    outline = outline_from_mesh(split)
    assert len(outline.vertices) == 8
    assert len(outline.edges) == 18


def test_null_triangles_are_left_out():
    mesh = TriangleMesh(np.eye(3), np.array([[0, 1, 2], [0, 0, 1], [2, 2, 2]], dtype=np.int32))
    assert len(outline_from_mesh(mesh).triangles) == 1
