"""Sizes of picture files, found without decoding, against those of the decoded pictures."""

import cv2
import numpy as np
import pytest
from PIL import Image

from drake_pose.camera.picture_files import picture_size, read_picture
from drake_pose.errors import SceneError

PICTURE = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_size_of_whole_files_and_refusal_of_damaged_ones(tmp_path, suffix):
    path = tmp_path / f"0001{suffix}"
    cv2.imwrite(str(path), PICTURE)
    assert picture_size(path, SceneError) == read_picture(path, SceneError).shape[1::-1] == (60, 40)
    whole = path.read_bytes()
    damaged = [b"", b"no picture", whole[:20], whole[:-30], bytes(len(whole))]
    if suffix == ".png":
        damaged.append(whole[:200] + bytes([whole[200] ^ 255]) + whole[201:])
    for content in damaged:
        path.write_bytes(content)
        for read in (picture_size, read_picture):
            with pytest.raises(SceneError, match=f"0001{suffix}"):
                read(path, SceneError)


def test_pictures_that_must_be_decoded_have_no_size(tmp_path):
    deep, turned = tmp_path / "deep.png", tmp_path / "turned.jpg"
    cv2.imwrite(str(deep), PICTURE.astype(np.uint16))
    with pytest.raises(SceneError, match="16 bits"):
        read_picture(deep, SceneError)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(PICTURE).save(turned, exif=exif)
    assert read_picture(turned, SceneError).shape == (60, 40, 3)
    assert picture_size(deep, SceneError) is picture_size(turned, SceneError) is None
