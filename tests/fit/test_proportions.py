"""Bodies whose parts are longer and wider than their model's."""

import numpy as np
import pytest

from drake_pose.body import RootRotation, bundled_model, load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.fit.proportions import ProportionedBody, sequence_prior
from drake_pose.silhouette.areas.bending import TreeSurfaces
from drake_pose.silhouette.areas.outline import Outline, outline_from_mesh
from tests.fit.motions import assert_motions_are_derivatives

HELD = {"wrist_flexion": 0.0, "wrist_deviation": 0.0}


@pytest.fixture(scope="module")
def model():
    whole = load_model(bundled_model("hand").with_name("right_hand.urdf"), check=False)
    return whole.without(["forearm"])


def palm_tree(model):
    return model.pose_tree(
        "palm", root_position=np.zeros(3), root_rotation=RootRotation.free(), held=HELD
    )


@pytest.fixture(scope="module")
def body(model):
    tree = palm_tree(model)
    return ProportionedBody(TreeKinematics(tree), TreeSurfaces(tree))


def test_every_motion_agrees_with_finite_differences(body):
    theta = np.random.default_rng(0).normal(0.0, 0.2, len(body.names))
    assert_motions_are_derivatives(body, theta)


def test_planes_are_those_of_the_stretched_surfaces(body):
    theta = np.random.default_rng(1).normal(0.0, 0.2, len(body.names))
    packed = body.place(theta).packed
    for node in range(3):
        (v, t, _), (v_end, t_end, _) = packed.starts[node], packed.starts[node + 1]
        nothing = np.zeros((0, 6), dtype=np.int32)
        own = Outline(packed.points[:, v:v_end].T, packed.triangles[t:t_end], nothing)
        np.testing.assert_allclose(packed.planes[:, t:t_end].T, own.planes, atol=1e-15)


def test_a_stretched_model_stands_where_the_stretched_body_does(model, body):
    theta = np.random.default_rng(2).normal(0.0, 0.2, len(body.names))
    count = len(body.kinematics.names)
    theta[count : count + 4] = 0.0
    stretched = palm_tree(body.applied_to(model, theta))
    X_WN = TreeKinematics(stretched).poses(theta[:count])
    np.testing.assert_allclose(X_WN, body.place(theta).X_WN, atol=1e-12)
    packed = body.place(theta).packed
    for node, after in enumerate(stretched.nodes):
        vertices = outline_from_mesh(after.mesh).vertices
        own = packed.points[:, packed.starts[node, 0] :][:, : len(vertices)].T
        order, own_order = np.lexsort(vertices.round(9).T), np.lexsort(own.round(9).T)
        np.testing.assert_allclose(vertices[order], own[own_order], atol=1e-8)


def test_a_sequence_is_as_usual_and_moves_on_as_it_did():
    usual = np.array([[1.0, 2.0]]), np.array([0.5]), np.array([4.0])
    coupling = sequence_prior(5, usual, np.array([0.1, 0.2]))
    x = np.random.default_rng(1).normal(size=(5, 2))
    told = ((coupling.rows @ x.ravel() - coupling.mean) ** 2 * coupling.information).sum()
    off = 4.0 * ((x @ [1.0, 2.0] - 0.5) ** 2).sum()
    faster = (np.diff(x, 2, axis=0) / [0.1, 0.2]) ** 2
    assert told == pytest.approx(off + faster.sum())
