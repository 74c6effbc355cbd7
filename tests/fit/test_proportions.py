"""Proportions of a body: motions against finite differences, poses against Drake's."""

import numpy as np
import pytest

from drake_pose.body import RootRotation, bundled_model, load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import ModelError
from drake_pose.fit.contour_fit import Noise
from drake_pose.fit.evidence import NO_EDGE
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.proportions import ProportionedBody, fit_proportions, sequence_prior
from drake_pose.silhouette.outline import Outline, TreeSurfaces, outline_from_mesh
from tests.body.models import joint, link, urdf, write
from tests.fit.motions import assert_motions_are_derivatives

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
    for node in range(len(packed.balls)):
        (v, t, _), (v_end, t_end, _) = packed.starts[node], packed.starts[node + 1]
        nothing = np.zeros((0, 6), dtype=np.int32)
        own = Outline(packed.points[:, v:v_end].T, packed.triangles[t:t_end], nothing)
        np.testing.assert_allclose(packed.planes[:, t:t_end].T, own.planes, atol=1e-15)
        away = np.linalg.norm(own.vertices - packed.balls[node, :3], axis=1, keepdims=True)
        assert away.max(initial=0.0) <= packed.balls[node, 3] + 1e-12


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
    camera = ParallelCamera("top", 60, 50, 100.0, 30.0, 25.0, np.eye(4))
    kinematics = stretched.kinematics
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
    names = stretched.length_names, stretched.width_names, stretched.joint_shift_names
    counts = [*map(len, names)]
    known = np.repeat([0.15**-2, 0.1**-2, 0.15**-2], counts)
    np.testing.assert_allclose(np.diag(found.equations.H[0, free:, free:]), known)
    limbs = {f"joint_shift_{kinematics.tree.nodes[i].name}" for i in stretched.movable}
    assert limbs == set(stretched.joint_shift_names)
    assert len(limbs) == 5


def test_bodies_with_mimic_joints_are_refused(tmp_path):
    bar = '<visual><geometry><box size="0.1 0.1 0.4"/></geometry></visual>'
    text = urdf(
        link("base", bar), link("a", bar), link("b", bar), joint("lead", "revolute", "base", "a"),
        joint("follow", "revolute", "a", "b"),
    )  # fmt: skip
    end = text.rindex("</joint>")
    path = write(tmp_path, f'{text[:end]}<mimic joint="lead"/>{text[end:]}')
    tree = load_model(path, check=False).pose_tree()
    with pytest.raises(ModelError, match="mimic 'lead'"):
        ProportionedBody(TreeKinematics(tree), TreeSurfaces(tree))
