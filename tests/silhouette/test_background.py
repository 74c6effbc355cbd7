"""Segmentation by background models, boxes and outlines, on synthetic pictures."""

import cv2
import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.segmentation import (
    Background,
    _components,
    _filled,
    _strength,
    background_of_recording,
    background_support,
    find_regions,
    foreground_log_ratios,
    grab_cut,
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


def test_log_ratios_match_their_definition():
    """Pixel by pixel, with medians of the pictures that show the background."""
    rng, count, size = np.random.default_rng(6), 5, (6, 7)
    colours = rng.uniform(40.0, 200.0, (*size, 3))
    gain = np.array([[1.0, 1.0, 1.0], [0.8, 0.9, 1.1], [1.2, 1.0, 0.9], [1.0, 0.8, 1.0], [1, 1, 1]])
    pictures = [
        (colours * one + rng.normal(0.0, 5.0, colours.shape)).clip(0, 255).astype(np.uint8)
        for one in gain
    ]
    probabilities = [rng.choice([0.0, 0.02, 0.2, 0.9], size).astype(np.float32) for _ in gain]
    for one in probabilities:
        one[:2] = 0.0
    wanted = [1, 3]
    found = foreground_log_ratios(pictures, probabilities, wanted, break_even=2.0, bounds=(-2.5, 7))
    always = np.max(probabilities, axis=0) < 0.05
    floats = np.array(pictures, float)
    usual = np.median(floats[:, always], axis=0)
    gains = np.median((floats[:, always] + 1.0) / (usual + 1.0), axis=1)
    even = np.minimum(floats / gains[:, None, None], 255.0)
    for k, ratio in zip(wanted, found, strict=True):
        for v, u in np.ndindex(*size):
            if max(probabilities[j][v, u] for j in wanted) < 0.011:
                assert ratio[v, u] == -2.5
                continue
            shown = [j for j in range(count) if probabilities[j][v, u] < 0.1]
            if len(shown) < 2:
                assert ratio[v, u] == 0.0
                continue
            middle = np.median(even[shown, v, u], axis=0)
            spread = 1.4826 * np.median(np.abs(even[shown, v, u] - middle), axis=0).mean()
            sd = 9.0 if len(shown) == 2 else max(4.0, spread)
            squares = ((even[k, v, u] - middle) ** 2).mean() / sd**2
            assert ratio[v, u] == pytest.approx(
                np.clip(0.5 * (squares - 4.0), -2.5, 7), rel=1e-4, abs=1e-4
            )
    # Of more pictures than allowed every n-th gives the background.
    repeated = [k for k in range(count) for _ in range(3)]
    some, all_of_them = (
        foreground_log_ratios(
            [pictures[k] for k in repeated],
            [probabilities[k] for k in repeated],
            [3],
            max_count=most,
        )[0]
        for most in (5, 15)
    )
    np.testing.assert_allclose(
        some[3:], found_once(pictures, probabilities)[3:], rtol=1e-4, atol=1e-4
    )
    assert np.abs(some - all_of_them).max() > 0.01


def found_once(pictures, probabilities):
    return foreground_log_ratios(pictures, probabilities, [1])[0]


def test_strided_grab_cut_learns_colours_from_few_pixels():
    rng, true = np.random.default_rng(4), np.zeros((90, 120), bool)
    true[30:60, 40:90] = True
    colours = np.where(true[:, :, None], (60, 80, 190), (200, 180, 70))
    picture = (colours + 12.0 * rng.standard_normal(colours.shape)).clip(0, 255).astype(np.uint8)
    labels = np.full(true.shape, cv2.GC_BGD, np.uint8)
    labels[20:70, 30:100] = cv2.GC_PR_FGD
    labels[40:45, 50:60] = cv2.GC_FGD
    given = labels.copy()
    for stride in (1, 3):
        found = grab_cut(picture, labels, stride=stride)
        assert intersection_over_union(found, true) > 0.99
        np.testing.assert_array_equal(labels, given)
        assert not found[:20].any()
    # Nothing is uncertain: the labels are the answer.
    labels[labels == cv2.GC_PR_FGD] = cv2.GC_BGD
    np.testing.assert_array_equal(grab_cut(picture, labels), labels == cv2.GC_FGD)


def test_components_are_filled_and_neither_tiny_nor_huge():
    """At most the area is limited after filling, at least before."""
    above = np.zeros((100, 100), bool)
    above[10:40, 10:40] = True
    above[20:30, 20:30] = False
    above[60:65, 60:66] = True
    above[80:85, 80:86] = True
    above[82, 82] = False
    (ring, spot), expected = _components(above), np.zeros((100, 100), bool)
    expected[10:40, 10:40] = True
    np.testing.assert_array_equal(ring, expected)
    assert np.count_nonzero(spot) == 30
    frame = np.ones((100, 100), bool)
    frame[8:92, 8:92] = False
    assert [*_components(frame)] == []
    (thinner,) = _components(frame, (0.003, 1.0))
    assert thinner.all()
    # What a region and the border enclose is a hole if it is small.
    cut = np.zeros((50, 60), bool)
    cut[5:45, :40] = True
    for rows, fills in ((6, True), (9, False)):
        bay = cut.copy()
        bay[20 : 20 + rows, :20] = False
        assert _filled(bay)[20 : 20 + rows, :20].all() == fills


def test_strength_is_a_quantile_of_the_change_along_the_outline():
    mask = np.zeros((30, 40), bool)
    mask[10:20, 10:30] = True
    change = np.zeros((30, 40), np.float32)
    change[10:20, 10:30] = 100.0
    change[11:19, 11:29] = 1e4
    for columns in (0, 10, 12, 16):
        change[10, 10 : 10 + columns] = 20.0
        edge = np.sort(np.r_[np.full(columns, 20.0), np.full(56 - columns, 100.0)])
        expected = np.quantile(edge, 0.25) * np.sqrt(200.0)
        assert _strength(mask, change) == pytest.approx(expected)
    assert _strength(np.ones((5, 5), bool), np.ones((5, 5), np.float32)) == 0.0


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
