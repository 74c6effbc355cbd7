"""A sequence fitted as a whole, against the states that drew it and against Drake's positions."""

import numpy as np
import pytest

from drake_pose.filtering.contour import ContourObservation
from drake_pose.filtering.contour_tracker import ContourTracker, TrackingSettings
from drake_pose.filtering.sequence_fit import fit_sequence, pose_set
from tests.filtering.tracking.test_match_and_track import PERIOD
from tests.filtering.tracking.test_unknown_scale import drawn, moving_states
from tests.search.bodies import forked_body, front_camera

SETTINGS = TrackingSettings(root_moves=True, scale_unknown=True, rest_time=1.0)
FRAMES = 16


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    tree = forked_body(tmp_path_factory.mktemp("forked")).pose_tree(
        "trunk", root_position=np.zeros(3)
    )
    camera = front_camera(240, shift=0.2)
    generator = np.random.default_rng(5)
    states = moving_states(tree, camera, FRAMES, generator)
    masks, _ = drawn(tree, camera, states)
    observation = ContourObservation(tree, [camera], True, True, rest=0.1)
    tracker = ContourTracker(observation, PERIOD, SETTINGS)
    # All frames are off alike in each start, and two of the starts end in one explanation.
    starts = []
    for off in ([0.15, -0.12, 0.1], [-0.1, 0.1, 0.12], [0.0, 2.6, 0.0]):
        start = states.copy()
        start[:, :3] += off
        starts.append(list(start))
    return tree, observation, states, starts, fit_sequence(tracker, masks, starts, PERIOD)


def test_all_poses_are_found_and_starts_that_end_alike_are_one_explanation(fitted):
    _, observation, states, starts, explanations = fitted
    assert len(explanations) == 1
    (found,) = explanations
    index = [found.body.kinematics.names.index(name) for name in observation.layout.moving[:3]]
    off = np.degrees(np.abs(found.fitted.parameters[:, index] - states[:, :3]))
    begun = np.degrees(np.abs(np.array(starts[0])[:, :3] - states[:, :3]))
    assert np.median(off) < 0.25 * np.median(begun)
    deviations = np.degrees(found.fitted.deviations[:, index])
    assert (deviations > 0.0).all()
    assert np.mean(off < 2.0 * deviations) > 0.9


def test_what_an_explanation_says_of_a_frame_is_its_pose_and_its_intervals(fitted):
    tree, observation, states, _, explanations = fitted
    for frame in (0, FRAMES - 1):
        x = observation.state_of(
            explanations[0].fitted.parameters[frame][: len(observation.parameters(states[0]))]
        )
        q, X_WB = observation.positions(x)
        told = pose_set(explanations, [(q, X_WB, 7.0)], frame)
        (family,) = told.families
        assert family.J == 7.0
        values = np.concatenate(tree.values_from_positions(q, X_WB))
        np.testing.assert_allclose(np.concatenate(family.node_values), values, atol=1e-9)
        for joint, value in zip(told.joints, values, strict=True):
            assert joint.low <= value <= joint.high
