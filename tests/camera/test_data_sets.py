"""LeRobot data sets (2.1, 3.0) and DROID folders, and times and poses as they record them."""

import json

import numpy as np
import pyarrow
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.episode_files import open_episode, recorded_pose
from drake_pose.camera.lerobot_tables import is_picture, row_times
from drake_pose.errors import SceneError, UnknownNameError
from tests.camera.recordings import number_of, png, write_table, write_video

LENGTHS = {0: 8, 1: 6, 2: 9}
TOP, WRIST, DEPTH = (f"observation.images.{name}" for name in ("top", "wrist", "depth"))
V2 = "chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}"
V3 = "{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}"


def write_info(folder, version, template, names):
    features = {
        "observation.state": {"dtype": "float32", "shape": [3], "names": names},
        TOP: {"dtype": "video", "info": {"video.is_depth_map": False}},
        DEPTH: {"dtype": "video", "info": {"video.is_depth_map": True}},
        WRIST: {"dtype": "image"},
        "timestamp": {"dtype": "float32", "shape": [1]},
    }
    paths = {"data_path": f"data/{template}.parquet", "video_path": f"videos/{template}.mp4"}
    counts = {"total_episodes": 3, "chunks_size": 2, "fps": 10}
    content = {"codebase_version": version, "features": features, **paths, **counts}
    (folder / "meta").mkdir()
    (folder / "meta" / "info.json").write_text(json.dumps(content))


def rows_of(*episodes):
    pairs = [(n, k) for n in episodes for k in range(LENGTHS[n])]
    return {
        "observation.state": [[0.1 * k, -1.0, 10.0 * n] for n, k in pairs],
        WRIST: [{"bytes": png(50 + k), "path": None} for _, k in pairs],
        "timestamp": [0.1 * k for _, k in pairs],
        "episode_index": [n for n, _ in pairs],
    }


def write_v21(folder):
    write_info(folder, "v2.1", V2, [["pan", "lift", "grip"]])
    for n, count in LENGTHS.items():
        where = V2.format(episode_chunk=n // 2, video_key=TOP, episode_index=n)
        numbers = [20 * n + k for k in range(count)]
        write_video(folder / "videos" / f"{where}.mp4", numbers, codec="libsvtav1")
        where = V2.format(episode_chunk=n // 2, video_key="", episode_index=n)
        write_table(folder / "data" / f"{where}.parquet", rows_of(n))


def write_v30(folder):
    write_info(folder, "v3.0", V3, {"motors": ["pan", "lift", "grip"]})
    for file, own in enumerate(([0, 1], [2])):
        where = V3.format(chunk_index=0, video_key="", file_index=file)
        write_table(folder / f"data/{where}.parquet", rows_of(*own))
    numbers = [20 * n + k for n, count in LENGTHS.items() for k in range(count)]
    where = V3.format(chunk_index=0, video_key=TOP, file_index=0)
    write_video(folder / f"videos/{where}.mp4", numbers)
    # LeRobot sums rounded durations.
    begin = np.cumsum([0, *LENGTHS.values()]) * 0.1 + 1e-7
    times = {"from_timestamp": begin[:-1], "to_timestamp": begin[1:]}
    meta = {"chunk_index": [0, 0, 0], "file_index": [0, 0, 0], **times}
    table = {"episode_index": [0, 1, 2], "data/chunk_index": [0] * 3, "data/file_index": [0, 0, 1]}
    table |= {f"videos/{TOP}/{name}": values for name, values in meta.items()}
    table |= {"stats/max": [[9.0]] * 3}
    write_table(folder / "meta/episodes/chunk-000/file-000.parquet", table)


@pytest.mark.parametrize("write", [write_v21, write_v30])
def test_episodes_have_their_own_images_and_rows(tmp_path, write):
    write(tmp_path)
    for n, count in LENGTHS.items():
        episode = open_episode(tmp_path, episode=n)
        assert (list(episode.cameras), episode.warnings) == (["top", "wrist"], ())
        top, wrist, joints = episode.camera("top"), episode.camera("wrist"), episode.joints
        for k in (count - 1, *range(count)):
            assert (number_of(top.read(k)), number_of(wrist.read(k))) == (20 * n + k, 50 + k)
        for times in (top.times, wrist.times, joints.times, joints.positions[:, 0]):
            np.testing.assert_allclose(times, 0.1 * np.arange(count), atol=1e-6)
        assert joints.names == ("pan", "lift", "grip")
        assert (joints.positions[:, 2] == 10.0 * n).all()
    with pytest.raises(UnknownNameError, match="has no episode '3'; it has: 0, 1, 2"):
        open_episode(tmp_path, episode=3)
    with pytest.raises(SceneError, match=r"--episode N\); of 3 these are present: 0, 1, 2"):
        open_episode(tmp_path)


def test_a_real_data_set_is_read(shared_data):
    folder = shared_data / "humanoid_head_camera"
    for n, count in ((10, 290), (20, 297)):
        episode = open_episode(folder, episode=n)
        one, joints = episode.camera("cam_high"), episode.joints
        assert (one.width, one.height, len(one.times), episode.warnings) == (640, 480, count, ())
        assert (len(joints.names), joints.names[3]) == (26, "kLeftElbow")
        assert np.abs(joints.times - one.times).max() < 1e-5
        np.testing.assert_array_equal(one.read(200), [one.read(k) for k in (199, 200)][1])
    with pytest.raises(SceneError, match="of 100 these are present: 10, 20"):
        open_episode(folder)


START, COUNT = 1_691_000_000_123, 10  # [ms]
EACH = 66.7 * np.arange(COUNT)
ANGLES = np.arange(7) + 0.01 * EACH[:, None]
STATE, STAMPS = "observation/robot_state", "observation/timestamp"


def write_episode(folder, **changed):
    """Write a DROID episode: `111` is a hand camera, `222` a stereo camera; datasets may change."""
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


def test_cameras_and_joints_share_the_recorders_clock(tmp_path):
    write_episode(tmp_path)
    episode = open_episode(tmp_path)
    # 256 x 64 pixels are a stereo pair side by side.
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
    assert "camera '111' is on the hand" in "\n".join(episode.warnings)


def test_videos_longer_than_their_time_stamps_are_cut(tmp_path):
    video = write_video(write_episode(tmp_path), range(COUNT + 2))
    episode = open_episode(tmp_path)
    assert len(episode.camera("111").times) == COUNT
    text = f"111.mp4: has {COUNT + 2} pictures, but trajectory.h5 has {COUNT} times"
    assert text in "\n".join(episode.warnings)
    received = START + 50 + 66.7 * np.arange(COUNT + 2)
    video.with_name("111_timestamps.json").write_text(json.dumps(received.tolist()))
    timed = open_episode(tmp_path)
    assert text.partition(",")[0] not in "\n".join(timed.warnings)
    np.testing.assert_allclose(timed.camera("111").times, 1e-3 * (received - 41), rtol=0, atol=1e-6)


def test_missing_and_damaged_files_are_named(tmp_path):
    file, none = tmp_path / "trajectory.h5", {"111_estimated_capture": None}
    for changed, message in (
        (none | {"111_frame_received": None}, r"111\.mp4: has no .*cameras/111_est.* has: 222_est"),
        ({"gripper_position": None}, r"has no .*/gripper_position; /obs.*state has: joint_pos"),
        ({"joint_positions": np.zeros((COUNT - 1, 7))}, "h5: truncated or damaged"),
        ({"joint_positions": np.zeros(COUNT)}, r"have the shapes \(10,\), .* but n x 7 and"),
        ({"read_end": START + EACH[1:]}, r"have the shapes .*\(9,\), but"),
        ({"read_end": START + 4 - EACH, "read_start": START - 4 - EACH}, "rows: .* backwards"),
    ):
        write_episode(tmp_path, **changed)
        with pytest.raises(SceneError, match=message):
            open_episode(tmp_path)
    write_episode(tmp_path)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(SceneError, match=r"trajectory\.h5: truncated or damaged"):
        open_episode(tmp_path)
    write_episode(tmp_path)
    for video in (tmp_path / "recordings" / "MP4").iterdir():
        video.unlink()
    with pytest.raises(SceneError, match=r"MP4: has no <serial>\.mp4.* the folder has no record"):
        open_episode(tmp_path)
    (tmp_path / "recordings" / "SVO").mkdir()
    (tmp_path / "recordings" / "SVO" / "111.svo").touch()
    with pytest.raises(SceneError, match=r"MP4: has no .*folder has recordings/SVO/111\.svo"):
        open_episode(tmp_path)


def test_useless_intrinsics_and_stamps_are_named(tmp_path):
    video = write_episode(tmp_path, **{"222_left": np.zeros((COUNT, 3, 3))})
    episode = open_episode(tmp_path)
    assert episode.camera("222_left").camera is None
    assert "camera_intrinsics/222_left is no camera matrix and is ignored" in episode.warnings[-1]
    for text in ('{"a": [1]}', "{", '["now"]'):
        video.with_name("111_timestamps.json").write_text(text)
        with pytest.raises(SceneError, match=r"111_timestamps\.json: is no list of times \[ms\]"):
            open_episode(tmp_path)


def test_extrinsics_without_intrinsics_are_named(tmp_path):
    import h5py

    write_episode(tmp_path)
    with h5py.File(tmp_path / "trajectory.h5", "a") as file:
        file["observation/camera_extrinsics/222_right"] = np.zeros((COUNT, 6))
    texts = [text for text in open_episode(tmp_path).warnings if "extrinsics" in text]
    assert len(texts) == 1
    assert texts[0].startswith("camera '222_right': its recorded extrinsics are not used, as ")
    assert "trajectory.h5 has no camera_intrinsics/222_right" in texts[0]


@pytest.mark.parametrize("stretch", [0.5, 0.75, 1.3, 2.0])
def test_times_at_another_rate_are_used_and_told(stretch) -> None:
    times, warnings = stretch * (3.0 + 0.1 * np.arange(9)), []
    found = row_times(pyarrow.table({"timestamp": times}), 10.0, "a.parquet", warnings)
    np.testing.assert_allclose(found, times)
    (text,) = warnings
    assert f"the rows' times are {0.1 * stretch:.4g} s apart, but at 10 Hz" in text
    assert "would be 0.1 s" in text


def test_colour_images_are_told_from_depth_and_numbers():
    for key, kind, more, found in (
        ("observation.image", ("image", [4, 4, 3]), {}, True),
        ("observation.images.top", ("video", [4, 4, 3]), {}, True),
        ("top", ("uint8", [4, 4, 3]), {}, True),
        ("top", ("uint8", [3, 4, 4]), {}, True),
        ("depth", ("uint16", [4, 4, 1]), {}, False),
        ("depth", ("uint16", [1, 4, 4]), {}, False),
        ("top", ("video", [4, 4, 3]), {"info": {"video.is_depth_map": True}}, False),
        ("top", ("video", [4, 4, 3]), {"info": {"video.is_depth_map": False}}, True),
        ("state", ("float32", [7]), {}, False),
    ):
        assert is_picture(key, {"dtype": kind[0], "shape": kind[1], **more}) == found


def test_a_recorded_pose_is_the_median_of_rows_as_droid_writes_them() -> None:
    """Position, and angles about the fixed axes x, y and z; half a turn is no jump."""
    rng, warnings = np.random.default_rng(2), []
    row = np.array([0.3, -0.2, 0.5, 3.14159, 0.2, -1.1])
    rows = row + 1e-4 * rng.normal(size=(31, 6))
    rows[:, 3] = np.mod(rows[:, 3] + np.pi, 2.0 * np.pi) - np.pi
    assert np.ptp(rows[:, 3]) > 6.0
    found = recorded_pose(rows, "eye", warnings)
    assert found is not None
    assert warnings == []
    turn = np.eye(3)
    for axis, angle in zip("xyz", row[3:], strict=True):
        turn = Rotation.from_euler(axis, angle).as_matrix() @ turn
    np.testing.assert_allclose(found[:3, :3], turn, atol=2e-4)
    np.testing.assert_allclose(found[:3, 3], row[:3], atol=2e-4)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])
    rows[:3] += 0.5
    again = recorded_pose(rows, "eye", warnings)
    np.testing.assert_allclose(again, found, atol=1e-4)
    assert "vary by 500 mm and 28.7 degrees; their median is used" in warnings[0]
    (single,) = [recorded_pose(row, "eye", [])]
    np.testing.assert_allclose(single, found, atol=3e-4)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        (np.zeros((3, 5)), "are not x, y, z"), (np.full((3, 6), np.nan), "are not x, y, z"),
        (np.array([[0.0] * 6, [0.004] * 6]), None),
        (np.array([[0.0] * 6, [0.006] + [0.0] * 5]), "vary by 6 mm and 0.0 degrees"),
        (np.array([[0.0] * 6, [0.0] * 5 + [0.006]]), "vary by 0 mm and 0.3 degrees"),
    ],
)  # fmt: skip
def test_useless_or_moving_poses_are_told(rows, told) -> None:
    warnings: list[str] = []
    found = recorded_pose(rows, "eye", warnings)
    assert (found is None) == (told is not None and "not x" in told)
    assert len(warnings) == (told is not None)
    assert all(f"camera 'eye': its recorded extrinsics {told}" in text for text in warnings)
