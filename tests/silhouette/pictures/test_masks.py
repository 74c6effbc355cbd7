"""Mask files, label images and agreement between masks."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from pydrake.geometry import RenderLabel
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.camera.picture_files import read_picture
from drake_pose.errors import MaskError
from drake_pose.silhouette.pictures.label_renderer import label_image_to_mask, mask_to_label_image
from drake_pose.silhouette.pictures.masks import (
    compare_masks,
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
    np.testing.assert_array_equal(read_picture(tmp_path / "m.png", MaskError)[..., 0], GREY)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (np.zeros_like(GREY), "empty"),
        (np.full_like(GREY, 255), "full"),
        (cv2.GaussianBlur(GREY, (5, 5), 0), "values"),
        (np.dstack([GREY, GREY, np.roll(GREY, 3, axis=1)]), "values"),
        (np.where(MASK, 255, 3).astype(np.uint8), "full"),
        (GREY.T.copy(), r"20 x 30 pixels.*30 x 20"),
    ],
    ids=["empty", "full", "soft", "two colours", "no black", "wrong size"],
)
def test_invalid_masks_are_refused(tmp_path, picture, message):
    with pytest.raises(MaskError, match=rf"0007\.png.*{message}"):
        read_mask(save(tmp_path, picture), 30, 20)


def test_damaged_files_are_refused(tmp_path):
    path = save(tmp_path, MASK.astype(np.uint8) * 255)
    data = path.read_bytes()
    for end in (0, 5, 8, 20, 40, len(data) - 13, len(data) - 8):
        path.write_bytes(data[:end])
        with pytest.raises(MaskError, match=r"0007\.png: .*(not a PNG|truncated|damaged)"):
            read_mask(path)
    for place in (9, 14, 18, 30, len(data) - 20):
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :])
        with pytest.raises(MaskError, match=r"0007\.png: "):
            read_mask(path)


@pytest.mark.parametrize("side", [10_000, 60_000])
def test_huge_pictures_are_refused(tmp_path, side):
    header = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n"
    for kind, content in ((b"IHDR", header), (b"IEND", b"")):
        checksum = struct.pack(">I", zlib.crc32(kind + content))
        data += struct.pack(">I", len(content)) + kind + content + checksum
    (tmp_path / "bomb.png").write_bytes(data)
    with pytest.raises(MaskError, match=r"bomb\.png.*too large"):
        read_mask(tmp_path / "bomb.png")
    photo = bytearray(cv2.imencode(".jpg", np.zeros((20, 30, 3), np.uint8))[1].tobytes())
    size = photo.index(b"\xff\xc0") + 5
    photo[size : size + 4] = struct.pack(">HH", side, side)
    (tmp_path / "bomb.jpg").write_bytes(photo)
    with pytest.raises(MaskError, match=r"bomb\.jpg.*too large"):
        read_picture(tmp_path / "bomb.jpg", MaskError)
    with (tmp_path / "sparse.png").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(MaskError, match=r"sparse\.png.*larger than 2 GiB"):
        read_mask(tmp_path / "sparse.png")


def test_unreadable_files_are_refused(tmp_path):
    for path in (tmp_path / "missing.png", tmp_path):
        with pytest.raises(MaskError, match=str(path)):
            read_mask(path)
    picture = tmp_path / "photo.png"
    cv2.imwrite(str(tmp_path / "photo.jpg"), MASK.astype(np.uint8) * 255)
    picture.write_bytes((tmp_path / "photo.jpg").read_bytes())
    with pytest.raises(MaskError, match="not a PNG"):
        read_mask(picture)


def test_signed_distances_match_brute_force():
    mask = np.random.default_rng(4).random((14, 17)) < 0.6
    found = signed_distances(mask)
    inside, outside = np.argwhere(mask), np.argwhere(~mask)
    for row, column in np.ndindex(mask.shape):
        others = outside if mask[row, column] else inside
        nearest = np.linalg.norm(others - [row, column], axis=1).min() - 0.5
        expected = -nearest if mask[row, column] else nearest
        assert found[row, column] == pytest.approx(expected, abs=1e-4)


def test_mask_survives_conversion_to_label_image():
    image = mask_to_label_image(MASK)
    assert isinstance(image, ImageLabel16I)
    assert (image.width(), image.height()) == (30, 20)
    assert {*np.unique(image.data).tolist()} == {1, int(RenderLabel.kEmpty)}
    np.testing.assert_array_equal(label_image_to_mask(image), MASK)
    np.testing.assert_array_equal(label_image_to_mask(image.data), MASK)


def test_labels_can_be_chosen():
    labels = np.full((4, 5), int(RenderLabel.kEmpty), dtype=np.int16)
    labels[1, 2], labels[3, 3] = 7, 9
    # Drake's reserved labels are not objects.
    labels[0, :3] = [
        int(getattr(RenderLabel, k)) for k in ("kDontCare", "kDoNotRender", "kUnspecified")
    ]
    assert np.argwhere(label_image_to_mask(labels)).tolist() == [[1, 2], [3, 3]]
    assert np.argwhere(label_image_to_mask(labels, [9])).tolist() == [[3, 3]]


def test_E_total_is_the_differing_fraction_over_all_cameras():
    """One mask is right; the other lacks 10 of 85 pixels."""
    body = MASK.copy()
    body[4:9, 3:5] = False
    E_total, ious = compare_masks({"a": MASK, "b": MASK}, {"a": MASK, "b": body})
    assert E_total == pytest.approx(10 / 170)
    assert ious == {"a": 1.0, "b": pytest.approx(75 / 85)}
