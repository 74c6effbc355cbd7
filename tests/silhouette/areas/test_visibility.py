import numpy as np
import pytest

from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.errors import CameraError
from drake_pose.silhouette.areas.outline import outline_from_mesh
from drake_pose.silhouette.areas.scoring import require_visible
from tests.silhouette.shapes import box

PINHOLE = PinholeCamera("eye", 64, 48, 60.0, 60.0, 31.5, 23.5, np.eye(4))
PARALLEL = ParallelCamera("flat", 64, 48, 20.0, 31.5, 23.5, np.eye(4))
CUBE = outline_from_mesh(box(1.0))


def at(x, y, z):
    X_CN = np.eye(4)
    X_CN[:3, 3] = (x, y, z)
    return X_CN


def test_a_body_in_view_is_accepted():
    require_visible([CUBE], at(0, 0, 3)[None], PINHOLE)
    require_visible([CUBE], at(0, 0, -3)[None], PARALLEL)
    require_visible([CUBE, CUBE], np.array([at(0, 0, 3), at(0, 0, -3)]), PINHOLE)
    require_visible([CUBE], at(0.6, 0, 0)[None], PINHOLE)  # beside the camera, in part before it


def test_a_body_out_of_sight_is_refused():
    with pytest.raises(CameraError, match=r"'eye'.*behind"):
        require_visible([CUBE, CUBE], np.array([at(0, 0, -3), at(1, 0, -2)]), PINHOLE)
    with pytest.raises(CameraError, match=r"'eye' is inside"):
        require_visible([CUBE, CUBE], np.array([at(0, 0, 3), at(0.1, 0.2, 0.3)]), PINHOLE)
    with pytest.raises(CameraError, match=r"'eye'.*outside the picture"):
        require_visible([CUBE], at(50, 0, 3)[None], PINHOLE)
    with pytest.raises(CameraError, match=r"'flat'.*outside the picture"):
        require_visible([CUBE], at(0, 50, 3)[None], PARALLEL)
