"""Joints and units of a joint log's columns; every assumption is reported."""

import math

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.camera.episode import JointLog
from drake_pose.camera.episode_files import open_episode
from drake_pose.camera.joint_map import Column, map_joints, match_names, read_joint_map
from drake_pose.camera.servo_readings import Servos
from drake_pose.errors import SceneError, SettingsError, UnknownNameError

LOW = np.array([-2.9, -1.8, -2.9, -3.1, -2.9, -0.1, -2.9])
HIGH = np.array([2.9, 1.8, 2.9, -0.1, 2.9, 3.8, 2.9])
ARM = {"names": tuple(f"panda_joint{k}" for k in range(1, 8)), "lower": LOW, "upper": HIGH}
POSES = np.array([[0.1, -0.5, 0.3, -2.4, 0.2, 2.0, 0.7], [0.2, -0.4, 0.1, -2.0, 0.1, 1.5, 0.9]])


def map_log(logged, readings, model, servos=None, frames=(), **more):
    readings = np.array(readings, dtype=float)
    log = JointLog(logged, 0.1 * np.arange(len(readings)), readings, frames, servos)
    is_angle = [not name.startswith("slide") for name in model["names"]]
    return map_joints(log, **model, is_angle=np.array(is_angle), **more)


def test_names_are_matched():
    for logged, wanted, found in (
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
        # Beside joints without number, if the numbered ones are as many and begin alike.
        ("joint_0 joint_1", "panda_joint1 panda_joint2 finger", [0, 1]),
        ("joint_0 joint_1", "a1 a2 a3 finger", [None, None]),
        ("joint_0 joint_1", "left_1 right_1 finger", [None, None]),
        ("m0 m1 finger", "a1 a2 finger", [0, 1, 2]),
        ("joint_0.pos joint_1.pos joint_2.pos", "joint_0 joint_1 left_carriage", [0, 1, 2]),
    ):
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
    np.testing.assert_array_equal(found.positions, expected)
    np.testing.assert_allclose(found.at(np.array([0.05]))[0, 0], 0.15)
    assert found.not_logged == ("panda_joint5",)
    assert found.warnings[-1] == "columns of the joint log that are not joints: gripper"
    with pytest.raises(SceneError, match=r"its columns are x, y, the joints panda_joint1,"):
        map_log(("x", "y"), np.zeros((2, 2)), ARM)


def test_joint_maps_and_given_units_decide():
    with pytest.raises(SettingsError, match="units must be rad or deg or normalised or steps, not"):
        map_log(ARM["names"], POSES, ARM, units="turns")
    limits = {"lower": np.full(2, -1.92), "upper": np.full(2, 1.92)}
    model, names = {"names": ("pan", "lift"), **limits}, ("main_pan", "main_lift", "claw")
    pan = Column("main_pan", 0.0192, 0.0, (-100.0, 100.0))
    table = {"pan": pan, "lift": Column("main_lift", 0.01)}
    found = map_log(names, [[-100.0, 3.0, 0], [50.0, 2.0, 0], [100.0, 0, 0]], model, table=table)
    np.testing.assert_allclose(found.positions[:, 0], [-1.92, 0.96, 1.92])
    np.testing.assert_array_equal(found.clipped, [[True, False], [False, False], [True, False]])
    warnings = map_log(names, [[-101.0, 3.0, 0.0]], model, table=table).warnings[0]
    assert "joint 'pan': column 'main_pan' has 1 of 1 readings outside the joint map's" in warnings


def test_a_joint_without_limits_is_unwrapped():
    turning = np.linspace(0.0, 9.0, 30)
    read = np.arctan2(np.sin(turning), np.cos(turning))[:, None]
    read[7] = turning[7] = np.nan
    model = {"names": ("wheel",), "lower": np.array([-np.inf]), "upper": np.array([np.inf])}
    found = map_log(("wheel",), read, model).positions[:, 0]
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
    np.testing.assert_allclose(found.positions, expected, atol=1e-12)
    assert found.clipped.tolist() == [[False] * 4, [True, False, False, False]]
    assert found.warnings == ()
    for text, message in (
        ("a: {from: [-1, 1]}", r"joint 'a': expected \{column: NAME\} and one of \{from, to\}"),
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


RNG = np.random.default_rng(5)
WIDE = {"names": ("j1", "j2", "j3"), "lower": np.full(3, -2.8), "upper": np.full(3, 2.8)}
SWING = np.column_stack([np.linspace(-a, b, 40) for a, b in ((0.7, 1.6), (0.2, 1.1), (0.8, 0.7))])
SWING += 0.001 * RNG.normal(size=SWING.shape)
HELD, HOLES = 0.2 * SWING, np.where(np.arange(40)[:, None] % 9 == [0, 1, 2], np.nan, SWING)
STEP, JOINTS = 2.0 * np.pi / 4096, WIDE["names"]
DEG, LEROBOT, SO = np.degrees(1.0), Servos(), Servos("so101_follower")
POS = ("j1.pos", "j2.pos", "j3.pos")


@pytest.mark.parametrize(
    ("names", "readings", "servos", "units", "scale", "told"),
    [
        # Radians with names of LeRobot's servos, or without; a robot that moves little.
        (POS, SWING, LEROBOT, None, 1.0, "in rad: as degrees or -100 ... 100 the robot would har"),
        (POS, SWING, None, None, 1.0, "assumed to be in rad"),
        (JOINTS, SWING, LEROBOT, None, 1.0, None),
        (JOINTS, HOLES, None, None, 1.0, None),
        (JOINTS, HELD, None, None, 0.2, "in rad: but as degrees they would be within"),
        (JOINTS, HELD, None, "rad", 0.2, None),
        (JOINTS, -SWING, None, None, -1.0, None),
        (POS, HELD, LEROBOT, None, None, r"normalised .*could be radians or degrees.*--units rad"),
        (POS, SWING, SO, None, None, r"normalised .*could be radians or degrees.*--units rad"),
        (JOINTS, SWING + 1.7, None, None, None, r"'j1' is 0.9\d+ to 3.3.*and not clearly degrees"),
        # Degrees: by limits beyond 100; up to 100 they could be normalised.
        (POS, 1.1 * DEG * SWING, LEROBOT, None, 1.1, "LeRobot's degrees: only as degrees"),
        (POS, DEG * SWING, LEROBOT, None, None, r"normalised .*could be degrees.*--units rad"),
        (JOINTS, DEG * SWING, None, None, 1.0, "in deg: only as degrees"),
        (JOINTS, 99.5 / 1.6 * SWING, None, None, None, r"normalised.*from: \[-100, 100\]"),
        # Normalised: a robot that moves little about the middle, in steps of its encoders.
        (POS, np.round(13.0 * SWING) / 13.0, LEROBOT, None, None, "their ranges are not known"),
        # Steps.
        (JOINTS, 2048 + SWING / STEP, LEROBOT, None, 1.0, "encoder steps, 4096"),
        (JOINTS, 2048 + SWING / STEP, None, None, None, "or steps"),
        # One column alone is in degrees.
        (POS, SWING * [1.2 * DEG, 1, 1], LEROBOT, None, None, "j1.pos are in degrees, but j2.pos"),
    ],
)
def test_limits_and_what_moves_tell_the_unit(names, readings, servos, units, scale, told):
    if scale is None:
        with pytest.raises(SceneError, match=told):
            map_log(names, readings, WIDE, servos, units=units)
        return
    found = map_log(names, readings, WIDE, servos, units=units)
    expected = np.where(np.isnan(readings), np.nan, scale * SWING)
    np.testing.assert_allclose(found.positions, expected, atol=1e-9)
    assert told in found.warnings[0] if told else found.warnings == ()


@pytest.mark.parametrize(
    ("off", "told"), [(-1, "full turn off"), (1, "full turn off"), (0.6, "wrong")]
)
def test_the_worst_reading_beyond_the_limits_is_named(off, told):
    """As it would be without the turn that an encoder counts too many."""
    readings = SWING.copy()
    readings[3, 0], readings[7, 1] = SWING[3, 0] + 2.0 * np.pi * off, 2.85
    (said,) = map_log(JOINTS, readings, WIDE, units="rad").warnings
    assert told in said
    assert f"gives {readings[3, 0]:.4g} rad in row 3," in said
    assert (f"off, {SWING[3, 0]:.4g}," in said) == ("turn" in told)


OPEN = np.linspace(0.0, 1.0, 40)


def test_grippers_and_lengths_beside_radians():
    for joint, upper, readings, servos, expected, told in (
        # A column that is called otherwise may be an opening.
        ("claw j4", 1.7, 0.7 * OPEN, LEROBOT, None, "'j4' of the joint log, 0 to 0.7, is not"),
        ("claw j4", 1.7, OPEN - 0.1, LEROBOT, OPEN - 0.1, ""),
        ("slide_claw j4", 0.04, 0.03 * OPEN, LEROBOT, 0.03 * OPEN, ""),
        ("gripper", 1.7, 100 * OPEN, LEROBOT, 1.7 * OPEN, "LeRobot's opening, 0 to 100"),
        ("gripper", 1.7, 100 * OPEN, None, None, "it seems to be a gripper's opening"),
        ("gripper", 0.5, OPEN, None, None, "it seems to be a gripper's opening"),
        ("slide_finger", 0.04, 40 * OPEN, None, 0.04 * OPEN, "assumed to be in mm"),
        ("slide_finger", 0.04, 40 * OPEN, LEROBOT, 0.016 * OPEN, "LeRobot's opening, 0 to 100"),
        # What lies between motor and finger is not known.
        ("gripper", 1.7, 2048 + 900 * OPEN, LEROBOT, None, "does not tell its position"),
        ("slide_rail", 0.9, 800 * OPEN, None, 0.8 * OPEN, "assumed to be in mm"),
        ("slide_rail", 0.9, OPEN + 0.1, None, OPEN + 0.1, "gives 1.1 m in row 39, outside"),
    ):
        joint, column = joint.split()[0], joint.split()[-1]
        model = {"names": (*JOINTS, joint), "lower": np.append(WIDE["lower"], 0.0)}
        model["upper"] = np.append(WIDE["upper"], upper)
        arm = SWING if readings.max() < 2048 else 2048 + SWING / STEP
        found = map_log((*JOINTS, column), np.column_stack([arm, readings]), model, servos)
        np.testing.assert_allclose(found.positions[:, :3], SWING, atol=1e-9)
        if expected is None:
            assert found.not_logged == (joint,)
        else:
            np.testing.assert_allclose(found.positions[:, 3], expected, atol=1e-12)
        assert told is None or told in " ".join(found.warnings)
        assert told is not None or found.warnings == ()


def test_columns_of_followers_have_their_words():
    model = {"names": ("slide_left", "slide_right_joint")}
    model |= {"lower": np.zeros(2), "upper": np.full(2, 0.04)}
    for names, joints in (
        (("slide_right_joint",), ("slide_right_joint",)),
        (("slide_right.pos", "slide_left"), ("slide_right_joint", "slide_left")),
        (("left", "right"), ("slide_left",)),
    ):
        readings = 0.03 * OPEN[:, None] * [1.0, 0.5][: len(names)]
        found = map_log(names, readings, model, followers=("slide_right_joint",))
        assert sorted(found.columns) == sorted(joints)


def test_real_logs_are_mapped(shared_data):
    """The fourteen arm joints of a humanoid are in its URDF's order, as its README says."""
    folder = shared_data / "humanoid_head_camera"
    log = open_episode(folder, episode=10).joints
    robot = load_model(folder / "robot" / "g1_upper_body_from_torso.urdf", check=False)
    model = {"names": robot.position_names, "lower": robot.lower, "upper": robot.upper}
    found = map_log(log.names, log.positions, model)
    arms = [k for k, name in enumerate(model["names"]) if name not in found.not_logged]
    np.testing.assert_array_equal(found.positions[:, arms], log.positions[:, :14])
    assert found.warnings[-1].endswith(f"are not joints: {', '.join(log.names[14:])}")
