"""Sources of masks: which pictures, videos and annotations belong to which camera and frame."""

import shutil

import numpy as np
import pytest

from drake_pose import MaskSettings, load_scene, make_masks
from drake_pose.errors import CameraError, SceneError
from drake_pose.jobs.mask_sources import open_source
from tests.camera.recordings import numbered, write_film
from tests.camera.test_lerobot import LENGTHS, write_shared_files
from tests.jobs.masks.rooms import box, save, save_rig, square, write_coco, write_masks

AREA = [(3, box(10))]


def annotated(path, camera_file=None):
    """Return the frames of each camera of a source of annotations."""
    source = open_source(path, camera_file, None)
    return {name: [*own] for name, own in source.annotated_pictures().items()}


@pytest.mark.parametrize(
    ("paths", "without", "with_cameras"),
    [
        # By the last folder that is a camera.
        (("front/9.jpg", "side/10.jpg"), {"front": ["9"], "side": ["10"]}, None),
        (
            ("side/a/x.jpg", "front/b/x.jpg"),
            {"a": ["x"], "b": ["x"]},
            {"side": ["x"], "front": ["x"]},
        ),
        # By the names of the pictures, in natural order.
        (
            ("front_10.jpg", "front_9.jpg", "side-2.jpg"),
            {"": ["front_9", "front_10", "side-2"]},
            {"front": ["9", "10"], "side": ["2"]},
        ),
        (("a/10.jpg", "a/9.jpg"), {"": ["9", "10"]}, "no folder of its path is a camera"),
        (("a/0.jpg", "b/a/0.png"), "has frame 0 twice", "no folder of its path"),
        (("front/0.jpg", "front/0.png"), "has frame 0 twice", "has frame 0 twice"),
        (("a/0.jpg", "1.jpg"), "no folder of its path is a camera; the", "front, side"),
    ],
)
def test_pictures_of_a_coco_file_belong_to_cameras(tmp_path, paths, without, with_cameras):
    file = write_coco(tmp_path / "a.json", dict.fromkeys(paths, AREA))
    rig = save_rig(tmp_path / "cameras.yaml")
    for camera_file, expected in ((None, without), (rig, with_cameras or without)):
        if isinstance(expected, str):
            with pytest.raises(SceneError, match=expected):
                annotated(file, camera_file)
        else:
            assert annotated(file, camera_file) == expected


def test_folders_with_coco_files_are_cameras(tmp_path):
    """Unless the folder is a part of a data set; of an only camera are all pictures."""
    for folder in ("left", "right"):
        write_coco(tmp_path / "a" / folder / "a.json", {"x/0.jpg": AREA})
    assert annotated(tmp_path / "a") == {"left": ["0"], "right": ["0"]}
    for k, folder in enumerate(("train", "valid")):
        write_coco(tmp_path / "b" / folder / "a.json", {f"{k}.jpg": AREA})
    assert annotated(tmp_path / "b") == {"": ["0", "1"]}
    alone = save_rig(tmp_path / "alone.yaml", ["front"])
    assert annotated(tmp_path / "b", alone) == {"front": ["0", "1"]}
    rig = save_rig(tmp_path / "rig.yaml", ["left", "right"])
    assert annotated(tmp_path / "a", rig) == {"left": ["0"], "right": ["0"]}


@pytest.mark.parametrize("name", ["result.json", "annotations/default.json", "train/_coco.json"])
def test_exported_folders_are_sources(tmp_path, name):
    """COCO files beside or before the pictures take precedence; other JSON files are no source."""
    is_part = name.startswith("train")
    save(tmp_path / ("train" if is_part else "images/default") / "0.png", numbered(0))
    (tmp_path / ("notes.txt" if is_part else "notes.json")).write_text("{}")
    (tmp_path / ".hidden").mkdir()
    write_coco(tmp_path / ".hidden" / "a.json", {"h.jpg": AREA})
    write_coco(tmp_path / name, {"front/0.jpg": AREA, "side/0.jpg": AREA})
    assert annotated(tmp_path) == {"front": ["0"], "side": ["0"]}


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ("images/a/0 images/b/1 masks/c/0", {"a": ["0"], "b": ["1"]}),
        ("a/0 b/2 .c/0 overlay/0 background/0", {"a": ["0"], "b": ["2"]}),
        ("0 1", {"": ["0", "1"]}),
        ("masks/0", {"": ["0"]}),
        ("0 a/0", "move them into a camera's folder"),
        ("images/0 images/b/0", "move them into a camera's folder"),
        ("annotations/0", "has no pictures"),
    ],
)
def test_folders_of_pictures_are_cameras(tmp_path, files, expected):
    folder = write_masks(tmp_path / "source", dict.fromkeys(files.split(), square(10)))
    if isinstance(expected, str):
        with pytest.raises(SceneError, match=expected):
            open_source(folder, None, None)
        return
    source = open_source(folder, None, None)
    assert {name: [*own] for name, own in source.pictures.items()} == expected
    assert source.names == tuple(expected)
    for name in source.names:
        for frame, where, mask in source.read(name, as_masks=True):
            assert where.endswith(f"{frame}.png")
            assert (mask == square(10)).all()
        assert next(source.read(name))[2].shape == (60, 80, 3)


def test_videos_of_masks_are_a_sequence(tmp_path, out):
    for name in ("front", "side"):
        films = [255 * square(10 + 8 * k) for k in range(3)]
        write_film(tmp_path / "videos" / f"{name}.avi", films, 25.0)
    write_film(tmp_path / "videos" / ".hidden.avi", films, 25.0)
    # Pictures take precedence over a video.
    save(tmp_path / "images" / "side" / "7.jpg", 255 * square(10))
    save_rig(tmp_path / "cameras.yaml")
    result = make_masks(tmp_path, out)
    assert {name: [*own] for name, own in result.summary["cameras"].items()} == {
        "side": ["7"], "front": ["000000", "000001", "000002"],
    }  # fmt: skip
    made = load_scene(out)
    assert (made.sequence, made.frame_rate_hz) == (True, 25.0)
    for k in range(3):
        assert (made.read("front", f"{k:06d}") == square(10 + 8 * k)).mean() > 0.99
    source = open_source(tmp_path / "videos" / "front.avi", None, None)
    assert next(source.read(""))[1].endswith("camera '', picture 0")
    shutil.copy(tmp_path / "videos" / "front.avi", tmp_path / "videos" / "front.mp4")
    with pytest.raises(SceneError, match="second video of 'front'"):
        open_source(tmp_path, None, None)


def test_an_episode_of_a_data_set_is_a_source(tmp_path, out):
    write_shared_files(tmp_path)
    with pytest.raises(SceneError, match="choose an episode"):
        open_source(tmp_path, None, None)
    result = make_masks(tmp_path, out, MaskSettings(background="median", episode=1))
    frames = [f"{k:06d}" for k in range(LENGTHS[1])]
    found = {name: [*own] for name, own in result.summary["cameras"].items()}
    assert found == {"top": frames, "wrist": frames}
    assert (out / "scene.yaml").read_text() == "frame_rate_hz: 10.0\nsequence: true\n"


def test_the_camera_of_a_single_folder(tmp_path):
    folder = write_masks(tmp_path / "masks", {"front/0": square(10)})
    rig = save_rig(tmp_path / "rig.yaml", ["only"])
    source = open_source(folder / "front", rig, None)
    assert source.names == ("only",)
    source.check_size("only", (60, 80, 3), "here")
    with pytest.raises(SceneError, match="here: has 80 x 61"):
        source.check_size("only", (61, 80), "here")
    # Without a camera file the first picture has the size; a camera without a name has none.
    several = open_source(folder, None, None)
    several.check_size("front", (5, 6), "first")
    several.check_size("front", (5, 6, 3), "second")
    with pytest.raises(SceneError, match=r"third: has 6 x 4 .* had before 6 x 5"):
        several.check_size("front", (4, 6), "third")
    single = open_source(folder / "front", None, None)
    single.check_size("", (5, 6), "any")
    single.check_size("", (7, 8), "any")
    # The folder's own file, unless another is given.
    save_rig(folder / "cameras.yaml", ["front", "back"])
    assert open_source(folder, None, None).camera_file == folder / "cameras.yaml"
    assert [*open_source(folder, save_rig(rig), None).cameras.cameras] == ["front", "side"]


def test_refusals(tmp_path):
    masks = write_masks(tmp_path / "masks", {"front/0": square(10), "side/0": ~square(0, side=0)})
    rig, text = save_rig(tmp_path / "rig.yaml"), tmp_path / "notes.txt"
    text.write_text("")
    (tmp_path / "empty").mkdir()
    (masks / "middle").mkdir()
    save(masks / "middle" / "0.png", np.zeros((60, 80)))
    for path, camera_file, error, words in (
        (tmp_path / "none", None, SceneError, "no such folder or file"),
        (tmp_path / "empty", None, SceneError, "has no pictures"),
        (text, None, SceneError, "notes.txt: is not a picture, video or COCO file"),
        (masks, rig, SceneError, "'middle' belong to no camera.*front, side"),
        (masks / "side", rig, SceneError, "not in a camera's folder.*2 cameras"),
        (masks, tmp_path / "none.yaml", CameraError, "none.yaml"),
    ):
        with pytest.raises(error, match=words):
            open_source(path, camera_file, None)
    size = write_coco(tmp_path / "a.json", {"side/0.jpg": AREA}, width=100)
    with pytest.raises(SceneError, match=r"100 x 60 pixels.*camera 'side'.*80 x 60"):
        make_masks(size, tmp_path / "out", MaskSettings(cameras=rig))
