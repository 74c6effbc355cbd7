"""Angles that can turn all the way round: in which turn answers are given, and none twice."""

import math

import numpy as np
import pytest

from drake_pose.search.continuous.multi_start import MultiStartSearch
from drake_pose.search.continuous.search import ContinuousSearch
from drake_pose.search.grid.beam_search import BeamSearch
from drake_pose.search.grid.examination import ExaminationSettings
from drake_pose.search.grid.pose_families import _joined
from tests.search.turning import crane, views_of


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return crane(tmp_path_factory.mktemp("crane"))


@pytest.mark.parametrize("make", [ContinuousSearch, MultiStartSearch])
@pytest.mark.parametrize("truth", [(178.0, 331.5), (-181.0, -28.5), (-100.0, 190.0)])
def test_drakes_pictures_are_answered_in_the_turn_about_the_default(model, make, truth):
    """The limits of the second joint hold the truth in two turns."""
    result = make(model.pose_tree()).match(views_of(model, np.radians(truth)))
    nearest = [math.degrees(math.remainder(math.radians(angle), 2 * math.pi)) for angle in truth]
    assert np.abs(np.degrees(result.q)).max() <= 180.0 + 1e-6
    errors = np.remainder(np.degrees(result.q) - nearest + 180.0, 360.0) - 180.0
    # A pixel is about a degree of the jib.
    assert np.abs(errors).max() < 2.0
    answer = result.pose_set
    keys = [tuple(np.round(np.degrees(one.q) % 360.0, 1)) for one in answer.families]
    assert len(set(keys)) == len(keys)
    for family in answer.families:
        for joint, value in zip(family.joints, np.concatenate(family.node_values), strict=True):
            assert joint.low <= value <= joint.high
            assert joint.high - joint.low <= 2 * math.pi + 1e-9
    swing = answer.joints[0]
    assert swing.determined
    assert swing.holds(math.radians(truth[0]))
    assert swing.holds(math.radians(truth[0] + 720.0))
    assert not swing.holds(math.radians(truth[0] + 90.0))


def test_directions_on_both_sides_of_half_a_turn_are_one_family(model):
    """A pose on the grid at 180 degrees, with room for its neighbours at 160 and -160."""
    search = BeamSearch(model.pose_tree(), None, ExaminationSettings(tolerance=400.0))
    result = search.match(views_of(model, np.radians([180.0, 0.0])))
    np.testing.assert_allclose(np.degrees(np.abs(result.q)), [180.0, 0.0], atol=1e-6)
    first = result.pose_set.families[0].joints[0]
    # Values rise without a gap through half a turn, and the answer is amidst.
    ends = np.degrees(np.array([first.low, first.high]) - result.q[0])
    np.testing.assert_allclose(ends, [-20.0, 20.0], atol=1e-6)
    assert result.pose_set.family_count == 1


def test_angles_of_one_turn_are_cut_at_their_widest_gap():
    def joined(values, about):
        return np.degrees(_joined(np.radians(values), math.radians(about), math.radians(20.0)))

    np.testing.assert_allclose(joined([-160.0, 160.0, 180.0], 180.0), [160.0, 180.0, 200.0])
    np.testing.assert_allclose(joined([-160.0, 160.0, 180.0], -160.0), [-200.0, -180.0, -160.0])
    np.testing.assert_allclose(joined([-20.0, 0.0, 20.0], 0.0), [-20.0, 0.0, 20.0])
    whole = np.arange(-160.0, 181.0, 20.0)
    np.testing.assert_allclose(joined(whole, 0.0), whole)
    np.testing.assert_allclose(joined([40.0], 40.0), [40.0])
