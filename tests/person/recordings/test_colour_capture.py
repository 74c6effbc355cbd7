"""Tracking by colour of a simulated person in coloured clothes before a patchy background."""

from dataclasses import replace

import numpy as np
import pytest

from drake_pose.body import landmark_positions, load_landmarks
from drake_pose.camera.models import circle_of_cameras
from drake_pose.fit.colours import Colour, PartColours
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.capture import capture_by_colour
from drake_pose.person.pose_tracker import NOISE, PersonPoseTracker
from drake_pose.person.views import ColourViews
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.person.persons_in_view import stepping

FRAMES = 8
CLOTHES = np.array([[230, 130, 40], [200, 40, 60], [240, 210, 60], [120, 20, 30], [250, 160, 150]])


@pytest.fixture(scope="module")
def cameras():
    return circle_of_cameras(4, size=(320, 240), face_camera=False)


@pytest.fixture(scope="module")
def recording(person, cameras):
    """Pictures and masks of a few steps, and the true positions."""
    generator = np.random.default_rng(11)
    renderers = {name: LabelRenderer(person, camera) for name, camera in cameras.items()}
    # Clothes have warm colours, the background has cold ones.
    rooms = {
        name: generator.integers(0, 256, (24, 32, 3)).repeat(10, axis=0).repeat(10, axis=1)
        * np.array([0.4, 0.9, 1.0])
        for name in cameras
    }
    q = np.array([stepping(person, 0.12 * k, knees=45.0) for k in range(FRAMES)])
    pictures, masks = [], []
    for pose in q:
        segments = {name: one.segments(pose) for name, one in renderers.items()}
        masks.append({name: one >= 0 for name, one in segments.items()})
        pictures.append(
            {name: _painted(one, rooms[name], generator) for name, one in segments.items()}
        )
    return pictures, masks, q


def _painted(segments, room, generator):
    colours = CLOTHES[np.maximum(segments, 0) % len(CLOTHES)]
    picture = np.where((segments >= 0)[..., None], colours, room)
    noisy = picture + generator.normal(0.0, 5.0, picture.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def joint_errors(person, found, truth):
    """Errors of joint centres [mm]."""
    landmarks = load_landmarks(person.path)
    places = [landmark_positions(person, landmarks, q) for q in (found, truth)]
    return 1e3 * np.linalg.norm(np.array(places[0]) - np.array(places[1]), axis=1)


def captured(person, cameras, recording, starts, pictures, on_frame=None):
    given = cameras, FRAMES, lambda k: pictures[k], starts, {}, None, on_frame
    return capture_by_colour(person.pose_tree(), *given)[0]


def test_person_is_tracked_from_a_start_without_masks(person, cameras, recording):
    heard, (pictures, _, truth) = [], recording
    found = captured(person, cameras, recording, {0: truth[0]}, pictures, heard.append)
    assert heard == list(range(FRAMES))
    errors = [joint_errors(person, *pair) for pair in zip(found.q, truth, strict=True)]
    # The person has moved by more than this.
    assert joint_errors(person, truth[0], truth[-1]).max() > 100.0
    assert np.mean(errors) < 15.0
    assert np.all(found.inlier_ratios > 0.8)
    angles = [k for k, kind in enumerate(person.position_kinds) if kind == "angle"]
    assert np.all(found.deviations[:, angles] > 0.0)


def test_loss_is_reported_and_another_start_resumes(person, cameras, recording):
    grey = {name: np.full((240, 320, 3), 128, np.uint8) for name in cameras}
    pictures, _, truth = recording
    starts, shown = {k: truth[k] for k in (0, 5)}, [*pictures[:3], grey, grey, *pictures[5:]]
    found = captured(person, cameras, recording, starts, shown)
    lost = np.isnan(found.q).any(axis=1)
    assert lost.tolist() == [False] * 3 + [True] * 2 + [False] * 3
    assert np.isnan(found.deviations[lost]).all()
    assert np.mean(joint_errors(person, found.q[-1], truth[-1])) < 20.0


def test_limb_without_its_own_colours_is_searched_again_or_lost(person, cameras, recording):
    pictures, masks, q = (one[0] for one in recording)
    tracker = PersonPoseTracker(ContourFit(person.pose_tree(), noise=NOISE))
    fit, values, seen = tracker.fit, tracker.values(q), list(pictures.values())
    known = ColourViews(list(cameras.values()), seen, {}).updated_colours(fit, values, masks)
    views = ColourViews(list(cameras.values()), seen, known)
    pairs = list(zip(views.cameras, seen, strict=True))
    X_WN = fit.kinematics.poses(values)
    own = PartColours.learn(known.values(), fit.outlines, X_WN, pairs)
    np.testing.assert_allclose(own.relative_fractions(fit.outlines, X_WN, pairs), 1.0)
    wrong, limb = values.copy(), tracker.plan.limbs["left_arm"]
    wrong[limb.values] = limb.poses[7]
    assert joint_errors(person, tracker.positions(wrong), q).max() > 300.0
    blind = tracker.follow_by_colour(tracker.start(wrong), views)
    assert joint_errors(person, tracker.positions(blind.values), q).max() > 150.0
    state = tracker.follow_by_colour(tracker.start(wrong), views, own)
    assert not state.is_lost
    assert joint_errors(person, tracker.positions(state.values), q).max() < 60.0
    other = own.is_own & ~np.isin(np.arange(len(own.is_own)), limb.nodes)[:, None]
    assert tracker.follow_by_colour(
        tracker.start(values), views, replace(own, is_own=other)
    ).is_lost


class TestLearning:
    def test_masks_determine_the_persons_colours(self, person, cameras, recording):
        """Although the model is displaced by 4 cm."""
        pictures, masks, q = (one[0] for one in recording)
        fit = ContourFit(person.pose_tree(), noise=NOISE)
        tracker = PersonPoseTracker(fit)
        off = q.copy()
        off[person.position_index("position_y")] += 0.04
        views = ColourViews(list(cameras.values()), list(pictures.values()), {})
        wrong = []
        for regions in (None, masks):
            known = views.updated_colours(fit, tracker.values(off), regions)
            # The background has little red.
            on = sum(one[:, Colour.ON].reshape(-1, 16, 256)[:, :7].sum() for one in known.values())
            seen = sum((one[:, Colour.ON].sum(axis=1) > 0.0).sum() for one in known.values())
            wrong.append(on / seen)
            beside = [one[:, Colour.BESIDE].sum(axis=1) for one in known.values()]
            assert np.all(np.isclose(beside, 0.0) | np.isclose(beside, 1.0, atol=1e-3))
        assert wrong[1] < 0.5 * wrong[0]

        # A camera without histograms is not compared.
        state = tracker.follow_by_colour(tracker.start(tracker.values(q)), views)
        assert state.inlier_ratio == 0.0
        assert state.is_lost
        assert np.isnan(tracker.distance_by_colour(state.values, views))
