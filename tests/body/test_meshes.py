"""Reading and writing of mesh files, triangles of Drake's shapes, and what its renderer draws."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydrake import geometry
from pydrake.common import MemoryFile
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body import TriangleMesh, join_meshes, load_model, meshes
from drake_pose.errors import ModelError
from tests.body import sdf_models as sdf
from tests.body.models import cube_obj, joint, link, urdf, write

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], dtype=float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def mesh_urdf(*files, scale="1 1 1"):
    mesh = '<visual><geometry><mesh filename="{}" scale="{}"/></geometry></visual>'
    visuals = "".join(mesh.format(file, scale) for file in files)
    return urdf(link("a", visuals), joint("j", "fixed", "world", "a", limits=None))


def tetrahedron():
    return trimesh.Trimesh(CORNERS, FACES, process=False)


def volume(mesh):
    """By the divergence theorem, right only if all triangles face outwards."""
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0


def assert_tetrahedron(mesh, scale=1.0):
    assert len(mesh.vertices) == 4
    places = {tuple(np.round(corner, 6)) for corner in mesh.vertices[mesh.triangles].reshape(-1, 3)}
    assert places == {tuple(corner) for corner in np.round(CORNERS * scale, 6)}
    assert volume(mesh) == pytest.approx(scale**3)


BINARY, TEXT = (tetrahedron().export(file_type=kind) for kind in ("stl", "stl_ascii"))


def test_every_variant_of_stl_is_read(tmp_path):
    for k, data in enumerate((
        BINARY,
        b"solid made by a program".ljust(80) + BINARY[80:],
        TEXT.encode(),
        TEXT.replace("solid", "solid Gelenk", 1).encode(),
        "solid Gelenkst\xfcck\n".encode("latin-1") + TEXT.split("\n", 1)[1].encode(),
        TEXT.replace("\n", "\r\n").upper().encode(),
    )):  # fmt: skip
        (tmp_path / f"{k}.stl").write_bytes(data)
        assert_tetrahedron(meshes.read_mesh_file(tmp_path / f"{k}.stl"))


POINTS = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
DAMAGED = {
    "truncated.stl": BINARY[:-20],
    "fewer.stl": BINARY[:80] + struct.pack("<I", 3) + BINARY[84:],
    "more.stl": BINARY[:80] + struct.pack("<I", 2**31) + BINARY[84:],
    "solid.stl": b"solid".ljust(80) + struct.pack("<I", 9) + BINARY[84:],
    "none.stl": BINARY[:80] + struct.pack("<I", 0),
    "half_text.stl": TEXT[: len(TEXT) // 2].encode(),
    "spoiled_text.stl": TEXT.replace("vertex", "vortex", 1).encode(),
    "no_number.stl": TEXT.replace("3.0", "3,x").encode(),
    "no_facet.stl": b"solid a\nendsolid a\n",
    "words.stl": b"facet normal",
    "empty.stl": b"",
    "words.obj": b"hello\n",
    "empty.obj": b"",
    "no_face.obj": POINTS + b"vn 0 0 1\n",
    "nan.obj": POINTS + b"v 0 0 nan\nf 1 2 4\n",
    "far.obj": POINTS + b"v 0 0 -INF\nf 1 2 3\n",
    "missing.obj": POINTS + b"f 1 2 9\n",
    "flat.obj": POINTS + b"f 1 2 2\n",
    "a.dae": b"<COLLADA",
    "no_scene.dae": re.sub(rb"(?s)<scene>.*</scene>", b"", tetrahedron().export(file_type="dae")),
    "a.gltf": b"{}",
    "a.glb": b"glTF",
    "a.ply": b"ply\n",
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_are_refused_by_link_and_file(tmp_path, name):
    (tmp_path / name).write_bytes(DAMAGED[name])
    with pytest.raises(ModelError, match=rf"thing\.urdf.*'a'.*{name}") as caught:
        load_model(write(tmp_path, mesh_urdf(name)), check=False)
    assert "charset" not in str(caught.value)
    with pytest.raises(ModelError, match="none does not exist"):
        meshes.read_mesh_file(tmp_path / "none")


@pytest.mark.parametrize("extension", ["obj", "gltf", "glb", "stl", "dae"])
def test_every_format_shows_the_same_cube(tmp_path, extension):
    """Its triangles face outwards, also where a factor of the scale mirrors them."""
    cube = trimesh.creation.box((1.0, 2.0, 3.0))
    if extension in ("gltf", "glb"):
        # Up is y in glTF and z in Drake, so write the cube rotated.
        cube.vertices = cube.vertices @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    path = tmp_path / f"cube.{extension}"
    cube.export(path)
    if extension == "obj":
        path.write_text("o nan_info\n" + path.read_text())
    for scale in ((2.0, 1.0, 1.0), (2.0, -1.0, 1.0)):
        mesh = meshes.read_mesh_file(path, np.array(scale))
        assert (len(mesh.vertices), len(mesh.triangles)) == (8, 12)
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [2, 2, 3], atol=1e-6)
        assert volume(mesh) == pytest.approx(12.0)
    assert meshes.read_mesh_file(path) is meshes.read_mesh_file(path)


def test_merging_drops_degenerate_triangles_and_unused_vertices():
    vertices = np.array([[0.0, 0, 0], [9, 9, 9], [1, 0, 0], [0, 1, 0], [0, 0, 0]])
    mesh = TriangleMesh(vertices, np.array([[0, 2, 3], [4, 0, 2], [4, 2, 3], [2, 0, 4], [0, 2, 4]]))
    merged = meshes.merge_duplicate_vertices(mesh)
    np.testing.assert_array_equal(merged.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(merged.triangles, [[0, 1, 2], [0, 1, 2]])
    joined = join_meshes([mesh, TriangleMesh.empty(), merged])
    corners = [one.vertices[one.triangles] for one in (joined, mesh, merged)]
    np.testing.assert_array_equal(corners[0], np.concatenate(corners[1:]))
    assert join_meshes([]).is_empty
    assert meshes.merge_duplicate_vertices(join_meshes([])).is_empty


def test_undrawable_mesh_files_are_replaced(tmp_path):
    """Drake's renderer skips STL files and OBJ files without normals."""
    for name in ("cube.stl", "cube.gltf"):
        trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / name)
    (tmp_path / "bare.obj").write_text(cube_obj(normals=False))
    (tmp_path / "good.obj").write_text(cube_obj(normals=True))
    files = ("cube.stl", "bare.obj", "good.obj", "cube.gltf")
    model = load_model(write(tmp_path, mesh_urdf(*files, scale="1 2 1")), check=False)
    plant, scene_graph = MultibodyPlant(0.0), geometry.SceneGraph()
    model.add_to(plant, scene_graph, prefix="copy")
    scene_graph.AddRenderer("vtk", geometry.MakeRenderEngineVtk(geometry.RenderEngineVtkParams()))
    inspector = scene_graph.model_inspector()
    ids = inspector.GetAllGeometryIds(geometry.Role.kPerception)
    drawn = [inspector.GetShape(one) for one in ids]
    paths = [Path(mesh.source().path()) for mesh in drawn]
    assert {path.name for path in paths if path.parent == tmp_path} == {"good.obj", "cube.gltf"}
    assert [path.suffix for path in paths].count(".obj") == 3
    np.testing.assert_array_equal([mesh.scale3() for mesh in drawn], [[1, 2, 1]] * 4)
    assert meshes.draws_given_files(scene_graph)
    only = load_model(write(tmp_path, mesh_urdf(*files[:2])), check=False)
    assert not meshes.draws_given_files(only.scene_graph)
    registered, graph = MultibodyPlant(0.0), geometry.SceneGraph()
    registered.RegisterAsSourceForSceneGraph(graph)
    with pytest.raises(ModelError, match="scene_graph"):
        model.add_to(registered)
    # The ground is no part of an object, and is not rendered.
    text = sdf.sdf(sdf.link("a", "<plane/>"), sdf.link("b"))
    ground = load_model(write(tmp_path, text, "m.sdf"), check=False)
    assert list(ground.link_meshes) == ["b"]
    assert (
        len(ground.scene_graph.model_inspector().GetAllGeometryIds(geometry.Role.kPerception)) == 1
    )


def test_dae_is_read_in_metres_without_textures(tmp_path):
    """Also where a texture is missing, or its definition is broken."""
    solid = tetrahedron()
    pixels = trimesh.visual.texture.SimpleMaterial()
    solid.visual = trimesh.visual.TextureVisuals(uv=np.zeros((4, 2)), material=pixels)
    text = solid.export(file_type="dae").decode()
    image = '<library_images><image id="i"><init_from>no.png</init_from></image></library_images>'
    sampler = '<newparam sid="p"><sampler2D><source>gone</source></sampler2D></newparam>'
    text = text.replace("<library_effects>", f"{image}<library_effects>")
    text = text.replace("<profile_COMMON>", f"<profile_COMMON>{sampler}")
    texture = '<diffuse><texture texture="p" texcoord="u"/></diffuse>'
    text = re.sub(r"(?s)<diffuse>.*?</diffuse>", texture, text)
    assert "no.png" in text
    assert 'texture="p"' in text
    unit = '<unit name="inch" meter="0.0254"/><up_axis>'
    path = write(tmp_path, text.replace("<up_axis>", unit), "t.dae")
    assert_tetrahedron(meshes.read_mesh_file(path), 0.0254)


def test_drake_reads_back_written_meshes(tmp_path):
    random = np.random.default_rng(2)
    points = random.normal(size=(70000, 3))
    triangles = random.integers(0, len(points), size=(70000, 3), dtype=np.int32)
    path = meshes.write_obj(TriangleMesh(points, triangles), "name with / and \xe9")
    surface = geometry.ReadObjToTriangleSurfaceMesh(path)
    np.testing.assert_allclose(np.array(surface.vertices()), points, rtol=1e-14, atol=0.0)
    faces = surface.triangles()
    for index in random.integers(0, len(faces), size=1000):
        assert [faces[index].vertex(corner) for corner in range(3)] == list(triangles[index])
    # Different surfaces of one name get different files; equal surfaces share one.
    name = "name with / and \xe9"
    assert meshes.write_obj(TriangleMesh(points + 1.0, triangles), name) != path
    assert meshes.write_obj(TriangleMesh(points, triangles), name) == path


def test_shapes_enclose_their_volumes_and_reach_their_ends(tmp_path):
    trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / "box.obj")
    for shape, size, expected in (
        (geometry.Cylinder(0.3, 1.0), (0.6, 0.6, 1.0), np.pi * 0.09),
        (geometry.Capsule(0.3, 1.0), (0.6, 0.6, 1.6), np.pi * 0.126),
        (geometry.Sphere(0.5), (1.0, 1.0, 1.0), np.pi / 6.0),
        (geometry.Ellipsoid(0.4, 0.5, 0.6), (0.8, 1.0, 1.2), np.pi * 0.16),
        (geometry.Box(1.0, 2.0, 3.0), (1.0, 2.0, 3.0), 6.0),
        (geometry.Convex(str(tmp_path / "box.obj"), np.ones(3)), (1.0, 2.0, 3.0), 6.0),
    ):
        mesh = meshes.shape_mesh(shape)
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), size, rtol=0.003)
        np.testing.assert_allclose(mesh.vertices.min(axis=0), np.multiply(size, -0.5), rtol=0.005)
        assert volume(mesh) == pytest.approx(expected, rel=0.01)
        assert meshes.is_watertight(mesh)
        assert meshes.is_watertight(TriangleMesh(mesh.vertices, mesh.triangles[:, ::-1]))
        turned = mesh.triangles.copy()
        turned[0] = turned[0, ::-1]
        for spoilt in (mesh.triangles[1:], turned, np.concatenate([mesh.triangles] * 2)):
            assert not meshes.is_watertight(TriangleMesh(mesh.vertices, spoilt))
    # Drake's cylinders begin on y.
    assert meshes.shape_mesh(geometry.Cylinder(0.3, 1.0)).vertices[:, 1].max() == pytest.approx(
        0.3, abs=1e-12
    )
    assert not meshes.is_watertight(TriangleMesh.empty())
    memory = geometry.InMemoryMesh(mesh_file=MemoryFile(cube_obj(normals=True), ".obj", "cube"))
    for shape, word in ((geometry.HalfSpace(), "HalfSpace"), (geometry.Mesh(memory), "in-memory")):
        with pytest.raises(ModelError, match=word):
            meshes.shape_mesh(shape)


def test_written_normals_are_area_weighted_means_of_the_triangles():
    rng = np.random.default_rng(3)
    made = trimesh.creation.icosphere(1)
    mesh = TriangleMesh(made.vertices * rng.uniform(0.5, 1.5, (42, 1)), np.array(made.faces))
    lines = [line.split() for line in meshes.write_obj(mesh, "normals").read_text().splitlines()]
    found = np.array([line[1:] for line in lines if line[:1] == ["vn"]], float)
    expected = np.zeros((42, 3))
    for corners in mesh.triangles:
        p, q, r = mesh.vertices[corners]
        expected[corners] += np.cross(q - p, r - p)
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    np.testing.assert_allclose(found, expected, atol=6e-5)
