"""Episodes whose camera was turned between two pictures."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.camera.camera_files import load_cameras
from drake_pose.jobs.registration.audit import audit_scene
from drake_pose.jobs.registration.register import register_scene
from tests.benchmarks.registration import pose_error
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
