"""Alternating estimation of pose and mask, on an arm painted over Drake's label images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from drake_pose.search import PoseAndMask, PoseAndMaskSettings
from drake_pose.search.pose_and_mask import (
    PictureLevel,
    cut_by_foreground,
    follow_colours,
    next_error,
)
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.scoring import draw_mask
from tests.registration.episodes import painted_episode


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    return painted_episode(tmp_path_factory.mktemp("arm"), frames=8)


def drawn(episode, values):
    body = episode.body
    return draw_mask(body.full, episode.camera.X_CW @ body.kinematics.poses(values), episode.camera)


def test_poses_and_masks_approach_the_ground_truth(episode):
    """A camera without an image has no mask; deviations are in units of the first error."""
    rng = np.random.default_rng(0)
    deviation = np.radians(4.0)
    starts = episode.values + rng.normal(0.0, deviation, episode.values.shape)
    settings, rounds_done = PoseAndMaskSettings(angle=deviation, rounds=2), []
    cameras = [episode.camera, replace(episode.camera, name="often blind")]
    search = PoseAndMask(episode.body.kinematics, cameras, settings)
    pictures = [[one, one if k % 4 == 0 else None] for k, one in enumerate(episode.pictures)]
    found = search.run(pictures, list(starts), rounds_done.append)
    assert rounds_done == [1, 2]
    overlaps, overlaps_before = [], []
    for one, start, true in zip(found, starts, episode.values, strict=True):
        shown = drawn(episode, true)
        overlaps.append(intersection_over_union(one.masks[0], shown))
        overlaps_before.append(intersection_over_union(drawn(episode, start), shown))
        np.testing.assert_allclose(one.deviations, (one.values - start) / deviation)
        assert one.agreements[0] > 0.8
    assert [one.masks[1] is None for one in found] == 2 * [False, True, True, True]
    assert [np.isnan(one.agreements[1]) for one in found] == 2 * [False, True, True, True]
    assert min(overlaps) > 0.9
    assert np.median(overlaps) > np.median(overlaps_before)
    off = np.abs([one.values - true for one, true in zip(found, episode.values, strict=True)])
    assert np.median(off) < 0.5 * np.median(np.abs(starts - episode.values))


def test_a_silhouette_follows_a_mask_only_near_its_edge():
    silhouette = np.zeros((120, 120), bool)
    silhouette[10:110, 10:110] = True
    mask = silhouette.copy()
    mask[:, 108:] = False
    mask[:, 111:] = True
    mask[50:60, 50:60] = False
    mask[10:110, 110] = True
    found = follow_colours(silhouette, mask)
    assert found[50:60, 50:60].all(), "inside the silhouette the mask is ignored"
    # The band has a half width of a hundredth of the size: one pixel.
    np.testing.assert_array_equal(found[40, 105:114], [1, 1, 1, 1, 0, 1, 0, 0, 0])


def test_foreground_is_cut_by_log_odds_and_by_colours():
    picture = np.full((60, 80, 3), 40, np.uint8)
    cv2.circle(picture, (40, 30), 15, (200, 180, 60), -1)
    object_ = picture[..., 0] > 100
    blurred = cv2.GaussianBlur(object_.astype(np.float32), (0, 0), 4.0)
    chance = np.clip(blurred, 0.02, 0.98)
    found = cut_by_foreground(picture, chance, np.zeros_like(chance))
    assert intersection_over_union(found, object_) > 0.97
    ratio = np.where(np.arange(80) < 40, 9.0, -9.0) * np.ones((60, 1))
    np.testing.assert_array_equal(
        cut_by_foreground(picture, np.full_like(chance, 0.5), ratio)[5:-5], ratio[5:-5] > 0.0
    )
    # Pixels of the least probability are background.
    assert not cut_by_foreground(picture, np.full_like(chance, 0.01), ratio).any()


@pytest.mark.parametrize(
    ("error", "agreements", "expected"),
    [
        (1.0, (0.95, 0.92), 0.5),
        (0.2, (0.95,), 0.14),
        (1.0, (0.95, 0.85), 0.7),
        (0.5, (0.85,), 0.4),
        (1.0, (0.7, 0.95), 1.0),
        (1.0, (np.nan, 0.95), 0.5),
    ],
)
def test_error_decreases_with_agreement(error, agreements, expected):
    assert next_error(error, agreements, PoseAndMaskSettings()) == pytest.approx(expected)


def test_reduced_images_match_their_cameras(episode):
    small = PictureLevel((episode.camera,), [[episode.pictures[0]], [None]]).downscaled(0.5)
    (camera,), ((picture,), (nothing,)) = small
    assert picture.shape == (camera.height, camera.width, 3) == (60, 80, 3)
    assert nothing is None
    whole = episode.pictures[0].reshape(60, 2, 80, 2, 3).mean(axis=(1, 3))
    assert np.abs(picture - whole).max() <= 1.0
