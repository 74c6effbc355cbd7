"""The figures of tracking by colour, of an arm of boxes."""

import numpy as np
import pytest

from drake_pose.body.model import load_model
from tests.benchmarks.colour import ColourOutcome, Room, measure_room
from tests.benchmarks.simulated_arms import write_box_arm


@pytest.mark.slow
def test_an_arm_of_boxes_is_followed_before_a_room(tmp_path):
    model = load_model(write_box_arm(tmp_path / "boxes.urdf"), check=False)
    masks, colour = measure_room(model, Room("all", noise=3.0, boxes=1, post=True), 5, 6)
    for outcome in (masks, colour):
        # The last joint's errors are left out.
        assert outcome.errors.shape == outcome.deviations.shape == (5, 4)
        assert not outcome.lost.any()
        assert not outcome.wrong.any()
    assert np.median(colour.errors) < 2.0


def test_truths_inside_and_wrong_frames_are_counted():
    errors = np.array([[1.0, 2.0], [11.0, 0.0]])
    outcome = ColourOutcome(errors, np.full((2, 2), 0.9), np.zeros(2, dtype=bool), 1.0)
    assert outcome.inside == 0.5
    np.testing.assert_array_equal(outcome.wrong, [False, True])
