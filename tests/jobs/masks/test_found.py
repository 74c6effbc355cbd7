"""Masks found in pictures: by the empty room, by a box."""

import filecmp
import shutil

import cv2
import numpy as np
import pytest

from drake_pose import MaskSettings, load_scene, make_masks
from drake_pose.errors import SceneError, SettingsError
from drake_pose.jobs.masks import doubt_mask, largest_patch, refuse_mask
from tests.cli import run_to_end
from tests.jobs.masks.rooms import iou, moving, write_pictures


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A moving crane, filmed by two cameras; shared, so do not change it."""
    return write_pictures(
        tmp_path_factory.mktemp("filmed") / "scene", moving(), ("front", "side")
    ).folder


@pytest.fixture
def pictures(filmed, tmp_path):
    """Its pictures and cameras alone, to be spoilt."""
    folder = tmp_path / "pictures"
    for name in ("images", "background"):
        shutil.copytree(filmed / name, folder / name)
    shutil.copy(filmed / "cameras.yaml", folder)
    return folder


def agreement(made, filmed, moves=False):
    """IoU with the true masks; of what moves alone."""
    true, found = load_scene(filmed), load_scene(made)
    values = []
    for camera in true.cameras:
        masks = {f: true.read(camera, f) for f in true.frames}
        still = np.logical_and.reduce(list(masks.values())) & moves
        for frame in true.frames:
            if (camera, frame) in found.masks:
                values.append(iou(masks[frame] & ~still, found.read(camera, frame) & ~still))
    return np.array(values)


def test_empty_room_beside_the_pictures_is_used(filmed, pictures, out):
    result = make_masks(pictures, out)
    assert result.count == 80
    assert agreement(out, filmed).mean() > 0.88
    assert filecmp.cmp(out / "cameras.yaml", filmed / "cameras.yaml", shallow=False)
    overlay = cv2.imread(str(out / "overlay" / "side" / "0003.jpg"))
    assert overlay.shape == (160, 200, 3)


def test_median_of_a_recording_finds_what_moves_alone(filmed, pictures, tmp_path, out):
    shutil.rmtree(pictures / "background")
    settings = MaskSettings(background="median")
    result = make_masks(pictures, out, settings)
    assert not any("no good background" in text for text in result.warnings)
    assert agreement(out, filmed, moves=True).mean() > 0.8
    angles = [(20.0 + 6.0 * k, -40.0 - 5.0 * k) for k in range(10)]
    still = write_pictures(tmp_path / "scene", angles)
    result = make_masks(still.folder / "images", tmp_path / "still", settings)
    assert sum("no good background" in text for text in result.warnings) == 1
    assert sum("hardly agree" in text for text in result.warnings) == 1


def test_pictures_of_two_sizes_are_refused(pictures, out):
    (pictures / "cameras.yaml").unlink()
    shutil.rmtree(pictures / "background")
    file = sorted((pictures / "images" / "front").iterdir())[4]
    cv2.imwrite(str(file), cv2.imread(str(file))[:-10])
    with pytest.raises(SceneError, match=r"200 x 150.*'front' had before 200 x 160"):
        make_masks(pictures, out, MaskSettings(background="median"))


def test_light_that_changed_and_pictures_of_another_size_are_named(pictures, tmp_path, out):
    files = sorted((pictures / "images" / "front").iterdir())
    cv2.imwrite(str(files[3]), 255 - cv2.imread(str(files[3])) // 2)
    result = make_masks(pictures, out)
    assert any("0003.png" in text and "light change" in text for text in result.warnings)
    cv2.imwrite(str(pictures / "background" / "side.png"), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(SceneError, match=r"side\.png.*10 x 10.*200 x 160"):
        make_masks(pictures, tmp_path / "again")
    (pictures / "background" / "side.png").unlink()
    with pytest.raises(SceneError, match="no picture of the empty room before camera 'side'"):
        make_masks(pictures, tmp_path / "again")
    shutil.copy(pictures / "background" / "front.png", pictures / "background" / "side.png")
    files[0].write_bytes(b"no picture")
    with pytest.raises(SceneError, match=r"0000\.png"):
        make_masks(pictures, tmp_path / "again")
    assert not any((tmp_path / "again").glob("**/*.png"))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"background": "median", "box": (1, 2, 3, 4)}, "two ways"),
        ({"background": "median", "classes": ("1",)}, "--class"),
        ({"box": (1, 2, 3)}, "4 numbers"),
    ],
)
def test_ways_cannot_be_mixed(settings, words):
    with pytest.raises(SettingsError, match=words):
        MaskSettings(**settings)


@pytest.fixture
def still(tmp_path):
    """A blue box with a hole before a yellow table, and the truth."""
    rng = np.random.default_rng(3)
    true = np.zeros((120, 160), bool)
    true[30:90, 40:110] = True
    true[50:60, 60:80] = False
    colours = np.where(true[:, :, None], (60, 80, 190), (200, 180, 70))
    picture = (colours + 12.0 * rng.standard_normal(colours.shape)).clip(0, 255).astype(np.uint8)
    path = tmp_path / "still.png"
    cv2.imwrite(str(path), picture[:, :, ::-1])
    return path, true


def test_box_cuts_a_still_out(still, tmp_path, out):
    path, true = still

    words = ["masks", path, "-o", out, "--box"]
    run_to_end(*words, "30,20,95,85")
    assert iou(load_scene(out).read("camera", "still"), true) > 0.97
    words[3] = tmp_path / "none"
    assert "still.png: the box" in run_to_end(*words, "300,20,95,85", status=1).stderr
    run_to_end(*words, "1,2,3", status=2)


def test_masks_of_nothing_of_all_and_of_two_objects_are_judged():
    mask = np.zeros((40, 60), bool)
    assert "not found" in refuse_mask(mask)
    assert "fills" in refuse_mask(~mask)
    assert "background" in doubt_mask(~mask)[0]
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
