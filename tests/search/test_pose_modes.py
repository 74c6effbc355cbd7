"""Compare the set of poses as good as the best, and its modes, with their definitions."""

import math

import numpy as np
import pytest

from drake_pose.search import View, renderer_tolerance, samples_at
from drake_pose.search.partial_poses import BoundLimits
from drake_pose.search.pose_modes import (
    cluster_samples,
    contour_length,
    estimate_joints,
    find_modes,
    grid_steps,
)
from tests.search.arms import is_held
from tests.search.bodies import box_link, forked_body, joint, load_body, swinging_chain
from tests.search.grid_problems import ProblemMaker


@pytest.fixture(scope="module")
def flipping_body(tmp_path_factory):
    """A trunk, an arm that turns towards or away from the camera alike, and a hidden knob."""
    model = load_body(
        tmp_path_factory.mktemp("flipping"),
        box_link("trunk", 14, 20),
        joint("turn", "revolute", "world", "trunk", (-0.4, 0.4)),
        box_link("arm", 4, 20, z=10.0),
        joint("flip", "revolute", "trunk", "arm", (-1.3, 1.3), axis="0 1 0", y=3.0, z=8.0),
        box_link("knob", 2, 3, z=-1.0),
        joint("spin", "revolute", "trunk", "knob", (-1.5, 1.5)),
    )
    return ProblemMaker(model.pose_tree(), 0.4)


def found_modes(problem, tolerance=None):
    samples, J = problem.best
    return find_modes(problem.body, problem.views, samples, J, tolerance)


def seen_values(problem, J, node):
    rows = np.array(sorted(problem.within(J)))
    return np.unique(problem.body.sampled.values[node][rows[:, node], 0])


def test_turns_towards_and_away_from_the_camera_are_two_modes(flipping_body):
    values = [np.array([0.4]), np.array([0.8]), np.array([-1.2])]
    problem = flipping_body.show(values)
    answer = found_modes(problem)
    assert answer.complete
    assert answer.tolerance == renderer_tolerance(problem.views)
    assert answer.contains(values)
    assert answer.mode_count == 2
    assert [mode.size for mode in answer.modes] == [7.0, 7.0]
    flips = sorted(float(mode.node_values[1][0]) for mode in answer.modes)
    assert flips == pytest.approx([-0.8, 0.8])
    turn, flip, spin = answer.joints
    assert turn.determined
    assert (turn.low, turn.high) == pytest.approx((0.2, 0.4))
    assert not flip.determined
    assert not spin.determined
    assert (spin.low, spin.high) == pytest.approx((-1.2, 1.2))
    for mode in answer.modes:
        assert [report.determined for report in mode.joints] == [True, True, False]
        assert mode.joints[1].holds(float(mode.node_values[1][0]))
    assert is_held(answer, np.concatenate(values))
    assert not is_held(answer, np.array([0.4, 0.0, 0.0]))


def test_pose_set_matches_its_definition(tmp_path):
    generator = np.random.default_rng(21)
    for model in (swinging_chain(tmp_path, 3), forked_body(tmp_path)):
        maker = ProblemMaker(model.pose_tree(), 0.4)
        for tolerance in (0.0, 25.0, 150.0):
            problem = maker.make(generator, views=1, noise=0.005, on_grid=False)
            answer = found_modes(problem, tolerance)
            J = problem.best[1] + tolerance
            expected = problem.within(J)
            assert answer.complete
            assert answer.size == len(expected) == sum(mode.size for mode in answer.modes)
            for row in problem.choices:
                values = [grid[t] for grid, t in zip(maker.body.sampled.values, row, strict=True)]
                assert answer.contains(values) == (tuple(row.tolist()) in expected)
            for node, report in enumerate(answer.joints):
                seen = seen_values(problem, J, node)
                assert report.holds(seen[0])
                assert report.holds(seen[-1])
                ends = (report.low, report.high)
                assert report.determined or ends == pytest.approx((seen[0], seen[-1]))


def test_modes_are_combinations_of_connected_clusters(flipping_body):
    problem = flipping_body.make(np.random.default_rng(22), views=1, noise=0.01, on_grid=False)
    answer = found_modes(problem, 120.0)
    J, groups = problem.best[1] + 120.0, []
    rows = np.array([*problem.within(J)])
    for node, grid in enumerate(flipping_body.body.sampled.values):
        seen = seen_values(problem, J, node)
        # Clusters are separated by more than a step of the grid.
        breaks = seen[1:][np.diff(seen) > 0.4 * 1.01]
        groups.append((grid[rows[:, node]] >= breaks - 1e-9).sum(axis=1))
    assert answer.mode_count == len(np.unique(groups, axis=1).T)
    assert [f.J for f in answer.modes] == sorted(f.J for f in answer.modes)


def test_a_better_pose_replaces_the_known_one(flipping_body):
    problem = flipping_body.make(np.random.default_rng(23), views=1, noise=0.0, on_grid=True)
    worse = int(np.argsort(problem.Js)[40])
    J = float(problem.Js[worse])
    assert J > 0.0
    answer = find_modes(problem.body, problem.views, problem.choices[worse], J, tolerance=0.0)
    assert answer.modes[0].J == problem.best[1]
    assert answer.size == len(problem.within(problem.best[1]))


@pytest.mark.parametrize("limits", [{"time_limit": 0.0}, {"states": 1}, {"pairs": 1}])
def test_a_limit_keeps_the_best_pose_and_is_reported(flipping_body, limits):
    problem = flipping_body.make(np.random.default_rng(24), views=1, noise=0.0, on_grid=False)
    samples, J = problem.best
    answer = find_modes(problem.body, problem.views, samples, J, 60.0, limits=BoundLimits(**limits))
    assert not answer.complete
    assert answer.graph.contains(samples)
    assert answer.modes[0].J == J


def test_default_tolerance_is_a_fraction_of_the_contour_length(flipping_body):
    problem = flipping_body.make(np.random.default_rng(25), views=1, noise=0.01, on_grid=True)
    assert found_modes(problem).tolerance == pytest.approx(0.05 * contour_length(problem.views))
    mask = np.zeros((70, 70), dtype=np.bool_)
    mask[10:20, 30:50] = True
    # The image border is no contour.
    mask[60:, 10:12] = True
    expected = 2 * 20 + 2 * 8 + 20
    assert contour_length([View(problem.views[0].camera, mask)]) == expected


def test_samples_with_equal_rotations_are_one_cluster(tmp_path):
    model = load_body(
        tmp_path,
        box_link("wheel", 10, 4),
        joint("spin", "revolute", "world", "wheel", (-math.pi, math.pi)),
    )
    maker = ProblemMaker(model.pose_tree(), math.pi / 4)
    values = maker.body.sampled.values[0][:, 0]
    ends = np.flatnonzero(np.abs(values) > 2.0)
    labels = cluster_samples(maker.body.sampled, 0, ends)
    assert len(set(labels[ends].tolist())) == 1
    assert set(labels.tolist()) == {-1, 0}


def test_grid_steps_of_products_and_other_grids():
    product = np.array([[0.0, 1.0, 5.0], [0.0, 3.0, 5.0], [0.5, 1.0, 5.0], [0.5, 3.0, 5.0]])
    np.testing.assert_allclose(grid_steps(product), [0.5, 2.0, np.inf])
    circle = np.array([[math.cos(a), math.sin(a)] for a in np.arange(6) * math.pi / 3])
    np.testing.assert_allclose(grid_steps(circle), [1.0, 1.0])


def test_two_neighbouring_values_are_still_determined(tmp_path):
    sampled = ProblemMaker(swinging_chain(tmp_path, 2).pose_tree(), 0.5).body.sampled
    grid = sampled.values[0][:, 0]
    pair, three = [np.flatnonzero((grid > -0.1) & (grid < limit)) for limit in (0.6, 1.1)]
    one, other = estimate_joints(sampled, [pair, three], [np.zeros(1)] * 2)
    assert one.determined
    assert (one.low, one.high) == pytest.approx((-0.25, 0.75))
    assert not other.determined or len(three) <= 2
    assert one.holds(0.75)
    assert not one.holds(0.76)


def test_a_pose_off_the_grid_has_no_samples(tmp_path):
    sampled = ProblemMaker(swinging_chain(tmp_path, 2).pose_tree(), 0.5).body.sampled
    assert samples_at(sampled, [np.array([0.5]), np.array([-1.0])]) is not None
    assert samples_at(sampled, [np.array([0.5]), np.array([-0.9])]) is None
