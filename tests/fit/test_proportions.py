"""Bodies whose parts are longer and wider than their model's."""

import numpy as np
import pytest

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.tree.root import RootRotation
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import ParallelCamera
from drake_pose.fit.contour_fit import Noise
from drake_pose.fit.evidence import find_edge_points
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.proportions import ProportionedBody, SequencePrior, fit_proportions
from drake_pose.silhouette.areas.bending import TreeSurfaces
from drake_pose.silhouette.areas.outline import Outline, outline_from_mesh
from drake_pose.silhouette.areas.scoring import draw_packed

STEP = 1e-6
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


def rigid_points(body, theta, counts):
    """Points of each node's rigid part in the world."""
    placement = body.place(theta)
    starts = placement.packed.starts[:, 0]
    return [
        (X[:3, :3] @ placement.packed.points[:, begin : begin + count] + X[:3, 3:]).T
        for X, begin, count in zip(placement.X_WN, starts, counts, strict=False)
    ]


def test_every_motion_agrees_with_finite_differences(model, body):
    theta = np.random.default_rng(0).normal(0.0, 0.2, len(body.names))
    counts = [len(outline.vertices) for outline in TreeSurfaces(palm_tree(model)).rigid]
    points = rigid_points(body, theta, counts)
    motions = body.place(theta).dense(len(body.names)).reshape(len(counts), -1, 3, 4)
    for k in range(len(theta)):
        step = STEP * np.eye(len(theta))[k]
        ahead, behind = (rigid_points(body, theta + s, counts) for s in (step, -step))
        for node, p_W in enumerate(points):
            slope = (ahead[node] - behind[node]) / (2 * STEP)
            M = motions[node, k]
            np.testing.assert_allclose(p_W @ M[:, :3].T + M[:, 3], slope, atol=1e-8)


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


@pytest.mark.slow
def test_lengths_and_widths_are_found_in_drawn_frames(body):
    """Fingers that bend, from three sides: lengths to a few per cent."""
    generator = np.random.default_rng(3)
    X_WC = np.array(
        [[0.0, 0.0, -1.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.08], [0.0, 0.0, 0.0, 1.0]]
    )
    camera = ParallelCamera("front", 400, 400, 1600.0, 199.5, 199.5, X_WC)
    count = len(body.kinematics.names)
    truth = np.zeros(len(body.names))
    shapes = len(body.length_names) + len(body.width_names)
    truth[count + 4 :][:shapes] = generator.normal(0.0, 0.1, shapes)
    masks, starts = [], []
    for turn in (-0.5, 0.0, 0.5, 1.0):
        theta = truth.copy()
        free = body.kinematics.lower < body.kinematics.upper
        theta[:count] = np.where(free, generator.uniform(0.1, 0.6, count), 0.0)
        # The palm to the camera, turned about the fingers.
        X_WR = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        c, s = np.cos(turn), np.sin(turn)
        R = X_WR @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        rotation = body.kinematics.tree.placements[0].rotation
        theta[:3] = rotation.values_from(R)
        placement = body.place(theta)
        masks.append(draw_packed(placement.packed, camera.X_CW @ placement.X_WN, camera))
        start = theta[: count + 4].copy()
        start[3:count] += generator.normal(0.0, 0.05, count - 3) * free[3:]
        starts.append(np.clip(start, -10, 10))
    edges = [find_edge_points(mask, 2.0) for mask in masks]
    p = int(np.count_nonzero(free)) + 4
    about = np.mean(starts, axis=0)[: count + 4][np.r_[free, np.ones(4, bool)]]
    lower = np.r_[body.kinematics.lower[free], np.full(4, -np.inf)]
    upper = np.r_[body.kinematics.upper[free], np.full(4, np.inf)]
    known = np.repeat([0.3, 0.03, 0.02], [p - 4, 3, 1]) ** -2
    prior = SequencePrior(np.eye(p), about, known, np.full(p, 100.0), lower, upper)
    rounds = [AnnealingStage(scale, 3.0, 8) for scale in (15.0, 6.0, 3.0)]
    noise = Noise(2.0, 12.0)
    found = fit_proportions(body, camera, edges, np.array(starts), rounds, noise, prior)
    before = np.abs(np.log(body.factors(truth)))
    after = np.abs(np.log(body.factors(found.parameters[0]) / body.factors(truth)))
    assert np.median(after) < 0.5 * np.median(before)
    assert np.median(after) < 0.04
