"""Episodes whose camera was turned between two pictures, or one of whose cameras is refused."""

from dataclasses import replace
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.camera_files import load_cameras, save_cameras
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration import tracks
from drake_pose.jobs.registration.audit import audit_scene
from drake_pose.jobs.registration.inputs import read_inputs
from drake_pose.jobs.registration.register import register_scene
from drake_pose.jobs.registration.tracks import register_recordings, require_unmoved, watch_cameras
from drake_pose.registration.camera_motion import Nudge, PictureMotion
from drake_pose.registration.recording import Recording
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


@pytest.mark.parametrize("command", [register_scene, audit_scene])
def test_a_nudged_camera_is_refused_with_the_frames_of_each_part(nudged, command, tmp_path):
    scene, painted, _ = nudged
    text = (
        rf"'camera' moved at {painted.times[FIRST]:.2f} s, between pictures 0017 and 0018, .*"
        r"no pose holds .* cameras camera and frames 0000:0017 or frames 0018:0029\."
    )
    with pytest.raises(RegistrationError, match=text):
        command(scene, painted.path, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_every_nudge_is_told_with_its_size_and_every_part_with_its_frames() -> None:
    """Pictures that are taken during a nudge belong to no part."""
    camera = PinholeCamera("eye", 320, 240, 250.0, 350.0, 159.5, 119.5, np.eye(4))
    nudges = Nudge(2, 4, 3.0, 0.1 * np.eye(3)[0]), Nudge(5, 6, 5.0, 0.2 * np.eye(3)[1])
    names, times = tuple(f"p{k}" for k in range(9)), 10.0 + 0.5 * np.arange(9)
    recording = Recording(names, lambda _: np.zeros((9, 1)), lambda _: np.zeros((1, 1, 3)), times)
    said = (
        rf"12\.00 s, .* p2 and p4, .* by 3\.0 .* {np.degrees(0.2):.2f} degrees"
        r".*--frame p0:p2, --frame p4:p5 or --frame p6:p8\."
    )
    with pytest.raises(RegistrationError, match=said):
        require_unmoved(camera, recording, PictureMotion(nudges))


def test_each_camera_is_refused_for_its_own_reason(nudged) -> None:
    scene, painted, _ = nudged
    inputs = read_inputs(scene, painted.path, None, None, RegistrationSettings())
    moved = {f"eye{k}": PictureMotion((Nudge(k, k + 1, 3.0, np.eye(3)[0]),)) for k in (2, 5)}
    one = replace(inputs, recordings=dict.fromkeys(moved, inputs.recordings["camera"]))
    cameras, refused = [replace(painted.camera, name=name) for name in moved], {}
    found = register_recordings(painted.body, replace(one, motions=moved), cameras, refused)
    assert not list(found)
    for k in (2, 5):
        assert f"between pictures 000{k} and 000{k + 1}" in str(refused[f"eye{k}"])


def test_drift_and_shake_are_warned_of_with_their_turns(nudged) -> None:
    scene, painted, _ = nudged
    inputs = read_inputs(scene, painted.path, None, None, RegistrationSettings())
    motion = PictureMotion((), 0.7, 1.3)
    with mock.patch.object(tracks, "find_camera_motion", return_value=motion):
        drift, shake = watch_cameras(inputs).warnings[len(inputs.warnings) :]
    for text, pixels in ((drift, 0.7), (shake, 1.3)):
        angle = np.degrees(pixels / painted.camera.focal_x)
        assert f"by {pixels} pixels, a turn by {angle:.2f} degrees" in text


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
    result = register_scene(scene, painted.path, out=tmp_path / "out")
    (written,) = load_cameras(tmp_path / "out" / "cameras.yaml").values()
    assert written.name == "camera"
    assert np.linalg.norm(pose_error(written.X_WC, painted.camera.X_WC)[3:]) < 0.012
    assert "no pose explains its pictures" in result.summary["refused"]["back"]
    # The entry of a single camera at the top level would look like the whole result.
    assert "X_WC" not in result.summary
    assert "1 refused, see the warnings: back." in (tmp_path / "out/report.html").read_text()
    assert not list((tmp_path / "out").rglob("*back*"))
    summary = audit_scene(scene, painted.path, overlay=False).summary
    (finding,) = (one for one in summary["findings"] if one["what"] == "refused")
    assert finding["text"].startswith("camera 'back': no pose explains its pictures")
    assert [*summary["found_cameras"]] == ["camera"]
