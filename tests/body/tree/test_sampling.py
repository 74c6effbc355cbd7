import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import RootRotation
from drake_pose.body.pose_tree import axis_samples, product_grid
from drake_pose.body.root import even_rotations
from drake_pose.errors import SettingsError

TWENTY = np.radians(20.0)


@pytest.mark.parametrize(
    ("lower", "upper", "expected"),
    [
        (-60, 60, [0, -20, 20, -40, 40, -60, 60]),
        (-100, 10, [0, -20, -40, -60, -80, -100]),
        (0, 40, [0, 20, 40]),
        (25, 35, [30]),
        (5, 5, [5]),
        (50, 110, [60, 80, 100]),
    ],
)
def test_multiples_by_size_negative_first(lower, upper, expected):
    samples = axis_samples(np.radians(lower), np.radians(upper), TWENTY, is_angle=True)
    np.testing.assert_allclose(np.degrees(samples), expected, atol=1e-9)
    assert min(samples) >= np.radians(lower)
    assert max(samples) <= np.radians(upper)


def test_full_turn_gives_each_direction_once():
    samples = np.degrees(axis_samples(-np.pi, np.pi, TWENTY, is_angle=True))
    assert len(samples) == 18
    assert len(np.unique(np.round(samples % 360.0, 6))) == 18
    assert len(axis_samples(-np.pi, np.pi, TWENTY, is_angle=False)) == 19


def test_last_axis_changes_fastest():
    grid = product_grid([[0.0, 1.0], [5.0], [2.0, 3.0]], "n")
    np.testing.assert_array_equal(grid, [[0, 5, 2], [0, 5, 3], [1, 5, 2], [1, 5, 3]])
    assert product_grid([], "n").shape == (1, 0)


def test_too_many_samples_name_the_node():
    with pytest.raises(SettingsError, match="node 'head'"):
        product_grid([range(1000)] * 3, "head")


def test_even_rotations_leave_no_gap():
    interval = np.radians(30.0)
    grid = Rotation.from_rotvec(even_rotations(interval))
    np.testing.assert_allclose(grid[0].magnitude(), 0.0, atol=1e-12)
    probes = Rotation.random(300, random_state=1)
    nearest = [(grid * probe.inv()).magnitude().min() for probe in probes]
    assert max(nearest) < 0.95 * interval
    distances = [np.sort((grid * one.inv()).magnitude())[1] for one in grid[::25]]
    assert min(distances) > 0.3 * interval


def test_limited_rotation_is_applied_in_order():
    rotation = RootRotation.limited([("y", -180, 180), ("z", -10, 10)])
    values = np.array([[0.5, 0.1]])
    expected = Rotation.from_euler("y", 0.5) * Rotation.from_euler("z", 0.1)
    np.testing.assert_allclose(rotation.rotations(values)[0], expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotation.values_from(expected.as_matrix()), [0.5, 0.1], atol=1e-9)
    assert rotation.value_names == ("root_y", "root_z")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RootRotation.fixed(np.diag([1.0, 1.0, -1.0])), "not a 3 x 3 rotation"),
        (lambda: RootRotation.fixed(np.zeros((2, 2))), "not a 3 x 3 rotation"),
        (lambda: RootRotation.fixed(np.full((3, 3), np.nan)), "not a 3 x 3 rotation"),
        (lambda: RootRotation.free(0.0), "interval"),
        (lambda: RootRotation.limited([("y", 10, -10)]), "lower first"),
        (lambda: RootRotation.limited([("y", 0, 1), ("y", 0, 1)]), "different"),
        (lambda: RootRotation.limited([]), "one to three"),
    ],
)
def test_bad_rotations_are_refused(make, message):
    with pytest.raises(SettingsError, match=message):
        make()


def test_a_tiny_interval_is_refused_before_memory_is_taken():
    with pytest.raises(SettingsError, match=r"1e-12.*larger interval"):
        axis_samples(-1.0, 1.0, 1e-12, is_angle=True)
