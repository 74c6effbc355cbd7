"""Sanitising of URDF, SDFormat, MJCF and model directives; MJCF against MuJoCo."""

import mujoco
import numpy as np
import pytest
import trimesh
from pydrake.geometry import Role
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body import load_model
from drake_pose.errors import ModelError
from tests.body import sdf_models as sdf
from tests.body.models import BOX, WELDED_URDF, joint, link, link_poses, urdf, write
from tests.body.test_meshes import tetrahedron

STL = '<collision><geometry><mesh filename="{}"/></geometry></collision>'


def read(folder, text, name="thing.urdf", **options):
    return load_model(write(folder, text, name), check=False, **options)


def refusal(folder, text, name="thing.urdf"):
    with pytest.raises(ModelError) as caught:
        read(folder, text, name)
    message = str(caught.value)
    assert name in message
    for raw in ("Failure at", "condition '", "literal-string", "data-string"):
        assert raw not in message
    return message


def arm(more_of_joint="", more="", a=BOX, **options):
    elbow = joint("elbow", options.pop("kind", "revolute"), "a", "b", more=more_of_joint, **options)
    return urdf(link("a", a), link("b"), elbow, more)


def link_of(names, *shape, **more):
    return "".join(sdf.link(name, *shape, **more) for name in names)


def visual(shape, material=""):
    return f"<visual><geometry>{shape}</geometry>{material}</visual>"


@pytest.mark.parametrize("mesh", ["c.stl", "gone.dae", "package://unknown/c.stl"])
def test_collision_meshes_are_neither_drawn_nor_read(tmp_path, mesh):
    trimesh.creation.box().export(tmp_path / "c.stl")
    box, solid = sdf.sdf(link_of("a", more=sdf.collision(mesh))), STL.format(mesh)
    for name, text, bare in (
        ("thing.urdf", urdf(link("a", BOX + solid)), urdf(link("a", solid))),
        ("thing.sdf", box, sdf.sdf(link_of("a", "", sdf.collision(mesh)))),
    ):
        model = read(tmp_path, text, name)
        assert (len(model.link_meshes["a"].triangles), model.warnings) == (12, ())
        assert "no visual geometry" in refusal(tmp_path, bare, name)


def test_materials_of_one_name_keep_their_colours(tmp_path):
    red, green, bright = (
        f'<material name="m"><color rgba="{rgba}"/></material>'
        for rgba in ("1 0 0 1", "0 1 0 1", "255 0 0 1")
    )
    texture = '<material name="t"><texture filename="gone.png"/></material>'
    own = {"a": green, "b": '<material name="m"/>', "d": bright, "e": texture}
    links = (link(name, visual('<sphere radius="0.1"/>', one)) for name, one in own.items())
    welds = (joint(f"to_{child}", "fixed", "a", child, limits=None) for child in "bde")
    model = read(tmp_path, urdf(red, red, *links, *welds))
    inspector = model.scene_graph.model_inspector()
    for name, expected in {"a": (0, 1, 0, 1), "b": (1, 0, 0, 1), "d": (1, 0, 0, 1)}.items():
        geometry = model.plant.GetVisualGeometriesForBody(model.plant.GetBodyByName(name))[0]
        rgba = inspector.GetPerceptionProperties(geometry).GetProperty("phong", "diffuse")
        assert (rgba.r(), rgba.g(), rgba.b(), rgba.a()) == expected


def test_unexpanded_macros_are_refused_and_mere_declarations_read(tmp_path):
    xmlns = 'xmlns:xacro="http://www.ros.org/wiki/xacro" '
    for left, named in (
        ('<xacro:macro name="m"><link name="c"/></xacro:macro>', "xacro:macro"),
        ('<xacro:my_arm prefix="l"/>', "xacro:my_arm"),
        ('<link name="${prefix}c"/>', "${prefix}c"),
        ('<include filename="$(find arm)/arm.xacro"/>', "include"),
        ('<macro name="m"/>', "macro"),
        (link("c", visual('<mesh filename="$(find arm)/c.stl"/>')), "$(find arm)"),
    ):
        for declared in ("", xmlns):
            text = arm(more="\n" + left).replace("<robot ", f"<robot {declared}")
            message = refusal(tmp_path, text)
            assert named in message
            assert "in line 2: links" in message
            assert "xacro robot.urdf.xacro > robot.urdf" in message
    text = arm(more='<gazebo><plugin><p>$(arg x)</p></plugin></gazebo><transmission name="t"/>'
               '<xacro:property name="w" value="${pi/2}"/><xacro:arg name="x" default="1"/>'
               '<xacro:property name="o"><origin xyz="0 0 0"/></xacro:property>')  # fmt: skip
    text = text.replace("<robot ", f"<robot {xmlns}")
    model = read(tmp_path, text)
    assert model.position_names[-1] == "elbow"
    assert model.warnings == ()
    assert "expand it first" in refusal(tmp_path, text, "thing.urdf.xacro")


def test_irrelevant_elements_are_left_out_and_unknown_ones_named(tmp_path):
    text = arm(
        '<safety_controller k_velocity="1"/><dynamics damping="-1"/><mimic joint="gone"/>',
        '<transmission name="t"><joint name="gone"/></transmission><bogus/>',
        a=BOX + '<inertial><mass value="nan"/></inertial><sensor type="camera"/>',
    )
    model = read(tmp_path, text.replace(' name="thing"', ""))
    assert model.name == "thing"
    follower, unknown = sorted(model.warnings)
    assert "'elbow' is written to follow joint 'gone' (<mimic>): not enforced" in follower
    assert "robot 'thing': the element <bogus>" in unknown
    # In SDFormat, with gearboxes and loops of links.
    text = sdf.sdf(
        link_of("abcd"),
        sdf.joint("shut", "d", "c", sdf.LIMITS + "<dynamics><damping>-1</damping></dynamics>"),
        sdf.joint("one", "a", "b", sdf.LIMITS + '<mimic joint="two" axis="axis"/>'),
        sdf.joint("two", "b", "c", kind="continuous"),
        sdf.joint("three", "a", "d"),
        sdf.joint("gear", "a", "c", kind="gearbox"),
        '<plugin name="p"><bogus>${x}</bogus></plugin><light name="l" type="point"/><bogus/>',
    )
    model = read(tmp_path, text, "thing.sdf")
    assert set(model.position_names[-3:]) == {"one", "shut", "three"}
    gear, one, two, other = sorted(model.warnings)
    assert "'gear' is a gearbox" in gear
    assert "'one' is written to follow joint 'two'" in one
    assert "'two' closes a loop of links at 'c'" in two
    assert "<bogus>" in other


def test_continuous_joints_ignore_limits(tmp_path):
    for kind, limits, end in (
        ("continuous", 'lower="0" upper="0"', np.pi),
        ("continuous", 'lower="1" upper="-1"', np.pi),
        ("revolute", 'lower="0" upper="0"', 0.0),
        ("revolute", 'lower="-inf" upper="inf"', np.pi),
    ):
        model = read(tmp_path, arm(kind=kind, limits=limits))
        assert (model.lower[-1], model.upper[-1]) == (-end, end)


def test_refusals_of_urdf_name_link_or_joint(tmp_path):
    for text, named in (
        (arm(limits='lower="1" upper="-1"'), "joint 'elbow': lower limit 1"),
        (arm().replace('velocity="1"', 'velocity="-1"'), "joint 'elbow': velocity"),
        (arm(a=visual('<sphere radius="-1"/>')), "link 'a': radius of its sphere is '-1'"),
        (arm(a=visual('<box size="1 1"/>')), "link 'a': size of its box is '1 1'"),
        (arm(a=visual('<cylinder radius="0" length="1"/>')), "link 'a': radius"),
        (arm(a=visual('<drake:ellipsoid a="0" b="1" c="1"/>')), "link 'a': a of its ellipsoid"),
        (arm(a=visual('<cone radius="1"/>')), "link 'a': there is no shape <cone>"),
        (arm(a=visual("")), "link 'a': a <visual> without a shape"),
        (arm(a=visual("<mesh/>")), "link 'a': a mesh without a filename"),
        (arm(a=visual('<mesh filename="gone.obj"/>')), "link 'a': mesh 'gone.obj'"),
        (arm(a=visual('<mesh filename="thing.urdf" scale="0 1 1"/>')), "link 'a': scale"),
        (arm(axis="0 x 0"), "joint 'elbow': xyz of <axis> is '0 x 0'"),
        (arm(axis="0 0 0"), "'elbow' axis is zero"),
        (arm(origin='xyz="0 0"'), "joint 'elbow': xyz of <origin> is '0 0'"),
        (arm(kind="weird"), "'elbow' has unrecognized type: 'weird'"),
        (arm().replace('child link="b"', 'child link="z"'), "joint 'elbow': its child link 'z'"),
        (arm(more=link("a")), "link 'a' is defined 2 times"),
        (arm(more=joint("elbow", "fixed", "b", "world")), "joint 'elbow' is defined 2 times"),
        (arm().replace(' name="elbow"', ""), "1 <joint> without a name"),
        ("<sdf/>", "its outermost element is <sdf>"),
    ):
        assert named in refusal(tmp_path, text)


OWN = "<mesh><uri>thing.sdf</uri>{}</mesh>"


def test_refusals_of_sdf_name_link_or_joint(tmp_path):
    elbow, crossed = sdf.joint("e", "a", "b"), sdf.LIMITS.replace("-1", "2")
    for parts, named in (
        (link_of("a", "<sphere><radius>-1</radius></sphere>"), "link 'a': radius of its sphere"),
        (link_of("a", "<cone><radius>1</radius></cone>"), "link 'a': there is no shape <cone>"),
        (link_of("a", "<mesh><uri>gone.stl</uri></mesh>"), "link 'a': mesh 'gone.stl'"),
        (link_of("a", "<mesh/>"), "link 'a': a mesh without a <uri>"),
        (link_of("a", OWN.format("<submesh/>")), "link 'a': Drake shows the whole mesh"),
        (link_of("a", OWN.format("<scale>1 0 1</scale>")), "link 'a': scale of mesh"),
        (link_of("a", more="<pose>0 0 x 0 0 0</pose>"), "link 'a': its <pose> is '0 0 x"),
        (link_of("ab") + sdf.joint("e", "a", "b", crossed), "joint 'e': lower limit 2"),
        (link_of("ab") + elbow.replace("0 0 1", "0 0 0"), "joint 'e': its axis is zero"),
        (link_of("a") + elbow, "specified by joint with name[e] not found"),
        (link_of("aa"), "Non-unique name[a]"),
        (sdf.link("${prefix}a"), "${prefix}a"),
        ("<include><uri>model://nowhere</uri></include>", "--package nowhere=FOLDER"),
        ("<include/>", "an <include> without a <uri>"),
    ):
        assert named in refusal(tmp_path, sdf.sdf(parts), "thing.sdf")
    old = sdf.sdf(link_of("a")).replace(' version="1.9"', "")
    for text, named in ((old, "<sdf> has no version"), ("<robot/>", "element is <robot>")):
        assert named in refusal(tmp_path, text, "thing.sdf")


def test_included_models_are_sanitised(tmp_path):
    trimesh.creation.box().export(tmp_path / "c.stl")
    arm = urdf(link("upper", BOX + STL.format("c.stl")))
    write(tmp_path, arm, "arm.urdf")
    folder = tmp_path / "my_box"
    folder.mkdir()
    write(folder, sdf.sdf(sdf.link("old"), name="box"), "old.sdf")
    write(folder, sdf.sdf(sdf.link("new", more=sdf.collision("../c.stl")), name="box"), "new.sdf")
    config = '<model><sdf version="1.10">new.sdf</sdf><sdf version="1.9">old.sdf</sdf></model>'
    write(folder, config, "model.config")
    text = sdf.sdf(
        sdf.link("a"),
        "<include><uri>arm.urdf</uri><name>first</name><pose>1 0 0 0 0 0</pose></include>",
        "<include><uri>model://my_box</uri><name>second</name></include>",
    )
    model = load_model(write(tmp_path, text, "thing.sdf"), check=False)
    assert set(model.link_names[1:]) == {"a", "upper", "new"}
    X_WB = link_poses(model, model.default_positions)["upper"]
    np.testing.assert_allclose(X_WB[:3, 3], [1.0, 0.0, 0.0], atol=1e-12)


def directives(*lines):
    return "directives:\n" + "\n".join(lines) + "\n"


def test_models_of_directives_are_sanitised(tmp_path):
    trimesh.creation.box().export(tmp_path / "c.stl")
    write(tmp_path, WELDED_URDF.replace("</link>", STL.format("c.stl") + "</link>"), "arm.urdf")
    write(tmp_path, "\n" + MJCF, "joints.xml")
    write(tmp_path, sdf.sdf(sdf.link("box", more=sdf.collision("c.stl"))), "box.sdf")
    inner = directives("- add_model: {name: man, file: 'package://mine/joints.xml'}")
    write(tmp_path, inner, "inner.dmd.yaml")
    text = directives(
        "- add_model: &arm {name: left, file: package://mine/arm.urdf}",
        "- add_model: {<<: *arm, name: right}",
        "- add_model: {name: crate, file: box.sdf}",
        "- add_weld:",
        "    parent: world",
        "    child: crate::box",
        "    X_PC: {rotation: !Rpy {deg: [0, 0, 90]}}",
        "- add_directives: {file: package://mine/inner.dmd.yaml}",
    )
    path = write(tmp_path, text, "all.dmd.yaml")
    model = load_model(path, package_paths={"mine": tmp_path}, check=False)
    alone = load_model(tmp_path / "joints.xml", check=False)
    assert {"left::upper", "right::upper", "box", "hand"} <= set(model.link_names)
    assert {"left_a1", "left_a2", "right_a1", "right_a2"} <= set(model.position_names)
    assert len(model.add_to(MultibodyPlant(0.0))) == 4
    # The included MJCF and the weld are placed as they are alone.
    q = np.random.default_rng(5).uniform(alone.lower, alone.upper)
    plant, expected = model.plant, link_poses(alone, q)
    context, instance = plant.CreateDefaultContext(), plant.GetModelInstanceByName("man")
    plant.SetPositions(context, instance, q)
    for name in ("base", "arm", "hand"):
        X_WB = plant.GetBodyByName(name, instance).EvalPoseInWorld(context)
        np.testing.assert_allclose(X_WB.GetAsMatrix4(), expected[name], atol=1e-12)
    crate = plant.GetBodyByName("box").EvalPoseInWorld(context).rotation().matrix()
    np.testing.assert_allclose(crate[:, 0], [0.0, 1.0, 0.0], atol=1e-12)


def test_refusals_of_directives_name_the_file(tmp_path):
    for text, named in (
        (directives("- add_model: {name: a, file: package://drake_models/a.urdf}"), "--package"),
        (directives("- add_model: {name: a, file: gone.urdf}"), "add_model 'gone.urdf'"),
        (directives("- add_directives: {file: all.dmd.yaml}"), "includes itself"),
        (directives("- add_model: {name: a, file: bad.urdf}"), "link 'a': radius of its sphere"),
        (directives("- bogus: {}"), "bogus"),
        ("", "it is empty"),
        ("a: [", "it is not YAML"),
    ):
        sphere = '<visual><geometry><sphere radius="-1"/></geometry></visual>'
        write(tmp_path, urdf(link("a", sphere)), "bad.urdf")
        path = write(tmp_path, text, "all.dmd.yaml")
        with pytest.raises(ModelError) as caught:
            load_model(path, check=False)
        assert named in str(caught.value)
        assert ("bad.urdf" if "bad.urdf" in text else "all.dmd.yaml") in str(caught.value)


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
MJCF = f'<mujoco model="m">{CLASSES}<worldbody>{SLIDES}</worldbody></mujoco>'


def file_of(folder, body=TWO_JOINTS, more="", attributes='model="m"'):
    text = f"<mujoco {attributes}>{more}<worldbody>{body}</worldbody></mujoco>"
    return write(folder, text, "m.xml")


def assert_as_mujoco(path, model):
    """Compare link poses at random positions, and limits, with MuJoCo's."""
    theirs = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(theirs)
    random = np.random.default_rng(11)
    for _ in range(5):
        q = {}
        for k in range(theirs.njnt):
            name, place = theirs.joint(k).name, theirs.jnt_qposadr[k]
            data.qpos[place] = q[name] = random.uniform(-1.0, 1.0)
            if theirs.jnt_limited[k]:
                own = model.position_index(name)
                limits = (model.lower[own], model.upper[own])
                np.testing.assert_allclose(limits, theirs.jnt_range[k], atol=1e-9)
        mujoco.mj_kinematics(theirs, data)
        ours = link_poses(model, np.array([q.get(name, 0.0) for name in model.position_names]))
        for body in range(1, theirs.nbody):
            X = ours[theirs.body(body).name]
            np.testing.assert_allclose(X[:3, 3], data.xpos[body], atol=1e-9)
            np.testing.assert_allclose(X[:3, :3], data.xmat[body].reshape(3, 3), atol=1e-9)


def test_body_poses_match_mujoco(tmp_path):
    for more, body in (
        (CLASSES, SLIDES),
        ('<compiler eulerseq="zYx"/>', FRAMES),
        ('<compiler eulerseq="XyZ"/><compiler autolimits="true"/>', REFERENCES),
        ("", TWO_JOINTS),
    ):
        path = file_of(tmp_path, body, more)
        assert_as_mujoco(path, load_model(path, check=False))


def test_joints_are_searched_about_their_reference(tmp_path):
    model = load_model(file_of(tmp_path, REFERENCES), check=False)
    np.testing.assert_allclose(model.lower, (-np.pi / 3, -1.0, np.radians(-200)), atol=1e-12)


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
        ('<body name="b"><freejoint/><joint name="j"/>' + GEOM, "body 'b'"),
        ('<flexcomp name="c" type="grid" count="2 2 2" spacing="1 1 1" dim="3"/>', "<flex> 'c'"),
        ('<body name="a" pos="1 2">' + GEOM, "'pos'.*line 1"),
        ('<attach model="s" prefix="left_"/>', "model 's'"),
    ):
        whole = text.startswith("<robot")
        path = write(tmp_path, text, "m.xml") if whole else file_of(tmp_path, text)
        with pytest.raises(ModelError, match=rf"(?s)m\.xml.*{message}"):
            load_model(path, check=False)
