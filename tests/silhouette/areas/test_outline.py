import numpy as np

from drake_pose.body.surfaces.meshes import TriangleMesh
from drake_pose.silhouette.areas.outline import outline_from_mesh
from tests.silhouette.shapes import box, soup


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
