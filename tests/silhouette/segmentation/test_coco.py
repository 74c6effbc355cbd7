"""Polygons and run lengths, compared with matplotlib's and COCO's own libraries."""

import builtins

import numpy as np
import pytest
from matplotlib.path import Path
from pycocotools import mask as coco

from drake_pose.errors import MaskError
from drake_pose.silhouette.segmentation.mask_pictures import decode_run_lengths, fill_polygon

HEIGHT, WIDTH = 60, 80
PIXEL_CENTRES = np.indices((HEIGHT, WIDTH))[::-1].reshape(2, -1).T + 0.5


def star(rng, count=9):
    """A polygon without crossings that reaches beyond the picture."""
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    lengths = rng.uniform(5.0, 60.0, count)
    return np.array([40.0, 30.0]) + lengths[:, None] * np.column_stack(
        [np.cos(angles), np.sin(angles)]
    )


@pytest.mark.parametrize("seed", range(10))
def test_polygons_hold_the_pixels_whose_centres_lie_in_them(seed):
    corners = star(np.random.default_rng(seed))
    inside = Path(np.vstack([corners, corners[:1]]), closed=True).contains_points(PIXEL_CENTRES)
    assert (fill_polygon(corners, HEIGHT, WIDTH).ravel() == inside).all()


def test_a_rectangle_has_its_exact_pixels_and_crossings_are_even_odd():
    box = np.array([(2.0, 3.0), (6.0, 3.0), (6.0, 5.0), (2.0, 5.0)])
    mask = fill_polygon(box, 8, 9)
    assert mask[3:5, 2:6].all()
    assert mask.sum() == 8
    assert not fill_polygon(np.vstack([box, box]), 8, 9).any()
    for wrong in (box[:2], np.where(box == 2.0, np.nan, box)):
        with pytest.raises(ValueError, match="three corners"):
            fill_polygon(wrong, 8, 9)


@pytest.mark.parametrize("seed", range(4))
def test_run_lengths_are_coco_s(seed):
    rng = np.random.default_rng(seed)
    mask = fill_polygon(star(rng), HEIGHT, WIDTH) ^ (rng.random((HEIGHT, WIDTH)) < 0.05 * seed)
    packed = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    assert (decode_run_lengths(packed["counts"].decode(), HEIGHT, WIDTH) == mask).all()
    changes = np.flatnonzero(np.diff(np.concatenate([[False], mask.T.ravel()])))
    runs = np.diff(np.concatenate([[0], changes, [mask.size]])).tolist()
    assert (decode_run_lengths(runs, HEIGHT, WIDTH) == mask).all()
    with pytest.raises(ValueError, match=r"run lengths|RLE"):
        decode_run_lengths(packed["counts"].decode()[:-1], HEIGHT, WIDTH)


@pytest.mark.parametrize(
    "counts",
    [[10, 100000], [3, 4], [-3, 28], [2.5, 22.5], [True, 24], "zzzz", "o~~~~", "", "é1", "P"],
)
def test_damaged_run_lengths_are_refused(counts):
    with pytest.raises(ValueError, match=r"run lengths|RLE"):
        decode_run_lengths(counts, 5, 5)


def test_run_lengths_without_the_library_say_what_to_install(monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **more):
        if name == "pycocotools":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MaskError, match=r"drake_pose\[coco\]"):
        decode_run_lengths([25], 5, 5)
