"""Self-motions keep the pose of the links behind the last joint."""

import numpy as np
import pytest

from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.search.self_motions import counter_turns, flips
from tests.search.arms import arm_tree, split
from tests.search.bodies import swinging_chain

VALUES = np.array([0.6, 0.7, -0.7, 0.9, 0.3])


@pytest.fixture(scope="module")
def kinematics(tmp_path_factory):
    return TreeKinematics(arm_tree(tmp_path_factory.mktemp("arm")))


def poses(kinematics, values):
    """Return X_WN (nodes, 4, 4) by the pose tree instead of the compiled kinematics."""
    return kinematics.tree.node_poses(split(kinematics.tree, values))


def test_flips_keep_the_pose_of_the_last_link(kinematics):
    found = flips(kinematics, VALUES)
    before = poses(kinematics, VALUES)
    assert found
    for flip in found:
        after = poses(kinematics, flip.values)
        np.testing.assert_allclose(after[-1], before[-1], atol=1e-9)
        assert np.abs(flip.values - VALUES).max() > 0.1
        assert ((flip.values >= kinematics.lower) & (flip.values <= kinematics.upper)).all()
        np.testing.assert_array_equal(flip.values[~flip.changed], VALUES[~flip.changed])
    # Turret and roll turn by half a turn, the shoulder changes its sign.
    expected = VALUES + np.pi * np.array([-1, 0, 1, 0, 0])
    expected[1] *= -1
    best = min(found, key=lambda flip: np.abs(flip.values - expected).max())
    np.testing.assert_allclose(best.values, expected, atol=1e-9)
    assert best.mirrored.tolist() == [False, True, False, False, False]
    assert best.changed.tolist() == [True, True, True, False, False]


def test_flipping_twice_returns_to_the_start(kinematics):
    for flip in flips(kinematics, VALUES):
        back = [again.values for again in flips(kinematics, flip.values)]
        assert min(np.abs(values - VALUES).max() for values in back) < 1e-9


def test_flips_outside_the_limits_are_left_out(kinematics):
    # The turret's limits are +-150 degrees, so 10 cannot become 190 degrees.
    values = np.radians([10.0, 40.0, -30.0, 50.0, 20.0])
    assert flips(kinematics, values) == []


def test_counter_turns_keep_the_pose_of_later_links(kinematics):
    # With the shoulder upright, turret and roll have the same axis.
    values = np.array([0.6, 0.0, -0.5, 0.9, 0.3])
    found = counter_turns(kinematics, values, np.radians(30.0))
    turned = [one for one in found if one[0] != values[0] and one[2] != values[2]]
    assert turned
    before = poses(kinematics, values)
    for one in turned:
        np.testing.assert_allclose(poses(kinematics, one)[-1], before[-1], atol=1e-9)
    assert all(((one >= kinematics.lower) & (one <= kinematics.upper)).all() for one in found)


def test_a_planar_chain_has_counter_turns_but_no_flips(tmp_path):
    kinematics = TreeKinematics(swinging_chain(tmp_path, 3).pose_tree())
    values = np.array([0.3, -0.4, 0.5])
    assert flips(kinematics, values) == []
    for one in counter_turns(kinematics, values, 0.5):
        changed = np.flatnonzero(one != values)
        assert len(changed) == 2
        # With parallel axes the two changes cancel, except for full turns.
        assert (one - values).sum() == pytest.approx(0.0, abs=1e-9)
