"""Regions of a picture that may be one object."""

import cv2
import numpy as np
import pytest

from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.segmentation.regions import find_regions


def drawn(cut, width):
    """A picture of a ring's half, a square with a pattern and clutter, and the square's mask."""
    rng, height = np.random.default_rng(0), 3 * width // 4
    picture = np.full((height, width, 3), (120, 90, 60), np.uint8)
    cv2.ellipse(picture, (width // 4, height // 2), (90, 60), 20.0, 0.0, 220.0, (60, 90, 160), 20)
    turned = cv2.boxPoints(((0.7 * width, (0.05 if cut else 0.5) * height), (150.0, 110.0), 25.0))
    mask = cv2.fillPoly(np.zeros((height, width), np.uint8), [turned.astype(np.int32)], 1) > 0
    picture[mask] = 225
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    inner = cv2.erode(mask.view(np.uint8), np.ones((25, 25), np.uint8), borderValue=0) > 0
    picture[inner & ((u // 9 + v // 9) % 2 == 0)] = 20
    noisy = picture + rng.normal(0.0, 6.0, picture.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8), mask


@pytest.mark.parametrize(("cut", "width"), [(False, 640), (True, 640), (False, 400)])
def test_a_patterned_object_is_one_region(cut, width):
    picture, mask = drawn(cut, width)
    grey = np.repeat(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    for shown in (picture, grey):
        regions = find_regions(shown, 12)
        assert max(intersection_over_union(one, mask) for one in regions) > 0.97
        assert all(one.shape == mask.shape for one in regions)


def test_there_may_be_none():
    assert find_regions(np.full((60, 80, 3), 100, np.uint8), 12) == []
