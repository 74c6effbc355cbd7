import math

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.filtering.contour import ContourObservation
from drake_pose.filtering.contour_tracker import ContourTracker, TrackingSettings
from drake_pose.filtering.match_and_track import Followed, MatchAndTrack
from drake_pose.search.estimates import TRACKED, View
from drake_pose.search.kameda import PaperSearch
from drake_pose.search.settings import PaperSearchSettings
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.search.bodies import forked_body, front_camera

PERIOD = 1 / 30


def swings(frames, centre, amplitude, generator):
    """(frames, n) smooth motion about a centre, about one swing in 1.3 s."""
    t = np.arange(frames)[:, None] / 40
    rate = generator.uniform(0.6, 1.4, len(centre))
    phase = generator.uniform(0, 2 * np.pi, len(centre))
    return centre + amplitude * np.sin(2 * np.pi * rate * t + phase)


class CountingSearch:
    """A search that counts how often it is asked."""

    def __init__(self, search):
        self.search, self.calls = search, 0
        self.tree, self.sampled = search.tree, search.sampled

    def match(self, views, root_position=None):
        self.calls += 1
        return self.search.match(views, root_position)


@pytest.fixture
def body(tmp_path):
    return forked_body(tmp_path)


def paper_search(model):
    settings = PaperSearchSettings(interval=math.radians(20), outside_limit=60.0)
    return CountingSearch(PaperSearch(model.pose_tree(), settings))


def test_tracked_after_one_match_and_matched_again_after_a_jump(body):
    camera = front_camera(200, shift=0.2)
    search = paper_search(body)
    follower = MatchAndTrack(search, [camera], PERIOD)
    generator = np.random.default_rng(7)
    first = swings(12, np.array([0.1, 0.4, -0.4]), 0.25, generator)
    # Cut: the body stands otherwise in the next frame.
    second = swings(12, np.array([-0.3, 1.7, -1.7]), 0.25, generator)
    renderer = LabelRenderer(body, camera)
    followed, errors, asked, held, widths = Followed(), [], [], [], []
    for q in np.vstack([first, second]):
        followed, result = follower.next(followed, [View(camera, renderer.mask(q))])
        told = follower.with_intervals(followed, result)
        np.testing.assert_array_equal(told.q, result.q)
        for joint, value in zip(told.pose_set.joints, q, strict=True):
            held.append(joint.holds(value))
            widths.append(joint.high - joint.low)
        errors.append(np.degrees(np.abs(result.q - q)).max())
        asked.append(search.calls)
        assert followed.matches == search.calls
    assert asked[0] == asked[11] == 1
    assert asked[12] == 2
    assert asked[-1] <= 3
    # Segments of 12 to 24 pixels.
    assert np.median(errors[:12]) < 3.0
    assert np.median(errors[12:]) < 3.5
    assert result.stopped_by == TRACKED
    # 95 % are claimed.
    assert np.mean(held) > 0.9
    assert np.median(widths) < np.radians(35.0)


def test_the_first_look_of_a_track_is_at_what_the_search_found(body):
    """Nothing has moved since, whether the search or the caller says where the body is."""
    camera = front_camera(200, shift=0.2)
    search = paper_search(body)
    follower = MatchAndTrack(search, [camera], PERIOD)
    mask = LabelRenderer(body, camera).mask(np.array([0.1, 0.4, -0.4]))
    views, tracker = [View(camera, mask)], follower.tracker
    begun, _ = follower.next(Followed(), views)
    told = search.search.match(views)
    for followed, q in (
        (begun, told.q),
        (follower.next(Followed(), views, start=told.q + 0.02)[0], told.q + 0.02),
    ):
        start = tracker.start(tracker.observation.state(q))
        expected = [tracker.follow(start, [mask], first).state.best for first in (True, False)]
        found = followed.track.state.best
        np.testing.assert_allclose(found.mean, expected[0].mean)
        np.testing.assert_allclose(found.covariance, expected[0].covariance)
        assert not np.allclose(found.covariance, expected[1].covariance)


def test_no_pose_found_is_said_and_asked_again(body):
    camera = front_camera(200, shift=0.2)
    settings = PaperSearchSettings(interval=math.radians(20), outside_limit=0.0)
    search = CountingSearch(PaperSearch(body.pose_tree(), settings))
    follower = MatchAndTrack(search, [camera], PERIOD)
    speck = np.zeros((200, 200), dtype=bool)
    speck[3:5, 3:5] = True
    followed, result = follower.next(Followed(), [View(camera, speck)])
    assert not result.found
    assert followed.track is None
    followed, _ = follower.next(followed, [View(camera, speck)])
    assert followed.matches == search.calls == 2


def test_lost_when_the_body_is_elsewhere(body):
    camera = front_camera(200, shift=0.2)
    observation = ContourObservation(body.pose_tree(), [camera])
    tracker = ContourTracker(observation, PERIOD)
    track = tracker.start(observation.state(np.array([0.1, 0.5, -0.5])))
    assert not track.lost
    empty = np.zeros((200, 200), dtype=bool)
    empty[:3, :3] = True
    assert tracker.follow(track, [empty]).lost
    waited = tracker.follow(track, [None])
    assert not waited.lost
    assert waited.measurement is None
    begun = tracker.follow(track, [None], first=True).state
    np.testing.assert_array_equal(begun.best.covariance, track.state.best.covariance)
    # Where nothing was measured contours say nothing of joints.
    follower, pose = MatchAndTrack(paper_search(body), [camera], PERIOD), object()
    for unmeasured in (None, waited):
        assert follower.with_intervals(Followed(unmeasured), pose) is pose


def test_bad_settings_and_a_bad_period_are_named(body):
    for bad in ({"rounds": 0}, {"memory": -1.0}, {"rest_time": math.nan}):
        with pytest.raises(SettingsError, match=next(iter(bad))):
            TrackingSettings(**bad)
    observation = ContourObservation(body.pose_tree(), [front_camera()])
    with pytest.raises(SettingsError, match="period"):
        ContourTracker(observation, 0.0)
