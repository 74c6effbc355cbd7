"""Compare the set of poses as good as the best, and its modes, with their definitions."""

import math

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from drake_pose.body import RootRotation
from drake_pose.search import View, renderer_tolerance, samples_at
from drake_pose.search.pose_modes import (
    cluster_samples,
    contour_length,
    estimate_joints,
    find_modes,
    grid_steps,
)
from drake_pose.search.sampled_body import GridSettings, SampledTree
from tests.search.arms import is_held
from tests.search.bodies import box_link, joint, load_body, swinging_chain
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
    return ProblemMaker(model.pose_tree(), interval=0.4)


def found_modes(problem, tolerance=None):
    return find_modes(problem.body, problem.views, *problem.best, tolerance)


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
    assert not answer.contains([values[0], values[1], values[2] + 0.1])
    assert answer.mode_count == 2
    assert [mode.size for mode in answer.modes] == [7.0, 7.0]
    flips = sorted(float(mode.node_values[1][0]) for mode in answer.modes)
    assert flips == pytest.approx([-0.8, 0.8])
    turn, flip, spin = answer.joints
    assert answer.determined == (True, False, False)
    assert (turn.low, turn.high) == pytest.approx((0.2, 0.4))
    assert (flip.low, flip.high) == pytest.approx((-0.8, 0.8))
    assert (spin.low, spin.high) == pytest.approx((-1.2, 1.2))
    for mode in answer.modes:
        assert [report.determined for report in mode.joints] == [True, True, False]
        assert mode.joints[1].holds(float(mode.node_values[1][0]))
    assert is_held(answer, np.concatenate(values))
    assert not is_held(answer, np.array([0.4, 0.0, 0.0]))


@pytest.mark.parametrize("tolerance", [0.0, 25.0, 150.0, None])
def test_pose_set_matches_its_definition(maker, tolerance):
    """And its modes are the combinations of clusters, which more than a step separates."""
    problem = maker.make(np.random.default_rng(21), views=1, noise=0.005)
    answer, sampled = found_modes(problem, tolerance), maker.body.sampled
    J = problem.best[1] + answer.tolerance
    if tolerance is None:
        assert problem.best[1] > renderer_tolerance(problem.views)
        assert answer.tolerance == 0.05 * contour_length(problem.views)
    expected = problem.within(J)
    assert answer.complete
    assert answer.size == len(expected)
    for row in problem.choices[::7]:
        assert answer.contains(sampled.values_at(row)) == (tuple(row.tolist()) in expected)
    joints, groups = iter(answer.joints), []
    rows = np.array(sorted(expected))
    for node, grid in enumerate(sampled.values):
        own, column = np.unique(rows[:, node], return_inverse=True)
        gaps = np.abs(grid[own][:, None] - grid[own][None]) <= grid_steps(grid) * 1.01
        same = np.abs(sampled.X_PN[node][own][:, None] - sampled.X_PN[node][own][None])
        near = gaps.all(axis=2) | (same.max(axis=(2, 3)) < 1e-6)
        groups.append(connected_components(near)[1][column])
        for k, step in enumerate(grid_steps(grid)):
            report, seen = next(joints), np.unique(grid[own, k].round(9))
            assert report.determined == (np.ptp(seen) <= step * 1.001)
            margin = 0.5 * step * report.determined
            lower, upper = maker.tree.value_bounds(node)
            ends = max(seen[0] - margin, lower[k]), min(seen[-1] + margin, upper[k])
            assert (report.low, report.high) == pytest.approx(ends)
    modes, counts = np.unique(np.transpose(groups), axis=0, return_counts=True)
    assert answer.mode_count == len(modes)
    if len(modes) <= 32:
        assert sorted(mode.size for mode in answer.modes) == sorted(counts.tolist())
    order = [(mode.J, -mode.size) for mode in answer.modes]
    assert order == sorted(order)
    assert order[0][0] == problem.best[1]
    for mode in answer.modes:
        assert mode.J == problem.objective(mode.node_values)


def test_contours_and_the_renderers_tolerance(flipping_body):
    mask = np.zeros((70, 70), dtype=np.bool_)
    mask[10:20, 30:50] = True
    # The image border is no contour.
    mask[60:, 10:12] = True
    view = View(flipping_body.cameras[0], mask)
    assert contour_length([view, view]) == 2 * (2 * 20 + 2 * 8 + 20)
    assert renderer_tolerance([view]) == math.floor(0.076 + 5.0 * 0.076**0.5 + 1.0) == 2
    assert renderer_tolerance([view] * 20) == math.floor(1.52 + 5.0 * 1.52**0.5 + 1.0) == 8


@pytest.mark.parametrize("kind", ["wheel", "free"])
def test_samples_with_equal_rotations_are_one_cluster(tmp_path, kind):
    """Neighbours across the half turn; samples half a turn apart are two clusters."""
    wheel = joint("spin", "revolute", "world", "wheel", (-math.pi, math.pi))
    model = load_body(tmp_path, box_link("wheel", 10, 4), wheel)
    if kind == "wheel":
        tree = model.pose_tree()
    else:
        rotation = RootRotation.free(interval_deg=45.0)
        tree = model.pose_tree("wheel", root_position=np.zeros(3), root_rotation=rotation)
    sampled = SampledTree(tree, GridSettings(interval=math.pi / 4))
    angles = np.linalg.norm(sampled.values[0], axis=1)
    along = np.abs(sampled.values[0][:, 0]) >= angles - 1e-9
    ends = np.flatnonzero((np.abs(angles) > 2.0) & along)
    labels = cluster_samples(sampled, 0, ends)
    assert {*labels[ends].tolist()} == {0}
    assert {*labels.tolist()} == {-1, 0}
    if kind == "wheel":
        apart = np.flatnonzero(np.isin(np.abs(sampled.values[0][:, 0]).round(6), [0.0, 3.141593]))
        assert len({*cluster_samples(sampled, 0, apart)[apart].tolist()}) == 2


def test_grid_steps_of_products_and_other_grids():
    product = np.array([[0.0, 1.0, 5.0], [0.0, 3.0, 5.0], [0.5, 1.0, 5.0], [0.5, 3.0, 5.0]])
    np.testing.assert_allclose(grid_steps(product), [0.5, 2.0, np.inf])
    circle = np.array([[math.cos(a), math.sin(a)] for a in np.arange(6) * math.pi / 3])
    np.testing.assert_allclose(grid_steps(circle), [1.0, 1.0])


@pytest.mark.parametrize(
    ("angles", "ends", "determined"),
    [
        # On a grid of 60 degrees, in degrees; a gap is wider than a step.
        ([120, 180], (90, 210), True),
        ([120, 180, -120], (120, 240), False),
        ([-180, 120], (90, 210), True),
        ([0], (-30, 30), True),
        ([0, 120], (0, 120), False),
    ],
)
def test_intervals_of_full_turns_are_continuous(tmp_path, angles, ends, determined):
    wheel = joint("spin", "continuous", "world", "wheel", (0, 0)).replace("<limit", "<!--limit")
    wheel = wheel.replace('"1"/></joint>', '"1"/--></joint>')
    tree = load_body(tmp_path, box_link("wheel", 10, 4), wheel).pose_tree()
    sampled = SampledTree(tree, GridSettings(interval=math.pi / 3))
    grid = np.degrees(sampled.values[0][:, 0])
    own = [int(np.argmin(np.abs((grid - a + 180.0) % 360.0 - 180.0))) for a in angles]
    for about in (np.mean(ends), np.mean(ends) + 360.0):
        (one,) = estimate_joints(sampled, [np.array(own)], [np.radians([about])])
        assert one.determined == determined
        found = np.degrees([one.low, one.high])
        off = found - ends
        np.testing.assert_allclose((off + 180.0) % 360.0 - 180.0, 0.0, atol=1e-6)
        assert np.ptp(found) == pytest.approx(np.ptp(ends))
        assert len(angles) == 1 or abs(found.mean() - about) < 180.0
    (open_one,) = estimate_joints(sampled, [np.array(own)], [np.zeros(1)], complete=False)
    assert not open_one.determined


def test_samples_of_poses_on_the_grid_alone(tmp_path):
    sampled = ProblemMaker(swinging_chain(tmp_path, 2).pose_tree(), interval=0.5).body.sampled
    found = samples_at(sampled, [np.array([0.5]), np.array([-1.0])])
    np.testing.assert_allclose(np.concatenate(sampled.values_at(found)), [0.5, -1.0])
    assert samples_at(sampled, [np.array([0.5]), np.array([-0.99999])]) is None
