"""Loading of models: positions, mesh formats, replaced meshes, checks and reports."""

import json
import logging

import numpy as np
import pytest
import trimesh
from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams, Role, SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body import (
    TriangleMesh,
    bundled_model,
    captured_warnings,
    describe_model,
    load_model,
)
from drake_pose.body.meshes import merge_duplicate_vertices
from drake_pose.body.model_files import package_map
from drake_pose.errors import ModelError, UnknownNameError
from tests.body.models import FLOATING_URDF, cube_obj, joint, link, urdf, write


def mesh_urdf(*files, scale="1 1 1"):
    mesh = '<visual><geometry><mesh filename="{}" scale="{}"/></geometry></visual>'
    visuals = "".join(mesh.format(file, scale) for file in files)
    return urdf(link("a", visuals), joint("j", "fixed", "world", "a", limits=None))


def test_positions_limits_and_defaults(tmp_path):
    text = FLOATING_URDF.replace('lower="-0.2" upper="0.3"', 'lower="0.1" upper="0.3"')
    model = load_model(write(tmp_path, text), check=False)
    names = dict(zip(model.position_names, range(13), strict=False))
    base = tuple(f"trunk_{one}" for one in ("qw", "qx", "qy", "qz", "x", "y", "z"))
    assert model.position_names[:7] == base
    assert model.position_kinds[0] == "quaternion"
    assert model.position_kinds[names["hip"]] == "angle"
    assert model.position_kinds[names["slide"]] == "length"
    assert (model.lower[names["hip"]], model.upper[names["hip"]]) == (-np.pi, np.pi)
    assert model.default_positions[names["slide"]] == 0.1
    with pytest.raises(ValueError, match="read-only"):
        model.lower[0] = 0.0
    with pytest.raises(UnknownNameError, match="shoulder_x"):
        model.position_index("nose")


@pytest.mark.parametrize("extension", ["obj", "gltf", "glb", "stl", "dae"])
def test_every_mesh_format_shows_the_same_cube(tmp_path, extension):
    cube = trimesh.creation.box((1.0, 2.0, 3.0))
    if extension in ("gltf", "glb"):
        # Up is y in glTF and z in Drake, so write the cube rotated.
        cube.vertices = cube.vertices @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    cube.export(tmp_path / f"cube.{extension}")
    text = mesh_urdf(f"cube.{extension}", scale="2 1 1")
    model = load_model(write(tmp_path, text), check=False)
    mesh = model.link_meshes["a"]
    assert (len(mesh.vertices), len(mesh.triangles)) == (8, 12)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [2, 2, 3], atol=1e-6)


def test_merging_drops_degenerate_triangles_and_unused_vertices():
    vertices = np.array([[0.0, 0, 0], [9, 9, 9], [1, 0, 0], [0, 1, 0], [0, 0, 0]])
    mesh = TriangleMesh(vertices, np.array([[0, 2, 3], [4, 0, 2], [4, 2, 3]], dtype=np.int32))
    merged = merge_duplicate_vertices(mesh)
    np.testing.assert_array_equal(merged.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(merged.triangles, [[0, 1, 2], [0, 1, 2]])


def test_undrawable_mesh_files_are_replaced(tmp_path):
    trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / "cube.stl")
    (tmp_path / "bare.obj").write_text(cube_obj(normals=False))
    (tmp_path / "good.obj").write_text(cube_obj(normals=True))
    text = mesh_urdf("cube.stl", "bare.obj", "good.obj")
    model = load_model(write(tmp_path, text), check=False)
    plant, scene_graph = MultibodyPlant(0.0), SceneGraph()
    model.add_to(plant, scene_graph, prefix="copy")
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
    inspector = scene_graph.model_inspector()
    shapes = [inspector.GetShape(i) for i in inspector.GetAllGeometryIds(Role.kPerception)]
    paths = [shape.source().path() for shape in shapes]
    assert [str(path).endswith(".obj") for path in paths] == [True] * 3
    assert sum(str(path) == str(tmp_path / "good.obj") for path in paths) == 1


def test_bundled_models_are_in_the_package_map():
    assert bundled_model("woman").is_file()
    assert package_map().Contains("drake_pose")
    with pytest.raises(UnknownNameError, match=r"'goblin'.*woman"):
        bundled_model("goblin")
    with pytest.raises(ModelError, match="package 'mine'"):
        package_map({"mine": "/nowhere"})


POINTS = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
BROKEN: list = [b"hello\n", b"", POINTS + b"vn 0 0 1\n", POINTS + b"v 0 0 nan\nf 1 2 4\n"]
BROKEN = [("a.obj", content) for content in (*BROKEN, POINTS + b"f 1 2 9\n")]
BROKEN += [("a.dae", b"<COLLADA"), ("a.gltf", b"{}"), ("a.glb", b"glTF"), ("a.ply", b"ply\n")]


@pytest.mark.parametrize(("name", "content"), BROKEN)
def test_errors_of_broken_meshes_name_the_files(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ModelError, match=rf"thing\.urdf.*{name}"):
        load_model(write(tmp_path, mesh_urdf(name)), check=False)


def test_drakes_warnings_are_collected_once_and_not_printed(caplog):
    with captured_warnings() as texts:
        for level in (logging.INFO, logging.WARNING, logging.ERROR, logging.WARNING):
            record = logging.makeLogRecord({"levelno": level, "msg": f" {level}\n"})
            logging.getLogger("drake").handle(record)
    assert texts == [str(logging.WARNING), str(logging.ERROR)]
    assert not caplog.records


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]\n" for level in range(1, 10)
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("loop.sdf", '<sdf version="1.9"><model name="m"><include><uri>package://mine/loop.sdf</uri>'
         "</include></model></sdf>"),
        ("loop.dmd.yaml", "directives:\n- add_directives:\n    file: package://mine/loop.dmd.yaml\n"),
        ("bomb.dmd.yaml", BOMB + "directives: []\n"),
        ("thing.urdf", mesh_urdf("cube.gltf")),
    ],
    ids=["SDFormat", "directives", "aliases", "accessor out of bounds"],
)  # fmt: skip
def test_files_that_crash_drake_raise_model_error(tmp_path, name, text):
    trimesh.creation.box().export(tmp_path / "cube.gltf")
    document = json.loads((tmp_path / "cube.gltf").read_text())
    for accessor in document["accessors"]:
        accessor["count"] = 100_000_000
    (tmp_path / "cube.gltf").write_text(json.dumps(document))
    with pytest.raises(ModelError, match=name):
        load_model(write(tmp_path, text, name), package_paths={"mine": tmp_path})


def test_report_warns_of_symmetry_and_unobserved_joints(tmp_path):
    round_ = '<visual><geometry><cylinder radius="0.1" length="0.3"/></geometry></visual>'
    text = urdf(
        *(link("a"), link("b"), link("c", round_), link("d", "")),
        joint("lead", "revolute", "world", "a"),
        joint("follow", "revolute", "a", "b", more='<mimic joint="lead"/>'),
        joint("spin", "revolute", "b", "c", axis="0 0 1"),
        joint("nod", "revolute", "b", "d", axis="0 0 1"),
    )
    report = describe_model(write(tmp_path, text))
    assert report.usable
    assert [node["name"] for node in report.nodes] == ["a", "b", "c"]
    np.testing.assert_allclose(report.nodes[0]["joints"][0]["upper"], np.degrees(1.0))
    assert all(node["watertight"] for node in report.nodes)
    warnings = "\n".join(report.warnings)
    assert "'spin' turns link 'c' about the link's own axis" in warnings
    assert "nod" in warnings
    assert "<mimic>" not in warnings
    assert "'follow' turns" not in warnings
    bare = describe_model(write(tmp_path, urdf(link("a", "")), "bare.urdf"))
    assert not bare.usable
    assert "no visual geometry" in bare.errors[0]
