"""A sequence fitted as a whole, against the states that drew it and against Drake's positions."""

from dataclasses import replace

import numpy as np
import pytest

from drake_pose.body.tree.root import RootRotation
from drake_pose.errors import SettingsError
from drake_pose.filtering.contour import ContourObservation
from drake_pose.filtering.contour_tracker import ContourTracker
from drake_pose.filtering.sequence_fit import (
    find_start,
    fit_sequence,
    pose_set,
    tilted,
)
from tests.filtering.tracking.test_match_and_track import PERIOD
from tests.filtering.tracking.test_unknown_scale import SETTINGS, drawn, moving_states
from tests.search.bodies import forked_body, front_camera

AT_REST = replace(SETTINGS, rest_time=1.0)
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
    tracker = ContourTracker(observation, PERIOD, AT_REST)
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


@pytest.fixture
def observation(tmp_path):
    tree = forked_body(tmp_path).pose_tree(
        "trunk", root_position=np.zeros(3), root_rotation=RootRotation.free()
    )
    return ContourObservation(tree, [front_camera(200, shift=0.2)], True, True, rest=0.03)


def test_a_tilt_turns_the_root_alone(observation):
    x = np.zeros(len(observation.layout))
    turned = tilted(observation, x, (0.3, -0.2))
    R_WC = observation.cameras[0].X_WC[:3, :3]
    R = observation.node_poses(turned)[0, :3, :3] @ observation.node_poses(x)[0, :3, :3].T
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    along = R_WC.T @ axis / np.linalg.norm(axis)
    np.testing.assert_allclose(along, np.array([0.3, -0.2, 0.0]) / np.hypot(0.3, 0.2), atol=1e-9)
    moved = np.flatnonzero(turned != x)
    assert {observation.layout.names[i] for i in moved} <= {
        "root_rotation_x", "root_rotation_y", "root_rotation_z"
    }  # fmt: skip


def test_the_true_start_is_among_those_followed_and_not_worse_than_what_was_given(observation):
    camera = observation.cameras[0]
    moving = len(observation.layout.moving)
    truth = []
    for k in range(12):
        x = np.zeros(len(observation.layout))
        names = observation.layout.moving
        x[names.index("left_turn")] = 0.6 + 0.05 * k
        x[names.index("right_turn")] = -0.5 - 0.03 * k
        x[names.index("root_rotation_z")] = 0.5
        truth.append(x)
    masks = [[observation.draw(x, camera)] for x in truth]
    given = truth[0].copy()
    given[:moving] += 0.05
    tracker = ContourTracker(observation, PERIOD, SETTINGS)
    found = find_start(tracker, given, masks)
    assert [one.cost for one in found] == sorted(one.cost for one in found)
    assert len(found[0].states) == len(found[0].errors) == 12


def test_a_root_that_does_not_turn_freely_is_refused(tmp_path):
    body = forked_body(tmp_path)
    limited = RootRotation.limited([("x", -30.0, 30.0)])
    for tree in (
        body.pose_tree(),
        body.pose_tree("trunk", root_position=np.zeros(3), root_rotation=limited),
    ):
        observation = ContourObservation(tree, [front_camera()])
        with pytest.raises(SettingsError, match="freely"):
            tilted(observation, np.zeros(len(observation.layout)), (0.1, 0.1))
