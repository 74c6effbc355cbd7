"""Reading of scene folders."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import CameraError, MaskError, SceneError, SettingsError, UnknownNameError
from drake_pose.silhouette.pictures.scenes import find_masks, load_scene, select_frames
from tests.camera.recordings import write_film
from tests.written_files import write_mask

MASK = np.zeros((20, 30), dtype=bool)
MASK[4:9, 3:20] = True


def camera(name, **changed):
    return replace(ParallelCamera(name, 30, 20, 10.0, 15.0, 10.0, np.eye(4)), **changed)


def make_scene(folder, **frames):
    """Write masks of cameras' ``frames``; by default two cameras share one of three frames."""
    frames = frames or {"left": ("0002", "0001"), "right": ("0002", "0003")}
    save_cameras(folder / "cameras.yaml", [camera(name) for name in frames])
    for name, own in frames.items():
        (folder / "masks" / name).mkdir(parents=True)
        for frame in own:
            write_mask(folder / "masks" / name / f"{frame}.png", MASK)
    return load_scene(folder)


def test_scene_has_cameras_frames_and_masks(tmp_path):
    scene = make_scene(tmp_path)
    assert list(scene.cameras) == ["left", "right"]
    assert scene.frames == ("0001", "0002", "0003")
    assert [scene.cameras_of(frame) for frame in scene.frames] == [
        ("left",), ("left", "right"), ("right",),
    ]  # fmt: skip
    assert scene.masks["left", "0001"] == tmp_path / "masks" / "left" / "0001.png"
    assert (scene.sequence, scene.frame_rate_hz, scene.warnings) == (False, None, ())
    right = scene.of_cameras(["right"])
    assert {*right.cameras} == {name for name, _ in right.masks} == {"right"}
    assert right.frames_with_files([]) == right.frames_with_files(["1:3"]) == ("0002", "0003")
    for _ in range(2):
        # Masks that were read are kept compressed.
        np.testing.assert_array_equal(scene.read("right", "0003"), MASK)
    for words, refused in (
        (r"camera 'middle'.*left, right", lambda: scene.read("middle", "0001")),
        (r"camera 'left' has no frame '0003'.*0001, 0002", lambda: scene.read("left", "0003")),
        (r"frame '9'.*0001, 0002, 0003", lambda: scene.cameras_of("9")),
        (r"camera 'up'", lambda: scene.of_cameras(["up"])),
        ("no mask of camera right", lambda: right.frames_with_files(["1"])),
    ):
        with pytest.raises((UnknownNameError, SceneError), match=words):
            refused()
    lone = replace(scene, masks={("left", "0001"): scene.masks["left", "0001"]})
    assert [*lone.of_cameras([]).cameras] == ["left"]
    assert lone.cameras_of("0003") == ()


def test_frames_are_selected_by_name_number_or_range():
    known = ("0001", "0002", "a", "07", "8", "08")
    for wanted, expected in (
        ([], known),
        (["2", "a"], ("0002", "a")),
        (["7:1", "1:a"], SettingsError),
        (["1:7"], known[:4]),
        (["07", "0001:2"], ("0001", "0002", "07")),
        (["9"], UnknownNameError),
        (["b"], UnknownNameError),
        (["008"], UnknownNameError),
        (["08"], ("08",)),
        (["a:a"], ("a",)),
    ):
        if isinstance(expected, tuple):
            assert select_frames(known, wanted, "here") == expected
        else:
            with pytest.raises(expected, match=r"9|'b'|008|7:1"):
                select_frames(known, wanted, "here")


def test_every_second_frame_halves_the_frame_rate(tmp_path):
    make_scene(tmp_path, left=[f"{k:04d}" for k in range(7)])
    (tmp_path / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 60\n")
    whole = load_scene(tmp_path)
    assert (whole.sequence, whole.frame_rate_hz) == (True, 60.0)
    scene, asked = whole.every(2, ["1:5"])
    assert scene.frames == asked == ("0001", "0003", "0005")
    assert {frame for _, frame in scene.masks} == set(asked)
    assert scene.frame_rate_hz == 30.0
    assert replace(whole, frame_rate_hz=None).every(2, [])[0].frame_rate_hz == 15.0
    assert replace(whole, sequence=False).every(2, [])[0].frame_rate_hz == 60.0
    timed = replace(whole, times=np.arange(7.0)).every(2, ["1:5"])[0].times
    np.testing.assert_array_equal(timed, [1.0, 3.0, 5.0])
    assert whole.every(3, [])[0].frames == ("0000", "0003", "0006")
    assert whole.every(1, ["2"]) == (whole, ("2",))
    with pytest.raises(SettingsError, match="not 0"):
        whole.every(0, [])


def test_invalid_settings_are_refused(tmp_path):
    make_scene(tmp_path)
    for text, message in (
        ("sequence: maybe", "sequence"),
        ("frame_rate_hz: 0", "frame_rate_hz"),
        ("frame_rate_hz: true", "frame_rate_hz"),
        ("speed: 3", "unknown field speed"),
        ("- 1", "mapping"),
        ("{", "not a YAML file"),
    ):
        (tmp_path / "scene.yaml").write_text(text)
        with pytest.raises(SceneError, match=rf"scene\.yaml: .*{message}"):
            load_scene(tmp_path)


def test_masks_of_one_camera_need_no_folder(tmp_path):
    """And without a camera file there is one uncalibrated camera for each size."""
    (tmp_path / "masks").mkdir()
    for name in "ab":
        write_mask(tmp_path / "masks" / f"{name}.png", MASK)
    with pytest.raises(SceneError, match="exactly one camera"):
        load_scene(tmp_path, {"a": camera("a"), "b": camera("b")})
    np.testing.assert_array_equal(load_scene(tmp_path, {"a": camera("a")}).read("a", "a"), MASK)
    scene = load_scene(tmp_path)
    assert scene.scale_unknown
    assert [scene.cameras_of(frame) for frame in scene.frames] == [("camera",), ("camera",)]
    write_mask(tmp_path / "masks" / "c.png", MASK[:-1])
    scene = load_scene(tmp_path)
    large, small = "camera_30x20", "camera_30x19"
    assert [scene.cameras_of(f) for f in scene.frames] == [(large,), (large,), (small,)]
    np.testing.assert_array_equal(scene.read(small, "c"), MASK[:-1])
    for name, height in ((large, 20), (small, 19)):
        # The axis, the world's x, goes through the picture's middle; its up is the world's z.
        uv, _ = scene.cameras[name].project(np.array([[3.0, 0.0, 0.0], [0.0, 0.001, 0.002]]))
        middle = np.array([14.5, 0.5 * (height - 1)])
        np.testing.assert_allclose(uv, [middle, (middle[0] + 1.0, middle[1] - 2.0)], atol=1e-9)
    assert not load_scene(tmp_path, {large: camera(large)}).scale_unknown


def test_errors_name_missing_parts(tmp_path):
    with pytest.raises(SceneError, match="nowhere: no such folder"):
        load_scene(tmp_path / "nowhere")
    for call in (load_scene, lambda folder: find_masks(folder, ["left"])):
        with pytest.raises(SceneError, match="no folder masks"):
            call(tmp_path)
    (tmp_path / "masks" / "left").mkdir(parents=True)
    with pytest.raises(SceneError, match="give one of its subfolders: "):
        load_scene(tmp_path.parent)
    with pytest.raises(SceneError, match=r"no cameras\.yaml"):
        load_scene(tmp_path)
    save_cameras(tmp_path / "cameras.yaml", [camera("left")])
    with pytest.raises(SceneError, match=r"no mask.*left"):
        load_scene(tmp_path)
    (tmp_path / "masks" / "left" / "1.txt").touch()
    (tmp_path / "masks" / "rihgt").mkdir()
    with pytest.raises(SceneError, match=r"rihgt belongs to no camera.*left/1\.txt is no PNG"):
        load_scene(tmp_path)
    (tmp_path / "cameras.yaml").write_text("left: 3")
    with pytest.raises(CameraError, match="left"):
        load_scene(tmp_path)


def test_files_that_are_not_used_are_reported(tmp_path):
    """A misspelt camera, files of other kinds, and two spellings of one number."""
    make_scene(tmp_path, left=("0001", "0002"), middle=("1", "2"), right=("1", "01", "2"))
    assert load_scene(tmp_path).frames == ("0001", "0002")
    (tmp_path / "masks" / "middle").rename(tmp_path / "masks" / "Midle")
    (tmp_path / "masks" / "left" / "a.jpg").touch()
    (tmp_path / "masks" / "left" / ".hidden").touch()
    write_mask(tmp_path / "masks" / "1.png", MASK)
    (tmp_path / "masks" / "notes.txt").touch()
    scene = load_scene(tmp_path)
    misspelt, empty, doubled, *others = scene.warnings
    assert "no camera 'Midle'" in misspelt
    assert "2 masks are left out: is it 'middle'?" in misspelt
    assert "camera 'middle' of cameras.yaml has no masks" in empty
    assert "camera 'right', frame 0001: 01.png is used; 1.png" in doubled
    left, root = others
    assert left.startswith("masks/left: a.jpg left out")
    assert root.startswith("masks: notes.txt and 1 more left out")
    assert scene.masks["right", "0001"].name == "01.png"
    assert scene.unknown_folders == ("Midle",)
    # A single camera's frames are different if they are spelt differently.
    (tmp_path / "one").mkdir()
    assert make_scene(tmp_path / "one", left=("1", "01")).frames == ("01", "1")
    (tmp_path / "one" / "masks" / "left" / "\udcff.png").touch()
    with pytest.raises(SceneError, match="UTF-8"):
        load_scene(tmp_path / "one")


def test_mask_size_is_checked_on_every_read(tmp_path):
    scene = make_scene(tmp_path)
    scene.read("left", "0001")
    larger = {**scene.cameras, "left": camera("left", width=31)}
    with pytest.raises(MaskError, match=r"left/0001\.png.*30 x 20"):
        replace(scene, cameras=larger).read("left", "0001")
    write_mask(scene.masks["right", "0003"], MASK.T)
    with pytest.raises(MaskError, match=r"right/0003\.png.*20 x 30"):
        scene.read("right", "0003")
    write_mask(scene.masks["right", "0002"], MASK & False)
    with pytest.raises(MaskError, match="empty"):
        scene.read("right", "0002")
    assert not scene.read("right", "0002", may_be_empty=True).any()


def test_pictures_have_the_size_of_their_camera(tmp_path):
    save_cameras(tmp_path / "cameras.yaml", [camera("left")])
    folder = tmp_path / "images" / "left"
    folder.mkdir(parents=True)
    for width in (30, 31):
        picture = np.full((20, width, 3), (10, 20, 30), np.uint8)
        cv2.imwrite(str(folder / f"{width}.png"), picture)
    (folder / "32.png").write_bytes((folder / "30.png").read_bytes()[:-30])
    with pytest.raises(SceneError, match="no folder masks"):
        load_scene(tmp_path)
    scene = load_scene(tmp_path, sequence=True)
    assert scene.frames == ("30", "31", "32")
    for _ in range(2):
        found = scene.read_image("left", "30")
        np.testing.assert_array_equal(found[7, 8], [30, 20, 10])
        # Callers draw over their copy.
        found[:] = 0
    scene.require_images({"30"})
    for frame, words in (("31", "is 31 x 20 pixels, but camera 'left' has 30"), ("32", r"32\.png")):
        with pytest.raises(SceneError, match=words):
            scene.read_image("left", frame)
        with pytest.raises(SceneError, match=words):
            scene.require_images({frame})


def test_videos_give_pictures_and_times(tmp_path):
    """Frames have the names of the masks; a camera file may have cameras without a pose."""
    square = {"width": 64, "height": 64}
    cameras = {name: camera(name, **square) for name in ("left", "right")}
    save_cameras(tmp_path / "cameras.yaml", cameras.values())
    (tmp_path / "masks" / "left").mkdir(parents=True)
    write_mask(tmp_path / "masks" / "left" / "02.png", np.eye(64, dtype=bool))
    for name in cameras:
        greys = [np.full((64, 64), 40 * k) for k in range(5)]
        write_film(tmp_path / "videos" / f"{name}.avi", greys, 20.0)
    scene = load_scene(tmp_path, sequence=True)
    assert scene.frames == ("000000", "000001", "02", "000003", "000004")
    assert scene.frame_rate_hz == pytest.approx(20.0)
    np.testing.assert_allclose(scene.times, 0.05 * np.arange(5), atol=1e-6)
    for k, frame in enumerate(scene.frames):
        np.testing.assert_allclose(scene.read_image("right", frame), 40 * k, atol=4)
    scene.require_images(scene.frames)
    smaller = {name: replace(one, height=63) for name, one in scene.cameras.items()}
    with pytest.raises(SceneError, match="64 x 64"):
        replace(scene, cameras=smaller).require_images({"02"})
    assert load_scene(tmp_path).frames == ("02",)
    # A camera that is not wanted needs no pose.
    text = (tmp_path / "cameras.yaml").read_text()
    start = text.index("X_WC", text.index("right"))
    (tmp_path / "cameras.yaml").write_text(text[: text.rindex("\n", 0, start)] + "\n")
    assert "left" in load_scene(tmp_path, wanted=["left"]).cameras
    with pytest.raises((SceneError, CameraError), match="right"):
        load_scene(tmp_path, wanted=["right"])
