"""The coarse search finds a pose near the true one, and its kernels match plain numpy."""

from dataclasses import replace

import numpy as np
import pytest

from drake_pose.camera.models import ParallelCamera
from drake_pose.search import BeamSearchSettings, View
from drake_pose.search.coarse_search import CoarseSearch, score_samples, spread_points
from drake_pose.search.sampled_body import SampledBody
from drake_pose.silhouette.pictures.masks import signed_distances
from tests.search.arms import arm_cameras, damaged_views, draw_pose, draw_view, split

INTERVAL = np.radians(15.0)


@pytest.fixture(scope="module")
def body(tree):
    return SampledBody(tree, BeamSearchSettings(interval=INTERVAL))


def nearest(tree, X_WN, values):
    """Return the greatest error of a joint's position in the nearest pose [m]."""
    gaps = X_WN[:, :, :3, 3] - tree.node_poses(split(tree, values))[:, :3, 3]
    return float(np.linalg.norm(gaps, axis=2).max(axis=1).min())


def test_one_distinct_pose_is_near_the_true_pose(tree, body):
    values = draw_pose(tree, np.random.default_rng(41))
    search = CoarseSearch(body, damaged_views(tree, values, 1))
    poses = search.choose_distinct(search.find(), 40, 0.13)
    assert 1 <= len(poses) <= 40
    assert (np.diff(poses.costs) >= 0.0).all()
    # The arm is 1.1 m long; half a step of 15 degrees moves its end by up to 14 cm.
    assert nearest(tree, poses.X_WN, values) < 0.15
    for samples, X_WN in zip(poses.samples[:20], poses.X_WN[:20], strict=True):
        own = [grid[t] for grid, t in zip(body.sampled.values, samples, strict=True)]
        np.testing.assert_allclose(X_WN, tree.node_poses(own), atol=1e-9)


def test_searching_a_limb_again_keeps_the_other_nodes(tree, body):
    values = draw_pose(tree, np.random.default_rng(2))
    views = [draw_view(tree, values, camera) for camera in arm_cameras()]
    X_WN = tree.node_poses(split(tree, values))
    hand = len(tree.nodes) - 1
    poses = CoarseSearch(body, views).find_again(X_WN, [hand])
    np.testing.assert_array_equal(poses.X_WN[:, :hand], np.tile(X_WN[:hand], (len(poses), 1, 1, 1)))
    assert (poses.samples[:, :hand] == -1).all()
    best = body.sampled.values[hand][poses.samples[0, hand], 0]
    assert abs(best - values[-1]) <= INTERVAL


@pytest.mark.parametrize("longer", [1e3, 1e9])
def test_a_huge_focal_length_does_not_exhaust_memory(tree, body, longer):
    view = draw_view(tree, draw_pose(tree, np.random.default_rng(3)), arm_cameras()[0])
    focal = longer * arm_cameras()[0].focal_x
    wrong = View(replace(arm_cameras()[0], focal_x=focal, focal_y=focal), view.mask)
    search = CoarseSearch(body, [wrong])
    assert sum(view.cover.nbytes for view in search.views) < 1e8
    assert len(search.find()) >= 1


@pytest.mark.parametrize("parallel", [False, True])
def test_scores_match_a_direct_computation_for_each_ball(tree, body, parallel):
    """Compare with plain numpy: a ball's projection, its area outside, and the points it covers."""
    generator = np.random.default_rng(5)
    camera = arm_cameras()[0]
    values = draw_pose(tree, generator)
    seen = draw_view(tree, values, camera)
    if parallel:
        middle = camera.center_x, camera.center_y
        camera = ParallelCamera("", camera.width, camera.height, 130.0, *middle, camera.X_WC)
    search = CoarseSearch(body, [View(camera, seen.mask)])
    (view,) = search.views
    distances, points = signed_distances(seen.mask), spread_points(seen.mask)
    n, node = 20, 3
    radii, p_PB = body.ball_radii[node], body.p_PB[node]
    X_WP = tree.node_poses(split(tree, values))[[node - 1] * n]
    X_WP[:, :3, 3] += generator.uniform(-0.2, 0.2, (n, 3))
    X_CP = np.ascontiguousarray(camera.X_CW @ X_WP)
    scores = np.zeros((n, len(p_PB)))
    masks = np.zeros((n, 4), dtype=np.uint64)
    united = score_samples(view, X_CP, search.balls[node], masks, 0.8, scores)
    area = body.surface_areas[node] / len(radii)
    gaps = []
    for h, sample in np.ndindex(scores.shape):
        p_WB = p_PB[sample] @ X_WP[h, :3, :3].T + X_WP[h, :3, 3]
        uv, depth = camera.project(p_WB)
        pixels = np.full(len(uv), 130.0) if parallel else camera.focal_x / depth
        size = np.array([camera.width, camera.height])
        inside = ((uv > -0.5) & (uv < size - 0.5)).all(axis=1)
        uv, pixels, r = uv[inside], pixels[inside], (pixels * radii)[inside]
        column, row = np.rint(uv).astype(int).T
        beyond = distances[row, column] + r - view.slack
        cost = (pixels**2 * area * np.clip(beyond / (2.0 * r), 0.0, 1.0)).sum()
        level = np.searchsorted(view.radii, r + view.slack, side="right") - 1
        within = view.radii[np.maximum(level, 0)]
        far = np.linalg.norm(points[:, None] - uv[:, ::-1], axis=2)
        covered = (far <= within).any(axis=1).sum()
        gaps.append(scores[h, sample] - (0.8 * cost - covered * view.point_area))
    # The tables have the resolution of a cell, and of a quarter of a cell for distances.
    assert np.abs(gaps).max() < 0.1 * seen.mask.sum()
    assert np.abs(np.mean(gaps)) < 0.005 * seen.mask.sum()
    again = np.zeros_like(scores)
    score_samples(view, X_CP, search.balls[node], united[:, 2].copy(), 0.8, again)
    # Points that are already covered gain nothing.
    assert (again[:, 2] >= 0.0).all()
    assert (again[:, 2] > scores[:, 2]).any()
