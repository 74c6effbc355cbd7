"""Scores of colour images: against sums over masks, and against painted images."""

import numpy as np
import pytest

from drake_pose.fit.background import (
    Backgrounds,
    KnownBackground,
    apply_gain,
    estimate_gain,
    foreground_of_colours,
    foreground_picture,
    mask_of_foreground,
    mask_reach,
    window_around,
)
from drake_pose.fit.colours import COLOURS, Colour
from drake_pose.fit.explain_kernel import Explained, explain_poses
from drake_pose.silhouette.outline import pack
from drake_pose.silhouette.scoring import draw_mask
from tests.registration.episodes import painted_episode


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    return painted_episode(tmp_path_factory.mktemp("arm"), frames=6, size=(80, 60))


def draw_masks(episode, X_CW):
    """Return (f, H, W) masks of the body, and the surfaces and poses for ``explain_poses``."""
    outlines = episode.body.coarse
    poses = [X_CW @ episode.body.kinematics.poses(values) for values in episode.values]
    masks = np.array([draw_mask(outlines, X, episode.camera) for X in poses])
    return masks, (pack(outlines), np.ascontiguousarray(np.array(poses)[:, :, :3]))


def test_explain_sums_log_likelihoods_over_pixels(episode):
    backgrounds = Backgrounds.estimate(episode.pictures)
    sums = backgrounds.sums
    masks, (packed, X_CN) = draw_masks(episode, episode.camera.X_CW)
    is_static = np.zeros(X_CN.shape[1], bool)
    parameters, here = episode.camera.kernel_parameters(), np.eye(4)[None, :3]
    (totals,), tiles = explain_poses(packed, here, X_CN, is_static, parameters, sums, 20.0, 4)
    covered = np.moveaxis(masks, 0, -1)
    each = sums.visible + np.where(covered[..., None], sums.covered, 0.0).sum(axis=2)
    gain = each.max(axis=-1) - sums.uncovered
    always = covered.all(axis=-1)
    gain[always] = 0.3 * np.maximum(gain[always], 0.0)
    gain[~covered.any(axis=-1)] = 0.0
    assert totals[Explained.AREA] == masks.sum()
    np.testing.assert_allclose(totals[Explained.GAIN], gain.sum(), rtol=1e-4)
    by_square = np.add.reduceat(np.add.reduceat(gain, [0, 20, 40], 0), [0, 20, 40, 60], 1)
    np.testing.assert_allclose(tiles[:3], by_square, rtol=1e-3, atol=1e-2)


def test_outline_pixels_have_uncovered_neighbours(episode):
    sums = Backgrounds.estimate(episode.pictures).sums
    masks, (packed, X_CN) = draw_masks(episode, episode.camera.X_CW)
    parameters = episode.camera.kernel_parameters()
    for is_static in (False, True):
        stands = np.full(X_CN.shape[1], is_static)
        here = np.eye(4)[None, :3]
        (totals,), _ = explain_poses(packed, here, X_CN, stands, parameters, sums, 1.0, 0)
        inner = np.pad(masks, ((0, 0), (1, 1), (1, 1)), mode="edge")
        left, right = inner[:, 1:-1, :-2], inner[:, 1:-1, 2:]
        above, below = inner[:, :-2, 1:-1], inner[:, 2:, 1:-1]
        across_u, across_v = masks & ~(left & right), masks & ~(above & below)
        assert totals[Explained.OUTLINE] == (across_u | across_v).sum()
        edges = zip((across_u, across_v), sums.edges, strict=True)
        u, v = (np.where(across, edge, -np.inf) for across, edge in edges)
        strongest = np.maximum(u, v)[across_u | across_v]
        np.testing.assert_allclose(totals[Explained.CONTOUR], strongest.sum(), rtol=1e-4)
        # Static nodes belong to the background and score no gain.
        assert (totals[Explained.GAIN] == 0.0) == is_static


def test_photometric_gain_ignores_outliers():
    rng = np.random.default_rng(0)
    reference = rng.uniform(40.0, 200.0, (40, 50, 3)).astype(np.float32)
    gain, offset = np.array([0.8, 1.1, 1.2]), np.array([10.0, -5.0, 3.0])
    picture = ((reference - offset) / gain).astype(np.float32)
    picture[:15, :20] = 0.0
    fitted_gain = estimate_gain(picture, reference)
    np.testing.assert_allclose(fitted_gain[:, :3], np.diag(gain), rtol=0.01)
    np.testing.assert_allclose(fitted_gain[:, 3], offset, atol=1.0)
    np.testing.assert_allclose(apply_gain(picture, fitted_gain)[20:], reference[20:], atol=0.5)


def test_log_odds_are_positive_on_the_body(episode):
    """The background is estimated where a frame shows it, and log-odds are positive on the body."""
    covered, _ = draw_masks(episode, episode.camera.X_CW)
    backgrounds = Backgrounds.estimate(episode.pictures)
    showing = backgrounds.shows_background(covered)
    assert not (showing & covered).any()
    known = KnownBackground.estimate(list(episode.pictures), backgrounds.gains, showing, covered)
    assert (known.unseen == ~showing.any(axis=0)).mean() > 0.99
    visible = ~known.unseen
    assert np.median(np.abs(known.colours - episode.background).max(axis=-1)[visible]) < 6.0
    frames = zip(episode.pictures, backgrounds.gains, covered, strict=True)
    for picture, fitted_gain, mask in frames:
        foreground, tolerant = known.foreground(picture, fitted_gain, np.s_[:, :])
        assert ((foreground > 0.0) == mask)[visible].mean() > 0.97
        found = mask_of_foreground(foreground, mask, foreground)
        # The mask of a picture is that of the window around the body.
        window = window_around(mask, mask_reach(mask) + 8)
        there, tolerant_again = known.foreground(picture, fitted_gain, window)
        np.testing.assert_array_equal(there, foreground[window])
        np.testing.assert_array_equal(tolerant_again, tolerant)
        whole = mask_of_foreground(foreground, mask, tolerant)
        own = mask_of_foreground(there, mask[window], tolerant[window])
        np.testing.assert_array_equal(own, whole[window])
        assert own.sum() == whole.sum()
        assert (found & mask).sum() / (found | mask).sum() > 0.85


def test_log_odds_images_decode_to_their_values():
    foreground = np.linspace(-9.0, 9.0, 120, dtype=np.float32).reshape(10, 12)
    picture = foreground_picture(foreground)
    red, green, blue = np.moveaxis(picture.astype(np.intp) >> 4, -1, 0)
    table = foreground_of_colours(2)
    assert table.shape == (2, 3, COLOURS)
    read = np.log(table[1, Colour.FOREGROUND][(red * 16 + green) * 16 + blue])
    np.testing.assert_allclose(read, np.clip(foreground, -8.0, 8.0), atol=0.01)


def test_masks_lose_the_halo_of_an_encoder_and_keep_faint_parts():
    body = np.zeros((60, 80), bool)
    body[20:40, 20:60] = True
    halo = np.pad(body, 2)[4:, 2:-2] | body
    as_is = np.where(halo | body, 2.0, -2.0).astype(np.float32)
    tolerant = np.where(body, 2.0, -2.0).astype(np.float32)
    # Inside, a part that looks like the background is no halo.
    tolerant[28:32, 30:50] = -2.0
    np.testing.assert_array_equal(mask_of_foreground(as_is, body, as_is), halo)
    np.testing.assert_array_equal(mask_of_foreground(as_is, body, tolerant), body)
