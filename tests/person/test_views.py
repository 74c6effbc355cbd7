import numpy as np
import pytest

from drake_pose.camera.models import ParallelCamera, circle_of_cameras
from drake_pose.person.views import _coarser, see_silhouette, shows_somebody


def ellipse(rows: int, columns: int) -> np.ndarray:
    y, x = np.mgrid[:rows, :columns]
    return ((x - 0.4 * columns) / (0.1 * columns)) ** 2 + ((y - 0.5 * rows) / (0.3 * rows)) ** 2 < 1


@pytest.mark.parametrize("kind", ["pinhole", "parallel"])
def test_a_coarser_camera_sees_every_third_pixel(kind):
    camera = circle_of_cameras(2)["camera_0"]
    if kind == "parallel":
        camera = ParallelCamera("flat", 320, 241, 90.0, 150.0, 118.0, camera.X_WC)
    coarse = _coarser(camera, 3)
    points = np.random.default_rng(0).normal([0.0, 0.0, 1.0], 0.3, (20, 3))
    np.testing.assert_allclose(3.0 * coarse.project(points)[0], camera.project(points)[0])
    picture = np.zeros((camera.height, camera.width))[::3, ::3]
    assert (coarse.height, coarse.width) == picture.shape


def test_a_speck_is_nobody():
    assert shows_somebody(see_silhouette(ellipse(480, 640), 6.0))
    speck = np.zeros((480, 640), bool)
    speck[10:14, 10:14] = True
    assert not shows_somebody(see_silhouette(speck, 6.0))
    assert not shows_somebody(None)
