"""What `register --export lerobot` writes is read by this program, and by LeRobot's formulas."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from drake_pose.camera.lerobot_tables import camera_fields
from drake_pose.camera.models import Lens
from drake_pose.camera.servo_readings import Column, JointReadings, Motor, Servos
from drake_pose.errors import CameraError, SettingsError
from drake_pose.files.settings import AuditSettings, RegistrationSettings
from drake_pose.jobs.registration.inputs import read_inputs
from drake_pose.jobs.registration.lerobot_files import (
    correct_homing,
    lerobot_files,
    require_data_set,
)
from tests.registration.episodes import painted_episode
from tests.registration.recordings import NAMES, write_episode

OFFSETS = {"joint1": 0.12, "joint2": -0.07}
"""Errors of the calibration, to be added to the recorded positions [rad]."""
STEP = 2.0 * np.pi / 4096
KEY = "observation.images.camera"


def write_data_set(folder, painted, robot="so101_follower"):
    """Write a LeRobot data set of normalised readings, with the robot's calibration file."""
    rng = np.random.default_rng(8)
    columns, motors = [], {}
    for k, name in enumerate(NAMES):
        homing = int(rng.integers(-2000, 2000))
        # All joints of the arm reach 2 rad to both sides.
        low, high = 2047 - round(2.0 / STEP), 2047 + round(2.0 / STEP)
        read = painted.values[:, k] - OFFSETS.get(name, 0.0)
        steps = np.round(read / STEP) + 2047
        columns.append(200 * (steps - low) / (high - low) - 100)
        motors[name] = {"id": k + 1, "drive_mode": 0, "homing_offset": homing,
                        "range_min": low, "range_max": high}  # fmt: skip
    coded = [cv2.imencode(".png", one[..., ::-1])[1].tobytes() for one in painted.pictures]
    count = len(painted.times)
    table = {
        "observation.state": np.column_stack(columns).astype(np.float32).tolist(),
        KEY: [{"bytes": data, "path": None} for data in coded],
        "timestamp": painted.times.astype(np.float32),
        "episode_index": [0] * count,
    }
    info = {
        "codebase_version": "v2.1", "robot_type": robot, "total_episodes": 1, "fps": 2.5,
        "data_path": "data/episode_{episode_index:06d}.parquet", "video_path": None,
        "features": {
            "observation.state": {"dtype": "float32", "shape": [5],
                                  "names": [f"{name}.pos" for name in NAMES]},
            KEY: {"dtype": "image", "shape": [*painted.pictures.shape[1:]]},
            "timestamp": {"dtype": "float32", "shape": [1]},
        },
    }  # fmt: skip
    for name in ("meta", "data"):
        (folder / name).mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "meta" / "tasks.jsonl").write_text('{"task": "swing"}\n')
    (folder / "arm.json").write_text(json.dumps(motors))
    pyarrow.parquet.write_table(pyarrow.table(table), folder / "data" / "episode_000000.parquet")
    return folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lerobot")
    painted = painted_episode(folder)
    return write_data_set(folder / "set", painted), painted


def read(folder, painted, **settings):
    return read_inputs(folder, painted.path, None, None, RegistrationSettings(**settings))


def export(folder, painted, **settings):
    """Return inputs, files and notes of an export of the true camera and offsets."""
    inputs = read(folder, painted, **settings)
    zeros = {
        name: {"significant": name in OFFSETS, "value_deg": np.rad2deg(OFFSETS.get(name, 0.01))}
        for name in NAMES
    }
    return inputs, *lerobot_files(inputs, [painted.camera], {}, zeros)


def test_the_joint_map_and_meta_are_read_with_the_data_set(recorded, tmp_path):
    folder, painted = recorded
    before = {one: one.read_bytes() for one in folder.rglob("*") if one.is_file()}
    _, files, notes = export(folder, painted)
    assert notes == []
    (tmp_path / "data").symlink_to(folder / "data")
    for name, content in files.items():
        path = tmp_path / name.removeprefix("lerobot/")
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert (tmp_path / "meta" / "tasks.jsonl").read_bytes() == b'{"task": "swing"}\n'
    # The corrected calibration does not belong to the readings; the map does.
    inputs = read(tmp_path, painted, joint_map=tmp_path / "joint_map.yaml")
    (recording,) = inputs.recordings.values()
    np.testing.assert_allclose(recording.values_at(0.0), painted.values, atol=2 * STEP)
    (camera,) = inputs.given_cameras
    np.testing.assert_allclose(camera.X_WC, painted.camera.X_WC, atol=1e-12)
    np.testing.assert_allclose(camera.kernel_parameters(), painted.camera.kernel_parameters())
    audited = read_inputs(tmp_path, painted.path, None, None, AuditSettings())
    assert [one.name for one in audited.given_cameras] == ["camera"]
    # A link without a pose is no given pose.
    info = json.loads(files["lerobot/meta/info.json"])
    info["features"][KEY]["info"] |= {"camera_link": "box3", "camera_extrinsics": None}
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    riding = read_inputs(tmp_path, painted.path, None, None, AuditSettings())
    assert (riding.links, riding.given_on_links) == ({"camera": "box3"}, ())
    assert before == {one: one.read_bytes() for one in folder.rglob("*") if one.is_file()}


def test_only_homing_offsets_of_the_calibration_change(recorded):
    folder, painted = recorded
    _, files, _ = export(folder, painted)
    old, new = json.loads((folder / "arm.json").read_text()), json.loads(files["lerobot/arm.json"])
    for name in NAMES:
        homing, shift = old[name]["homing_offset"], round(OFFSETS.get(name, 0.0) / STEP)
        assert new[name] == old[name] | {"homing_offset": homing - shift}
        assert (
            f"| {name} | {homing} | {homing - shift} | {shift:+d} |" in files["lerobot/README.md"]
        )


JOINT = JointReadings("joint", "column", np.zeros(1), -2.0, 2.0, True, False)


@pytest.mark.parametrize("encoding", ["steps", "normalised", "deg"])
@pytest.mark.parametrize("is_inverted", [False, True])
@pytest.mark.parametrize(
    ("robot", "homes", "inverts"), [("so101_follower", -1, True), ("koch_follower", 1, False)]
)
def test_the_middle_of_a_range_becomes_the_models_zero(
    robot, homes, inverts, is_inverted, encoding
):
    """position = count + homes * homing; LeRobot inverts readings of Feetech's motors only."""
    low, high, constant, offset = 1000, 3200, 0.15, 0.55
    turn = -1.0 if is_inverted and inverts and encoding != "deg" else 1.0
    middle = 0.5 * (low + high)
    scales = {"steps": turn * STEP, "normalised": (high - low) / 200 * STEP, "deg": np.radians(1)}
    start = constant - (turn * middle * STEP if encoding == "steps" else 0.0)
    column = Column("column", scales[encoding], start)
    for homing in (-1900, 20, 1900):
        servos = Servos(robot, None, {"m": Motor(low, high, homing, is_inverted)})
        found = correct_homing(JOINT, "m", column, offset, servos, encoding)
        zero = middle - turn * (constant + offset) / STEP
        moved = zero + homes * (found.after - homing)
        assert (moved - middle + 2048) % 4096 - 2048 == pytest.approx(0.0, abs=1.0)
        assert found.shift == round(middle - zero)
        assert (found.before, found.reason) == (homing, "")
        assert abs(found.after) < 2048 or not inverts
    for joint, more, said in (
        (JOINT, 0.2, "too far"),
        (replace(JOINT, is_gripper=True), 0, "0 to"),
    ):
        kept = correct_homing(joint, "m", column, offset + more, servos, encoding)
        assert (kept.before, kept.after, kept.shift) == (1900, 1900, 0)
        assert said in kept.reason


@pytest.mark.parametrize(("encoding", "sign"), [("steps", -1), ("normalised", 1)])
def test_offsets_are_added_to_inverted_counts_of_calibrations_by_lists(encoding, sign):
    servos = Servos("koch", None, {"m": Motor(np.nan, np.nan, 7, True)}, has_lists=True)
    servos = replace(servos, robot="so100")
    for scale, offset in ((STEP, 0.3), (-STEP, 0.3), (STEP, -0.3)):
        found = correct_homing(JOINT, "m", Column("column", scale), offset, servos, encoding)
        assert found.after == 7 + found.shift
        assert sign * scale * found.shift == pytest.approx(offset, abs=STEP)


def test_what_is_left_out_is_said(recorded, tmp_path):
    folder, painted = recorded
    other = write_data_set(tmp_path / "other", painted, robot="my_arm")
    _, files, notes = export(other, painted)
    assert "lerobot/arm.json" not in files
    assert "robot_type 'my_arm' does not tell whose motors" in notes[0]
    (other / "arm.json").unlink()
    _, _, notes = export(other, painted, units="normalised")
    assert "not in or beside the data set; name it (--joint-map FILE)" in notes[0]
    inputs = read(folder, painted)
    _, notes = lerobot_files(inputs, [painted.camera], {}, {})
    assert "no joint offset is significant" in notes[0]
    own = json.loads((other / "meta" / "info.json").read_text())
    own["features"][KEY]["info"] = camera_fields(painted.camera)
    (other / "meta" / "info.json").write_text(json.dumps(own))
    refused = read(other, painted, units="normalised").without(["camera"])
    files, notes = lerobot_files(refused, [], {}, {})
    assert "camera 'camera' is left out of lerobot/meta/info.json, as it has no pose" in notes[1]
    feature = json.loads(files["lerobot/meta/info.json"])["features"][KEY]
    assert "camera_intrinsics" in feature["info"]
    assert "camera_extrinsics" not in feature["info"]
    lens = Lens(320, 240, np.eye(3), np.array([0.1]))
    bent = replace(read(other, painted, units="normalised"), lenses={"camera": lens})
    files, notes = lerobot_files(bent, [painted.camera], {}, {})
    assert "'camera' is left out of lerobot/meta/info.json, as its pictures are dist" in notes[1]
    assert "camera_extrinsics" not in files["lerobot/meta/info.json"]
    with pytest.raises(SettingsError, match="leave --joints out"):
        require_data_set(replace(inputs, joints=tmp_path / "joints.csv"))
    write_episode(tmp_path / "plain", painted)
    with pytest.raises(SettingsError, match=r"needs a LeRobot data set .*leave it out"):
        require_data_set(read(tmp_path / "plain", painted))


def test_damaged_fields_of_cameras_are_named(recorded, tmp_path):
    folder, painted = recorded
    _, files, _ = export(folder, painted)
    info = json.loads(files["lerobot/meta/info.json"])
    (tmp_path / "data").symlink_to(folder / "data")
    (tmp_path / "meta").mkdir()
    for field, value in (("camera_intrinsics", None), ("camera_intrinsics", [[1, 2], [3, 4]]),
                         ("camera_extrinsics", [[1.0]])):  # fmt: skip
        changed = json.loads(json.dumps(info))
        changed["features"][KEY]["info"][field] = value
        (tmp_path / "meta" / "info.json").write_text(json.dumps(changed))
        with pytest.raises(CameraError, match=rf"info.json: camera 'camera': {field}.* must be"):
            read(tmp_path, painted, units="normalised")
