"""Tables of joint positions: units, limits, names of frames."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import SceneError
from drake_pose.jobs.estimate.measurements import read_measured_positions
from drake_pose.jobs.registration.positions import KnownPositions, put_on_base, read_known_positions
from drake_pose.registration.hand_eye import motion
from tests.body.models import joint, link, urdf, write

URDF = """<robot name="slide"><link name="world"/>
  <link name="cart"><visual><geometry><box size="0.2 0.1 0.1"/></geometry></visual></link>
  <link name="arm"><visual><geometry><box size="0.1 0.1 0.4"/></geometry></visual></link>
  <joint name="rail" type="prismatic"><parent link="world"/><child link="cart"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.8" effort="1" velocity="1"/></joint>
  <joint name="swing" type="revolute"><parent link="cart"/><child link="arm"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
</robot>"""


def read(folder: Path, text: str, held: dict[str, float] | None = None) -> KnownPositions:
    (folder / "slide.urdf").write_text(URDF)
    (folder / "joints.csv").write_text(text)
    model = load_model(folder / "slide.urdf")
    kinematics = TreeKinematics(model.pose_tree(held=held))
    return read_known_positions(folder / "joints.csv", kinematics)


def test_held_joints_need_no_column(tmp_path: Path) -> None:
    found = read(tmp_path, "frame,swing\n0,0.5\n1,-1\n", {"rail": 0.3})
    assert found.of("0", "left").tolist() == [0.3, 0.5]
    assert found.of("1", "left").tolist() == [0.3, -1.0]
    for text, held, message in (
        ("frame,swing,rail\n0,0.5,0.2\n", {"rail": 0.3}, "'rail' is a position that is held"),
        ("frame,swing\n0,0.5\n", {}, "no column for joint rail of slide.urdf.*--hold rail=VALUE"),
        ("frame,swing,rail\n0,0.5,0\n0,0.5,0\n", {}, "has frame 0 more than once"),
    ):
        with pytest.raises(SceneError, match=message):
            read(tmp_path, text, held)


def test_columns_are_sorted_into_the_tree_s_order(tmp_path: Path) -> None:
    found = read(tmp_path, "frame,swing,rail\n7,-0.5,0.25\nstart,1.5,0.75\n3.0,0,0\n")
    assert found.warnings == ()
    assert found.of("0007", "left").tolist() == [0.25, -0.5]
    assert found.of("start", "left").tolist() == [0.75, 1.5]
    assert found.of("3", "left").tolist() == [0.0, 0.0]
    with pytest.raises(SceneError, match=r"joints\.csv: has no row of frame '0008'.*'left'"):
        found.of("0008", "left")


@pytest.mark.parametrize(
    ("columns", "rows", "told"),
    [
        ("lead,other", [[0.4, -0.8], [0.1, -0.2]], ""),
        ("lead,other", [[0.4, 0.8], [0.1, -0.2]], "'other' .* differ .* by up to 1.6"),
        ("third", [[0.35], [0.05]], "'lead' is not logged: it follows from 'third'"),
    ],
)
def test_leaders_and_followers_are_compared(tmp_path, columns, rows, told):
    """third follows other: third = -0.5 other - 0.05 = lead - 0.05."""
    joints = [
        joint("third", "revolute", "world", "three",
              more='<mimic joint="other" multiplier="-0.5" offset="-0.05"/>'),
        joint("other", "revolute", "world", "two", more='<mimic joint="lead" multiplier="-2"/>'),
        joint("lead", "revolute", "world", "one"),
    ]  # fmt: skip
    path = write(tmp_path, urdf(link("world", ""), *map(link, ("one", "two", "three")), *joints))
    lines = [f"{k},{','.join(map(str, row))}" for k, row in enumerate(rows)]
    (tmp_path / "joints.csv").write_text("\n".join([f"frame,{columns}", *lines]))
    kinematics = TreeKinematics(load_model(path).pose_tree())
    found = read_known_positions(tmp_path / "joints.csv", kinematics)
    np.testing.assert_allclose(np.ravel([*found.values.values()]), [0.4, 0.1])
    assert bool(found.warnings) == bool(told)
    assert re.search(told, " ".join(found.warnings))


def test_moving_base_becomes_joints(tmp_path: Path) -> None:
    assert not read(tmp_path, "frame,rail,swing\n0,0.1,0.5\n").is_estimate
    model, rng = load_model(tmp_path / "slide.urdf"), np.random.default_rng(3)
    lines, bases = ["frame,rail,swing,base_x,base_y,base_z,base_qw,base_qx,base_qy,base_qz"], []
    for k in range(3):
        bases.append(motion(rng.normal(0.0, 1.0, 6)))
        turn = Rotation.from_matrix(bases[k][:3, :3])
        cells = [k, 0.1 * k, 0.5 - k, *bases[k][:3, 3], *turn.as_quat(scalar_first=True)]
        lines.append(",".join(map(str, cells)))
    lines.append("3" + 9 * ",nan")
    ends = ["error,seconds", *["0.1,1"] * 3, "nan,3"]
    text = "\n".join(f"{line},{end}" for line, end in zip(lines, ends, strict=True))
    (tmp_path / "poses.csv").write_text(text)
    table = read_measured_positions(tmp_path / "poses.csv", model)
    moved, table = put_on_base(model, table)
    kinematics = TreeKinematics(moved.pose_tree())
    found = read_known_positions(tmp_path / "poses.csv", kinematics, table=table)
    assert found.is_estimate
    assert [found.has(frame) for frame in ("0", "2", "3")] == [True, True, False]
    context = model.plant.CreateDefaultContext()
    for k, X_WB in enumerate(bases):
        model.plant.SetPositions(context, [0.1 * k, 0.5 - k])
        X_WN = kinematics.poses(found.of(str(k), "left"))
        for node, X in zip(kinematics.tree.nodes, X_WN, strict=True):
            body = model.plant.GetBodyByName(node.name)
            X_BN = model.plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4()
            np.testing.assert_allclose(X, X_WB @ X_BN, atol=1e-9)


def test_equal_poses_are_recognised(tmp_path: Path) -> None:
    found = read(tmp_path, "frame,swing,rail\n0,0.5,0.1\n")
    rows = np.array([[0.1, 0.5], [0.102, 0.505]])
    assert found.are_one_pose(rows)
    assert not found.are_one_pose([*rows, [0.0, 0.0], [0.0, 0.1]])
    assert not found.are_one_pose([*rows, [0.0, 0.0], [0.01, 0.0]])
    apart = [[0.1, 0.5], [0.108, 0.52]]
    assert not found.are_one_pose(apart)
    assert found.are_one_pose(apart, 5.0)
