"""A body seen by a camera whose scale nobody knows, and which drifts."""

import numpy as np
import pytest

from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import SettingsError
from drake_pose.filtering.contour import ContourObservation
from drake_pose.filtering.contour_tracker import ContourTracker, TrackingSettings
from drake_pose.filtering.match_and_track import Followed, MatchAndTrack
from drake_pose.search.estimates import TRACKED, PoseEstimate, View
from tests.filtering.tracking.test_match_and_track import PERIOD, swings
from tests.search.bodies import forked_body, front_camera

SETTINGS = TrackingSettings(root_moves=True, scale_unknown=True)


class KnownPoses:
    """A search that answers with what is true in the frame it is asked in."""

    def __init__(self, tree, answers):
        self.tree, self.answers, self.frame, self.calls = tree, answers, 0, 0

    def match(self, views, root_position=None):
        self.calls += 1
        q, X_WB, scale, p_WR = self.answers[self.frame]
        values = tuple(self.tree.values_from_positions(q, X_WB))
        found = True, q, X_WB, values, 20.0, 100.0, "end"
        return PoseEstimate(*found, root_position=p_WR, scale=scale)


@pytest.fixture
def tree(tmp_path):
    return forked_body(tmp_path).pose_tree("trunk", root_position=np.zeros(3))


def drawn(tree, camera, states):
    """Masks of states, and what a search would say of each."""
    observation = ContourObservation(tree, [camera], True, True)
    masks, answers = [], []
    for x in states:
        q, X_WB = observation.positions(x)
        masks.append(observation.draw(x, camera))
        answers.append((q, X_WB, observation.scale(x), observation.root_position(x)))
    return masks, answers


def moving_states(tree, camera, frames, generator):
    """Joints swing, the body goes to the right, the scale drifts by 6 %."""
    observation = ContourObservation(tree, [camera], True, True)
    layout, t = observation.layout, np.linspace(0.0, 1.0, frames)
    states = np.zeros((frames, len(layout)))
    states[:, :3] = swings(frames, np.array([0.1, 0.5, -0.5]), 0.3, generator)
    states[:, layout.index("root_shift_y")] = 0.1 * t
    states[:, layout.index("log_growth")] = 0.3 + 0.06 * np.sin(2.0 * t)
    return states


def test_a_state_is_a_pose_in_its_own_size_seen_by_a_scaled_camera(tree):
    camera = front_camera(200, shift=0.2)
    observation = ContourObservation(tree, [camera], True, True)
    (x,) = moving_states(tree, camera, 1, np.random.default_rng(3))
    q, X_WB = observation.positions(x)
    again = observation.state(q, X_WB, observation.scale(x))
    np.testing.assert_allclose(again, x, atol=1e-9)


def test_the_scale_is_tracked_while_it_drifts_and_found_again_after_a_cut(tree):
    camera = front_camera(240, shift=0.2)
    generator = np.random.default_rng(5)
    first = moving_states(tree, camera, 25, generator)
    # Cut: the body stands elsewhere, otherwise and larger in the next frame.
    second = moving_states(tree, camera, 10, generator)
    second[:, :3] += np.array([-0.3, 0.5, 0.3])
    layout = ContourObservation(tree, [camera], True, True).layout
    second[:, layout.index("log_growth")] += 0.15
    second[:, layout.index("root_shift_y")] += 0.5
    masks, answers = drawn(tree, camera, [*first, *second])
    search = KnownPoses(tree, answers)
    follower, followed = MatchAndTrack(search, [camera], PERIOD, SETTINGS), Followed()
    scales, errors, kinds = [], [], []
    for frame, mask in enumerate(masks):
        search.frame = frame
        followed, result = follower.next(followed, [View(camera, mask)])
        scales.append(result.scale / answers[frame][2])
        errors.append(np.degrees(np.abs(result.q - answers[frame][0])).max())
        kinds.append(result.stopped_by)
    assert kinds[1:25] == [TRACKED] * 24
    assert search.calls == 2
    assert kinds[-1] == TRACKED
    np.testing.assert_allclose(scales, 1.0, atol=0.05)
    # Segments of 12 to 24 pixels.
    assert np.median(errors) < 4.0
    assert max(errors) < 8.0


def test_joints_that_are_not_seen_come_to_rest_in_the_middle_of_their_limits(tree):
    """Nothing is seen of an arm that hides; without a rest it stays."""
    camera = front_camera(200, shift=0.2)
    moved = {}
    for rest in (0.0, 0.3):
        observation = ContourObservation(tree, [camera], True, True, rest=rest)
        (x,) = moving_states(tree, camera, 1, np.random.default_rng(3))
        mask = observation.draw(x, camera)
        # The left arm is cut out of the picture.
        tracker = ContourTracker(observation, PERIOD, SETTINGS)
        empty = np.zeros_like(mask)
        empty[:, : mask.shape[1] // 2 + 6] = mask[:, : mask.shape[1] // 2 + 6]
        track = tracker.start(x)
        for _ in range(10):
            track = tracker.follow(track, [empty])
        moved[rest] = observation.prior_distance(track.state.best.mean)
    assert moved[0.3] < moved[0.0]


def test_a_scale_needs_one_parallel_camera(tree):
    (pinhole,) = circle_of_cameras(1, face_camera=False).values()
    for cameras in ([pinhole], [front_camera(), front_camera(name="other")]):
        with pytest.raises(SettingsError, match="parallel"):
            ContourObservation(tree, cameras, True, True)
