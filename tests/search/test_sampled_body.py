"""Precomputed balls, orders and cells of a sampled body, against brute force."""

import math
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.search import BeamSearchSettings
from drake_pose.search.pose_modes import estimate_joints
from drake_pose.search.root_placement import place_body
from drake_pose.search.sampled_body import SampledBody
from drake_pose.search.self_motions import counter_turns
from drake_pose.silhouette.scoring import draw_mask
from tests.body.models import joint, link, urdf, write


@pytest.fixture(scope="module")
def sampled(body) -> SampledBody:
    return SampledBody(body.pose_tree(), BeamSearchSettings(interval=0.5))


def test_reach_balls_contain_a_node_and_all_below_it_at_all_samples(sampled) -> None:
    nodes, grid = sampled.sampled.tree.nodes, sampled.sampled
    rng = np.random.default_rng(1)
    for _ in range(50):
        samples = np.array([[rng.integers(len(X)) for X in grid.X_PN]])
        X_WN = grid.poses(samples)[0]
        for i, node in enumerate(nodes):
            X_WP = np.eye(4) if node.parent < 0 else X_WN[node.parent]
            centre = X_WP[:3, :3] @ sampled.reach_balls[i, :3] + X_WP[:3, 3]
            for j in grid.tree.subtrees[i]:
                p = grid.outlines[j].vertices @ X_WN[j, :3, :3].T + X_WN[j, :3, 3]
                assert np.linalg.norm(p - centre, axis=1).max() <= sampled.reach_balls[i, 3] + 1e-9
            # Inscribed balls are placed with their node, the farthest from its joint first.
            own = sampled.p_PB[i][samples[0, i]] @ X_WP[:3, :3].T + X_WP[:3, 3]
            again = sampled._p_NB[i] @ X_WN[i, :3, :3].T + X_WN[i, :3, 3]
            np.testing.assert_allclose(own, again, atol=1e-9)
    for p_NB in sampled._p_NB:
        away = np.linalg.norm(p_NB[:10], axis=1)
        assert away[0] == away.max()


def test_orders_place_parents_first_and_ends_of_limbs_last(sampled) -> None:
    nodes = sampled.sampled.tree.nodes
    for order in (sampled.order, sampled.limb_order):
        assert sorted(order) == [*range(len(nodes))]
        assert all(
            order.index(n.parent) < order.index(k) for k, n in enumerate(nodes) if n.parent >= 0
        )
    for placed in map(frozenset, ((), (0,), (0, 1), (0, 2), (0, 1, 2))):
        open_nodes, waiting = sampled.frontier(placed)
        assert waiting == [
            k
            for k, n in enumerate(nodes)
            if k not in placed and (n.parent < 0 or n.parent in placed)
        ]
        assert open_nodes.tolist() == [
            k for k in sorted(placed) if any(child not in placed for child in nodes[k].children)
        ]
    assert sampled.forked == [True, False, False]


def test_mean_areas_are_those_of_drawings_from_all_sides(sampled) -> None:
    """Of convex parts; a pinhole shows them at the roots' mean distance."""
    camera = ParallelCamera("flat", 200, 200, 300.0, 99.5, 99.5, np.eye(4))
    for node, outline in enumerate(sampled.sampled.outlines):
        areas = []
        for R in Rotation.random(60, random_state=6).as_matrix():
            X_CN = np.eye(4)
            X_CN[:3, :3], X_CN[:3, 3] = R, -R @ outline.ball[:3]
            areas.append(draw_mask([outline], X_CN[None], camera).sum())
        assert sampled.mean_area(node, camera) == pytest.approx(np.mean(areas), rel=0.08)
    far = np.eye(4)
    far[:3, 3] = 0.0, 0.0, -4.0
    eye = PinholeCamera("eye", 200, 200, 500.0, 500.0, 99.5, 99.5, far)
    roots = sampled.sampled.X_PN[0][:, :3, 3]
    distances = np.linalg.norm(roots - far[:3, 3], axis=1)
    np.testing.assert_allclose(sampled.root_distances(eye), distances)
    scale = (500.0 / distances.mean() / 300.0) ** 2
    assert sampled.mean_area(1, eye) == pytest.approx(scale * sampled.mean_area(1, camera))


def test_a_placed_body_has_its_rotations_at_the_positions(sampled) -> None:
    positions = np.array([[0.1, 0.2, 0.3], [-0.4, 0.5, 0.6]])
    rotations = len(sampled.sampled.X_PN[0])
    chosen = np.array([0, rotations - 1, rotations, rotations + 2])
    found = place_body(sampled, positions, chosen)
    before, start = sampled.sampled.X_PN[0], sampled.sampled.X_PN[0][0, :3, 3]
    for sample, (place, turn) in enumerate(((0, 0), (0, rotations - 1), (1, 0), (1, 2))):
        expected = before[turn].copy()
        expected[:3, 3] += positions[place] - start
        np.testing.assert_allclose(found.sampled.X_PN[0][sample], expected)
        np.testing.assert_array_equal(
            found.sampled.values[0][sample], sampled.sampled.values[0][turn]
        )
        shift = positions[place] - start
        np.testing.assert_allclose(found.p_PB[0][sample], sampled.p_PB[0][turn] + shift)
    assert found.sampled.X_PN[1] is sampled.sampled.X_PN[1]
    np.testing.assert_array_equal(sampled.sampled.X_PN[0], before)


def chain_of(folder, *axes: str, limits: str = 'lower="-3.2" upper="3.2"') -> TreeKinematics:
    """Return a chain of links that turn about axes, 0.2 m apart."""
    parts, parent = [link("world", "")], "world"
    for k, axis in enumerate(axes):
        parts += [
            link(f"l{k}"),
            joint(f"j{k}", "revolute", parent, f"l{k}", axis=axis, limits=limits,
                  origin='xyz="0 0 0.2"'),
        ]  # fmt: skip
        parent = f"l{k}"
    return TreeKinematics(load_model(write(folder, urdf(*parts)), check=False).pose_tree())


def test_counter_turns_are_all_multiples_of_parallel_pairs(tmp_path) -> None:
    """Of angles of a chain at most one angle apart, in the sense of their axes."""
    kinematics = chain_of(tmp_path, "0 1 0", "0 0 1", "0 -1 0.05", "0 1 0")
    values = np.array([0.1, 0.0, -0.3, 0.5])
    for interval in (1.0, 2.0):
        found = counter_turns(kinematics, values, interval)
        steps = math.ceil(2.0 * math.pi / interval) - 1
        expected = []
        for (first, second, sense), step in product(
            ((0, 2, 1.0), (2, 3, 1.0)), range(1, steps + 1)
        ):
            turned = values.copy()
            turned[first] += step * interval
            turned[second] += sense * step * interval
            expected.append(turned)
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(np.exp(1j * one), np.exp(1j * other), atol=1e-9)
            assert (np.abs(one) <= 3.2).all()
    # Nothing is left within narrow limits.
    narrow = chain_of(tmp_path, "0 1 0", "0 1 0", limits='lower="-0.2" upper="0.2"')
    assert counter_turns(narrow, np.zeros(2), 0.5) == []


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
def test_intervals_of_full_turns_are_continuous(tmp_path, angles, ends, determined) -> None:
    grid = np.radians([-180.0, -120.0, -60.0, 0.0, 60.0, 120.0])
    node = SimpleNamespace(value_names=("spin",))
    tree = SimpleNamespace(
        nodes=[node], value_bounds=lambda _: (np.array([-np.pi]), np.array([np.pi])),
        covers_full_turn=lambda _: np.array([True]),
    )  # fmt: skip
    own = [int(np.argmin(np.abs(np.radians((a + 180) % 360 - 180) - grid))) for a in angles]
    stub = SimpleNamespace(tree=tree, values=[grid[:, None]])
    for about in (np.mean(ends), np.mean(ends) + 360.0):
        (one,) = estimate_joints(stub, [np.array(own)], [np.radians([about])])
        assert one.determined == determined
        found = np.degrees([one.low, one.high]) - about + np.mean(ends)
        off = (found - np.array(ends) + 180.0) % 360.0 - 180.0
        np.testing.assert_allclose(off, 0.0, atol=1e-6)
        assert one.high - one.low == pytest.approx(np.radians(ends[1] - ends[0]))
    (open_one,) = estimate_joints(stub, [np.array(own)], [np.zeros(1)], complete=False)
    assert not open_one.determined
