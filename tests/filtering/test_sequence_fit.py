"""Joint fits of short sequences of a body in a parallel camera of unknown scale."""

from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.body import RootRotation
from drake_pose.filtering.contour_tracker import Tracker, TrackingSettings
from drake_pose.filtering.sequence_fit import (
    SEQUENCE,
    FittedSequence,
    find_start,
    fit_sequence,
    pose_set,
    tilted,
)
from tests.filtering.tracks import CAMERA, PERIOD, swings
from tests.search.bodies import front_camera

SETTINGS = TrackingSettings(root_moves=True, scale_unknown=True, rest_time=1.0)
FRAMES = 16


@pytest.fixture(scope="module")
def fitted(body):
    """A tracker, true states, starts of which two lead to the same fit, and the explanations."""
    tree, camera = body.pose_tree("trunk", root_position=np.zeros(3)), front_camera(240, shift=0.2)
    tracker, generator = Tracker(tree, [camera], PERIOD, SETTINGS), np.random.default_rng(5)
    layout, t = tracker.filter.layout, np.linspace(0.0, 1.0, FRAMES)
    states = np.zeros((FRAMES, len(layout)))
    states[:, :3] = swings(FRAMES, np.array([0.1, 0.5, -0.5]), 0.3, generator)
    states[:, layout.index("root_shift_y")] = 0.1 * t
    states[:, layout.index("log_scale")] = 0.3 + 0.06 * np.sin(2.0 * t)
    masks = [tracker.observation.draw(x, camera) for x in states]
    starts = []
    for off in ([0.15, -0.12, 0.1], [-0.1, 0.1, 0.12], [0.0, 2.6, 0.0]):
        start = states.copy()
        start[:, :3] += off
        starts.append(list(start))
    return tracker, states, starts, fit_sequence(tracker, masks, starts, PERIOD)


def test_all_poses_are_found_and_equal_fits_are_merged(fitted):
    tracker, states, starts, (found,) = fitted
    index = [found.body.kinematics.names.index(one) for one in tracker.filter.layout.moving[:3]]
    off = np.degrees(np.abs(found.fitted.parameters[:, index] - states[:, :3]))
    assert len(off) == FRAMES
    begin = np.degrees(np.abs(np.array(starts[0])[:, :3] - states[:, :3]))
    assert np.median(off) < 0.25 * np.median(begin)
    deviations = np.degrees(found.deviations[:, index])
    assert (deviations > 0.0).all()
    assert np.mean(off < 2.0 * deviations) > 0.9
    assert np.sqrt(np.mean((off / deviations) ** 2)) > 0.1


def test_explanations_are_modes_and_their_intervals_hulls(fitted):
    tracker, states, _, (one,) = fitted
    own, moved = tracker.observation, one.fitted.parameters.copy()
    kinematics, frame = one.body.kinematics, FRAMES - 1
    moved[:, : len(kinematics.names)] += 0.3
    other = FittedSequence(one.body, SimpleNamespace(parameters=moved), one.deviations)
    poses = []
    for k, each in enumerate((one, other)):
        parameters = each.fitted.parameters[frame][: len(own.parameters(states[0]))]
        poses.append((*own.positions(own.state_of(parameters)), 7.0 + k))
    found = pose_set([one, other], poses, frame)
    assert (found.mode_count, found.complete, found.tolerance) == (2, False, 0.0)
    for mode, (q, X_WB, J) in zip(found.modes, poses, strict=True):
        values = np.concatenate(own.tree.values_from_positions(q, X_WB))
        np.testing.assert_allclose(np.concatenate(mode.node_values), values, atol=1e-9)
        assert mode.J == J
        assert all(joint.holds(value) for joint, value in zip(mode.joints, values, strict=True))
    ends = [[(joint.low, joint.high) for joint in mode.joints] for mode in found.modes]
    low, high = np.min(ends, axis=0)[:, 0], np.max(ends, axis=0)[:, 1]
    np.testing.assert_allclose([(a.low, a.high) for a in found.joints], np.c_[low, high])
    ranges = np.minimum(kinematics.upper - kinematics.lower, 2.0 * np.pi)
    assert [a.determined for a in found.joints] == (high - low < 0.5 * ranges).tolist()


@pytest.fixture(scope="module")
def turning(body):
    """A tracker of the body whose root turns freely."""
    free = RootRotation.free()
    tree = body.pose_tree("trunk", root_position=np.zeros(3), root_rotation=free)
    return Tracker(tree, [CAMERA], PERIOD, SETTINGS)


def test_a_tilt_is_about_the_axes_of_the_image(turning):
    observation, R_WC = turning.observation, CAMERA.X_WC[:3, :3]
    x = np.zeros(len(observation.layout))
    turned = tilted(observation, x, (0.3, -0.2))
    R = observation.node_poses(turned)[0, :3, :3] @ observation.node_poses(x)[0, :3, :3].T
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    expected = np.sinc(np.hypot(0.3, 0.2) / np.pi) * np.array([0.3, -0.2, 0.0])
    np.testing.assert_allclose(R_WC.T @ axis, expected, atol=1e-9)


def test_different_starts_are_tracked_through_all_frames(turning):
    """Sorted by mean E_total and prior; each is as far from others as ``start_distance``."""
    observation = turning.observation
    names, x = observation.layout.moving, np.zeros((8, len(observation.layout)))
    k, moving = np.arange(8), len(observation.layout.moving)
    x[:, names.index("left_turn")] = 0.6 + 0.05 * k
    x[:, names.index("right_turn")] = -0.5 - 0.03 * k
    x[:, names.index("root_rotation_z")] = 0.5
    masks = [[observation.draw(one, CAMERA)] for one in x]
    given = x[0].copy()
    given[:moving] += 0.05
    found = find_start(turning, given, masks)
    assert 1 <= len(found) <= SEQUENCE.tracked_starts
    assert [one.cost for one in found] == sorted(one.cost for one in found)
    best = min(one.errors[0] for one in found)
    for i, one in enumerate(found):
        assert len(one.states) == len(one.errors) == len(one.prior_distances) == 8
        assert one.errors[0] <= best + SEQUENCE.worse_start
        for state, mask, error, prior in zip(
            one.states, masks, one.errors, one.prior_distances, strict=True
        ):
            wrong, area = observation.difference(state, [(CAMERA, mask[0])])
            assert error == wrong / area
            assert prior == observation.prior_distance(state)
        expected = np.mean(one.errors) + 0.0003 * np.mean(one.prior_distances)
        assert one.cost == pytest.approx(expected)
        for other in found[:i]:
            assert np.abs(one.x - other.x)[:moving].max() > SEQUENCE.start_distance
    assert found[0].errors[-1] < 0.05


def test_intervals_of_a_sequence_are_within_limits_or_a_turn():
    """1.96 x 1.6 deviations; a value is determined by less than half of its limits or of a turn."""
    kinematics = SimpleNamespace(
        names=("free", "bend", "slide"), covers_full_turn=np.array([True, False, False]),
        lower=np.array([-np.pi, -0.5, 0.0]), upper=np.array([np.pi, 1.0, 0.4]),
    )  # fmt: skip
    values = np.array([3.0, 0.8, 0.1])
    for deviations, known in (
        ((0.1, 0.05, 0.02), [True, True, True]),
        ((2.0, 0.4, 0.1), [False, False, False]),
        ((0.45, 0.1, 0.05), [True, True, False]),
    ):
        half = 1.96 * 1.6 * np.array(deviations)
        half[0] = min(half[0], np.pi)
        low = np.maximum(values - half, [-9.0, -0.5, 0.0])
        high = np.minimum(values + half, [9.0, 1.0, 0.4])
        rows = np.array([np.zeros(4), [*deviations, 1.0]])
        fitted = SimpleNamespace(parameters=np.array([np.full(4, 9.0), [*values, 7.0]]))
        found = FittedSequence(SimpleNamespace(kinematics=kinematics), fitted, rows).estimates(1)
        assert [one.name for one in found] == ["free", "bend", "slide"]
        np.testing.assert_allclose([(a.low, a.high) for a in found], np.c_[low, high])
        assert [one.determined for one in found] == known
        assert [one.covers_full_turn for one in found] == [True, False, False]
