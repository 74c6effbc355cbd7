import numpy as np

from drake_pose.camera.models import ParallelCamera, circle_of_cameras
from drake_pose.person.views import FrameViews, see_silhouette, shows_somebody


def ellipse(rows: int, columns: int) -> np.ndarray:
    y, x = np.mgrid[:rows, :columns]
    return ((x - 0.4 * columns) / (0.1 * columns)) ** 2 + ((y - 0.5 * rows) / (0.3 * rows)) ** 2 < 1


def test_scoring_regions_are_subsampled_with_their_cameras():
    """For a pinhole and a parallel camera."""
    pinhole = circle_of_cameras(2)["camera_0"]
    flat = ParallelCamera("flat", 320, 241, 90.0, 150.0, 118.0, pinhole.X_WC)
    cameras = [pinhole, flat]
    seen = FrameViews(cameras, [see_silhouette(ellipse(c.height, c.width), 4.0) for c in cameras])
    points = np.random.default_rng(0).normal([0.0, 0.0, 1.0], 0.3, (20, 3))
    assert len(seen.scoring) == 2
    for k, small, region in zip(seen.scoring, *seen.scoring_regions, strict=True):
        step = cameras[k].height // 120
        assert step > 1
        np.testing.assert_allclose(step * small.project(points)[0], cameras[k].project(points)[0])
        np.testing.assert_array_equal(region, seen.views[k].region[::step, ::step])
        assert region.shape == (small.height, small.width)


def test_speck_is_no_person():
    assert shows_somebody(see_silhouette(ellipse(480, 640), 6.0))
    speck = np.zeros((480, 640), bool)
    speck[10:14, 10:14] = True
    assert not shows_somebody(see_silhouette(speck, 6.0))
    assert not shows_somebody(None)
