"""Segmentation by background models and outlines, on synthetic pictures."""

import cv2
import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.segmentation import (
    Background,
    background_of_recording,
    find_regions,
    learn_background,
    person_region,
)
from tests.jobs.masks.rooms import texture


def test_background_is_the_mean_and_deviation_of_pictures():
    pictures = np.random.default_rng(0).integers(0, 256, (8, 9, 12, 3)).astype(np.uint8)
    found = learn_background([*pictures[:7], pictures[7]])
    np.testing.assert_array_equal(found.mean, np.rint(pictures.mean(axis=0)))
    deviation = np.sqrt(pictures.astype(float).var(axis=0).mean(axis=-1))
    np.testing.assert_allclose(found.deviation, deviation, rtol=1e-5)
    still = learn_background([pictures[0]] * 2)
    np.testing.assert_array_equal(still.deviation, 3.0)


@pytest.mark.parametrize("seed", range(40))
def test_person_region_matches_its_definition(seed):
    # In small pictures patches meet the border and each other, or are missing.
    generator = np.random.default_rng(seed)
    shape = tuple(generator.integers(3, 45, 2))
    mean = generator.integers(0, 256, (*shape, 3)).astype(np.uint8)
    deviation = generator.uniform(3.0, 70.0, shape).astype(np.float32)
    noise = generator.normal(0.0, 1.5 * deviation[:, :, None], mean.shape)
    picture = np.clip(mean + noise, 0, 255).astype(np.uint8)
    for _ in range(seed % 7):
        top, left = (int(generator.integers(0, n)) for n in shape)
        patch = slice(top, top + 9), slice(left, left + 6)
        picture[patch] = np.where(mean[patch] < 128, 255, 0)
        deviation[patch] = 3.0
    off = np.abs(picture.astype(int) - mean) > np.floor(5.0 * deviation)[:, :, None]
    square = np.ones((3, 3), np.uint8)
    expected = off.any(axis=2).astype(np.uint8)
    for step in (cv2.MORPH_OPEN, cv2.MORPH_CLOSE):
        expected = cv2.morphologyEx(expected, step, square)
    _, labels = cv2.connectedComponents(expected, connectivity=8)
    areas = np.bincount(labels.ravel())[1:]
    kept = 1 + np.flatnonzero(areas >= 0.1 * areas.max(initial=0))
    region = person_region(picture, Background(mean, deviation))
    np.testing.assert_array_equal(region, np.isin(labels, kept))
    assert region.any() == bool(expected.any())


def test_small_patches_are_dropped_beside_a_ring():
    """A patch of a tenth of the ring's area stays; the ring's hole is no patch."""
    background = Background(np.zeros((60, 120, 3), np.uint8), np.ones((60, 120), np.float32))
    picture = np.zeros((60, 120, 3), np.uint8)
    picture[6:46, 6:46] = 200
    picture[16:36, 16:36] = 0
    ring = picture[..., 0] > 0
    for side, stays in ((10, False), (12, True)):
        other = picture.copy()
        other[20 : 20 + side, 80 : 80 + side] = 90
        expected = other[..., 0] > 0 if stays else ring
        np.testing.assert_array_equal(person_region(other, background), expected)
        seen = np.dstack([other, np.full((60, 120), 77, np.uint8)])
        np.testing.assert_array_equal(person_region(seen, background), expected)
    np.testing.assert_array_equal(person_region(picture, background), ring)
    few = person_region(picture, background.with_noise(50.0))
    assert not few.any()
    np.testing.assert_array_equal(background.with_noise(2.0).deviation, 2.0)


def test_moving_object_is_not_in_the_median_background():
    rng, pictures = np.random.default_rng(2), []
    room = texture(np.random.default_rng(3))
    for k in range(9):
        picture = room + 2.0 * rng.standard_normal(room.shape)
        picture[40:100, 15 * k : 15 * k + 40] = 255.0
        pictures.append(picture.clip(0, 255).astype(np.uint8))
    background = background_of_recording(pictures)
    np.testing.assert_allclose(background.mean, room, atol=6.0)
    np.testing.assert_allclose(background.deviation, 3.0, atol=0.1)
    for refused, message in (
        (lambda: background_of_recording(pictures[:2]), "three or more"),
        (lambda: learn_background([]), ""),
        (lambda: person_region(pictures[0][:-1], background), ""),
    ):
        with pytest.raises(SettingsError, match=message):
            refused()


@pytest.mark.parametrize("width", [480, 960])
def test_regions_of_large_pictures_have_sharp_edges(width):
    """A disc on a slope of colour, as it is at full size."""
    height = 3 * width // 4
    v, u = np.mgrid[:height, :width]
    disc = np.hypot(u - 0.55 * width, v - 0.5 * height) < 0.17 * width
    grey = 60.0 + 60.0 * u / width + 60.0 * disc
    picture = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)
    best = max(find_regions(picture, 6), key=lambda one: intersection_over_union(one, disc))
    assert intersection_over_union(best, disc) > 0.98
    assert len(find_regions(picture, 2)) == 2
    assert find_regions(np.full((60, 80, 3), 100, np.uint8), 12) == []


def drawn(at_border, width):
    """A picture with half a ring and a patterned square, and the square's mask."""
    rng, height = np.random.default_rng(0), 3 * width // 4
    picture = np.full((height, width, 3), (120, 90, 60), np.uint8)
    cv2.ellipse(picture, (width // 4, height // 2), (90, 60), 20.0, 0.0, 220.0, (60, 90, 160), 20)
    middle = 0.7 * width, (0.05 if at_border else 0.5) * height
    turned = cv2.boxPoints((middle, (150.0, 110.0), 25.0))
    mask = cv2.fillPoly(np.zeros((height, width), np.uint8), [turned.astype(np.int32)], 1) > 0
    picture[mask] = 225
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    inner = cv2.erode(mask.view(np.uint8), np.ones((25, 25), np.uint8), borderValue=0) > 0
    picture[inner & ((u // 9 + v // 9) % 2 == 0)] = 20
    noisy = picture + rng.normal(0.0, 6.0, picture.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8), mask


@pytest.mark.parametrize(("at_border", "width"), [(False, 640), (True, 640), (False, 400)])
def test_patterned_object_is_one_region(at_border, width):
    picture, mask = drawn(at_border, width)
    grey = np.repeat(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    for shown in (picture, grey):
        regions = find_regions(shown, 12)
        assert max(intersection_over_union(one, mask) for one in regions) > 0.97
        assert all(one.shape == mask.shape for one in regions)
