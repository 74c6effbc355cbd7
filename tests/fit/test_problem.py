"""Unknowns of every kind recovered from drawn silhouettes, and their normal equations."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.sparse import csr_array

from drake_pose.body import TriangleMesh
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import ParallelCamera, PinholeCamera, circle_of_cameras
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.fit.background import foreground_picture
from drake_pose.fit.contour_fit import symmetric
from drake_pose.fit.evidence import NO_EDGE, Observation, find_edge_points, pack_evidence
from drake_pose.fit.levenberg_marquardt import AnnealingStage, Equations, LinearPrior
from drake_pose.fit.parameters import BodyParameters, CameraParameters
from drake_pose.fit.problem import BOUNDARY_BIAS, Problem, Solution, Unknowns, parameter_names
from drake_pose.fit.surfaces import VERY_FEW, simplify_surfaces
from drake_pose.silhouette.outline import TreeSurfaces, outline_from_mesh
from drake_pose.silhouette.scoring import draw_mask

STAGES = [AnnealingStage(*one) for one in ((0.08, 0.04, 3), (0.04, 0.03, 3), (0.01, 0.02, 8))]
BENT = ("left_forearm_x", "right_forearm_x", "left_shin_x", "right_shin_x")


@pytest.fixture(scope="module")
def body(person):
    tree = person.pose_tree()
    groups = np.arange(len(tree.nodes)) % 2
    outlines = simplify_surfaces(TreeSurfaces(tree), VERY_FEW)
    return BodyParameters(TreeKinematics(tree), outlines, groups, ("even", "odd"))


@pytest.fixture(scope="module")
def rig():
    return list(circle_of_cameras(4, face_camera=False, size=(480, 360)).values())


def parallel(pinhole, scale=150.0):
    return ParallelCamera("parallel", 480, 360, scale, 239.5, 179.5, pinhole.X_WC)


def poses(body, count, seed):
    """Return (count, n) parameters of different poses of the body."""
    generator = np.random.default_rng(seed)
    kinematics = body.kinematics
    lower, upper = np.maximum(kinematics.lower, -1.0), np.minimum(kinematics.upper, 1.0)
    theta = np.zeros((count, len(body.names)))
    values = kinematics.flatten(kinematics.tree.default_values())
    for row in theta:
        row[: len(values)] = np.clip(
            values + 0.25 * (upper - lower) * generator.uniform(-1, 1, len(values)), lower, upper
        )
        for name, place in (("position_x", 0.0), ("position_y", 0.0), ("position_z", 1.0)):
            row[list(body.names).index(name)] = place
    return theta


def few_outlines(body, theta):
    """Return the surfaces of a body at its parameters, in its nodes' frames."""
    packed = body.place(theta).packed
    parts = np.split(packed.points.T, packed.starts[1:-1, 0])
    pairs = zip(parts, body.outlines, strict=True)
    return [outline_from_mesh(TriangleMesh(part, one.triangles)) for part, one in pairs]


def draw(body, cameras, theta, camera_theta=None):
    """Return the edges of a body's silhouettes, drawn by the span kernel and not by the fit."""
    placement, outlines = body.place(theta), few_outlines(body, theta)
    parameters = np.zeros(9 * len(cameras)) if camera_theta is None else camera_theta
    X_CW, kernel, _ = CameraParameters(cameras, root_of(body)).place(parameters)
    edges = []
    for camera, X, (_, fx, fy, *_) in zip(cameras, X_CW, kernel.tolist(), strict=True):
        is_pinhole = isinstance(camera, PinholeCamera)
        lens = {"focal_x": fx, "focal_y": fy} if is_pinhole else {"pixels_per_metre": fx}
        moved = replace(camera, X_WC=np.linalg.inv(X), **lens)
        edges.append(find_edge_points(draw_mask(outlines, X @ placement.X_WN, moved), 2.0))
    return pack_evidence(edges)


def root_of(body):
    kinematics = body.kinematics
    return kinematics.poses(kinematics.flatten(kinematics.tree.default_values()))[0, :3, 3]


def test_shared_joint_offsets_are_recovered(body, rig):
    truth = poses(body, 4, 4)
    offsets = np.array([0.08, -0.1, 0.07, 0.05])
    readings = truth.copy()
    readings[:, [list(body.names).index(name) for name in BENT]] -= offsets
    problem = Problem(body, rig, [Unknowns(BENT, shared=True)])
    pairs = zip(truth, readings, strict=True)
    seen = [Observation(draw(body, rig, theta), row) for theta, row in pairs]
    np.testing.assert_allclose(problem.solve(seen, STAGES).shared, offsets, atol=0.012)


def test_log_odds_images_are_fitted_like_masks(body, rig):
    """A dilated foreground is reported as a boundary bias."""
    truth = poses(body, 1, 4)[0]
    camera, outlines = rig[0], few_outlines(body, truth)
    mask = draw_mask(outlines, camera.X_CW @ body.place(truth).X_WN, camera)
    names = [f"{camera.name}.{name}" for name in ("shift_x", "shift_y", BOUNDARY_BIAS)]
    off, nothing = np.array([0.02, -0.015, 0.0]), np.zeros((1, 0))
    stages = [AnnealingStage(scale, 0.02, 4) for scale in (0.03, 0.01, 0.005)]
    for grown in (0, 2):
        wide = cv2.dilate(mask.view(np.uint8), np.ones((2 * grown + 1,) * 2, np.uint8))
        foreground = foreground_picture(np.where(wide > 0, 5.0, -5.0).astype(np.float32))
        seen = [Observation(pack_evidence([NO_EDGE]), truth, (foreground,))]
        problem = Problem(body, [camera], [Unknowns(names, shared=True)])
        found = problem.solve(seen, stages, (nothing, off)).shared
        np.testing.assert_allclose(found[:2], 0.0, atol=0.004)
        assert found[2] == pytest.approx(grown, abs=0.5)


def test_unknowns_are_added_to_known_values(body, rig):
    """Including two unknowns added to one parameter: a frame's own angle and a joint offset."""
    own = Unknowns(BENT[:2])
    problem = Problem(body, rig, [Unknowns(BENT[1:3], shared=True), own])
    assert problem.names == (*BENT[:2], *BENT[1:3])
    values = np.random.default_rng(0).normal(size=(2, 5))
    seen = [Observation(pack_evidence([NO_EDGE] * len(rig)), row) for row in values]
    theta = problem.parameters(seen, np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([10.0, 20.0]))
    expected = np.zeros((2, len(parameter_names(body, rig))))
    expected[:, :5] = values
    at = [body.names.index(name) for name in BENT[:3]]
    expected[:, at] += [[1.0, 12.0, 20.0], [3.0, 14.0, 20.0]]
    np.testing.assert_allclose(theta, expected)


def test_equations_are_the_gradient_of_the_cost(body, rig):
    """For all parameters at once, where all points have matches."""
    cameras = [rig[1], parallel(rig[0])]
    truth = poses(body, 1, 7)
    names = parameter_names(body, cameras)
    problem = Problem(body, cameras, [Unknowns(names)])
    generator, none = np.random.default_rng(0), np.zeros(0)
    rates = generator.uniform(-1.0, 1.0, len(body.kinematics.names))
    base = np.pad(truth[0], (0, len(names) - truth.shape[1]))
    base += 0.015 * generator.uniform(-1, 1, base.shape)
    seen = [Observation(draw(body, cameras, truth[0]), base, rates=rates)]

    def equations(own):
        return problem.equations(seen, (own[None], none), AnnealingStage(0.1, 0.002))

    steps = 2e-3 * np.eye(len(names))
    slopes = np.array([equations(d).cost - equations(-d).cost for d in steps]) / (2 * 2e-3)
    expected = 2.0 * equations(np.zeros(len(names))).g[0]
    # Matches change along the way, so only the whole gradients agree.
    several = slice(-len(cameras)), slice(-len(cameras), None)
    for some in several:
        lengths = np.linalg.norm((slopes[some], expected[some]), axis=1)
        cosine = slopes[some] @ expected[some] / np.prod(lengths)
        assert cosine > 0.93
        assert lengths[0] == pytest.approx(lengths[1], rel=0.2)


@pytest.mark.parametrize(
    "some",
    [
        "turn_x center_y",
        "log_focal",
        "boundary_bias",
        "left_shin_x boundary_bias",
        "root_shift_x",
        "log_radius_scale_odd",
    ],
)
def test_equations_of_some_unknowns_are_a_block_of_those_of_all(body, rig, some):
    """For two frames and two cameras, with and without unknowns of the body."""
    cameras = rig[:2]
    every = parameter_names(body, cameras)
    names = [name for name in every if name.split(".")[-1] in some.split()]
    truth = poses(body, 2, 11)
    count = len(body.kinematics.names)
    seen = [Observation(draw(body, cameras, theta), theta[:count] + 0.01) for theta in truth]
    none, step = np.zeros((2, 0)), AnnealingStage(0.1, 0.02)
    part, full = (
        Problem(body, cameras, [Unknowns(chosen, shared=True)]).equations(
            seen, (none, np.zeros(len(chosen))), step
        )
        for chosen in (names, every)
    )
    at = [every.index(name) for name in names]
    assert np.abs(part.g).min() > 0.0
    np.testing.assert_allclose(part.g, full.g[:, at], rtol=1e-9, atol=1e-9 * np.abs(part.g).max())
    np.testing.assert_allclose(part.H, full.H[:, at][:, :, at], rtol=1e-9)
    assert part.cost == pytest.approx(full.cost)


def test_compared_masks_have_the_information_of_the_equations(body, rig):
    """Own unknowns of all frames, frame by frame, then the shared ones, without biases."""
    cameras = rig[:2]
    shared = ["log_radius_scale_odd", f"{rig[1].name}.turn_x", f"{rig[0].name}.{BOUNDARY_BIAS}"]
    problem = Problem(body, cameras, [Unknowns(BENT[:2]), Unknowns(shared, shared=True)])
    truth, count = poses(body, 2, 11), len(body.kinematics.names)
    seen = [Observation(draw(body, cameras, theta), theta[:count] + 0.01) for theta in truth]
    own, nothing, step = np.zeros((2, 2)), np.zeros(3), AnnealingStage(0.1, 0.02)
    equations = problem.equations(seen, (own, nothing), step)
    masks = problem.compared_masks(seen, problem.parameters(seen, own, nothing), step)
    assert [one.camera for one in masks] == [0, 1, 0, 1]
    H, g = np.zeros((6, 6)), np.zeros(6)
    for k in range(2):
        at = [2 * k, 2 * k + 1, 4, 5]
        H[np.ix_(at, at)] += equations.H[k][:4, :4]
        g[at] += equations.g[k][:4]
    found = sum(np.einsum("nmi,nij,nkj->mk", m.moves, symmetric(m.A), m.moves) for m in masks)
    np.testing.assert_allclose(found, H, rtol=1e-9, atol=1e-9 * np.abs(H).max())
    pulled = sum(np.einsum("nmi,ni->m", one.moves, one.b) for one in masks)
    np.testing.assert_allclose(pulled, -g, rtol=1e-9, atol=1e-9 * np.abs(g).max())
    for one, camera in zip(masks, (*cameras, *cameras), strict=True):
        # A pixel at the body's distance.
        depth = (camera.X_CW[:3, :3] @ one.X_WN[:, :3, 3].mean(axis=0) + camera.X_CW[:3, 3])[2]
        assert one.size == pytest.approx(depth / camera.focal_x, rel=1e-6)
        np.testing.assert_allclose(one.X_CW, camera.X_CW, atol=1e-12)


def test_priors_count_once(body, rig):
    """The prior of own unknowns counts in each frame, that of shared ones once in all."""
    names, radius_scales = BENT[:2], body.names[-2:]
    known, free = (
        Problem(
            body, rig, [Unknowns(names, deviation=a), Unknowns(radius_scales, True, deviation=b)]
        )
        for a, b in ((0.5, 0.25), (np.inf, np.inf))
    )
    held = poses(body, 3, 8)
    seen = [Observation(pack_evidence([NO_EDGE] * len(rig)), row) for row in held]
    own, shared = np.arange(6.0).reshape(3, 2), np.array([1.0, -2.0])
    about = np.ones((3, 2)), np.zeros(2)
    at = seen, (own, shared), STAGES[0], about
    with_it, without = (one.equations(*at) for one in (known, free))
    off, own_information, information = own - about[0], np.full(2, 4.0), np.full(2, 16.0)
    H, g = np.zeros((3, 4, 4)), np.zeros((3, 4))
    H[:, :2, :2], g[:, :2] = np.diag(own_information), own_information * off
    H[0, 2:, 2:], g[0, 2:] = np.diag(information), information * shared
    np.testing.assert_allclose(with_it.H - without.H, H, atol=1e-12)
    np.testing.assert_allclose(with_it.g - without.g, g, atol=1e-12)
    cost = (own_information * off**2).sum() + information @ shared**2
    assert with_it.cost - without.cost == pytest.approx(cost)


def test_unknown_names_and_wrong_shapes_are_refused(body, rig):
    with pytest.raises(UnknownNameError, match="no_such"):
        Problem(body, rig, [Unknowns(["no_such"])])
    seen = [Observation(draw(body, rig, poses(body, 1, 1)[0]))]
    with pytest.raises(SettingsError, match="1 frames with 4 own and 0 shared"):
        Problem(body, rig, [Unknowns(BENT)]).solve(seen, STAGES, (np.zeros((1, 3)), np.zeros(0)))


@pytest.mark.parametrize("couples", [False, True])
def test_own_deviations_match_the_full_system(couples):
    generator = np.random.default_rng(4)
    frames, p, q = 4, 3, 2
    J = generator.normal(size=(frames, 9, p + q))
    H = np.einsum("fij,fik->fjk", J, J)
    rows, information = generator.normal(size=(5, frames * p)), generator.uniform(1.0, 9.0, 5)
    coupling = LinearPrior(csr_array(rows), np.zeros(5), information) if couples else None
    equations = Equations(H, np.zeros((frames, p + q)), 0.0)
    nothing = np.zeros((frames, p))
    fitted = Solution(nothing, np.zeros(q), nothing, 0.0, lambda: (equations, nothing), coupling)
    full = np.zeros((frames * p + q, frames * p + q))
    for k in range(frames):
        at = np.r_[k * p : (k + 1) * p, frames * p : frames * p + q]
        full[np.ix_(at, at)] += H[k]
    if couples:
        full[: frames * p, : frames * p] += rows.T @ np.diag(information) @ rows
    expected = np.sqrt(np.diag(np.linalg.inv(full))[: frames * p]).reshape(frames, p)
    np.testing.assert_allclose(fitted.own_deviations(), expected, rtol=1e-3)
