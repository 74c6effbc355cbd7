"""Laws of accepting a camera on a link from points of a standing scene, without pictures."""

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import t as scipy_t

from drake_pose.arrays import Array
from drake_pose.errors import RegistrationError
from drake_pose.registration import hand_eye, track_registration
from drake_pose.registration.hand_eye import TrackFit, motion
from drake_pose.registration.picture_matches import Matches
from drake_pose.registration.recording import Recording
from drake_pose.registration.track_registration import TrackRegistration, register_tracks
from tests.registration.test_hand_eye_tracks import (
    CAMERA,
    TIMES,
    X_LC,
    all_matches,
    error,
    hand,
    problem_of,
    see,
    table_points,
)

LATE = 0.05
JOINTS = ("first", "last", "middle")


def turn(angle: float) -> Array:
    """Return a transform (4, 4) that turns about y."""
    return motion(np.array([0.0, angle, 0.0, 0.0, 0.0, 0.0]))


def link_poses(constants: Array) -> Array:
    """Return X_WL of a hand, the last and the middle joint of which have offsets."""
    back = motion(np.column_stack([0.3 * np.sin(5.0 * TIMES), np.zeros((len(TIMES), 5))]))
    inner = back @ turn(constants[3]) @ np.linalg.inv(back)
    return np.asarray(hand(TIMES + constants[0]) @ inner @ turn(constants[2]))


class QuickSearch(hand_eye.EpipolarSearch):
    """A search from fewer rotations."""

    def search(self, X_WL: Array, rotations: int = 2000) -> list[tuple[float, Array]]:
        return super().search(X_WL, min(rotations, 700))


class Scene:
    """Registers a camera from sightings; chance matches and motion can be replaced."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._patch = monkeypatch
        few = hand_eye.TRACKS._replace(matches=100, refined=10, groups=7)
        monkeypatch.setattr(hand_eye, "TRACKS", few)
        self.settings(least=25)
        monkeypatch.setattr(track_registration, "EpipolarSearch", QuickSearch)
        kinematics = SimpleNamespace(names=JOINTS, is_angle=np.ones(3, bool))
        nodes = [SimpleNamespace(name=name) for name in ("base", "arm")]
        tree = SimpleNamespace(nodes=nodes)
        self.body = SimpleNamespace(kinematics=kinematics, tree=tree)
        self.recording = Recording(
            tuple("abcdefghijklmn"), lambda _: np.zeros((14, 3)), lambda k: np.full((1, 1, 3), k),
            TIMES,
        )  # fmt: skip
        self.see(np.array([LATE, 0.0, 0.0, 0.0]))

    def settings(self, **changes: Any) -> None:
        """Change settings of registrations."""
        changed = track_registration.STANDING_SCENE._replace(**changes)
        self._patch.setattr(track_registration, "STANDING_SCENE", changed)

    def see(self, constants: Array, seed: int = 4) -> None:
        """Draw sightings at a time offset [s] and joint offsets [rad]."""
        rng = np.random.default_rng(seed)
        self.seen = see(link_poses(constants), table_points(rng, 60), 0.3, rng)

    def register(
        self,
        poses: Callable[[Array], Array] = link_poses,
        pairs: int | None = None,
        elsewhere: tuple[float, int] = (0.0, 0),
        **given: Any,
    ) -> TrackRegistration:
        matches = all_matches(self.seen)
        if pairs is not None:
            pair = np.unique(matches.frames, axis=0, return_inverse=True)[1]
            kept = np.isin(pair, np.argsort(-np.bincount(pair))[:pairs])
            matches = Matches(matches.frames[kept], matches.uv[kept])
        for name, value in {
            "choose_pictures": ([*range(0, 14, 2)], [*range(1, 14, 2)]),
            "recorded_link_poses": poses,
            "match_pictures": (matches, self.seen),
            "explaining_links": [elsewhere],
        }.items():
            self._patch.setattr(track_registration, name, lambda *_, value=value, **__: value)
        camera, recording = given.pop("camera", CAMERA), given.pop("recording", self.recording)
        return register_tracks(self.body, "hand", 0, camera, recording, **given)


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    return Scene(monkeypatch)


def test_a_scene_gives_pose_clock_and_inliers_with_their_intervals(scene: Scene) -> None:
    found = scene.register()
    deviations = np.sqrt(np.diag(found.found.covariance))
    off = X_LC[:3, :3] @ error(found.found.camera.X_WC).reshape(2, 3).T
    assert (np.abs(off.T.ravel()) < 4.0 * deviations).all()
    assert deviations[3:].max() < 0.01
    assert found.time_offset is not None
    assert found.time_offset.value == pytest.approx(LATE, abs=4.0 * found.time_offset.deviation)
    assert found.time_offset.deviation < 0.005
    assert found.focal_deviation == 0.0
    assert found.found.camera.focal_x == CAMERA.focal_x
    assert (found.offsets, found.likely) == ((), ())
    assert found.explained > 0.6 > 1.9 * found.chance > 0.3
    assert found.inliers.mean() > 0.98
    assert [one.frame for one in found.found.frames] == [*"abcdefghijklmn"]
    assert all(one.is_inlier and math.isnan(one.iou) for one in found.found.frames)
    assert [int(one[0, 0, 0]) for one in found.pictures.values()] == [*range(14)]


def test_focal_length_and_offsets_are_found_where_they_are_asked_for(scene: Scene) -> None:
    """The offset of the last joint only turns the camera on the link: it stays open."""
    scene.see(np.array([LATE, 0.0, 0.0, 0.12]))
    longer = replace(CAMERA, focal_x=1.2 * CAMERA.focal_x, focal_y=1.2 * CAMERA.focal_y)
    scene.settings(focals=(0.8, 1.0), times=(0.0, 0.1), chance_rotations=100, least_gain=1.2)
    found = scene.register(camera=longer, focal=True, offset_joints=["middle", "last"])
    assert found.found.camera.focal_x == pytest.approx(500.0, abs=5.0)
    assert found.found.camera.focal_y == pytest.approx(510.0, abs=5.0)
    assert 0.0 < found.focal_deviation < 0.01
    off = np.log(found.found.camera.focal_x / 500.0)
    assert off == pytest.approx(0.0, abs=4.0 * found.focal_deviation)
    middle, last = found.offsets
    assert (middle.name, last.name, found.likely) == ("middle", "last", ())
    assert middle.low < 0.12 < middle.high
    assert middle.deviation < 0.01
    assert middle.significant
    assert (last.value, last.deviation, last.low, last.high) == (0.0, np.inf, -np.inf, np.inf)
    assert not last.significant


@pytest.mark.parametrize(("offset", "named"), [(0.06, ("middle",)), (0.0, ())])
def test_offsets_that_explain_much_better_are_named(monkeypatch, scene, offset, named):
    scene.see(np.array([LATE, 0.0, 0.0, offset]))
    # Begin at the right pose, in place of a search.
    start = [X_LC], np.zeros(5), 0.7, 0.1
    monkeypatch.setattr(track_registration, "search_pose", lambda *_: start)
    found = scene.register()
    assert found.likely == named
    assert np.abs(error(found.found.camera.X_WC)).max() < 0.01
    assert (found.explained, found.chance) == (0.7, 0.1)


def wrong_hand(_: Array) -> Array:
    """Return the poses of a hand that moves otherwise."""
    return hand(1.7 * TIMES[::-1])


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"pairs": 2}, r"\d+ points of the scene were matched, in 2 pairs"),
        ({"poses": lambda _: hand(TIMES, (0.0, 0.0, 0.6))}, "and by 0.0 about others.* position"),
        ({"poses": lambda _: still(hand(TIMES))}, "moves by 0 mm .* scale"),
        ({"poses": wrong_hand}, "on link 'hand'.* --target"),
        ({"poses": wrong_hand, "elsewhere": (0.9, 1)}, "'arm' .* 90%.*--on arm"),
    ],
)
def test_scenes_that_cannot_determine_a_pose_are_refused(scene: Scene, given, told) -> None:
    scene.settings(times=(0.0,), chance_rotations=300)
    with pytest.raises(RegistrationError, match=told):
        scene.register(**given)


def still(X: Array) -> Array:
    """Return the poses with the first one's position."""
    X[:, :3, 3] = X[0, :3, 3]
    return X


def test_intervals_of_offsets_are_students(scene: Scene) -> None:
    """With half as many degrees of freedom as pictures, 11 at most; Bonferroni over all joints."""
    problem = problem_of(scene.seen, link_poses, 0.2, 0.2, 0.2, 0.2)
    deviations = np.array([1.0] * 8 + [0.1, 0.1, 0.02])
    constants = np.array([0.0, 0.0, 0.3, 0.2, -0.1])
    fit = TrackFit(X_LC, constants, np.zeros((0, 3)), 1.0, np.eye(11), np.zeros(0))
    found = track_registration.describe_offsets(JOINTS, JOINTS, problem, fit, deviations)
    law = scipy_t(6)
    for one, value, sd in zip(found, constants[2:], deviations[8:], strict=True):
        assert (one.value, one.deviation) == (value, sd)
        np.testing.assert_allclose([one.low, one.high], value + sd * law.ppf([0.025, 0.975]))
        assert one.significant == (2.0 * law.sf(abs(value) / sd) < 0.05 / 3)
    assert [one.significant for one in found] == [False, False, True]
