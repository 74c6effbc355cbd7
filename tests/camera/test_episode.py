"""What is wrong in the times of any recording is named, and positions are never made up."""

from pathlib import Path

import numpy as np
import pytest

from drake_pose.camera.episode import Episode, EpisodeCamera, JointLog, ascending
from drake_pose.errors import SceneError, UnknownNameError

TIMES = 0.1 * np.arange(20)


def camera(times):
    return EpisodeCamera("a", 4, 3, times, None, None, lambda k: np.zeros((3, 4 + k, 3), np.uint8))


def log(times):
    return JointLog(("x", "y"), times, np.column_stack([2.0 * times, np.sin(times)]))


def episode(times, joints):
    return Episode.checked(Path("here"), [camera(times)], joints)


def test_positions_between_rows_and_none_beyond_them():
    wanted = np.array([-0.06, -0.04, 0.0, 0.05, 1.84, 1.9, 1.94, 1.96, np.nan])
    found = log(TIMES).at(wanted)
    expected = [np.nan, 0.0, 0.0, 0.1, 3.68, 3.8, 3.8, np.nan, np.nan]
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-12)
    assert found[3, 1] == pytest.approx(0.5 * np.sin(0.1))
    # A reading that is missing leaves no position up to its neighbours, which stand.
    broken = log(TIMES)
    broken.positions[3, 0] = np.nan
    assert np.isnan(broken.at(np.array([0.2, 0.25, 0.35, 0.4]))[:, 0]).tolist() == [0, 1, 1, 0]
    one = JointLog(("x",), np.array([2.0]), np.array([[7.0]]))
    np.testing.assert_array_equal(one.at(np.array([1.99, 2.0]))[:, 0], [np.nan, 7.0])


def test_rows_of_frames_are_found_by_name_or_number():
    rows = JointLog(("x",), None, np.array([[1.0], [2.0], [3.0]]), ("7", "last", "12.0"))
    found = rows.of_frames(["0012", "007", "last", "8"])
    np.testing.assert_array_equal(found[:, 0], [3.0, 1.0, 2.0, np.nan])
    with pytest.raises(SceneError, match="frames and have no times"):
        rows.at(TIMES)
    with pytest.raises(SceneError, match="are of no frames"):
        log(TIMES).of_frames(["7"])


def test_clocks_that_run_backwards():
    times = TIMES.copy()
    times[5], times[7] = times[4], 0.05
    kept, said = ascending(times, "the log")
    np.testing.assert_array_equal(kept, np.delete(np.arange(20), [5, 7]))
    assert "number 5" in said[0]
    assert "2 of 20 such are left out" in said[0]
    times[8:] -= 0.6
    with pytest.raises(SceneError, match=r"the log: number 5 .* runs backwards or stands still"):
        ascending(times, "the log")
    with pytest.raises(SceneError, match="the log: holds nothing"):
        ascending(np.zeros(0), "the log")


def test_what_is_odd_is_named():
    broken = log(TIMES)
    broken.positions[[3, 9], 1] = np.nan, np.inf
    for times, joints, expected in (
        (TIMES[2:-2] + 0.013, log(TIMES), None),
        (TIMES + 1.71, log(TIMES), "17 of 20 pictures are before or after the log (1.710 to"),
        (TIMES[:14], log(TIMES), "camera 'a': its pictures end, or begin, while the log goes on"),
        (TIMES + 1.7e9, log(TIMES), "camera 'a': its clock is not the joint log's: no picture"),
        (np.delete(TIMES, [4, 5, 11]), log(TIMES), "camera 'a': 2 of 16 steps are longer than 1.5"),
        (TIMES, log(np.delete(TIMES, [4, 5])), "the joint log: 1 of 17 steps"),
        (TIMES[:1], log(TIMES), "camera 'a': has one picture only"),
        (TIMES, broken, "'y' is no number in 2 of 20 rows, the first of which is 3"),
        (TIMES, None, "here: holds no joint positions"),
    ):
        said = episode(times, joints).warnings
        assert expected in said[0] if expected else said == ()


def test_what_cannot_be_used_is_refused():
    with pytest.raises(SceneError, match="here: holds no camera's pictures because"):
        Episode.checked(Path("here"), [], log(TIMES), ["because"])
    with pytest.raises(SceneError, match="holds no row"):
        episode(TIMES, JointLog((), TIMES, np.zeros((20, 0))))
    with pytest.raises(SceneError, match=r"nothing tells which .* of camera 'a'.*timestamps\.csv"):
        episode(np.full(3, np.nan), log(TIMES))
    with pytest.raises(UnknownNameError, match="here has no camera 'c'; it has: a"):
        episode(TIMES, None).camera("c")
    with pytest.raises(SceneError, match="camera 'a' has no picture 20, but 0 to 19"):
        camera(TIMES).read(20)
    with pytest.raises(SceneError, match=r"picture 1: has 5 x 3 pixels .* the first one 4 x 3"):
        camera(TIMES).read(1)
