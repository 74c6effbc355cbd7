"""The figures of following a person by colour, of a few frames."""

import numpy as np
import pytest

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from tests.benchmarks.colour import Room
from tests.benchmarks.colour_person import PersonOutcome, measure_room


@pytest.mark.slow
def test_a_person_is_followed_before_a_room():
    model = load_model(bundled_model("person"), check=False)
    masks, colour = measure_room(model, Room("all", noise=3.0, boxes=1), 5, 6)
    for outcome in (masks, colour):
        assert len(outcome.errors) == 5
        assert not outcome.lost.any()
        assert not outcome.wrong.any()
    assert colour.errors.mean() < 2.0 * masks.errors.mean()


def test_wrong_frames_are_those_with_one_joint_far_off():
    errors = np.array([[1.0, 200.0], [11.0, 0.0]])
    outcome = PersonOutcome(errors, np.zeros(2, dtype=bool), 1.0)
    np.testing.assert_array_equal(outcome.wrong, [True, False])
