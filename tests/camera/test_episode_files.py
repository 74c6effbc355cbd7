"""Folders of videos or images, and of DROID, and their intrinsics."""

import json

import cv2
import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.camera_files import load_camera_file, save_cameras
from drake_pose.camera.episode import Stream
from drake_pose.camera.episode_files import open_episode, recorded_intrinsics, recorded_pose
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError, SceneError, SettingsError
from tests.camera.recordings import LENS, number_of, numbered, write_video


def write_table(path, kind, stamps):
    rows = [f"{stamp},{0.01 * k},{k}" for k, stamp in enumerate(stamps)]
    path.write_text("\n".join([f"{kind},joint1,grip", *rows]) + "\n")
    return path


def write_images(folder, numbers):
    (folder / "images" / "a").mkdir(parents=True)
    for k in numbers:
        cv2.imwrite(str(folder / "images" / "a" / f"{k}.png"), numbered(k)[:, :, ::-1])
    return folder / "images" / "a"


def test_videos_with_a_faster_joint_log(tmp_path):
    write_video(tmp_path / "videos" / "left.mp4", range(12))
    write_video(tmp_path / "videos" / "right.avi", range(7), codec="mpeg4")
    write_table(tmp_path / "joint_angles.csv", "time", [round(0.02 * k, 3) for k in range(60)])
    (tmp_path / "cameras.yaml").write_text(f"left: {{{LENS}}}\nlost: {{{LENS}}}\n")
    episode = open_episode(tmp_path)
    left, joints = episode.camera("left"), episode.joints
    assert [number_of(left.read(k)) for k in (0, 9, 4)] == [0, 9, 4]
    assert (left.camera.focal_x, left.camera.focal_y, left.link) == (70.0, 75.0, None)
    np.testing.assert_allclose(joints.at(left.times)[:, 1], 5.0 * np.arange(12), rtol=0, atol=1e-9)
    warnings = "\n".join(episode.warnings)
    assert "camera 'lost' of cameras.yaml has no pictures" in warnings
    assert "camera 'right' has no entry in cameras.yaml" in warnings
    with pytest.raises(SettingsError, match=r"--episode 3: .* is a single episode"):
        open_episode(tmp_path, episode=3)
    (tmp_path / "none" / "sub").mkdir(parents=True)
    for name, message in (
        ("joint_angles.csv", "is not an episode: a file of another"), ("gone", "no such folder"),
        ("none", "is not an episode: sub"), ("none/sub", "is not an episode: empty"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=f"{message}.*; expected a LeRobot data set"):
            open_episode(tmp_path / name)


def test_a_late_video_and_clocks_that_do_not_overlap(tmp_path):
    write_video(tmp_path / "videos" / "a.mp4", range(9), 0.2 + 0.1 * np.arange(9))
    table = tmp_path / "joint_angles.csv"
    write_table(table, "time", [round(0.1 * k, 3) for k in range(12)])
    found = open_episode(tmp_path)
    assert not any("clock" in text or "starts" in text for text in found.warnings)
    positions = found.joints.at(found.camera("a").times)[:, 1]
    np.testing.assert_allclose(positions, 2.0 + np.arange(9), rtol=0, atol=1e-6)
    # Seconds since 1970 beside a video's own.
    write_table(table, "time", [f"{1.7e9 + 0.1 * k:.3f}" for k in range(12)])
    found = open_episode(tmp_path)
    assert any("both are counted from their starts" in text for text in found.warnings)
    positions = found.joints.at(found.camera("a").times)[:, 1]
    np.testing.assert_allclose(positions, np.arange(9), rtol=0, atol=1e-5)
    # A table's times of frames precede those of the video.
    rows = [f"{k},{5 + 0.2 * k},{k}" for k in range(8)]
    table.write_text("\n".join(["frame,time,grip", *rows]))
    times = open_episode(tmp_path).camera("a").times
    np.testing.assert_allclose(times, [*(5 + 0.2 * np.arange(8)), np.nan])


def test_images_are_matched_by_frame_or_by_time(tmp_path):
    stamps, table = write_images(tmp_path, [2, 9, 10]) / "timestamps.csv", tmp_path / "other.csv"
    write_table(tmp_path / "joint_angles.csv", "frame", ["010", "2", "9"])
    episode = open_episode(tmp_path)
    one = episode.camera("a")
    assert one.frames == ("2", "9", "10")
    assert [number_of(one.read(k)) for k in range(3)] == [2, 9, 10]
    np.testing.assert_array_equal(episode.joints.of_frames(one.frames)[:, 1], [1.0, 2.0, 0.0])
    warnings = open_episode(tmp_path, joints=write_table(table, "frame", ["2", "9", "11"])).warnings
    told = "1 of 3 pictures have no row in the joint log, and 1 of 3 rows"
    assert any(told in text for text in warnings)
    write_table(table, "time", [0.0, 0.5, 1.0])
    with pytest.raises(SceneError, match=r"rows and pictures both need times .*timestamps\.csv"):
        open_episode(tmp_path, joints=table)
    (tmp_path / "scene.yaml").write_text("frame_rate_hz: 2\n")
    paced = open_episode(tmp_path, joints=table).camera("a")
    np.testing.assert_allclose(paced.times, [0.0, 0.5, 1.0])
    table.write_text("frame,time,joint1\n2,7.5,0\n9,8,\n10,9,1\n")
    both = open_episode(tmp_path, joints=table)
    np.testing.assert_array_equal(both.camera("a").times, [7.5, 8.0, 9.0])
    np.testing.assert_array_equal(both.joints.positions[:, 0], [0.0, np.nan, 1.0])
    stamps.write_text("frame,time\n010,3.5\n9,3.75\n7,4\n")
    timed = open_episode(tmp_path, joints=table)
    np.testing.assert_array_equal(timed.camera("a").times, [3.5, 3.75])
    assert number_of(timed.camera("a").read(0)) == 10
    assert any("2 frames have no picture, or no time" in text for text in timed.warnings)


def test_invalid_joint_tables_are_refused(tmp_path):
    write_images(tmp_path, [1])
    for table, message in (
        ("q,r\n1,2\n", "expected one column 'time'.* has 1 rows of: q, r"),
        ("time,q,q\n1,2,3\n", "expected one column 'time'"),
        ("time,q\n", "has 0 rows of: time, q"),
        ("time,q\n0,1\n1,two\n", "line 3, column 'q': 'two' is not a number"),
        ("time,q\n0,1\n1,1_8\n", "line 3, column 'q': '1_8' is not a number"),
        ("frame,q\n1,0\n01,0\n", "has frame 1 more than once"),
        ("time,q\n3,1\n2,1\n1,1\n", "rows: number 1 .* runs backwards"),
        ("time,q\n" + "".join(f"{k},nan\n" for k in range(9)), "has 9 rows, but no number: q"),
        ("frame,q\n5,1\n", "camera 'a': 1 of 1 pictures have no row .* the same names in both"),
    ):
        (tmp_path / "joint_angles.csv").write_text(table)
        with pytest.raises(SceneError, match=message):
            open_episode(tmp_path)


def test_calibrations_belong_to_their_pictures(tmp_path):
    """Pictures are undistorted by the lens; images take precedence over a video."""
    (write_images(tmp_path, [1, 2]) / "._2.png").write_bytes(b"no picture")
    write_video(tmp_path / "videos" / "a.mp4", range(9))
    D, file = [-0.3, 0.1, 2e-3, -1e-3, 0.02], tmp_path / "cameras.yaml"
    file.write_text(f"a: {{{LENS}, distortion: {D}, link: hand, X_LC: {np.eye(4).tolist()}}}")
    one = open_episode(tmp_path).camera("a")
    assert (one.link, one.frames) == ("hand", ("1", "2"))
    K = np.array([[70.0, 0.0, 31.5], [0.0, 75.0, 30.0], [0.0, 0.0, 1.0]])
    P = [[one.camera.focal_x, 0, one.camera.center_x], [0, one.camera.focal_y, one.camera.center_y]]
    expected = cv2.undistort(numbered(2), K, np.array(D), None, np.array([*P, [0, 0, 1]]))
    np.testing.assert_array_equal(one.read(1), expected)
    # Masks must be of undistorted images.
    with pytest.raises(CameraError, match=r"camera 'a' has distortion.*cv2.undistort"):
        load_camera_file(file)
    for text, message in (
        (f"{LENS}, distortion: [1, 2, 3]", "camera 'a': has 3 distortion coefficients"),
        (LENS.replace("64", "32", 1), "camera 'a': has 32 x 64 pixels .* pictures 64 x 64"),
    ):
        file.write_text(f"a: {{{text}}}")
        with pytest.raises(CameraError, match=message):
            open_episode(tmp_path)


def test_intrinsics_are_scaled_to_each_cameras_pictures(tmp_path):
    sizes = {"left": (160, 120), "right": (320, 240)}
    streams = [Stream(name, *size, np.zeros(1), None, None, None) for name, size in sizes.items()]
    lens = (640, 480, 600.0, 610.0, 319.5, 239.5, np.eye(4))
    save_cameras(tmp_path / "cameras.yaml", [PinholeCamera(name, *lens) for name in sizes])
    found = recorded_intrinsics(streams, tmp_path, None).cameras
    for name, size in sizes.items():
        assert (found[name].width, found[name].height) == size
        assert found[name].focal_x == pytest.approx(600.0 * size[0] / 640)


def test_real_episodes_are_read(shared_data):
    for name, count, rows in (("short", 62, 184), ("cloth", 124, 370)):
        episode = open_episode(shared_data / "droid_episodes" / name)
        assert (episode.warnings, episode.joints.positions.shape) == ((), (rows, 8))
        for one in episode.cameras.values():
            np.testing.assert_allclose(one.times, np.arange(count) / 5.0)
            assert one.camera.focal_y / one.camera.focal_x == pytest.approx(192 / 180, 1e-3)
            logged, expected = episode.joints.at(one.times), episode.joints.positions[::3][:count]
            np.testing.assert_allclose(logged, expected, rtol=0, atol=1e-4)
    stills = open_episode(shared_data / "franka_one_view")
    assert np.isfinite(stills.joints.of_frames(stills.camera("camera").frames)).all()


START, COUNT = 1_691_000_000_123, 10  # [ms]
EACH = 66.7 * np.arange(COUNT)
ANGLES = np.arange(7) + 0.01 * EACH[:, None]
STATE, STAMPS = "observation/robot_state", "observation/timestamp"


def write_episode(folder, **changed):
    """Write a DROID episode: `111` is a hand camera, `222` a stereo camera; datasets may change."""
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


def test_useless_intrinsics_and_stamps_are_named(tmp_path):
    video = write_episode(tmp_path, **{"222_left": np.zeros((COUNT, 3, 3))})
    episode = open_episode(tmp_path)
    assert episode.camera("222_left").camera is None
    assert "camera_intrinsics/222_left is no camera matrix and is ignored" in episode.warnings[-1]
    with h5py.File(tmp_path / "trajectory.h5", "a") as file:
        file["observation/camera_extrinsics/222_right"] = np.zeros((COUNT, 6))
    (text,) = (text for text in open_episode(tmp_path).warnings if "extrinsics" in text)
    assert text.startswith("camera '222_right': its recorded extrinsics are not used, as ")
    assert "trajectory.h5 has no camera_intrinsics/222_right" in text
    for text in ('{"a": [1]}', "{", '["now"]'):
        video.with_name("111_timestamps.json").write_text(text)
        with pytest.raises(SceneError, match=r"111_timestamps\.json: is no list of times \[ms\]"):
            open_episode(tmp_path)


def test_a_recorded_pose_is_the_median_of_rows_as_droid_writes_them():
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
    for odd, told in (
        (np.zeros((3, 5)), "are not x, y, z"), (np.full((3, 6), np.nan), "are not x, y, z"),
        ([[0.0] * 6, [0.004] * 6], ""), ([[0.0] * 6, [0.006] + [0.0] * 5], "vary by 6 mm and 0.0"),
        ([[0.0] * 6, [0.0] * 5 + [0.006]], "vary by 0 mm and 0.3 degrees"),
    ):  # fmt: skip
        said: list[str] = []
        assert (recorded_pose(odd, "eye", said) is None) == told.startswith("are not")
        assert f"camera 'eye': its recorded extrinsics {told}" in said[0] if told else said == []
