import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import trimesh
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
    text = f'<mujoco model="m"><worldbody>{body}</worldbody></mujoco>'
    with pytest.raises(ModelError, match=message):
        load_model(write(tmp_path, text, "m.xml"), check=False)


def test_a_body_without_mass_is_read(tmp_path):
    inertial = '<inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/>'
    body = f'<body name="b">{inertial}<joint name="j" range="-1 1"/><geom size="0.1"/></body>'
    text = f'<mujoco model="m"><worldbody>{body}</worldbody></mujoco>'
    model = load_model(write(tmp_path, text, "m.xml"), check=False)
    assert set(model.link_meshes) == {"b"}
