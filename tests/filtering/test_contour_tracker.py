"""Tracks of a small body that Drake renders, in masks and in pictures."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import SettingsError
from drake_pose.filtering.contour_observation import ContourObservation
from drake_pose.filtering.contour_tracker import Tracker, TrackerState, TrackingSettings
from drake_pose.filtering.state import Belief
from drake_pose.search import (
    TRACKED,
    BeamSearch,
    BeamSearchSettings,
    ExaminationSettings,
    JointEstimate,
    MultiStartSearch,
    PoseEstimate,
    PoseSet,
    View,
)
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.filtering.tracks import (
    CAMERA,
    PERIOD,
    KnownPoses,
    lit,
    make_background,
    painted,
    paper_search,
    swings,
    tracker_of,
)
from tests.jobs.live_scenes import standing
from tests.search.bodies import box_link, front_camera, joint, load_body, near_camera

Q = np.array([0.1, 0.4, -0.4])
SCALED = TrackingSettings(root_moves=True, scale_unknown=True)


@pytest.fixture(scope="module")
def renderer(body):
    return LabelRenderer(body, CAMERA)


@pytest.fixture(scope="module")
def tree(body):
    return body.pose_tree("trunk", root_position=np.zeros(3))


def known(body, *poses, J=20.0):
    """Return a search that knows poses of a body whose base does not move."""
    return KnownPoses(body.pose_tree(), [(q, np.eye(4), 1.0, None) for q in poses], J)


def test_tracked_after_one_match_and_matched_again_after_a_jump(body, renderer):
    follower, generator = tracker_of(paper_search(body)), np.random.default_rng(7)
    # A cut: the body has another pose after twelve frames.
    poses = [swings(12, centre, 0.25, generator) for centre in (Q, np.array([-0.3, 1.7, -1.7]))]
    state, errors, asked, held, widths = TrackerState(), [], [], [], []
    for q in np.vstack(poses):
        state, result = follower.update(state, [View(CAMERA, renderer.mask(q))])
        matched = follower.with_intervals(state, result)
        np.testing.assert_array_equal(matched.q, result.q)
        for one, value in zip(matched.pose_set.joints, q, strict=True):
            held.append(one.holds(value))
            widths.append(one.high - one.low)
        errors.append(np.degrees(np.abs(result.q - q)).max())
        asked.append(state.matches)
    assert asked[0] == asked[11] == 1
    assert asked[12] == 2
    assert asked[-1] <= 3
    assert np.median(errors[:12]) < 3.0
    assert np.median(errors[12:]) < 3.5
    assert result.stopped_by == TRACKED
    # The intervals claim 95 %.
    assert np.mean(held) > 0.9
    assert np.median(widths) < np.radians(35.0)
    # Without a measurement there are no intervals.
    bare = replace(state, track=replace(state.track, measurement=None))
    for unmeasured in (TrackerState(), bare):
        assert follower.with_intervals(unmeasured, result) is result


def test_a_track_starts_in_the_frame_of_its_pose(body, renderer):
    """Whether the pose is searched or given, it is not predicted before."""
    off, mask, follower = Q + 0.02, renderer.mask(Q), tracker_of(known(body, Q + 0.02))
    begun = follower.start(follower.observation.state(off))
    expected = follower.follow(begun, [mask], first=True).state.best
    for start in (None, off):
        state, _ = follower.update(TrackerState(), [View(CAMERA, mask)], start=start)
        np.testing.assert_array_equal(state.track.state.best.covariance, expected.covariance)


def test_frames_without_evidence_only_predict(body, renderer):
    tracker = Tracker(body.pose_tree(), [CAMERA], PERIOD)
    track = tracker.start(tracker.observation.state(Q))
    assert not track.lost
    elsewhere = np.zeros((200, 200), dtype=bool)
    elsewhere[:3, :3] = True
    assert tracker.follow(track, [elsewhere]).lost
    waited = tracker.follow(track, [None])
    assert not waited.lost
    assert waited.measurement is None
    predicted = tracker.predict(track).state.best
    np.testing.assert_array_equal(waited.state.best.covariance, predicted.covariance)
    started = tracker.follow(track, [None], first=True).state.best
    np.testing.assert_array_equal(started.covariance, track.state.best.covariance)
    # A late picture may show the body up to a period earlier.
    seen, moving = tracker.follow(track, [renderer.mask(Q + 0.1)]), np.zeros(6)
    belief, H = seen.state.best, seen.measurement.H
    moving[:3] = belief.mean[3:]
    shift = belief.covariance @ H.T @ H @ moving
    wide = tracker.delayed(seen).state
    np.testing.assert_allclose(wide.best.mean, belief.mean, atol=1e-5)
    expected = belief.covariance + np.outer(shift, shift)
    np.testing.assert_allclose(wide.best.covariance, expected, rtol=1e-3)
    assert wide.step == seen.state.step
    assert tracker.delayed(waited) is waited


def test_rates_decay_with_memory_and_change_by_their_kinds_acceleration(tree):
    settings = TrackingSettings(
        2.0, 3.0, 5.0, 0.2, root_moves=True, scale_unknown=True,
        start_angle=0.5, start_length=0.6, start_log_scale=0.7,
    )  # fmt: skip
    tracker = Tracker(tree, [CAMERA], 0.05, settings)
    n, moving = len(tracker.filter.layout), tracker.filter.layout.moving
    kinds = [
        0 if one.endswith("turn") else 1 if one.startswith("root_shift") else 2 for one in moving
    ]
    of_kind = np.array([2.0, 3.0, 5.0])[kinds]
    np.testing.assert_array_equal(tracker.accelerations, of_kind)
    still = tracker.filter.predict_belief(Belief(np.zeros(n), np.zeros((n, n))))
    np.testing.assert_allclose(still.deviations()[len(moving) :], 0.05**2 * of_kind)
    belief = Belief(np.r_[np.zeros(len(moving)), np.ones(len(moving))], np.eye(n))
    for _ in range(4):
        belief = tracker.filter.predict_belief(belief)
    np.testing.assert_allclose(belief.mean[len(moving) :], math.exp(-1.0))
    begun = tracker.start(tracker.observation.state(np.zeros(3))).state.hypotheses[0].free
    expected = [*np.array([0.5, 0.6, 0.7])[kinds], *(0.2 * 0.05 * of_kind)]
    np.testing.assert_allclose(begun.deviations(), expected)


def test_a_pose_with_a_look_alike_is_as_uncertain_as_both(tmp_path):
    """A lever looks the same turned towards the camera and away from it."""
    turn = joint("swing", "revolute", "world", "lever", (-1.0, 1.0), axis="0 1 0")
    model = load_body(tmp_path, turn, box_link("lever", 8, 30))
    search = BeamSearch(model.pose_tree(), BeamSearchSettings(interval=0.25), ExaminationSettings())
    views = [View(CAMERA, LabelRenderer(model, CAMERA).mask(np.array([0.5])))]
    state, _ = tracker_of(search).update(TrackerState(), views)
    # Uniform from -0.5 to 0.5, about an end.
    assert state.spread[0] == pytest.approx(1.0 / np.sqrt(3.0), rel=0.05)


def test_a_failed_search_is_reported_and_repeated(body):
    follower, state = tracker_of(paper_search(body, 0.0)), TrackerState()
    speck = np.indices((200, 200)).sum(axis=0) < 2
    for calls in (1, 2):
        state, result = follower.update(state, [View(CAMERA, speck)])
        assert (result.found, state.track, state.belief) == (False, None, None)
        assert state.matches == calls


def test_fruitless_searches_become_rare_until_other_masks_come(body, renderer):
    """Another object appears, far from the body's contour; a speck needs no search."""
    mask = renderer.mask(Q)

    def beside(fraction, rows=slice(150, 200)):
        with_other = mask.copy()
        with_other[rows, : round(fraction * mask.sum() / 50)] = True
        return [View(CAMERA, with_other)]

    search = known(body, Q)
    settings = TrackingSettings(search_pause=0.1)
    follower = Tracker(search.tree, [CAMERA], PERIOD, settings, search)
    state, _ = follower.update(TrackerState(), [View(CAMERA, mask)])
    state, _ = follower.update(state, beside(0.04))
    assert search.calls == 1
    asked = []
    for frame in range(24):
        before = search.calls
        state, pose = follower.update(state, beside(0.6))
        assert pose.found
        if search.calls > before:
            asked.append(frame)
    # A pause of 0.1 s has three frames; it doubles.
    assert asked == [0, 3, 9, 21]
    (one,), (other,) = beside(0.6), beside(0.6, slice(0, 50))
    state, _ = follower.update(state, [View(CAMERA, one.mask | other.mask)])
    assert state.matches == search.calls == 6
    # Once the masks are explained again, doubt ends.
    state, _ = follower.update(state, [View(CAMERA, mask)])
    assert (state.doubt, state.spread) == (None, None)


def test_a_track_does_not_lag_in_its_second_frame(person):
    """Although the rates are unknown after the first frame."""
    cameras = list(circle_of_cameras(3, size=(320, 240), face_camera=False).values())
    tracker = Tracker(person.pose_tree(), cameras, 1.0 / 30.0)
    observation, renderers = tracker.observation, [LabelRenderer(person, one) for one in cameras]
    q = standing(person, ahead=-0.3)
    track = tracker.start(observation.state(q))
    for k in range(3):
        masks = [renderer.mask(q) for renderer in renderers]
        track = tracker.follow(track, masks, first=k == 0)
        seen = list(zip(cameras, masks, strict=True))
        J, area = observation.difference(track.state.best.mean, seen)
        assert J / area < 0.04, k
        q[person.position_index("position_x")] += 0.2
        for name in ("left_upper_arm_z", "right_forearm_x", "left_thigh_x", "right_thigh_x"):
            q[person.position_index(name)] -= 0.2


def hidden(mask, fraction):
    """Return a mask without its left pixels."""
    columns = np.nonzero(mask)[1]
    rest = mask.copy()
    rest[:, : int(np.quantile(columns, fraction))] = False
    return rest


@pytest.mark.parametrize("fraction", [0.6, 1.0])
def test_hidden_parts_are_predicted_near_the_truth(body, renderer, fraction):
    """The body is occluded for a third of a second, and the search returns bad poses."""
    search = known(body, Q, J=0.0)
    follower, state, before = tracker_of(search), TrackerState(), np.zeros(3)
    for k, q in enumerate(swings(30, Q, 0.4, np.random.default_rng(3))):
        is_hidden = 10 <= k < 20
        search.answers = [(np.array([1.0, -1.2, 1.0]) if is_hidden else q, np.eye(4), 1.0, None)]
        mask = hidden(renderer.mask(q), fraction if is_hidden else 0.0)
        views = [View(CAMERA, mask)] if mask.any() else []
        state, pose = follower.update(state, views)
        assert pose.found == (bool(views) or not is_hidden)
        off = np.abs(state.belief.mean - follower.observation.state(q))[:3]
        deviations = state.belief.deviations()[:3]
        assert np.all(off < 3.0 * deviations + np.radians(3.0)), k
        if is_hidden:
            assert fraction < 1.0 or np.all(deviations > before)
        before = deviations


@pytest.mark.parametrize(("undetermined", "is_found"), [(None, True), (0, True), (2, False)])
def test_a_jump_is_believed_if_what_jumps_is_determined(body, renderer, undetermined, is_found):
    search, poses = known(body), (Q, Q - np.array([0.0, 0.0, 1.7]))
    joints = tuple(JointEstimate("", k != undetermined, 0.0, 0.0) for k in range(3))
    follower, state = tracker_of(search), TrackerState()
    for q in poses:
        given = {"stopped_by": "end", "pose_set": PoseSet((), joints, 0.0, False, 1)}
        found = PoseEstimate.of_values(search.tree, tuple(q[:, None]), 20.0, 100.0, **given)
        search.match = lambda *_, found=found: found
        state, pose = follower.update(state, [View(CAMERA, renderer.mask(q))])
    assert state.matches == 2
    assert pose.found == is_found


def test_only_a_pose_that_explains_the_masks_replaces_measured_positions(body, renderer):
    mask = renderer.mask(Q)
    # A straight cut would be recognised.
    mask &= np.add.outer(np.arange(200), np.arange(200)) > np.argwhere(mask).sum(axis=1).mean()
    wrong, right = (Q + off for off in ([0.9, -1.0, 1.0], [0.0, 0.01, 0.01]))
    search = known(body, wrong)
    state, pose = tracker_of(search).update(TrackerState(), [View(CAMERA, mask)], start=right)
    assert search.calls == 1
    # The search's J is 20 of 100 pixels: better than before, but no explanation.
    np.testing.assert_allclose(pose.q, right, atol=np.radians(1.0))
    assert state.track.state.best.deviations().min() > 0.0


def test_a_half_hidden_body_is_found_as_soon_as_it_is_whole(body, renderer):
    """Until then no deviation is too small, and later the deviations are small."""
    follower, state = tracker_of(MultiStartSearch(body.pose_tree())), TrackerState()
    for k, q in enumerate(swings(8, np.array([0.4, 0.8, -0.9]), 0.5, np.random.default_rng(9))):
        mask = renderer.mask(q)
        mask = hidden(mask, 0.3) if k < 4 else mask
        state, _ = follower.update(state, [View(CAMERA, mask)])
        off = np.abs(state.belief.mean - follower.observation.state(q))[:3]
        deviations = state.belief.deviations()[:3]
        assert np.all(off < 3.0 * deviations + np.radians(1.0)), k
        assert k < 4 or np.all(off < np.radians(6.0))
    assert np.all(deviations < np.radians(6.0))


def test_a_drifting_scale_is_tracked_and_found_again_after_a_cut(tree):
    """The joints swing, the root moves right and the scale drifts by 6 %; then all change."""
    camera, generator = front_camera(240, shift=0.2), np.random.default_rng(5)
    search = KnownPoses(tree)
    follower, state = Tracker(tree, [camera], PERIOD, SCALED, search), TrackerState()
    observation, layout = follower.observation, follower.filter.layout
    scales, errors, kinds = [], [], []
    for frames, jump, scale, y in ((25, 0.0, 0.3, 0.0), (10, [-0.3, 0.5, 0.3], 0.45, 0.5)):
        t = np.linspace(0.0, 1.0, frames)
        x = np.zeros((frames, len(layout)))
        x[:, :3] = swings(frames, np.array([0.1, 0.5, -0.5]), 0.3, generator) + jump
        x[:, layout.index("root_shift_y")] = y + 0.1 * t
        x[:, layout.index("log_scale")] = scale + 0.06 * np.sin(2.0 * t)
        for one in x:
            q, X_WB = observation.positions(one)
            true_scale = observation.scale(one)
            search.answers = [(q, X_WB, true_scale, observation.root_position(one))]
            state, result = follower.update(state, [View(camera, observation.draw(one, camera))])
            scales.append(result.scale / true_scale)
            errors.append(np.degrees(np.abs(result.q - q)).max())
            kinds.append(result.stopped_by)
    assert kinds[1:25] == [TRACKED] * 24
    assert search.calls == 2
    assert kinds[-1] == TRACKED
    np.testing.assert_allclose(scales, 1.0, atol=0.05)
    assert np.median(errors) < 4.0
    assert max(errors) < 8.0


# Pictures without masks.


def test_tracking_by_colours_alone_starts_from_given_positions(body, renderer):
    """Without a search. A covered lens loses the track, which recovers afterwards."""
    q, search = np.array([0.2, 0.9, -0.6]), known(body)
    seen = lit(renderer.mask(q))
    follower, state = tracker_of(search), TrackerState()
    found = []
    for picture, start in ((seen, None), (seen, q), (seen, None), (0 * seen, None), (seen, q)):
        state, pose = follower.update(state, [], None, {"front": picture}, start)
        found.append(pose.found)
        if pose.found:
            np.testing.assert_allclose(pose.q, q, atol=np.radians(3.0))
            assert 0.0 < pose.E_total < 0.2
        assert (state.track is None) == (len(found) == 1)
    assert found == [False, True, True, False, True]
    assert search.calls == state.matches == 0


def test_a_lost_track_and_a_lost_part_are_predicted(body):
    """Whole: search lines may have found another object's edges. A part: others keep to theirs."""
    truth, generator = np.array([0.2, 0.9, -0.6]), np.random.default_rng(8)
    camera, background = near_camera(), make_background(generator)
    renderer, tracker = (
        LabelRenderer(body, near_camera()),
        Tracker(body.pose_tree(), [camera], PERIOD),
    )
    observation = ContourObservation(body.pose_tree(), [camera])
    track, mask = tracker.start(observation.state(truth)), renderer.mask(truth)
    for k in range(4):
        picture = painted(mask, background, generator)
        track = tracker.follow(track, [None], k == 0, pictures=[picture])
    assert not track.lost
    expected = tracker.predict(track).state.best
    before = expected.deviations()

    dark = tracker.follow(track, [None], pictures=[0 * picture])
    assert dark.lost
    np.testing.assert_array_equal(dark.colours, track.colours)

    aside = painted(np.roll(mask, 9, axis=1), background, generator)
    lost = tracker.follow(track, [None], pictures=[aside])
    assert lost.lost
    now = lost.state.best
    assert np.all(now.deviations() >= 0.95 * before)
    assert np.all(np.abs(now.mean - expected.mean) <= 1.01 * now.deviations())
    # The uncertainty never decreases while the track is lost.
    again = tracker.follow(lost, [None], pictures=[aside])
    later = again.state.best.deviations()[:3]
    assert not again.lost or np.all(later >= 0.95 * now.deviations()[:3])

    jumped = truth + np.array([0.0, 0.0, 1.2])
    picture = painted(renderer.mask(jumped), background, generator)
    after = tracker.follow(track, [None], pictures=[picture])
    assert after.lost
    parts = after.measurement.hidden_parts[0]
    assert 0 < np.count_nonzero(parts) < len(parts)
    now = after.state.best.deviations()
    assert np.all(now[:2] < 0.9 * before[:2])
    assert now[2] >= 0.95 * before[2]
    error = np.abs(observation.positions(after.state.best.mean)[0] - jumped)
    assert np.all(error[:2] < np.radians(4.0))
    changed = np.any(after.colours != track.colours, axis=(0, 2, 3))
    np.testing.assert_array_equal(changed, ~parts)


def test_invalid_settings_and_periods_are_refused_by_name(body):
    for bad in ({"rounds": 0}, {"memory": -1.0}, {"rest_time": math.nan}):
        with pytest.raises(SettingsError, match=next(iter(bad))):
            TrackingSettings(**bad)
    with pytest.raises(SettingsError, match="period"):
        Tracker(body.pose_tree(), [CAMERA], 0.0)
