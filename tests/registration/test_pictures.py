"""Cameras from pictures alone, of an arm of boxes painted over Drake's label images."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.errors import RegistrationError
from drake_pose.fit.problem import TIME_OFFSET
from drake_pose.registration.picture_registration import register_pictures
from drake_pose.registration.picture_search import (
    PictureSearch,
    PosedPicture,
    choose_frames,
    node_places,
)
from tests.benchmarks.registration import pose_error
from tests.registration.episodes import LATE


def near(camera, degrees=2.0):
    """The camera turned a little about the arm."""
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.5, -0.6, 0.6])).as_matrix()
    return camera.with_pose(X @ camera.X_WC)


def test_frames_differ_most_that_are_chosen(episode):
    places = node_places(episode.body, episode.values)
    chosen = choose_frames(places, 4)
    assert len(set(chosen)) == 4
    apart = np.linalg.norm(places[:, None] - places, axis=-1).mean(axis=-1)
    for k in range(1, 4):
        nearest = apart[:, chosen[:k]].min(axis=1)
        assert nearest[chosen[k]] == nearest.max()


def test_a_drift_and_a_focal_length_are_fitted_on_lines(episode, recording):
    rates = recording().rates_at(0.0)
    # A clock that drifts is told by how offsets grow.
    later = episode.times[:12] - episode.times[:12].mean()
    drifting = episode.values_at(episode.times[:12] + LATE - 0.005 * later)

    def search(values):
        frames = [PosedPicture(f"{k}", values[k], episode.pictures[k], rates[k]) for k in range(12)]
        return PictureSearch(episode.body, episode.camera, frames)

    fitted = search(drifting).fit(near(episode.camera, 0.5), (TIME_OFFSET,))
    every = np.ones(len(later), bool)
    covariance = sum(fitted.fit.covariances(fitted.found, every))
    drift, deviation = fitted.fit.growth(fitted.found, TIME_OFFSET, later, every, covariance)
    assert drift == pytest.approx(0.005, abs=0.002)
    assert 0.0 < deviation < 0.004
    # The wrong focal length is told, too.
    wide = replace(episode.camera, focal_x=1.04 * episode.camera.focal_x,
                   focal_y=1.04 * episode.camera.focal_y)  # fmt: skip
    values = episode.values_at(episode.times + LATE - 0.015)
    again = search(values).fit(near(wide, 0.5), (TIME_OFFSET,), focal=True)
    assert again.camera.focal_x == pytest.approx(episode.camera.focal_x, rel=0.02)
    k = again.fit.names.index(TIME_OFFSET)
    assert again.found.shared[k] == pytest.approx(0.015, abs=0.004)
    assert min(again.fit.inlier_ratios(again.found)) > 0.7


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"values_at": lambda offset: np.full((16, 5), np.nan)}, "0 of its 16 pictures"),
        ({"values_at": lambda offset: np.zeros((16, 5))}, "hardly moves, by 0 mm"),
    ],
)
def test_what_tells_nothing_is_refused_before_the_search(episode, recording, changes, words):
    with pytest.raises(RegistrationError, match=words):
        register_pictures(episode.body, episode.camera, recording(**changes))


@pytest.mark.slow
def test_a_camera_is_found_without_a_guess_and_as_sure_as_it_is(episode, recording):
    nowhere = episode.camera.with_pose(np.eye(4))
    found = register_pictures(episode.body, nowhere, recording())
    error = pose_error(found.found.camera.X_WC, episode.camera.X_WC)
    deviations = np.sqrt(np.diag(found.found.covariance))
    assert (np.abs(error) < 3.0 * deviations).all()
    assert np.linalg.norm(error[3:]) < 0.012
    assert found.offset.value == pytest.approx(LATE, abs=4.0 * found.offset.deviation + 1e-3)
    assert found.offset.deviation < 0.02
    # The best of all that were tried is next to what was fitted.
    offsets, scores = found.offset.scores.T
    assert offsets[scores.argmax()] == pytest.approx(LATE, abs=0.03)


@pytest.mark.slow
def test_a_clock_that_drifts_is_put_right(episode, recording):
    faster = recording(values_at=lambda offset: episode.values_at(0.97 * episode.times + offset))
    found = register_pictures(episode.body, episode.camera, faster)
    # Pictures show later moments, and later ones the later they are.
    assert found.offset.drift == pytest.approx(0.03 / 0.97, abs=0.003)
    assert found.offset.drift_deviation < 0.003
    assert np.linalg.norm(pose_error(found.found.camera.X_WC, episode.camera.X_WC)[3:]) < 0.012


@pytest.mark.slow
def test_mirrored_pictures_are_told(episode, recording):
    mirrored = recording(read=lambda k: np.ascontiguousarray(episode.pictures[k][:, ::-1]))
    with pytest.raises(RegistrationError, match="its pictures are mirrored"):
        register_pictures(episode.body, episode.camera, mirrored)


@pytest.mark.slow
def test_joints_of_another_episode_are_refused(episode, recording):
    other = recording(values_at=lambda offset: -0.7 * episode.values_at(2.0 * episode.times))
    with pytest.raises(RegistrationError, match="no pose explains its pictures"):
        register_pictures(episode.body, episode.camera, other)
