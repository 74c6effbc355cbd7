"""Compare the branch and bound with brute force over whole grids."""

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.search.branch_and_bound import branch_and_bound
from drake_pose.search.partial_poses import BoundLimits
from tests.search.bodies import box_link, joint, load_body
from tests.search.grid_problems import ProblemMaker


def members(graph, problem):
    return {tuple(row) for row in problem.choices.tolist() if graph.contains(np.array(row))}


@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize("extra", [-1.0, 0.0, 3.0, 40.0, 400.0])
def test_finds_exactly_the_poses_within_the_limit(maker, views, extra):
    generator = np.random.default_rng(1)
    for noise, on_grid in [(0.0, True), (0.0, False), (0.01, True)]:
        problem = maker.make(generator, views=views, noise=noise, on_grid=on_grid)
        limit = problem.best[1] + extra
        found = branch_and_bound(maker.body, problem.views, limit)
        expected, graph = problem.within(limit), found.graph
        assert (found.complete, found.limited, found.J_limit) == (True, False, limit)
        assert graph.size == len(expected)
        assert graph.best_J == (problem.best[1] if expected else np.inf)
        Js = [graph.objective(row) for row in problem.choices]
        known = np.array([np.inf if J is None else J for J in Js])
        np.testing.assert_array_equal(known, np.where(problem.Js <= limit, problem.Js, np.inf))
        beyond = problem.Js[problem.Js > limit]
        assert found.lower_bound <= beyond.min(initial=np.inf)
        if extra < 0.0:
            assert found.lower_bound == problem.best[1]
        rows = np.array(sorted(expected)).reshape(-1, len(maker.tree.nodes))
        for used, column in zip(graph.samples_used(), rows.T, strict=True):
            np.testing.assert_array_equal(used, np.unique(column))


@pytest.mark.parametrize(
    "limits", [{"states": 3}, {"pairs": 5}, {"time_limit": 0.0}, {"poses": 20}, {"memory": 20_000}]
)
def test_poses_left_out_are_not_below_the_lower_bound(maker, limits):
    problem = maker.make(np.random.default_rng(3), views=1, noise=0.02)
    J = problem.best[1]
    found = branch_and_bound(maker.body, problem.views, J + 60.0, BoundLimits(**limits))
    assert (found.complete, found.limited) == (False, True)
    there = members(found.graph, problem)
    assert there <= problem.within(J + 60.0)
    left_out = [tuple(row) not in there for row in problem.choices.tolist()]
    assert problem.Js[left_out].min() >= found.lower_bound
    for name, value in limits.items():
        with pytest.raises(SettingsError, match=name):
            BoundLimits(**{name: value - value - 1})


def test_all_poses_of_hidden_limbs_are_counted(tmp_path):
    """A broad trunk hides two short arms of two links each at every angle."""
    parts = [
        box_link("trunk", 40, 40),
        joint("trunk_turn", "revolute", "world", "trunk", (0.0, 0.0)),
    ]
    for side, y in (("left", 5.0), ("right", -5.0)):
        upper, lower = f"{side}_upper", f"{side}_lower"
        parts += [
            box_link(upper, 3, 6, z=-3.0),
            joint(f"{side}_shoulder", "revolute", "trunk", upper, (-1.5, 1.5), y=y),
            box_link(lower, 3, 6, z=-3.0),
            joint(f"{side}_elbow", "revolute", upper, lower, (-1.5, 1.5), z=-5.0),
        ]
    maker = ProblemMaker(load_body(tmp_path, *parts).pose_tree(), interval=0.5)
    view = maker.draw([grid[0] for grid in maker.body.sampled.values], maker.cameras[0])
    found = branch_and_bound(maker.body, maker.problem(view).views, 0.0)
    assert found.complete
    assert found.graph.size == len(maker.choices) == 7**4
    # All poses of a hidden limb's end lead to the same state.
    assert sum(len(layer.samples) for layer in found.graph.layers) == 1 + 7 + 7**2 + 7**3 + 7**2


def test_restricting_limit_or_samples_removes_poses(maker):
    problem = maker.make(np.random.default_rng(7), views=1)
    best = problem.best[1]
    graph = branch_and_bound(maker.body, problem.views, best + 100.0).graph
    assert tuple(graph.central().tolist()) in problem.within(best)
    assert members(graph.up_to(best + 30.0), problem) == problem.within(best + 30.0)
    allowed = [np.ones(len(grid), dtype=np.bool_) for grid in maker.body.sampled.values]
    allowed[1][1::2] = False
    expected = {row for row in problem.within(best + 100.0) if row[1] % 2 == 0}
    assert members(graph.restricted(allowed), problem) == expected
    nothing = graph.restricted([np.zeros_like(one) for one in allowed])
    assert nothing.size == 0.0
    with pytest.raises(ValueError, match="empty"):
        nothing.central()
