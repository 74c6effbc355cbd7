"""Views of silhouettes, and the rays of their pixels."""

import numpy as np
import pytest

from drake_pose.camera.models import ParallelCamera, circle_of_cameras, look_at
from drake_pose.person import views

CAMERAS = (
    *circle_of_cameras(3).values(),
    ParallelCamera("flat", 300, 300, 226.0, 150, 150, look_at([2, 1, 1], [0, 0, 1])),
)


def ellipse(rows: int, columns: int) -> np.ndarray:
    y, x = np.mgrid[:rows, :columns]
    return ((x - 0.4 * columns) / (0.1 * columns)) ** 2 + ((y - 0.5 * rows) / (0.3 * rows)) ** 2 < 1


def test_scoring_regions_are_subsampled_with_their_cameras():
    """For a pinhole and a parallel camera."""
    pinhole = circle_of_cameras(2)["camera_0"]
    flat = ParallelCamera("flat", 320, 241, 90.0, 150.0, 118.0, pinhole.X_WC)
    cameras = [pinhole, flat]
    seen = views.FrameViews(
        cameras, [views.see_silhouette(ellipse(c.height, c.width), 4.0) for c in cameras]
    )
    points = np.random.default_rng(0).normal([0.0, 0.0, 1.0], 0.3, (20, 3))
    assert len(seen.scoring) == 2
    for k, small, region in zip(seen.scoring, *seen.scoring_regions, strict=True):
        step = cameras[k].height // 120
        assert step > 1
        np.testing.assert_allclose(step * small.project(points)[0], cameras[k].project(points)[0])
        np.testing.assert_array_equal(region, seen.views[k].region[::step, ::step])
        assert region.shape == (small.height, small.width)


def test_speck_is_no_person():
    assert views.shows_somebody(views.see_silhouette(ellipse(480, 640), 6.0))
    speck = np.zeros((480, 640), bool)
    speck[10:14, 10:14] = True
    assert not views.shows_somebody(views.see_silhouette(speck, 6.0))
    assert not views.shows_somebody(None)


def test_rays_pass_through_projected_points():
    p_W = np.random.default_rng(1).uniform([-0.5, -0.5, 0.5], [0.5, 0.5, 1.5], (20, 3))
    for camera in CAMERAS:
        origins, directions = views.viewing_rays(camera, camera.project(p_W)[0])
        np.testing.assert_allclose(np.cross(p_W - origins, directions), 0.0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    for place in p_W[:5]:
        pixels = [camera.project(place[None])[0][0] for camera in CAMERAS]
        np.testing.assert_allclose(views.triangulate(CAMERAS, pixels), place, atol=1e-9)
        pixels[0] = np.full(2, np.nan)
        np.testing.assert_allclose(views.triangulate(CAMERAS, pixels), place, atol=1e-9)


@pytest.mark.parametrize("apart", [0.03, 0.06])
def test_meeting_point_is_half_way_between_close_rays(apart):
    """Rays along x and along y: their distance is along z."""
    point = np.array([0.2, -0.1, 1.0])
    poses = [look_at([4.0, 0, 1], [0, 0, 1]), look_at([0, 4.0, 1], [0, 0, 1])]
    cameras = [ParallelCamera(str(k), 300, 300, 90.0, 150, 150, X) for k, X in enumerate(poses)]
    moved = point + apart * np.eye(3)[2]
    pixels = [cameras[0].project(point[None])[0], cameras[1].project(moved[None])[0]]
    found = views.meeting_points(cameras, pixels, 0.05)
    expected = [0.5 * (point + moved)] if apart < 0.05 else np.empty((0, 3))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert not len(views.meeting_points(cameras, pixels, 0.05, [np.array([False])] * 2))
