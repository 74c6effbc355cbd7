"""Episodes in folders, and checks of a recording's times."""

from pathlib import Path

import numpy as np
import pytest

from drake_pose.camera.episode import Episode, JointLog, Stream, ascending_indices
from drake_pose.errors import SceneError, UnknownNameError

TIMES = 0.1 * np.arange(20)


def log(times):
    return JointLog(("x", "y"), times, np.column_stack([2.0 * times, np.sin(times)]))


def episode(times, joints):
    one = Stream("a", 4, 3, times, None, None, lambda k: np.zeros((3, 4 + k, 3), np.uint8))
    return Episode.checked(Path("here"), [one], joints)


def test_positions_are_interpolated_within_the_log():
    times = np.array([-0.06, -0.04, 0.0, 0.05, 1.84, 1.9, 1.94, 1.96, np.nan])
    found = log(TIMES).at(times)
    expected = [np.nan, 0.0, 0.0, 0.1, 3.68, 3.8, 3.8, np.nan, np.nan]
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-12)
    assert found[3, 1] == pytest.approx(0.5 * np.sin(0.1))
    # A missing reading leaves a gap up to its neighbours.
    broken = log(TIMES)
    broken.positions[3, 0] = np.nan
    assert np.isnan(broken.at(np.array([0.2, 0.25, 0.35, 0.4]))[:, 0]).tolist() == [0, 1, 1, 0]
    one = JointLog(("x",), np.array([2.0]), np.array([[7.0]]))
    np.testing.assert_array_equal(one.at(np.array([1.99, 2.0]))[:, 0], [np.nan, 7.0])


def test_frames_match_by_name_or_number():
    rows = JointLog(("x",), None, np.array([[1.0], [2.0], [3.0]]), ("7", "last", "12.0"))
    found = rows.of_frames(["0012", "007", "last", "8"])
    np.testing.assert_array_equal(found[:, 0], [3.0, 1.0, 2.0, np.nan])
    with pytest.raises(SceneError, match="frames, but no times"):
        rows.at(TIMES)
    with pytest.raises(SceneError, match="but no frames"):
        log(TIMES).of_frames(["7"])


def test_time_stamps_out_of_order_are_dropped_or_refused():
    times = TIMES.copy()
    times[5], times[7] = times[4], 0.05
    kept, warnings = ascending_indices(times, "the log")
    np.testing.assert_array_equal(kept, np.delete(np.arange(20), [5, 7]))
    assert "number 5" in warnings[0]
    assert "2 of 20 are left out" in warnings[0]
    times[8:] -= 0.6
    with pytest.raises(SceneError, match=r"the log: number 5 .* runs backwards or stands still"):
        ascending_indices(times, "the log")
    with pytest.raises(SceneError, match="the log: is empty"):
        ascending_indices(np.zeros(0), "the log")


def test_anomalies_of_times_are_warned_of():
    broken = log(TIMES)
    broken.positions[[3, 9], 1] = np.nan, np.inf
    for times, joints, expected in (
        (TIMES[2:-2] + 0.013, log(TIMES), None),
        (TIMES + 1.71, log(TIMES), "17 of 20 pictures are before or after the log (1.710 to"),
        (1e3 * TIMES, log(TIMES), "s): are the pictures' times in ms?"),
        (TIMES[:14], log(TIMES), "camera 'a': its pictures cover only a part of the log"),
        (TIMES + 1.7e9, log(TIMES), "camera 'a': its clock differs from the joint log's: no pict"),
        (np.delete(TIMES, [4, 5, 11]), log(TIMES), "camera 'a': 2 of 16 steps are longer than 1.5"),
        (TIMES, log(np.delete(TIMES, [4, 5])), "the joint log: 1 of 17 steps"),
        (TIMES[:1], log(TIMES), "camera 'a': has one picture only"),
        (TIMES, broken, "'y' is not a number in 2 of 20 rows, first in row 3"),
        (TIMES, None, "here: has no joint positions"),
    ):
        warnings = episode(times, joints).warnings
        assert expected in warnings[0] if expected else warnings == ()


def test_unusable_episodes_are_refused():
    good, empty = episode(TIMES, None), JointLog((), TIMES, np.zeros((20, 0)))
    for make, message in (
        (lambda: Episode.checked(Path("here"), [], log(TIMES), ["because"]),
         "here: has no camera's pictures: because"),
        (lambda: episode(TIMES, empty), "has no row"),
        (lambda: episode(np.full(3, np.nan), log(TIMES)), r"cannot match .* 'a'.*timestamps\.csv"),
        (lambda: good.camera("a").read(20), "camera 'a' has no picture 20, but 0 to 19"),
        (lambda: good.camera("a").read(1), "picture 1: has 5 x 3 pixels .* the first one 4 x 3"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=message):
            make()
    with pytest.raises(UnknownNameError, match="here has no camera 'c'; it has: a"):
        good.camera("c")
