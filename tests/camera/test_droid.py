"""DROID's folders, written by h5py and PyAV as its recorder writes them."""

import json

import numpy as np
import pytest

from drake_pose.camera.episode_files import open_episode
from drake_pose.errors import SceneError
from tests.camera.recordings import number_of, write_video

START, COUNT = 1_691_000_000_123, 10  # [ms]
EACH = 66.7 * np.arange(COUNT)
ANGLES = np.arange(7) + 0.01 * EACH[:, None]
STATE, STAMPS = "observation/robot_state", "observation/timestamp"


def write_episode(folder, **changed):
    """`111` is the hand's camera, and `222` a stereo one; datasets may be changed or left out."""
    import h5py

    K = np.array([[520.0, 0.0, 640.0], [0.0, 522.0, 360.0], [0.0, 0.0, 1.0]])
    content = {
        f"{STATE}/joint_positions": ANGLES,
        f"{STATE}/gripper_position": np.linspace(0.0, 1.0, COUNT),
        f"{STAMPS}/robot_state/read_start": START + EACH - 4,
        f"{STAMPS}/robot_state/read_end": START + EACH + 4,
        "observation/camera_intrinsics/222_left": np.tile(K, (COUNT, 1, 1)),
    }
    for serial, kind in (("111", 0), ("222", 1)):
        content[f"{STAMPS}/cameras/{serial}_frame_received"] = START + EACH + 50
        content[f"{STAMPS}/cameras/{serial}_estimated_capture"] = START + EACH + 9
        content[f"observation/camera_type/{serial}"] = np.full(COUNT, kind)
    with h5py.File(folder / "trajectory.h5", "w") as file:
        for name, values in content.items():
            values = changed.get(name.rpartition("/")[2], values)
            if values is not None:
                file[name] = values
    write_video(folder / "recordings" / "MP4" / "222.mp4", range(COUNT), width=256)
    return write_video(folder / "recordings" / "MP4" / "111.mp4", range(COUNT))


def test_cameras_and_joints_are_on_the_recorders_clock(tmp_path):
    write_episode(tmp_path)
    episode = open_episode(tmp_path)
    # 256 x 64 pixels are two pictures side by side.
    assert list(episode.cameras) == ["111", "222_left", "222_right"]
    joints = episode.joints
    assert joints.names == (*(f"joint{k}" for k in range(1, 8)), "gripper_position")
    np.testing.assert_allclose(joints.times, 1e-3 * (START + EACH), rtol=0, atol=1e-6)
    for camera in episode.cameras.values():
        np.testing.assert_allclose(camera.times - joints.times, 0.009, rtol=0, atol=1e-6)
        logged = joints.at(camera.times[:-1])[:, :7] - ANGLES[:-1]
        np.testing.assert_allclose(logged, 0.01 * 9, rtol=0, atol=1e-4)
    assert [number_of(episode.camera("111").read(k)) for k in (0, 7, 3)] == [0, 7, 3]
    left, right = episode.camera("222_left"), episode.camera("222_right")
    whole = np.hstack([left.read(6), right.read(6)])
    assert (whole.shape, number_of(whole), right.camera) == ((64, 256, 3), 6, None)
    assert (left.camera.width, left.camera.height, left.camera.focal_x) == (128, 64, 52.0)
    assert left.camera.focal_y == pytest.approx(522 * 64 / 720)
    assert "camera '111' is the hand's" in "\n".join(episode.warnings)


def test_videos_that_are_longer_than_their_time_stamps(tmp_path):
    video = write_video(write_episode(tmp_path), range(COUNT + 2))
    episode = open_episode(tmp_path)
    assert len(episode.camera("111").times) == COUNT
    text = f"111.mp4: has {COUNT + 2} pictures, but trajectory.h5 {COUNT} times"
    assert text in "\n".join(episode.warnings)
    received = START + 50 + 66.7 * np.arange(COUNT + 2)
    video.with_name("111_timestamps.json").write_text(json.dumps(received.tolist()))
    timed = open_episode(tmp_path)
    assert text.partition(",")[0] not in "\n".join(timed.warnings)
    np.testing.assert_allclose(timed.camera("111").times, 1e-3 * (received - 41), rtol=0, atol=1e-6)


def test_what_is_missing_or_damaged_is_named(tmp_path):
    file, none = tmp_path / "trajectory.h5", {"111_estimated_capture": None}
    for changed, message in (
        (none | {"111_frame_received": None}, r"111\.mp4: has no .*cameras/111_est.* has: 222_est"),
        ({"gripper_position": None}, r"has no .*/gripper_position; /obs.*state has: joint_pos"),
        ({"joint_positions": np.zeros((COUNT - 1, 7))}, "h5: cut short or damaged"),
        ({"read_end": START + 4 - EACH, "read_start": START - 4 - EACH}, "rows: .* backwards"),
    ):
        write_episode(tmp_path, **changed)
        with pytest.raises(SceneError, match=message):
            open_episode(tmp_path)
    write_episode(tmp_path)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(SceneError, match=r"trajectory\.h5: cut short or damaged"):
        open_episode(tmp_path)
    write_episode(tmp_path)
    for video in (tmp_path / "recordings" / "MP4").iterdir():
        video.unlink()
    with pytest.raises(SceneError, match=r"MP4: holds no <serial>\.mp4"):
        open_episode(tmp_path)
