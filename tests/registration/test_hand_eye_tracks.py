"""Laws of the registration of a camera on a link from points of a standing scene."""

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.hand_eye import (
    EpipolarSearch,
    TrackProblem,
    fit_tracks,
    gauge_constants,
    jackknife,
    motion,
)
from drake_pose.registration.picture_matches import Matches, Sightings, match_pictures

CAMERA = PinholeCamera("wrist", 640, 480, 500.0, 510.0, 310.0, 250.0, np.eye(4))
X_LC = np.eye(4)
X_LC[:3, :3] = Rotation.from_euler("zyx", [2.1, 0.3, -0.4]).as_matrix()
X_LC[:3, 3] = 0.05, -0.03, 0.06
TIMES = np.linspace(0.0, 4.0, 14)


def hand(times: Array, turn: tuple[float, float, float] = (0.35, 0.3, 0.5)) -> Array:
    """Return the poses X_WL (n, 4, 4) of a hand that looks down and swings about three axes."""
    X = np.tile(np.eye(4), (len(times), 1, 1))
    phases = times[:, None] * (1.3, 1.7, 0.9) + (0.0, 1.0, 2.0)
    down = Rotation.from_euler("x", 180.0, degrees=True)
    X[:, :3, :3] = (down * Rotation.from_rotvec(turn * np.sin(phases))).as_matrix()
    X[:, :3, 3] = 0.1 * np.sin(phases[:, ::-1] + 0.5) + (0.4, 0.0, 0.5)
    return X


def see(X_WL: Array, points: Array, noise: float, rng: np.random.Generator) -> Sightings:
    """Return sightings in the pictures by OpenCV's projection, with normal errors [pixel]."""
    K = np.array([[500.0, 0.0, 310.0], [0.0, 510.0, 250.0], [0.0, 0.0, 1.0]])
    rows = []
    for k, X in enumerate(X_WL):
        X_CW = np.linalg.inv(X @ X_LC)
        turn, _ = cv2.Rodrigues(X_CW[:3, :3])
        uv = cv2.projectPoints(points, turn, X_CW[:3, 3], K, None)[0].reshape(-1, 2)
        ahead = (points @ X_CW[2, :3] + X_CW[2, 3]) > 0.05
        inside = ahead & np.all((uv > 0) & (uv < (640, 480)), axis=1)
        shown = np.flatnonzero(inside & (rng.uniform(size=len(uv)) < 0.7))
        rows.append(np.column_stack([np.full(len(shown), k), shown, uv[shown]]))
    table = np.concatenate(rows)
    often = np.bincount(table[:, 1].astype(int), minlength=len(points)) > 1
    table = table[often[table[:, 1].astype(int)]]
    _, point = np.unique(table[:, 1], return_inverse=True)
    uv = table[:, 2:] + rng.normal(0.0, noise, (len(table), 2))
    return Sightings(table[:, 0].astype(int), point, uv)


def table_points(rng: np.random.Generator, count: int = 120) -> Array:
    """Return points (count, 3) on a table, and on things up to 5 cm high."""
    xy = rng.uniform((0.05, -0.35), (0.75, 0.35), (count, 2))
    return np.column_stack([xy, rng.uniform(0.0, 0.05, count) * (rng.uniform(size=count) < 0.3)])


def all_matches(seen: Sightings) -> Matches:
    """Return the matches of all pairs of sightings of a point."""
    pairs = [
        (i, j)
        for point in range(seen.points.max() + 1)
        for own in [np.flatnonzero(seen.points == point)]
        for i, j in pairwise(own)
    ]
    rows = np.array(pairs)
    rows = rows[seen.frames[rows[:, 0]] < seen.frames[rows[:, 1]]]
    return Matches(seen.frames[rows], seen.uv[rows])


def error(found: Array) -> Array:
    """Return rotation vector [rad] and translation [m] (6,) of the error, in the camera's axes."""
    by = np.linalg.inv(found) @ X_LC
    return np.concatenate([Rotation.from_matrix(by[:3, :3]).as_rotvec(), by[:3, 3]])


def problem_of(
    seen: Sightings, poses: Callable[[Array], Array], *constant_sds: float, focal_sd: float = 0.0
) -> TrackProblem:
    return TrackProblem(CAMERA, poses, seen, np.array([focal_sd, *constant_sds]))


def test_all_rotations_are_searched_amid_wrong_matches() -> None:
    rng, X_WL = np.random.default_rng(3), hand(TIMES)
    matches = all_matches(see(X_WL, table_points(rng), 1.0, rng))
    wrong = rng.uniform(size=len(matches.uv)) < 0.3
    matches.uv[wrong, 1] = rng.uniform((0, 0), (640, 480), (np.count_nonzero(wrong), 2))
    search = EpipolarSearch(CAMERA, matches)
    (explained, found), *_ = search.search(X_WL)
    chance = search.search(np.roll(X_WL, 5, axis=0), 1000)[0][0]
    assert (np.linalg.norm(error(found).reshape(2, 3), axis=1) < 0.02).all()
    assert explained > 0.5 > 2.0 * chance


def test_points_that_ride_along_do_not_count() -> None:
    rng, X_WL = np.random.default_rng(6), hand(TIMES)
    seen = see(X_WL, table_points(rng), 0.3, rng)
    fixed = rng.uniform((200, 350), (450, 470), (30, 2))
    frames = np.repeat(np.arange(len(X_WL)), len(fixed))
    points = np.tile(np.arange(len(fixed)), len(X_WL)) + seen.points.max() + 1
    both = Sightings(
        np.concatenate([seen.frames, frames]),
        np.concatenate([seen.points, points]),
        np.concatenate([seen.uv, np.tile(fixed, (len(X_WL), 1))]),
    )
    fit = fit_tracks(problem_of(both, lambda _: X_WL), X_LC)
    assert np.linalg.norm(error(fit.X_LC)[3:]) < 0.0003
    assert fit.inliers[: len(seen.uv)].mean() > 0.98
    assert fit.inliers[len(seen.uv) :].mean() < 0.2


@pytest.mark.parametrize(
    ("joint_noise", "noise", "least", "most"), [(0.0, 0.5, 0.7, 1.3), (0.004, 0.3, 0.6, 1.5)]
)
def test_covariances_are_those_of_many_noisy_scenes(joint_noise, noise, least, most) -> None:
    """The jackknife has eleven degrees of freedom, and contains the noise of the joints."""
    X_WL, rows = hand(TIMES), []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        off = rng.normal(0.0, joint_noise, (len(X_WL), 6)) * [1, 1, 1, 0, 0, 0]
        seen = see(X_WL @ motion(off), table_points(rng, 60), noise, rng)
        problem = problem_of(seen, lambda _: X_WL)
        fit = fit_tracks(problem, X_LC)
        sigmas = [np.sqrt(np.diag(C))[:6] for C in (jackknife(problem, fit), fit.covariance)]
        rows.append([error(fit.X_LC) / one for one in sigmas])
    jackknifed, fitted = np.sqrt(np.mean(np.square(rows), axis=(0, 2)))
    assert least < jackknifed < most
    # The robust loss costs some information.
    assert joint_noise or 0.8 < fitted < 1.3


def test_first_and_last_joints_are_told_from_others() -> None:
    rng, X_WL = np.random.default_rng(9), hand(TIMES)
    seen = see(X_WL, table_points(rng), 0.3, rng)

    def poses(constants: Array) -> Array:
        z, turning = np.eye(6)[2], np.zeros((len(TIMES), 6))
        turning[:, 0], turning[:, 1] = np.cos(TIMES), np.sin(TIMES)
        first, last = motion(constants[0] * z), motion(constants[1] * z)
        return np.asarray(first @ hand(TIMES) @ motion(constants[2] * turning) @ last)

    problem = problem_of(seen, poses, 0.1, 0.1, 0.1)
    assert gauge_constants(problem, X_LC, np.zeros(4)).tolist() == [False, True, True, False]


def test_pictures_of_a_textured_table_are_matched() -> None:
    rng = np.random.default_rng(10)
    texture = cv2.resize(rng.integers(0, 255, (60, 60, 3)).astype(np.uint8), (600, 600))
    for _ in range(60):
        at = rng.integers(0, 560, 2)
        colour = rng.integers(0, 255, 3).tolist()
        cv2.rectangle(texture, at.tolist(), (at + rng.integers(8, 40, 2)).tolist(), colour, -1)
    H = np.array([[0.9, -0.2, 80.0], [0.15, 1.0, -20.0], [1e-4, 2e-4, 1.0]])
    first = texture[60:540, 20:580].copy()
    second = cv2.warpPerspective(texture, H, (560, 480))
    # A gripper stands still in both.
    for one in (first, second):
        one[400:, 200:360] = cv2.resize(texture[:80, :160], (160, 80))
    pictures = [np.ascontiguousarray(one) for one in (first, second)]
    matches, seen = match_pictures(pictures)
    from_texture = np.column_stack([matches.uv[:, 0] + (20.0, 60.0), np.ones(len(matches.uv))])
    mapped = from_texture @ H.T
    off = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - matches.uv[:, 1], axis=1)
    assert len(off) > 50
    assert np.mean(off < 2.0) > 0.9
    assert np.all(np.linalg.norm(matches.uv[:, 1] - matches.uv[:, 0], axis=1) > 3.0)
    assert np.all(np.bincount(seen.points) == 2)
