"""The derivative of the sub-pixel difference by a body's values, and its agreement with pixels."""

import numpy as np
import pytest

from drake_pose.body import bundled_model, load_model
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera import ParallelCamera, PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.matching.fit.pose_jacobian import normal_jacobian
from drake_pose.silhouette import draw_mask, outline_from_mesh
from drake_pose.silhouette.contours.sub_pixel import sub_pixel_difference

_X_WC = np.array(
    [[0.0, 0.0, -1.0, 5.0], [1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, -0.5], [0.0, 0.0, 0.0, 1.0]]
)


def camera_of(kind, fineness=1):
    size, centre, scale = 160 * fineness, 80.0 * fineness - 0.5, 55.0 * fineness
    if kind == "parallel":
        return ParallelCamera("c", size, size, scale, centre, centre, _X_WC)
    return PinholeCamera("c", size, size, 5 * scale, 5.2 * scale, centre, centre, _X_WC)


@pytest.fixture(scope="module")
def woman():
    tree = load_model(bundled_model("woman")).pose_tree(root_position=np.zeros(3))
    return TreeKinematics(tree), tuple(outline_from_mesh(node.mesh) for node in tree.nodes)


@pytest.mark.parametrize("kind", ["parallel", "pinhole"])
def test_the_difference_is_that_of_fine_pixels(woman, kind):
    """A picture 8 times finer, in which each pixel of the mask is 8 x 8 pixels."""
    kinematics, outlines = woman
    camera, fine = camera_of(kind), camera_of(kind, 8)
    rng = np.random.default_rng(2)
    for _ in range(3):
        true, other = rng.uniform(kinematics.lower, kinematics.upper, (2, len(kinematics.names)))
        mask = draw_mask(outlines, camera.X_CW @ kinematics.poses(true), camera)
        X_CN = camera.X_CW @ kinematics.poses(other)
        body = draw_mask(outlines, X_CN, fine)
        expected = (body != np.kron(mask, np.ones((8, 8), dtype=bool))).sum() / 64.0
        found = sub_pixel_difference(outlines, X_CN, camera, mask, lines=8).J
        # The finer picture counts whole fine pixels.
        assert abs(found - expected) < 0.01 * expected


def test_a_body_that_leaves_the_picture(woman):
    kinematics, outlines = woman
    values = np.clip(0.0, kinematics.lower, kinematics.upper)
    X_WC = _X_WC.copy()
    for shift, scale in ((1.0, 55.0), (-0.9, 55.0), (0.1, 2000.0)):
        X_WC[1, 3] = shift
        camera = ParallelCamera("c", 160, 160, scale, 79.5, 79.5, X_WC)
        X_CN = camera.X_CW @ kinematics.poses(values)
        mask = np.zeros((160, 160), dtype=bool)
        mask[10:90, 30:140] = True
        drawn = draw_mask(outlines, X_CN, camera)
        found = sub_pixel_difference(outlines, X_CN, camera, mask).J
        assert abs(found - (drawn != mask).sum()) < 0.02 * (drawn | mask).sum()


@pytest.mark.parametrize("kind", ["parallel", "pinhole"])
def test_the_slopes_are_its_derivative(woman, kind):
    kinematics, outlines = woman
    camera = camera_of(kind)
    rng = np.random.default_rng(7)
    true, values = rng.uniform(kinematics.lower, kinematics.upper, (2, len(kinematics.names)))
    mask = draw_mask(outlines, camera.X_CW @ kinematics.poses(true), camera)

    def difference(values):
        return sub_pixel_difference(outlines, camera.X_CW @ kinematics.poses(values), camera, mask)

    found = difference(values)
    motions = kinematics.motions(values)
    J = normal_jacobian(found.points, motions, camera)
    gradient = found.slopes @ J
    step = 1e-5
    for j in np.flatnonzero(kinematics.upper > kinematics.lower):
        shift = step * np.eye(len(values))[j]
        expected = (difference(values + shift).J - difference(values - shift).J) / (2 * step)
        # A few lines have a contour that touches another or a pixel's side within the step.
        assert abs(gradient[j] - expected) < 0.02 * np.abs(found.slopes * J[:, j]).sum() + 1e-6


def test_bad_lines_are_refused(woman):
    kinematics, outlines = woman
    camera = camera_of("parallel")
    X_CN = camera.X_CW @ kinematics.poses(kinematics.lower)
    with pytest.raises(SettingsError, match="lines"):
        sub_pixel_difference(outlines, X_CN, camera, np.zeros((160, 160), dtype=bool), lines=0)
