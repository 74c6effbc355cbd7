"""Keyframes, searches and motions of a camera that is registered online."""

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError, SettingsError
from drake_pose.fit.judge import PairedEvidence
from drake_pose.registration.online_registration import (
    CameraStatus,
    OnlineRegistration,
    OnlineSettings,
    OnlineState,
    pose_difference,
)
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import FrameMisfit, RegisteredCamera, RegistrationBody
from tests.registration.test_register import looking_at

NOT_REGISTERED, REGISTERED, CONTRADICTED = CameraStatus
SEEN = np.ones((480, 640), dtype=bool)
# Positions of the first joint; the body's pose differs in all of them.
TURNS = np.radians([-140.0, -100.0, -60.0, -20.0, 20.0, 60.0, 100.0, 140.0])

# Positions of the camera along x [m].
PLACES = {"here": 1.6, "a little off": 1.62, "there": 2.0}


def camera_at(x: float) -> PinholeCamera:
    return looking_at(np.array([x, 0.4, 0.5]), np.array([0.0, 0.0, 0.4]), 0.1)


class ScriptedSearch:
    """Fake search: a frame's name says where its camera was, and most frames are inliers."""

    def __init__(self) -> None:
        self.searches = self.refinements = 0
        self.alternatives = 0
        self.p_value, self.mirrored = 0.001, 2.0
        self.deviation = 0.0004

    def register(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        self.searches += 1
        names = [frame.name for frame in frames]
        most = max(PLACES, key=names.count)
        if names.count(most) == 0:
            raise RegistrationError("nothing fits")
        return self._at(most, frames, self.alternatives)

    def refine(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        self.refinements += 1
        near = min(PLACES, key=lambda name: abs(PLACES[name] - camera.X_WC[0, 3]))
        if near == "here" and all(frame.name == "a little off" for frame in frames):
            near = "a little off"
        return self._at(near, frames, 0)

    def _at(self, place: str, frames: Sequence[PosedFrame], others: int) -> RegisteredCamera:
        near = {place}, {"here", "a little off"}
        agreeing = [{frame.name, place} in near for frame in frames]
        misfits = [
            FrameMisfit(frame.name, 0.02, 0.98, 0.97 if is_inlier else 0.2, is_inlier)
            for frame, is_inlier in zip(frames, agreeing, strict=True)
        ]
        covariance = np.diag(np.full(6, self.deviation**2))
        alternatives = np.tile(np.eye(4), (others, 1, 1))
        return RegisteredCamera(
            camera_at(PLACES[place]), covariance, tuple(misfits), alternatives,
            evidence=PairedEvidence(0.9, 0.4, self.p_value, 0.001, len(frames), 5),
        )  # fmt: skip

    def mirrored_costs(
        self, found: RegisteredCamera, frames: Sequence[PosedFrame]
    ) -> tuple[np.ndarray, np.ndarray]:
        costs = np.ones((len(frames), 9, 9))
        return costs, self.mirrored * costs


@pytest.fixture
def search() -> ScriptedSearch:
    return ScriptedSearch()


@pytest.fixture
def online(body: RegistrationBody, search: ScriptedSearch) -> OnlineRegistration:
    settings = OnlineSettings(most_frames=6, newest=3, least_frames=4)
    return OnlineRegistration(body, camera_at(0.0), settings, search)


def frame(place: str, turn: float) -> PosedFrame:
    """Return a frame of a camera at a place; the arm is bent, so that its first joint moves it."""
    return PosedFrame(place, np.array([turn, 1.0, 0.3, 1.2, 0.2]), SEEN)


def follow(
    online: OnlineRegistration, state: OnlineState, frames: Sequence[PosedFrame]
) -> tuple[OnlineState, list[int]]:
    """Return the state after some frames, and the status after each."""
    statuses = []
    for one in frames:
        state = online.next(state, one)
        statuses.append(online.status(state))
    return state, statuses


def registered_at(state: OnlineState, x: float) -> bool:
    """Return whether the registered camera is at ``camera_at(x)``."""
    known = state.registered
    return known is not None and np.allclose(known.camera.X_WC, camera_at(x).X_WC)


def names(state: OnlineState) -> set[str]:
    return {one.name for one in state.keyframes}


def test_a_camera_is_searched_with_enough_keyframes_and_the_newest_are_kept(online, search):
    frames = [frame("here", t) for t in TURNS]
    state, statuses = follow(online, OnlineState(), frames[:3])
    assert statuses == [NOT_REGISTERED] * 3
    # A repeated pose of the body and an empty mask are no new information.
    state, _ = follow(online, state, [frame("here", TURNS[1] + 0.01)] * 5)
    empty = PosedFrame("empty", np.zeros(5), np.zeros((480, 640), dtype=bool))
    assert online.next(state, empty) is state
    assert (len(state.keyframes), search.searches) == (3, 0)
    state, statuses = follow(online, state, frames[3:])
    assert (set(statuses), search.searches) == ({REGISTERED}, 1)
    assert registered_at(state, 1.6)
    assert state.keyframes == tuple(frames[2:])
    assert len(state.registered.frames) == 6
    assert copy.deepcopy(state) is state


@pytest.mark.parametrize(
    ("doubt", "value"), [("alternatives", 1), ("p_value", 0.02), ("mirrored", 0.5)]
)
def test_an_ambiguous_or_unproven_camera_is_not_registered(online, search, doubt, value):
    usual = getattr(search, doubt)
    setattr(search, doubt, value)
    state, statuses = follow(online, OnlineState(), [frame("here", t) for t in TURNS[:5]])
    assert statuses[-1] == NOT_REGISTERED
    setattr(search, doubt, usual)
    assert follow(online, state, [frame("here", TURNS[5])])[1] == [REGISTERED]


def test_unexplained_frames_do_not_register_a_camera_and_are_not_kept(online):
    state, statuses = follow(online, OnlineState(), [frame("nowhere", t) for t in TURNS])
    assert (set(statuses), len(state.keyframes)) == ({NOT_REGISTERED}, 6)
    frames = [frame("here", t) for t in TURNS[:4]]
    frames.insert(1, frame("nowhere", TURNS[5]))
    state, statuses = follow(online, OnlineState(), frames)
    assert (statuses[-1], names(state)) == (REGISTERED, {"here"})
    for bad in ({"least_frames": 2}, {"newest": 1}, {"most_frames": 4}):
        with pytest.raises(SettingsError, match="newest <= least_frames"):
            OnlineSettings(**bad)


@pytest.fixture
def known(online: OnlineRegistration) -> OnlineState:
    return follow(online, OnlineState(), [frame("here", t) for t in TURNS[:5]])[0]


def test_a_moved_camera_is_found_when_outliers_agree_with_each_other(online, search, known):
    """Three outliers contradict the pose, the fourth determines the new one."""
    state, statuses = follow(online, known, [frame("there", t) for t in TURNS[4:]])
    assert statuses == [REGISTERED, REGISTERED, CONTRADICTED, REGISTERED]
    assert (search.searches, state.moves, names(state)) == (2, 1, {"there"})
    assert registered_at(state, 2.0)
    # One pose of the body does not determine the camera: each frame is only compared.
    before = search.refinements
    _, statuses = follow(online, known, [frame("there", TURNS[4])] * 6)
    assert statuses == [REGISTERED] * 2 + [CONTRADICTED] * 4
    assert (search.searches, search.refinements - before) == (2, 6)
    # An uncertain pose is corrected without a motion.
    search.deviation = 0.3
    state, statuses = follow(online, known, [frame("there", t) for t in TURNS[4:]])
    assert (statuses[-1], state.moves) == (REGISTERED, 0)
    assert registered_at(state, 2.0)


def test_occluded_frames_are_no_motion(online, known):
    state, statuses = follow(online, known, [frame("nowhere", t) for t in TURNS])
    assert statuses == [REGISTERED] * 2 + [CONTRADICTED] * 6
    assert state.registered is known.registered
    state, statuses = follow(online, state, [frame("here", TURNS[6])])
    assert (statuses, state.moves, state.outlier_frames) == ([REGISTERED], 0, ())
    places = ["here", "nowhere", "here", "nowhere", "nowhere", "here"]
    turns = np.resize(TURNS[5:], len(places))
    state, statuses = follow(online, known, [*map(frame, places, turns)])
    assert (set(statuses), state.moves, names(state)) == ({REGISTERED}, 0, {"here"})


def test_a_small_motion_is_found_from_the_newest_keyframes(online, known):
    moved = [frame("a little off", t) for t in TURNS[5:]]
    state, statuses = follow(online, known, moved)
    assert (set(statuses), state.moves) == ({REGISTERED}, 1)
    assert [one.name for one in state.keyframes] == ["a little off"] * 3
    assert registered_at(state, 1.62)
    # Poses that differed as much before are no motion.
    assert follow(online, replace(known, distances=(5000.0,) * 12), moved)[0].moves == 0


AXIS = np.array([0.48, -0.6, 0.64])


def bumped(camera: PinholeCamera, degrees: float, metres: float) -> PinholeCamera:
    """Return a camera that is rotated and shifted."""
    X_WC = camera.X_WC.copy()
    X_WC[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * AXIS).as_matrix() @ X_WC[:3, :3]
    X_WC[:3, 3] += metres * AXIS[[1, 2, 0]]
    return camera.with_pose(X_WC)


def test_pose_difference_is_along_the_worlds_axes() -> None:
    camera = camera_at(1.6)
    off = pose_difference(bumped(camera, 2.0, 0.1).X_WC, camera.X_WC)
    expected = np.append(np.radians(2.0) * AXIS, 0.1 * AXIS[[1, 2, 0]])
    np.testing.assert_allclose(off, expected, atol=1e-12)
