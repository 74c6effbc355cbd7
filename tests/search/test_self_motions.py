"""Self-motions: what hangs on the last joint stays where it is."""

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
    """By the plant, not by the compiled kinematics."""
    return kinematics.tree.node_poses(split(kinematics.tree, values))


def test_flips_leave_the_end_where_it_is(kinematics):
    found = flips(kinematics, VALUES)
    before = poses(kinematics, VALUES)
    assert found
    for flip in found:
        after = poses(kinematics, flip.values)
        np.testing.assert_allclose(after[-1], before[-1], atol=1e-9)
        assert np.abs(flip.values - VALUES).max() > 0.1
        assert ((flip.values >= kinematics.lower) & (flip.values <= kinematics.upper)).all()
        np.testing.assert_array_equal(flip.values[~flip.changed], VALUES[~flip.changed])
    # Turret and roll by half a turn, the shoulder the other way round.
    expected = VALUES + np.pi * np.array([-1, 0, 1, 0, 0])
    expected[1] *= -1
    best = min(found, key=lambda flip: np.abs(flip.values - expected).max())
    np.testing.assert_allclose(best.values, expected, atol=1e-9)
    assert best.mirrored.tolist() == [False, True, False, False, False]
    assert best.changed.tolist() == [True, True, True, False, False]


def test_flipping_twice_returns(kinematics):
    for flip in flips(kinematics, VALUES):
        back = [again.values for again in flips(kinematics, flip.values)]
        assert min(np.abs(values - VALUES).max() for values in back) < 1e-9


def test_flips_outside_the_limits_are_left_out(kinematics):
    # The turret reaches 150 degrees to either side, so that 10 cannot become 190.
    values = np.radians([10.0, 40.0, -30.0, 50.0, 20.0])
    assert flips(kinematics, values) == []


def test_counter_turns_keep_the_direction_of_what_follows(kinematics):
    # With the shoulder upright, turret and roll have one axis.
    values = np.array([0.6, 0.0, -0.5, 0.9, 0.3])
    found = counter_turns(kinematics, values, np.radians(30.0))
    turned = [one for one in found if one[0] != values[0] and one[2] != values[2]]
    assert turned
    before = poses(kinematics, values)
    for one in turned:
        np.testing.assert_allclose(poses(kinematics, one)[-1], before[-1], atol=1e-9)
    assert all(((one >= kinematics.lower) & (one <= kinematics.upper)).all() for one in found)


def test_a_chain_in_a_plane_has_counter_turns_but_no_flips(tmp_path):
    kinematics = TreeKinematics(swinging_chain(tmp_path, 3).pose_tree())
    values = np.array([0.3, -0.4, 0.5])
    assert flips(kinematics, values) == []
    for one in counter_turns(kinematics, values, 0.5):
        changed = np.flatnonzero(one != values)
        assert len(changed) == 2
        # Parallel axes: a turn there and back again, but for full turns.
        assert (one - values).sum() == pytest.approx(0.0, abs=1e-9)
