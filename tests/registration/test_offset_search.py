"""Joint offsets of 15 degrees, found in pictures together with the camera."""

import numpy as np
import pytest

from drake_pose.registration.offset_search import joints_like_cameras
from drake_pose.registration.picture_registration import register_pictures
from drake_pose.registration.picture_search import PictureSearch, PosedPicture
from tests.registration.arm_pictures import errors

OFF = np.radians([0.0, 15.0, -12.0, 14.0, -15.0])
"""Offsets of the arm's joints. All its boxes move with the first one, whose offset is 0."""

NAMES = tuple(f"joint{k}" for k in range(5))


def test_offsets_of_fifteen_degrees_are_found_with_the_pose(episode) -> None:
    shown = range(0, 16, 2)
    frames = [PosedPicture(f"{k}", episode.values[k] - OFF, episode.pictures[k]) for k in shown]
    search = PictureSearch(episode.body, episode.camera.with_pose(np.eye(4)), frames)
    start = search.search(((64, 40, 24, 0.25), (64, 10, 50, 0.1)), rotations=300)[0]
    found, X_CW = search.fit_offsets(NAMES, start)
    assert np.abs(found.joint_offsets - OFF).max() < np.radians(2.0)
    camera, _ = found.coarse_fit(X_CW)
    shift, turn = errors(camera.X_WC, episode.camera.X_WC)
    assert shift < 0.02
    assert turn < np.radians(1.0)
    # The frames' values include the offsets; those of the original search stay as they were.
    np.testing.assert_allclose(found.frames[1].values, frames[1].values + found.joint_offsets)
    np.testing.assert_array_equal(search.frames[1].values, frames[1].values)


def test_an_offset_about_a_fixed_axis_looks_like_a_rotation_of_the_camera(episode) -> None:
    kinematics = episode.body.kinematics
    shown = np.array([len(one.vertices) > 0 for one in episode.body.coarse])
    assert joints_like_cameras(kinematics, episode.values, shown) == ("joint0",)
    # Where the first joint rests, all that moves turns about the second joint, too.
    rests = episode.values * [0.0, 1.0, 1.0, 1.0, 1.0]
    assert joints_like_cameras(kinematics, rests, shown) == ("joint0", "joint1")


@pytest.mark.slow
def test_camera_and_large_offsets_are_found_within_their_deviations(episode, recording) -> None:
    nowhere = episode.camera.with_pose(np.eye(4))
    wrong = recording(values_at=lambda by: episode.values_at(episode.times + by) - OFF)
    one = register_pictures(episode.body, nowhere, wrong, offset_joints=NAMES[1:])
    shift, turn = errors(one.found.camera.X_WC, episode.camera.X_WC)
    assert shift < 0.02
    assert turn < np.radians(1.0)
    deviations = np.sqrt(np.diag(one.fit.covariance))
    for k, name in enumerate(NAMES[1:], 1):
        row = one.fit.fit.names.index(name)
        value = one.joint_offsets[k] + one.fit.found.shared[row]
        assert value == pytest.approx(OFF[k], abs=4.0 * deviations[row] + 1e-3)
