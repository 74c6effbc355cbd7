"""Polygons and run lengths, compared with matplotlib's and COCO's own libraries."""

import numpy as np
import pytest
from matplotlib.path import Path
from pycocotools import mask as coco

from drake_pose.silhouette.segmentation.polygons import decode_runs, fill_polygon

HEIGHT, WIDTH = 60, 80


def star(rng, count=9):
    """A polygon without crossings that reaches beyond the picture."""
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    lengths = rng.uniform(5.0, 60.0, count)
    return np.array([40.0, 30.0]) + lengths[:, None] * np.column_stack(
        [np.cos(angles), np.sin(angles)]
    )


def centres():
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.column_stack([x.ravel(), y.ravel()])


@pytest.mark.parametrize("seed", range(20))
def test_polygons_hold_the_pixels_whose_centres_lie_in_them(seed):
    corners = star(np.random.default_rng(seed))
    inside = Path(np.vstack([corners, corners[:1]]), closed=True).contains_points(centres())
    assert (fill_polygon(corners, HEIGHT, WIDTH).ravel() == inside).all()


def test_polygons_are_where_coco_draws_them():
    rng = np.random.default_rng(5)
    for _ in range(20):
        corners = star(rng).clip(0.0, [WIDTH, HEIGHT])
        own = fill_polygon(corners, HEIGHT, WIDTH)
        (runs,) = coco.frPyObjects([corners.ravel().tolist()], HEIGHT, WIDTH)
        other = coco.decode(runs) > 0
        # Along the border COCO rounds to fifths of a pixel.
        columns, rows = own.any(axis=0).sum(), own.any(axis=1).sum()
        assert (own != other).sum() <= 0.2 * 2 * (columns + rows)
        assert abs(own.sum() - other.sum()) < 0.02 * other.sum() + 5


def test_a_rectangle_has_its_exact_pixels_and_crossings_are_even_odd():
    box = np.array([(2.0, 3.0), (6.0, 3.0), (6.0, 5.0), (2.0, 5.0)])
    mask = fill_polygon(box, 8, 9)
    assert mask[3:5, 2:6].all()
    assert mask.sum() == 8
    twice = np.vstack([box, box])
    assert not fill_polygon(twice, 8, 9).any()
    with pytest.raises(ValueError, match="three corners"):
        fill_polygon(box[:2], 8, 9)
    with pytest.raises(ValueError, match="finite"):
        fill_polygon(np.where(box == 2.0, np.nan, box), 8, 9)


@pytest.mark.parametrize("seed", range(10))
def test_run_lengths_are_coco_s(seed):
    rng = np.random.default_rng(seed)
    mask = fill_polygon(star(rng), HEIGHT, WIDTH) ^ (rng.random((HEIGHT, WIDTH)) < 0.03 * seed)
    packed = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    assert (decode_runs(packed["counts"].decode(), HEIGHT, WIDTH) == mask).all()
    changes = np.flatnonzero(np.diff(np.concatenate([[False], mask.T.ravel()]))) + 0
    runs = np.diff(np.concatenate([[0], changes, [mask.size]])).tolist()
    assert (decode_runs(runs, HEIGHT, WIDTH) == mask).all()


@pytest.mark.parametrize(
    "counts",
    [[10, 100000], [3, 4], [-3, 28], [2.5, 22.5], [True, 24], "zzzz", "o~~~~", "", "é1", "P"],
)
def test_damaged_run_lengths_are_refused(counts):
    with pytest.raises(ValueError, match="run lengths"):
        decode_runs(counts, 5, 5)
