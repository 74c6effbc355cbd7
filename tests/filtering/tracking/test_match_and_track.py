import math

import numpy as np
import pytest

from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import SettingsError
from drake_pose.filtering.contour_observation import ContourObservation
from drake_pose.filtering.contour_tracker import (
    Tracker,
    TrackerState,
    TrackingSettings,
)
from drake_pose.filtering.state import Belief
from drake_pose.search import (
    TRACKED,
    MultiStartSearch,
    PaperSearch,
    PaperSearchSettings,
    PoseEstimate,
    View,
)
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.jobs.live_scenes import standing
from tests.search.bodies import front_camera

PERIOD = 1 / 30
CAMERA = front_camera(200, shift=0.2)


def swings(frames, centre, amplitude, generator):
    """Return a smooth motion (frames, n) about a centre, with a period of about 1.3 s."""
    t = np.arange(frames)[:, None] / 40
    rate = generator.uniform(0.6, 1.4, len(centre))
    phase = generator.uniform(0, 2 * np.pi, len(centre))
    return centre + amplitude * np.sin(2 * np.pi * rate * t + phase)


class KnownPoses:
    """A search that returns the true pose of the current frame."""

    def __init__(self, tree, answers):
        self.tree, self.answers, self.frame, self.calls = tree, answers, 0, 0

    def match(self, views, root_position=None):
        self.calls += 1
        q, X_WB, scale, p_WR = self.answers[self.frame]
        values = tuple(self.tree.values_from_positions(q, X_WB))
        found = True, q, X_WB, values, 20.0, 100.0, "end"
        return PoseEstimate(*found, root_position=p_WR, scale=scale)


class CountingSearch:
    """A search that counts its calls."""

    def __init__(self, search):
        self.search, self.calls = search, 0
        self.tree, self.sampled = search.tree, search.sampled

    def match(self, views, root_position=None):
        self.calls += 1
        return self.search.match(views, root_position)


def tracker_of(search):
    """Return a tracker that uses a search."""
    return Tracker(search.tree, [CAMERA], PERIOD, search=search)


def paper_search(model):
    settings = PaperSearchSettings(interval=math.radians(20), outside_limit=60.0)
    return CountingSearch(PaperSearch(model.pose_tree(), settings))


def test_tracked_after_one_match_and_matched_again_after_a_jump(body):
    search = paper_search(body)
    follower = tracker_of(search)
    generator = np.random.default_rng(7)
    first = swings(12, np.array([0.1, 0.4, -0.4]), 0.25, generator)
    # A cut: the body has another pose in the next frame.
    second = swings(12, np.array([-0.3, 1.7, -1.7]), 0.25, generator)
    renderer = LabelRenderer(body, CAMERA)
    state, errors, asked, held, widths = TrackerState(), [], [], [], []
    for q in np.vstack([first, second]):
        state, result = follower.update(state, [View(CAMERA, renderer.mask(q))])
        matched = follower.with_intervals(state, result)
        np.testing.assert_array_equal(matched.q, result.q)
        for joint, value in zip(matched.pose_set.joints, q, strict=True):
            held.append(joint.holds(value))
            widths.append(joint.high - joint.low)
        errors.append(np.degrees(np.abs(result.q - q)).max())
        asked.append(search.calls)
        assert state.matches == search.calls
    assert asked[0] == asked[11] == 1
    assert asked[12] == 2
    assert asked[-1] <= 3
    # Segments have 12 to 24 pixels.
    assert np.median(errors[:12]) < 3.0
    assert np.median(errors[12:]) < 3.5
    assert result.stopped_by == TRACKED
    # The intervals claim 95 %.
    assert np.mean(held) > 0.9
    assert np.median(widths) < np.radians(35.0)


def test_a_track_starts_in_the_frame_of_its_pose_without_motion(body):
    """Whether the pose comes from the search or from the caller."""
    search = paper_search(body)
    follower = tracker_of(search)
    mask = LabelRenderer(body, CAMERA).mask(np.array([0.1, 0.4, -0.4]))
    views, tracker = [View(CAMERA, mask)], follower
    started, _ = follower.update(TrackerState(), views)
    matched = search.search.match(views)
    for state, q in (
        (started, matched.q),
        (
            follower.update(TrackerState(), views, start=matched.q + 0.02)[0],
            matched.q + 0.02,
        ),
    ):
        start = tracker.start(tracker.observation.state(q))
        expected = [tracker.follow(start, [mask], first).state.best for first in (True, False)]
        found = state.track.state.best
        np.testing.assert_allclose(found.mean, expected[0].mean)
        np.testing.assert_allclose(found.covariance, expected[0].covariance)
        assert not np.allclose(found.covariance, expected[1].covariance)


def test_a_failed_search_is_reported_and_repeated(body):
    settings = PaperSearchSettings(interval=math.radians(20), outside_limit=0.0)
    search = CountingSearch(PaperSearch(body.pose_tree(), settings))
    follower = tracker_of(search)
    speck = np.zeros((200, 200), dtype=bool)
    speck[3:5, 3:5] = True
    state, result = follower.update(TrackerState(), [View(CAMERA, speck)])
    assert not result.found
    assert state.track is None
    state, _ = follower.update(state, [View(CAMERA, speck)])
    assert state.matches == search.calls == 2


def test_a_track_is_lost_if_the_body_is_elsewhere(body):
    observation = ContourObservation(body.pose_tree(), [CAMERA])
    tracker = Tracker(body.pose_tree(), [CAMERA], PERIOD)
    track = tracker.start(observation.state(np.array([0.1, 0.5, -0.5])))
    assert not track.lost
    empty = np.zeros((200, 200), dtype=bool)
    empty[:3, :3] = True
    assert tracker.follow(track, [empty]).lost
    waited = tracker.follow(track, [None])
    assert not waited.lost
    assert waited.measurement is None
    started = tracker.follow(track, [None], first=True).state
    np.testing.assert_array_equal(started.best.covariance, track.state.best.covariance)
    # Without a measurement there are no intervals.
    follower, pose = tracker_of(paper_search(body)), object()
    for unmeasured in (None, waited):
        assert follower.with_intervals(TrackerState(unmeasured), pose) is pose


def test_invalid_settings_and_periods_are_refused_by_name(body):
    for bad in ({"rounds": 0}, {"memory": -1.0}, {"rest_time": math.nan}):
        with pytest.raises(SettingsError, match=next(iter(bad))):
            TrackingSettings(**bad)
    with pytest.raises(SettingsError, match="period"):
        Tracker(body.pose_tree(), [CAMERA], 0.0)


def test_rates_decay_with_memory_and_change_by_their_kinds_acceleration(body):
    tree = body.pose_tree("trunk", root_position=np.zeros(3))
    settings = TrackingSettings(
        2.0, 3.0, log_scale_acceleration=5.0, memory=0.2, root_moves=True, scale_unknown=True
    )
    tracker = Tracker(tree, [CAMERA], 0.05, settings)
    n, moving = len(tracker.filter.layout), tracker.filter.layout.moving
    still = tracker.filter.predict_belief(Belief(np.zeros(n), np.zeros((n, n))))
    for name, deviation in zip(moving, still.deviations()[len(moving) :], strict=True):
        turn, shift = name.endswith("turn"), name.startswith("root_shift")
        of_kind = 2.0 if turn else 3.0 if shift else 5.0
        assert deviation == pytest.approx(0.05**2 * of_kind), name
    belief = Belief(np.r_[np.zeros(len(moving)), np.ones(len(moving))], np.eye(n))
    for _ in range(4):
        belief = tracker.filter.predict_belief(belief)
    np.testing.assert_allclose(belief.mean[len(moving) :], math.exp(-1.0))


@pytest.mark.parametrize(("fraction", "asked"), [(0.04, 1), (0.6, 2)])
def test_the_search_is_used_if_much_of_the_silhouette_is_unexplained(body, fraction, asked):
    """Another object appears, far from the body's contour."""
    tree, q = body.pose_tree(), np.array([0.1, 0.5, -0.5])
    mask = LabelRenderer(body, CAMERA).mask(q)
    search = KnownPoses(tree, [(q, np.eye(4), 1.0, None)])
    follower = tracker_of(search)
    state, _ = follower.update(TrackerState(), [View(CAMERA, mask)])
    with_other = mask.copy()
    with_other[150:, : round(fraction * mask.sum() / 50)] = True
    assert not (mask[150:] | mask[:, :60].any()).any()
    follower.update(state, [View(CAMERA, with_other)])
    assert search.calls == asked


@pytest.mark.parametrize(("shift", "angle"), [(0.15, 0.3), (0.2, 0.2)])
def test_a_track_does_not_lag_in_its_second_frame(person, shift, angle):
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
        q[person.position_index("position_x")] += shift
        for name in ("left_upper_arm_z", "right_forearm_x", "left_thigh_x", "right_thigh_x"):
            q[person.position_index(name)] -= angle


def test_tracking_by_colours_alone_starts_from_given_positions(body):
    """Without a search. A covered lens loses the track, which recovers afterwards."""
    q, search = np.array([0.2, 0.9, -0.6]), KnownPoses(body.pose_tree(), [])
    seen = lit(LabelRenderer(body, CAMERA).mask(q))
    follower, state = tracker_of(search), TrackerState()
    found = []
    for picture, start in ((seen, None), (seen, q), (seen, None), (0 * seen, None), (seen, q)):
        state, pose = follower.update(state, [], None, {"front": picture}, start)
        found.append(pose.found)
        if pose.found:
            np.testing.assert_allclose(pose.q, q, atol=np.radians(3.0))
            # Contours are within a pixel of the edge, which bounds the differing area.
            assert 0.0 < pose.E_total < 0.2
        assert (state.track is None) == (len(found) == 1)
    assert found == [False, True, True, False, True]
    assert search.calls == state.matches == 0


def test_histograms_are_learned_in_the_first_frame_also_from_a_searched_pose(body):
    """The second frame has no mask, and the body has moved by several pixels."""
    moved = np.array([[0.2, 0.9, -0.6], [0.32, 0.8, -0.7]])
    tree = body.pose_tree()
    values = tree.values_from_positions(moved[0])
    pose = PoseEstimate.of_values(tree, values, 0.0, 1.0, stopped_by="end")
    search = KnownPoses(tree, [])
    search.match = lambda views, root_position=None: pose
    follower, state = tracker_of(search), TrackerState()
    renderer = LabelRenderer(body, CAMERA)
    for q, has_mask in zip(moved, (True, False), strict=True):
        mask = renderer.mask(q)
        views = [View(CAMERA, mask)] if has_mask else []
        state, found = follower.update(state, views, None, {"front": lit(mask)})
        assert found.found
        assert found.stopped_by == ("end" if has_mask else TRACKED)
        np.testing.assert_allclose(found.q, q, atol=np.radians(3.0))


def lit(mask):
    """Return a picture of an orange body before green."""
    return np.where(mask[..., None], (230, 130, 40), (60, 140, 60)).astype(np.uint8)


def hidden(mask, fraction):
    """Return a mask without its left pixels."""
    columns = np.nonzero(mask)[1]
    rest = mask.copy()
    rest[:, : int(np.quantile(columns, fraction))] = False
    return rest


@pytest.mark.parametrize("fraction", [0.6, 1.0])
def test_hidden_parts_are_predicted_near_the_truth(body, fraction):
    """The body is occluded for a third of a second, and the search returns bad poses."""
    search, answers = KnownPoses(body.pose_tree(), []), {}

    def match(views, root_position=None):
        values = search.tree.values_from_positions(answers["q"])
        return PoseEstimate.of_values(search.tree, values, 0.0, 1.0, stopped_by="end")

    search.match = match
    follower, state = tracker_of(search), TrackerState()
    poses = swings(30, np.array([0.1, 0.4, -0.4]), 0.4, np.random.default_rng(3))
    renderer, observation = LabelRenderer(body, CAMERA), follower.observation
    moving = follower.filter.layout.indices(follower.filter.layout.moving)
    before = np.zeros(len(moving))
    for k, q in enumerate(poses):
        is_hidden = 10 <= k < 20
        answers["q"] = np.array([1.0, -1.2, 1.0]) if is_hidden else q
        mask = hidden(renderer.mask(q), fraction if is_hidden else 0.0)
        views = [View(CAMERA, mask)] if mask.any() else []
        state, pose = follower.update(state, views)
        assert pose.found == (bool(views) or not is_hidden)
        off = np.abs(state.belief.mean - observation.state(q))[moving]
        deviations = state.belief.deviations()[moving]
        assert np.all(off < 3.0 * deviations + np.radians(3.0)), k
        if is_hidden:
            assert fraction < 1.0 or np.all(deviations > before)
        before = deviations


def test_only_a_pose_that_explains_the_masks_replaces_measured_positions(body):
    q = np.array([0.1, 0.4, -0.4])
    mask = LabelRenderer(body, CAMERA).mask(q)
    # A straight cut would be recognised.
    mask &= np.add.outer(np.arange(200), np.arange(200)) > np.argwhere(mask).sum(axis=1).mean()
    wrong, right = (q + off for off in ([0.9, -1.0, 1.0], [0.0, 0.01, 0.01]))
    search = KnownPoses(body.pose_tree(), [(wrong, np.eye(4), 1.0, None)])
    follower = tracker_of(search)
    state, pose = follower.update(TrackerState(), [View(CAMERA, mask)], start=right)
    assert search.calls == 1
    # The search's J is 20 of 100 pixels: better than before, but no explanation.
    np.testing.assert_allclose(pose.q, right, atol=np.radians(1.0))
    assert state.track.state.best.deviations().min() > 0.0


@pytest.mark.parametrize("shown", [0.5, 0.7])
def test_a_half_hidden_body_is_found_as_soon_as_it_is_whole(body, shown):
    """Until then no deviation is too small, and later the deviations are small."""
    search = MultiStartSearch(body.pose_tree())
    follower, state = tracker_of(search), TrackerState()
    renderer, moving = LabelRenderer(body, CAMERA), np.arange(3)
    for k, q in enumerate(swings(8, np.array([0.4, 0.8, -0.9]), 0.5, np.random.default_rng(9))):
        mask = renderer.mask(q)
        mask = hidden(mask, 1.0 - shown) if k < 4 else mask
        state, _ = follower.update(state, [View(CAMERA, mask)])
        off = np.abs(state.belief.mean - follower.observation.state(q))[moving]
        deviations = state.belief.deviations()[moving]
        assert np.all(off < 3.0 * deviations + np.radians(1.0)), k
        assert k < 4 or np.all(off < np.radians(6.0))
    assert np.all(deviations < np.radians(6.0))
