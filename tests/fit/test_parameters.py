"""Every parameter's motion of the nodes against finite differences of pictures."""

import numpy as np
import pytest

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import ParallelCamera, PinholeCamera, circle_of_cameras
from drake_pose.fit.parameters import CAMERA_NAMES, BodyParameters, CameraParameters
from drake_pose.fit.surfaces import VERY_FEW, few_triangles
from drake_pose.silhouette.areas.bending import TreeSurfaces

STEP = 1e-6


@pytest.fixture(scope="module")
def body():
    tree = load_model(bundled_model("person"), check=False).pose_tree()
    kinematics = TreeKinematics(tree)
    outlines = few_triangles(TreeSurfaces(tree), VERY_FEW)
    groups = np.arange(len(tree.nodes)) % 3 - 1
    return BodyParameters(kinematics, outlines, groups, ("one", "two"))


@pytest.fixture(scope="module")
def theta(body):
    generator = np.random.default_rng(5)
    kinematics = body.kinematics
    values = kinematics.flatten(kinematics.tree.default_values())
    lower, upper = np.maximum(kinematics.lower, -1.0), np.minimum(kinematics.upper, 1.0)
    values = np.clip(values, lower, upper) + 0.3 * (upper - lower) * generator.uniform(0, 0.2)
    return np.concatenate([values, [0.2, -0.1, 0.15, 0.1], [0.2, -0.15]])


def world_points(placement):
    """One point of each node's surface, wherever the parameters have brought it."""
    starts = placement.packed.starts[:-1, 0]
    p_N = placement.packed.points[:, starts].T
    return np.einsum("nij,nj->ni", placement.X_WN[:, :3, :3], p_N) + placement.X_WN[:, :3, 3]


def motion_of(placement, node, parameter):
    """The affine motion (3, 4) that a parameter gives to a node."""
    affine = np.zeros((3, 4))
    for k in range(placement.starts[node], placement.starts[node + 1]):
        if placement.parameters[k] == parameter:
            affine += placement.motions[placement.owners[k]].reshape(3, 4)
    return affine


def test_body_parameters_against_finite_differences(body, theta):
    placement = body.place(theta)
    p_W = world_points(placement)
    for parameter, name in enumerate(body.names):
        ends = [theta.copy(), theta.copy()]
        ends[0][parameter] -= STEP
        ends[1][parameter] += STEP
        below, above = (world_points(body.place(end)) for end in ends)
        for node in range(len(p_W)):
            affine = motion_of(placement, node, parameter)
            speed = (above[node] - below[node]) / (2 * STEP)
            found = affine @ [*p_W[node], 1.0]
            np.testing.assert_allclose(found, speed, atol=1e-7, err_msg=f"{name}, node {node}")


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
    pinhole = next(iter(circle_of_cameras(1).values()))
    parallel = ParallelCamera("parallel", 640, 480, 250.0, 320.0, 240.0, pinhole.X_WC)
    assert isinstance(pinhole, PinholeCamera)
    cameras = CameraParameters([pinhole, parallel], np.array([0.1, -0.2, 1.0]))
    theta = np.random.default_rng(2).uniform(-0.3, 0.3, len(cameras.names))
    X_CW, kernel, motions = cameras.place(theta)
    points = np.array([[0.3, 0.1, 1.2], [-0.4, 0.2, 0.6]])
    for index, name in enumerate(cameras.names):
        c, k = divmod(index, len(CAMERA_NAMES))
        ends = [theta.copy(), theta.copy()]
        ends[0][index] -= STEP
        ends[1][index] += STEP
        moved = [cameras.place(end) for end in ends]
        for p_W in points:
            low, high = (picture(one[0][c], one[1][c], p_W) for one in moved)
            shifted = p_W + STEP * motions[c, k].reshape(3, 4) @ [*p_W, 1.0]
            back = p_W - STEP * motions[c, k].reshape(3, 4) @ [*p_W, 1.0]
            expected = picture(X_CW[c], kernel[c], shifted) - picture(X_CW[c], kernel[c], back)
            np.testing.assert_allclose(
                expected / (2 * STEP), (high - low) / (2 * STEP), rtol=1e-5, atol=1e-3, err_msg=name
            )


def test_cameras_where_nothing_is_changed():
    rig = list(circle_of_cameras(3).values())
    X_CW, kernel, _ = CameraParameters(rig, np.ones(3)).place(np.zeros(27))
    for c, camera in enumerate(rig):
        np.testing.assert_allclose(X_CW[c], camera.X_CW, atol=1e-12)
        np.testing.assert_allclose(kernel[c], camera.kernel_parameters())
