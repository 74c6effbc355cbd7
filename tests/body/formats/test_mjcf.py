"""MJCF as MuJoCo reads it: poses of links and what is drawn, against MuJoCo where it is installed.

Cases that are held against MuJoCo also name one place computed by hand.
"""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import trimesh
from pydrake.geometry import Role
from pydrake.multibody.plant import MultibodyPlant
from scipy.spatial.transform import Rotation

from drake_pose.body.model import load_model
from drake_pose.errors import ModelError
from tests.body.models import cube_obj, write

MJCF = """<mujoco model="m"><compiler angle="degree"/>
<default><joint limited="true" range="-60 60"/><geom type="capsule" size="0.05 0.1"/>
<default class="arm"><joint axis="0 1 0" pos="0.02 0.01 0.03"/></default></default>
<worldbody><geom type="plane" size="1 1 1"/>
<body name="base" pos="0.1 0.2 1" quat="0.8 0.2 0.4 0.4"><geom/>
 <joint name="rx" axis="1 0 0" pos="0 0 0.1"/><joint name="ry" axis="0 1 0"/>
 <joint name="s" type="slide" axis="0 0 1" range="-0.1 0.2"/>
 <body name="arm" pos="0.3 0 0" quat="0.9 0 0.3 0.1" childclass="arm">
  <joint name="a1"/><joint name="a2" axis="1 1 0"/><geom/>
  <body name="hand" pos="0 0 0.3"><joint name="h1"/><joint name="h2" axis="0 0 1"/><geom/></body>
 </body></body></worldbody></mujoco>"""


def transform(rotation: Rotation, position: np.ndarray) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = rotation.as_matrix(), position
    return X


def mujoco_poses(text: str, q: dict[str, float]) -> dict[str, np.ndarray]:
    """Forward kinematics by MuJoCo's rules, for hinge and slide joints and quaternions.

    A body's joints act one after the other, each in the frame that the ones before it left; a
    hinge turns the body about the point ``pos`` of that frame.
    """
    poses: dict[str, np.ndarray] = {}
    defaults = {"": ("0 0 1", "0 0 0"), "arm": ("0 1 0", "0.02 0.01 0.03")}

    def numbers(text: str) -> np.ndarray:
        return np.array([float(word) for word in text.split()])

    def visit(body: ElementTree.Element, X_WP: np.ndarray, class_name: str) -> None:
        class_name = body.get("childclass", class_name)
        w, x, y, z = numbers(body.get("quat", "1 0 0 0"))
        X = X_WP @ transform(Rotation.from_quat([x, y, z, w]), numbers(body.get("pos", "0 0 0")))
        for joint in body.findall("joint"):
            axis = numbers(joint.get("axis", defaults[class_name][0]))
            anchor = numbers(joint.get("pos", defaults[class_name][1]))
            axis, value = axis / np.linalg.norm(axis), q[joint.get("name", "")]
            if joint.get("type") == "slide":
                X = X @ transform(Rotation.identity(), axis * value)
            else:
                turn = Rotation.from_rotvec(axis * value)
                X = X @ transform(turn, anchor - turn.apply(anchor))
        poses[body.get("name", "")] = X
        for child in body.findall("body"):
            visit(child, X, class_name)

    for body in ElementTree.fromstring(text).find("worldbody").findall("body"):
        visit(body, np.eye(4), "")
    return poses


def test_bodies_with_several_joints_move_as_in_mujoco(tmp_path):
    model = load_model(write(tmp_path, MJCF, "m.xml"), check=False)
    assert model.position_names == ("rx", "ry", "s", "a1", "a2", "h1", "h2")
    tree = model.pose_tree()
    assert [node.name for node in tree.nodes] == ["base", "arm", "hand"]
    random = np.random.default_rng(3)
    for _ in range(20):
        q = random.uniform(model.lower, model.upper)
        expected = mujoco_poses(MJCF, dict(zip(model.position_names, q, strict=True)))
        X_WN = tree.node_poses(tree.values_from_positions(q))
        for node, X in zip(tree.nodes, X_WN, strict=True):
            np.testing.assert_allclose(X, expected[node.name], atol=1e-12)


def test_classes_inherit_geometry_and_planes_are_no_part_of_the_object(tmp_path):
    model = load_model(write(tmp_path, MJCF, "m.xml"), check=False)
    assert set(model.link_meshes) == {"base", "arm", "hand"}
    sizes = {name: np.ptp(mesh.vertices[:, 2]) for name, mesh in model.link_meshes.items()}
    np.testing.assert_allclose(list(sizes.values()), 0.3, atol=1e-9)


def test_includes_and_meshes_are_found_from_the_main_file(tmp_path):
    (tmp_path / "assets").mkdir()
    (tmp_path / "parts").mkdir()
    (tmp_path / "assets" / "cube.obj").write_text(cube_obj(normals=True))
    trimesh.creation.icosahedron().export(tmp_path / "assets" / "ball.stl")
    asset = '<mujoco><asset><mesh file="cube.obj" scale="0.1 0.1 0.1"/><mesh file="ball.stl"/>'
    write(tmp_path / "parts", asset + "</asset></mujoco>", "asset.xml")
    main = """<mujoco model="m"><compiler meshdir="assets"/><include file="parts/asset.xml"/>
    <worldbody><body name="b"><joint name="j1" range="-1 1"/><joint name="j2" axis="1 0 0"
    range="-1 1"/><geom type="mesh" mesh="cube"/><geom type="mesh" mesh="ball"/></body></worldbody>
    </mujoco>"""
    model = load_model(write(tmp_path, main, "m.xml"), check=False)
    mesh = model.link_meshes["b"]
    assert len(mesh.triangles) == 12 + 20
    assert len(mesh.vertices) == 8 + 12


def test_a_body_without_mass_is_read(tmp_path):
    inertial = '<inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/>'
    body = f'<body name="b">{inertial}<joint name="j" range="-1 1"/><geom size="0.1"/></body>'
    model = load_model(file_of(tmp_path, body), check=False)
    assert set(model.link_meshes) == {"b"}


# Two joints a body: what Drake gets wrong, where the file reaches it as it is.
TWO_JOINTS = """<body name="a" pos="0 0 0.1"><joint name="x" axis="1 0 0" range="-90 90"/>
<joint name="y" axis="0 1 0" pos="0 0 0.1" range="-90 90"/><geom size="0.05"/>
<body name="b" pos="0 0 0.2"><joint name="z" range="-9 9"/><geom size="0.04"/></body></body>"""
HALF_ROOT = np.sqrt(0.5)


def file_of(folder, body=TWO_JOINTS, more="", attributes='model="m"'):
    text = f"<mujoco {attributes}>{more}<worldbody>{body}</worldbody></mujoco>"
    return write(folder, text, "m.xml")


def body_places(model, q):
    """Position and rotation of every body, by name, at positions given by name."""
    plant: MultibodyPlant = model.plant
    context = plant.CreateDefaultContext()
    positions = np.array([q.get(name, 0.0) for name in model.position_names])
    plant.SetPositions(context, positions)
    poses = {}
    for name in model.link_names[1:]:
        X = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(name))
        poses[name] = (X.translation(), X.rotation().matrix())
    return poses


def assert_as_mujoco(path, model):
    """Link poses at random positions within 1e-9 of MuJoCo's; nothing where it is not installed."""
    try:
        import mujoco
    except ModuleNotFoundError:
        return
    theirs = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(theirs)
    random = np.random.default_rng(11)
    for _ in range(5):
        q = {}
        for joint in range(theirs.njnt):
            index = theirs.jnt_qposadr[joint]
            data.qpos[index] = random.uniform(-1.0, 1.0)
            q[theirs.joint(joint).name] = data.qpos[index]
        mujoco.mj_kinematics(theirs, data)
        ours = body_places(model, q)
        for body in range(1, theirs.nbody):
            position, rotation = ours[theirs.body(body).name]
            np.testing.assert_allclose(position, data.xpos[body], atol=1e-9)
            np.testing.assert_allclose(rotation, data.xmat[body].reshape(3, 3), atol=1e-9)


# What a strict reader refuses in a file, or reads otherwise.
SPOILT = {
    "newline": lambda text: ("\n \n<?xml version='1.0'?>" + text).encode(),
    "comment": lambda text: text.replace("<worldbody>", "<worldbody><!-- a -- b --->").encode(),
    "latin1": lambda text: text.replace('"m"', '"m\xe9"').encode("latin-1"),
    "prefix": lambda text: text.replace("model=", 'xsi:schema="s" model=').encode(),
    "entity": lambda text: text.replace('"m"', '"m&nbsp;n & o"').encode(),
    "encoding": lambda text: ('<?xml version="1.0" encoding="nonsense"?>' + text).encode(),
    "bom": lambda text: ("\ufeff" + text).encode(),
    "utf16": lambda text: ('<?xml version="1.0" encoding="utf-16"?>' + text).encode("utf-16"),
    "xmlns": lambda text: text.replace("<mujoco ", '<mujoco xmlns="http://example.org" ').encode(),
    "nameless": lambda text: text.replace('model="m"', "").encode(),
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_what_a_strict_reader_refuses_is_cured_all_the_same(tmp_path, spoil):
    path = file_of(tmp_path)
    path.write_bytes(spoil(path.read_text()))
    model = load_model(path, check=False)
    assert model.position_names == ("x", "y", "z")
    # x lays the body down along -y about its origin at (0, 0, 0.1); b is 0.2 above that origin.
    p_b, _ = body_places(model, {"x": np.pi / 2})["b"]
    np.testing.assert_allclose(p_b, (0.0, -0.2, 0.1), atol=1e-12)
    # y turns about a point 0.1 above a's origin: b stands 0.1 beside that point.
    p_b, _ = body_places(model, {"y": np.pi / 2})["b"]
    np.testing.assert_allclose(p_b, (0.1, 0.0, 0.2), atol=1e-12)
    if b"u\x00" not in path.read_bytes():  # MuJoCo reads no UTF-16.
        assert_as_mujoco(path, model)


def test_a_model_without_a_name_takes_its_files(tmp_path):
    assert load_model(file_of(tmp_path, attributes=""), check=False).name == "m"


def test_bodies_and_joints_need_no_names(tmp_path):
    body = """<body name="body1"><geom size="0.1"/><body pos="0 0 1"><joint name="" range="-9 9"/>
    <joint name="q" axis="1 0 0" range="-90 90"/><geom size="0.1"/><body name="" pos="0 0 1">
    <geom size="0.1"/></body></body></body>"""
    model = load_model(file_of(tmp_path, body), check=False)
    places = body_places(model, {"q": np.pi / 2})
    assert set(model.link_meshes) == {"body1", "body2", "body3"}
    np.testing.assert_allclose(places["body3"][0], (0.0, -1.0, 1.0), atol=1e-12)


@pytest.mark.parametrize("root", ["robot", "sdf", "something"])
def test_another_kind_of_file_is_named(tmp_path, root):
    path = write(tmp_path, f'<{root} name="r"><link name="a"/></{root}>', "m.xml")
    with pytest.raises(ModelError, match=rf"m\.xml: the outermost element is <{root}>"):
        load_model(path, check=False)


def test_frames_move_and_class_what_is_in_them(tmp_path):
    more = """<compiler angle="degree" eulerseq="zYx"/><default><default class="k">
    <joint axis="0 1 0" pos="0 0 0.1"/></default></default>"""
    body = """<frame pos="1 0 0" euler="90 0 0"><body name="a" pos="0 1 0"><geom size="0.1"/>
    <frame pos="0 0 1" zaxis="0 0 -1" childclass="k"><joint name="j" range="-9 9"/>
    <geom type="box" size="0.1" fromto="0 0 0 0 0 1"/>
    <frame axisangle="0 2 0 30"><body name="b" pos="0 0 1" xyaxes="0 3 0 -1 1 0"><geom size="0.1"/>
    <joint name="k" range="-9 9" pos="0 0 0" axis="1 2 3"/></body></frame></frame></body></frame>"""
    path = file_of(tmp_path, body, more)
    model = load_model(path, check=False)
    p_a, R_a = body_places(model, {})["a"]
    np.testing.assert_allclose(p_a, (0.0, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(R_a, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    # The box runs down from (0, 0, 1) in a, since the frame in a stands on its head.
    assert np.max(model.link_meshes["a"].vertices[:, 2]) == pytest.approx(1.0)
    assert_as_mujoco(path, model)


def test_orientations_and_references_of_joints(tmp_path):
    body = """<body name="a" zaxis="0 0 -1"><joint name="r" ref="30" range="-60 60"/>
    <geom size="0.1"/><body name="b" pos="0 0 1" euler="10 20 30"><joint name="s" type="slide"
    ref="0.3" range="-1 1" axis="0 2 0"/><joint name="t" ref="-20" axis="1 1 0" range="5 -5"/>
    <geom size="0.1"/></body></body>"""
    path = file_of(tmp_path, body, '<compiler eulerseq="XyZ"/><compiler autolimits="true"/>')
    model = load_model(path, check=False)
    # The file shows the arm at its references: there, a stands as it is written.
    _, R_a = body_places(model, {"r": np.pi / 6})["a"]
    np.testing.assert_allclose(R_a, np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    np.testing.assert_allclose(model.lower, (-np.pi / 3, -1.0, np.radians(-200)), atol=1e-12)
    assert_as_mujoco(path, model)


def test_geoms_that_are_not_drawn_or_that_collide_do_not_matter(tmp_path):
    plate = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    plate.export(tmp_path / "plate.stl")
    more = """<asset><mesh file="plate.stl"/><mesh name="missing" file="no.stl"/>
    <material name="glass" rgba="1 1 1 0"/></asset><default><geom size="0.1 0.1 0.1" type="box"/>
    <default class="collision"><geom group="3"/></default>
    <default class="visual"><geom group="1" contype="0" conaffinity="0"/></default></default>
    <contact><pair geom1="g" geom2="g"/><exclude body1="world" body2="a"/></contact>
    <actuator><motor joint="free"/><motor joint="j"/></actuator>"""
    body = """<body name="a" childclass="visual"><inertial pos="0 0 0" mass="1"
    diaginertia="1 1 1"/><freejoint name="free"/><geom size="0.2" name="geom1"/>
    <geom type="mesh" mesh="plate" class="collision"/><geom class="main" type="mesh" mesh="plate"/>
    <geom type="mesh" mesh="missing" class="collision"/><geom size="5" material="glass"/>
    <geom size="6" rgba="1 0 0 0"/><body name="b"><joint name="j" range="-9 9"/>
    <geom class="collision" name="g"/></body></body>"""
    model = load_model(file_of(tmp_path, body, more), check=True)
    assert set(model.link_meshes) == {"a"}
    # A box whose class says the sizes that it does not, and the plate.
    mesh = model.link_meshes["a"]
    assert len(mesh.triangles) == 12 + 1
    np.testing.assert_allclose(np.max(mesh.vertices, axis=0), (1.0, 1.0, 0.1))
    np.testing.assert_allclose(np.min(mesh.vertices, axis=0), (-0.2, -0.1, -0.1))
    assert model.scene_graph.model_inspector().NumGeometriesWithRole(Role.kProximity) == 0
    # A body without <inertial> keeps the mass of the geom that is not drawn.
    assert model.plant.GetBodyByName("b").default_mass() == pytest.approx(8.0)


@pytest.mark.parametrize(
    ("asset", "corner"),
    [
        ('file="t.stl" scale="2 1 1"', (2.0, 2.0, 3.0)),
        # First to the reference pose, then to scale: (0, 2, 0) - (1, 0, 0), a quarter back, twice.
        (
            f'file="t.stl" refpos="1 0 0" refquat="{HALF_ROOT} 0 0 {HALF_ROOT}" scale="2 1 1"',
            (4.0, 1.0, 3.0),
        ),
        ('vertex="0 0 0  1 0 0  0 2 0  0 0 3  0.1 0.1 0.1"', (1.0, 2.0, 3.0)),
        ('vertex="0 0 0 1 0 0 0 2 0 0 0 3" face="0 2 1 0 1 3 1 2 3 0 3 2"', (1.0, 2.0, 3.0)),
    ],
    ids=["scale", "reference", "hull", "faces"],
)
def test_meshes_are_placed_as_in_mujoco(tmp_path, asset, corner):
    corners = [[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    trimesh.Trimesh(corners, faces, process=False).export(tmp_path / "t.stl")
    path = file_of(
        tmp_path,
        '<body name="a"><geom type="mesh" mesh="t"/></body>',
        f'<asset><mesh name="t" {asset}/></asset>',
    )
    mesh = load_model(path, check=False).link_meshes["a"]
    assert len(mesh.triangles) == 4
    np.testing.assert_allclose(np.max(mesh.vertices, axis=0), corner, atol=1e-6)
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    theirs = mujoco.MjModel.from_xml_path(str(path))
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, theirs.geom_quat[0])
    used = theirs.mesh_vert[np.unique(theirs.mesh_face)]
    vertices = used @ R.reshape(3, 3).T + theirs.geom_pos[0]
    np.testing.assert_allclose(np.max(mesh.vertices, axis=0), np.max(vertices, axis=0), atol=1e-6)
    np.testing.assert_allclose(np.min(mesh.vertices, axis=0), np.min(vertices, axis=0), atol=1e-6)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<replicate count="2"><body name="b"><geom size="1"/></body></replicate>', "<replicate>"),
        (
            '<body name="b"><freejoint/><joint name="j"/><geom size="1"/></body>',
            "body 'b' has a free joint",
        ),
        ('<frame name="f"><flexcomp name="c" type="grid"/></frame>', "<flexcomp> 'c'"),
        ('<include file="m.xml"/>', "never ends"),
        ("<body>", r"m\.xml"),
    ],
)
def test_what_cannot_be_cured_is_refused(tmp_path, body, message):
    with pytest.raises(ModelError, match=message):
        load_model(file_of(tmp_path, body), check=False)


@pytest.mark.parametrize(
    ("more", "body", "message"),
    [
        ("", '<body name="a"><geom class="k" size="1"/></body>', "class 'k'"),
        ("", '<body name="a" pos="1 2"><geom size="1"/></body>', "'a': pos is '1 2'; expected 3"),
        ("", '<body name="a"><joint name="j" axis="0 0 0"/><geom size="1"/></body>', "joint 'j'"),
        (
            "",
            '<body name="a" euler="0 0 1" quat="1 0 0 0"><geom size="1"/></body>',
            "several orientations",
        ),
        (
            '<compiler autolimits="false"/><compiler angle="radian"/>',
            '<body name="a"><joint name="j" range="0 1"/><geom size="1"/></body>',
            "joint 'j' has a range",
        ),
        (
            '<asset><mesh name="t" file="no.stl"/></asset>',
            '<body name="a"><geom type="mesh" mesh="t"/></body>',
            r"body 'a', mesh 't': .*no\.stl",
        ),
        ("", '<attach model="s" prefix="left_"/>', "<attach> 'left_'"),
    ],
)
def test_what_mujoco_refuses_or_drake_ignores_is_named(tmp_path, more, body, message):
    with pytest.raises(ModelError, match=message):
        load_model(file_of(tmp_path, body, more), check=False)
