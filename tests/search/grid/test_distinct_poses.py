"""The list of the best poses against brute force, and that no two of it look alike."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import SettingsError
from drake_pose.search.estimates import View
from drake_pose.search.grid.beam.distinct_poses import GridPoses
from drake_pose.search.grid.beam.search import BeamSearch
from drake_pose.search.scoring import SampledTree, Scoring
from drake_pose.search.settings import BeamSearchSettings, PaperSearchSettings
from drake_pose.silhouette.areas.outline import outline_from_mesh
from drake_pose.silhouette.areas.scoring import draw_mask
from tests.search.bodies import forked_body, front_camera

INTERVAL = 0.2
ALIKE = 0.7


@pytest.fixture
def tree(tmp_path: Path) -> PoseTree:
    return forked_body(tmp_path).pose_tree()


def picture(tree: PoseTree, values: list[np.ndarray], angle: float = 0.0) -> View:
    camera = front_camera(100, shift=0.137)
    X_TW = np.eye(4)
    c, s = math.cos(angle), math.sin(angle)
    X_TW[:2, :2] = [[c, -s], [s, c]]
    camera = camera.with_pose(X_TW @ camera.X_WC)
    outlines = [outline_from_mesh(node.mesh) for node in tree.nodes]
    return View(camera, draw_mask(outlines, camera.X_CW @ tree.node_poses(values), camera))


def random_values(tree: PoseTree, seed: int) -> list[np.ndarray]:
    generator = np.random.default_rng(seed)
    bounds = [tree.value_bounds(i) for i in range(len(tree.nodes))]
    return [generator.uniform(lower, upper) for lower, upper in bounds]


def settings(**more: object) -> BeamSearchSettings:
    return BeamSearchSettings(interval=INTERVAL, **more)


def look_alike(tree: PoseTree, views: list[View], poses: GridPoses, i: int, j: int) -> bool:
    """The definition, from masks of single nodes."""
    for node in range(len(tree.nodes)):
        common, union, hidden = 0, 0, True
        for view in views:
            masks = []
            for pose in (i, j):
                X_CN = view.camera.X_CW @ poses.X_WN[pose]
                drawn = [
                    draw_mask([outline_from_mesh(other.mesh)], X_CN[k : k + 1], view.camera)
                    for k, other in enumerate(tree.nodes)
                ]
                rest = np.logical_or.reduce([m for k, m in enumerate(drawn) if k != node])
                hidden = hidden and not (drawn[node] & ~rest).any()
                masks.append(drawn[node])
            common += int((masks[0] & masks[1]).sum())
            union += int((masks[0] | masks[1]).sum())
        if not hidden and common < ALIKE * union:
            return False
    return True


@pytest.mark.parametrize("angles", [[0.0], [0.0, 1.0]])
def test_the_list_begins_with_the_best_and_no_two_look_alike(
    tree: PoseTree, angles: list[float]
) -> None:
    views = [picture(tree, random_values(tree, 1), angle) for angle in angles]
    search = BeamSearch(tree, settings())
    poses = search.best_poses(views, count=12, alike=ALIKE)
    assert len(poses) == 12
    assert poses.J[0] == search.match(views).J
    assert (np.diff(poses.J) >= 0).all()
    for i, j in itertools.combinations(range(len(poses)), 2):
        assert not look_alike(tree, views, poses, i, j)


def test_what_is_told_of_a_pose_belongs_together(tree: PoseTree) -> None:
    views = [picture(tree, random_values(tree, 2))]
    search = BeamSearch(tree, settings())
    poses = search.best_poses(views, count=5)
    scoring = Scoring(SampledTree(tree, PaperSearchSettings()), views)
    for i in range(len(poses)):
        X_WN = tree.node_poses(poses.node_values[i])
        np.testing.assert_allclose(poses.X_WN[i], X_WN, atol=1e-12)
        assert scoring.J(X_WN[None])[0] == poses.J[i]
        for node, values in enumerate(poses.node_values[i]):
            grid = search.sampled.values[node]
            np.testing.assert_array_equal(grid[poses.samples[i, node]], values)
    assert poses.area == views[0].mask.sum()


def test_all_poses_of_the_grid_differ_if_that_is_wanted(tree: PoseTree) -> None:
    views = [picture(tree, random_values(tree, 3))]
    search = BeamSearch(tree, settings())
    choices = list(itertools.product(*(range(len(grid)) for grid in search.sampled.values)))
    X_WN = [
        tree.node_poses([grid[t] for grid, t in zip(search.sampled.values, choice, strict=True)])
        for choice in choices
    ]
    Js = np.sort(Scoring(search.sampled, views).J(np.array(X_WN)))
    poses = search.best_poses(views, count=10, alike=2.0)
    assert len(np.unique(poses.samples, axis=0)) == 10
    np.testing.assert_array_equal(poses.J, Js[:10])


def test_alternatives_to_an_exact_pose_are_listed_too(tree: PoseTree) -> None:
    search = BeamSearch(tree, settings())
    view = picture(tree, [grid[1] for grid in search.sampled.values])
    poses = search.best_poses([view], count=6)
    assert poses.J[0] == 0.0
    assert len(poses) == 6


def test_a_limit_leaves_a_list_that_may_be_short(tree: PoseTree) -> None:
    view = picture(tree, random_values(tree, 4))
    poses = BeamSearch(tree, settings(time_limit=0.0)).best_poses([view])
    assert len(poses) == len(poses.node_values) >= 1


@pytest.mark.parametrize(("count", "alike"), [(0, 0.5), (1, 0.0)])
def test_settings_out_of_range_are_refused(tree: PoseTree, count: int, alike: float) -> None:
    view = picture(tree, random_values(tree, 4))
    with pytest.raises(SettingsError):
        BeamSearch(tree, settings()).best_poses([view], count=count, alike=alike)
