"""Alternating estimation of pose and mask, on an arm painted over Drake's label images."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.search import PoseAndMask, PoseAndMaskSettings, View, pose_and_mask
from drake_pose.search.partial_poses import coarsen
from drake_pose.search.parts import find_parts, find_reflections
from drake_pose.search.pose_and_mask import (
    PictureLevel,
    _Progress,
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


@pytest.fixture(scope="module")
def search(episode):
    return PoseAndMask(episode.body.kinematics, [episode.camera], PoseAndMaskSettings(angle=0.08))


def frame_of(episode, values, error=1.0, **more):
    return _Progress(values, values.copy(), np.random.default_rng(3), error, **more)


def test_initial_spreads_are_those_of_angles_and_ranges():
    """A held value has none; a length without limits has a fixed one."""
    kinematics = SimpleNamespace(
        tree=None, is_angle=np.array([True, False, False, True]),
        lower=np.array([-1.0, 0.0, -np.inf, 0.3]), upper=np.array([1.0, 0.6, np.inf, 0.3]),
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        for name in ("TreeSurfaces", "simplify_surfaces", "ContourFit"):
            patch.setattr(pose_and_mask, name, lambda *_, **__: None)
        made = PoseAndMask(kinematics, [])
    np.testing.assert_allclose(made._spread, [np.radians(5.0), 0.3, 0.05, 0.0])
    values = np.array([0.9, 0.3, 0.0, 0.3])
    drawn = made._sample(np.random.default_rng(1), values, made._spread, 4000)
    assert drawn.shape == (4000, 4)
    assert drawn[:, 0].max() == 1.0
    np.testing.assert_allclose(drawn[:, 2].std(), 0.05, rtol=0.05)
    np.testing.assert_array_equal(drawn[:, 3], 0.3)


def test_foreground_probabilities_are_fractions_of_random_poses(episode, search):
    """Blurred by the error of the surface, never certain; larger errors are wider."""
    level = PictureLevel((episode.camera,), [[episode.pictures[0]]])
    values = episode.values[0]
    (sharp,) = search._probabilities(level, frame_of(episode, values, 1e-6))
    shown = drawn(episode, values)
    assert (sharp.min(), sharp.max()) == pytest.approx((0.01, 0.99))
    inner = cv2.erode(shown.view(np.uint8), np.ones((7, 7))) > 0
    outer = cv2.dilate(shown.view(np.uint8), np.ones((9, 9))) > 0
    assert sharp[inner].mean() > 0.9
    assert sharp[~outer].max() < 0.1
    size = np.sqrt(shown.sum())
    blurred = cv2.GaussianBlur(shown.astype(np.float32), (0, 0), max(1.0, 0.02 * size))
    assert np.abs(sharp - blurred.clip(0.01, 0.99)).mean() < 0.01
    (wide,) = search._probabilities(level, frame_of(episode, values, 1.0))
    assert ((wide > 0.1) & (wide < 0.9)).sum() > 2 * ((sharp > 0.1) & (sharp < 0.9)).sum()
    assert wide.sum() == pytest.approx(sharp.sum(), rel=0.15)


def test_a_search_finds_the_pose_with_the_greatest_sum(episode, search):
    level = PictureLevel((episode.camera,), [[episode.pictures[0]]])
    true = episode.values[0]
    before = true + np.radians(np.resize([3.0, -3.0, 2.0], len(true)))
    ratios = np.where(drawn(episode, true), 3.0, -3.0).astype(np.float32)
    found = search._search(level, frame_of(episode, before), [ratios])

    def score(values):
        return float(ratios[drawn(episode, values)].sum())

    assert score(found) > score(before)
    assert intersection_over_union(drawn(episode, found), ratios > 0) > 0.93
    nothing = search._search(level, frame_of(episode, before), [np.zeros_like(ratios)])
    np.testing.assert_array_equal(nothing, before)


def test_a_pose_is_refined_to_the_masks_within_its_prior(episode, search):
    level = PictureLevel((episode.camera,), [[episode.pictures[0]]])
    true = episode.values[0]
    before = np.clip(true + 0.05, episode.body.kinematics.lower, episode.body.kinematics.upper)
    mask = drawn(episode, true)
    found = search._refine(level, frame_of(episode, before, 0.4, cuts=[mask]))
    assert intersection_over_union(drawn(episode, found), mask) > 0.95
    assert intersection_over_union(drawn(episode, found), mask) > intersection_over_union(
        drawn(episode, before), mask
    )
    for cuts in ([None], [mask & False]):
        same = search._refine(level, frame_of(episode, before, 0.4, cuts=cuts))
        np.testing.assert_array_equal(same, before)


@pytest.mark.parametrize("parallel", [False, True])
def test_coarse_views_show_what_halves_of_their_pixels_show(parallel):
    rng = np.random.default_rng(2)
    mask = cv2.GaussianBlur(rng.random((47, 62)), (0, 0), 3.0) > 0.5
    X = np.eye(4)
    camera = PinholeCamera("a", 62, 47, 80.0, 90.0, 30.2, 22.9, X)
    if parallel:
        camera = ParallelCamera("a", 62, 47, 80.0, 30.2, 22.9, X)
    view = View(camera, mask)
    assert coarsen(view, int(mask.sum())) is view
    for factor in (2, 3, 5):
        small = coarsen(view, int(mask.sum() / factor**2))
        height, width = small.mask.shape
        assert (height, width) == (-(-47 // factor), -(-62 // factor))
        for v, u in np.ndindex(height, width):
            cell = mask[factor * v : factor * (v + 1), factor * u : factor * (u + 1)]
            assert small.mask[v, u] == (2 * cell.sum() >= factor**2)
        p_W = rng.uniform((-0.3, -0.3, 1.7), (0.3, 0.3, 2.3), (5, 3))
        uv, few = camera.project(p_W)[0], small.camera.project(p_W)[0]
        np.testing.assert_allclose(factor * (few + 0.5), uv + 0.5)


def test_parts_are_ends_of_limbs_and_reflections_exchange_pairs():
    """A trunk with two arms of two links, a head, and legs of one link."""
    parents = {"trunk": -1, "l1": 0, "l2": 1, "head": 0, "r1": 0, "r2": 4, "left": 0, "right": 0}
    children = [[k for k, p in enumerate(parents.values()) if p == n] for n in range(8)]
    nodes = [
        SimpleNamespace(name=name, parent=parent, children=tuple(children[n]))
        for n, (name, parent) in enumerate(parents.items())
    ]
    below = [
        tuple(sorted([n, *[k for c in children[n] for k in (c, *children[c])]])) for n in range(8)
    ]
    tree = SimpleNamespace(
        nodes=nodes, leaves=(2, 3, 5, 6, 7), subtrees=tuple(below), source=lambda node: node
    )
    found = find_parts(tree)
    assert {one.nodes for one in found} == {(2,), (1, 2), (3,), (5,), (4, 5), (6,), (7,), (0,)}
    assert all(one.sources == one.nodes for one in found)
    (trunk,) = (one for one in found if one.nodes == (0,))
    assert trunk.held == (1, 3, 4, 6, 7)
    whole, pairs = find_reflections(tree)
    assert whole.nodes == tuple(range(8))
    partners = dict(zip(whole.nodes, whole.sources, strict=True))
    assert [partners[k] for k in range(8)] in (
        [0, 4, 5, 3, 1, 2, 7, 6], [0, 4, 5, 6, 1, 2, 3, 7], [0, 4, 5, 7, 1, 2, 6, 3],
    )  # fmt: skip
    alone = [k for k in (3, 6, 7) if partners[k] == k]
    assert (pairs.held, len(alone)) == ((alone[0],), 1)
    assert set(pairs.nodes) == set(range(8)) - set(alone)
    # Nodes that mimic their parents are no parts.
    tree.source = lambda node: nodes[node].parent if node in (2, 6) else node
    mimics = {one.nodes for one in find_parts(tree)}
    assert mimics == {(1, 2), (3,), (5,), (4, 5), (7,), (0,)}
