"""Placement of bodies and cameras: against Drake, and motions against finite differences."""

import numpy as np
import pytest

from drake_pose.body import RootRotation, bundled_model, load_model
from drake_pose.body.tree_kinematics import TreeKinematics, link_vectors
from drake_pose.camera.models import ParallelCamera, circle_of_cameras
from drake_pose.fit.contour_fit import Noise
from drake_pose.fit.evidence import NO_EDGE
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import CAMERA_NAMES, BodyParameters, CameraParameters
from drake_pose.fit.proportions import ProportionedBody, fit_proportions, sequence_prior
from drake_pose.fit.surfaces import VERY_FEW, simplify_surfaces
from drake_pose.silhouette.outline import Outline, TreeSurfaces, outline_from_mesh
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
            measured = project(above[0][c], above[1][c], p_W) - project(
                below[0][c], below[1][c], p_W
            )
            by = STEP * motions[c, k].reshape(3, 4) @ [*p_W, 1.0]
            predicted = project(X_CW[c], kernel[c], p_W + by) - project(
                X_CW[c], kernel[c], p_W - by
            )
            np.testing.assert_allclose(
                predicted / STEP,
                measured / STEP,
                rtol=1e-5,
                atol=2e-3,
                err_msg=cameras.names[index],
            )


def test_zero_parameters_do_not_change_cameras():
    rig = list(circle_of_cameras(3).values())
    X_CW, kernel, _ = CameraParameters(rig, np.ones(3)).place(np.zeros(27))
    for c, camera in enumerate(rig):
        np.testing.assert_allclose(X_CW[c], camera.X_CW, atol=1e-12)
        np.testing.assert_allclose(kernel[c], camera.kernel_parameters())


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


def test_links_that_carry_joints_have_scales(scaled):
    assert set(scaled.links) == {"base", "upper", "gimbal", "mount"}


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


def test_link_vector_of_a_joint_behind_a_weld(scaled):
    offset = next(one for one in link_vectors(scaled.kinematics.tree) if one.link == "mount")
    # The slide is 0.1 up the wrist and 0.05 along the y axis of a frame rotated by 1 rad.
    assert np.linalg.norm(offset.p_L) == pytest.approx(np.hypot(0.1, 0.05))
    np.testing.assert_allclose(offset.p_L, [0.0, 0.05, 0.1], atol=1e-12)


def test_link_scales_against_finite_differences(scaled):
    """Also of a body whose root is scaled and translated."""
    logs = {"base": 0.1, "upper": -0.2, "gimbal": 0.3, "mount": -0.1}
    theta = parameters(scaled, logs, (0.1, -0.2, 0.3, 0.15))
    assert_motions_are_derivatives(scaled, theta)


HELD = {"wrist_flexion": 0.0, "wrist_deviation": 0.0}


@pytest.fixture(scope="module")
def hand():
    whole = load_model(bundled_model("hand").with_name("right_hand.urdf"), check=False)
    return whole.without(["forearm"])


def palm_tree(model):
    return model.pose_tree(
        "palm", root_position=np.zeros(3), root_rotation=RootRotation.free(), held=HELD
    )


@pytest.fixture(scope="module")
def stretched(hand):
    tree = palm_tree(hand)
    return ProportionedBody(TreeKinematics(tree), TreeSurfaces(tree))


def test_proportions_against_finite_differences(stretched, person):
    """For a hand with a fixed root, and a person with a moving one."""
    tree = person.pose_tree()
    for body in (stretched, ProportionedBody(TreeKinematics(tree), TreeSurfaces(tree))):
        theta = np.random.default_rng(0).normal(0.0, 0.2, len(body.names))
        assert_motions_are_derivatives(body, theta)


def test_parts_are_stretched_towards_their_children_or_centroid(stretched):
    kinematics = stretched.kinematics
    X_WN = kinematics.poses(kinematics.flatten(kinematics.tree.default_values()))
    for node, axis, X in zip(kinematics.tree.nodes, stretched.axes, X_WN, strict=True):
        ways = (X_WN[list(node.children), :3, 3] - X[:3, 3]) @ X[:3, :3]
        ways = ways if len(ways) else node.mesh.vertices.mean(axis=0)[None]
        assert axis == np.abs(ways).sum(axis=0).argmax()
    count, theta = len(kinematics.names) + 4, np.zeros(len(stretched.names))
    theta[count : count + len(X_WN)] = np.log(2.0)
    long = np.eye(3)[stretched.axes]
    np.testing.assert_allclose(stretched.factors(theta), 1.0 + long)


def test_planes_and_balls_match_the_stretched_surfaces(stretched):
    theta = np.random.default_rng(1).normal(0.0, 0.2, len(stretched.names))
    packed = stretched.place(theta).packed
    for node in range(3):
        (v, t, _), (v_end, t_end, _) = packed.starts[node], packed.starts[node + 1]
        nothing = np.zeros((0, 6), dtype=np.int32)
        own = Outline(packed.points[:, v:v_end].T, packed.triangles[t:t_end], nothing)
        np.testing.assert_allclose(packed.planes[:, t:t_end].T, own.planes, atol=1e-15)
        away = np.linalg.norm(own.vertices - packed.balls[node, :3], axis=1)
        assert away.max() <= packed.balls[node, 3] + 1e-12


def test_a_stretched_model_has_the_poses_of_the_stretched_body(hand, stretched):
    theta = np.random.default_rng(2).normal(0.0, 0.2, len(stretched.names))
    count = len(stretched.kinematics.names)
    theta[count : count + 4] = 0.0
    changed = palm_tree(stretched.applied_to(hand, theta))
    X_WN = TreeKinematics(changed).poses(theta[:count])
    np.testing.assert_allclose(X_WN, stretched.place(theta).X_WN, atol=1e-12)
    packed = stretched.place(theta).packed
    for node, after in enumerate(changed.nodes):
        vertices = outline_from_mesh(after.mesh).vertices
        own = packed.points[:, packed.starts[node, 0] :][:, : len(vertices)].T
        order, own_order = np.lexsort(vertices.round(9).T), np.lexsort(own.round(9).T)
        np.testing.assert_allclose(vertices[order], own[own_order], atol=1e-8)


def test_sequence_prior_penalises_unusual_values_and_accelerations():
    usual = np.array([[1.0, 2.0]]), np.array([0.5]), np.array([4.0])
    coupling = sequence_prior(5, usual, np.array([0.1, 0.2]))
    x = np.random.default_rng(1).normal(size=(5, 2))
    predicted = ((coupling.rows @ x.ravel() - coupling.mean) ** 2 * coupling.information).sum()
    deviations = 4.0 * ((x @ [1.0, 2.0] - 0.5) ** 2).sum()
    faster = (np.diff(x, 2, axis=0) / [0.1, 0.2]) ** 2
    assert predicted == pytest.approx(deviations + faster.sum())


def test_without_evidence_proportions_follow_the_prior(stretched):
    """Without evidence the result and its deviations are those of the prior."""
    camera, kinematics = (
        ParallelCamera("top", 60, 50, 100.0, 30.0, 25.0, np.eye(4)),
        stretched.kinematics,
    )
    free = np.count_nonzero(kinematics.lower < kinematics.upper) + 4
    usual = np.eye(free), np.full(free, 0.1), np.full(free, 4.0)
    limits = np.full(free, -np.inf), np.full(free, np.inf)
    starts = np.zeros((3, len(kinematics.names) + 4))
    rounds, prior = [AnnealingStage(1.0, 1.0, 30)], sequence_prior(3, usual, np.full(free, 1e3))
    found, deviations = fit_proportions(
        stretched, camera, [NO_EDGE] * 3, starts, rounds, Noise(1.0, 1.0), limits, prior
    )
    np.testing.assert_allclose(found.own, 0.1, atol=1e-3)
    np.testing.assert_allclose(deviations[:, deviations.any(axis=0)], 0.5, rtol=1e-3)
    counts = [
        len(names)
        for names in (stretched.length_names, stretched.width_names, stretched.joint_shift_names)
    ]
    known = np.repeat([0.15**-2, 0.1**-2, 0.15**-2], counts)
    np.testing.assert_allclose(np.diag(found.equations.H[0, free:, free:]), known)
    limbs = {f"joint_shift_{kinematics.tree.nodes[i].name}" for i in stretched.movable}
    assert limbs == set(stretched.joint_shift_names)
    assert len(limbs) == 5
