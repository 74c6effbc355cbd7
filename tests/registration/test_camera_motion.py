"""Motions of a camera in drawn pictures of a wall before which things move."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.models import PinholeCamera
from drake_pose.registration import camera_motion
from drake_pose.registration.camera_motion import PictureMotion, find_camera_motion, find_steps

WIDTH, HEIGHT, FOCAL, COUNT = 320, 240, 300.0, 40
CAMERA = PinholeCamera("eye", WIDTH, HEIGHT, FOCAL, FOCAL, 159.5, 119.5, np.eye(4))
K = np.array([[FOCAL, 0.0, 159.5], [0.0, FOCAL, 119.5], [0.0, 0.0, 1.0]])
STILL = np.eye(3)


def patched(seed: int, size: tuple[int, int], cells: Sequence[int]) -> np.ndarray:
    """Return a wall (H, W, 3) of random patches: so many a side, coarse ones first."""
    rng, wall = np.random.default_rng(seed), np.zeros((*size[::-1], 3), np.float32)
    for count, weight in zip(cells, (0.4, 0.4, 0.2), strict=True):
        patches = rng.uniform(20, 235, (count, count, 3)).astype(np.float32)
        wall += weight * cv2.resize(patches, size, interpolation=cv2.INTER_CUBIC)
    return wall


def told(turned: Callable[[int], np.ndarray], seed: int, *, lamp: bool = False) -> PictureMotion:
    """Return the motion found of a camera whose pose at picture k is turned by R (3, 3).

    A dark arm swings, a box as high as the picture crosses, a stack is taken away at picture 20,
    and, with a lamp, the light changes by a third and a shadow passes.
    """
    wall, column = patched(seed, (WIDTH, HEIGHT), (5, 20, 60)), np.arange(WIDTH)

    def read(k: int) -> np.ndarray:
        # A direction d of the first camera is R^T d in the turned one.
        view = K @ turned(k).T @ np.linalg.inv(K)
        drawn = cv2.warpPerspective(wall, view, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
        if k < 20:
            cv2.rectangle(drawn, (20, 120), (110, 239), (200, 60, 40), -1)
        end = (160 + round(90 * np.sin(0.3 * k)), 60 + round(30 * np.cos(0.4 * k)))
        cv2.line(drawn, (160, 239), end, (30, 30, 35), 22)
        cv2.rectangle(drawn, (9 * k - 60, 0), (9 * k, 239), (90, 120, 150), -1)
        if lamp:
            drawn = drawn * (1.0 - 0.33 * (k > 12)) + 10.0 * np.sin(k)
            drawn = drawn * np.where(np.abs(column - 8 * k) < 40, 0.6, 1.0)[:, None]
        noise = np.random.default_rng([seed, k]).normal(0.0, 3.0, drawn.shape)
        return np.clip(drawn + noise, 0.0, 255.0).astype(np.uint8)

    return find_camera_motion(read, COUNT, CAMERA)


def turn(axis: tuple[float, float, float], pixels: float) -> np.ndarray:
    """Return a rotation (3, 3) that shifts the middle of the picture by about some pixels."""
    vector = np.array(axis) / np.linalg.norm(axis)
    return Rotation.from_rotvec(vector * pixels / FOCAL).as_matrix()


@pytest.mark.parametrize("seed", range(3))
def test_nudges_are_found_at_their_picture_with_their_angle(seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    first, pixels = int(rng.integers(4, COUNT - 4)), float(rng.uniform(1.0, 13.0))
    R = turn((*rng.normal(size=2), 0.3), pixels)
    motion = told(lambda k: R if k >= first else STILL, seed, lamp=seed % 2 == 1)
    (nudge,) = motion.nudges
    assert (nudge.before, nudge.after) == (first - 1, first)
    true = Rotation.from_matrix(R.T).as_rotvec()
    np.testing.assert_allclose(nudge.rotation, true, atol=0.2 / FOCAL + 0.03 * pixels / FOCAL)
    grid = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT), [1.0]), axis=-1).reshape(-1, 3)
    seen = grid @ (K @ R.T @ np.linalg.inv(K)).T
    shift = np.linalg.norm(seen[:, :2] / seen[:, 2:] - grid[:, :2], axis=1)
    assert nudge.pixels == pytest.approx(np.sqrt((shift**2).mean()), rel=0.1, abs=0.2)
    assert (motion.drift, motion.shake) == (0.0, 0.0)


@pytest.mark.parametrize("first", [23, 26])
def test_nudges_are_bracketed_between_compared_pictures(monkeypatch, first: int) -> None:
    """One picture is taken in the middle of the nudge; few pictures are compared at first."""
    monkeypatch.setattr(camera_motion, "MOTION", replace(camera_motion.MOTION, most=9))
    R = [STILL, turn((1.0, 0.2, 0.0), 4.0), turn((1.0, 0.2, 0.0), 8.0)]
    (nudge,) = told(lambda k: R[int(np.clip(k - first + 1, 0, 2))], 5).nudges
    assert (nudge.before, nudge.after) == (first - 1, first + 1)


def test_shifts_are_those_of_similar_pictures() -> None:
    """Shifts along u and v, rotation and growth, in pictures of two thirds of the size."""
    size, walls = (960, 720), [patched(seed, (960, 720), (5, 20, 60)) for seed in (7, 8)]
    moves = np.array([[0.0] * 4, [4.5, -3.0, 0, 0], [0, 0, 0.01, 0], [-2, 3, -0.008, 0.015]])

    def read(k: int) -> np.ndarray:
        u, v, angle, growth = moves[k % 4]
        view = cv2.getRotationMatrix2D((479.5, 359.5), -np.degrees(angle), 1.0 + growth)
        view[:, 2] += u, v
        return cv2.warpAffine(walls[k // 4], view, size).clip(0.0, 255.0).astype(np.uint8)

    tracker = camera_motion.BackgroundTracker(read, 0, CAMERA.resized(*size))
    found, radius = tracker.shifts(range(5), at_once=2), np.hypot(640, 480) / np.sqrt(12.0)
    np.testing.assert_allclose(found[:4, :4], moves * [2 / 3, 2 / 3, radius, radius], atol=0.1)
    assert np.isnan(found[4, :4]).all()  # Another wall.


@pytest.mark.parametrize("seed", [0, 1])
def test_a_camera_that_stands_still_has_no_motion(seed: int) -> None:
    motion = told(lambda _: STILL, 10 + seed, lamp=seed % 2 == 1)
    assert motion == PictureMotion((), found_again=motion.found_again)
    assert motion.found_again > 0.3  # 0.13 at most, where the camera rides on the robot.


def test_drift_and_shake_are_no_nudges() -> None:
    drifts = told(lambda k: turn((1.0, 0.2, 0.0), 4.0 * k / COUNT), 22)
    assert drifts.nudges == ()
    # Between the medians of the first and last five pictures.
    assert drifts.drift == pytest.approx(4.0 * 35 / COUNT, abs=0.2)
    assert drifts.shake == 0.0
    rng = np.random.default_rng(0)
    steps = [turn(tuple(one), 2.0) for one in rng.normal(size=(COUNT, 3)) * (1.0, 1.0, 0.2)]
    shakes = told(lambda k: steps[k], 23)
    assert shakes.nudges == ()
    assert shakes.shake == pytest.approx(2.0, abs=0.5)


def test_nothing_is_told_of_pictures_without_corners() -> None:
    def plain(k: int) -> np.ndarray:
        return np.full((HEIGHT, WIDTH, 3), 100 + k, np.uint8)

    assert find_camera_motion(plain, COUNT, CAMERA) == PictureMotion(())
    assert find_camera_motion(plain, 2, CAMERA) == PictureMotion(())


def steps_of(levels: list[float], counts: list[int], noise: float, seed: int = 1) -> np.ndarray:
    """Return samples (n, 4) that stand at levels along a direction, with noise."""
    rng = np.random.default_rng(seed)
    along = np.repeat(levels, counts)[:, None] * np.array([0.6, 0.0, -0.8, 0.0])
    return along + noise * rng.normal(size=(len(along), 4))


@pytest.mark.parametrize(
    ("levels", "counts", "noise", "found"),
    [
        ([0.0], [30], 0.1, []), ([0.0, 1.0], [12, 18], 0.02, [(11, 12)]),
        ([0.0, 1.0, 3.0], [9, 8, 13], 0.02, [(8, 9), (16, 17)]),
        # A step that is undone; one hidden by noise; one under the least size.
        ([0.0, 2.0, 0.0], [9, 9, 9], 0.02, [(8, 9), (17, 18)]),
        ([0.0, 1.0], [12, 18], 0.2, []), ([0.0, 0.45], [12, 18], 0.001, []),
        ([0.0, 0.55], [12, 18], 0.001, [(11, 12)]),
        # Up to three samples are taken during a step; four make a slow motion.
        ([0.0, 1.0, 2.0], [12, 1, 18], 0.02, [(11, 13)]),
        ([0.0, 0.7, 1.0, 1.3, 2.0], [12, 1, 1, 1, 18], 0.02, [(11, 15)]),
        ([*np.linspace(0.0, 3.0, 30)], [1] * 30, 0.02, []),
    ],
)  # fmt: skip
def test_steps_are_found_between_their_samples(levels, counts, noise, found) -> None:
    assert find_steps(steps_of(levels, counts, noise), 0.5) == found
