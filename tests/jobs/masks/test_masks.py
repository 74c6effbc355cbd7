"""Masks segmented by a background, or read from other tools, and doubts about them."""

import filecmp
import shutil

import cv2
import numpy as np
import pytest

from drake_pose import MaskSettings, load_scene, make_masks
from drake_pose.camera.picture_files import read_picture
from drake_pose.errors import DrakePoseError, MaskError, SceneError, SettingsError
from drake_pose.jobs.mask_sources import open_source
from drake_pose.jobs.masks import doubt_mask, find_masks, largest_patch, refuse_mask
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.segmentation import (
    background_of_recording,
    learn_background,
    person_region,
)
from tests.jobs.masks.rooms import (
    HEIGHT,
    WIDTH,
    box,
    save,
    save_rig,
    square,
    texture,
    write_coco,
    write_masks,
    write_room,
)

NOBODY = square(0, side=0)
PLACES = [square(2 + 6 * k) for k in range(11)]


def test_objects_are_segmented_by_the_background_beside_the_pictures(tmp_path, out):
    """The sixth picture shows nobody, the last one another light."""
    truth = [*PLACES[:5], NOBODY, NOBODY]
    folder, heard = write_room(tmp_path / "room", truth, ("front", "side")), []
    for camera in ("front", "side"):
        bright = folder / "images" / camera / "0006.png"
        save(bright, cv2.imread(str(bright)) + 90.0)
    result = make_masks(folder, out, on_mask=heard.append)
    assert heard == [*range(1, 15)]
    assert result.summary["mask_count"] == 10
    assert filecmp.cmp(out / "cameras.yaml", folder / "cameras.yaml", shallow=False)
    found = load_scene(out)
    for camera in ("front", "side"):
        room = learn_background([read_picture(folder / "background" / f"{camera}.png")])
        for k, mask in enumerate(truth):
            entry, name = result.summary["cameras"][camera][f"{k:04d}"], f"{camera}/{k:04d}"
            picture = read_picture(folder / "images" / f"{name}.png")
            drawn = cv2.imread(str(out / "overlay" / f"{name}.jpg")).astype(float)
            brightness = drawn.mean() / picture.mean()
            if k < 5:
                own = found.read(camera, f"{k:04d}")
                assert intersection_over_union(own, mask) > 0.9
                assert entry["area"] == own.sum()
                others = [person_region(picture, room.with_noise(n)) for n in (0.7, 1.4)]
                ious = [intersection_over_union(own, one) for one in others]
                assert entry["agreement"] == min(ious)
                assert brightness == pytest.approx(1.0, abs=0.05)
                edge = own & ~cv2.erode(own.view(np.uint8), np.ones((3, 3))).view(np.bool_)
                near = np.abs(drawn - (0, 94, 213)).max(axis=2) < 90
                assert near[edge].mean() > 0.9
                assert near[~edge].mean() < 0.2
            else:
                assert ("not found" if k == 5 else "the light") in entry["refusal"]
                assert f"{name}.png: {entry['refusal']}; no mask" in " ".join(result.warnings)
                assert not (out / "masks" / f"{name}.png").exists()
                assert brightness == pytest.approx(1 / 3, abs=0.05)
    assert len(result.warnings) == 4


def test_a_median_of_all_pictures_shows_what_never_moves(tmp_path, out):
    """The first body walks by; the second stays around one place, however it moves there."""
    settings = MaskSettings(background="median")
    walking = write_room(tmp_path / "walking", PLACES, ("front", "side"))
    # The background beside the pictures, of a body that is there, is not used.
    save(walking / "background" / "front.png", np.full((HEIGHT, WIDTH, 3), 255.0))
    result = make_masks(walking, out, settings, overlay=False)
    found = load_scene(out)
    for k, mask in enumerate(PLACES):
        assert intersection_over_union(found.read("front", f"{k:04d}"), mask) > 0.85
    assert result.warnings == ()
    assert not (out / "overlay").exists()
    assert result.summary["settings"] == {"background": "median"}
    standing = [square(30 + 6 * (k % 2), 20 + 6 * (k % 3 > 0)) for k in range(9)]
    room = write_room(tmp_path / "standing", standing)
    warnings = [one.warnings for one in find_masks(open_source(room, None, None), settings)]
    assert "stays around one place" in warnings[0][0]
    assert set(warnings[1:]) == {()}


def test_a_median_of_a_long_recording_uses_every_second_picture(tmp_path):
    masks = [square(7 * k % 60, 5 * k % 40, 8) for k in range(130)]
    folder = write_room(tmp_path / "room", masks)
    source = open_source(folder, None, None)
    every = [read_picture(path) for path in sorted(folder.glob("images/front/*.png"))]
    room = background_of_recording(every[::2])
    for found, picture in zip(
        find_masks(source, MaskSettings(background="median")), every, strict=True
    ):
        np.testing.assert_array_equal(found.mask, person_region(picture, room))


def test_empty_and_full_masks_are_rejected_and_two_objects_warned_of():
    mask = square(10)
    assert "not found" in refuse_mask(NOBODY)
    full = np.ones((50, 50), bool)
    assert "fills" in refuse_mask(full)
    full[:, 0] = False
    assert "fills" in refuse_mask(full)
    full[0] = False
    assert refuse_mask(full) == ""
    assert "100% of the picture's border" in doubt_mask(~mask)[0]
    assert refuse_mask(mask) == ""
    assert doubt_mask(mask) == []
    both = mask | square(40, side=9)
    (text,) = doubt_mask(both)
    assert "256 pixels around (18, 28)" in text
    assert "81 around (44, 24)" in text
    assert (largest_patch(both) == mask).all()
    assert (largest_patch(mask) == mask).all()


def test_only_the_largest_region_is_kept_if_asked_for(tmp_path, out):
    folder = write_masks(tmp_path, {"a": square(10) | square(40, side=9), "b": NOBODY})
    for largest, area in ((False, 256 + 81), (True, 256)):
        made = make_masks(folder, out / str(largest), MaskSettings(largest=largest))
        assert made.summary["cameras"][""]["a"]["area"] == area
        assert len(made.warnings) == 2 - largest


def test_an_indistinct_object_is_doubtful(tmp_path, out):
    rng = np.random.default_rng(0)
    room = texture(rng, (HEIGHT, WIDTH))
    save(tmp_path / "room.png", room)
    ramp = 10.0 + 12.0 * np.tile(np.linspace(0.0, 1.0, WIDTH), (HEIGHT, 1))
    for k, left in enumerate((10, 40)):
        shown = room + (square(left, side=20) * (ramp if k else 90.0))[:, :, None]
        save(tmp_path / "images" / "a" / f"{k}.png", shown)
    save(tmp_path / "images" / "a" / "2.png", room + 90.0 * square(10)[:, :, None])
    result = make_masks(tmp_path, out, MaskSettings(background=tmp_path / "room.png"))
    (text,) = (one for one in result.warnings if "doubtful" in one)
    assert "frame 1 (1 of 3)" in text
    agreement = result.summary["cameras"]["a"]["1"]["agreement"]
    assert f"IoU {agreement:.0%}" in text


@pytest.mark.parametrize(
    ("names", "is_doubtful"),
    [
        (("3a1b0", "3a1b1"), False),
        (("3a1b0", "3c1b1"), True),
        (("3a1b00000", "3a1b11111"), True),
        (("cam3a_00000000", "cam3a_00000001"), False),
        (("3a_0", "3b_1"), False),
    ],
)
def test_frames_with_names_like_random_ones_have_a_doubtful_order(
    tmp_path, out, names, is_doubtful
):
    folder = write_masks(tmp_path / "masks", dict.fromkeys(names, square(10)))
    assert len(make_masks(folder, out).warnings) == is_doubtful


def test_masks_of_coco_files_are_those_of_the_chosen_classes(tmp_path, out):
    both = [(3, box(10)), (4, box(40))]
    file = write_coco(tmp_path / "a.json", {"front/0.jpg": both, "side/0.jpg": [(3, box(20))]})
    save_rig(tmp_path / "cameras.yaml")
    for k, (classes, areas) in enumerate(
        ((("arm",), (1, 0)), (("arm", "4"), (1, 1)), (("all",), (1, 1)), (("3",), (1, 0)))
    ):
        settings = MaskSettings(classes=classes, cameras=tmp_path / "cameras.yaml")
        result = make_masks(file, out / str(k), settings)
        found = load_scene(out / str(k))
        expected = areas[0] * square(10) | areas[1] * square(40)
        assert (found.read("front", "0") == expected).all()
        assert (found.read("side", "0") == square(20)).all()
        assert result.summary["mask_count"] == 2
    # A box without area, a picture without the object, and the only class.
    boxes = {"front/0.jpg": [(3, box(10)), (4, [])], "side/0.jpg": []}
    result = make_masks(write_coco(tmp_path / "b.json", boxes), out / "boxes")
    assert "1 annotations have a box, but no area" in " ".join(result.warnings)
    assert "side/0.jpg': the object is not found" in result.warnings[0]
    assert "there is no cameras.yaml for the cameras front, side" in result.warnings[-1]
    assert result.summary["cameras"]["front"]["0"]["area"] == 256


def coco(*pairs, **size):
    """Write a COCO file of one picture with these annotations."""
    return lambda folder: write_coco(folder / "a.json", {"front/0.jpg": pairs}, **size)


def without_object(folder):
    return write_coco(folder / "a.json", {f"front/{k}.jpg": [] for k in range(3)})


def room(change):
    """Write a room that is changed."""

    def write(folder):
        change(write_room(folder, PLACES[:3], ("front", "side")))
        return folder

    return write


def grown(name):
    return room(lambda folder: save(folder / name, np.zeros((10, 20, 3))))


def uncalibrated(folder):
    (folder / "cameras.yaml").unlink()
    save(folder / "images" / "side" / "0001.png", np.zeros((10, 20, 3)))


@pytest.mark.parametrize(
    ("write", "settings", "error", "words"),
    [
        (coco((3, box(1)), (4, box(2))), {}, MaskError, "classes arm, tool"),
        (coco((3, box(1))), {"classes": "robot"}, DrakePoseError, "'robot'; it has: arm"),
        (coco((3, [[1, 2, 3]])), {}, MaskError, "front/0.jpg': a segmentation"),
        (coco((3, box(1))), {"background": "median"}, SceneError, "a.json: has annotations"),
        (without_object, {}, MaskError, r"front/0.jpg.*not found.*and 2 more"),
        (grown("images/front/0002.png"), {}, SceneError, r"0002\.png.*20 x 10.*'front'.*80 x 60"),
        (grown("background/side.png"), {}, SceneError, r"side\.png.*20 x 10.*80 x 60"),
        (
            room(lambda folder: (folder / "background" / "side.png").unlink()),
            {}, SceneError, "background picture of camera 'side'",
        ),
        (
            room(lambda folder: (folder / "images" / "side" / "0001.png").write_bytes(b"no")),
            {}, SceneError, r"0001\.png",
        ),
        (room(uncalibrated), {"background": "median"}, SceneError, r"0001\.png.*20 x 10"),
        (
            room(lambda folder: (folder / "images" / "side" / "0001.png").unlink()),
            {"background": "median"}, SettingsError, "camera 'side'",
        ),
    ],
)  # fmt: skip
def test_refusals(tmp_path, write, settings, error, words):
    path = write(tmp_path / "source")
    with pytest.raises(error, match=words):
        make_masks(path, tmp_path / "out", MaskSettings(**settings))
    assert not any((tmp_path / "out").rglob("*.*g"))


def test_backgrounds_of_pictures_without_cameras(tmp_path, out):
    """A single picture of the room is that of every camera; a folder has several of a camera."""
    folder = write_room(tmp_path / "room", PLACES[:3])
    room = folder / "background" / "front.png"
    several = tmp_path / "several" / "front"
    several.mkdir(parents=True)
    shutil.copy(room, several / "0.png")
    save(several / "1.png", cv2.imread(str(room)) + 9.0)
    for name, given in (("one", room), ("more", tmp_path / "several")):
        make_masks(folder, out / name, MaskSettings(background=given))
        mask = load_scene(out / name).read("front", "0001")
        assert intersection_over_union(mask, PLACES[1]) > 0.9
