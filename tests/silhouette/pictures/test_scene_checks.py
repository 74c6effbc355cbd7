"""Warnings and errors about the files of a scene."""

import re
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import ParallelCamera, circle_of_cameras
from drake_pose.errors import MaskError, SceneError
from drake_pose.silhouette.pictures.scene_checks import (
    check_scene,
    check_upright,
    frame_ranges,
    leave_out_unreadable,
    read_mask_of,
    read_scene,
    require_readable,
)
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.camera.recordings import write_film
from tests.written_files import write_mask

NAMES = ("left", "middle", "right")


def square(at, part=np.s_[10:30]):
    """A square of 20 pixels whose left edge is at column 5 + at."""
    mask = np.zeros((40, 60), dtype=bool)
    mask[part, 5 + at : 25 + at] = True
    return mask


def record(folder, frames, still=(), step=2):
    """Masks of a square that moves by ``step``; cameras in ``still`` freeze from frame 3 on."""
    cameras = [ParallelCamera(n, 60, 40, 10.0, 30.0, 20.0, np.eye(4)) for n in NAMES]
    save_cameras(folder / "cameras.yaml", cameras)
    (folder / "scene.yaml").write_text("sequence: true\n")
    for name in NAMES:
        (folder / "masks" / name).mkdir(parents=True, exist_ok=True)
        for k, frame in enumerate(frames):
            mask = square(step * (min(k, 2) if name in still else k))
            write_mask(folder / "masks" / name / f"{frame}.png", mask)
    return load_scene(folder)


def film(folder, rate, count=60, **changed):
    """Grey videos for every camera; ``changed``: rate and count of single cameras."""
    for name in NAMES:
        own_rate, own_count = changed.get(name, (rate, count))
        pictures = [np.full((40, 60), k) for k in range(own_count)]
        write_film(folder / "videos" / f"{name}.avi", pictures, own_rate)


def test_videos_of_different_rates_or_lengths_are_reported(tmp_path):
    record(tmp_path, ["000000"])
    film(tmp_path, 30.0)
    assert check_scene(load_scene(tmp_path)).warnings == ()
    film(tmp_path, 29.8, 200, left=(30.0, 200))
    (drift,) = check_scene(load_scene(tmp_path)).warnings
    assert "has 29.8 pictures a second" in drift
    assert "they are 1 pictures apart" in drift
    film(tmp_path, 30.0, middle=(25.0, 60))
    words = r"middle\.avi has 25 pictures a second, .* 30: .*12 pictures apart.*-r RATE"
    with pytest.raises(SceneError, match=words):
        load_scene(tmp_path)
    film(tmp_path, 30.0, middle=(30.0, 45))
    (text,) = check_scene(load_scene(tmp_path)).warnings
    assert "'middle' has 45 of 60 frames; it lacks 000045-000059" in text
    video = tmp_path / "videos" / "left.avi"
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    texts = check_scene(load_scene(tmp_path)).warnings
    assert re.search(r"left\.avi: is truncated: it ends after \d+ of 60 pictures", texts[0])


FROZEN = "shows its last picture again"


@pytest.mark.parametrize(
    ("frames", "still", "step", "left_out", "words"),
    [
        # Natural order: 9 before 10.
        ("8 9 10 11 12", (), 2, (), None),
        ("1 2 3 4 5", ("middle",), 2, "45", f"'middle' {FROZEN} in frame 4-5"),
        ("1 2 3 4", NAMES, 2, (), "frame 4: all cameras show the previous frame again"),
        ("1 2 3 4 5", ("left", "right"), 2, (), None),
        ("1 2 3", (), 0, (), "frame 2-3: all cameras show the previous frame again"),
        ("f_02 f_04 f_06 f_12 f_14", (), 2, (), "2 frames dropped by all cameras, the first "
         "between f_06 and f_12"),
        ("1 2 3 5 7 9", (), 2, (), None),
        ("1 5", (), 2, (), None),
        ("a1 b2 b9", (), 2, (), None),
        ("2 4 6 9", (), 2, (), None),
        ("1a 2a 9a", (), 2, (), None),
    ],
)  # fmt: skip
def test_faults_of_a_sequence_are_reported(tmp_path, frames, still, step, left_out, words):
    scene = record(tmp_path, frames.split(), still, step)
    assert " ".join(scene.frames) == frames
    checked = check_scene(scene)
    assert len(checked.warnings) == (words is not None)
    assert words is None or words in checked.warnings[0]
    assert scene.masks.keys() - checked.masks.keys() == {("middle", frame) for frame in left_out}
    assert check_scene(replace(scene, sequence=False)).warnings == ()
    lone = scene.of_cameras(["middle"])
    assert (FROZEN in "".join(check_scene(lone).warnings)) is False


@pytest.mark.parametrize(("step", "frozen"), [(2, True), (0, False)])
def test_a_camera_is_frozen_only_while_the_others_move(tmp_path, step, frozen):
    """By more than 2 % of their silhouettes; else the body stood still, too."""
    scene = record(tmp_path, "12345", ("middle",))
    for name in ("left", "right"):
        for k, frame in enumerate("12345"):
            mask = square(step * k)
            # A pixel of noise: the files differ.
            mask[0, k] = True
            write_mask(scene.masks[name, frame], mask)
    checked = check_scene(load_scene(tmp_path))
    assert (f"'middle' {FROZEN}" in " ".join(checked.warnings)) == frozen


def test_a_checked_scene_has_the_wanted_cameras_and_frames(tmp_path):
    record(tmp_path, "1234")
    (tmp_path / "masks" / "left" / "4.png").unlink()
    scene, frames = read_scene(tmp_path, ["left"], ["1:3"], None, 2)
    assert (frames, [*scene.cameras], scene.sequence) == (("1", "3"), ["left"], True)
    (text,) = scene.warnings
    assert "camera 'left' has 3 of 4 frames; it lacks 4" in text
    (tmp_path / "scene.yaml").unlink()
    assert not read_scene(tmp_path, [], [], None, 1)[0].sequence
    assert read_scene(tmp_path, [], [], None, 1, sequence=True)[0].sequence
    unknown = replace(scene, scale_unknown=True)
    assert check_scene(unknown) is unknown


def test_unreadable_masks_are_left_out_if_others_have_the_frame(tmp_path):
    record(tmp_path, ["1", "2", "3"])
    for frame in ("2", "3"):
        (tmp_path / "masks" / "left" / f"{frame}.png").write_bytes(b"")
    (tmp_path / "masks" / "right" / "3.png").unlink()
    (tmp_path / "masks" / "right" / "3.png").symlink_to("nowhere.png")
    scene = load_scene(tmp_path)
    checked = leave_out_unreadable(scene, scene.frames)
    left, right = checked.warnings
    assert left.startswith("frame 2-3 without camera 'left'")
    assert right.startswith("frame 3 without camera 'right'")
    assert checked.cameras_of("3") == ("middle",)
    assert leave_out_unreadable(scene, ["1"]).masks == scene.masks
    with pytest.raises(MaskError, match=r"left/3\.png"):
        leave_out_unreadable(scene.of_cameras(("left", "right")), scene.frames)
    refused = dict.fromkeys(scene.masks, "this file")
    with pytest.raises(SceneError, match="none of 9 masks can be used: this file"):
        require_readable(refused, scene)
    del refused["left", "1"]
    require_readable(refused, scene)
    require_readable({}, replace(scene, masks={}))


@pytest.mark.parametrize(
    ("turn", "name"),
    [((180, 0, 0), "-z"), ((0, 90, 0), "+x"), ((-90, 0, 0), "+y"), ((90, 0, 0), "-y")],
)
def test_world_with_wrong_up_axis_is_reported(turn, name):
    cameras = [*circle_of_cameras(4, size=(160, 120), face_camera=False).values()]
    assert check_upright(cameras) == ()
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    (warning,) = check_upright([camera.with_pose(X @ camera.X_WC) for camera in cameras])
    assert f"is the world's {name}," in warning
    # Up in the picture of a camera that looks straight down is y; opposite cameras' ups cancel.
    assert check_upright([ParallelCamera("top", 9, 9, 1.0, 4.0, 4.0, np.diag([1, -1, -1, 1]))])
    down = np.eye(4)
    down[:3, :3] = Rotation.from_rotvec([0.25 * np.pi, 0, 0]).as_matrix() @ np.diag([1, -1, -1])
    two = [down, np.diag([-1, -1, 1, 1]) @ down]
    assert check_upright([ParallelCamera("c", 9, 9, 1.0, 4.0, 4.0, X) for X in two]) == ()


def test_consecutive_frames_become_ranges():
    known = [f"{k:02d}" for k in range(40)]
    assert frame_ranges(["03", "02", "07", "04"], known) == "02-04, 07"
    assert frame_ranges(known[::3], known) == "00, 03, 06, 09, 12, 15 and 8 more"
    assert frame_ranges([], known) == ""


def test_masks_that_fill_picture_and_edge_are_inverted(tmp_path):
    """More than half of the picture and more than three quarters of its edge."""
    frame = np.ones((40, 60), bool)
    frame[6:34, 6:54] = False
    parts = (np.s_[:, 2:], "97 %"), (np.s_[:, 4:], "93 %"), (np.s_[:, 6:], None)
    cases = [(square(0, part=rows) | False, None) for rows in (np.s_[:], np.s_[5:])]
    for part, told in parts:
        mask = np.zeros((40, 60), bool)
        mask[part] = True
        cases.append((mask, told))
    # White along the edge alone, and nowhere.
    cases += [(frame, None), (frame & False, None)]
    scene = record(tmp_path, "1")
    for mask, told in cases:
        write_mask(scene.masks["left", "1"], mask)
        fresh = load_scene(tmp_path)
        with nullcontext() if told is None else pytest.raises(MaskError, match=told):
            found = read_mask_of(fresh, "left", "1", may_be_empty=True)
            np.testing.assert_array_equal(found, mask)
    with pytest.raises(MaskError, match="empty"):
        read_mask_of(load_scene(tmp_path), "left", "1", may_be_empty=False)
