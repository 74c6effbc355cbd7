"""Every parameter's motion of the nodes against finite differences of pictures."""

import numpy as np
import pytest

from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import ParallelCamera, circle_of_cameras
from drake_pose.fit.parameters import CAMERA_NAMES, BodyParameters, CameraParameters
from drake_pose.fit.surfaces import VERY_FEW, few_triangles
from drake_pose.silhouette.areas.bending import TreeSurfaces
from tests.fit.motions import STEP, assert_motions_are_derivatives


@pytest.fixture(scope="module")
def body(person):
    tree = person.pose_tree()
    outlines = few_triangles(TreeSurfaces(tree), VERY_FEW)
    groups = np.arange(len(tree.nodes)) % 3 - 1
    return BodyParameters(TreeKinematics(tree), outlines, groups, ("one", "two"))


@pytest.fixture(scope="module")
def theta(body):
    generator = np.random.default_rng(5)
    kinematics = body.kinematics
    values = kinematics.flatten(kinematics.tree.default_values())
    lower, upper = np.maximum(kinematics.lower, -1.0), np.minimum(kinematics.upper, 1.0)
    values = np.clip(values, lower, upper) + 0.3 * (upper - lower) * generator.uniform(0, 0.2)
    return np.concatenate([values, [0.2, -0.1, 0.15, 0.1], [0.2, -0.15]])


def test_body_parameters_against_finite_differences(body, theta):
    assert_motions_are_derivatives(body, theta)


def test_values_alone_are_all_parameters_at_rest(body, theta):
    count = len(body.kinematics.names)
    alone = body.place(theta[:count])
    whole = body.place(np.concatenate([theta[:count], np.zeros(6)]))
    np.testing.assert_allclose(alone.X_WN, whole.X_WN, atol=1e-12)
    np.testing.assert_allclose(alone.motions, whole.motions[:count], atol=1e-12)


def picture(X_CW, kernel, p_W):
    """(2,) where a point (3,) is seen."""
    x, y, z = X_CW[:3, :3] @ p_W + X_CW[:3, 3]
    depth = 1.0 if kernel[0] == 1.0 else z
    return np.array([kernel[1] * x / depth + kernel[3], kernel[2] * y / depth + kernel[4]])


def test_camera_parameters_against_finite_differences():
    (pinhole,) = circle_of_cameras(1, face_camera=False).values()
    parallel = ParallelCamera("parallel", 640, 480, 250.0, 320.0, 240.0, pinhole.X_WC)
    cameras = CameraParameters([pinhole, parallel], np.array([0.1, -0.2, 1.0]))
    theta = np.random.default_rng(2).uniform(-0.3, 0.3, len(cameras.names))
    X_CW, kernel, motions = cameras.place(theta)
    for index, step in enumerate(STEP * np.eye(len(theta))):
        c, k = divmod(index, len(CAMERA_NAMES))
        above, below = (cameras.place(theta + by) for by in (step, -step))
        for p_W in np.array([[0.3, 0.1, 1.2], [-0.4, 0.2, 0.6]]):
            seen = picture(above[0][c], above[1][c], p_W) - picture(below[0][c], below[1][c], p_W)
            by = STEP * motions[c, k].reshape(3, 4) @ [*p_W, 1.0]
            told = picture(X_CW[c], kernel[c], p_W + by) - picture(X_CW[c], kernel[c], p_W - by)
            np.testing.assert_allclose(
                told / STEP, seen / STEP, rtol=1e-5, atol=2e-3, err_msg=cameras.names[index]
            )


def test_cameras_where_nothing_is_changed():
    rig = list(circle_of_cameras(3).values())
    X_CW, kernel, _ = CameraParameters(rig, np.ones(3)).place(np.zeros(27))
    for c, camera in enumerate(rig):
        np.testing.assert_allclose(X_CW[c], camera.X_CW, atol=1e-12)
        np.testing.assert_allclose(kernel[c], camera.kernel_parameters())
