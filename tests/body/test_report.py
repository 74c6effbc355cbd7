"""The report on a model file: its parts, its couplings, and what may be unexpected."""

import numpy as np
import trimesh

from drake_pose.body import RootRotation, describe_model, load_model, model_warnings
from tests.body.models import BOX, HAND, joint, link, urdf, write


def visual(shape, place=""):
    return f"<visual>{place}<geometry>{shape}</geometry></visual>"


CYLINDER = '<cylinder radius="0.1" length="0.3"/>'


def test_report_lists_nodes_joints_and_couplings(tmp_path):
    nodes = {node["name"]: node for node in describe_model(write(tmp_path, HAND)).nodes}
    assert [nodes[name]["parent"] for name in ("palm", "one", "two")] == ["world", "palm", "one"]
    joints = {name: node["joints"][0] for name, node in nodes.items()}
    assert [joints[name]["follows"] for name in ("one", "two")] == ["", "-1 lead +0.1"]
    np.testing.assert_allclose(joints["one"]["upper"], np.degrees(0.7))
    np.testing.assert_allclose([joints["far"][end] for end in ("lower", "upper")], [0.0, 0.7])
    assert joints["far"]["kind"] == "length"
    assert {node["triangles"] for node in nodes.values()} == {12}
    tree = load_model(write(tmp_path, HAND), check=False).pose_tree()
    (warning,) = model_warnings(tree.model, tree)
    assert "'far' is written to follow joint 'lead'" in warning
    # A leader behind its follower: the tree has the follower's position, the report the model's.
    ring = joint("A", "revolute", "world", "a", more='<mimic joint="B" multiplier="2"/>')
    serial = urdf(link("world", ""), link("a"), link("b"), ring, joint("B", "revolute", "a", "b"))
    joints = [one["joints"][0] for one in describe_model(write(tmp_path, serial)).nodes]
    assert [(one["name"], one["follows"]) for one in joints] == [("A", "2 B +0"), ("B", "")]


def report_of(folder, shape, origin='xyz="0 0 0"', axis="0 0 1", limits='lower="0" upper="1"'):
    turn = joint("turn", "revolute", "a", "b", axis=axis, limits=limits, origin=origin)
    text = urdf(link("a"), link("b", shape), turn)
    return "\n".join(describe_model(write(folder, text)).warnings)


def test_only_joints_about_an_axis_of_symmetry_are_named(tmp_path):
    trimesh.creation.cylinder(0.1, 0.3, sections=5).export(tmp_path / "pentagon.stl")
    mesh, moved = '<mesh filename="{}.stl"/>', '<origin xyz="0.05 0 0.2"/>'
    bent, aside = '<origin xyz="0 0 0.2" rpy="0.3 0 0"/>', '<origin xyz="0 0 1"/>'
    for shape, axis, is_symmetric in (
        (visual(CYLINDER), "0 0 1", True),
        (visual(CYLINDER, aside), "0 0 -1", True),
        (visual(CYLINDER), "1 0 0", False),
        (visual(CYLINDER, moved), "0 0 1", False),
        (visual(CYLINDER, bent), "0 0 1", False),
        (visual(mesh.format("pentagon")), "0 0 1", False),
        (visual('<box size="0.1 0.1 0.3"/>'), "0 0 1", False),
        (visual('<sphere radius="0.1"/>'), "1 2 3", True),
        (visual(CYLINDER) + visual('<box size="0.3 0.01 0.01"/>'), "0 0 1", False),
    ):
        text = report_of(tmp_path, shape, axis=axis, origin='xyz="0.1 0.2 0.3" rpy="1 2 3"')
        assert ("'turn' turns link 'b' about the link's own axis" in text) == is_symmetric, shape
    # Only outermost links are examined.
    middle = urdf(
        *(link("a"), link("b", visual(CYLINDER)), link("c")),
        joint("spin", "revolute", "a", "b", axis="0 0 1", origin=""),
        joint("next", "revolute", "b", "c", origin=""),
    )
    assert not describe_model(write(tmp_path, middle)).warnings


def test_unexpected_sizes_limits_joints_and_surfaces_are_named(tmp_path):
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(tmp_path / "t.stl")
    box = '<box size="0.3 {} 0.1"/>'
    for shape, limits, expected in (
        (box.format(1), 'lower="0" upper="1"', ""),
        (box.format(49), 'lower="0" upper="1"', ""),
        (box.format(51), 'lower="0" upper="1"', "51 m long"),
        (box.format(1), 'lower="0" upper="0"', "they never move: turn"),
        ('<mesh filename="t.stl"/>', 'lower="0" upper="1"', "'b' are not watertight"),
    ):
        text = report_of(tmp_path, visual(shape), limits=limits)
        assert (expected in text) if expected else not text
    small = urdf(link("a", visual('<box size="0.018 0.01 0.005"/>')))
    assert "in metres" in describe_model(write(tmp_path, small)).warnings[0]
    fixed = joint("fix", "fixed", "world", "a", limits=None)
    still = urdf(link("a"), link("b", ""), fixed, joint("nod", "revolute", "a", "b"))
    (warning,) = describe_model(write(tmp_path, still)).warnings
    assert "no visual geometry" in warning
    assert warning.endswith("nod")
    model = load_model(write(tmp_path, still), check=False)
    rooted = model.pose_tree("a", root_rotation=RootRotation.free())
    assert model_warnings(model, rooted) == ()
    bare = describe_model(write(tmp_path, urdf(link("a", "")), "bare.urdf"))
    assert (bare.usable, bare.name, bare.nodes) == (False, "", ())
    assert "no visual geometry" in bare.errors[0]
    assert describe_model(write(tmp_path, urdf(link("a", BOX)))).usable
