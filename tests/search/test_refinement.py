"""Compare refinement by pixels with drawn bodies and with small changes of the pose."""

import math

import numpy as np
import pytest

from drake_pose.body import bundled_model, load_model
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.search import View
from drake_pose.search.exact_search import find_intervals
from drake_pose.search.parts import NeighbourhoodSearch, PartSearch, find_parts, find_reflections
from drake_pose.search.refinement import (
    COARSE_PASSES,
    FINE_PASSES,
    LAST_PASSES,
    Pass,
    RefinementBody,
    RefinementProblem,
    descend,
)
from drake_pose.silhouette.outline import TreeSurfaces
from drake_pose.silhouette.scoring import draw_mask

_X_WC = np.array(
    [[0.0, 0.0, -1.0, 5.0], [1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, -0.35], [0.0, 0.0, 0.0, 1.0]]
)

_TURN = np.array([[0.0, -1.0, 0, 0], [1.0, 0.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])


def camera_of(kind, turned=False):
    X_WC = _TURN @ _X_WC if turned else _X_WC
    if kind == "parallel":
        return ParallelCamera("c", 400, 400, 130.0, 199.5, 199.5, X_WC)
    return PinholeCamera("c", 400, 400, 650.0, 660.0, 199.5, 199.5, X_WC)


@pytest.fixture(scope="module")
def body():
    tree = load_model(bundled_model("woman"), check=False).pose_tree(root_position=np.zeros(3))
    return RefinementBody(tree)


@pytest.fixture(scope="module")
def search(body):
    nodes = range(len(body.tree.nodes))
    return PartSearch(body, [body.tree.grid(i, math.radians(20.0)) for i in nodes])


def drawn(body, parameters, camera):
    """Return the silhouette (H, W), drawn by the span kernel."""
    outlines = TreeSurfaces(body.tree).at(body.node_values(parameters))
    return draw_mask(outlines, camera.X_CW @ body.poses(parameters), camera)


def random_pose(body, seed, fraction=0.8):
    """Draw a pose in the middle fraction of the limits, with the root at its position."""
    rng = np.random.default_rng(seed)
    lower, upper = body.lower[:-4], body.upper[:-4]
    middle, half = 0.5 * (upper + lower), 0.5 * fraction * (upper - lower)
    return np.append(middle + half * rng.uniform(-1.0, 1.0, len(middle)), np.zeros(4))


def problem_of(body, pose, cameras):
    views = [View(camera, drawn(body, pose, camera)) for camera in cameras]
    return RefinementProblem(body, views)


@pytest.mark.parametrize("kind", ["parallel", "pinhole"])
def test_J_equals_the_area_of_the_drawn_difference(body, kind):
    """Skin, shift and log scale are included, and earlier poses have no effect."""
    camera = camera_of(kind)
    problem = problem_of(body, random_pose(body, 1), [camera])
    for seed in (2, 3):
        pose = random_pose(body, seed)
        pose[-4:] = 0.02, -0.03, 0.05, 0.1
        expected = np.count_nonzero(drawn(body, pose, camera) != problem.views[0].mask)
        assert problem.J(pose) == expected
    assert problem.J(random_pose(body, 1)) == 0


@pytest.mark.parametrize("kind", ["parallel", "pinhole"])
def test_one_step_reverts_a_small_change(body, kind):
    """The normal equations give the change of each value, so their derivatives are right."""
    true = random_pose(body, 5)
    problem = problem_of(body, true, [camera_of(kind), camera_of(kind, turned=True)])
    freedom, step, off = body.freedom(None, (0, 1, 2, 3)), 0.02, []
    for one, j in enumerate(freedom.columns):
        moved = true.copy()
        moved[j] += step
        equations, _ = problem.equations(moved, freedom, Pass(1, 1, 3.0, 1.0), 0)
        off.append(abs(equations.g[0, one] / equations.H[0, one, one] / step - 1.0))
    # Pixels, and parts that the change covers and uncovers, cause errors.
    assert np.median(off) < 0.1
    assert np.quantile(off, 0.85) < 0.35


def test_a_refined_pose_is_a_local_optimum_within_the_limits(body):
    cameras = [camera_of("parallel"), camera_of("parallel", turned=True)]
    for seed in (7, 8):
        true = random_pose(body, seed, fraction=1.0)
        # Some values are at their limits.
        true[10:14] = body.upper[10:14]
        problem = problem_of(body, true, cameras)
        start = true + 0.06 * np.random.default_rng(seed).normal(size=len(true))
        start = np.clip(start, body.lower, body.upper)
        start[-4:] = 0.0
        freedom = body.freedom()
        refined, _, steps = descend(problem, start, freedom, COARSE_PASSES + FINE_PASSES)
        assert steps > 0
        assert np.all(refined >= body.lower)
        assert np.all(refined <= body.upper)
        assert problem.J(refined) < 0.05 * problem.J(start)
        assert np.median(np.degrees(np.abs(refined - true))[freedom.columns]) < 0.5

        least = problem.J(refined)
        for j in freedom.columns[::4]:
            for sign in (-1.0, 1.0):
                moved = refined.copy()
                moved[j] = np.clip(moved[j] + sign * 0.02, body.lower[j], body.upper[j])
                assert problem.J(moved) >= 0.9 * least


def centers(body, parameters, part):
    """Return the centres (k, 3) of a part's nodes [m]."""
    X_WN = body.poses(parameters)[list(part.nodes)]
    p_N = np.array([body.surfaces.rigid[node].ball[:3] for node in part.nodes])
    return np.einsum("kij,kj->ki", X_WN[:, :3, :3], p_N) + X_WN[:, :3, 3]


def test_a_mirrored_part_has_nearly_mirrored_centers(body, search):
    camera = camera_of("parallel")
    true = random_pose(body, 4, fraction=0.5)
    problem = problem_of(body, true, [camera])
    parts = [part for part in find_parts(body.tree) if len(part.nodes) == 2]
    depth, ratios = _X_WC[:3, 2], []
    for part in parts:
        mirrored = search.mirror(true, part, problem.views[0])
        assert np.all(mirrored >= body.lower)
        assert np.all(mirrored <= body.upper)
        joint = body.poses(true)[part.nodes[0], :3, 3]
        before, after = centers(body, true, part), centers(body, mirrored, part)
        wanted = before - 2.0 * np.outer((before - joint) @ depth, depth)
        ratios.append(np.linalg.norm(after - wanted) / np.linalg.norm(before - wanted))
    # Joint limits prevent some parts from being mirrored.
    assert max(ratios) < 1.0
    assert np.median(ratios) < 0.4


def test_mirrored_halves_seen_from_the_side_have_the_same_silhouette(body, search):
    """The mirror image of a symmetric body is the body with left and right exchanged."""
    camera, parts = camera_of("parallel", turned=True), find_reflections(body.tree)
    names = [node.name for node in body.tree.nodes]
    (whole,) = [part for part in parts if len(part.nodes) == len(names)]
    for node, source in zip(whole.nodes, whole.sources, strict=True):
        side, _, rest = names[node].partition("_")
        other = {"left": "right", "right": "left"}.get(side, side)
        assert names[source] == "_".join([other, rest]).strip("_")
    for part in parts:
        ratios = []
        for seed in range(6, 13):
            true = random_pose(body, seed, fraction=0.3)
            problem = problem_of(body, true, [camera])
            mirrored = search.mirror(true, part, problem.views[0])
            assert np.abs(mirrored - true).max() > 0.1
            ratios.append(problem.J(mirrored) / problem.area)
        assert np.median(ratios) < 0.003


def test_intervals_of_exact_masks_contain_the_true_values(body, search):
    cameras = [camera_of("parallel"), camera_of("parallel", turned=True)]
    held, claimed = 0, 0
    for seed in (21, 22, 23):
        true = random_pose(body, seed)
        problem = problem_of(body, true, cameras)
        refined, _, _ = descend(problem, true, body.freedom(), FINE_PASSES + LAST_PASSES)
        neighbourhood = NeighbourhoodSearch(problem, search)
        neighbourhood.improve(refined, 0.0, everywhere=True)
        others = neighbourhood.others(refined, 2.0 * problem.J(refined) + 40.0, 0.1)
        others = [pose for pose in others if problem.J(pose) <= problem.J(refined) + 20.0]
        intervals = find_intervals(problem, others, refined, body.tree)
        assert len(intervals.joints) == len(true) - 4
        first = np.concatenate(intervals.modes[0].node_values)
        np.testing.assert_allclose(first, refined[:-4], atol=1e-12)
        for mode in intervals.modes:
            assert mode.J <= problem.J(refined) + intervals.tolerance
        for j, joint in enumerate(intervals.joints):
            if joint.determined and body.upper[j] > body.lower[j]:
                claimed += 1
                held += joint.holds(true[j])
    assert claimed > 60
    assert held / claimed > 0.9
