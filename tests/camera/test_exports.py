"""Cameras for ROS and MuJoCo, against what these make of them."""

import shlex
import xml.etree.ElementTree as ElementTree

import cv2
import mujoco
import numpy as np
import pytest
import yaml
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform

from drake_pose.camera.exports import mujoco_cameras, ros_camera_info, ros_transforms
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.errors import CameraError

PLACE = RigidTransform(Quaternion(np.array([0.5, -0.7, 0.4, 0.3]) / np.sqrt(0.99)), [0.3, -0.2, 1])
CAMERA = PinholeCamera("head left", 64, 48, 60.0, 70.0, 25.3, 30.1, PLACE.GetAsMatrix4())
PARALLEL = ParallelCamera("flat", 64, 48, 50.0, 31.5, 23.5, np.eye(4))


def seen_points():
    """(n, 3) points of the world that the camera sees."""
    p_C = np.array([[0.0, 0.0, 1.0], [0.1, 0.2, 2.0], [-0.3, 0.1, 1.5], [0.2, -0.4, 3.0]])
    return p_C @ CAMERA.X_WC[:3, :3].T + CAMERA.X_WC[:3, 3]


def test_a_camera_info_projects_as_the_camera():
    info = yaml.safe_load(ros_camera_info(CAMERA))
    K, D, R, P = (
        np.array(info[key]["data"]).reshape(info[key]["rows"], info[key]["cols"])
        for key in (
            "camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix",
        )
    )  # fmt: skip
    assert info["distortion_model"] == "plumb_bob"
    assert (info["image_width"], info["image_height"]) == (64, 48)
    assert (K.size, R.size, P.size) == (9, 9, 12)
    np.testing.assert_array_equal(D, np.zeros((1, 5)))
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(P[:, :3], K)
    X_CW = np.linalg.inv(CAMERA.X_WC)
    turn, shift = cv2.Rodrigues(X_CW[:3, :3])[0], X_CW[:3, 3]
    for used in (K, P[:, :3]):
        uv, _ = cv2.projectPoints(seen_points(), turn, shift, used, D)
        np.testing.assert_allclose(uv[:, 0], CAMERA.project(seen_points())[0], atol=1e-9)


def test_a_launch_file_publishes_the_optical_frame():
    launch = ElementTree.fromstring(ros_transforms([CAMERA], {"head left": "panda_link0"}))
    (node,) = launch
    assert (node.get("pkg"), node.get("exec")) == ("tf2_ros", "static_transform_publisher")
    words = shlex.split(node.get("args", ""))
    given = dict(zip(words[::2], words[1::2], strict=True))
    assert given["--frame-id"] == "panda_link0"
    assert given["--child-frame-id"] == "head_left_optical_frame"
    q = Quaternion(*(float(given[f"--q{axis}"]) for axis in "wxyz"))
    pose = RigidTransform(q, [float(given[f"--{axis}"]) for axis in "xyz"])
    np.testing.assert_allclose(pose.GetAsMatrix4(), CAMERA.X_WC, atol=1e-12)


def test_mujoco_sees_points_at_the_same_pixels(tmp_path):
    (tmp_path / "cameras.xml").write_text(mujoco_cameras([CAMERA]))
    text = '<mujoco><worldbody><include file="cameras.xml"/></worldbody></mujoco>'
    (tmp_path / "scene.xml").write_text(text)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.camera("head left").id == 0
    assert model.cam_resolution[0].tolist() == [64, 48]
    scene, camera = mujoco.MjvScene(model, 10), mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, everything, scene)
    # What its renderer hands to glFrustum, and the pose that it looks from.
    view = scene.camera[0]
    x, y, z = ((seen_points() - data.cam_xpos[0]) @ data.cam_xmat[0].reshape(3, 3)).T
    left = view.frustum_center - view.frustum_width
    u = 64 * (view.frustum_near * x / -z - left) / (2.0 * view.frustum_width)
    height = view.frustum_top - view.frustum_bottom
    v = 48 * (view.frustum_top - view.frustum_near * y / -z) / height
    # It counts from the picture's corner, half a pixel before the first centre.
    expected = CAMERA.project(seen_points())[0]
    np.testing.assert_allclose(np.column_stack([u, v]) - 0.5, expected, atol=1e-3)


@pytest.mark.parametrize("export", [ros_camera_info, lambda one: mujoco_cameras([one])])
def test_parallel_cameras_are_refused(export):
    with pytest.raises(CameraError, match=r"'flat'.*parallel"):
        export(PARALLEL)
