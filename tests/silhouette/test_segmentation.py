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
    np.testing.assert_array_equal(still.with_noise(2.0).deviation, 6.0)
    assert (still.with_noise(90.0).tolerance == 255).all()


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
    if seed % 7 == 0:
        # A ring of 24 pixels, whose hole is no patch, and a patch in it that is too small.
        deviation[:] = 3.0
        picture[4:28, 4:28] = np.where(mean[4:28, 4:28] < 128, 255, 0)
        picture[10:22, 10:22] = mean[10:22, 10:22]
        picture[14:17, 14:17] = np.where(mean[14:17, 14:17] < 128, 255, 0)
    off = np.abs(picture.astype(int) - mean) > np.floor(5.0 * deviation)[:, :, None]
    square = np.ones((3, 3), np.uint8)
    expected = off.any(axis=2).astype(np.uint8)
    for step in (cv2.MORPH_OPEN, cv2.MORPH_CLOSE):
        expected = cv2.morphologyEx(expected, step, square)
    _, labels = cv2.connectedComponents(expected, connectivity=8)
    areas = np.bincount(labels.ravel())[1:]
    kept = 1 + np.flatnonzero(areas >= 0.1 * areas.max(initial=0))
    background = Background(mean, deviation)
    region = person_region(picture, background)
    np.testing.assert_array_equal(region, np.isin(labels, kept))
    # A fourth channel is ignored.
    np.testing.assert_array_equal(
        person_region(np.dstack([picture, picture[..., 0]]), background), region
    )
    assert region.any() == bool(expected.any())


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
        (lambda: background_of_recording([*pictures, pictures[0][1:]]), "one size"),
        (lambda: learn_background([]), "one or more"),
        (lambda: person_region(pictures[0][:-1], background), "background"),
    ):
        with pytest.raises(SettingsError, match=message):
            refused()


@pytest.mark.parametrize(
    ("box", "hole", "is_filled"),
    [
        (np.s_[30:90, 40:120], np.s_[40:80, 50:110], True),
        # An area that is enclosed together with the picture's border is smaller than a tenth.
        (np.s_[0:60, 40:120], np.s_[0:18, 60:80], True),
        (np.s_[0:60, 40:120], np.s_[0:30, 60:90], False),
        (np.s_[60:120, 40:120], np.s_[102:120, 60:80], True),
        (np.s_[30:90, 0:80], np.s_[40:60, 0:18], True),
    ],
)
def test_regions_have_no_holes(box, hole, is_filled):
    expected, picture = np.zeros((120, 160), bool), np.full((120, 160, 3), 60, np.uint8)
    picture[box], expected[box] = 200, True
    picture[hole] = 60
    expected[hole] = is_filled
    other = expected.copy()
    other[hole] = not is_filled
    found = find_regions(picture, 4)
    best, worse = (max(intersection_over_union(m, k) for m in found) for k in (expected, other))
    assert best > max(0.88, worse)


def test_regions_have_a_fair_size_and_differ():
    """From .3 to 70 % of the picture; other regions of one channel overlap less than .85."""
    for side, is_found in ((5, False), (10, True), (96, True), (115, False)):
        picture, square = np.full((120, 120, 3), 60, np.uint8), np.zeros((120, 120), bool)
        first = (120 - side) // 2
        square[first : first + side, first : first + side] = True
        picture[square] = 200
        found = find_regions(picture, 8)
        best = max((intersection_over_union(one, square) for one in found), default=0.0)
        assert (best > 0.5) == is_found
        assert len(find_regions(picture, 1)) <= 1
        for k, one in enumerate(found):
            assert all(intersection_over_union(one, other) < 0.9 for other in found[:k])
    assert find_regions(np.full((60, 80, 3), 100, np.uint8), 12) == []


def test_the_regions_with_the_strongest_outlines_come_first():
    picture = np.full((120, 160, 3), 60, np.uint8)
    for left, level in ((20, 130), (90, 200)):
        picture[30:70, left : left + 40] = level
    for count in (1, 2):
        found = find_regions(picture, count)
        assert [int(np.median(picture[one])) for one in found] == [200, 130][:count]


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


@pytest.mark.parametrize(("at_border", "width"), [(False, 560), (True, 400)])
def test_patterned_object_is_one_region(at_border, width):
    picture, mask = drawn(at_border, width)
    grey = np.repeat(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    for shown in (picture, grey):
        regions = find_regions(shown, 12)
        assert max(intersection_over_union(one, mask) for one in regions) > 0.97
        assert all(one.shape == mask.shape for one in regions)
