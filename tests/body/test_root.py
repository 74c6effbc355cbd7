"""Rotations of a tree's root, and rotations that cover all directions evenly."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import RootRotation
from drake_pose.body.root import even_rotations
from drake_pose.errors import SettingsError

TURNED = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()


def test_values_and_rotations_are_inverse():
    """Scipy's Euler angles and rotation vectors, after the rotation at zero."""
    ranges = [("y", 100.0, 300.0), ("z", -10.0, 10.0), ("x", -350.0, -100.0)]
    rng = np.random.default_rng(0)
    for start in (np.eye(3), TURNED):
        for count in (1, 2, 3):
            limited = RootRotation.limited(ranges[:count], rotation=start)
            axes = "".join(axis for axis, *_ in ranges[:count])
            assert limited.value_names == tuple(f"root_{axis}" for axis in axes)
            ends = np.degrees([limited.lower, limited.upper])
            np.testing.assert_allclose(ends.T, [row[1:] for row in ranges[:count]])
            values = rng.uniform(limited.lower, limited.upper, (20, count))
            values[:, 1:] = np.where(np.abs(values[:, 1:]) > 1.5, -1.8, values[:, 1:])
            expected = start @ Rotation.from_euler(axes.upper(), values).as_matrix()
            np.testing.assert_allclose(limited.rotations(values), expected, atol=1e-12)
            found = [limited.values_from(R) for R in expected]
            np.testing.assert_allclose(found, values, atol=1e-9)
        free = RootRotation.free(rotation=start)
        vectors = rng.normal(0.0, 0.5, (20, 3))
        expected = start @ Rotation.from_rotvec(vectors).as_matrix()
        np.testing.assert_allclose(free.rotations(vectors), expected, atol=1e-12)
        np.testing.assert_allclose(free.values_from(expected[0]), vectors[0], atol=1e-12)
        np.testing.assert_allclose(free.upper, np.pi)
        np.testing.assert_allclose(free.lower, -np.pi)
        assert free.value_names == tuple(f"root_rotation_{axis}" for axis in "xyz")
        fixed = RootRotation.fixed(start)
        np.testing.assert_array_equal(fixed.rotations(np.zeros((2, 0))), [start] * 2)
        assert fixed.values_from(start).shape == (0,)
        assert not any(one.R_W0.flags.writeable for one in (limited, free, fixed))


def test_invalid_rotations_are_refused():
    RootRotation.limited([("z", -360, 360)], interval_deg=180.0)
    assert RootRotation.free(90.0).interval == pytest.approx(np.pi / 2.0)
    for make, message in (
        *(
            (lambda bad=bad: RootRotation.fixed(bad), "not a 3 x 3 rotation")
            for bad in (np.diag([1, 1, -1]), np.zeros((2, 2)), np.full((3, 3), np.nan))
        ),
        (lambda: RootRotation.fixed(TURNED + 0.1), "not a 3 x 3 rotation"),
        (lambda: RootRotation.free(0.0), "interval"),
        (lambda: RootRotation.free(180.1), "interval"),
        (lambda: RootRotation.limited([("y", 10, -10)]), "lower first"),
        (lambda: RootRotation.limited([("y", -361, 0)]), "axis y"),
        (lambda: RootRotation.limited([("y", 0, 361)]), "axis y"),
        (lambda: RootRotation.limited([("y", 0, 1), ("y", 0, 1)]), "different"),
        (lambda: RootRotation.limited([("w", 0, 1)]), "different"),
        (lambda: RootRotation.limited([]), "one to three"),
    ):
        with pytest.raises(SettingsError, match=message):
            make()


@pytest.mark.parametrize("degrees", [30.0, 60.0])
def test_even_rotations_are_near_to_every_rotation_and_apart(degrees):
    """About as many as cells of the interval's size fill all rotations."""
    interval = np.radians(degrees)
    found = Rotation.from_rotvec(even_rotations(interval))
    assert found[0].magnitude() == 0.0
    assert (np.diff(found.magnitude()) > -1e-8).all()
    drawn = Rotation.random(300, random_state=1)
    nearest = [(found.inv() * one).magnitude().min() for one in drawn]
    assert max(nearest) < 0.95 * interval
    assert len(found) == pytest.approx(8.0 * np.pi**2 / interval**3, rel=0.3)
    apart = [np.sort((found.inv() * one).magnitude())[1] for one in found[::7]]
    assert min(apart) > 0.3 * interval
