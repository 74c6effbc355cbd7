"""Registration of episodes: pictures and a joint log, no masks."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drake_pose.camera.camera_files import load_cameras, save_cameras
from drake_pose.errors import DrakePoseError
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.inputs import RegistrationInputs, read_inputs
from drake_pose.jobs.registration.register import register_scene
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.benchmarks.registration import pose_error
from tests.cli import run_command
from tests.jobs.scenes import edit_camera
from tests.registration.arm_pictures import shifted
from tests.registration.episodes import painted_episode
from tests.registration.recordings import NAMES, write_episode, write_log

LATE = 0.04


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    """A folder of pictures with a joint log at another rate, and its contents."""
    folder = tmp_path_factory.mktemp("episode")
    painted = painted_episode(folder, late=LATE)
    write_episode(folder / "scene", painted)
    return folder / "scene", painted


def read(scene, painted, joints=None, cameras=None, **settings: Any) -> RegistrationInputs:
    return read_inputs(scene, painted.path, joints, cameras, RegistrationSettings(**settings))


def run(command: str, episode, out: Path, *more: object) -> dict[str, Any]:
    """Return the summary of a command's result."""
    scene, painted = episode
    words = [command, scene, "--model", painted.path, "--out", out, "--json", *more]
    result = run_command([str(word) for word in words])
    assert result.exit_code == 0, result.output
    return json.loads((out / "summary.json").read_text())


def test_log_is_interpolated_at_the_pictures_times(episode):
    _, painted = episode
    found = read(*episode)
    assert found.visible_nodes is None
    assert not found.assumed_focal
    (recording,) = found.recordings.values()
    for offset in (0.0, 0.07):
        # The log is interpolated linearly.
        np.testing.assert_allclose(
            recording.values_at(offset), painted.values_at(painted.times + offset), atol=2e-3
        )
    ahead, behind = (painted.values_at(painted.times + by) for by in (0.02, -0.02))
    np.testing.assert_allclose(recording.rates_at(0.0), (ahead - behind) / 0.04, atol=0.05)
    np.testing.assert_array_equal(recording.read(3), painted.pictures[3])
    (few,) = read(*episode, every=4, frames=("0004:0015",)).recordings.values()
    assert few.names == ("0004", "0008", "0012")
    np.testing.assert_array_equal(few.read(1), painted.pictures[8])


def test_parts_moved_by_unlogged_joints_are_not_used(episode, tmp_path):
    _, painted = episode
    times, table = np.arange(0.0, 6.0, 0.1), tmp_path / "some.csv"
    write_log(table, times, painted.values_at(times)[:, :3], NAMES[:3])
    found = read(*episode, table)
    assert found.visible_nodes == ("box0", "box1", "box2")
    assert any("box3, box4" in text for text in found.warnings)
    assert read(*episode, table, hold={"joint3": 0.0, "joint4": 10.0}).visible_nodes is None


def test_unknown_focal_length_is_assumed(episode, tmp_path):
    scene, painted = episode
    for name in ("images", "joint_angles.csv"):
        (tmp_path / name).symlink_to(scene / name)
    assert read(tmp_path, painted).assumed_focal == {"camera"}
    given = read(tmp_path, painted, None, scene / "cameras.yaml")
    assert given.scene.cameras["camera"].focal_x == painted.camera.focal_x
    assert not given.assumed_focal


def test_given_poses_of_cameras_are_known(episode, tmp_path):
    """Also on a link that stands still, as its joints are held."""
    scene, painted = episode
    file = edit_camera(scene / "cameras.yaml", "camera", tmp_path / "cameras.yaml", X_WC=None)
    for own, expected in ((None, {"camera"}), (scene / "cameras.yaml", {"camera"}), (file, set())):
        assert {one.name for one in read(*episode, None, own).given_cameras} == expected
    edit_camera(file, "camera", link="box1", X_LC=painted.camera.X_WC.tolist())
    assert read(*episode, None, file).links == {"camera": "box1"}
    found = read(*episode, None, file, hold={"joint0": 30.0, "joint1": 20.0})
    assert not found.links
    plant = painted.model.plant
    plant.SetPositions(context := plant.CreateDefaultContext(), np.radians([30, 20, 0, 0, 0]))
    X_WL = plant.GetBodyByName("box1").EvalPoseInWorld(context).GetAsMatrix4()
    np.testing.assert_allclose(found.given_cameras[0].X_WC, X_WL @ painted.camera.X_WC)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda scene: (scene / "joint_angles.csv").unlink(), "holds no joint positions"),
        (
            lambda scene: edit_camera(scene / "cameras.yaml", "camera", width=320, height=240),
            "320 x 240 pixels .*but its pictures 160 x 120",
        ),
        (
            lambda scene: write_log(scene / "joint_angles.csv", [0, 1], np.zeros((2, 5)), "vwxyz"),
            "no column of the joint log is a joint",
        ),
    ],
)
def test_unusable_episodes_are_refused(episode, tmp_path, spoil, words):
    scene, painted = episode
    for file in ("joint_angles.csv", "cameras.yaml"):
        (tmp_path / file).write_bytes((scene / file).read_bytes())
    (tmp_path / "images").symlink_to(scene / "images")
    spoil(tmp_path)
    with pytest.raises(DrakePoseError, match=words):
        read(tmp_path, painted)


@pytest.mark.slow
def test_an_episode_becomes_a_calibrated_scene(episode, out):
    _, painted = episode
    summary = run("register", episode, out)
    assert summary["masks"] == "found"
    deviation = summary["time_offset_sd_s"]
    assert summary["time_offset_s"] == pytest.approx(LATE, abs=3.0 * deviation + 2e-3)
    error = pose_error(load_cameras(out / "cameras.yaml")["camera"].X_WC, painted.camera.X_WC)
    assert np.linalg.norm(error[3:]) < 0.012
    assert np.degrees(np.linalg.norm(error[:3])) < 0.4
    # The result is a scene of masks for other commands.
    masks = load_scene(out)
    with (out / "joint_angles.csv").open(newline="") as file:
        rows = {row["frame"]: row for row in csv.DictReader(file)}
    assert set(rows) == set(masks.frames)
    told = [[float(rows[frame][name]) for name in NAMES] for frame in masks.frames]
    np.testing.assert_allclose(told, painted.values[list(map(int, masks.frames))], atol=0.02)
    errors = {frame: one["E_total"] for frame, one in summary["frames"].items()}
    in_order = sorted(errors, key=lambda frame: -errors[frame])
    given = sorted((out / "overlay_as_given" / "camera").glob("*.png"))
    assert [one.stem for one in given] == sorted({in_order[0], in_order[len(in_order) // 2]})
    anew = RegistrationSettings(cameras=("camera",))
    again = register_scene(out, painted.path, out / "joint_angles.csv", settings=anew)
    error = pose_error(again.registered["camera"].camera.X_WC, painted.camera.X_WC)
    assert np.linalg.norm(error[3:]) < 0.02


@pytest.mark.slow
def test_audit_of_an_episode_finds_wrong_clock_and_camera(episode, tmp_path):
    _, painted = episode
    summary = run("audit", episode, tmp_path / "audit")
    (clock,) = summary["findings"]
    assert clock["cause"] == "clock"
    assert clock["shift_ms"] == pytest.approx(1e3 * LATE, abs=5.0)
    assert summary["agreeing_count"] == summary["frame_count"] == len(painted.times)
    save_cameras(tmp_path / "moved.yaml", [shifted(painted.camera, 0.15, -0.1, 0.05)])
    summary = run("audit", episode, tmp_path / "again", "--cameras", tmp_path / "moved.yaml")
    camera = next(one for one in summary["findings"] if one["cause"] == "camera")
    assert camera["shift_mm"] == pytest.approx(1e3 * np.linalg.norm([0.15, 0.1, 0.05]), abs=15.0)
    assert camera["alternatives"] == ["base"]
    assert any((tmp_path / "again" / "overlay_as_given" / "camera").glob("*.png"))
