"""Registrations of episodes: pictures and joints by time, no masks."""

import csv
import json

import cv2
import numpy as np
import pytest
import yaml

from drake_pose.camera.camera_files import load_cameras, save_cameras
from drake_pose.commands.main import app
from drake_pose.errors import DrakePoseError
from drake_pose.files.overlay import EXCESS_RGB, MISSING_RGB
from drake_pose.jobs.estimate.episode import is_episode
from drake_pose.jobs.registration.audit import audit_scene
from drake_pose.jobs.registration.episodes import read_episode
from drake_pose.jobs.registration.register import register_scene
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.benchmarks.registration import pose_error
from tests.cli import CliRunner
from tests.registration.episodes import painted_episode
from tests.registration.recordings import NAMES, write_episode, write_log

LATE = 0.04


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    """A folder of pictures with a joint log at another rate, and what is in it."""
    folder = tmp_path_factory.mktemp("episode")
    painted = painted_episode(folder, late=LATE)
    scene = folder / "scene"
    write_episode(scene, painted)
    return scene, painted


def test_what_is_an_episode(episode, tmp_path):
    scene, _ = episode
    settings = RegistrationSettings()
    assert is_episode(scene, settings)
    (tmp_path / "images").mkdir()
    assert is_episode(tmp_path, settings)
    (tmp_path / "masks").mkdir()
    assert not is_episode(tmp_path, settings)


def test_joints_are_where_their_log_says_at_the_pictures_times(episode):
    scene, painted = episode
    read = read_episode(scene, painted.path, None, None, RegistrationSettings())
    assert read.seen is None
    assert not read.assumed
    (recording,) = read.recordings.values()
    for offset in (0.0, 0.07):
        # Between rows of the log a swing is straight.
        np.testing.assert_allclose(
            recording.values_at(offset), painted.values_at(painted.times + offset), atol=2e-3
        )
    ahead, behind = (painted.values_at(painted.times + by) for by in (0.02, -0.02))
    np.testing.assert_allclose(recording.rates_at(0.0), (ahead - behind) / 0.04, atol=0.05)
    np.testing.assert_array_equal(recording.read(3), painted.pictures[3])
    some = RegistrationSettings(every=4, frames=("0004:0015",))
    (few,) = read_episode(scene, painted.path, None, None, some).recordings.values()
    assert few.names == ("0004", "0008", "0012")
    np.testing.assert_array_equal(few.read(1), painted.pictures[8])


def test_parts_that_unlogged_joints_move_are_not_looked_at(episode, tmp_path):
    scene, painted = episode
    times = np.arange(0.0, 6.0, 0.1)
    write_log(tmp_path / "some.csv", times, painted.values_at(times)[:, :3], NAMES[:3])
    read = read_episode(scene, painted.path, tmp_path / "some.csv", None, RegistrationSettings())
    assert read.seen == ("box0", "box1", "box2")
    assert any("box3, box4" in text for text in read.warnings)
    held = RegistrationSettings(hold={"joint3": 0.0, "joint4": 10.0})
    read = read_episode(scene, painted.path, tmp_path / "some.csv", None, held)
    assert read.seen is None


def test_a_focal_length_that_nobody_knows_is_a_usual_one(episode, tmp_path):
    scene, painted = episode
    (tmp_path / "images").symlink_to(scene / "images")
    (tmp_path / "joint_angles.csv").symlink_to(scene / "joint_angles.csv")
    read = read_episode(tmp_path, painted.path, None, None, RegistrationSettings())
    assert read.assumed == {"camera"}
    given = read_episode(
        tmp_path, painted.path, None, scene / "cameras.yaml", RegistrationSettings()
    )
    assert given.cameras["camera"].focal_x == painted.camera.focal_x
    assert not given.assumed


def test_whether_a_camera_s_place_is_given(episode, tmp_path):
    scene, painted = episode
    content = yaml.safe_load((scene / "cameras.yaml").read_text())
    del content["camera"]["X_WC"]
    file = tmp_path / "cameras.yaml"
    file.write_text(yaml.safe_dump(content))
    for own, expected in ((None, {"camera"}), (scene / "cameras.yaml", {"camera"}), (file, set())):
        read = read_episode(scene, painted.path, None, own, RegistrationSettings())
        assert read.placed == expected


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda scene: (scene / "joint_angles.csv").unlink(), "holds no joint positions"),
        (
            lambda scene: save_cameras(
                scene / "cameras.yaml",
                [load_cameras(scene / "cameras.yaml")["camera"].resized(320, 240)],
            ),
            "320 x 240 pixels .*but its pictures 160 x 120",
        ),
        (
            lambda scene: write_log(
                scene / "joint_angles.csv", [0.0, 1.0], np.zeros((2, 5)), [f"a{k}" for k in "vwxyz"]
            ),
            "no column of the joint log is a joint",
        ),
    ],
)
def test_what_cannot_be_used_is_named(episode, tmp_path, spoil, words):
    scene, painted = episode
    for file in ("joint_angles.csv", "cameras.yaml"):
        (tmp_path / file).write_bytes((scene / file).read_bytes())
    (tmp_path / "images").symlink_to(scene / "images")
    spoil(tmp_path)
    with pytest.raises(DrakePoseError, match=words):
        read_episode(tmp_path, painted.path, None, None, RegistrationSettings())


@pytest.mark.parametrize("name", ["on", "suggest"])
def test_options_that_need_masks_are_refused(episode, name):
    scene, painted = episode
    value = {"on": "box4", "suggest": True}[name]
    with pytest.raises(DrakePoseError, match=f"--{name} needs masks"):
        register_scene(scene, painted.path, settings=RegistrationSettings(**{name: value}))


@pytest.mark.slow
def test_an_episode_becomes_a_calibrated_scene(episode, tmp_path):
    scene, painted = episode
    out = tmp_path / "out"
    arguments = ["register", str(scene), "--model", str(painted.path), "--out", str(out), "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    summary = json.loads((out / "summary.json").read_text())
    assert summary["masks"] == "found"
    deviation = summary["time_offset_sd_s"]
    assert summary["time_offset_s"] == pytest.approx(LATE, abs=3.0 * deviation + 2e-3)
    found = load_cameras(out / "cameras.yaml")["camera"]
    error = pose_error(found.X_WC, painted.camera.X_WC)
    assert np.linalg.norm(error[3:]) < 0.012
    assert np.degrees(np.linalg.norm(error[:3])) < 0.4
    # The result is a scene of masks, that other commands read.
    masks = load_scene(out)
    with (out / "joint_angles.csv").open(newline="") as file:
        rows = {row["frame"]: row for row in csv.DictReader(file)}
    assert set(rows) == set(masks.frames)
    for frame in masks.frames:
        k = int(frame)
        told = [float(rows[frame][name]) for name in NAMES]
        np.testing.assert_allclose(told, painted.values[k], atol=0.02)
    assert (out / "overlay" / "camera" / f"{masks.frames[0]}.png").is_file()
    # The camera file had the true place: as it was given the robot is seen where it was found.
    errors = {frame: one["E_total"] for frame, one in summary["frames"].items()}
    in_order = sorted(errors, key=lambda frame: -errors[frame])
    given = sorted((out / "overlay_as_given" / "camera").glob("*.png"))
    assert [one.stem for one in given] == sorted({in_order[0], in_order[len(in_order) // 2]})
    picture = cv2.imread(str(given[0]))
    legend = picture[-38:]
    found, shown = (
        cv2.dilate((part == EXCESS_RGB[::-1]).all(axis=2).astype(np.uint8), np.ones((25, 25)))
        for part in (picture[:-38], legend)
    )
    blue = (picture[:-38] == MISSING_RGB[::-1]).all(axis=2)
    assert shown.any()
    assert found[blue].mean() > 0.95
    page = (out / "report.html").read_text()
    assert "from pictures and joint positions" in page
    assert f"Offset {1e3 * summary['time_offset_s']:.1f} ms" in page
    assert "pixels, as given" in page
    again = register_scene(
        out,
        painted.path,
        out / "joint_angles.csv",
        settings=RegistrationSettings(cameras=("camera",)),
    )
    error = pose_error(again.registered["camera"].camera.X_WC, painted.camera.X_WC)
    assert np.linalg.norm(error[3:]) < 0.02


def test_a_folder_of_neither_masks_nor_pictures_is_refused(tmp_path, episode):
    with pytest.raises(DrakePoseError, match=r"cameras\.yaml"):
        register_scene(tmp_path, episode[1].path, tmp_path / "joints.csv")


def audited(episode, tmp_path, *arguments):
    scene, painted = episode
    out = tmp_path / "audit"
    command = ["audit", str(scene), "--model", str(painted.path), "--out", str(out), "--json"]
    result = CliRunner().invoke(app, [*command, *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return json.loads((out / "summary.json").read_text()), out


@pytest.mark.slow
def test_an_audit_of_an_episode_names_its_clock_and_a_camera_that_stands_elsewhere(
    episode, tmp_path
):
    _scene, painted = episode
    summary, out = audited(episode, tmp_path)
    clock = next(one for one in summary["contradictions"] if one["cause"] == "clock")
    assert clock["shift_ms"] == pytest.approx(1e3 * LATE, abs=5.0)
    assert f"{1e3 * LATE:.0f}"[0] in clock["text"]
    assert {one["cause"] for one in summary["contradictions"]} == {"clock"}
    assert summary["agreeing_count"] == summary["frame_count"] == len(painted.times)
    moved = painted.camera.X_WC.copy()
    moved[:3, 3] += [0.15, -0.1, 0.05]
    save_cameras(tmp_path / "moved.yaml", [painted.camera.with_pose(moved)])
    (tmp_path / "again").mkdir()
    summary, out = audited(episode, tmp_path / "again", "--cameras", tmp_path / "moved.yaml")
    camera = next(one for one in summary["contradictions"] if one["cause"] == "camera")
    assert camera["shift_mm"] == pytest.approx(1e3 * np.linalg.norm([0.15, 0.1, 0.05]), abs=15.0)
    assert camera["rivals"] == ["base"]
    assert any((out / "overlay_as_given" / "camera").glob("*.png"))


def test_an_episode_whose_camera_nobody_places_cannot_be_audited(episode, tmp_path):
    scene, painted = episode
    text = yaml.safe_load((scene / "cameras.yaml").read_text())
    del text["camera"]["X_WC"]
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(text))
    with pytest.raises(DrakePoseError, match="no camera has an X_WC that could be audited"):
        audit_scene(scene, painted.path, cameras=tmp_path / "cameras.yaml")
    with pytest.raises(DrakePoseError, match="needs joint positions"):
        audit_scene(tmp_path, painted.path)
