"""Episodes in folders, and checks of a recording's times."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from drake_pose.camera.camera_files import load_camera_file, save_cameras
from drake_pose.camera.episode import Episode, JointLog, Stream, ascending_indices
from drake_pose.camera.episode_files import open_episode, recorded_intrinsics
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError, SceneError, SettingsError, UnknownNameError
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.camera.recordings import GRID, LENS, distorted, number_of, numbered, shade, write_video


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
    with pytest.raises(SceneError, match=r"joint_angles\.csv: is not an episode: a file of anot"):
        open_episode(tmp_path / "joint_angles.csv")


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


def test_logs_in_other_units_or_without_numbers_are_named(tmp_path):
    write_video(tmp_path / "videos" / "a.mp4", range(9))
    table = tmp_path / "joint_angles.csv"
    write_table(table, "time", [100 * k for k in range(9)])
    assert open_episode(tmp_path).warnings[-1].endswith("are its times in ms?")
    table.write_text("\n".join(["time,joint1", *(f"{0.1 * k:.1f},nan" for k in range(9))]))
    with pytest.raises(SceneError, match="has 9 rows, but no number: joint1 are all missing"):
        open_episode(tmp_path)
    table.write_text("\n".join(["time,joint1", "0,nan", *(f"0.{k},1" for k in range(1, 9))]))
    texts = open_episode(tmp_path).warnings
    assert not any("before or after the log" in text for text in texts)


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


def test_scenes_and_episodes_read_a_folder_alike(tmp_path):
    """Images take precedence over a video; hidden files of macOS are ignored."""
    (write_images(tmp_path, [1, 2]) / "._2.png").write_bytes(b"no picture")
    write_video(tmp_path / "videos" / "a.mp4", range(9))
    pose = f"X_WC: {np.eye(4).tolist()}"
    (tmp_path / "cameras.yaml").write_text(f"a: {{{LENS}, {pose}}}")
    scene, one = load_scene(tmp_path, sequence=True), open_episode(tmp_path).camera("a")
    assert scene.frames == one.frames == ("1", "2")
    np.testing.assert_array_equal(scene.read_image("a", "2"), one.read(1))


def test_images_are_undistorted_by_the_lens_model(tmp_path):
    D = (-0.3, 0.1, 2e-3, -1e-3, 0.02)
    file = tmp_path / "cameras.yaml"
    recorded = np.repeat(distorted(D)[:, :, None], 3, axis=2)
    cv2.imwrite(str(write_images(tmp_path, []) / "0.png"), recorded)
    file.write_text(f"a: {{{LENS}, distortion: {[*D]}, link: hand, X_LC: {np.eye(4).tolist()}}}")
    one = open_episode(tmp_path).camera("a")
    lens, found = one.camera, one.read(0)[:, :, 0].astype(int)
    rays = (GRID[:, 0] - [lens.center_x, lens.center_y]) / [lens.focal_x, lens.focal_y]
    assert one.link == "hand"
    assert np.abs(found - recorded[:, :, 0]).max() > 8
    assert np.abs(found - shade(rays))[2:-2, 2:-2].max() < 3
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
        ("frame,q\n5,1\n", "camera 'a': 1 of 1 pictures have no row .* the same names in both"),
    ):
        (tmp_path / "joint_angles.csv").write_text(table)
        with pytest.raises(SceneError, match=message):
            open_episode(tmp_path)


def test_other_folders_are_refused(tmp_path):
    (tmp_path / "nothing").mkdir()
    (tmp_path / "notes.txt").touch()
    for name, message in ((".", "notes.txt, nothing"), ("nothing", "empty"), ("gone", "no such")):
        with pytest.raises(SceneError, match=rf"{message}.*; expected a LeRobot data set"):
            open_episode(tmp_path / name)


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


TIMES = 0.1 * np.arange(20)


def log(times):
    return JointLog(("x", "y"), times, np.column_stack([2.0 * times, np.sin(times)]))


def episode(times, joints):
    one = Stream("a", 4, 3, times, None, None, lambda k: np.zeros((3, 4 + k, 3), np.uint8))
    return Episode.checked(Path("here"), [one], joints)


def test_positions_are_interpolated_within_the_log():
    times = np.array([-0.06, -0.04, 0.0, 0.05, 1.84, 1.9, 1.94, 1.96, np.nan])
    found = log(TIMES).at(times)
    expected = [np.nan, 0.0, 0.0, 0.1, 3.68, 3.8, 3.8, np.nan, np.nan]
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-12)
    assert found[3, 1] == pytest.approx(0.5 * np.sin(0.1))
    # A missing reading leaves a gap up to its neighbours.
    broken = log(TIMES)
    broken.positions[3, 0] = np.nan
    assert np.isnan(broken.at(np.array([0.2, 0.25, 0.35, 0.4]))[:, 0]).tolist() == [0, 1, 1, 0]
    one = JointLog(("x",), np.array([2.0]), np.array([[7.0]]))
    np.testing.assert_array_equal(one.at(np.array([1.99, 2.0]))[:, 0], [np.nan, 7.0])


def test_frames_match_by_name_or_number():
    rows = JointLog(("x",), None, np.array([[1.0], [2.0], [3.0]]), ("7", "last", "12.0"))
    found = rows.of_frames(["0012", "007", "last", "8"])
    np.testing.assert_array_equal(found[:, 0], [3.0, 1.0, 2.0, np.nan])
    with pytest.raises(SceneError, match="frames, but no times"):
        rows.at(TIMES)
    with pytest.raises(SceneError, match="but no frames"):
        log(TIMES).of_frames(["7"])


def test_time_stamps_out_of_order_are_dropped_or_refused():
    times = TIMES.copy()
    times[5], times[7] = times[4], 0.05
    kept, warnings = ascending_indices(times, "the log")
    np.testing.assert_array_equal(kept, np.delete(np.arange(20), [5, 7]))
    assert "number 5" in warnings[0]
    assert "2 of 20 are left out" in warnings[0]
    times[8:] -= 0.6
    with pytest.raises(SceneError, match=r"the log: number 5 .* runs backwards or stands still"):
        ascending_indices(times, "the log")
    with pytest.raises(SceneError, match="the log: is empty"):
        ascending_indices(np.zeros(0), "the log")


def test_anomalies_of_times_are_warned_of():
    broken = log(TIMES)
    broken.positions[[3, 9], 1] = np.nan, np.inf
    for times, joints, expected in (
        (TIMES[2:-2] + 0.013, log(TIMES), None),
        (TIMES + 1.71, log(TIMES), "17 of 20 pictures are before or after the log (1.710 to"),
        (1e3 * TIMES, log(TIMES), "s): are the pictures' times in ms?"),
        (TIMES[:14], log(TIMES), "camera 'a': its pictures cover only a part of the log"),
        (TIMES + 1.7e9, log(TIMES), "camera 'a': its clock differs from the joint log's: no pict"),
        (np.delete(TIMES, [4, 5, 11]), log(TIMES), "camera 'a': 2 of 16 steps are longer than 1.5"),
        (TIMES, log(np.delete(TIMES, [4, 5])), "the joint log: 1 of 17 steps"),
        (TIMES[:1], log(TIMES), "camera 'a': has one picture only"),
        (TIMES, broken, "'y' is not a number in 2 of 20 rows, first in row 3"),
        (TIMES, None, "here: has no joint positions"),
    ):
        warnings = episode(times, joints).warnings
        assert expected in warnings[0] if expected else warnings == ()


def test_unusable_episodes_are_refused():
    good, empty = episode(TIMES, None), JointLog((), TIMES, np.zeros((20, 0)))
    for make, message in (
        (lambda: Episode.checked(Path("here"), [], log(TIMES), ["because"]),
         "here: has no camera's pictures: because"),
        (lambda: episode(TIMES, empty), "has no row"),
        (lambda: episode(np.full(3, np.nan), log(TIMES)), r"cannot match .* 'a'.*timestamps\.csv"),
        (lambda: good.camera("a").read(20), "camera 'a' has no picture 20, but 0 to 19"),
        (lambda: good.camera("a").read(1), "picture 1: has 5 x 3 pixels .* the first one 4 x 3"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=message):
            make()
    with pytest.raises(UnknownNameError, match="here has no camera 'c'; it has: a"):
        good.camera("c")


def test_intrinsics_are_scaled_to_each_cameras_pictures(tmp_path):
    sizes = {"left": (160, 120), "right": (320, 240)}
    streams = [Stream(name, *size, TIMES, None, None, None) for name, size in sizes.items()]
    lens = (640, 480, 600.0, 610.0, 319.5, 239.5, np.eye(4))
    save_cameras(tmp_path / "cameras.yaml", [PinholeCamera(name, *lens) for name in sizes])
    found = recorded_intrinsics(streams, tmp_path, None).cameras
    for name, size in sizes.items():
        assert (found[name].width, found[name].height) == size
        assert found[name].focal_x == pytest.approx(600.0 * size[0] / 640)
