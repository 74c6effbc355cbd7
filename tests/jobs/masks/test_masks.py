"""Scenes of masks, read from other tools or segmented by a background."""

import filecmp
import json
import shutil

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco

from drake_pose import MaskSettings, load_scene, make_masks
from drake_pose.errors import CameraError, DrakePoseError, MaskError, OutputError, SceneError
from drake_pose.jobs.masks import doubt_mask, largest_patch, refuse_mask
from drake_pose.silhouette.pictures.masks import intersection_over_union
from tests.camera.recordings import numbered, write_film, write_video
from tests.camera.test_data_sets import LENGTHS, write_v21
from tests.cli import run_json, run_to_end
from tests.jobs.masks.rooms import moving, write_pictures
from tests.jobs.scenes import write_scene


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Pictures of a moving crane by two cameras; shared, do not change them."""
    folder = tmp_path_factory.mktemp("filmed") / "scene"
    return write_pictures(folder, moving(), ("front", "side")).folder


@pytest.fixture
def pictures(filmed, tmp_path):
    """A copy of its pictures and cameras that may be changed."""
    folder = tmp_path / "pictures"
    for name in ("images", "background"):
        shutil.copytree(filmed / name, folder / name)
    shutil.copy(filmed / "cameras.yaml", folder)
    return folder


def agreement(made, filmed, moves=False):
    """Return IoUs with the true masks, of the moving links only."""
    true, found = load_scene(filmed), load_scene(made)
    values = []
    for camera in true.cameras:
        masks = {f: true.read(camera, f) for f in true.frames}
        still = np.logical_and.reduce(list(masks.values())) & moves
        for frame in true.frames:
            if (camera, frame) in found.masks:
                pair = masks[frame] & ~still, found.read(camera, frame) & ~still
                values.append(intersection_over_union(*pair))
    return np.array(values)


def test_background_beside_the_pictures_is_used(filmed, pictures, out):
    result = make_masks(pictures, out)
    assert result.summary["mask_count"] == 80
    assert agreement(out, filmed).mean() > 0.88
    assert filecmp.cmp(out / "cameras.yaml", filmed / "cameras.yaml", shallow=False)
    overlay = cv2.imread(str(out / "overlay" / "side" / "0003.jpg"))
    assert overlay.shape == (160, 200, 3)


def test_median_of_a_recording_segments_only_what_moves(filmed, pictures, tmp_path, out):
    shutil.rmtree(pictures / "background")
    settings = MaskSettings(background="median")
    result = make_masks(pictures, out, settings)
    # The crane's base does not move.
    assert sum("the body stays around one place" in text for text in result.warnings) == 2
    assert agreement(out, filmed, moves=True).mean() > 0.8
    angles = [(20.0 + 6.0 * k, -40.0 - 5.0 * k) for k in range(10)]
    still = write_pictures(tmp_path / "scene", angles)
    result = make_masks(still.folder / "images", tmp_path / "still", settings)
    assert sum("the body stays around one place" in text for text in result.warnings) == 1
    assert sum("masks are doubtful" in text for text in result.warnings) == 1


def test_changed_light_and_pictures_of_another_size_are_named(pictures, tmp_path, out):
    files = sorted((pictures / "images" / "front").iterdir())
    cv2.imwrite(str(files[3]), 255 - cv2.imread(str(files[3])) // 2)
    result = make_masks(pictures, out)
    assert any("0003.png" in text and "the light" in text for text in result.warnings)
    cv2.imwrite(str(pictures / "background" / "side.png"), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(SceneError, match=r"side\.png.*10 x 10.*200 x 160"):
        make_masks(pictures, tmp_path / "again")
    (pictures / "background" / "side.png").unlink()
    with pytest.raises(SceneError, match="no background picture of camera 'side'"):
        make_masks(pictures, tmp_path / "again")
    shutil.copy(pictures / "background" / "front.png", pictures / "background" / "side.png")
    files[0].write_bytes(b"no picture")
    with pytest.raises(SceneError, match=r"0000\.png"):
        make_masks(pictures, tmp_path / "again")
    (pictures / "cameras.yaml").unlink()
    cv2.imwrite(str(files[0]), np.zeros((150, 200, 3), np.uint8))
    with pytest.raises(SceneError, match=r"200 x 160.*'front' had before 200 x 150"):
        make_masks(pictures, tmp_path / "again", MaskSettings(background="median"))
    assert not any((tmp_path / "again").glob("**/*.png"))


def test_empty_and_full_masks_are_rejected_and_two_objects_warned_of():
    mask = np.zeros((40, 60), bool)
    assert "not found" in refuse_mask(mask)
    assert "fills" in refuse_mask(~mask)
    assert "border" in doubt_mask(~mask)[0]
    mask[5:20, 10:30] = True
    alone = mask.copy()
    assert refuse_mask(mask) == ""
    assert doubt_mask(mask) == []
    mask[25:35, 40:55] = True
    (text,) = doubt_mask(mask)
    assert "two objects" in text
    assert "(20, 12)" in text
    assert (largest_patch(mask) == alone).all()
    assert not largest_patch(np.zeros_like(mask)).any()


POLYGON = [60.0, 40.0, 120.0, 40.0, 120.0, 100.0, 60.0, 100.0]


@pytest.fixture
def two_views(tmp_path):
    """Masks of two cameras in three frames."""
    return write_scene(tmp_path / "scene", cameras=("front", "side"))


def runs_of(mask):
    """Return a mask as COCO run lengths."""
    runs = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": list(mask.shape), "counts": runs["counts"].decode()}


def write_coco(path, scene, annotate, paths="{camera}/{frame}.jpg"):
    """Write a COCO file; annotate(mask) returns the (class, segmentation) pairs of a picture."""
    images, annotations = [], []
    for k, ((camera, frame), _) in enumerate(scene.masks.items()):
        mask = scene.read(camera, frame)
        name = paths.format(camera=camera, frame=frame)
        images.append({"id": k, "file_name": name, "width": mask.shape[1], "height": mask.shape[0]})
        for number, segmentation in annotate(mask):
            own = {"id": len(annotations), "category_id": number, "segmentation": segmentation}
            annotations.append(own | {"image_id": k})
    names = [{"id": 3, "name": "arm"}, {"id": 4, "name": "tool"}]
    content = {"images": images, "annotations": annotations, "categories": names}
    path.write_text(json.dumps(content))
    return path


def test_coco_run_lengths_become_the_same_masks(tmp_path, out, two_views):
    scene = load_scene(two_views.folder)

    def halves(mask):
        upper = mask & (np.arange(len(mask)) < 70)[:, None]
        return [(3, runs_of(upper)), (4, runs_of(mask & ~upper))]

    file = write_coco(tmp_path / "a.json", scene, halves)
    cameras = two_views.folder / "cameras.yaml"
    result = make_masks(file, out, MaskSettings(classes=("arm", "4"), cameras=cameras))
    assert (result.summary["mask_count"], result.warnings) == (6, ())
    found = load_scene(out)
    assert set(found.masks) == set(scene.masks)
    assert all((found.read(*key) == scene.read(*key)).all() for key in scene.masks)
    with pytest.raises(MaskError, match=r"classes arm, tool.*classes 'arm'"):
        make_masks(file, tmp_path / "none", MaskSettings(cameras=cameras))
    with pytest.raises(DrakePoseError, match=r"no class 'robot'; it has: arm, tool"):
        make_masks(file, tmp_path / "none", MaskSettings(classes=("robot",), cameras=cameras))
    assert not (tmp_path / "none").exists() or not any((tmp_path / "none").iterdir())


@pytest.mark.parametrize(
    ("paths", "warning"),
    [
        ("a9b8c7{frame[3]}f-{camera}_{frame}.jpg", ""),
        ("{camera}/{frame[3]}a{frame}9f8d.jpg", "frames' names have parts like random ones"),
        ("{camera}/s2a3b_00000{frame}.jpg", ""),
    ],
)
def test_names_that_tell_the_frames_and_others(tmp_path, out, two_views, paths, warning):
    scene = load_scene(two_views.folder)
    file = write_coco(tmp_path / "a.json", scene, lambda _: [(3, [POLYGON])], paths)
    content = json.loads(file.read_text())
    for one in content["images"][::2]:
        one["file_name"] = one["file_name"].replace("9", "c")
    content["images"].reverse()
    file.write_text(json.dumps(content))
    result = make_masks(file, out, MaskSettings(cameras=scene.path / "cameras.yaml"))
    assert bool(warning) == bool(result.warnings)
    assert all(warning in text for text in result.warnings)
    found = {name: [*own] for name, own in result.summary["cameras"].items()}
    assert [len(own) for own in found.values()] == [3, 3]
    if paths.startswith("a9b8"):
        assert found == {key: [*scene.frames] for key in ("side", "front")}


@pytest.mark.parametrize("name", ["result.json", "annotations/default.json", "train/_coco.json"])
def test_exported_folders_are_sources(tmp_path, out, two_views, name):
    scene, export = load_scene(two_views.folder), tmp_path / "export"
    for folder in (export / "images/default", (export / name).parent):
        folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(export / "images/default/0.png"), numbered(0))
    if name.startswith("train"):
        (export / "images").rename(export / "train/images")
    write_coco(export / name, scene, lambda _: [(3, [POLYGON])])
    result = make_masks(export, out, MaskSettings(cameras=scene.path / "cameras.yaml"))
    assert set(load_scene(out).masks) == set(scene.masks)
    assert result.warnings == ()


def test_coco_polygons_without_cameras(tmp_path, out, two_views):
    file = write_coco(tmp_path / "a.json", load_scene(two_views.folder), lambda _: [(3, [POLYGON])])
    result = make_masks(file, out)
    assert "there is no cameras.yaml" in result.warnings[0]
    mask = cv2.imread(str(out / "masks" / "side" / "0001.png"), cv2.IMREAD_GRAYSCALE)
    expected = np.zeros((160, 200))
    expected[40:100, 60:120] = 255
    assert (mask == expected).all()


def test_pictures_without_the_object_are_named(tmp_path, out, two_views):
    scene = load_scene(two_views.folder)
    count = iter(range(6))
    file = write_coco(tmp_path / "a.json", scene, lambda _: [(3, [POLYGON])] if next(count) else [])
    result = make_masks(file, out, MaskSettings(cameras=scene.path / "cameras.yaml"))
    assert result.summary["mask_count"] == 5
    assert "front/0000.jpg': the object is not found" in result.warnings[0]
    assert "0000" not in [path.stem for path in (tmp_path / "out/masks/front").iterdir()]
    empty = write_coco(tmp_path / "b.json", scene, lambda _: [])
    with pytest.raises(MaskError, match=r"not found.*and 5 more"):
        make_masks(empty, tmp_path / "none")
    assert not (tmp_path / "none" / "masks").exists()


def test_annotations_of_another_size_or_camera_are_refused(tmp_path, out, two_views):
    scene = load_scene(two_views.folder)
    cameras = scene.path / "cameras.yaml"
    file = write_coco(tmp_path / "a.json", scene, lambda _: [(3, [POLYGON])], "x/{frame}.jpg")
    with pytest.raises(SceneError, match=r"no folder of its path is a camera.*front, side"):
        make_masks(file, out, MaskSettings(cameras=cameras))
    with pytest.raises(SceneError, match="has frame 0000 twice"):
        make_masks(file, out)
    content = json.loads(file.read_text())
    for one in content["images"]:
        one |= {"width": 100, "file_name": f"side/{one['id']}.png"}
    file.write_text(json.dumps(content))
    with pytest.raises(SceneError, match=r"100 x 160 pixels.*camera 'side'.*200 x 160"):
        make_masks(file, out, MaskSettings(cameras=cameras))
    with pytest.raises(CameraError):
        make_masks(file, out, MaskSettings(cameras=tmp_path / "none.yaml"))


def test_masks_in_a_video_become_a_sequence(tmp_path, out, two_views):
    scene = load_scene(two_views.folder)
    source = tmp_path / "source"
    for camera in scene.cameras:
        masks = [np.where(scene.read(camera, frame), 255, 0) for frame in scene.frames]
        write_film(source / "videos" / f"{camera}.avi", masks, 25.0)
    shutil.copy(scene.path / "cameras.yaml", source)
    make_masks(source, out)
    made = load_scene(out)
    assert made.sequence
    assert made.frame_rate_hz == 25.0
    for (camera, frame), mask in zip(made.masks, scene.masks, strict=True):
        assert (made.read(camera, frame) == scene.read(*mask)).mean() > 0.999


def test_an_episode_of_a_data_set_is_a_source(tmp_path, out):
    write_v21(tmp_path)
    with pytest.raises(SceneError, match="choose an episode"):
        make_masks(tmp_path, out, MaskSettings(background="median"))
    result = make_masks(tmp_path, out, MaskSettings(background="median", episode=1))
    frames = [f"{k:06d}" for k in range(LENGTHS[1])]
    found = {name: [*own] for name, own in result.summary["cameras"].items()}
    assert found == {"top": frames, "wrist": frames}
    assert (out / "scene.yaml").read_text() == "frame_rate_hz: 10.0\nsequence: true\n"


def test_a_camera_without_pictures_uses_its_video(tmp_path, out):
    for k, name in enumerate(("a", "b")):
        (tmp_path / "images" / "a").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "images" / "a" / f"{k}.png"), numbered(k))
        write_video(tmp_path / "videos" / f"{name}.mp4", range(3))
    room = numbered(0)
    room[:20, :20] = 90
    cv2.imwrite(str(tmp_path / "room.png"), room)
    result = make_masks(tmp_path, out, MaskSettings(background=tmp_path / "room.png"))
    counts = {name: len(own) for name, own in result.summary["cameras"].items()}
    assert counts == {"a": 2, "b": 3}


def test_ambiguous_sources_are_refused(tmp_path, out, two_views):
    masks = two_views.folder / "masks"
    with pytest.raises(SceneError, match="no such folder or file"):
        make_masks(tmp_path / "none", out)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SceneError, match="has no pictures"):
        make_masks(tmp_path / "empty", out)
    shutil.copy(two_views.folder / "cameras.yaml", masks)
    (masks / "front").rename(masks / "middle")
    with pytest.raises(SceneError, match=r"'middle' belong to no camera.*front, side"):
        make_masks(masks, out)
    with pytest.raises(SceneError, match=r"not in a camera's folder.*2 cameras"):
        make_masks(masks / "side", out, MaskSettings(cameras=masks / "cameras.yaml"))
    make_masks(masks / "side", out)
    assert load_scene(out).scale_unknown
    with pytest.raises(OutputError, match="not empty"):
        make_masks(masks / "side", out)


def test_command_says_what_was_made(tmp_path, two_views):
    source = two_views.folder / "masks" / "side"
    assert run_json("masks", source, "--out", tmp_path / "a")["mask_count"] == 3
    assert "3 masks of 3 pictures" in run_to_end("masks", source, "--out", tmp_path / "b").stdout
    photograph = tmp_path / "photograph.png"
    noise = np.random.default_rng(0).integers(0, 255, (9, 9, 3), dtype=np.uint8)
    noise[0] = 0
    cv2.imwrite(str(photograph), noise)
    done = run_to_end("masks", photograph, "--out", tmp_path / "c", status=1)
    assert "photograph.png: the mask has" in done.stderr
    assert "threshold it first" in done.stderr
    blurred = np.where(load_scene(two_views.folder).read("side", "0000"), 255, 0).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "mask.jpg"), blurred)
    make_masks(tmp_path / "mask.jpg", tmp_path / "d")
    assert (load_scene(tmp_path / "d").read("camera", "mask") == (blurred > 0)).all()
