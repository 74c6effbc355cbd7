"""Masks from lossy pictures and COCO files, against matplotlib."""

import json
import sys

import cv2
import numpy as np
import pytest
from matplotlib.path import Path as MplPath
from pycocotools import mask as coco

from drake_pose.camera.picture_files import read_binary_mask, read_picture, threshold_mask
from drake_pose.errors import MaskError, SceneError
from drake_pose.silhouette.pictures.masks import draw_area, read_coco

HEIGHT, WIDTH = 40, 60


@pytest.fixture
def classes():
    """A class image (H, W): background 0, a box of class 1 and a box of class 7."""
    layer = np.zeros((HEIGHT, WIDTH), np.uint8)
    layer[5:20, 10:30], layer[25:35, 40:55] = 1, 7
    return layer


def test_twelve_bit_values_in_sixteen_bit_files_are_refused(tmp_path):
    """OpenCV keeps the upper eight of 16 bits, so that 12-bit values would read as black."""
    ramp = np.linspace(0, 4095, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint16)
    for name, values in (("twelve", ramp), ("sixteen", ramp * 16), ("black", ramp * 0)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), values)
    with pytest.raises(
        SceneError, match=r"twelve\.png: has 16 bits per pixel.*above 4095 of 65535"
    ):
        read_picture(tmp_path / "twelve.png", SceneError)
    assert read_picture(tmp_path / "sixteen.png", SceneError).max() == 255
    assert read_picture(tmp_path / "black.png", SceneError).max() == 0


def test_blurred_masks_are_read_but_photographs_are_refused(classes, tmp_path):
    blurred = cv2.GaussianBlur(np.where(classes > 0, 255, 0).astype(np.uint8), (3, 3), 0)
    grey = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    for k, picture in enumerate((blurred, grey)):
        cv2.imwrite(str(tmp_path / f"{k}.jpg"), picture)
    for found in (
        threshold_mask(np.dstack([blurred] * 3), "a.mp4", MaskError),
        read_binary_mask(tmp_path / "0.jpg", MaskError, lossy=True),
    ):
        assert (found == (classes > 0)).mean() > 0.99
    with pytest.raises(MaskError, match=r"a\.mp4.*a picture and not a mask"):
        threshold_mask(grey, "a.mp4", MaskError)
    with pytest.raises(MaskError, match=r"1\.jpg.*a picture and not a mask"):
        read_binary_mask(tmp_path / "1.jpg", MaskError, lossy=True)


def star(rng, count=9):
    """A polygon without self-intersections that exceeds the picture."""
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    lengths = rng.uniform(5.0, 60.0, count)
    return np.array([40.0, 30.0]) + lengths[:, None] * np.column_stack(
        [np.cos(angles), np.sin(angles)]
    )


@pytest.mark.parametrize("seed", range(10))
def test_polygons_contain_pixels_by_their_centres(seed):
    """But for those within a fifth of a pixel of the edge, which pycocotools rounds."""
    corners = star(np.random.default_rng(seed))
    centres = np.indices((60, 80))[::-1].reshape(2, -1).T + 0.5
    path = MplPath(np.vstack([corners, corners[:1]]), closed=True)
    found = draw_area([corners.ravel().tolist()], 60, 80).ravel()
    around = 0.2 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
    near = np.array([path.contains_points(centres + step) for step in around])
    sure = near.all(axis=0) | ~near.any(axis=0)
    assert sure.mean() > 0.9
    assert (found == path.contains_points(centres))[sure].all()


@pytest.mark.parametrize("seed", range(4))
def test_run_lengths_match_pycocotools(seed):
    rng = np.random.default_rng(seed)
    mask = draw_area([star(rng).ravel().tolist()], 60, 80) ^ (rng.random((60, 80)) < 0.05 * seed)
    packed = coco.encode(np.asfortranarray(mask, dtype=np.uint8))["counts"].decode()
    changes = np.flatnonzero(np.diff(np.concatenate([[False], mask.T.ravel()])))
    runs = np.diff(np.concatenate([[0], changes, [mask.size]])).tolist()
    for counts in (packed, runs):
        assert (draw_area({"size": [60, 80], "counts": counts}, 60, 80) == mask).all()


@pytest.mark.parametrize(
    "area",
    [
        *(
            {"size": [5, 5], "counts": counts}
            for counts in ([10, 100000], [3, 4], [-3, 28], [2.5, 22.5], [True, 24], "zzzz", "o~~~~",
                           "", "é1", "P")
        ),
        {"size": [5, 6], "counts": [30]},
        [[1.0, 2.0, 3.0]], [[1.0, 2.0, 3.0, 4.0]], [["a", "b"] * 3], [[np.nan] * 6], [[1e9] * 6],
    ],
)  # fmt: skip
def test_damaged_areas_are_refused(area):
    with pytest.raises(ValueError, match=r"run lengths|RLE|another size|three or more|could not"):
        draw_area(area, 5, 5)


def test_missing_pycocotools_names_the_extra_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycocotools", None)
    with pytest.raises(MaskError, match=r"drake_pose\[coco\]"):
        draw_area([], 5, 5)


def annotations(path, **changes):
    """A COCO file of two pictures; ``changes`` apply to the first image and area."""
    image = {"id": 5, "file_name": "left/0001.jpg", "width": WIDTH, "height": HEIGHT}
    box = [[10.0, 5.0, 30.0, 5.0, 30.0, 20.0, 10.0, 20.0]]
    area = {"id": 0, "image_id": 5, "category_id": 3, "segmentation": box}
    content = {
        "images": [image | changes.get("image", {}), image | {"id": 6}],
        "annotations": [
            area | changes.get("area", {}),
            area | {"id": 1, "category_id": 4, "segmentation": []},
            area | {"id": 2, "category_id": 9, "segmentation": [[40, 25, 55, 25, 55, 35, 40, 35]]},
        ],
        "categories": [{"id": 3, "name": "arm"}, {"id": 4, "name": "tool"}],
    }
    path.write_text(json.dumps(content | changes.get("content", {})))
    return path


def test_annotations_are_drawn_by_class_and_picture(tmp_path, classes):
    first, second = read_coco(annotations(tmp_path / "a.json"))
    assert [area[:2] for area in first.areas] == [("arm", "3"), ("tool", "4"), ("9", "9")]
    assert [bool(area) for *_, area in first.areas] == [True, False, True]
    assert (str(first.file), first.width, first.height) == ("left/0001.jpg", WIDTH, HEIGHT)
    assert (first.draw(["arm"]) == (classes == 1)).all()
    assert (first.draw(["arm", "9"]) == (classes > 0)).all()
    assert not second.draw(["arm"]).any()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"area": {"image_id": 77}}, "lacks 77"),
        ({"area": {"image_id": []}}, "unhashable"),
        ({"image": {"id": 6}}, "image 6 is given twice"),
        ({"image": {"width": True}}, "whole numbers of 2 to"),
        ({"image": {"file_name": "a\0.png"}}, "not a name of a picture"),
        ({"image": {"file_name": 3}}, "not int"),
        ({"content": {"images": 3}}, "not iterable"),
        ({"content": {"categories": [{"id": 3}]}}, "lacks 'name'"),
        *((text, "") for text in ("{", "[]", "3", '"images"', "{}", '{"images": []}')),
    ],
)
def test_other_files_and_damaged_annotations_are_refused(tmp_path, content, words):
    file = tmp_path / "a.json"
    if isinstance(content, str):
        file.write_text(content)
    else:
        annotations(file, **content)
    with pytest.raises(MaskError, match=rf"a\.json: is not a COCO file, which has .*{words}"):
        read_coco(file)
