"""Reading of scene folders."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import CameraError, MaskError, SceneError, SettingsError, UnknownNameError
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.written_files import write_mask

MASK = np.zeros((20, 30), dtype=bool)
MASK[4:9, 3:20] = True


def camera(name):
    return ParallelCamera(name, 30, 20, 10.0, 15.0, 10.0, np.eye(4))


def make_scene(folder):
    save_cameras(folder / "cameras.yaml", [camera("left"), camera("right")])
    for name, frames in {"left": ("0002", "0001"), "right": ("0002", "0003")}.items():
        (folder / "masks" / name).mkdir(parents=True)
        for frame in frames:
            write_mask(folder / "masks" / name / f"{frame}.png", MASK)
    return folder


def test_scene_has_cameras_frames_and_masks(tmp_path):
    scene = load_scene(make_scene(tmp_path))
    assert list(scene.cameras) == ["left", "right"]
    assert scene.frames == ("0001", "0002", "0003")
    assert scene.cameras_of("0002") == ("left", "right")
    assert scene.cameras_of("0003") == ("right",)
    assert scene.masks["left", "0001"] == tmp_path / "masks" / "left" / "0001.png"
    np.testing.assert_array_equal(scene.read("right", "0003"), MASK)
    assert (scene.sequence, scene.frame_rate_hz) == (False, None)


def test_errors_list_existing_names(tmp_path):
    scene = load_scene(make_scene(tmp_path))
    with pytest.raises(UnknownNameError, match=r"camera 'middle'.*left, right"):
        scene.read("middle", "0001")
    with pytest.raises(UnknownNameError, match=r"camera 'left' has no frame '0003'.*0001, 0002"):
        scene.read("left", "0003")
    with pytest.raises(UnknownNameError, match=r"frame '9'.*0001, 0002, 0003"):
        scene.cameras_of("9")


def test_every_second_frame_halves_the_frame_rate(tmp_path):
    save_cameras(tmp_path / "cameras.yaml", [camera("left")])
    (tmp_path / "masks" / "left").mkdir(parents=True)
    for k in range(7):
        write_mask(tmp_path / "masks" / "left" / f"{k:04d}.png", MASK)
    (tmp_path / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 60\n")
    whole = load_scene(tmp_path)
    assert (whole.sequence, whole.frame_rate_hz) == (True, 60.0)
    scene, asked = whole.every(2, ["1:5"])
    assert scene.frames == asked == ("0001", "0003", "0005")
    assert {frame for _, frame in scene.masks} == set(asked)
    assert scene.frame_rate_hz == 30.0
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
        ("frame_rate_hz: .inf", "frame_rate_hz"),
        ("frame_rate_hz: fast", "frame_rate_hz"),
        ("frame_rate_hz: true", "frame_rate_hz"),
        ("speed: 3", "unknown field speed"),
        ("- 1", "mapping"),
        ("{", "not a YAML file"),
    ):
        (tmp_path / "scene.yaml").write_text(text)
        with pytest.raises(SceneError, match=rf"scene\.yaml: .*{message}"):
            load_scene(tmp_path)


def test_flat_mask_folder_needs_one_camera(tmp_path):
    (tmp_path / "masks").mkdir()
    write_mask(tmp_path / "masks" / "0000.png", MASK)
    with pytest.raises(SceneError, match="exactly one camera"):
        load_scene(tmp_path, {"a": camera("a"), "b": camera("b")})
    scene = load_scene(tmp_path, {"a": camera("a")})
    np.testing.assert_array_equal(scene.read("a", "0000"), MASK)


def test_masks_without_camera_file_get_one_camera_per_size(tmp_path):
    (tmp_path / "masks").mkdir()
    for name in "ab":
        write_mask(tmp_path / "masks" / f"{name}.png", MASK)
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
    with pytest.raises(SceneError, match="no folder masks"):
        load_scene(tmp_path)
    (tmp_path / "masks" / "left").mkdir(parents=True)
    with pytest.raises(SceneError, match="give one of its subfolders: "):
        load_scene(tmp_path.parent)
    with pytest.raises(SceneError, match=r"no cameras\.yaml"):
        load_scene(tmp_path)
    save_cameras(tmp_path / "cameras.yaml", [camera("left")])
    with pytest.raises(SceneError, match=r"no mask.*left"):
        load_scene(tmp_path)
    (tmp_path / "masks" / "rihgt").mkdir()
    with pytest.raises(SceneError, match="rihgt belongs to no camera"):
        load_scene(tmp_path)
    (tmp_path / "cameras.yaml").write_text("left: 3")
    with pytest.raises(CameraError, match="left"):
        load_scene(tmp_path)


def test_mask_size_is_checked_on_every_read(tmp_path):
    scene = load_scene(make_scene(tmp_path))
    for _ in range(3):
        np.testing.assert_array_equal(scene.read("left", "0001"), MASK)
    larger = replace(camera("left"), width=31)
    with pytest.raises(MaskError, match=r"left/0001\.png.*30 x 20"):
        replace(scene, cameras={**scene.cameras, "left": larger}).read("left", "0001")
    write_mask(scene.masks["right", "0003"], MASK.T)
    with pytest.raises(MaskError, match=r"right/0003\.png.*20 x 30"):
        scene.read("right", "0003")


def test_picture_size_must_match_the_camera(tmp_path):
    save_cameras(tmp_path / "cameras.yaml", [camera("left")])
    folder = tmp_path / "images" / "left"
    folder.mkdir(parents=True)
    for width in (30, 31):
        picture = np.full((20, width, 3), (10, 20, 30), np.uint8)
        cv2.imwrite(str(folder / f"{width}.png"), picture)
    scene = load_scene(tmp_path, sequence=True)
    np.testing.assert_array_equal(scene.read_image("left", "30")[7, 8], [30, 20, 10])
    with pytest.raises(SceneError, match=r"31.png: is 31 x 20 pixels, but camera 'left' has 30"):
        scene.read_image("left", "31")
