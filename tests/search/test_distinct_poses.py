"""Compare ``BeamSearch.best_poses`` with brute force; its poses differ pairwise."""

import itertools

import numpy as np
import pytest

from drake_pose.search import BeamSearch, BeamSearchSettings, samples_at
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.scoring import draw_mask
from tests.search.bodies import forked_body
from tests.search.grid_problems import ProblemMaker

INTERVAL = 0.2
OVERLAP = 0.7


@pytest.fixture(scope="module")
def maker(tmp_path_factory):
    return ProblemMaker(forked_body(tmp_path_factory.mktemp("fork")).pose_tree(), INTERVAL)


@pytest.fixture
def problem(maker):
    return maker.make(np.random.default_rng(2), views=1, noise=0.0, on_grid=False)


def settings(**more):
    return BeamSearchSettings(interval=INTERVAL, **more)


def objectives(problem, poses):
    """Return J of poses of the grid, from brute force."""
    found = [samples_at(problem.body.sampled, values) for values in poses]
    return np.array([problem.Js[(problem.choices == one).all(axis=1)][0] for one in found])


def node_masks(tree, views, values):
    """Return masks (views, nodes, H, W) of single nodes."""
    outlines = [outline_from_mesh(node.mesh) for node in tree.nodes]
    X_WN = tree.node_poses(values)[:, None]
    return np.array(
        [
            [
                draw_mask([o], v.camera.X_CW @ X, v.camera)
                for o, X in zip(outlines, X_WN, strict=True)
            ]
            for v in views
        ]
    )


def look_alike(first, second):
    """Return whether two poses are alike, by definition, from masks of their single nodes."""
    for node in range(first.shape[1]):
        is_visible = [
            (pose[:, node] & ~np.delete(pose, node, axis=1).any(axis=1)).any()
            for pose in (first, second)
        ]
        one, other = first[:, node], second[:, node]
        if any(is_visible) and (one & other).sum() < OVERLAP * (one | other).sum():
            return False
    return True


@pytest.mark.parametrize("count", [1, 2])
def test_poses_start_with_the_best_and_differ_pairwise(maker, count):
    problem = maker.make(np.random.default_rng(1), views=count, noise=0.0, on_grid=False)
    search = BeamSearch(maker.tree, settings())
    poses = search.best_poses(problem.views, count=8, overlap=OVERLAP)
    Js = objectives(problem, poses)
    assert len(poses) == 8
    assert Js[0] == search.match(problem.views).J
    assert (np.diff(Js) >= 0).all()
    masks = [node_masks(maker.tree, problem.views, pose) for pose in poses]
    for one, other in itertools.combinations(masks, 2):
        assert not look_alike(one, other)


def test_an_overlap_above_one_keeps_all_poses(maker, problem):
    poses = BeamSearch(maker.tree, settings()).best_poses(problem.views, count=10, overlap=2.0)
    np.testing.assert_array_equal(objectives(problem, poses), np.sort(problem.Js)[:10])
    assert len({tuple(np.concatenate(values)) for values in poses}) == 10
