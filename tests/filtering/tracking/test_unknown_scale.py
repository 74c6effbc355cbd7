"""A body in a parallel camera whose scale is unknown and drifts."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.body import RootRotation
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import SettingsError
from drake_pose.filtering.contour_observation import ContourObservation
from drake_pose.filtering.contour_tracker import (
    Tracker,
    TrackerState,
    TrackingSettings,
)
from drake_pose.filtering.sequence_fit import (
    FittedSequence,
    find_start,
    fit_sequence,
    pose_set,
    tilted,
)
from drake_pose.search import TRACKED, View
from tests.filtering.tracking.test_match_and_track import PERIOD, KnownPoses, swings
from tests.search.bodies import front_camera

SETTINGS = TrackingSettings(root_moves=True, scale_unknown=True)


@pytest.fixture(scope="module")
def tree(body):
    return body.pose_tree("trunk", root_position=np.zeros(3))


def drawn(tree, camera, states):
    """Return the masks of states, and the estimate a search would return for each."""
    observation = ContourObservation(tree, [camera], True, True)
    masks, answers = [], []
    for x in states:
        q, X_WB = observation.positions(x)
        masks.append(observation.draw(x, camera))
        answers.append((q, X_WB, observation.scale(x), observation.root_position(x)))
    return masks, answers


def moving_states(tree, camera, frames, generator):
    """Return states whose joints swing, whose root moves right and whose scale drifts by 6 %."""
    observation = ContourObservation(tree, [camera], True, True)
    layout, t = observation.layout, np.linspace(0.0, 1.0, frames)
    states = np.zeros((frames, len(layout)))
    states[:, :3] = swings(frames, np.array([0.1, 0.5, -0.5]), 0.3, generator)
    states[:, layout.index("root_shift_y")] = 0.1 * t
    states[:, layout.index("log_scale")] = 0.3 + 0.06 * np.sin(2.0 * t)
    return states


def test_states_describe_an_unscaled_body_in_a_scaled_camera(tree):
    camera = front_camera(200, shift=0.2)
    observation = ContourObservation(tree, [camera], True, True)
    (x,) = moving_states(tree, camera, 1, np.random.default_rng(3))
    q, X_WB = observation.positions(x)
    again = observation.state(q, X_WB, observation.scale(x))
    np.testing.assert_allclose(again, x, atol=1e-9)


def test_a_drifting_scale_is_tracked_and_found_again_after_a_cut(tree):
    camera = front_camera(240, shift=0.2)
    generator = np.random.default_rng(5)
    first = moving_states(tree, camera, 25, generator)
    # A cut: the body has another place, pose and scale in the next frame.
    second = moving_states(tree, camera, 10, generator)
    second[:, :3] += np.array([-0.3, 0.5, 0.3])
    layout = ContourObservation(tree, [camera], True, True).layout
    second[:, layout.index("log_scale")] += 0.15
    second[:, layout.index("root_shift_y")] += 0.5
    masks, answers = drawn(tree, camera, [*first, *second])
    search = KnownPoses(tree, answers)
    follower, tracker_state = Tracker(tree, [camera], PERIOD, SETTINGS, search), TrackerState()
    scales, errors, kinds = [], [], []
    for frame, mask in enumerate(masks):
        search.frame = frame
        tracker_state, result = follower.update(tracker_state, [View(camera, mask)])
        scales.append(result.scale / answers[frame][2])
        errors.append(np.degrees(np.abs(result.q - answers[frame][0])).max())
        kinds.append(result.stopped_by)
    assert kinds[1:25] == [TRACKED] * 24
    assert search.calls == 2
    assert kinds[-1] == TRACKED
    np.testing.assert_allclose(scales, 1.0, atol=0.05)
    # Segments have 12 to 24 pixels.
    assert np.median(errors) < 4.0
    assert max(errors) < 8.0


def test_unobserved_joints_move_to_the_middle_of_their_limits(tree):
    """A hidden arm stays where it is without a prior."""
    camera = front_camera(200, shift=0.2)
    moved = {}
    for rest in (0.0, 0.3):
        observation = ContourObservation(tree, [camera], True, True, prior_weight=rest)
        (x,) = moving_states(tree, camera, 1, np.random.default_rng(3))
        mask = observation.draw(x, camera)
        # The left arm is removed from the mask.
        settings = replace(SETTINGS, rest_time=PERIOD / rest if rest else None)
        tracker = Tracker(tree, [camera], PERIOD, settings)
        empty = np.zeros_like(mask)
        empty[:, : mask.shape[1] // 2 + 6] = mask[:, : mask.shape[1] // 2 + 6]
        track = tracker.start(x)
        for _ in range(10):
            track = tracker.follow(track, [empty])
        moved[rest] = observation.prior_distance(track.state.best.mean)
    assert moved[0.3] < moved[0.0]


def test_an_unknown_scale_needs_one_parallel_camera(tree):
    (pinhole,) = circle_of_cameras(1, face_camera=False).values()
    for cameras in ([pinhole], [front_camera(), front_camera(name="other")]):
        with pytest.raises(SettingsError, match="parallel"):
            ContourObservation(tree, cameras, True, True)


AT_REST = replace(SETTINGS, rest_time=1.0)
FRAMES = 16


@pytest.fixture(scope="module")
def fitted(tree):
    camera = front_camera(240, shift=0.2)
    generator = np.random.default_rng(5)
    states = moving_states(tree, camera, FRAMES, generator)
    masks, _ = drawn(tree, camera, states)
    observation = ContourObservation(tree, [camera], True, True, prior_weight=0.1)
    tracker = Tracker(tree, [camera], PERIOD, AT_REST)
    # Each start has a constant error, and two of them converge to the same fit.
    starts = []
    for off in ([0.15, -0.12, 0.1], [-0.1, 0.1, 0.12], [0.0, 2.6, 0.0]):
        start = states.copy()
        start[:, :3] += off
        starts.append(list(start))
    return tree, observation, states, starts, fit_sequence(tracker, masks, starts, PERIOD)


def test_all_poses_are_found_and_equal_fits_are_merged(fitted):
    _, observation, states, starts, explanations = fitted
    assert len(explanations) == 1
    (found,) = explanations
    index = [found.body.kinematics.names.index(name) for name in observation.layout.moving[:3]]
    off = np.degrees(np.abs(found.fitted.parameters[:, index] - states[:, :3]))
    initial_errors = np.degrees(np.abs(np.array(starts[0])[:, :3] - states[:, :3]))
    assert np.median(off) < 0.25 * np.median(initial_errors)
    deviations = np.degrees(found.deviations[:, index])
    assert (deviations > 0.0).all()
    assert np.mean(off < 2.0 * deviations) > 0.9


def test_a_frames_pose_set_has_the_explanations_pose_and_intervals(fitted):
    tree, observation, states, _, explanations = fitted
    for frame in (0, FRAMES - 1):
        x = observation.state_of(
            explanations[0].fitted.parameters[frame][: len(observation.parameters(states[0]))]
        )
        q, X_WB = observation.positions(x)
        found_set = pose_set(explanations, [(q, X_WB, 7.0)], frame)
        (mode,) = found_set.modes
        assert mode.J == 7.0
        values = np.concatenate(tree.values_from_positions(q, X_WB))
        np.testing.assert_allclose(np.concatenate(mode.node_values), values, atol=1e-9)
        kinematics = explanations[0].body.kinematics
        ranges = np.minimum(kinematics.upper - kinematics.lower, 2.0 * np.pi)
        for joint, value, whole in zip(found_set.joints, values, ranges, strict=True):
            assert joint.low <= value <= joint.high
            assert joint.determined == (joint.high - joint.low < 0.5 * whole)


@pytest.fixture
def observation(body):
    free = RootRotation.free()
    tree = body.pose_tree("trunk", root_position=np.zeros(3), root_rotation=free)
    return ContourObservation(tree, [front_camera(200, shift=0.2)], True, True, prior_weight=0.03)


def test_a_tilt_rotates_only_the_root(observation):
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


def test_the_true_start_is_tracked_and_not_worse_than_the_given_one(observation):
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
    tracker = Tracker(observation.tree, [camera], PERIOD, SETTINGS)
    found = find_start(tracker, given, masks)
    assert [one.cost for one in found] == sorted(one.cost for one in found)
    assert len(found[0].states) == len(found[0].errors) == 12


def test_a_root_that_does_not_turn_freely_is_refused(body):
    limited = RootRotation.limited([("x", -30.0, 30.0)])
    for tree in (
        body.pose_tree(),
        body.pose_tree("trunk", root_position=np.zeros(3), root_rotation=limited),
    ):
        observation = ContourObservation(tree, [front_camera()])
        with pytest.raises(SettingsError, match="freely"):
            tilted(observation, np.zeros(len(observation.layout)), (0.1, 0.1))


def test_intervals_of_a_sequence_are_within_limits_or_a_turn():
    """1.96 x 1.6 deviations; a value is determined by less than half of its limits or of a turn."""
    kinematics = SimpleNamespace(
        names=("free", "bend", "slide"), covers_full_turn=np.array([True, False, False]),
        lower=np.array([-np.pi, -0.5, 0.0]), upper=np.array([np.pi, 1.0, 0.4]),
    )  # fmt: skip
    values = np.array([[9.0, 9.0, 9.0, 9.0], [3.0, 0.8, 0.1, 7.0]])
    factor = 1.96 * 1.6
    for deviations, ends, known in (
        ((0.1, 0.05, 0.02), [(3.0 - 0.1 * factor, 3.0 + 0.1 * factor),
                             (0.8 - 0.05 * factor, 0.8 + 0.05 * factor),
                             (0.1 - 0.02 * factor, 0.1 + 0.02 * factor)], [True, True, True]),
        ((2.0, 0.4, 0.1), [(3.0 - np.pi, 3.0 + np.pi), (-0.4544, 1.0), (0.0, 0.4)],
         [False, False, False]),
        ((0.45, 0.1, 0.05), [(3.0 - 0.45 * factor, 3.0 + 0.45 * factor),
                             (0.8 - 0.1 * factor, 1.0), (0.0, 0.1 + 0.05 * factor)],
         [True, True, False]),
    ):  # fmt: skip
        rows = np.array([np.zeros(4), [*deviations, 1.0]])
        fitted = SimpleNamespace(parameters=values)
        found = FittedSequence(SimpleNamespace(kinematics=kinematics), fitted, rows).estimates(1)
        assert [one.name for one in found] == ["free", "bend", "slide"]
        np.testing.assert_allclose([(one.low, one.high) for one in found], ends, atol=1e-9)
        assert [one.determined for one in found] == known
        assert [one.covers_full_turn for one in found] == [True, False, False]
