"""Covariances with correlated errors: known answers, and simulated arms."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drake_pose.body import TriangleMesh
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.fit.contour_fit import Comparison, symmetric
from drake_pose.fit.covariance import (
    ComparedMask,
    Distances,
    ErrorSizes,
    distances_covariance,
    distances_in_masks,
    error_unit,
    estimate_sizes,
    nuisance_covariance,
    round_parts,
    score_nuisances,
    surface_deformations,
    values_covariance,
    vuong_statistic,
    without_rotations,
)
from drake_pose.fit.parameters import affine_motions
from drake_pose.fit.surfaces import simplify_surfaces
from drake_pose.silhouette.outline import (
    EMPTY_OUTLINE,
    Outline,
    TreeSurfaces,
    outline_from_mesh,
    outline_of_triangles,
)
from tests.search.arms import arm_tree

ANGLES = np.ones(3, dtype=bool)
ALL = np.arange(3)
# The information of uniform priors over a full turn.
PRIOR = 12.0 / (2.0 * np.pi) ** 2 * np.eye(3)


def drawn_distances(generator, sizes, count=150):
    """Return residuals drawn from three values and five kinds of errors, and the values' errors."""
    X = generator.normal(0.0, 20.0, (count, 3))
    kinds = [generator.normal(0.0, 1.5, (count, k)) for k in (40, 60, 12)]
    y = generator.normal(0.0, sizes.noise, count)
    # The second half repeats some noise of the first.
    again = np.tile(np.eye(count // 2), (2, 1))
    kinds = [again, *kinds]
    nuisances = tuple(generator.normal(0.0, 2.0, (count, 4)) for _ in sizes.nuisances)
    for size, kind in zip((*sizes[1:5], *sizes.nuisances), (*kinds, *nuisances), strict=True):
        y += size * kind @ generator.standard_normal(kind.shape[1])
    effects = np.array([np.eye(count), *(kind @ kind.T for kind in kinds)])
    which = np.arange(count) // (count // 2)
    residuals = Distances(y, X, effects, X.T @ X, kinds[1], which, nuisances)
    return residuals, np.linalg.solve(X.T @ X, X.T @ y)


@pytest.mark.parametrize(("scale", "prior"), [(1.0, 1.0), (0.02, 1.0), (30.0, 3.0), (1.0, 0.2)])
def test_sizes_maximise_the_posterior(scale, prior):
    """They maximise the restricted likelihood times the prior of the sizes' logarithms."""
    sizes = ErrorSizes(*(scale * np.array([1.5, 1.2, 0.4, 1.0, 2.0])))
    residuals, _ = drawn_distances(np.random.default_rng(8), sizes, 60)
    found = np.log(estimate_sizes(residuals, ANGLES, 0.0, prior, tolerance=1e-4)[:5])

    def log_likelihood(t):
        V = np.einsum("k,kij->ij", np.exp(2.0 * t), residuals.effects)
        whole = V + residuals.X @ np.linalg.inv(PRIOR) @ residuals.X.T
        logs = np.linalg.slogdet(whole)[1] + residuals.y @ np.linalg.solve(whole, residuals.y)
        return -0.5 * (logs + t @ t / prior**2)

    for step in 0.15 * np.eye(5):
        beside = log_likelihood(found + step), log_likelihood(found - step)
        assert log_likelihood(found) > max(beside)


def test_camera_error_is_at_least_one_pixel():
    residuals, _ = drawn_distances(np.random.default_rng(2), ErrorSizes(1.0, 0.5, 0.1, 0.1, 0.01))
    assert estimate_sizes(residuals, ANGLES).camera == 1.0


def test_covariance_matches_monte_carlo():
    generator = np.random.default_rng(3)
    sizes = ErrorSizes(1.0, 1.0, 0.5, 0.5, 2.0)
    ratios = []
    for _ in range(300):
        residuals, errors = drawn_distances(generator, sizes, 60)
        covariance = values_covariance(residuals, sizes, ALL, ANGLES)
        ratios.append(errors @ np.linalg.solve(covariance, errors))
    # The mean of chi squared with three degrees of freedom.
    assert np.mean(ratios) == pytest.approx(3.0, rel=0.15)


def test_unobservable_values_have_the_prior_deviation(capfd):
    empty = Distances(
        np.zeros(0),
        np.zeros((0, 3)),
        np.zeros((5, 0, 0)),
        np.diag([0.0, 1e6, 1e6]),
        np.zeros((0, 12)),
        np.zeros(0, dtype=np.intp),
    )
    sizes = estimate_sizes(empty, ANGLES)
    by_nuisances, unseen, without = nuisance_covariance(empty, sizes, ANGLES)
    assert not by_nuisances.any()
    assert not unseen.any()
    assert without is empty
    for is_angle, widest in ((ANGLES, 2.0 * np.pi), (~ANGLES, 10.0)):
        deviations = np.sqrt(np.diag(values_covariance(empty, sizes, ALL, is_angle)))
        assert deviations[0] == pytest.approx(widest / np.sqrt(12.0))
        assert deviations[1] < 0.01
    assert capfd.readouterr() == ("", "")


def test_moving_parts_have_no_repeated_noise():
    sizes = ErrorSizes(1.5, 0.0, 0.4, 1.0, 2.0)
    residuals, _ = drawn_distances(np.random.default_rng(6), sizes)
    moving = residuals._replace(effects=residuals.effects[[0, 0, 2, 3, 4]])
    assert estimate_sizes(moving, ANGLES).repeated == 0.0
    assert estimate_sizes(residuals, ANGLES).repeated > 0.0


def test_vuong_statistic_is_the_difference_over_its_scatter():
    tiles, others = np.array([[3.0, 1.0], [2.0, 5.0]]), np.array([[1.0, 1.0], [3.0, 3.0]])
    assert vuong_statistic(tiles, others) == pytest.approx(3.0 / np.sqrt(4.0 + 1.0 + 4.0))
    assert vuong_statistic(others, tiles) == -vuong_statistic(tiles, others)
    assert [error_unit(size) for size in (10.0, 200.0, 500.0)] == [1.0, 1.0, 2.5]


def test_deformations_move_surfaces_by_a_metre(kinematics):
    """For all twelve deformations: translations along the part's axes and stretches along them."""
    outlines = simplify_surfaces(TreeSurfaces(kinematics.tree))
    X_WN = kinematics.poses(np.array([0.6, 0.7, -0.7, 0.9, 0.3]))
    for outline, X, K in zip(outlines, X_WN, surface_deformations(outlines, X_WN), strict=True):
        p_W = outline.vertices @ X[:3, :3].T + X[:3, 3]
        p_W = np.column_stack([p_W, np.ones(len(p_W))])
        moved = np.einsum("ijk,pj->kpi", K.reshape(3, 4, 12), p_W)
        np.testing.assert_allclose(np.sqrt((moved**2).sum(axis=2).mean(axis=1)), 1.0, rtol=1e-6)


@pytest.fixture(scope="module")
def kinematics(tmp_path_factory):
    return TreeKinematics(arm_tree(tmp_path_factory.mktemp("arm")))


def test_nuisances_are_removed_by_their_posterior_mean():
    sizes = ErrorSizes(1.0, 0.5, 0.2, 0.1, 0.3, (2.0,))
    residuals, _ = drawn_distances(np.random.default_rng(5), sizes, 40)
    _, _, without = nuisance_covariance(residuals, sizes, ANGLES)
    (A,) = residuals.nuisances
    values = residuals.X @ np.linalg.inv(PRIOR) @ residuals.X.T
    whole = distances_covariance(residuals, sizes) + 4.0 * A @ A.T + values
    estimates = 4.0 * A.T @ np.linalg.solve(whole, residuals.y)
    np.testing.assert_allclose(without.y, residuals.y - A @ estimates, atol=1e-6)


SIZES = np.array([0.004, 0.006, 0.004])
MIDDLES = ((0.0, 0.1, 0.2), (0.3, -0.1, 0.0))


def compared_clouds() -> tuple[list[Outline], list[ComparedMask]]:
    """Return two parts, and comparisons with three masks whose information is random and large.

    The first and third mask are of cameras that see the first part in the same pose.
    """
    rng = np.random.default_rng(9)
    corners = [rng.normal(middle, (0.05, 0.08, 0.11), (40, 3)) for middle in MIDDLES]
    triangles = np.arange(39).reshape(-1, 3).astype(np.int32)
    outlines = [outline_from_mesh(TriangleMesh(one, triangles)) for one in corners]
    turns = Rotation.random(8, random_state=3).as_matrix()
    masks = []
    for c in range(3):
        X_WN, X_CW = np.tile(np.eye(4), (2, 1, 1)), np.eye(4)
        X_WN[:, :3, :3] = turns[[0, 1 + c]]
        X_WN[:, :3, 3] = (0.1, 0.2, 0.3), (0.2 * c, 0.0, 0.1)
        X_CW[:3, :3], X_CW[:3, 3] = turns[5 + c % 2], (0.0, 0.1, 2.0 + c % 2)
        J = 3e4 * rng.normal(size=(2, 30, 12))
        A = np.tril(np.swapaxes(J, 1, 2) @ J)
        b = 1e4 * rng.normal(size=(2, 12))
        moves = rng.normal(size=(2, 4, 12))
        moves[:, c] = 0.0
        masks.append(ComparedMask(A, b, X_WN, X_CW, moves, float(SIZES[c])))
    return outlines, masks


def test_residuals_keep_all_information_of_well_seen_parts() -> None:
    """Sums over residuals are those of the quadratic costs x^T A x - 2 b^T x of all motions."""
    outlines, masks = compared_clouds()
    found = distances_in_masks(outlines, masks)
    assert found.X.shape == (72, 4)
    As = [symmetric(one.A) for one in masks]
    pairs = [*zip(masks, map(symmetric, [one.A for one in masks]), strict=True)]
    expected = sum(np.einsum("nmi,nij,nkj->mk", one.moves, A, one.moves) for one, A in pairs)
    np.testing.assert_allclose(found.X.T @ found.X, expected, rtol=1e-6)
    np.testing.assert_allclose(found.information, expected, rtol=1e-9)
    pulled = sum(np.einsum("nmi,ni->m", one.moves, one.b) for one in masks)
    scale = np.abs(pulled).max()
    np.testing.assert_allclose(found.X.T @ found.y, pulled, rtol=1e-6, atol=1e-6 * scale)
    squares = sum(
        float(b @ np.linalg.solve(own, b))
        for one, A in zip(masks, As, strict=True)
        for own, b in zip(A, one.b, strict=True)
    )
    assert found.y @ found.y == pytest.approx(squares)
    np.testing.assert_array_equal(np.bincount(found.pictures), [24, 24, 24])
    # The directions with the largest information come first, and are kept.
    some = distances_in_masks(outlines, masks, max_count=30)
    np.testing.assert_allclose(some.y, found.y[:30])
    np.testing.assert_allclose(some.X, found.X[:30])
    curvatures = (found.surface_derivatives**2).sum(axis=1)
    assert (np.diff(curvatures) <= 1e-9 * curvatures[0]).all()
    weak = [one._replace(A=1e-14 * one.A) for one in masks]
    assert distances_in_masks(outlines, weak).y.shape == (0,)


def effect_of(masks: list[ComparedMask], found: Distances, c: int, motions: np.ndarray) -> float:
    """Return the information of mask c about an affine motion (nodes, 12), by its residuals."""
    moved = [one._replace(moves=motions[:, None] * (k == c)) for k, one in enumerate(masks)]
    return float(distances_in_masks(compared_clouds()[0], moved).information[0, 0])


def test_a_cameras_error_moves_the_whole_body_by_the_unit_of_errors() -> None:
    """By three translations along, and three rotations about, its axes through the body."""
    outlines, masks = compared_clouds()
    found = distances_in_masks(outlines, masks)
    for c, one in enumerate(masks):
        own = found.pictures == c
        parts = zip(outlines, one.X_WN, strict=True)
        p_W = np.concatenate([part.vertices @ X[:3, :3].T + X[:3, 3] for part, X in parts])
        middle = p_W.mean(axis=0)
        extent = np.sqrt(((p_W - middle) ** 2).sum(axis=1).mean())
        total = 0.0
        for axis in one.X_CW[:3, :3]:
            turn = np.cross(np.eye(3), axis).T / extent
            for M, shift in ((np.zeros((3, 3)), axis), (turn, -turn @ middle)):
                affine = SIZES[c] * np.column_stack([M, shift]).ravel()
                total += effect_of(masks, found, c, np.tile(affine, (2, 1)))
        # Both parts move alike, so residuals of both are added before they are squared.
        assert np.trace(found.effects[4][np.ix_(own, own)]) == pytest.approx(total, rel=1e-6)
        assert not found.effects[4][np.ix_(own, ~own)].any()


def test_a_boundary_bias_grows_each_part_by_the_unit_on_all_sides() -> None:
    outlines, masks = compared_clouds()
    plain, found = (distances_in_masks(outlines, masks, with_bias=one) for one in (False, True))
    assert found.X.shape == (72, 7)
    np.testing.assert_allclose(found.X[:, :4], plain.X)
    for c, one in enumerate(masks):
        growth = []
        for outline, X in zip(outlines, one.X_WN, strict=True):
            R, own = X[:3, :3], outline.vertices
            M = R @ np.diag(1.0 / own.std(axis=0)) @ R.T
            shift = -M @ (R @ own.mean(axis=0) + X[:3, 3])
            growth.append(SIZES[c] * np.column_stack([M, shift]).ravel())
        information = effect_of(masks, found, c, np.array(growth))
        assert found.information[4 + c, 4 + c] == pytest.approx(information)
        assert (found.X[:, 4 + c] ** 2).sum() == pytest.approx(information)
        assert not found.X[found.pictures != c, 4 + c].any()
    # Nodes without a surface do not grow.
    bare = outline_from_mesh(TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32)))
    A = masks[0].A.copy()
    A[1] = 0.0
    one = distances_in_masks([outlines[0], bare], [masks[0]._replace(A=A)], with_bias=True)
    assert np.isfinite(one.X).all()


def test_noise_repeats_where_a_part_is_seen_in_the_same_pose() -> None:
    """Relative to the camera: the first part by the first and third mask only."""
    outlines, masks = compared_clouds()
    found = distances_in_masks(outlines, masks)
    parts = np.abs(found.surface_derivatives).reshape(-1, 2, 12).sum(axis=2)
    part = np.argmax(parts, axis=1)
    by_part = found.surface_derivatives.reshape(-1, 2, 12)[np.arange(72), part]
    unit = by_part / np.linalg.norm(by_part, axis=1)[:, None]
    seen = np.where(part == 0, found.pictures % 2, found.pictures)
    alike = (part[:, None] == part) & (seen[:, None] == seen)
    np.testing.assert_allclose(found.effects[1], alike * (unit @ unit.T), atol=1e-9)
    np.testing.assert_array_equal(found.effects[0], np.eye(72))
    # A surface's error moves its part alike in all masks, the edge's error in one.
    surface, one_mask = found.effects[2:4]
    derivatives, same_mask = found.surface_derivatives, found.pictures[:, None] == found.pictures
    np.testing.assert_allclose(surface, derivatives @ derivatives.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(one_mask, surface * same_mask)
    assert surface[~same_mask].any()
    # A pose that differs by a little less or more than half the unit of errors.
    for by, repeats in ((0.4, True), (0.6, False)):
        moved = masks[2].X_WN.copy()
        moved[0, :3, 3] += by * SIZES[2] * np.array([0.6, 0.0, 0.8])
        again = distances_in_masks(outlines, [*masks[:2], masks[2]._replace(X_WN=moved)])
        first, third = again.pictures == 0, again.pictures == 2
        assert again.effects[1][np.ix_(first, third)].any() == repeats


def test_scores_of_nuisances_are_least_squares_beside_the_values() -> None:
    sizes = ErrorSizes(1.0, 0.5, 0.2, 0.1, 0.3, (2.0, 1.0))
    residuals, _ = drawn_distances(np.random.default_rng(5), sizes, 40)
    found, deviations = score_nuisances(residuals, sizes)
    inverse = np.linalg.inv(distances_covariance(residuals, sizes))
    for k, a in enumerate(np.hstack(residuals.nuisances).T):
        J = np.column_stack([residuals.X, a])
        covariance = np.linalg.inv(J.T @ inverse @ J)
        assert found[k] == pytest.approx((covariance @ J.T @ inverse @ residuals.y)[-1])
        assert deviations[k] == pytest.approx(np.sqrt(covariance[-1, -1]))
    assert len(found) == len(deviations) == 8
    assert score_nuisances(residuals._replace(nuisances=()), sizes)[0].shape == (0,)


@pytest.mark.parametrize(
    ("sides", "aside", "is_round"),
    [(4, 0.0, False), (8, 0.0, False), (16, 0.0, True), (40, 0.0, True), (40, 0.02, False)],
)
def test_parts_are_round_within_the_facets_of_their_meshes(tmp_path, sides, aside, is_round):
    """Marginalised rotations add no information, and other motions lose only what turns."""
    turn = np.arange(sides) * 2.0 * np.pi / sides
    ring = np.column_stack([np.cos(turn), np.sin(turn)]) * 0.1 + [aside, 0.0]
    points = np.vstack([np.insert(ring, 2, z, axis=1) for z in (-0.1, 0.0)])
    hull = outline_of_triangles(points, ConvexHull(points).simplices)
    tree = arm_tree(tmp_path)
    kinematics, box = TreeKinematics(tree), outline_from_mesh(tree.nodes[-1].mesh)
    outlines = (box, *[EMPTY_OUTLINE] * (len(tree.nodes) - 2), box)
    child = kinematics.value_nodes[0]
    surfaces = tuple(hull if k == child else one for k, one in enumerate(outlines))
    parts = round_parts(kinematics, surfaces)
    assert [node for node, _ in parts] == [child] * is_round
    A = np.random.default_rng(0).normal(size=(2, len(outlines), 20, 12))
    A = np.swapaxes(A, 2, 3) @ A
    b, bias = A.sum(axis=3), np.concatenate([A.sum(axis=3), A[..., :1, 0]], axis=2)
    X_WN = kinematics.poses(np.linspace(-0.5, 0.5, len(kinematics.names)))
    placement = SimpleNamespace(X_WN=X_WN)
    found = without_rotations(Comparison(A, b, np.zeros(0), bias, placement), parts)
    for node, _ in parts:
        omega = X_WN[node, :3, 2]
        r = affine_motions(np.array([[*omega, *-np.cross(omega, X_WN[node, :3, 3]), 0.0]]))[0]
        for new, old in zip(found.A[:, node], A[:, node], strict=True):
            np.testing.assert_allclose(new @ r, 0.0, atol=1e-9)
            across = np.linalg.svd(r[None])[2][1:]
            marginal = np.linalg.inv(across @ new @ across.T)
            whole = np.linalg.inv(np.vstack([across, r]) @ old @ np.vstack([across, r]).T)
            np.testing.assert_allclose(marginal, whole[:-1, :-1], rtol=1e-6)
        np.testing.assert_allclose(found.b[:, node] @ r, 0.0, atol=1e-9)
    kept = np.arange(len(outlines)) != (child if is_round else -1)
    np.testing.assert_array_equal(found.A[:, kept], A[:, kept])


def test_values_without_data_keep_their_prior() -> None:
    """The sandwich is Bayes' posterior where the noise is what the fit's weights say."""
    rng = np.random.default_rng(4)
    X, known = rng.normal(size=(6, 3)) * [1.0, 0.3, 0.0], np.array([0.0, 9.0, 25.0])
    effects = np.array([np.eye(6), *np.zeros((4, 6, 6))])
    residuals = Distances(
        np.zeros(6), X, effects, X.T @ X, np.zeros((6, 0)), np.zeros(6, int), known=known
    )
    sizes = ErrorSizes(1.0, 0.0, 1.0, 1.0, 1.0)
    found = values_covariance(residuals, sizes, np.arange(3), np.zeros(3, bool))
    np.testing.assert_allclose(found, np.linalg.inv(X.T @ X + np.diag(known)), rtol=0.05, atol=1e-9)
    assert found[2, 2] == pytest.approx(0.04, rel=0.01)


def test_nuisances_that_nothing_shows_keep_the_deviation_of_their_unit() -> None:
    """One has the effect of a value, and no other residual; the other is seen well."""
    rng = np.random.default_rng(7)
    X = rng.normal(size=(40, 3)) * 30.0
    A = np.column_stack([X @ [0.02, 0.01, 0.0], 50.0 * rng.normal(size=40)])
    effects = np.array([np.eye(40), *np.zeros((4, 40, 40))])
    y = rng.normal(size=40)
    residuals = Distances(y, X, effects, X.T @ X, np.zeros((40, 0)), np.arange(40), (A,))
    sizes = ErrorSizes(1.0, 0.0, 1.0, 1.0, 1.0, (0.01,))
    _, unseen, _ = nuisance_covariance(residuals, sizes, ANGLES)
    moved = np.array([0.02, 0.01, 0.0])
    np.testing.assert_allclose(unseen, np.outer(moved, moved), atol=0.02 * 0.02**2)
