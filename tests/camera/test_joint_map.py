"""Joints and units of a joint log's columns; every assumption is reported."""

import math
from xml.etree import ElementTree

import numpy as np
import pytest

from drake_pose.camera.episode import JointLog
from drake_pose.camera.episode_files import open_episode
from drake_pose.camera.joint_map import (
    Column,
    follower_warnings,
    map_joints,
    match_names,
    read_joint_map,
    without_followers,
)
from drake_pose.errors import SceneError, SettingsError, UnknownNameError

LOW = np.array([-2.9, -1.8, -2.9, -3.1, -2.9, -0.1, -2.9])
HIGH = np.array([2.9, 1.8, 2.9, -0.1, 2.9, 3.8, 2.9])
ARM = {"names": tuple(f"panda_joint{k}" for k in range(1, 8)), "lower": LOW, "upper": HIGH}
POSES = np.array([[0.1, -0.5, 0.3, -2.4, 0.2, 2.0, 0.7], [0.2, -0.4, 0.1, -2.0, 0.1, 1.5, 0.9]])


def map_log(logged, readings, model, **more):
    readings = np.array(readings, dtype=float)
    log = JointLog(logged, 0.1 * np.arange(len(readings)), readings)
    is_angle = [not name.startswith("slide") for name in model["names"]]
    return map_joints(log, **model, is_angle=np.array(is_angle), **more)


@pytest.mark.parametrize(
    ("logged", "wanted", "found"),
    [
        ("b a", "a b", [1, 0]),
        ("Shoulder-Pan elbow.pos", "shoulder_pan elbow", [0, 1]),
        ("kLeftElbow kRightElbow", "right_elbow_joint left_elbow_joint", [1, 0]),
        ("joint1 joint2", "panda_joint1 panda_joint2", [0, 1]),
        ("panda_joint1 main_elbow", "elbow joint1", [1, 0]),
        # Ambiguous matches are refused, and only whole words match: bow is not elbow, 1 not 11.
        ("elbow", "left_elbow right_elbow", [None]),
        ("left_elbow right_elbow", "elbow", [None, None]),
        ("bow joint1", "elbow joint11", [None, None]),
        # Numbered names that start at another number are the model's joints in order.
        ("joint_0 joint_2 joint_1", "j1 j2 j3", [0, 2, 1]),
        ("joint_0 joint_1", "panda_joint1 panda_joint2", [0, 1]),
        # Beside joints without number, if the numbered ones are as many and begin alike.
        ("joint_0 joint_1", "panda_joint1 panda_joint2 finger", [0, 1]),
        ("joint_0 joint_1", "a1 a2 a3 finger", [None, None]),
        ("joint_0 joint_1", "left_1 right_1 finger", [None, None]),
        ("m0 m1 finger", "a1 a2 finger", [0, 1, 2]),
    ],
)
def test_names_are_matched(logged, wanted, found):
    names, joints = logged.split(), wanted.split()
    expected = {a: joints[k] for a, k in zip(names, found, strict=True) if k is not None}
    matched, warnings = match_names(names, joints)
    assert matched == expected
    if "0" in logged and expected:
        assert all(f"{a} for {b}" in warnings[0] for a, b in expected.items() if a != b)


def test_positions_have_the_models_order_and_missing_joints_are_reported():
    order = [6, 5, 3, 2, 1, 0]
    names = ("gripper", *(f"joint{k + 1}" for k in order))
    found = map_log(names, np.column_stack([[0.5, 0.6], POSES[:, order]]), ARM)
    expected = np.where(np.arange(7) == 4, np.nan, POSES)
    np.testing.assert_array_equal(found.log.positions, expected)
    np.testing.assert_allclose(found.log.at(np.array([0.05]))[0, 0], 0.15)
    assert found.not_logged == ("panda_joint5",)
    assert found.warnings[-2:] == (
        "joints that are not logged: panda_joint5; hold them (--hold) or map columns to them "
        "(joint map)",
        "columns of the joint log that are not joints: gripper",
    )
    with pytest.raises(SceneError, match=r"its columns are x, y, the joints panda_joint1,"):
        map_log(("x", "y"), np.zeros((2, 2)), ARM)


def test_units_are_given_or_inferred_from_the_limits():
    names, degrees = ARM["names"], np.rad2deg(POSES)
    wide = ARM | {"lower": np.full(7, -3.0), "upper": np.full(7, 3.0)}
    holes = np.where(np.eye(2, 7, dtype=bool), np.nan, POSES)
    swings = POSES * [[1.0], [0.5]]
    for readings, model, units, message in (
        (POSES, ARM, None, None),
        (holes, ARM, None, None),
        (degrees, ARM, None, "in deg: only as degrees"),
        (POSES, wide, None, "in rad: but as degrees they would be within"),
        # No robot is recorded that moves by 1.2 degrees.
        (swings, wide, None, None),
        (POSES, ARM, "rad", None),
        (degrees, ARM, "deg", None),
    ):
        found = map_log(names, readings, model, units=units)
        expected = POSES if readings is degrees else readings
        np.testing.assert_allclose(found.log.positions, expected, atol=1e-12)
        assert message in found.warnings[0] if message else found.warnings == ()
    # Readings 0.3 rad beyond a limit do not suffice to infer degrees.
    beyond = [[3.3, *np.zeros(6)]]
    with pytest.raises(
        SceneError, match=r"'panda_joint1' is 3\.3 to 3\.3.*and not clearly degrees"
    ):
        map_log(names, beyond, wide)
    warning = map_log(names, beyond, wide, units="rad").warnings[0]
    assert "joint 'panda_joint1': column 'panda_joint1' gives 3.3 in row 0" in warning
    # A single column in degrees is named, unless somebody says that all are.
    poses = np.random.default_rng(1).uniform(0.8 * LOW, 0.8 * HIGH, (9, 7))
    mixed = poses * np.where(np.arange(7) == 2, np.degrees(1.0), 1.0)
    with pytest.raises(
        SceneError, match=r"columns panda_joint3 are in degrees, but .*panda_joint4"
    ):
        map_log(names, mixed, ARM)
    by_map = {names[2]: Column(names[2], np.radians(1.0))}
    found = map_log(names, mixed, ARM, table=by_map).log.positions
    np.testing.assert_allclose(found, poses)
    with pytest.raises(
        SettingsError, match="units must be rad or deg or normalised or steps, not 'turns'"
    ):
        map_log(names, POSES, ARM, units="turns")


def test_normalised_readings_need_a_range():
    limits = {"lower": np.full(2, -1.92), "upper": np.full(2, 1.92)}
    model, names = {"names": ("pan", "lift"), **limits}, ("main_pan", "main_lift", "claw")
    # As degrees all would be within the limits of 110 degrees.
    for columns, readings in (
        (names, [[-99.5, 3.0, 1.0], [40.0, 9.0, 2.0]]),
        (names, [[-60.0, 3.0, 1.0], [40.0, 9.0, 100.0]]),
        (("pan.pos", "lift.pos"), [[-40.0, 3.0], [40.0, 9.5]]),
    ):
        with pytest.raises(SceneError, match=r"normalised.*give units.*from: \[-100, 100\]"):
            map_log(columns, readings, model)
    pan = Column("main_pan", 0.0192, 0.0, (-100.0, 100.0))
    table = {"pan": pan, "lift": Column("main_lift", 0.01)}
    found = map_log(names, [[-100.0, 3.0, 0], [50.0, 2.0, 0], [100.0, 0, 0]], model, table=table)
    np.testing.assert_allclose(found.log.positions[:, 0], [-1.92, 0.96, 1.92])
    np.testing.assert_array_equal(found.clipped, [[True, False], [False, False], [True, False]])
    beside = map_log(names[:2], [[-100.0, 1.0]], {**model, "names": ("pan", "main_lift")},
                    table={"pan": pan}).warnings[0]  # fmt: skip
    assert "to be in rad" in beside
    warnings = map_log(names, [[-101.0, 3.0, 0.0]], model, table=table).warnings[0]
    assert "joint 'pan': column 'main_pan' has 1 of 1 readings outside the joint map's" in warnings


def test_a_joint_without_limits_is_unwrapped():
    turning = np.linspace(0.0, 9.0, 30)
    read = np.arctan2(np.sin(turning), np.cos(turning))[:, None]
    read[7] = turning[7] = np.nan
    model = {"names": ("wheel",), "lower": np.array([-np.inf]), "upper": np.array([np.inf])}
    found = map_log(("wheel",), read, model).log.positions[:, 0]
    np.testing.assert_allclose(found, turning, atol=1e-12)


def test_joint_maps_are_read_and_applied(tmp_path):
    path = tmp_path / "joint_map.yaml"
    path.write_text(
        "shoulder_pan: {column: main_shoulder_pan, from: [100, -100], to: [-1.92, 1.92]}\n"
        "finger_joint: {column: gripper_position, scale: 0.8, offset: 0.1}\n"
        "wrist: {column: wrist_deg, unit: deg}\n"
        "slide: {unit: mm}\n"
    )
    limits = {"lower": np.array([-2.0, 0.0, -2.0, 0.0]), "upper": np.array([2.0, 1.0, 2.0, 0.5])}
    model = {"names": ("shoulder_pan", "finger_joint", "wrist", "slide"), **limits}
    log = ("wrist_deg", "gripper_position", "main_shoulder_pan", "slide")
    readings = [[90.0, 0.5, 50.0, 250.0], [-45.0, 1.0, 100.0, 0.0]]
    found = map_log(log, readings, model, table=read_joint_map(path))
    expected = [[-0.96, 0.5, math.pi / 2, 0.25], [-1.92, 0.9, -math.pi / 4, 0.0]]
    np.testing.assert_allclose(found.log.positions, expected, atol=1e-12)
    assert found.clipped.tolist() == [[False] * 4, [True, False, False, False]]
    assert found.warnings == ()
    for text, message in (
        ("a: {from: [-1, 1]}", r"joint 'a': expected \{column: NAME\} and one of \{from, to\}"),
        ("a: {unit: deg, scale: 2}", "joint 'a': expected"),
        ("a: 3", "joint 'a': expected"),
        ("a: {unit: turns}", "joint 'a': unit must be one of rad, deg, m, mm"),
        ("a: {from: [1, 1], to: [0, 1]}", "joint 'a': from must be two different numbers"),
        ("a: {scale: much}", "joint 'a': scale must be a finite number"),
        ("[]", "a mapping from joints"),
    ):
        path.write_text(text)
        with pytest.raises(SceneError, match=message):
            read_joint_map(path)
    for table, message in (
        ({"b": Column("panda_joint1")}, r"the model.* has no joint 'b'; it has: panda"),
        ({"panda_joint1": Column("b")}, "the joint log has no column 'b'; it has: panda"),
    ):
        with pytest.raises(UnknownNameError, match=message):
            map_log(ARM["names"], POSES, ARM, table=table)


@pytest.mark.parametrize(("units", "unit"), [("rad", 1.0), ("deg", math.pi / 180.0)])
def test_columns_of_followers_are_compared_with_the_joint_s(units, unit):
    model = {"names": ("lead",), "lower": np.array([-1.0]), "upper": np.array([1.0])}
    followers = {"same": Column("lead"), "mirror": Column("lead", -0.5, 0.2)}
    lead = np.array([0.1, 0.6, 0.3])
    columns = {"same": lead, "mirror": 0.2 - 0.5 * lead, "lead": lead}

    def warnings(names=("same", "mirror", "lead"), **changed):
        readings = np.column_stack([(columns | changed)[name] for name in names]) / unit
        log = JointLog(names, 0.1 * np.arange(3), readings)
        alone = without_followers(log, followers)
        assert alone.names == ("lead",)
        found = map_log(alone.names, alone.positions, model, units=units)
        assert found.warnings == ()
        return follower_warnings(log, found.columns, followers, {"lead": 2.0})

    assert warnings() == []
    assert warnings(("lead", "mirror"), mirror=columns["mirror"] + 0.04) == []
    (one,) = warnings(mirror=-columns["mirror"], same=lead + 0.15)
    assert "column 'mirror' differs by up to 0.3 [rad or m] from -0.5 x 'lead' +0.2" in one
    assert "so do: same" in one


def joints_of(urdf):
    """Return the movable joints of a URDF that are not mimic joints, and their limits."""
    moving = [one for one in ElementTree.parse(urdf).iter("joint") if one.get("type") != "fixed"]
    moving = [one for one in moving if one.find("mimic") is None]
    sides = {
        side: [float(one.find("limit").get(side)) for one in moving] for side in ("lower", "upper")
    }
    arrays = {side: np.array(values) for side, values in sides.items()}
    return {"names": tuple(one.get("name") for one in moving), **arrays}


def test_real_logs_are_mapped(shared_data):
    """The fourteen arm joints of a humanoid are in its URDF's order, as its README says."""
    folder = shared_data / "humanoid_head_camera"
    log = open_episode(folder, episode=10).joints
    model = joints_of(folder / "robot" / "g1_upper_body_from_torso.urdf")
    found = map_log(log.names, log.positions, model)
    arms = [k for k, name in enumerate(model["names"]) if name not in found.not_logged]
    np.testing.assert_array_equal(found.log.positions[:, arms], log.positions[:, :14])
    assert found.warnings[-1].endswith(f"are not joints: {', '.join(log.names[14:])}")
    robot = joints_of(shared_data / "droid_episodes" / "robot" / "panda_robotiq.urdf")
    log = open_episode(shared_data / "droid_episodes" / "cloth").joints
    table = {"finger_joint": Column("gripper_position", 0.8)}
    found = map_log(log.names, log.positions, robot, table=table)
    assert found.not_logged == ()
    np.testing.assert_allclose(found.log.positions[:, -1], 0.8 * log.positions[:, -1])
