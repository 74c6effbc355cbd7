"""Masks in pictures that other tools wrote with Pillow and OpenCV."""

import cv2
import numpy as np
import pytest
from PIL import Image

from drake_pose.errors import MaskError
from drake_pose.silhouette.segmentation.mask_pictures import (
    mask_of_video_picture,
    read_mask_picture,
)

HEIGHT, WIDTH = 40, 60


@pytest.fixture
def classes():
    """Three classes: 0, 1 a box, 7 another."""
    layer = np.zeros((HEIGHT, WIDTH), np.uint8)
    layer[5:20, 10:30], layer[25:35, 40:55] = 1, 7
    return layer


def save_palette(path, layer):
    picture = Image.fromarray(layer).convert("P")
    picture.putdata(layer.ravel().tolist())
    # The first class is painted black, too: only the index tells it.
    picture.putpalette([0, 0, 0, 0, 0, 0] + [value % 256 for value in range(762)])
    picture.save(path)


def test_palette_gives_classes(tmp_path, classes):
    path = tmp_path / "a.png"
    save_palette(path, classes)
    assert (read_mask_picture(path, classes=["1"]) == (classes == 1)).all()
    assert (read_mask_picture(path, classes=["1", "7"]) == (classes > 0)).all()
    assert (read_mask_picture(path, classes=["all"]) == (classes > 0)).all()
    with pytest.raises(MaskError, match=r"classes 1, 7.*--class 1"):
        read_mask_picture(path)
    with pytest.raises(MaskError, match="numbers"):
        read_mask_picture(path, classes=["robot"])
    with pytest.raises(MaskError, match="not probabilities"):
        read_mask_picture(path, "probability")
    save_palette(path, np.where(classes == 7, 0, classes))
    assert (read_mask_picture(path) == (classes == 1)).all()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_grey_classes_of_both_depths(tmp_path, classes, kind):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), classes.astype(kind) * (1 if kind == np.uint8 else 1000))
    name = "7" if kind == np.uint8 else "7000"
    assert (read_mask_picture(path, classes=[name]) == (classes == 7)).all()
    with pytest.raises(MaskError, match="classes or probabilities"):
        read_mask_picture(path)


def test_alpha_tells_the_object_from_one_half_on(tmp_path, classes):
    rng = np.random.default_rng(1)
    alpha = rng.integers(0, 256, classes.shape, dtype=np.uint8)
    colours = rng.integers(0, 256, (*classes.shape, 3), dtype=np.uint8)
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.dstack([colours, alpha]))
    assert (read_mask_picture(path) == (alpha > 127)).all()
    cv2.imwrite(str(path), colours)
    with pytest.raises(MaskError, match="no alpha"):
        read_mask_picture(path, "alpha")
    with pytest.raises(MaskError, match="photograph"):
        read_mask_picture(path)


@pytest.mark.parametrize(("kind", "most"), [(np.uint8, 255), (np.uint16, 65535)])
def test_probabilities_from_one_half_on(tmp_path, kind, most):
    probability = np.random.default_rng(2).random((HEIGHT, WIDTH))
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.rint(probability * most).astype(kind))
    found = read_mask_picture(path)
    sure = np.abs(probability - 0.5) > 1.0 / most
    assert (found == (probability > 0.5))[sure].all()


def test_masks_as_they_should_be_are_read(tmp_path, classes):
    path = tmp_path / "a.png"
    for colour in (1, 255, (0, 0, 200), (10, 10, 10)):
        picture = np.zeros(
            (HEIGHT, WIDTH, 3) if isinstance(colour, tuple) else classes.shape, np.uint8
        )
        picture[classes > 0] = colour
        cv2.imwrite(str(path), picture)
        assert (read_mask_picture(path) == (classes > 0)).all()
    Image.fromarray(classes > 0).save(path)
    assert (read_mask_picture(path) == (classes > 0)).all()


def test_what_is_no_picture_is_refused(tmp_path):
    for name, data in {
        "a.png": b"\x89PNG\r\n\x1a\n",
        "b.png": b"GIF89a",
        "c.jpg": b"\xff\xd8\xff",
    }.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(MaskError, match=name):
            read_mask_picture(tmp_path / name)
    with pytest.raises(MaskError, match="cannot read"):
        read_mask_picture(tmp_path / "none.png")


def test_a_video_of_pictures_is_no_video_of_masks(classes):
    blurred = cv2.GaussianBlur(np.where(classes > 0, 255, 0).astype(np.uint8), (3, 3), 0)
    found = mask_of_video_picture(np.dstack([blurred] * 3), "a.mp4")
    assert (found == (classes > 0)).mean() > 0.99
    grey = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    with pytest.raises(MaskError, match=r"a\.mp4.*no mask but a picture"):
        mask_of_video_picture(grey, "a.mp4")
