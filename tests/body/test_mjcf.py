"""Sanitised MJCF: link poses and meshes against MuJoCo and against values by hand."""

import sys

import mujoco
import numpy as np
import pytest
import trimesh
from pydrake.geometry import Role

from drake_pose.body import load_model
from drake_pose.errors import ModelError
from tests.body.models import link_poses, write
from tests.body.test_meshes import tetrahedron

# Two joints on one body, which Drake's own parser places wrongly.
TWO_JOINTS = """<body name="a" pos="0 0 0.1"><joint name="x" axis="1 0 0" range="-90 90"/>
<joint name="y" axis="0 1 0" pos="0 0 0.1" range="-90 90"/><geom size="0.05"/>
<body name="b" pos="0 0 0.2"><joint name="z" range="-9 9"/><geom size="0.04"/></body></body>"""
CLASSES = """<default><joint limited="true" range="-60 60"/><geom type="capsule" size="0.05 0.1"/>
<default class="arm"><joint axis="0 1 0" pos="0.02 0.01 0.03"/></default></default>"""
SLIDES = """<geom type="plane" size="1 1 1"/>
<body name="base" pos="0.1 0.2 1" quat="0.8 0.2 0.4 0.4"><geom/>
 <joint name="rx" axis="1 0 0" pos="0 0 0.1"/><joint name="ry" axis="0 1 0"/>
 <joint name="s" type="slide" axis="0 0 1" range="-0.1 0.2"/>
 <body name="arm" pos="0.3 0 0" quat="0.9 0 0.3 0.1" childclass="arm">
  <joint name="a1"/><joint name="a2" axis="1 1 0"/><geom/>
  <body name="hand" pos="0 0 0.3"><joint name="h1"/><joint name="h2" axis="0 0 1"/><geom/></body>
 </body></body>"""
FRAMES = """<frame pos="1 0 0" euler="90 0 0"><body name="a" pos="0 1 0"><geom size="0.1"/>
<frame pos="0 0 1" zaxis="0 0 -1"><joint name="j" range="-9 9" axis="0 1 0" pos="0 0 0.1"/>
<geom type="box" size="0.1" fromto="0 0 0 0 0 1"/>
<frame axisangle="0 2 0 30"><body name="b" pos="0 0 1" xyaxes="0 3 0 -1 1 0"><geom size="0.1"/>
<joint name="k" range="-9 9" pos="0 0 0" axis="1 2 3"/></body></frame></frame></body></frame>"""
REFERENCES = """<body name="a" zaxis="0 0 -1"><joint name="r" ref="30" range="-60 60"/>
<geom size="0.1"/><body name="b" pos="0 0 1" euler="10 20 30"><joint name="s" type="slide"
ref="0.3" range="-1 1" axis="0 2 0"/><joint name="t" ref="-20" axis="1 1 0" range="5 -5"/>
<geom size="0.1"/></body></body>"""
REPLICAS = """<body name="x"><replicate count="3" offset="0 0 1"><body name="b"><geom size="1"/>
<joint name="j" range="-9 9"/></body></replicate></body>"""
MJCF = f'<mujoco model="m">{CLASSES}<worldbody>{SLIDES}</worldbody></mujoco>'


def file_of(folder, body=TWO_JOINTS, more="", attributes='model="m"'):
    text = f"<mujoco {attributes}>{more}<worldbody>{body}</worldbody></mujoco>"
    return write(folder, text, "m.xml")


def posed(model, q):
    """The pose (4, 4) of every body by name, given positions by name."""
    return link_poses(model, np.array([q.get(name, 0.0) for name in model.position_names]))


def assert_as_mujoco(path, model):
    """Compare link poses at random positions, and limits, with MuJoCo's."""
    theirs = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(theirs)
    random = np.random.default_rng(11)
    for _ in range(5):
        q = {}
        for joint in range(theirs.njnt):
            index = theirs.jnt_qposadr[joint]
            data.qpos[index] = random.uniform(-1.0, 1.0)
            name = theirs.joint(joint).name
            q[name] = data.qpos[index]
            if theirs.jnt_limited[joint]:
                place = model.position_index(name)
                limits = (model.lower[place], model.upper[place])
                np.testing.assert_allclose(limits, theirs.jnt_range[joint], atol=1e-9)
        mujoco.mj_kinematics(theirs, data)
        ours = posed(model, q)
        for body in range(1, theirs.nbody):
            X = ours[theirs.body(body).name]
            np.testing.assert_allclose(X[:3, 3], data.xpos[body], atol=1e-9)
            np.testing.assert_allclose(X[:3, :3], data.xmat[body].reshape(3, 3), atol=1e-9)


def test_body_poses_match_mujoco(tmp_path):
    for more, body in (
        (CLASSES, SLIDES),
        ('<compiler eulerseq="zYx"/>', FRAMES),
        ('<compiler eulerseq="XyZ"/><compiler autolimits="true"/>', REFERENCES),
        ("", REPLICAS),
    ):
        path = file_of(tmp_path, body, more)
        model = load_model(path, check=False)
        assert_as_mujoco(path, model)
        tree = model.pose_tree()
        q = np.clip(np.full(len(model.position_names), 0.1), model.lower, model.upper)
        places = link_poses(model, q)
        for node, X in zip(tree.nodes, tree.node_poses(tree.values_from_positions(q)), strict=True):
            if node.name in places:
                np.testing.assert_allclose(X[:3, 3], places[node.name][:3, 3], atol=1e-12)


def test_meshes_of_classes_and_frames(tmp_path):
    model = load_model(file_of(tmp_path, SLIDES, CLASSES), check=False)
    assert set(model.link_meshes) == {"base", "arm", "hand"}  # A plane is no part of the object.
    sizes = {name: np.ptp(mesh.vertices[:, 2]) for name, mesh in model.link_meshes.items()}
    np.testing.assert_allclose(list(sizes.values()), 0.3, atol=1e-9)
    # The frame in a is upside down, so the box extends downwards from (0, 0, 1).
    model = load_model(file_of(tmp_path, FRAMES), check=False)
    assert np.max(model.link_meshes["a"].vertices[:, 2]) == pytest.approx(1.0)
    # A joint without limits is searched about its reference position.
    model = load_model(file_of(tmp_path, REFERENCES), check=False)
    np.testing.assert_allclose(model.lower, (-np.pi / 3, -1.0, np.radians(-200)), atol=1e-12)


# Deviations from strict XML that must be read.
DEVIATIONS = {
    "newline": lambda text: ("\n \n<?xml version='1.0'?>" + text).encode(),
    "comment": lambda text: text.replace("<worldbody>", "<worldbody><!-- a -- b --->").encode(),
    "latin1": lambda text: text.replace('"m"', '"m\xe9"').encode("latin-1"),
    "prefix": lambda text: text.replace("model=", 'xsi:schema="s" model=').encode(),
    "entity": lambda text: text.replace('"m"', '"m&nbsp;n & o"').encode(),
    "bom": lambda text: ("\ufeff" + text).encode(),
    "xmlns": lambda text: text.replace("<mujoco ", '<mujoco xmlns="http://example.org" ').encode(),
    "nameless": lambda text: text.replace('model="m"', "").encode(),
}


@pytest.mark.parametrize("deviate", DEVIATIONS.values(), ids=DEVIATIONS)
def test_xml_is_read_leniently(tmp_path, deviate):
    path = file_of(tmp_path)
    path.write_bytes(deviate(path.read_text()))
    model = load_model(path, check=False)
    assert model.position_names == ("x", "y", "z")
    assert model.name.startswith("m")
    # x rotates a about its origin (0, 0, 0.1) towards -y; b is 0.2 from that origin.
    X_b = posed(model, {"x": np.pi / 2})["b"]
    np.testing.assert_allclose(X_b[:3, 3], (0.0, -0.2, 0.1), atol=1e-12)
    # y rotates about a point 0.1 above a's origin; b is 0.1 from that point.
    X_b = posed(model, {"y": np.pi / 2})["b"]
    np.testing.assert_allclose(X_b[:3, 3], (0.1, 0.0, 0.2), atol=1e-12)


def test_collision_geometry_inertia_and_textures_are_ignored(tmp_path):
    plate = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    plate = trimesh.Trimesh(plate, [[0, 1, 2], [1, 3, 2]], process=False)
    plate.export(tmp_path / "plate.stl")
    more = """<asset><mesh file="plate.stl"/><mesh name="missing" file="no.stl"/>
    <texture name="t" type="2d" file="no.png"/><material name="paint" texture="t"/>
    <material name="glass" rgba="1 1 1 0"/></asset><default><geom size="0.1 0.1 0.1" type="box"/>
    <default class="collision"><geom group="3"/></default>
    <default class="visual"><geom group="1" contype="0" conaffinity="0"/></default></default>
    <contact><pair geom1="g" geom2="g2"/><exclude body1="world" body2="a"/></contact>
    <equality><weld body1="a" body2="b"/></equality>
    <actuator><motor joint="free"/><motor joint="j"/></actuator>"""
    body = """<body name="a" childclass="visual"><inertial pos="0 0 0" mass="0"
    diaginertia="0 0 0"/><freejoint name="free"/><geom size="0.2" name="geom1" material="paint"/>
    <geom type="mesh" mesh="plate" class="collision"/><geom class="main" type="mesh" mesh="plate"/>
    <geom type="mesh" mesh="missing" class="collision"/><geom size="5" material="glass"/>
    <geom size="6" rgba="1 0 0 0" name="g2"/><body name="b"><joint name="j" range="-9 9"/>
    <geom class="collision" name="g"/></body></body>"""
    model = load_model(file_of(tmp_path, body, more), check=True)
    assert set(model.link_meshes) == {"a"}
    assert any("1 <equality> constraint" in warning for warning in model.warnings)
    # A box, whose class completes its sizes, and the plate.
    mesh = model.link_meshes["a"]
    assert len(mesh.triangles) == 12 + 2
    np.testing.assert_allclose(np.max(mesh.vertices, axis=0), (1.0, 1.0, 0.1), atol=1e-6)
    np.testing.assert_allclose(np.min(mesh.vertices, axis=0), (-0.2, -0.1, -0.1), atol=1e-6)
    assert model.scene_graph.model_inspector().NumGeometriesWithRole(Role.kProximity) == 0
    # A body without <inertial> keeps the mass of its undrawn geom.
    assert model.plant.GetBodyByName("b").default_mass() == pytest.approx(8.0)


def test_meshes_are_placed_as_in_mujoco(tmp_path):
    for asset, corner in (
        ('file="t.stl" scale="2 1 1"', (2.0, 2.0, 3.0)),
        # Reference pose first, then scale: (0, 2, 0) - (1, 0, 0), rotated back by 90 deg, doubled.
        ('file="t.stl" refpos="1 0 0" refquat="1 0 0 1" scale="2 1 1"', (4.0, 1.0, 3.0)),
        ('vertex="0 0 0  1 0 0  0 2 0  0 0 3  0.1 0.1 0.1"', (1.0, 2.0, 3.0)),
    ):
        tetrahedron().export(tmp_path / "t.stl")
        body = '<body name="a"><geom type="mesh" mesh="t"/></body>'
        path = file_of(tmp_path, body, f'<asset><mesh name="t" {asset}/></asset>')
        mesh = load_model(path, check=False).link_meshes["a"]
        assert len(mesh.triangles) == 4
        np.testing.assert_allclose(np.max(mesh.vertices, axis=0), corner, atol=1e-6)


GEOM = '<geom size="1"/></body>'


def test_errors_quote_mujocos_reason(tmp_path):
    for text, message in (
        ('<robot name="r"><link name="a"/></robot>', "outermost element is <robot>.*name it .urdf"),
        ('<sdf version="1.7"/>', "outermost element is <sdf>"),
        ("<body>", "not well-formed XML"),
        ('<body name="b"><freejoint/><joint name="j"/>' + GEOM, "body 'b'"),
        ('<flexcomp name="c" type="grid" count="2 2 2" spacing="1 1 1" dim="3"/>', "<flex> 'c'"),
        ('<body name="a" pos="1 2">' + GEOM, "'pos'.*line 1"),
        ('<attach model="s" prefix="left_"/>', "model 's'"),
    ):
        whole = text.startswith(("<robot", "<sdf"))
        path = write(tmp_path, text, "m.xml") if whole else file_of(tmp_path, text)
        with pytest.raises(ModelError, match=rf"(?s)m\.xml.*{message}"):
            load_model(path, check=False)


def test_missing_mujoco_names_the_extra_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ModelError, match=r'm\.xml: .*pip install "drake_pose\[mjcf\]"'):
        load_model(file_of(tmp_path), check=False)
