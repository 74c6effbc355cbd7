"""The list of the best poses against brute force, and that no two of it look alike."""

import itertools

import numpy as np
import pytest

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import SettingsError
from drake_pose.search.estimates import View
from drake_pose.search.grid.beam_search import BeamSearch
from drake_pose.search.grid.distinct_poses import GridPoses
from drake_pose.search.settings import BeamSearchSettings
from drake_pose.silhouette.areas.outline import outline_from_mesh
from drake_pose.silhouette.areas.scoring import draw_mask
from tests.search.bodies import forked_body
from tests.search.grid_problems import GridProblem, ProblemMaker

INTERVAL = 0.2
ALIKE = 0.7


@pytest.fixture(scope="module")
def maker(tmp_path_factory: pytest.TempPathFactory) -> ProblemMaker:
    return ProblemMaker(forked_body(tmp_path_factory.mktemp("fork")).pose_tree(), INTERVAL)


@pytest.fixture
def problem(maker: ProblemMaker) -> GridProblem:
    return maker.make(np.random.default_rng(2), views=1, noise=0.0, on_grid=False)


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


@pytest.mark.parametrize("count", [1, 2])
def test_the_list_begins_with_the_best_and_no_two_look_alike(
    maker: ProblemMaker, count: int
) -> None:
    views = maker.make(np.random.default_rng(1), views=count, noise=0.0, on_grid=False).views
    search = BeamSearch(maker.tree, settings())
    poses = search.best_poses(views, count=8, alike=ALIKE)
    assert len(poses) == 8
    assert poses.J[0] == search.match(views).J
    assert (np.diff(poses.J) >= 0).all()
    for i, j in itertools.combinations(range(len(poses)), 2):
        assert not look_alike(maker.tree, views, poses, i, j)


def test_what_is_told_of_a_pose_belongs_together(maker: ProblemMaker, problem: GridProblem) -> None:
    search = BeamSearch(maker.tree, settings())
    poses = search.best_poses(problem.views, count=5)
    for i in range(len(poses)):
        X_WN = maker.tree.node_poses(poses.node_values[i])
        np.testing.assert_allclose(poses.X_WN[i], X_WN, atol=1e-12)
        known = (problem.choices == poses.samples[i]).all(axis=1)
        assert problem.Js[known] == poses.J[i]
        for node, values in enumerate(poses.node_values[i]):
            grid = search.sampled.values[node]
            np.testing.assert_array_equal(grid[poses.samples[i, node]], values)
    assert poses.area == problem.views[0].mask.sum()


def test_all_poses_of_the_grid_differ_if_that_is_wanted(
    maker: ProblemMaker, problem: GridProblem
) -> None:
    poses = BeamSearch(maker.tree, settings()).best_poses(problem.views, count=10, alike=2.0)
    assert len(np.unique(poses.samples, axis=0)) == 10
    np.testing.assert_array_equal(poses.J, np.sort(problem.Js)[:10])


def test_alternatives_to_an_exact_pose_are_listed_too(maker: ProblemMaker) -> None:
    search = BeamSearch(maker.tree, settings())
    problem = maker.show([grid[1] for grid in search.sampled.values])
    poses = search.best_poses(problem.views, count=6)
    assert poses.J[0] == 0.0
    assert len(poses) == 6


@pytest.mark.parametrize(("count", "alike"), [(0, 0.5), (1, 0.0)])
def test_settings_out_of_range_are_refused(
    maker: ProblemMaker, problem: GridProblem, count: int, alike: float
) -> None:
    with pytest.raises(SettingsError):
        BeamSearch(maker.tree, settings()).best_poses(problem.views, count=count, alike=alike)
