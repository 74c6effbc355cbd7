"""Mask files and agreement between masks; COCO files against matplotlib and pycocotools."""

import json
import struct
import sys
import zlib

import cv2
import numpy as np
import pytest
from matplotlib.path import Path as MplPath
from pycocotools import mask as coco
from scipy.ndimage import binary_erosion

from drake_pose.camera.picture_files import read_binary_mask, read_picture, threshold_mask
from drake_pose.errors import MaskError, SceneError
from drake_pose.silhouette.pictures.masks import (
    compare_masks,
    count_edge_pixels,
    draw_area,
    intersection_over_union,
    is_coco,
    original_files,
    read_coco,
    read_mask,
    signed_distances,
)
from tests.written_files import write_mask

MASK = np.zeros((20, 30), dtype=bool)
MASK[4:9, 3:20] = True


def save(folder, picture, name="0007.png"):
    path = folder / name
    cv2.imwrite(str(path), picture)
    return path


GREY = MASK.astype(np.uint8) * 255
COLOUR = np.where(MASK[..., None], np.array([0, 200, 17]), 0).astype(np.uint8)


@pytest.mark.parametrize(
    "picture",
    [
        *(MASK.astype(np.uint8) * np.uint8(value) for value in (1, 128, 255)),
        MASK.astype(np.uint16) * np.uint16(65535),
        COLOUR,
        np.dstack([COLOUR, np.full_like(GREY, 255)]),
        np.dstack([np.full((*MASK.shape, 3), 255, np.uint8), GREY]),
    ],
    ids=["1", "128", "255", "deep", "colour", "opaque", "transparent"],
)
def test_every_variant_of_mask_is_read(tmp_path, picture):
    """And a mask that is written is white, of one bit a pixel."""
    mask = read_mask(save(tmp_path, picture))
    assert mask.dtype == np.bool_
    np.testing.assert_array_equal(mask, MASK)
    write_mask(tmp_path / "m.png", mask)
    np.testing.assert_array_equal(read_picture(tmp_path / "m.png")[..., 0], GREY)


def png_of_size(side):
    """An empty PNG file whose header tells its size."""
    header = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n"
    for kind, content in ((b"IHDR", header), (b"IEND", b"")):
        checksum = struct.pack(">I", zlib.crc32(kind + content))
        data += struct.pack(">I", len(content)) + kind + content + checksum
    return data


def test_invalid_masks_are_refused(tmp_path):
    path = save(tmp_path, GREY)
    data = path.read_bytes()
    pictures = (
        (np.zeros_like(GREY), "empty"),
        (np.full_like(GREY, 255), "full"),
        (cv2.GaussianBlur(GREY, (5, 5), 0), "values"),
        (np.dstack([GREY, GREY, np.roll(GREY, 3, axis=1)]), "values"),
        (np.where(MASK, 255, 3).astype(np.uint8), "full"),
        (GREY.T.copy(), r"20 x 30 pixels.*30 x 20"),
    )
    ends, places = (0, 5, 8, 20, 40, len(data) - 13, len(data) - 8), (9, 14, 18, 30, len(data) - 20)
    damaged = [(data[:end], "(not a PNG|truncated|damaged)") for end in ends]
    damaged += [(data[:k] + bytes([data[k] ^ 0x55]) + data[k + 1 :], "") for k in places]
    damaged += [(png_of_size(side), "too large") for side in (10_000, 60_000)]
    damaged.append((cv2.imencode(".jpg", GREY)[1].tobytes(), "not a PNG"))
    for content, message in (*pictures, *damaged):
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            save(tmp_path, content)
        with pytest.raises(MaskError, match=rf"0007\.png.*{message}"):
            read_mask(path, 30, 20)
    with path.open("wb") as file:
        file.truncate(1 << 40)
    for name, message in (("0007.png", "larger than 2 GiB"), ("missing.png", ""), ("", "")):
        with pytest.raises(MaskError, match=rf"{tmp_path / name}.*{message}"):
            read_mask(tmp_path / name)


def test_signed_distances_match_brute_force():
    mask = np.random.default_rng(4).random((14, 17)) < 0.6
    found = signed_distances(mask)
    inside, outside = np.argwhere(mask), np.argwhere(~mask)
    for row, column in np.ndindex(mask.shape):
        others = outside if mask[row, column] else inside
        nearest = np.linalg.norm(others - [row, column], axis=1).min() - 0.5
        expected = -nearest if mask[row, column] else nearest
        assert found[row, column] == pytest.approx(expected, abs=1e-4)
    # An edge pixel has one of its four neighbours in the picture outside.
    eroded = binary_erosion(mask, border_value=1)
    assert count_edge_pixels(mask) == np.count_nonzero(mask & ~eroded)


def test_E_total_is_the_differing_fraction_over_all_cameras():
    """One mask is right; the other lacks 10 of 85 pixels."""
    body = MASK.copy()
    body[4:9, 3:5] = False
    assert compare_masks({"a": ~MASK & MASK}, {"a": ~MASK & MASK})[1] == {"a": 1.0}
    assert np.isnan(compare_masks({}, {})[0])
    shifted = np.roll(MASK, 2, axis=1)
    assert intersection_over_union(MASK, shifted) == pytest.approx(75 / 95)
    E_total, ious = compare_masks({"a": MASK, "b": MASK}, {"a": MASK, "b": body})
    assert E_total == pytest.approx(10 / 170)
    assert ious == {"a": 1.0, "b": pytest.approx(75 / 85)}


HEIGHT, WIDTH = 40, 60


@pytest.fixture
def classes():
    """A class image (H, W): background 0, a box of class 1 and a box of class 7."""
    layer = np.zeros((HEIGHT, WIDTH), np.uint8)
    layer[5:20, 10:30], layer[25:35, 40:55] = 1, 7
    return layer


def test_blurred_masks_are_read_but_photographs_are_refused(classes, tmp_path):
    blurred = cv2.GaussianBlur(np.where(classes > 0, 255, 0).astype(np.uint8), (3, 3), 0)
    grey = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    for k, picture in enumerate((blurred, grey)):
        cv2.imwrite(str(tmp_path / f"{k}.jpg"), picture)
    for found in (
        threshold_mask(np.dstack([blurred] * 3), "a.mp4"),
        read_binary_mask(tmp_path / "0.jpg", lossy=True),
    ):
        assert (found == (classes > 0)).mean() > 0.99
    with pytest.raises(SceneError, match=r"a\.mp4.*a picture and not a mask"):
        threshold_mask(grey, "a.mp4")
    with pytest.raises(SceneError, match=r"1\.jpg.*a picture and not a mask"):
        read_binary_mask(tmp_path / "1.jpg", lossy=True)


def star(rng, count=9):
    """A polygon without self-intersections that exceeds the picture."""
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    return [40.0, 30.0] + rng.uniform(5.0, 60.0, count)[:, None] * directions


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
        {"size": [5, 6], "counts": [25]},
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
    assert is_coco(tmp_path / "a.json")
    for text in ('{"images": []}', '{"annotations": []}'):
        (tmp_path / "b.json").write_text(text)
        assert not is_coco(tmp_path / "b.json")


def test_pictures_have_the_names_they_had_before_annotation():
    for names, expected in (
        # As they are; Windows'; Label Studio's, with one or two prefixes; Roboflow's.
        (["front/frame_000001.PNG", "2.png"], ["front/frame_000001.PNG", "2.png"]),
        ([r"C:\data\front\1.png", r"D:\2.png"], ["data/front/1.png", "2.png"]),
        ([r"images\4\3a8d9f0c-1.jpg", "1a8d9f0c-2.jpg"], ["images/4/1.jpg", "2.jpg"]),
        (["../../media/0a1b2c3d__3a8d9f0c-1.jpg", "5a1b2c3d__4a8d9f0c-2__3.jpg"],
         ["media/1.jpg", "2__3.jpg"]),
        (["/data/upload/4/3a8d9f0c-1.jpg"], ["data/upload/4/1.jpg"]),
        (["%2Fdata%2Fupload%2F4%2F3a8d9f0c-a%201.jpg"], ["data/upload/4/a 1.jpg"]),
        (["/data/local-files/?d=set%2Ffront%2F1.jpg&x=1"], ["set/front/1.jpg"]),
        (["http://host:80/data/3a8d9f0c-1.jpg?x=1", "s3://b/f/0a8d9f0c-2.jpg"],
         ["data/1.jpg", "f/2.jpg"]),
        (["1_jpg.rf.3b1c2d3e.jpg", "front_2_jpeg.rf.AbC-x9.png"], ["1.jpg", "front_2.jpeg"]),
        ([("left/1_jpg.rf.3b1c.jpg", "1.png"), ("2_jpg.rf.3b1c.jpg", r"right\2.png")],
         ["left/1.png", "right/2.png"]),
        # These may be the pictures' own names.
        (["20240101-1.jpg", "20240102-2.jpg"],) * 2,
        (["3a8d9f0c-1.jpg", "3a8d9f0c-2.jpg"],) * 2,
        (["3a8d9f0c-1.jpg", "2.jpg"],) * 2,
        (["../../1.png"], ["1.png"]),
    ):  # fmt: skip
        pairs = [one if isinstance(one, tuple) else (one, None) for one in names]
        images = [{"file_name": name, "extra": {"name": extra}} for name, extra in pairs]
        assert [*map(str, original_files(images))] == expected


def test_other_files_and_damaged_annotations_are_refused(tmp_path):
    for content, words in (
        ({"area": {"image_id": 77}}, "lacks 77"),
        ({"area": {"image_id": []}}, "unhashable"),
        ({"image": {"id": 6}}, "image 6 is given twice"),
        ({"image": {"width": True}}, "whole numbers of 2 to"),
        ({"image": {"height": 1}}, "whole numbers of 2 to"),
        ({"image": {"height": 2.0}}, "whole numbers of 2 to"),
        ({"image": {"file_name": ".."}}, "not a name of a picture"),
        ({"image": {"file_name": "a\0.png"}}, "not a name of a picture"),
        ({"image": {"file_name": 3}}, ""),
        ({"content": {"images": 3}}, "not iterable"),
        ({"content": {"categories": [{"id": 3}]}}, "lacks 'name'"),
        *((text, "") for text in ("{", "[]", "3", '"images"', "{}", '{"images": []}')),
    ):
        file = tmp_path / "a.json"
        if isinstance(content, str):
            file.write_text(content)
        else:
            annotations(file, **content)
        with pytest.raises(MaskError, match=rf"a\.json: is not a COCO file, which has .*{words}"):
            read_coco(file)
