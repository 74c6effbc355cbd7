"""Angles that can turn all the way round, followed from frame to frame."""

import numpy as np
import pytest

from drake_pose.filtering.contour import ContourObservation
from drake_pose.filtering.inequalities import from_model
from tests.jobs.scenes import camera
from tests.search.turning import crane

PERIOD = 1 / 30


@pytest.fixture
def model(tmp_path):
    return crane(tmp_path)


def test_a_pose_goes_on_in_the_turn_of_the_track(model):
    """As a search finds it, within half a turn; as a track has counted it, two turns on."""
    observation = ContourObservation(model.pose_tree(), [camera("front")])
    names = observation.layout.names
    swing, luff = names.index("swing"), names.index("luff")
    last = observation.state(np.array([13.0, 3.0]))
    found = observation.continued(observation.state(np.array([0.4, -2.0])), last)
    assert found[swing] == pytest.approx(0.4 + 4.0 * np.pi)
    # Its limits are those of two turns.
    assert found[luff] == pytest.approx(-2.0 + 2.0 * np.pi)
    assert np.all(found[len(observation.layout.moving) :] == 0.0)
    near = observation.continued(observation.state(np.array([13.1, 3.1])), last)
    np.testing.assert_allclose(near[[swing, luff]], [13.1, 3.1])


def test_what_turns_round_is_not_truncated(model, tmp_path):
    """The filter of states keeps a joint's own limits, but for those that are none."""
    assert from_model(model).rows == ("luff >= -6.28319", "luff <= 6.28319")
    observation = ContourObservation(model.pose_tree(), [camera("front")])
    with pytest.warns(UserWarning, match="no joint has a limit"):
        assert not len(observation.inequalities())
    wide = crane(tmp_path, 'lower="-1e16" upper="1e16"')
    assert not len(from_model(wide))
    narrow = crane(tmp_path, 'lower="-1" upper="2"')
    observation = ContourObservation(narrow.pose_tree(), [camera("front")])
    assert observation.inequalities().rows == ("luff >= -1", "luff <= 2")
