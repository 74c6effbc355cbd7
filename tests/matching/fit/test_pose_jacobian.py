import numpy as np
import pytest

from drake_pose.body import bundled_model, load_model
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera import ParallelCamera, PinholeCamera
from drake_pose.matching.fit.pose_jacobian import image_jacobian, normal_jacobian, world_points
from drake_pose.silhouette import draw_mask, outline_from_mesh
from drake_pose.silhouette.contours.contour_points import find_contour_points

_X_WC = np.array(
    [[0.0, 0.0, -1.0, 5.0], [1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, -0.5], [0.0, 0.0, 0.0, 1.0]]
)


def cameras(fineness):
    size, centre = 400 * fineness, 200.0 * fineness
    scale = 120.0 * fineness
    return [
        ParallelCamera("parallel", size, size, scale, centre, centre, _X_WC),
        PinholeCamera("pinhole", size, size, 5 * scale, 5.2 * scale, centre, centre, _X_WC),
    ]


@pytest.fixture(scope="module")
def kinematics():
    return TreeKinematics(load_model(bundled_model("woman")).pose_tree(root_position=np.zeros(3)))


def grown(kinematics, change, base):
    """Poses after a change (m + 4,) of values, shift and growth."""
    m = len(base)
    X_WN = kinematics.poses(base + change[:m])
    p_WR = kinematics.poses(base)[0, :3, 3]
    factor = 1.0 + change[m + 3]
    X_WN[:, :3, :3] *= factor
    X_WN[:, :3, 3] = p_WR + change[m : m + 3] + factor * (X_WN[:, :3, 3] - p_WR)
    return X_WN


@pytest.mark.parametrize("which", [0, 1])
def test_image_jacobian_is_the_derivative_of_the_projection(kinematics, which):
    camera = cameras(1)[which]
    rng = np.random.default_rng(4)
    values = rng.uniform(kinematics.lower, kinematics.upper)
    nodes = rng.integers(0, 15, 40)
    p_N = rng.normal(0, 0.1, (40, 3))
    motions = kinematics.motions(values, translation=True, scale=True)
    J = image_jacobian(p_N, nodes, motions, camera)
    for j in range(J.shape[2]):
        step = 1e-6 * np.eye(J.shape[2])[j]
        there, back = (
            camera.project(world_points(p_N, nodes, grown(kinematics, s * step, values)))[0]
            for s in (1, -1)
        )
        assert np.abs((there - back) / 2e-6 - J[:, :, j]).max() < 1e-4


@pytest.mark.parametrize("which", [0, 1])
def test_normal_jacobian_gives_the_derivative_of_the_area(kinematics, which):
    """The silhouette's area grows by the contour's outward speed, summed along it."""
    camera, fine = cameras(1)[which], cameras(8)[which]
    outlines = tuple(outline_from_mesh(node.mesh) for node in kinematics.tree.nodes)
    values = np.random.default_rng(8).uniform(kinematics.lower, kinematics.upper)
    motions = kinematics.motions(values, translation=True)
    points = find_contour_points(outlines, camera.X_CW @ motions.X_WN, camera, spacing=0.1)
    J = normal_jacobian(points, motions, camera)
    gradient = points.lengths @ J
    m = len(values)
    for j in range(3, m, 4):
        step = 0.01 * np.eye(m + 4)[j]
        there, back = (
            draw_mask(outlines, fine.X_CW @ grown(kinematics, s * step, values), fine).sum() / 64
            for s in (1, -1)
        )
        scale = points.lengths @ np.abs(J[:, j])
        assert abs((there - back) / 0.02 - gradient[j]) < 0.02 * scale + 20.0
