"""Flips and counter-turns of chains, by the pose tree instead of the compiled kinematics."""

import math
from itertools import product

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.search.self_motions import counter_turns, flips
from tests.body.models import joint, link, urdf, write
from tests.search.arms import split

TRUTH = np.array([0.6, 0.7, -0.7, 0.9, 0.3])
FULL = 'lower="-3.2" upper="3.2"'


@pytest.fixture(scope="module")
def kinematics(tree):
    return TreeKinematics(tree)


def chain_of(folder, *axes: str, limits: str | None = FULL, last: str = "0 0 0.2"):
    """Return a chain of links that turn about axes, 0.2 m apart; ``last``: the last one's place."""
    parts, parent = [link("world", "")], "world"
    for k, axis in enumerate(axes):
        origin = f'xyz="{last if k == len(axes) - 1 else "0 0 0.2"}"'
        kind = "continuous" if limits is None else "revolute"
        parts.append(link(f"l{k}"))
        parts.append(joint(f"j{k}", kind, parent, f"l{k}", axis=axis, limits=limits, origin=origin))
        parent = f"l{k}"
    return TreeKinematics(load_model(write(folder, urdf(*parts)), check=False).pose_tree())


def moved(kinematics, one, other):
    """Return the greatest change of a node's pose, by node."""
    X = [kinematics.tree.node_poses(split(kinematics.tree, values)) for values in (one, other)]
    return np.abs(X[0] - X[1]).max(axis=(1, 2))


def test_flips_keep_the_pose_of_the_last_link(kinematics):
    found = flips(kinematics, TRUTH)
    assert found
    for flip in found:
        assert moved(kinematics, flip.values, TRUTH)[-1] < 1e-9
        assert np.abs(flip.values - TRUTH).max() > 0.1
        assert ((flip.values >= kinematics.lower) & (flip.values <= kinematics.upper)).all()
        np.testing.assert_array_equal(flip.values[~flip.changed], TRUTH[~flip.changed])
        back = [again.values for again in flips(kinematics, flip.values)]
        assert min(np.abs(values - TRUTH).max() for values in back) < 1e-9
    # Turret and roll turn by half a turn, the shoulder changes its sign.
    expected = TRUTH + np.pi * np.array([-1, 0, 1, 0, 0])
    expected[1] *= -1
    best = min(found, key=lambda flip: np.abs(flip.values - expected).max())
    np.testing.assert_allclose(best.values, expected, atol=1e-9)
    assert best.mirrored.tolist() == [False, True, False, False, False]
    assert best.changed.tolist() == [True, True, True, False, False]
    # The turret's limits are +-150 degrees, so 10 cannot become 190 degrees.
    assert flips(kinematics, np.radians([10.0, 40.0, -30.0, 50.0, 20.0])) == []


@pytest.mark.parametrize("limits", [FULL, None])
def test_flips_of_chains_that_turn_around(tmp_path, limits):
    """Of two wrists in succession, together and alone: all combinations, each once."""
    kinematics = chain_of(tmp_path, "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", limits=limits)
    values = np.array([0.3, 0.5, -0.4, 0.9, 0.2])
    first, second = np.array([1, 0, 1, 0, 0]), np.array([0, 0, 1, 0, 1])
    expected = {(True, False): first, (False, True): second, (True, True): (first + second) % 2}
    found = {tuple(flip.mirrored[[1, 3]].tolist()): flip for flip in flips(kinematics, values)}
    assert found.keys() == expected.keys()
    assert len(flips(kinematics, values)) == 3
    assert len(flips(kinematics, values, count=1)) == 1
    for which, turns in expected.items():
        wanted = values + math.pi * turns
        wanted[[1, 3]] *= np.where(which, -1.0, 1.0)
        flip = found[which]
        np.testing.assert_allclose(np.exp(1j * flip.values), np.exp(1j * wanted), atol=1e-9)
        assert moved(kinematics, flip.values, values)[-1] < 1e-9
        assert (np.abs(flip.values) <= 3.2).all()


@pytest.mark.parametrize(
    ("axes", "count"),
    [
        # The first and last axes are at a right angle: a2 becomes pi - a2.
        (("0 0 1", "0 1 0", "1 0 0"), 1),
        (("0 0 1", "0 1 0.1", "0 0 1"), 0),
        (("0 0 1", "0 1 0", "0.5 0 1"), 0),
        (("0 0 1", "0 1 1", "0 0 1"), 0),
    ],
)
def test_only_joints_whose_axes_can_be_aligned_flip(tmp_path, axes, count):
    kinematics = chain_of(tmp_path, *axes, last="0 0 0")
    values = np.array([0.3, 0.5, -0.4])
    found = flips(kinematics, values)
    assert len(found) == count
    for flip in found:
        np.testing.assert_allclose(
            np.cos(flip.values - [0.3 + math.pi, math.pi - 0.5, -0.4 + math.pi]), 1.0
        )
        assert moved(kinematics, flip.values, values)[-1] < 1e-9


def test_a_link_off_the_last_axis_does_not_flip(tmp_path):
    """Its place would change."""
    straight, off = (chain_of(tmp_path, "0 0 1", "0 1 0", "0 0 1", last=p) for p in
                     ("0 0 0.2", "0.05 0 0.2"))  # fmt: skip
    values = np.array([0.3, 0.5, -0.4])
    assert len(flips(straight, values)) == 1
    assert flips(off, values) == []


def test_counter_turns_are_all_multiples_of_parallel_pairs(tmp_path):
    """Of angles of a chain at most one angle apart, in the sense of their axes."""
    kinematics = chain_of(tmp_path, "0 1 0", "0 0 1", "0 -1 0.05", "0 1 0")
    values = np.array([0.1, 0.0, -0.3, 0.5])
    for interval in (1.0, 2.0):
        found = counter_turns(kinematics, values, interval)
        steps = range(1, math.ceil(2.0 * math.pi / interval))
        expected = []
        for (first, second, sense), step in product(((0, 2, 1.0), (2, 3, 1.0)), steps):
            turned = values.copy()
            turned[first] += step * interval
            turned[second] += sense * step * interval
            expected.append(turned)
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(np.exp(1j * one), np.exp(1j * other), atol=1e-9)
            assert (np.abs(one) <= 3.2).all()
    # Nothing is left within narrow limits; 45 degrees apart is not nearly parallel.
    narrow = chain_of(tmp_path, "0 1 0", "0 1 0", limits='lower="-0.2" upper="0.2"')
    assert counter_turns(narrow, np.zeros(2), 0.5) == []
    assert counter_turns(chain_of(tmp_path, "0 1 0", "0 1 1"), np.zeros(2), 1.0) == []
