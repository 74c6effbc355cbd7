"""Joint offsets of 15 degrees, found in pictures together with the camera."""

import numpy as np
import pytest

from drake_pose.fit.base_edges import BASE, draw_normals, joint_rotation, locate_base
from drake_pose.registration.picture_search import PictureSearch, PosedPicture
from drake_pose.registration.posed_frames import joints_like_cameras
from tests.benchmarks.rooms import Room
from tests.registration.arm_pictures import assert_close, looking_at

OFF = np.radians([0.0, 15.0, -12.0, 14.0, -15.0])
"""Offsets of the arm's joints. All its boxes move with the first one, whose offset is 0."""

NAMES = tuple(f"joint{k}" for k in range(5))


def test_offsets_of_fifteen_degrees_are_found_with_the_pose(episode) -> None:
    shown = range(0, 16, 2)
    frames = [PosedPicture(f"{k}", episode.values[k] - OFF, episode.pictures[k]) for k in shown]
    search = PictureSearch(episode.body, episode.camera.with_pose(np.eye(4)), frames)
    start = search.search(((64, 40, 24, 0.25), (64, 10, 50, 0.1)), rotations=300)[0]
    found, X_CW = search.fit_offsets(NAMES, start)
    assert np.abs(found.joint_offsets - OFF).max() < np.radians(0.8)
    camera = found.coarse_fit(X_CW).camera
    assert_close(camera.X_WC, episode.camera.X_WC, 0.008, 0.4)
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


@pytest.mark.parametrize("degrees", [14.0, 0.0])
def test_a_base_is_turned_to_its_edges(model, body, tmp_path, degrees: float) -> None:
    """The turret rests and stands for the base; all other boxes move with the shoulder."""
    camera = looking_at(np.array([1.2, 0.5, 0.9]), np.array([0.0, 0.0, 0.2]), 0.1)
    rng, kinematics = np.random.default_rng(3), body.kinematics
    values = rng.uniform(0.3 * kinematics.lower, 0.3 * kinematics.upper, (6, 5))
    values[:, 0] = 0.4
    room, pictures = Room(model, tmp_path, 4, False, np.pi), []
    for row in values:
        q = body.tree.positions_from(kinematics.split(row))[0]
        picture = room.picture(q, np.array([9.0, 9.0, 0.0]), camera)
        pictures.append(np.uint8(np.clip(picture + rng.normal(0.0, 3.0, picture.shape), 0, 255)))
    # Camera and offset are wrong together, and the moving boxes stay where they are.
    by = np.radians(degrees)
    X_WW = joint_rotation(kinematics, values[0], 1, by)
    wrong = camera.with_pose(np.linalg.inv(camera.X_CW @ X_WW))
    values[:, 1] -= by
    for row in values:
        np.testing.assert_allclose(
            wrong.X_CW @ kinematics.poses(row)[-1],
            camera.X_CW @ kinematics.poses(row + np.array([0.0, by, 0.0, 0.0, 0.0]))[-1],
            atol=1e-9,
        )
    found, deviation = locate_base(kinematics, body.full, wrong, pictures, values, 1)
    assert deviation < BASE.max_deviation
    assert abs(found + by) < 2.5 * deviation
    assert np.degrees(found) == pytest.approx(-degrees, abs=1.0)
    # A base outside the pictures says nothing.
    aside = wrong.with_pose(wrong.X_WC @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    assert locate_base(kinematics, body.full, aside, pictures, values, 1) == (0.0, np.inf)


def test_the_nearest_triangle_is_drawn_at_each_pixel() -> None:
    """Two triangles cross; each pixel's depth is that of the nearer plane."""
    corners = np.array([[[-1.0, -1.0], [40.0, -1.0], [-1.0, 40.0]]] * 2)
    depths = np.array([[1.0, 3.0, 1.0], [2.0, 2.0, 2.0]])
    picture = np.zeros((12, 16, 4), np.float32)
    draw_normals(corners, 1.0 / depths, np.array([[0.0, 0.6, -0.8], [0.0, 0.0, -1.0]]), picture)
    share = (np.tile(np.arange(16), (12, 1)) + 1.0) / 41.0
    sloped = (1.0 - share) + share / 3.0
    np.testing.assert_allclose(picture[..., 3], np.maximum(sloped, 0.5), rtol=1e-5)
    np.testing.assert_array_equal(picture[..., 1] > 0.0, sloped > 0.5)
