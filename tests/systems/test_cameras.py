"""The camera rig, compared with the label renderer."""

import cv2
import numpy as np
import pytest

from drake_pose.camera.camera_files import load_cameras, save_cameras
from drake_pose.camera.models import circle_of_cameras, look_at
from drake_pose.errors import CameraError, UnknownNameError
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.systems.cameras import build_camera_rig
from tests.person.persons_in_view import posed

SIZE = (160, 120)


@pytest.fixture(scope="module")
def standing(person):
    return posed(person, z=1.5, left_upper_arm_z=75)


def test_masks_equal_the_label_renderers(person, standing, tmp_path):
    save_cameras(tmp_path / "cameras.yaml", circle_of_cameras(3, size=SIZE))
    cameras = load_cameras(tmp_path / "cameras.yaml")
    rig = build_camera_rig(person, cameras)
    context = rig.diagram.CreateDefaultContext()
    rig.set_positions(context, standing)
    for name, camera in cameras.items():
        mask = rig.mask(context, name)
        assert mask.any()
        assert np.array_equal(mask, LabelRenderer(person, camera).mask(standing))
        picture = rig.picture(context, name)
        assert picture.shape == (120, 160, 3)
        near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert np.ptp(picture[~near], axis=0).max() <= 1  # The background has one colour.


def test_unknown_and_missing_cameras_are_refused(person):
    rig = build_camera_rig(person, circle_of_cameras(1, size=SIZE, face_camera=False))
    with pytest.raises(UnknownNameError, match="camera_9"):
        rig.picture(rig.diagram.CreateDefaultContext(), "camera_9")
    with pytest.raises(CameraError, match="at least one"):
        build_camera_rig(person, {})
    with pytest.raises(CameraError, match="cannot look"):
        look_at([0, 0, 2], [0, 0, 1])
