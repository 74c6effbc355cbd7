"""Reading of STL and DAE files, and writing of OBJ files."""

import re
import struct

import numpy as np
import pytest
import trimesh
from pydrake.geometry import Box, Cylinder, Ellipsoid, ReadObjToTriangleSurfaceMesh

from drake_pose.body import TriangleMesh, load_model
from drake_pose.body.meshes import is_watertight, read_mesh_file, shape_mesh, write_obj
from drake_pose.errors import ModelError
from tests.body.models import link, urdf, write

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], dtype=float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def tetrahedron():
    return trimesh.Trimesh(CORNERS, FACES, process=False)


def assert_tetrahedron(mesh, scale=1.0):
    assert len(mesh.vertices) == 4
    places = {tuple(np.round(corner, 6)) for corner in mesh.vertices[mesh.triangles].reshape(-1, 3)}
    assert places == {tuple(corner) for corner in np.round(CORNERS * scale, 6)}
    # By the divergence theorem the volume is right only if all normals point outward.
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0 == pytest.approx(scale**3)


BINARY, TEXT = (tetrahedron().export(file_type=kind) for kind in ("stl", "stl_ascii"))


@pytest.mark.parametrize(
    "data",
    [
        BINARY,
        b"solid made by a program".ljust(80) + BINARY[80:],
        TEXT.encode(),
        TEXT.replace("solid", "solid Gelenk", 1).encode(),
        "solid Gelenkst\xfcck\n".encode("latin-1") + TEXT.split("\n", 1)[1].encode(),
        TEXT.replace("\n", "\r\n").upper().encode(),
    ],
    ids=["binary", "binary solid", "text", "named", "latin1", "upper"],
)
def test_every_variant_of_stl_is_read(tmp_path, data):
    (tmp_path / "t.stl").write_bytes(data)
    assert_tetrahedron(read_mesh_file(tmp_path / "t.stl"))


@pytest.mark.parametrize(
    "data",
    [
        BINARY[:-20],
        BINARY[:80] + struct.pack("<I", 3) + BINARY[84:],
        BINARY[:80] + struct.pack("<I", 2**31) + BINARY[84:],
        b"solid".ljust(80) + struct.pack("<I", 9) + BINARY[84:],
        TEXT[: len(TEXT) // 2].encode(),
        TEXT.replace("vertex", "vortex", 1).encode(),
        TEXT.replace("3.0", "3,x").encode(),
        b"",
    ],
    ids=["truncated", "fewer", "more", "solid", "half text", "spoiled text", "no number", "empty"],
)
def test_damaged_stl_files_are_refused_by_link_and_file(tmp_path, data):
    (tmp_path / "t.stl").write_bytes(data)
    text = urdf(link("hand", '<visual><geometry><mesh filename="t.stl"/></geometry></visual>'))
    with pytest.raises(ModelError, match=r"'hand'.*t\.stl") as caught:
        load_model(write(tmp_path, text), check=False)
    assert "charset" not in str(caught.value)


def test_dae_is_read_in_metres_without_textures(tmp_path):
    mesh = tetrahedron()
    pixels = trimesh.visual.texture.SimpleMaterial()
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((4, 2)), material=pixels)
    text = mesh.export(file_type="dae").decode()
    image = '<library_images><image id="i"><init_from>no.png</init_from></image></library_images>'
    sampler = (
        '<newparam sid="s"><surface type="2D"><init_from>i</init_from></surface></newparam>'
        '<newparam sid="p"><sampler2D><source>s</source></sampler2D></newparam>'
    )
    text = text.replace("<library_effects>", f"{image}<library_effects>")
    text = text.replace("<profile_COMMON>", f"<profile_COMMON>{sampler}")
    colour = r"<diffuse>.*?</diffuse>"
    text = re.sub(colour, '<diffuse><texture texture="p" texcoord="u"/></diffuse>', text, flags=16)
    assert "no.png" in text
    assert 'texture="p"' in text
    unit = '<unit name="inch" meter="0.0254"/><up_axis>'
    path = write(tmp_path, text.replace("<up_axis>", unit), "t.dae")
    assert_tetrahedron(read_mesh_file(path), 0.0254)
    broken = write(tmp_path, text.replace("<source>s<", "<source>gone<"), "broken.dae")
    assert_tetrahedron(read_mesh_file(broken))


def test_drake_reads_back_written_meshes(tmp_path):
    random = np.random.default_rng(2)
    points = random.normal(size=(70000, 3))
    triangles = random.integers(0, len(points), size=(70000, 3), dtype=np.int32)
    path = write_obj(TriangleMesh(points, triangles), "name with / and \xe9")
    surface = ReadObjToTriangleSurfaceMesh(path)
    np.testing.assert_allclose(np.array(surface.vertices()), points, rtol=1e-14, atol=0.0)
    faces = surface.triangles()
    for index in random.integers(0, len(faces), size=1000):
        assert [faces[index].vertex(corner) for corner in range(3)] == list(triangles[index])
    # Different surfaces of one name get different files; equal surfaces share one.
    assert write_obj(TriangleMesh(points + 1.0, triangles), "name with / and \xe9") != path
    assert write_obj(TriangleMesh(points, triangles), "name with / and \xe9") == path


def test_a_round_mesh_and_a_box_enclose_their_volumes_outwards():
    """By the divergence theorem, with triangles counter-clockwise from outside."""
    for shape, volume in (
        (Cylinder(0.3, 1.0), np.pi * 0.09),
        (Ellipsoid(0.4, 0.4, 0.6), np.pi * 0.128),
        (Box(1.0, 2.0, 3.0), 6.0),
    ):
        mesh = shape_mesh(shape)
        a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
        found = np.einsum("ni,ni->", a, np.cross(b, c)) / 6.0
        assert found == pytest.approx(volume, rel=0.01)
        assert is_watertight(mesh)
        flipped = TriangleMesh(mesh.vertices, mesh.triangles[:, ::-1])
        assert is_watertight(flipped)
        assert not is_watertight(TriangleMesh(mesh.vertices, mesh.triangles[1:]))
        turned = mesh.triangles.copy()
        turned[0] = turned[0, ::-1]
        assert not is_watertight(TriangleMesh(mesh.vertices, turned))
        doubled = np.concatenate([mesh.triangles, mesh.triangles])
        assert not is_watertight(TriangleMesh(mesh.vertices, doubled))
    assert not is_watertight(TriangleMesh.empty())


def test_written_normals_are_area_weighted_means_of_the_triangles():
    rng = np.random.default_rng(3)
    made = trimesh.creation.icosphere(1)
    mesh = TriangleMesh(made.vertices * rng.uniform(0.5, 1.5, (42, 1)), np.array(made.faces))
    lines = [line.split() for line in write_obj(mesh, "normals").read_text().splitlines()]
    found = np.array([line[1:] for line in lines if line[:1] == ["vn"]], float)
    expected = np.zeros((42, 3))
    for a, b, c in mesh.triangles:
        p, q, r = mesh.vertices[[a, b, c]]
        expected[[a, b, c]] += np.cross(q - p, r - p)
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    np.testing.assert_allclose(found, expected, atol=6e-5)
