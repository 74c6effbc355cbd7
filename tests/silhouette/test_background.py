"""Segmentation by background models, boxes and outlines, on synthetic pictures."""

import cv2
import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.segmentation import (
    Background,
    background_of_recording,
    background_support,
    find_regions,
    foreground_log_ratios,
    grab_cut_box,
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


def test_pictures_of_different_sizes_are_refused():
    with pytest.raises(SettingsError):
        learn_background([])
    background = learn_background([np.zeros((4, 5, 3), np.uint8)])
    with pytest.raises(SettingsError):
        person_region(np.zeros((5, 4, 3), np.uint8), background)


def passing(room, shown=255.0, count=9):
    """Pictures of a room with a moving square, and the square's masks."""
    rng, pictures, masks = np.random.default_rng(2), [], []
    for k in range(count):
        mask = np.zeros(room.shape[:2], bool)
        mask[40:100, 15 * k : 15 * k + 40] = True
        picture = np.where(mask[:, :, None], shown, room) + 2.0 * rng.standard_normal(room.shape)
        pictures.append(picture.clip(0, 255).astype(np.uint8))
        masks.append(mask)
    return pictures, np.array(masks)


def test_moving_object_is_not_in_the_median_background():
    room = texture(np.random.default_rng(3))
    pictures, masks = passing(room)
    background = background_of_recording(pictures)
    np.testing.assert_allclose(background.mean, room, atol=6.0)
    np.testing.assert_allclose(background.deviation, 3.0, atol=0.1)
    support = background_support(pictures, background)
    # The white square is invisible before white parts of the wall.
    differs = room.max(axis=2) < 220.0
    hidden = 1.0 - masks.mean(axis=0)
    np.testing.assert_allclose(support[differs], hidden[differs], atol=1e-6)
    with pytest.raises(SettingsError, match="three or more"):
        background_of_recording(pictures[:2])


def test_log_ratios_hold_across_exposures():
    """A square moves in a room; half of the pictures are redder and darker."""
    room = texture(np.random.default_rng(2))
    pictures, masks = passing(room, 255.0 - room, 8)
    for k in (1, 3, 5, 7):
        pictures[k] = (pictures[k] * np.array([0.9, 0.7, 0.6])).astype(np.uint8)
    probabilities = [
        cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 5.0).clip(0.01, 0.99) for mask in masks
    ]
    differs = np.abs(255.0 - 2.0 * room).max(axis=2) > 60.0
    every = foreground_log_ratios(pictures, probabilities, range(8))
    for ratio, mask in zip(every, masks, strict=True):
        assert (ratio[~mask] < 0.0).mean() > 0.97
        assert (ratio[mask & differs] > 0.0).mean() > 0.97
    # A subset of pictures gives the same ratios where their body is likely.
    some = foreground_log_ratios(pictures, probabilities, [5, 2])
    for ratio, k in zip(some, (5, 2), strict=True):
        near = probabilities[k] > 0.02
        np.testing.assert_array_equal(ratio[near], every[k][near])
    alone = foreground_log_ratios(pictures[:1], probabilities[:1], [0])
    assert not alone[0].any()


def test_box_around_an_object_segments_it():
    rng, true = np.random.default_rng(3), np.zeros((120, 160), bool)
    true[30:90, 40:110] = True
    true[50:60, 60:80] = False
    colours = np.where(true[:, :, None], (60, 80, 190), (200, 180, 70))
    picture = (colours + 12.0 * rng.standard_normal(colours.shape)).clip(0, 255).astype(np.uint8)
    assert intersection_over_union(grab_cut_box(picture, (30, 20, 95, 85)), true) > 0.97
    for box in ((300, 20, 95, 85), (30, 20, 95, 1), (30, 20, 1, 85)):
        with pytest.raises(SettingsError, match="outside the picture, 160 x 120 pixels"):
            grab_cut_box(picture, box)
    with pytest.raises(SettingsError, match="whole picture"):
        grab_cut_box(picture, (0, 0, 160, 120))


def drawn(at_border, width):
    """A picture with half a ring and a patterned square, and the square's mask."""
    rng, height = np.random.default_rng(0), 3 * width // 4
    picture = np.full((height, width, 3), (120, 90, 60), np.uint8)
    cv2.ellipse(picture, (width // 4, height // 2), (90, 60), 20.0, 0.0, 220.0, (60, 90, 160), 20)
    turned = cv2.boxPoints(
        ((0.7 * width, (0.05 if at_border else 0.5) * height), (150.0, 110.0), 25.0)
    )
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


def test_uniform_picture_has_no_regions():
    assert find_regions(np.full((60, 80, 3), 100, np.uint8), 12) == []
