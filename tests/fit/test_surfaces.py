"""Simplified surfaces: against exact shapes, bundled bodies, and brute-force distances."""

import numpy as np
import pytest
import trimesh

from drake_pose.body import TriangleMesh
from drake_pose.fit import surfaces
from drake_pose.fit.surfaces import (
    FEW,
    VERY_FEW,
    load_or_make,
    reduce_meshes,
    simplify_or_hull,
    simplify_outlines,
    simplify_rigid_parts,
    simplify_surfaces,
    surface_distance,
    with_radius_scales,
)
from drake_pose.silhouette.outline import TreeSurfaces, outline_from_mesh

RADIUS, TUBE, ENDS = 0.08, 0.06, (0.1, 0.3)


class Rigid:
    """Minimal surfaces for ``simplify_surfaces``."""

    def __init__(self, *outlines):
        self.rigid, self.bending = outlines, [None] * len(outlines)


def ball_and_tube(slivers):
    """Return a ball of 5120 triangles beside a closed tube of slivers along its whole length."""
    one = trimesh.creation.icosphere(4, radius=RADIUS)
    tube = trimesh.creation.cylinder(TUBE, segment=[[0, 0, z] for z in ENDS], sections=slivers)
    both = trimesh.util.concatenate([one, tube])
    return outline_from_mesh(TriangleMesh(both.vertices, both.faces))


def distance_to_shape(points):
    """Return distances of points (n, 3) to the exact surface of the ball or the tube [m]."""
    ball = np.abs(np.linalg.norm(points, axis=1) - RADIUS)
    across = np.linalg.norm(points[:, :2], axis=1) - TUBE
    along = np.abs(points[:, 2] - np.mean(ENDS)) - 0.5 * (ENDS[1] - ENDS[0])
    outside = np.hypot(np.maximum(across, 0), np.maximum(along, 0))
    return np.minimum(ball, np.abs(outside + np.minimum(np.maximum(across, along), 0)))


def on_surface(outline, count=4000):
    """Return points drawn uniformly from a surface."""
    mesh = trimesh.Trimesh(outline.vertices, outline.triangles, process=False)
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=4)[0])


def nearest_sample(points, outline):
    """Return the distance of each point to the nearest of many samples: slightly too large."""
    samples = on_surface(outline, 20_000)
    return np.array([np.sqrt(((samples - p) ** 2).sum(axis=1).min()) for p in points])


@pytest.mark.parametrize("slivers", [40, 100])
def test_surfaces_with_slivers_keep_their_shape(slivers):
    given = ball_and_tube(slivers)
    (simple,) = simplify_surfaces(Rigid(given))
    assert 0.5 * FEW < len(simple.triangles) < 1.2 * FEW
    # Nothing is lost, and nothing protrudes.
    assert nearest_sample(on_surface(given, 400), simple).max() < 0.012
    assert distance_to_shape(on_surface(simple)).max() < 0.008


def test_a_thin_rod_is_kept():
    rod = trimesh.creation.cylinder(0.0005, height=1.0, sections=600)
    (simple,) = simplify_surfaces(Rigid(outline_from_mesh(TriangleMesh(rod.vertices, rod.faces))))
    assert len(simple.triangles) > 0
    np.testing.assert_allclose(np.ptp(simple.vertices, axis=0)[2], 1.0, atol=0.01)


def test_surface_distance_matches_brute_force():
    """Tiny triangles at thirty places, against triangles of very different sizes."""
    rng = np.random.default_rng(7)
    places = rng.uniform(-1.0, 1.0, (30, 3))
    tiny = (places[:, None] + 1e-6 * rng.normal(size=(30, 3, 3))).reshape(-1, 3)
    sizes = np.repeat([0.5, 0.05, 0.005], 12)[:, None, None]
    corners = rng.uniform(-1.0, 1.0, (36, 1, 3)) + 0.6 + sizes * rng.normal(size=(36, 3, 3))
    one, other = (
        outline_from_mesh(TriangleMesh(points, np.arange(len(points)).reshape(-1, 3)))
        for points in (tiny, corners.reshape(-1, 3))
    )
    there = np.min([
        np.linalg.norm(trimesh.triangles.closest_point(np.tile(k, (30, 1, 1)), places) - places,
                       axis=1) for k in corners
    ], axis=0)  # fmt: skip
    back = np.linalg.norm(on_surface(other)[:, None] - places, axis=2).min(axis=1)
    expected = np.sqrt(0.5 * ((there**2).mean() + (back**2).mean()))
    np.testing.assert_allclose(surface_distance(one, other), expected, rtol=0.03)
    empty = outline_from_mesh(TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32)))
    assert surface_distance(one, empty) == surface_distance(empty, one) == np.inf
    assert surface_distance(other, other) == pytest.approx(0.0, abs=1e-9)


def test_radius_scales_widen_across_the_y_axis():
    given = [outline_from_mesh(ball(1, 0.1)), outline_from_mesh(ball(0, 0.2))]
    for one, factor, wide in zip(given, (2.0, 1.0), with_radius_scales(given, [2.0, 1.0]),
                                 strict=True):  # fmt: skip
        np.testing.assert_allclose(wide.vertices, one.vertices * [factor, 1.0, factor])
        np.testing.assert_array_equal(wide.triangles, one.triangles)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Folder of the stored surfaces."""
    monkeypatch.setattr(surfaces, "kernel_folder", lambda: tmp_path)
    return tmp_path / "surfaces"


class Maker:
    """Makes a ball of few triangles, and counts the calls."""

    def __init__(self, radius=1.0):
        self.outline = outline_from_mesh(ball(2, radius))
        self.count = 0

    def __call__(self):
        self.count += 1
        return self.outline


def same(one, other):
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("vertices", "triangles", "edges")
    )


@pytest.mark.parametrize(
    "damage", [lambda b: b"", lambda b: b[:-9], lambda b: b[:99] + b"x" + b[100:]]
)
def test_a_damaged_file_is_replaced(folder, damage):
    make = Maker()
    load_or_make((b"key",), make)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    assert same(load_or_make((b"key",), make), make.outline)
    assert make.count == 2
    assert same(load_or_make((b"key",), make), make.outline)
    assert make.count == 2
    assert file.read_bytes() == whole


def test_key_parts_are_distinguished_and_oldest_files_removed(folder):
    makers = [Maker(1.0 + k) for k in range(4)]
    keys = [(b"ab", b"c"), (b"a", b"bc"), (b"abc",), (b"abc", b"")]
    for key, make in zip(keys, makers, strict=True):
        assert same(load_or_make(key, make, 3), make.outline)
    assert len(list(folder.iterdir())) == 3
    load_or_make(keys[-1], makers[-1])
    assert makers[-1].count == 1
    load_or_make(keys[0], makers[0])
    assert makers[0].count == 2


def test_without_a_writable_folder_surfaces_are_made(tmp_path, monkeypatch):
    make = Maker()
    (tmp_path / "file").touch()
    for folder in (None, tmp_path / "file", tmp_path / "none"):
        monkeypatch.setattr(surfaces, "kernel_folder", lambda folder=folder: folder)
        assert load_or_make((b"key",), make) is make.outline


def ball(level, radius=1.0):
    made = trimesh.creation.icosphere(level, radius=radius)
    return TriangleMesh(np.array(made.vertices), np.array(made.faces))


def test_meshes_share_the_triangles_that_are_allowed():
    """Each keeps its fraction, and at least 100; few triangles stay as they are."""
    given = [ball(4), ball(3, 0.5), ball(0), ball(1)]
    counts = np.array([len(one.triangles) for one in given])
    assert counts.tolist() == [5120, 1280, 20, 80]
    found = reduce_meshes(given, 1300)
    fewer = np.array([len(one.triangles) for one in found])
    np.testing.assert_allclose(fewer[:2], 1300 * counts[:2] / counts.sum(), rtol=0.05)
    assert found[2:] == given[2:]
    for one, radius in zip(found, (1.0, 0.5), strict=False):
        np.testing.assert_allclose(np.linalg.norm(one.vertices, axis=1), radius, rtol=0.03)
    few = reduce_meshes(given, 400)
    assert len(few[1].triangles) == pytest.approx(100, abs=6)
    for total, stays in ((5500, True), (5300, False)):
        again = reduce_meshes(given, total)
        assert all(a is b for a, b in zip(again, given, strict=True)) == stays


def test_surfaces_that_cannot_be_simplified_become_hulls():
    """Loose triangles cannot be merged; a ball and a surface of few triangles are kept."""
    rng = np.random.default_rng(3)
    at = on_surface(outline_from_mesh(ball(3)), 600)
    loose = (at[:, None] + 0.01 * rng.normal(size=(600, 3, 3))).reshape(-1, 3)
    cloud = outline_from_mesh(TriangleMesh(loose, np.arange(1800).reshape(-1, 3)))
    round_one, small = outline_from_mesh(ball(3)), outline_from_mesh(ball(1))
    (hull,) = simplify_or_hull([cloud], 80, limit=0.5)
    simple, same = simplify_or_hull([round_one, small], 80)
    assert same is small
    for one in (hull, simple):
        assert 60 <= len(one.triangles) <= 100
        np.testing.assert_allclose(np.linalg.norm(one.vertices, axis=1), 1.0, atol=0.08)
        made = trimesh.Trimesh(one.vertices, one.triangles)
        assert made.volume == pytest.approx(4.0 / 3.0 * np.pi, rel=0.2)
    (kept,) = simplify_or_hull([cloud], 80)
    assert abs(trimesh.Trimesh(kept.vertices, kept.triangles).volume) < 0.1
    (again,) = simplify_outlines([simple], 40)
    assert 30 <= len(again.triangles) <= 48
    assert simplify_outlines([small])[0] is small


def test_only_rigid_parts_of_a_skin_are_simplified(person):
    surfaces = TreeSurfaces(person.pose_tree())
    few = simplify_rigid_parts(surfaces, VERY_FEW)
    assert max(len(one.triangles) for one in few.rigid) <= 1.2 * VERY_FEW
    for one, other in zip(few.bending, surfaces.bending, strict=True):
        assert one is other
