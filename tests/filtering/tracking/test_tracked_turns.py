"""Angles that can turn all the way round, followed from frame to frame."""

import numpy as np
import pytest

from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.tracking.match_and_track import Followed, MatchAndTrack
from drake_pose.filtering.truncation.inequalities import from_model
from drake_pose.search.continuous.search import ContinuousSearch
from drake_pose.search.estimates import TRACKED, View
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.jobs.scenes import camera
from tests.search.turning import crane

PERIOD = 1 / 30


@pytest.fixture
def model(tmp_path):
    return crane(tmp_path)


@pytest.mark.slow
def test_turns_are_counted_while_a_body_is_followed(model):
    """Drake's pictures of two turns at 240 degrees a second; the search is asked now and then."""
    front = camera("front")
    renderer = LabelRenderer(model, front)
    follower = MatchAndTrack(ContinuousSearch(model.pose_tree()), [front], PERIOD)
    followed, tracked = Followed(), 0
    for k in range(90):
        truth = np.array([100.0 + 8.0 * k, -28.5 + 4.5 * k])
        followed, result = follower.next(followed, [View(front, renderer.mask(np.radians(truth)))])
        tracked += result.stopped_by == TRACKED
        expected = truth.copy()
        # Past the end of its limits it must be in another turn.
        expected[1] -= 360.0 * (np.degrees(result.q[1]) < 180.0 and truth[1] > 350.0)
        # Folded back, the outer arm is hidden behind the inner one for three frames.
        hidden = abs(truth[1] - 183.0) < 9.0
        assert np.abs(np.degrees(result.q) - expected).max() < (15.0 if hidden else 8.0)
        values = np.concatenate(result.node_values)
        np.testing.assert_allclose(values, result.q, atol=1e-9)
        assert abs(result.q[1]) <= 6.2831853 + 1e-9
        if result.pose_set is not None:
            for joint, value in zip(result.pose_set.joints, values, strict=True):
                assert joint.low <= value <= joint.high
            np.testing.assert_allclose(result.pose_set.families[0].q, result.q, atol=1e-9)
    assert truth[0] > 800.0
    assert truth[1] > 365.0
    assert tracked > 40


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
