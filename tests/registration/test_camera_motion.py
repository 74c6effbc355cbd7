"""Motions of a camera in drawn pictures of a wall before which things move."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.camera_motion import PictureMotion, find_camera_motion

WIDTH, HEIGHT, FOCAL, COUNT = 320, 240, 300.0, 40
CAMERA = PinholeCamera("eye", WIDTH, HEIGHT, FOCAL, FOCAL, 159.5, 119.5, np.eye(4))
K = np.array([[FOCAL, 0.0, 159.5], [0.0, FOCAL, 119.5], [0.0, 0.0, 1.0]])
STILL = np.eye(3)


def told(turned: Callable[[int], np.ndarray], seed: int, *, lamp: bool = False) -> PictureMotion:
    """Return the motion found of a camera whose pose at picture k is turned by R (3, 3).

    A dark arm swings, a box as high as the picture crosses, a stack is taken away at picture 20,
    and, with a lamp, the light changes by a third and a shadow passes.
    """
    rng = np.random.default_rng(seed)
    wall = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    for cells, weight in ((5, 0.4), (20, 0.4), (60, 0.2)):
        patches = rng.uniform(20, 235, (cells, cells, 3)).astype(np.float32)
        wall += weight * cv2.resize(patches, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    column = np.arange(WIDTH)

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


@pytest.mark.parametrize("seed", range(6))
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


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_that_stands_still_has_no_motion(seed: int) -> None:
    assert told(lambda _: STILL, 10 + seed, lamp=seed % 2 == 1) == PictureMotion(())


def test_two_nudges_of_which_the_second_undoes_the_first() -> None:
    R = turn((1.0, 1.0, 0.0), 5.0)
    motion = told(lambda k: R if 12 <= k < 27 else STILL, 20)
    assert [one[:2] for one in motion.nudges] == [(11, 12), (26, 27)]
    one, other = (nudge.rotation for nudge in motion.nudges)
    np.testing.assert_allclose(one, -other, atol=0.3 / FOCAL)


def test_pictures_taken_during_a_nudge_belong_to_no_part() -> None:
    (nudge,) = told(lambda k: turn((0.0, 1.0, 0.0), 3.0 * np.clip(k - 14, 0, 3)), 21).nudges
    assert (nudge.before, nudge.after) == (14, 17)


def test_drift_and_shake_are_no_nudges() -> None:
    drifts = told(lambda k: turn((1.0, 0.2, 0.0), 4.0 * k / COUNT), 22)
    assert drifts.nudges == ()
    assert drifts.drift == pytest.approx(4.0, abs=0.7)
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
