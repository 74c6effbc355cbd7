"""Conventions of a recorded camera pose are told from the pose that the pictures show."""

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.models import inverse_pose, look_at
from drake_pose.jobs.registration.readings import likeliest_reading
from tests.benchmarks.rooms import _around


def upright(rng):
    """A camera that looks at a robot's middle from any side: X_WC, and its distance [m]."""
    away = rng.uniform(0.7, 1.7) * _around(rng, rng.uniform(-0.1, 0.8))
    X = rotated(lambda R: R * turn(rng, 0.1), look_at(away, np.zeros(3)))
    X[2, 3] += 0.4
    return X, float(np.linalg.norm(away))


def turn(rng, size):
    return Rotation.from_rotvec(rng.normal(0.0, size, 3))


def off_by_a_bit(rng, X):
    """Return X as a good calibration has it: two degrees and 20 mm off."""
    X = rotated(lambda R: R * turn(rng, 0.02), X)
    X[:3, 3] += rng.normal(0.0, 0.012, 3)
    return X


def rotated(change, X):
    X = X.copy()
    X[:3, :3] = change(Rotation.from_matrix(X[:3, :3])).as_matrix()
    return X


def as_angles(numbers):
    return partial(rotated, lambda R: Rotation.from_euler("xyz", numbers(R)))


def euler(meant, read):
    return partial(rotated, lambda R: Rotation.from_euler(read, R.as_euler(meant)))


def quaternion(shift):
    return partial(rotated, lambda R: Rotation.from_quat(np.roll(R.as_quat(), shift)))


LINK = Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
link = partial(rotated, lambda R: R * LINK)


def scaled(by, X):
    return X * np.array([1.0, 1.0, 1.0, by])


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (inverse_pose, ["the inverse of the camera's pose"]),
        (link, ["ROS' camera_link"]),
        (lambda X: X @ np.diag([1.0, -1.0, -1.0, 1.0]), ["OpenGL"]),
        (partial(scaled, 1e3), ["in millimetres"]),
        (euler("XYZ", "xyz"), ["moving x, y, z axes, read as about fixed x, y, z"]),
        (euler("ZYX", "xyz"), ["moving z, y, x axes, read as about fixed x, y, z"]),
        (euler("zyx", "xyz"), ["fixed z, y, x axes, read as about fixed x, y, z"]),
        (euler("xyz", "XYZ"), ["fixed x, y, z axes, read as about moving x, y, z"]),
        (quaternion(1), ["in the order w, x, y, z"]),
        (quaternion(-1), ["in the order x, y, z, w"]),
        (as_angles(Rotation.as_rotvec), ["made of a rotation vector"]),
        (as_angles(lambda R: np.radians(R.as_euler("xyz"))), ["in radians, read as degrees"]),
        (lambda X: scaled(1e3, inverse_pose(link(X))), ["inverse", "camera_link", "millimetres"]),
        (lambda X: quaternion(1)(inverse_pose(X)), ["inverse", "in the order w, x, y, z"]),
    ],
)
def test_a_convention_is_named(wrong, words):
    rng = np.random.default_rng(45)
    for _ in range(5):
        X, distance = upright(rng)
        text, angle, shift = likeliest_reading(wrong(off_by_a_bit(rng, X)), X, distance)
        assert all(word in text for word in words)
        assert angle < np.radians(8.0)
        assert shift < 0.08


def test_no_convention_is_named_for_a_camera_elsewhere():
    rng = np.random.default_rng(46)
    for _ in range(60):
        X, distance = upright(rng)
        other, _ = upright(rng)
        random = Rotation.random(random_state=rng.integers(1 << 30))
        for given in (other, rotated(lambda _, R=random: R, X), off_by_a_bit(rng, X)):
            assert likeliest_reading(given, X, distance) is None
