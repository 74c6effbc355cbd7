"""Readings of LeRobot's servos become the angles of a simulated arm with encoders."""

import json
from dataclasses import replace

import numpy as np
import pytest

from drake_pose.camera.episode import JointLog
from drake_pose.camera.joint_map import map_joints, motors_of, read_joint_map
from drake_pose.camera.servo_readings import Column, JointReadings, Servos, find_motors, read_motors
from drake_pose.errors import SceneError
from drake_pose.jobs.registration.lerobot_files import correct_homing, dump_column

BODY = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
NAMES = (*BODY, "gripper")
# Limits of the SO-101's URDF.
LOWER = np.array([-1.91986, -1.74533, -1.69, -1.65806, -2.74385, -0.174533])
UPPER = np.array([1.91986, 1.74533, 1.69, 1.65806, 2.84121, 1.74533])
STEP = 2.0 * np.pi / 4096


class Encoder:
    """A motor whose encoder is mounted at any angle, calibrated as LeRobot does, in whole steps."""

    def __init__(self, rng, lower, upper, full=False, dynamixel=False, inverted=False, wrong=0.0):
        """wrong: middle of the range as calibrated, less the true one [rad]."""
        self.dynamixel, self.inverted = dynamixel, inverted
        # Dynamixel's motors invert what they count, so that a joint counts up with its angle.
        self.sign = -1.0 if inverted and not dynamixel else 1.0
        self.mount = int(rng.integers(0, 4096))
        middle = self.raw((0.5 * (lower + upper) if not full else 0.0) + wrong)
        # Homing makes the middle half a turn.
        self.homing = 2047 - middle if dynamixel else middle - 2047
        # The joint was not moved to one of its ends.
        reached = np.array([lower + 2 * max(wrong, 0.0), upper + 2 * min(wrong, 0.0)])
        ends = sorted(self.homed(reached).tolist())
        self.low, self.high = (0, 4095) if full else ends

    def raw(self, angle):
        return np.round(self.sign * np.asarray(angle) / STEP).astype(int) + self.mount

    def homed(self, angle):
        return self.raw(angle) + (self.homing if self.dynamixel else -self.homing)

    def entry(self, number):
        return {"id": number, "drive_mode": int(self.inverted), "homing_offset": int(self.homing),
                "range_min": int(self.low), "range_max": int(self.high)}  # fmt: skip

    def read(self, angle, mode):
        """LeRobot's formulas for its three modes, and raw steps."""
        P = self.homed(angle)
        inside = (np.clip(P, self.low, self.high) - self.low) / (self.high - self.low)
        flips = self.inverted and not self.dynamixel
        if mode == "steps":
            return P.astype(float)
        if mode == "deg":
            return (P - 0.5 * (self.low + self.high)) * 360 / 4095
        if mode == "opening":
            return 100 * (1 - inside) if flips else 100 * inside
        norm = 200 * inside - 100
        return -norm if flips else norm


def arm_of(seed, wrong=(0.0,) * 6, **more):
    rng = np.random.default_rng(seed)
    arm = {
        name: Encoder(rng, low, high, full=name == "wrist_roll", wrong=off, **more)
        for name, low, high, off in zip(NAMES, LOWER, UPPER, wrong, strict=True)
    }
    phases = np.linspace(0, 3, 40)[:, None] * rng.uniform(1, 2, 6) + rng.uniform(0, 6, 6)
    return arm, 0.5 * (LOWER + UPPER) + 0.7 * np.sin(phases) * 0.5 * (UPPER - LOWER)


def log_of(arm, angles, mode, suffix=".pos", servos=None):
    modes = [mode] * 5 + ["steps" if mode == "steps" else "opening"]
    columns = [arm[n].read(a, m) for n, a, m in zip(NAMES, angles.T, modes, strict=True)]
    names = tuple(name + suffix for name in NAMES)
    readings = np.column_stack(columns).astype(np.float32).astype(float)
    return JointLog(names, 0.1 * np.arange(len(angles)), readings, servos=servos or Servos())


def map_arm(log, **more):
    return map_joints(log, NAMES, LOWER, UPPER, np.ones(6, bool), **more)


def write_file(path, arm):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({n: one.entry(k + 1) for k, (n, one) in enumerate(arm.items())}))
    return path


def test_a_calibration_file_gives_the_models_angles(tmp_path):
    """Also of columns without names: they have the file's motors in order."""
    for robot, names, modes in (
        ("so101_follower", None, ("normalised", "deg", "steps")),
        ("koch_follower", None, ("normalised", "deg", "steps")),
        ("my_arm", None, ("normalised", "deg", "steps")),
        ("inverted so101", None, ("normalised", "steps")),
        ("so101", tuple(f"joint_{k}" for k in range(6)), ("steps",)),
    ):
        is_inverted, robot = robot.startswith("inverted"), robot.split()[-1]
        arm, angles = arm_of(3, dynamixel=robot.startswith("koch"), inverted=is_inverted)
        write_file(tmp_path / "arm.json", arm)
        for mode in modes:
            log = log_of(arm, angles, mode)
            servos, warnings = find_motors(tmp_path, robot, names or log.names)
            assert warnings == []
            found = map_arm(JointLog(names or log.names, log.times, log.positions, servos=servos))
            # A step of the encoder, and one of the calibration.
            np.testing.assert_allclose(found.positions, angles, atol=2.1 * STEP)
            assert (found.unit, found.not_logged) == (mode, ())
            told = found.warnings[-1]
            assert all(text in told for text in ("arm.json", "--zeros all"))


def test_readings_that_are_not_whole_steps_are_told_by_their_range(tmp_path):
    """Filtered or simulated readings have no steps; ranges tell degrees only beyond 100."""
    arm, angles = arm_of(5)
    servos = read_motors(write_file(tmp_path / "arm.json", arm), "so101_follower")
    log = log_of(arm, angles, "normalised", servos=servos)
    smooth = replace(log, positions=log.positions + 0.004)
    found = map_arm(smooth)
    np.testing.assert_allclose(found.positions, angles, atol=3 * STEP)
    assert "could be degrees" in found.warnings[0]
    # Two degrees beyond the motor's range cannot be degrees.
    j = int(np.argmin(UPPER[:5] - LOWER[:5]))
    half = 180.0 * (arm[NAMES[j]].high - arm[NAMES[j]].low) / 4096
    for beyond, said in ((1.5, "could be degrees"), (2.5, "would leave its range")):
        readings = smooth.positions.copy()
        readings[3, j] = half + beyond
        found = map_arm(replace(log, positions=readings))
        assert (found.unit, said in found.warnings[0]) == ("normalised", True)
    angles[3, 4] = 2.7
    log = log_of(arm, angles, "deg", servos=servos)
    assert map_arm(replace(log, positions=log.positions + 0.004)).unit == "deg"


@pytest.mark.parametrize("mode", ["normalised", "deg"])
def test_without_a_file_the_steps_in_the_readings_give_the_ranges(mode):
    """The range in steps follows from normalised readings, as encoders count in whole steps."""
    arm, angles = arm_of(6)
    fine = np.repeat(angles, 4, axis=0) + np.tile([[0.0], [0.011], [0.023], [0.04]], (40, 1))
    found = map_arm(log_of(arm, fine, mode))
    np.testing.assert_allclose(found.positions[:, :5], fine[:, :5], atol=3 * STEP)
    assert found.unit == mode


def test_a_robot_without_a_file_has_its_models_limits():
    arm, angles = arm_of(7)
    log = log_of(arm, angles[:12], "normalised")
    with pytest.raises(SceneError, match=r"normalised.*their ranges are not known.*--joint-map"):
        map_arm(log)
    known = JointLog(log.names, log.times, log.positions, servos=Servos("so100_follower"))
    found = map_arm(known)
    np.testing.assert_allclose(found.positions, angles[:12], atol=3 * STEP)


def test_degrees_of_old_data_sets_have_another_zero():
    """LeRobot's page on backward compatibility: lift is -(x - 90), elbow x - 90."""
    _, angles = arm_of(8)
    degrees = np.rad2deg(angles)
    degrees[:, 1], degrees[:, 2] = 90.0 - degrees[:, 1], degrees[:, 2] + 90.0
    degrees[:, 5] = 100 * (angles[:, 5] - LOWER[5]) / (UPPER[5] - LOWER[5])
    names = tuple(f"main_{name}" for name in NAMES)
    found = map_arm(JointLog(names, np.arange(40.0), degrees, servos=Servos("so100")))
    np.testing.assert_allclose(found.positions, angles, atol=1e-9)
    assert "before June 2025" in " ".join(found.warnings)


def test_lists_of_older_files_home_raw_steps(tmp_path):
    _, angles = arm_of(9)
    old = np.rad2deg(angles)
    old[:, 1], old[:, 2] = 90.0 - old[:, 1], old[:, 2] + 90.0
    homing, modes = np.array([2048, -1024, 300, -2048, 10, 0]), np.array([0, 1, 0, 0, 1, 0])
    steps = np.where(modes, -1, 1) * (old * 2048 / 180 - homing)
    steps[:, 5] = 1000 + 900 * (angles[:, 5] - LOWER[5]) / (UPPER[5] - LOWER[5])
    content = {
        "homing_offset": homing.tolist(), "drive_mode": modes.tolist(), "motor_names": [*NAMES],
        "start_pos": [0, 0, 0, 0, 0, 1000], "end_pos": [1] * 5 + [1900],
        "calib_mode": ["DEGREE"] * 5 + ["LINEAR"],
    }  # fmt: skip
    path = tmp_path / "main_follower.json"
    path.write_text(json.dumps(content))
    servos = read_motors(path, "so100")
    names = tuple(f"main_{name}" for name in NAMES)
    found = map_arm(JointLog(names, np.arange(40.0), np.round(steps), servos=servos))
    np.testing.assert_allclose(found.positions[:, :5], angles[:, :5], atol=STEP)
    np.testing.assert_allclose(found.positions[:, 5], angles[:, 5], atol=0.01)


WRONG = (0.11, -0.16, 0.05, -0.3, 0.2, 0.0)
"""Errors of a calibration by hand [rad]."""


@pytest.mark.parametrize("mode", ["normalised", "deg", "steps"])
@pytest.mark.parametrize(
    ("robot", "inverted"),
    [("so101_follower", False), ("so100", True), ("koch_follower", False), ("koch", True)],
)
def test_a_corrected_file_reads_the_models_angles(tmp_path, mode, robot, inverted):
    """An encoder that is homed by the corrected file reads degrees of the model in LeRobot."""
    dynamixel = robot.startswith("koch")
    # In degrees LeRobot ignores the drive mode of Feetech's motors: such a joint is mirrored.
    inverted &= dynamixel or mode != "deg"
    arm, angles = arm_of(11, WRONG, dynamixel=dynamixel, inverted=inverted)
    angles = 0.5 * angles
    servos = read_motors(write_file(tmp_path / "arm.json", arm), robot)
    found = map_arm(log_of(arm, angles, mode, servos=servos))
    off = np.median(angles - found.positions, axis=0)
    np.testing.assert_allclose(off[:5], WRONG[:5], atol=3 * STEP)
    # A joint map with these offsets maps the data set as recorded to the model.
    lines = [dump_column(n, one, off[NAMES.index(n)]) for n, one in found.columns.items()]
    path = tmp_path / "joint_map.yaml"
    path.write_text("".join(lines))
    again = map_arm(log_of(arm, angles, mode, servos=servos), table=read_joint_map(path))
    np.testing.assert_allclose(again.positions, angles, atol=3 * STEP)
    corrections = {}
    for joint, motor in motors_of(found):
        k = NAMES.index(joint.name)
        column = found.columns[joint.name]
        corrections[motor] = correct_homing(joint, motor, column, off[k], servos, mode)
    assert corrections["gripper"].after == arm["gripper"].homing
    for k, name in enumerate(BODY):
        encoder = arm[name]
        encoder.homing = corrections[name].after
        read = encoder.read(angles[:, k], "deg")
        if encoder.inverted and not dynamixel:
            # Only normalised readings regard the drive mode.
            read = encoder.read(angles[:, k], "normalised")
            read = read * 180 * (encoder.high - encoder.low) / 100 / 4096
        turned = np.mod(read - np.rad2deg(angles[:, k]) + 180, 360) - 180
        np.testing.assert_allclose(turned, 0, atol=0.3)
        assert dynamixel or abs(encoder.homing) < 2048


def test_a_zero_far_from_the_motors_middle_is_not_corrected(tmp_path):
    arm = {"joint4": Encoder(np.random.default_rng(0), -3.0, -0.1)}
    servos = read_motors(write_file(tmp_path / "arm.json", arm), "so100")
    joint = JointReadings("joint4", "joint4.pos", np.zeros(0), -3.0, -0.1, True, False, None)
    column = Column("joint4.pos", 0.01, -1.55)
    found = correct_homing(joint, "joint4", column, 0.1, servos, "normalised")
    assert found.before == found.after
    assert "-83 degrees" in found.reason


def test_lists_are_corrected_in_their_own_sense(tmp_path):
    """reading = (sign steps + homing) 180 / 2048, as LeRobot read until June 2025."""
    content = {"homing_offset": [100, -50], "drive_mode": [0, 1], "motor_names": ["pan", "tilt"]}
    path = tmp_path / "old.json"
    path.write_text(json.dumps(content))
    servos, off = read_motors(path, "so100"), np.array([0.1, -0.2])
    readings = np.random.default_rng(3).uniform(-40, 40, (9, 2)).round(3)
    log = JointLog(("main_pan", "main_tilt"), np.arange(9.0), readings, servos=servos)
    found = map_joints(log, ("pan", "tilt"), -2 * np.ones(2), 2 * np.ones(2), np.ones(2, bool))
    counted = readings * 2048 / 180 - content["homing_offset"]
    for k, (joint, motor) in enumerate(motors_of(found)):
        column = found.columns[joint.name]
        homing = correct_homing(joint, motor, column, off[k], servos, "deg").after
        read = np.deg2rad((counted[:, k] + homing) * 180 / 2048)
        np.testing.assert_allclose(read, found.positions[:, k] + off[k], atol=STEP)


def test_a_model_with_other_names_has_the_arms_joints_in_order(tmp_path):
    """Joints of other models of the SO-100, such as MuJoCo's."""
    arm, angles = arm_of(13)
    servos = read_motors(write_file(tmp_path / "arm.json", arm), "so100")
    log = log_of(arm, angles, "normalised", servos=servos)
    joints = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
    for count in (6, 5):
        limits = LOWER[:count], UPPER[:count], np.ones(count, bool)
        found = map_joints(log, joints[:count], *limits)
        np.testing.assert_allclose(found.positions, angles[:, :count], atol=2.1 * STEP)
        assert "gripper.pos for Jaw" in found.warnings[0] or count == 5
    with pytest.raises(SceneError, match="no column of the joint log is a joint"):
        map_joints(log, ("a", "b"), LOWER[:2], UPPER[:2], np.ones(2, bool))


def test_files_are_found_beside_the_data_set(tmp_path):
    arm, _ = arm_of(10)
    folder = tmp_path / "sets" / "pick"
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text('{"robot_type": "so101_follower"}')
    names = tuple(f"{name}.pos" for name in NAMES)
    assert find_motors(folder, "so101_follower", names)[0].path is None
    beside = write_file(tmp_path / "sets" / "my_follower.json", arm)
    assert find_motors(folder, "", names)[0].path == beside
    write_file(folder / "calibration" / "teleoperators" / "my_leader.json", arm)
    own = write_file(folder / "calibration" / "robots" / "blue.json", arm)
    found, warnings = find_motors(folder, "", names)
    assert (found.path, found.motors["gripper"].low, warnings) == (own, arm["gripper"].low, [])
    write_file(folder / "calibration" / "robots" / "red.json", arm)
    with pytest.raises(SceneError, match=r"several calibrations.*blue.json.*red.json.*--joint-map"):
        find_motors(folder, "", names)
    other = folder.with_name("other")
    write_file(other / "arm.json", {"axis": arm["gripper"]})
    found, warnings = find_motors(other, "", ("pan", "lift"))
    assert (found.path, "not those of the data set: axis" in warnings[0]) == (None, True)
    damaged = folder / "damaged.json"
    damaged.write_text('{"a": {"range_min": 5, "range_max": 5, "homing_offset": 0}}')
    with pytest.raises(SceneError, match=r"damaged.json: motor 'a': range_min 5 must be less"):
        read_motors(damaged)
