"""Parameters of bodies and cameras: against Drake, and motions against finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import RootRotation, load_model
from drake_pose.body.tree_kinematics import TreeKinematics, link_vectors
from drake_pose.camera.models import ParallelCamera, circle_of_cameras
from drake_pose.fit.parameters import CAMERA_NAMES, BodyParameters, CameraParameters
from drake_pose.fit.surfaces import VERY_FEW, simplify_surfaces
from drake_pose.silhouette.outline import TreeSurfaces, outline_from_mesh
from tests.body.models import joint, link, urdf
from tests.fit.motions import STEP, assert_motions_are_derivatives


@pytest.fixture(scope="module")
def body(person):
    tree = person.pose_tree()
    outlines = simplify_surfaces(TreeSurfaces(tree), VERY_FEW)
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


def test_zero_parameters_do_not_change_a_placement(body, theta):
    count = len(body.kinematics.names)
    alone = body.place(theta[:count])
    whole = body.place(np.concatenate([theta[:count], np.zeros(6)]))
    np.testing.assert_allclose(alone.X_WN, whole.X_WN, atol=1e-12)
    np.testing.assert_allclose(alone.motions, whole.motions[:count], atol=1e-12)


def project(X_CW, kernel, p_W):
    """Return (2,) the projection of a point (3,) [pixel]."""
    x, y, z = X_CW[:3, :3] @ p_W + X_CW[:3, 3]
    depth = 1.0 if kernel[0] == 1.0 else z
    return np.array([kernel[1] * x / depth + kernel[3], kernel[2] * y / depth + kernel[4]])


@pytest.mark.parametrize("size", [0.3, 1e-6, 0.0])
def test_cameras_against_finite_differences(size):
    """At 0 they are as given; a rotation is about the pivot, whose place in the picture stays."""
    (pinhole,) = circle_of_cameras(1, face_camera=False).values()
    parallel = ParallelCamera("parallel", 640, 480, 250.0, 320.0, 240.0, pinhole.X_WC)
    rig, pivot = [pinhole, parallel], np.array([0.1, -0.2, 1.0])
    cameras = CameraParameters(rig, pivot)
    theta = size * np.random.default_rng(2).uniform(-1.0, 1.0, len(cameras.names))
    X_CW, kernel, motions = cameras.place(theta)
    for c, camera in enumerate(rig):
        part = theta[9 * c :][:9]
        turn = Rotation.from_rotvec(part[:3]).as_matrix()
        np.testing.assert_allclose(X_CW[c, :3, :3], turn @ camera.X_CW[:3, :3], atol=1e-12)
        before, after = (X[:3, :3] @ pivot + X[:3, 3] for X in (camera.X_CW, X_CW[c]))
        np.testing.assert_allclose(after, before + part[3:6], atol=1e-12)
        expected = camera.kernel_parameters()
        expected[1:3] *= np.exp(part[6])
        expected[3:5] += part[7:]
        np.testing.assert_allclose(kernel[c], expected)
    for index, step in enumerate(STEP * np.eye(len(theta))):
        c, k = divmod(index, len(CAMERA_NAMES))
        above, below = (cameras.place(theta + by) for by in (step, -step))
        for p_W in np.array([[0.3, 0.1, 1.2], [-0.4, 0.2, 0.6]]):
            there, here = (project(X[c], lens[c], p_W) for X, lens, _ in (above, below))
            by = STEP * motions[c, k].reshape(3, 4) @ [*p_W, 1.0]
            on, back = (project(X_CW[c], kernel[c], p_W + move) for move in (by, -by))
            near = pytest.approx((there - here) / STEP, rel=1e-5, abs=2e-3)
            assert (on - back) / STEP == near, cameras.names[index]


# A wrist of two joints with an invisible link between them, a mount welded on before the last
# joint, and a link with two joints.
def box(*size):
    return f'<visual><geometry><box size="{" ".join(map(str, size))}"/></geometry></visual>'


LIMITS = 'lower="-2" upper="2"'
URDF = urdf(
    link("base", box(0.2, 0.3, 0.1)),
    link("upper", box(0.1, 0.1, 0.4)),
    link("gimbal", ""),
    link("wrist", box(0.05, 0.1, 0.2)),
    link("mount", ""),
    link("finger", box(0.02, 0.02, 0.1)),
    link("flag", box(0.02, 0.2, 0.1)),
    joint("turn", "revolute", "base", "upper", limits=LIMITS,
          origin='xyz="0.1 0 0" rpy="0.1 0.2 0.3"'),
    joint("pitch", "revolute", "upper", "gimbal", limits=LIMITS, axis="0 1 0",
          origin='xyz="0.02 0.1 0.3" rpy="0 0.4 0"'),
    joint("yaw", "revolute", "gimbal", "wrist", limits=LIMITS, axis="1 0 1",
          origin='xyz="0.12 0 0"'),
    joint("weld", "fixed", "wrist", "mount", limits=None, origin='xyz="0 0 0.1" rpy="0 0 1"'),
    joint("slide", "prismatic", "mount", "finger", limits='lower="-0.1" upper="0.1"',
          axis="0 1 1", origin='xyz="0 0.05 0"'),
    joint("wave", "revolute", "upper", "flag", limits=LIMITS, axis="1 0 0",
          origin='xyz="0.2 0 0.1"'),
)  # fmt: skip
# For each link with a scale: its joints' origins, and the same scaled by 1.25.
LONGER = {
    "base": {"0.1 0 0": "0.125 0 0"},
    "upper": {"0.02 0.1 0.3": "0.025 0.125 0.375", "0.2 0 0.1": "0.25 0 0.125"},
    "gimbal": {"0.12 0 0": "0.15 0 0"},
}
VALUES = {"turn": 0.4, "pitch": -0.7, "yaw": 0.9, "slide": 0.05, "wave": 0.6}


def kinematics_of(path, text, root):
    path.write_text(text)
    fixed, place = RootRotation.fixed(np.eye(3)), np.array([0.1, -0.2, 0.3])
    model = load_model(path, check=False)
    return TreeKinematics(model.pose_tree(root, root_position=place, root_rotation=fixed))


@pytest.fixture(params=["base", "finger", "flag"])
def scaled(tmp_path, request):
    """The tree traverses joints outwards from the base, inwards from the finger, and both ways."""
    kinematics = kinematics_of(tmp_path / "odd.urdf", URDF, request.param)
    outlines = [outline_from_mesh(node.mesh) for node in kinematics.tree.nodes]
    return BodyParameters(kinematics, outlines, offsets=link_vectors(kinematics.tree))


def parameters(scaled, logs, placed=(0.0, 0.0, 0.0, 0.0)):
    values = [VALUES[name] for name in scaled.kinematics.names]
    return np.array([*values, *placed, *(logs.get(link, 0.0) for link in scaled.links)])


@pytest.mark.parametrize("link", LONGER)
def test_scaled_links_place_nodes_as_drake_does(link, scaled, tmp_path):
    text = URDF
    for origin, longer in LONGER[link].items():
        assert text.count(f'"{origin}"') == 1
        text = text.replace(f'"{origin}"', f'"{longer}"')
    theta = parameters(scaled, {link: np.log(1.25)})
    root = scaled.kinematics.tree.root
    drake = kinematics_of(tmp_path / "longer.urdf", text, root)
    assert drake.names == scaled.kinematics.names
    expected = drake.poses(theta[: len(drake.names)])
    np.testing.assert_allclose(scaled.place(theta).X_WN, expected, atol=1e-12)


def test_link_scales_against_finite_differences(scaled):
    """Also of a body whose root is scaled and translated."""
    logs = {"base": 0.1, "upper": -0.2, "gimbal": 0.3, "mount": -0.1}
    theta = parameters(scaled, logs, (0.1, -0.2, 0.3, 0.15))
    assert_motions_are_derivatives(scaled, theta)
