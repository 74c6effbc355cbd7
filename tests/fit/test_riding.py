"""Scores of a body that rides along with a camera."""

import cv2
import numpy as np
import pytest
from scipy.stats import entropy

from drake_pose.fit.background import MODEL, apply_gain, grown, likeness
from drake_pose.fit.colours import colour_numbers
from drake_pose.fit.explain_kernel import Explained, PixelSums, explain
from drake_pose.fit.riding import RidingColours, RidingPictures, silhouette_gains
from drake_pose.silhouette.outline import pack
from drake_pose.silhouette.scoring import draw_mask
from tests.registration.episodes import painted_episode

COUNT = 6


def worlds(count):
    """Return pictures (count, 60, 80, 3) of smooth random colours."""
    small = np.random.default_rng(2).uniform(0.0, 255.0, (count, 9, 12, 3))
    large = np.array([cv2.resize(one, (80, 60), interpolation=cv2.INTER_CUBIC) for one in small])
    return np.clip(large, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def wrist(tmp_path_factory):
    """Return the pictures of a painted body before a world that changes, and its silhouettes."""
    episode = painted_episode(tmp_path_factory.mktemp("wrist"), frames=COUNT, size=(80, 60))
    X_CW, outlines = episode.camera.X_CW, episode.body.coarse
    poses = np.array([X_CW @ episode.body.kinematics.poses(one) for one in episode.values])
    masks = np.array([draw_mask(outlines, X, episode.camera) for X in poses])
    pictures = np.where(masks[..., None], episode.pictures, worlds(COUNT))
    return pictures, masks, (pack(outlines), np.ascontiguousarray(poses[:, :, :3])), episode.camera


def test_gain_is_the_information_of_silhouettes_about_kinds(wrist) -> None:
    pictures, masks, (packed, X_CN), camera = wrist
    sums = RidingPictures.estimate(pictures, np.ones((COUNT, COUNT))).sums
    is_static = np.zeros(X_CN.shape[1], bool)
    totals, _ = explain(packed, X_CN, is_static, camera.kernel_parameters(), sums, 1.0, 0)
    kinds = np.moveaxis(sums.kinds, -1, 0)
    both = [np.bincount(kinds[one], minlength=len(sums.counts)) for one in (masks, ~masks)]
    separate = sum(one.sum() * entropy(one) for one in both)
    expected = kinds.size * entropy(sums.counts) - separate
    np.testing.assert_allclose(totals[Explained.GAIN], expected, rtol=1e-6)
    # By tiles the sum is the same, up to what is added to the counts.
    np.testing.assert_allclose(silhouette_gains(sums, masks).sum(), expected, rtol=0.02)
    shifted, _ = explain(
        packed,
        X_CN + np.array([0.0, 0.0, 0.0, 0.2]),
        is_static,
        camera.kernel_parameters(),
        sums,
        1.0,
        0,
    )
    assert shifted[Explained.GAIN] < 0.7 * expected


def test_kinds_that_no_silhouette_shows_have_a_finite_gain() -> None:
    """Half a pixel of each kind is added to the counts."""
    kinds = np.array([[0, 0, 1, 1, 1, 2]], np.uint8)[:, :, None]
    nothing = np.zeros((1, 6, 3), np.float32)
    sums = PixelSums(
        nothing, nothing, nothing[..., 0], nothing, kinds, np.bincount(kinds.ravel()).astype(float)
    )
    covered = np.array([[[True, True, True, False, False, False]]])
    inside, outside, both = np.array([2.5, 1.5, 0.5]), np.array([0.5, 2.5, 1.5]), [2.5, 3.5, 1.5]
    logs = [np.log(one / np.sum(one)) for one in (inside, outside, both)]
    expected = [logs[0][0] - logs[2][0]] * 2 + [logs[0][1] - logs[2][1]]
    expected += [logs[1][1] - logs[2][1]] * 2 + [logs[1][2] - logs[2][2]]
    np.testing.assert_allclose(silhouette_gains(sums, covered, squares=6)[0], expected)


def test_only_edges_that_last_count(wrist) -> None:
    """With the body in one pose its contour lasts, and the world's edges do not."""
    pictures, masks, _, _ = wrist
    held = np.where(masks[:1, ..., None], pictures[:1], worlds(20))
    edges = RidingPictures.estimate(held, np.ones((20, 20))).sums.edges.max(axis=0)
    inner = masks[0] & np.roll(masks[0], 1, 1) & np.roll(masks[0], 1, 0)
    contour = masks[0] & ~(inner & np.roll(inner, -1, 1) & np.roll(inner, -1, 0))
    far = ~np.any([np.roll(masks[0], k, a) for k in range(-3, 4) for a in (0, 1)], axis=0)
    assert edges[0][contour].mean() > edges[0][far].mean() + 0.2


def test_colours_of_the_body_segment_further_pictures(wrist) -> None:
    pictures, masks, _, _ = wrist
    riding = RidingPictures.estimate(pictures, np.ones((COUNT, COUNT)))
    known = riding.known(list(pictures), masks, masks)
    assert isinstance(known, RidingColours)
    found, tolerant = known.foreground(pictures[2], riding.gains[2])
    np.testing.assert_array_equal(found, tolerant)
    on, beside = found[masks[2]] > 0.0, found[~masks[2]] > 0.0
    assert on.mean() > 4.0 * beside.mean()


def test_mirrored_pictures_have_mirrored_sums(wrist) -> None:
    pictures, *_ = wrist
    riding = RidingPictures.estimate(pictures, np.eye(COUNT))
    mirrored = riding.mirrored()
    np.testing.assert_allclose(mirrored.sums.edges, riding.sums.edges[..., ::-1], atol=1e-5)
    np.testing.assert_array_equal(mirrored.mirrored().pictures, riding.pictures)
    assert riding.contour_terms(100.0, 4.0)[1] == pytest.approx(
        4.0 * riding.contour_terms(400.0, 4.0)[1]
    )
    assert riding.changed_frames() is None


def lasting(pictures: np.ndarray, alike: np.ndarray) -> np.ndarray:
    """Return the strength of edges across u and v in single channels (f, H, W)."""
    colours = np.repeat(pictures[..., None], 3, axis=-1).astype(np.float32)
    size = colours.shape[1:3]
    gains = tuple(np.ones(3, np.float32) for _ in colours)
    riding = RidingPictures(
        colours, gains, colours[0], np.full(size, 3.0, np.float32), alike.astype(np.float32)
    )
    return riding._lasting_edges()


def test_edges_last_by_their_mean_doubled_angle_less_that_of_chance() -> None:
    """An edge lasts whatever its sign; n random directions have a mean of 1 / sqrt(n)."""
    count, size = 9, 41
    v, u = np.mgrid[:size, :size] - size // 2
    signs = np.where(np.arange(count) % 2, 120.0, -120.0)
    least = 1.0 - 1.0 / np.sqrt(count)
    for angle, across in ((0, (1, 0)), (90, (0, 1)), (45, (1, 1)), (10, (1, 0)), (80, (0, 1))):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        step = 1.0 / (1.0 + np.exp(-2.0 * (c * u + s * v)))
        found = lasting(128.0 + signs[:, None, None] * (step - 0.5), np.ones((count, count)))
        middle = found[:, :, size // 2, size // 2]
        for k in (0, 1):
            np.testing.assert_allclose(middle[k], least * across[k], atol=0.03)
        assert not found[:, :, 2, 2].any() or angle == 45
    # Faint edges count by their slope.
    faint = 128.0 + 0.02 * signs[:, None, None] * (u > 0)
    assert lasting(faint, np.ones((count, count))).max() < 0.5 * least
    # Every image has another direction: nothing lasts, but among images with the same pose.
    turned = []
    for k in range(count):
        a = np.pi * k / count
        turned.append(128.0 + 120.0 * np.tanh(np.cos(a) * u + np.sin(a) * v))
    mixed = lasting(np.array(turned), np.ones((count, count)))
    assert mixed[:, :, size // 2, size // 2].max() < 0.05
    twice = np.array([*turned[::3]] * 3)
    alike = (np.arange(count)[:, None] % 3 == np.arange(count) % 3).astype(float)
    again = lasting(twice, alike)[0, 0, size // 2, size // 2]
    assert again == pytest.approx(1.0 - 1.0 / np.sqrt(3.0), abs=0.03)


def test_colours_of_the_body_are_means_where_it_is_seen_twice(wrist) -> None:
    """Frequencies and matches are those of the pixels inside and outside, but for a margin."""
    pictures, masks, _, _ = wrist
    riding = RidingPictures.estimate(pictures, np.ones((COUNT, COUNT)))
    known = riding.known(list(pictures), masks, masks)
    corrected = np.array([apply_gain(*p) for p in zip(pictures, riding.gains, strict=True)])
    inside = ~grown(~masks, MODEL.margin)
    count = inside.sum(axis=0)
    for v, u in np.argwhere(count > 1)[::7]:
        own = corrected[inside[:, v, u], v, u]
        np.testing.assert_allclose(known.colours[v, u], own.mean(axis=0), rtol=1e-4)
    for v, u in np.argwhere(count <= 1)[::97]:
        np.testing.assert_allclose(known.colours[v, u], riding.colours[v, u], atol=1e-3)
    np.testing.assert_allclose(known.deviations, riding.deviations, atol=1e-4)
    assert not known.unseen.any()
    off = np.abs(corrected - known.colours).max(axis=-1) / known.deviations
    match = off < MODEL.match_deviations
    outside = ~grown(masks, MODEL.margin)
    for region, rate in zip((outside, inside), known.matches, strict=True):
        assert rate == pytest.approx(np.clip(match[region].mean(), 0.05, 0.95))
    # Log-odds are those of the colour's frequency, and of its likeness to the body's.
    found, whole = known.foreground(pictures[1], riding.gains[1])
    at = corrected[1].clip(0.0, 255.0).astype(np.uint8)
    ratio = likeness(off[1].astype(np.float32))
    beside, on = known.matches
    expected = known.on[colour_numbers(at)] - known.beside[colour_numbers(at)]
    expected = expected + np.log(on * ratio + 1.0 - on) - np.log(beside * ratio + 1.0 - beside)
    np.testing.assert_allclose(whole, expected, atol=1e-3)
    part = (slice(5, 20), slice(8, 30))
    window, again = known.foreground(pictures[1], riding.gains[1], part)
    np.testing.assert_array_equal(window, found[part])
    np.testing.assert_array_equal(again, whole)


def test_estimates_have_the_noise_of_what_changes_least() -> None:
    """The body, a fifth of the picture, keeps its colours but for noise; the world does not."""
    rng, size, noise = np.random.default_rng(5), (48, 64), 6.0
    body = np.full((*size, 3), (180.0, 90.0, 60.0))
    pictures = worlds(8)[:, : size[0], : size[1]].astype(float)
    pictures[:, 24:, 10:44] = body[24:, 10:44]
    pictures = (pictures + noise * rng.normal(size=pictures.shape)).clip(0, 255).astype(np.uint8)
    riding = RidingPictures.estimate(pictures, np.ones((8, 8)))
    np.testing.assert_allclose(riding.colours, np.median(pictures, axis=0))
    inner = riding.deviations[28:44, 14:40]
    # Of the median differences' largest channel, the twentieth that is least, as of a normal one.
    changes = np.median(np.abs(riding.pictures - riding.colours).max(axis=-1), axis=0)
    assert inner.min() == pytest.approx(1.4826 * np.quantile(changes, 0.05), rel=0.05)
    assert noise * 0.6 < inner.min() < noise * 1.5
    # A pixel's kind says whether it repeats its median colour; equal colours are of one group.
    kinds = np.moveaxis(riding.sums.kinds, -1, 0)
    off = np.abs(riding.pictures - riding.colours).max(axis=-1) / riding.deviations
    np.testing.assert_array_equal(kinds % 2 == 1, off < MODEL.match_deviations)
    assert (kinds % 2)[:, 28:44, 14:40].mean() > 0.9 > 2.0 * (kinds % 2)[:, :20].mean()
    groups = kinds // 2
    assert len(np.unique(groups)) <= 12
    means = [riding.pictures[groups == k].mean(axis=0) for k in range(groups.max() + 1)]
    nearest = ((riding.pictures[:, :, :, None] - means) ** 2).sum(axis=-1).argmin(axis=-1)
    assert np.mean(nearest == groups) > 0.9
    np.testing.assert_array_equal(
        riding.sums.counts, np.bincount(kinds.ravel(), minlength=len(riding.sums.counts))
    )
    length, weight = riding.contour_terms(100.0, 4.0)
    assert weight / length == pytest.approx(2.0 / 100.0)
    assert riding.max_gain == pytest.approx(0.35 * 8 * 48 * 64)
