"""Tables of joint positions: units, limits, names of frames."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import SceneError
from drake_pose.jobs.estimate.measurements import read_measured_positions
from drake_pose.jobs.registration.positions import (
    KnownPositions,
    put_on_base,
    read_known_positions,
)
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
    with pytest.raises(SceneError, match="column 'rail' is a position that is held"):
        read(tmp_path, "frame,swing,rail\n0,0.5,0.2\n", {"rail": 0.3})


def test_columns_are_sorted_into_the_tree_s_order(tmp_path: Path) -> None:
    found = read(tmp_path, "frame,swing,rail\n7,-0.5,0.25\nstart,1.5,0.75\n3.0,0,0\n")
    assert found.warnings == ()
    assert found.of("0007", "left").tolist() == [0.25, -0.5]
    assert found.of("start", "left").tolist() == [0.75, 1.5]
    assert found.of("3", "left").tolist() == [0.0, 0.0]
    with pytest.raises(SceneError, match=r"joints\.csv: has no row of frame '0008'.*'left'"):
        found.of("0008", "left")


def test_columns_of_followers_are_compared(tmp_path: Path) -> None:
    lead, mimic = joint("lead", "revolute", "world", "one"), '<mimic joint="lead" multiplier="-1"/>'
    other = joint("other", "revolute", "world", "two", more=mimic)
    path = write(tmp_path, urdf(link("world", ""), link("one"), link("two"), lead, other))
    kinematics = TreeKinematics(load_model(path).pose_tree())
    for value, count in (("-0.4", 0), ("0.4", 1)):
        (tmp_path / "joints.csv").write_text(f"frame,lead,other\n0,0,0\n1,0.4,{value}\n")
        found = read_known_positions(tmp_path / "joints.csv", kinematics)
        assert found.of("1", "left").tolist() == [0.4]
        assert sum("'other' differs by up to 0.8" in one for one in found.warnings) == count


def test_poses_of_an_estimate_are_read(tmp_path: Path) -> None:
    text = "frame,rail,swing,error,seconds\n0,0.1,0.5,0.02,1\n1,nan,nan,nan,3\n2,0.2,-1,0.03,1\n"
    found = read(tmp_path, text)
    assert found.is_estimate
    assert [found.has(frame) for frame in ("0", "1", "2")] == [True, False, True]
    assert found.of("2", "left").tolist() == [0.2, -1.0]
    assert not read(tmp_path, "frame,rail,swing\n0,0.1,0.5\n").is_estimate


def test_moving_base_becomes_joints(tmp_path: Path) -> None:
    read(tmp_path, "frame,rail,swing\n0,0.1,0.5\n")
    model, rng = load_model(tmp_path / "slide.urdf"), np.random.default_rng(3)
    lines, bases = ["frame,rail,swing,base_x,base_y,base_z,base_qw,base_qx,base_qy,base_qz"], []
    for k in range(3):
        bases.append(motion(rng.normal(0.0, 1.0, 6)))
        turn = Rotation.from_matrix(bases[k][:3, :3])
        cells = [k, 0.1 * k, 0.5 - k, *bases[k][:3, 3], *turn.as_quat(scalar_first=True)]
        lines.append(",".join(map(str, cells)))
    ends = ["error,seconds", *["0.1,1"] * 3]
    text = "\n".join(f"{line},{end}" for line, end in zip(lines, ends, strict=True))
    (tmp_path / "poses.csv").write_text(text)
    table = read_measured_positions(tmp_path / "poses.csv", model.position_names)
    moved, table = put_on_base(model, table)
    kinematics = TreeKinematics(moved.pose_tree())
    found = read_known_positions(table.path, kinematics, table=table)
    context = model.plant.CreateDefaultContext()
    for k, X_WB in enumerate(bases):
        model.plant.SetPositions(context, [0.1 * k, 0.5 - k])
        X_WN = kinematics.poses(found.of(str(k), "left"))
        for node, X in zip(kinematics.tree.nodes, X_WN, strict=True):
            body = model.plant.GetBodyByName(node.name)
            X_BN = model.plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4()
            np.testing.assert_allclose(X, X_WB @ X_BN, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,swing,rail\n0,2,0\n1,-70,0.5\n", "'swing', frame 1: -70 rad.* in degrees"),
        ("frame,swing,rail\n0,0.5,300\n1,1.5,700\n", "'rail', frame 1: 700 m.* in millimetres"),
        ("frame,swing\n0,0.5\n", "no column for joint rail of slide.urdf.*--hold rail=VALUE"),
        ("frame\n0\n", "first line must be frame"),
        ("frame,swing,swing\n0,0.5,0.5\n", "has the column 'swing' twice"),
        ("frame,swing,rail\n0,0.5,0\n0,0.5,0\n", "line 3: frame '0' is given twice"),
    ],
)
def test_bad_tables_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        read(tmp_path, text)


def test_positions_outside_their_limits_are_warned_of(tmp_path: Path) -> None:
    (text,) = read(tmp_path, "frame,swing,rail\n0,0.5,0.1\n4,2.6,0.5\n").warnings
    assert "column 'swing', frame 4: 2.6 rad lies outside the joint's limits, -2 to 2 rad" in text
    for value, turned in ((0.5 + 2.0 * np.pi, 0.5), (-1.9 - 2.0 * np.pi, -1.9)):
        (text,) = read(tmp_path, f"frame,swing,rail\n0,0.5,0.1\n4,{value},0.5\n").warnings
        assert f"a full turn off, {turned} rad, it would not" in text
    # Small encoder errors are accepted.
    assert read(tmp_path, "frame,swing,rail\n0,2.05,-0.01\n").warnings == ()


def test_equal_poses_are_recognised(tmp_path: Path) -> None:
    found = read(tmp_path, "frame,swing,rail\n0,0.5,0.1\n")
    rows = np.array([[0.1, 0.5], [0.102, 0.505]])
    assert found.are_one_pose(rows)
    assert not found.are_one_pose([*rows, [0.0, 0.0], [0.0, 0.1]])
    assert not found.are_one_pose([*rows, [0.0, 0.0], [0.01, 0.0]])
    apart = [[0.1, 0.5], [0.108, 0.52]]
    assert not found.are_one_pose(apart)
    assert found.are_one_pose(apart, 5.0)
