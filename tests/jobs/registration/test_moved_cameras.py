"""Episodes whose camera was turned between two pictures, or one of whose cameras is refused."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.camera.camera_files import load_cameras, save_cameras
from drake_pose.camera.models import PinholeCamera
from drake_pose.jobs.registration.audit import audit_scene
from drake_pose.jobs.registration.moved_cameras import _parts, motion_warnings
from drake_pose.jobs.registration.register import register_scene
from drake_pose.registration.camera_motion import Nudge, PictureMotion
from drake_pose.registration.recording import Recording
from tests.benchmarks.registration import pose_error
from tests.cli import run_to_end
from tests.jobs.scenes import read_rows
from tests.registration.episodes import PaintedEpisode, painted_episode
from tests.registration.recordings import write_episode

FIRST, DEGREES = 18, 2.0
"""Index of the first picture after the turn, and its angle."""


@pytest.fixture(scope="module")
def nudged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PaintedEpisode, np.ndarray]:
    """A folder of pictures, the painted episode, and the camera's rotation in its own frame."""
    folder = tmp_path_factory.mktemp("nudged")
    painted = painted_episode(folder, frames=30, size=(320, 240), every=0.2)
    R = Rotation.from_rotvec(np.radians(DEGREES) * np.array([0.6, 0.8, 0.0])).as_matrix()
    focal, centre = painted.camera.focal_x, (painted.camera.center_x, painted.camera.center_y)
    K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    # The view of a camera that only turned is a homography of the view before.
    view = K @ R.T @ np.linalg.inv(K)
    turned = [
        cv2.warpPerspective(one, view, (320, 240), borderMode=cv2.BORDER_REFLECT)
        for one in painted.pictures[FIRST:]
    ]
    pictures = np.concatenate([painted.pictures[:FIRST], turned])
    write_episode(folder / "scene", replace(painted, pictures=pictures))
    return folder / "scene", painted, R


def test_parts_of_a_recording_are_two_cameras(nudged, tmp_path):
    scene, painted, R = nudged
    out = tmp_path / "out"
    found = register_scene(scene, painted.path, out=out, overlay=False)
    (text,) = [one for one in found.warnings if "moved" in one]
    assert text.startswith(f"camera 'camera' moved at {painted.times[FIRST]:.2f} s, between")
    written = yaml.safe_load((out / "cameras.yaml").read_text())
    spans = {
        name: [one[key] for key in ("part_of", "from", "until")] for name, one in written.items()
    }
    times = painted.times
    assert spans == {
        "camera": ["camera", times[0], times[FIRST - 1]],
        "camera_2": ["camera", times[FIRST], times[-1]],
    }
    true = {"camera": painted.camera.X_WC, "camera_2": painted.camera.X_WC.copy()}
    true["camera_2"][:3, :3] @= R
    for name, camera in load_cameras(out / "cameras.yaml").items():
        error = pose_error(camera.X_WC, true[name])
        assert np.degrees(np.linalg.norm(error[:3])) < 0.5
        assert np.linalg.norm(error[3:]) < 0.015
        assert (np.abs(error) < 4.0 * np.sqrt(np.diag(found.registered[name].covariance))).all()
    # One clock, and every picture is in one part only.
    parts = found.summary["cameras"]
    assert parts["camera"]["time_offset_s"] == parts["camera_2"]["time_offset_s"]
    assert not {*parts["camera"]["frames"]} & {*parts["camera_2"]["frames"]}


@pytest.mark.slow
def test_an_audit_tells_when_and_how_far_a_camera_was_moved(nudged):
    scene, painted, _ = nudged
    audit = audit_scene(scene, painted.path)
    (moved,) = [one for one in audit.summary["findings"] if one["what"] == "moved"]
    assert moved["name"] == "camera"
    assert f"'camera' moved at {painted.times[FIRST]:.2f} s by" in moved["text"]
    assert moved["angle_deg"] == pytest.approx(DEGREES, abs=4.0 * moved["angle_sd_deg"])


def moving(times: np.ndarray | None) -> tuple[Recording, PictureMotion]:
    """Return a recording of nine pictures, and two nudges of its camera."""
    names = tuple(f"{k}" for k in range(9))
    recording = Recording(names, lambda _: np.zeros((9, 1)), lambda _: np.zeros((1, 1, 3)), times)
    turns = np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]])
    nudges = (Nudge(2, 4, 3.0, turns[0]), Nudge(5, 6, 5.0, turns[1]))
    return recording, PictureMotion(nudges, 0.7, 1.3)


def test_parts_lie_between_nudges_with_the_cameras_rotations() -> None:
    """Pictures taken during a nudge belong to no part; names that are taken are left out."""
    times = 10.0 + 0.5 * np.arange(9)
    recording, motion = moving(times)
    found = _parts("eye", recording, motion, {"eye", "eye_2"})
    assert [*found] == ["eye", "eye_3", "eye_4"]
    first, second, third = found.values()
    assert [one.pictures for one in found.values()] == [slice(0, 3), slice(4, 6), slice(6, 9)]
    assert [(one.since, one.until) for one in found.values()] == [
        (10.0, 11.0), (12.0, 12.5), (13.0, 14.0)
    ]  # fmt: skip
    np.testing.assert_array_equal(first.rotation, np.eye(3))
    # The background's directions turn against the camera.
    back = [Rotation.from_rotvec(-one.rotation).as_matrix() for one in motion.nudges]
    np.testing.assert_allclose(second.rotation, back[0])
    np.testing.assert_allclose(third.rotation, back[0] @ back[1])
    assert {(one.of, one.is_whole, one.drift, one.shake) for one in found.values()} == {
        ("eye", False, 0.7, 1.3)
    }
    untimed, _ = moving(None)
    (whole,) = _parts("eye", untimed, PictureMotion(()), ()).values()
    assert (whole.is_whole, whole.since, whole.pictures) == (True, None, slice(0, 9))


def test_motions_are_told_with_their_time_and_angle() -> None:
    camera = PinholeCamera("eye", 320, 240, 250.0, 350.0, 159.5, 119.5, np.eye(4))
    recording, motion = moving(10.0 + 0.5 * np.arange(9))
    first, second, drift, shake = motion_warnings(camera, recording, motion)
    assert "'eye' moved at 12.00 s, between pictures 2 and 4" in first
    assert "shifted by 3.0 pixels, as by a turn of 5.73 degrees" in first
    assert "at 13.00 s" in second
    # A pixel is a three hundredth of a radian.
    assert f"0.7 pixels, a turn by {np.degrees(0.7 / 300.0):.2f} degrees" in drift
    assert f"1.3 pixels, a turn by {np.degrees(1.3 / 300.0):.2f} degrees" in shake
    untimed, _ = moving(None)
    assert "'eye' moved between pictures 2 and 4" in motion_warnings(camera, untimed, motion)[0]
    assert motion_warnings(camera, recording, PictureMotion(())) == []


@pytest.fixture(scope="module")
def half_wrong(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PaintedEpisode]:
    """An episode of cameras 'back' and 'camera', whose pictures of 'back' are in reversed order."""
    folder = tmp_path_factory.mktemp("half_wrong")
    painted = painted_episode(folder)
    write_episode(folder / "scene", painted)
    reversed_pictures = replace(painted, pictures=painted.pictures[::-1])
    write_episode(folder / "other", reversed_pictures)
    (folder / "other/images/camera").rename(folder / "scene/images/back")
    cameras = [replace(painted.camera, name=name) for name in ("back", "camera")]
    save_cameras(folder / "scene/cameras.yaml", cameras)
    return folder / "scene", painted


@pytest.mark.slow
def test_an_accepted_camera_is_written_without_a_refused_one(half_wrong, tmp_path):
    scene, painted = half_wrong
    out = tmp_path / "out"
    words = ["register", scene, "--model", painted.path, "--out", out, "--export", "ros"]
    said = run_to_end(*words, status=1).stderr
    assert "warning: left out: camera 'back': no pose explains its pictures" in said
    assert "error: 1 of 2 cameras refused: back" in said
    (written,) = load_cameras(out / "cameras.yaml").values()
    assert written.name == "camera"
    error = pose_error(written.X_WC, painted.camera.X_WC)
    assert np.linalg.norm(error[3:]) < 0.012
    summary = json.loads((out / "summary.json").read_text())
    assert "no pose explains its pictures" in summary["refused"]["back"]
    assert [*summary["cameras"]] == ["camera"]
    # The entry of a single camera at the top level would look like the whole result.
    assert "X_WC" not in summary
    assert "1 refused, see the warnings: back." in (out / "report.html").read_text()
    files = [one.relative_to(out).as_posix() for one in out.rglob("*")]
    assert not [one for one in files if "back" in one]


@pytest.mark.slow
def test_audits_and_their_batch_name_a_refused_camera(half_wrong, tmp_path):
    scene, painted = half_wrong
    words = ["audit", scene, "--model", painted.path, "--out", tmp_path / "audit", "--no-overlay"]
    said = run_to_end(*words, status=1).stderr
    assert "error: 1 of 2 cameras refused: back" in said
    summary = json.loads((tmp_path / "audit/summary.json").read_text())
    (finding,) = [one for one in summary["findings"] if one["what"] == "refused"]
    assert finding["name"] == "back"
    assert finding["text"].startswith("camera 'back': no pose explains its pictures")
    assert [*summary["found_cameras"]] == ["camera"]
    jobs = tmp_path / "jobs.yaml"
    entry = {"scene": str(scene), "model": str(painted.path), "audit": True, "overlay": False}
    jobs.write_text(json.dumps({"scenes": {"both": entry}}))
    run_to_end("batch", jobs, "--out", tmp_path / "all", "--workers", "0")
    named = [(row["scene"], row["what"], row["name"])
             for row in read_rows(tmp_path / "all/findings.csv")]  # fmt: skip
    assert ("both", "refused", "back") in named
    rows = read_rows(tmp_path / "all/episodes.csv")
    assert [(row["scene"], row["camera"]) for row in rows] == [("both", "camera")]


@pytest.mark.slow
def test_an_episode_without_an_accepted_camera_is_refused(half_wrong, tmp_path):
    scene, painted = half_wrong
    out = tmp_path / "out"
    words = ["register", scene, "--model", painted.path, "--out", out, "--camera", "back"]
    assert "error: camera 'back': no pose" in run_to_end(*words, status=1).stderr
    assert not out.exists()
