"""Estimates of recorded episodes: pictures and a joint log, no masks."""

import numpy as np
import pytest

from drake_pose.camera.camera_files import save_cameras
from drake_pose.errors import CameraError, SceneError, UnknownNameError
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.scene import estimate_scene
from tests.jobs.scenes import edit_camera
from tests.registration.episodes import painted_episode
from tests.registration.recordings import write_episode


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    folder = tmp_path_factory.mktemp("episode")
    painted = painted_episode(folder, frames=6, size=(320, 240), every=0.1)
    write_episode(folder / "scene", painted)
    return folder / "scene", painted


def test_an_arm_is_followed_from_where_its_log_begins(episode):
    scene, painted = episode
    result = estimate_scene(scene, painted.path)
    assert list(result.records) == [f"{k:04d}" for k in range(6)]
    off = np.array([list(one.joint_errors.values()) for one in result.records.values()])
    assert off.shape == painted.values.shape
    # The boxes' tip turns about its own axis.
    assert np.median(np.abs(off[:, :3])) < 1.0
    assert np.abs(off[:, :3]).max() < 4.0


def test_frames_are_chosen_and_truth_is_of_the_same_moments(episode):
    scene, painted = episode
    result = estimate_scene(scene, painted.path, settings=EstimateSettings(every=2))
    assert list(result.records) == ["0000", "0002", "0004"]
    for k, record in zip((0, 2, 4), result.records.values(), strict=True):
        truth = record.q - np.radians(list(record.joint_errors.values()))
        np.testing.assert_allclose(truth, painted.values[k], atol=5e-3)


def test_cameras_of_another_file_are_taken(episode, tmp_path):
    scene, painted = episode
    nowhere = edit_camera(scene / "cameras.yaml", "camera", tmp_path / "nowhere.yaml", X_WC=None)
    with pytest.raises(SceneError, match="nobody says where a camera stands; find out"):
        estimate_scene(scene, painted.path, cameras=nowhere)
    save_cameras(tmp_path / "small.yaml", [painted.camera.resized(160, 120)])
    with pytest.raises(CameraError, match="has 160 x 120 pixels"):
        estimate_scene(scene, painted.path, cameras=tmp_path / "small.yaml")
    with pytest.raises(UnknownNameError, match="no camera 'left'"):
        estimate_scene(scene, painted.path, settings=EstimateSettings(cameras=("left",)))
