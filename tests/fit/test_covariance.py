"""How sure values are where contours err together: known answers, and drawn arms."""

from dataclasses import replace

import numpy as np
import pytest

from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.fit.covariance import (
    Distances,
    ErrorSizes,
    _prior_information,
    distances_covariance,
    error_unit,
    estimate_sizes,
    nuisance_covariance,
    surface_deformations,
    values_covariance,
    vuong_statistic,
)
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import simplify_surfaces
from drake_pose.search import ViewsFit
from drake_pose.silhouette.outline import TreeSurfaces
from tests.search.arms import arm_tree, damaged_views, draw_pose

FINE = tuple(AnnealingStage(scale, 0.0125, 8) for scale in (0.025, 0.0125))
STEP = AnnealingStage(0.025, 0.0125)
ANGLES = np.ones(3, dtype=bool)
ALL = np.arange(3)


def drawn_distances(generator, sizes, count=150):
    """Distances that follow three values and five kinds of errors; and the values' errors."""
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
    seen = Distances(y, X, effects, X.T @ X, kinds[1], which, nuisances)
    return seen, np.linalg.solve(X.T @ X, X.T @ y)


def test_sizes_are_those_that_were_drawn():
    generator = np.random.default_rng(1)
    sizes = ErrorSizes(1.5, 1.2, 0.4, 1.0, 2.0)
    found = [estimate_sizes(drawn_distances(generator, sizes)[0], ANGLES) for _ in range(4)]
    np.testing.assert_allclose(np.median([one[:5] for one in found], axis=0), sizes[:5], rtol=0.4)


@pytest.mark.parametrize(("scale", "prior"), [(1.0, 1.0), (0.02, 1.0), (30.0, 3.0), (1.0, 0.2)])
def test_sizes_are_the_likeliest(scale, prior):
    """Restricted likelihood times prior of the sizes' logarithms, whose values are known little."""
    sizes = ErrorSizes(*(scale * np.array([1.5, 1.2, 0.4, 1.0, 2.0])))
    seen, _ = drawn_distances(np.random.default_rng(8), sizes, 60)
    found = np.log(estimate_sizes(seen, ANGLES, 0.0, prior, tolerance=1e-4)[:5])

    def log_likelihood(t):
        V = np.einsum("k,kij->ij", np.exp(2.0 * t), seen.effects)
        whole = V + seen.X @ np.linalg.inv(_prior_information(ANGLES)) @ seen.X.T
        told = np.linalg.slogdet(whole)[1] + seen.y @ np.linalg.solve(whole, seen.y)
        return -0.5 * (told + t @ t / prior**2)

    for step in 0.15 * np.eye(5):
        assert log_likelihood(found) > max(
            log_likelihood(found + step), log_likelihood(found - step)
        )


def test_a_calibration_is_not_trusted_beyond_a_pixel():
    seen, _ = drawn_distances(np.random.default_rng(2), ErrorSizes(1.0, 0.5, 0.1, 0.1, 0.01))
    assert estimate_sizes(seen, ANGLES).camera == 1.0


def test_covariance_is_that_of_many_fits():
    generator = np.random.default_rng(3)
    sizes = ErrorSizes(1.0, 1.0, 0.5, 0.5, 2.0)
    ratios = []
    for _ in range(300):
        seen, errors = drawn_distances(generator, sizes, 60)
        covariance = values_covariance(seen, sizes, ALL, ANGLES)
        ratios.append(errors @ np.linalg.solve(covariance, errors))
    # The mean of chi squared with three degrees of freedom.
    assert np.mean(ratios) == pytest.approx(3.0, rel=0.15)


@pytest.mark.parametrize("size", [0.0, 1.0, 5.0])
def test_what_is_doubted_widens_what_leans_on_it(size):
    """Of values whose fit knew nothing of it, as many are inside as is claimed, however large."""
    generator, inside, widths = np.random.default_rng(4), [], []
    for _ in range(12):
        sizes = ErrorSizes(1.0, 0.0, 0.1, 0.1, 0.1, (size,))
        seen, errors = drawn_distances(generator, sizes, 60)
        found = estimate_sizes(seen, ANGLES, 0.0, 3.0)
        doubted, without = nuisance_covariance(seen, found, ANGLES)
        own = values_covariance(without, found, ALL, ANGLES)
        deviations = np.sqrt(np.diag(own + doubted))
        inside += (np.abs(errors) < 1.96 * deviations).tolist()
        widths.append(np.median(deviations) / np.median(np.abs(errors)))
    assert np.mean(inside) >= 0.85
    # And not by being told nothing: the usual error is about a deviation.
    assert np.median(widths) < 4.0


def test_values_that_do_not_show_are_as_unsure_as_a_full_turn():
    nothing = Distances(
        np.zeros(0),
        np.zeros((0, 3)),
        np.zeros((5, 0, 0)),
        np.diag([0.0, 1e6, 1e6]),
        np.zeros((0, 12)),
        np.zeros(0, dtype=np.intp),
    )
    sizes = estimate_sizes(nothing, ANGLES)
    for is_angle, widest in ((ANGLES, 2.0 * np.pi), (~ANGLES, 10.0)):
        deviations = np.sqrt(np.diag(values_covariance(nothing, sizes, ALL, is_angle)))
        assert deviations[0] == pytest.approx(widest / np.sqrt(12.0))
        assert deviations[1] < 0.01


def test_noise_is_not_repeated_where_no_part_stands_still():
    sizes = ErrorSizes(1.5, 0.0, 0.4, 1.0, 2.0)
    seen, _ = drawn_distances(np.random.default_rng(6), sizes)
    moving = seen._replace(effects=seen.effects[[0, 0, 2, 3, 4]])
    assert estimate_sizes(moving, ANGLES).repeated == 0.0
    assert estimate_sizes(seen, ANGLES).repeated > 0.0


def test_costs_differ_by_how_their_pieces_scatter():
    pieces, others = np.array([[3.0, 1.0], [2.0, 5.0]]), np.array([[1.0, 1.0], [3.0, 3.0]])
    assert vuong_statistic(pieces, others) == pytest.approx(3.0 / np.sqrt(4.0 + 1.0 + 4.0))
    assert vuong_statistic(others, pieces) == -vuong_statistic(pieces, others)
    assert [error_unit(size) for size in (10.0, 200.0, 500.0)] == [1.0, 1.0, 2.5]


def test_deformations_move_surfaces_by_a_metre(kinematics):
    """Each of twelve: shifts along the part's axes, stretches along them of its vertices."""
    outlines = simplify_surfaces(TreeSurfaces(kinematics.tree))
    X_WN = kinematics.poses(np.array([0.6, 0.7, -0.7, 0.9, 0.3]))
    for outline, X, K in zip(outlines, X_WN, surface_deformations(outlines, X_WN), strict=True):
        p_W = outline.vertices @ X[:3, :3].T + X[:3, 3]
        moved = np.einsum(
            "ijk,pj->kpi", K.reshape(3, 4, 12), np.pad(p_W, ((0, 0), (0, 1)), constant_values=1.0)
        )
        np.testing.assert_allclose(np.sqrt((moved**2).sum(axis=2).mean(axis=1)), 1.0, rtol=1e-6)


def test_distances_err_together_in_a_picture_a_part_and_a_view(kinematics):
    """Two pictures of a camera before which nothing moves, and one of another camera."""
    truth = np.array([0.6, 0.7, -0.7, 0.9, 0.3])
    one, other = damaged_views(kinematics.tree, truth, 2)[:2]
    views = [
        replace(view, camera=replace(view.camera, name=f"{k}"))
        for k, view in enumerate((one, one, other))
    ]
    fit = ViewsFit(kinematics, simplify_surfaces(TreeSurfaces(kinematics.tree)), views)
    seen = fit.distances(truth, STEP)
    _, repeated, surface, mask, camera = seen.effects
    apart = seen.pictures[:, None] != seen.pictures
    still = (seen.pictures[:, None] < 2) & (seen.pictures < 2)
    assert not mask[apart].any()
    assert not camera[apart].any()
    np.testing.assert_array_equal(mask[~apart], surface[~apart])
    assert surface[apart].any()
    assert not repeated[apart & ~still].any()
    np.testing.assert_allclose(repeated[apart & still].max(), 1.0)
    np.testing.assert_allclose(np.diag(repeated), 1.0)
    for matrix in seen.effects:
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-9)
        assert np.linalg.eigvalsh(matrix).min() > -1e-6 * np.abs(matrix).max()
    # All that is told of the values, as the distances are nearly all there is.
    np.testing.assert_allclose(
        seen.X.T @ seen.X, seen.information, rtol=0.1, atol=0.1 * np.abs(seen.information).max()
    )


@pytest.fixture(scope="module")
def kinematics(tmp_path_factory):
    return TreeKinematics(arm_tree(tmp_path_factory.mktemp("arm")))


def fitted(kinematics, views, truth):
    """How far a pose fitted from the truth is from it, its standard deviations, and the sizes."""
    fit = ViewsFit(kinematics, simplify_surfaces(TreeSurfaces(kinematics.tree)), views)
    values = fit.refine(truth, FINE).values
    seen = fit.distances(values, STEP)
    sizes = estimate_sizes(seen, kinematics.is_angle)
    free = np.arange(len(truth))
    covariance = values_covariance(seen, sizes, free, kinematics.is_angle)
    return values - truth, np.sqrt(np.diag(covariance)), sizes


def test_truths_lie_in_their_intervals_where_cameras_masks_and_links_are_off(kinematics):
    """And points that erred each by itself would claim far more."""
    errors, deviations = [], []
    generator = np.random.default_rng(7)
    for seed in range(12):
        truth = 0.8 * draw_pose(kinematics.tree, generator)
        error, deviation, _ = fitted(kinematics, damaged_views(kinematics.tree, truth, seed), truth)
        errors.append(error)
        deviations.append(deviation)
    ratios = np.abs(errors) / np.array(deviations)
    assert np.mean(ratios < 1.96) >= 0.95
    assert np.median(ratios) > 0.2


def test_costs_by_pieces_add_up(kinematics):
    truth = np.array([0.6, 0.7, -0.7, 0.9, 0.3])
    views = damaged_views(kinematics.tree, truth, 2)
    fit = ViewsFit(kinematics, simplify_surfaces(TreeSurfaces(kinematics.tree)), views)
    pieces = fit.tile_costs(truth, STEP)
    assert pieces.sum() == pytest.approx(fit.cost(truth, STEP))
    # Only where a silhouette or the body has an edge.
    assert 5 < np.count_nonzero(pieces[0]) < 80
    assert (pieces >= 0.0).all()


def test_what_is_doubted_is_taken_out_as_likely_as_one_normal_distribution_says():
    sizes = ErrorSizes(1.0, 0.5, 0.2, 0.1, 0.3, (2.0,))
    seen, _ = drawn_distances(np.random.default_rng(5), sizes, 40)
    _, without = nuisance_covariance(seen, sizes, ANGLES)
    (A,) = seen.nuisances
    values = seen.X @ np.linalg.inv(_prior_information(ANGLES)) @ seen.X.T
    whole = distances_covariance(seen, sizes) + 4.0 * A @ A.T + values
    likeliest = 4.0 * A.T @ np.linalg.solve(whole, seen.y)
    np.testing.assert_allclose(without.y, seen.y - A @ likeliest, atol=1e-6)
