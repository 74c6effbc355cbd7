"""Conventions of a recorded camera pose are told from the pose that the pictures show."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.models import inverse_pose, look_at
from drake_pose.jobs.registration.readings import (
    joint_exchanges,
    likeliest_reading,
    readings,
    scene_corrections,
)
from drake_pose.registration.posed_frames import MultiViewFrame
from tests.benchmarks.rooms import _around
from tests.search.arms import arm_cameras


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
    return np.vstack([X[:3] * [1.0, 1.0, 1.0, by], X[3:]])


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
        (as_angles(lambda R: np.radians(R.as_euler("xyz"))), ["in radians, read as degrees"]),
        (lambda X: scaled(1e3, inverse_pose(link(X))), ["inverse", "camera_link", "millimetres"]),
        (lambda X: quaternion(1)(inverse_pose(X)), ["inverse", "in the order w, x, y, z"]),
    ],
)
def test_a_convention_is_named(wrong, words):
    rng = np.random.default_rng(45)
    for _ in range(3):
        X, distance = upright(rng)
        text, angle, shift = likeliest_reading(wrong(off_by_a_bit(rng, X)), X, distance)
        assert all(word in text for word in words)
        assert angle < np.radians(8.0)
        assert shift < 0.08


def test_every_rotation_vector_read_as_angles_is_undone():
    """Also where the angle about y is beyond 90 degrees, which other angles stand for."""
    read = [one for one in readings() if "rotation vector, read" in one.text and one.steps == 1]
    off, X = [], np.eye(4)
    for vector in np.random.default_rng(47).uniform(-1.8, 1.8, (30, 3)):
        X[:3, :3] = Rotation.from_euler("xyz", vector).as_matrix()
        true = Rotation.from_rotvec(vector).as_matrix()
        off.append([np.abs(one.meant(X)[:3, :3] - true).max() for one in read])
    assert np.min(off, axis=1).max() < 1e-9


def test_no_convention_is_named_for_a_camera_elsewhere():
    rng = np.random.default_rng(46)
    for _ in range(10):
        X, distance = upright(rng)
        other, _ = upright(rng)
        random = Rotation.random(random_state=rng.integers(1 << 30))
        for given in (other, rotated(lambda _, R=random: R, X), off_by_a_bit(rng, X)):
            assert likeliest_reading(given, X, distance) is None


VALUES = [np.full(3, float(k)) for k in range(4)]


def scaled_pictures(size):
    return lambda one: one.with_scaled_intrinsics(size, size)


def reposed(change):
    return lambda one: one.with_pose(change(one.X_WC))


@pytest.mark.parametrize("which", [("left", "right"), ("right",)])
def test_a_correction_undoes_every_usual_mistake(which):
    true = {one.name: one for one in arm_cameras()}
    mistakes = [scaled_pictures(size) for size in (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 1.5, 2, 3, 4)]
    mistakes += [lambda one: replace(one, center_x=one.center_y, center_y=one.center_x)]
    mistakes += map(reposed, (inverse_pose, link, partial(scaled, 1e3), partial(scaled, 1e2)))
    for mistake in mistakes:
        given = [mistake(one) if name in which else one for name, one in true.items()]
        assert any(
            all(
                np.allclose(k.kernel_parameters(), true[k.name].kernel_parameters())
                and np.allclose(k.X_WC, true[k.name].X_WC)
                for k in one.cameras
            )
            for one in scene_corrections(given, VALUES, "0123")
        )
    focal = [one for one in scene_corrections([*true.values()], VALUES, "0123")
             if one.kind == "focal" and len(one.fitted) == len(which)]  # fmt: skip
    factors = np.array([[k.focal_x / true[k.name].focal_x for k in one.cameras] for one in focal])
    np.testing.assert_allclose(np.exp([one.amount for one in focal]), factors.max(axis=1), rtol=0.6)
    for error in np.geomspace(0.5, 2.0, 20):
        assert np.abs(np.log(factors[:, 1] / error)).min() < 0.18


def test_exchanges_mirrors_and_other_rows_are_tried():
    left, right = (
        replace(one, focal_x=k) for k, one in zip((300, 310), arm_cameras(), strict=True)
    )
    mask = np.arange(12).reshape(3, 4) > 6
    frame = MultiViewFrame("1", VALUES[1], {"left": mask, "right": mask})
    tried = list(scene_corrections([left, right], VALUES, "0123"))
    poses = [
        [one.cameras[k].X_WC[0, 3] for k in (0, 1)] + [one.cameras[0].focal_x] for one in tried
    ]
    swapped = [right.X_WC[0, 3], left.X_WC[0, 3]]
    assert [*swapped, 300] in poses
    assert [*swapped, 310] in poses
    applied = [one.apply(frame) for one in tried]
    assert {float(one.values[0]) for one in applied} == {0.0, 1.0, 2.0}
    turned = {
        tuple(name for name, own in one.masks.items() if np.array_equal(own, mask[:, ::-1]))
        for one in applied
    }
    assert turned == {(), ("left", "right"), ("left",), ("right",)}
    frame = MultiViewFrame("1", np.arange(3.0), {})
    found = [one.apply(frame).values.tolist() for one in joint_exchanges([left], "abc", [0, 1, 2])]
    assert found == [[1, 0, 2], [2, 1, 0], [0, 2, 1]]
