"""Edges of outlines, against every use of every edge; surfaces that threads deform."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from drake_pose.body import TriangleMesh
from drake_pose.silhouette.outline import PackedSurfaces, TreeSurfaces, outline_from_mesh
from tests.body.models import load_limb
from tests.silhouette.shapes import box, soup


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


def test_open_and_inconsistent_surfaces_are_not_closed():
    cube = box(1.0)
    turned = np.vstack([cube.triangles[:1, ::-1], cube.triangles[1:]])
    for triangles in (cube.triangles[1:], turned):
        assert not outline_from_mesh(TriangleMesh(cube.vertices, triangles)).is_closed


def test_each_thread_deforms_its_own_copy(tmp_path):
    """Another thread deforms the band before the main thread reads it."""
    tree = load_limb(tmp_path).pose_tree()
    surfaces, rest = PackedSurfaces(TreeSurfaces(tree)), tree.default_values()
    ends = np.concatenate(rest), np.concatenate(rest) + 0.4
    held = surfaces.bend_to(ends[0])
    before = held.points.copy()
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(lambda: surfaces.at(ends[1]).points).result()
    assert np.abs(other - before).max() > 1e-3
    np.testing.assert_array_equal(held.points, before)
