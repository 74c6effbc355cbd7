import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import truncnorm

from drake_pose.errors import SettingsError
from drake_pose.filtering.inequalities import from_bounds, make_inequalities, stack, two_sided
from drake_pose.filtering.state import make_belief
from drake_pose.filtering.truncated_normal import (
    interval_moments,
    merge_rows,
    truncate_joint,
    truncate_sequential,
)

METHODS = {"sequential": truncate_sequential, "joint": truncate_joint}


def random_problem(seed, n=4, rows=6, reach=1.5):
    """Return a belief, and rows about a point up to ``reach`` standard deviations away."""
    generator = np.random.default_rng(seed)
    A = generator.normal(size=(n, n))
    covariance = A @ A.T / n + 0.05 * np.eye(n)
    mean = generator.normal(size=n)
    inside = mean + np.linalg.cholesky(covariance) @ generator.normal(size=n) * reach / 2
    phi = generator.normal(size=(rows, n))
    b = phi @ inside + generator.uniform(0.05, 1.0, size=rows)
    names = [f"x{i}" for i in range(n)]
    rows = make_inequalities(names, [f"r{k}" for k in range(rows)], phi, b)
    return make_belief(mean, covariance), rows


# One dimension: compared with quadrature, the tail's series, and scipy where it is accurate.


@pytest.mark.parametrize("c", [-35.0, -8.0, -3.0, -0.5, 0.0, 0.7, 2.0, 5.0])
def test_one_sided_moments_equal_quadrature(c):
    log_probability, mean, variance = interval_moments(-np.inf, c)

    def density(u):
        # Shifted to the bound, so that the quadrature avoids tiny numbers.
        return math.exp(c * u - 0.5 * u * u)

    total = quad(density, 0, np.inf, epsabs=0, epsrel=1e-12)[0]
    first = quad(lambda u: u * density(u), 0, np.inf, epsabs=0, epsrel=1e-12)[0] / total
    centred = quad(lambda u: (u - first) ** 2 * density(u), 0, np.inf, epsabs=0, epsrel=1e-12)[0]
    assert mean == pytest.approx(c - first, rel=1e-10)
    assert variance == pytest.approx(centred / total, rel=1e-9)
    assert log_probability == pytest.approx(
        math.log(total) - 0.5 * c * c - 0.5 * math.log(2 * math.pi), rel=1e-10, abs=1e-13
    )


@pytest.mark.parametrize("c", [-40.0, -300.0, -1e4, -1e7])
def test_far_tails_follow_the_asymptotic_series(c):
    _, mean, variance = interval_moments(-np.inf, c)
    a = -c
    # Mean (hazard rate) and variance 1 - hazard (hazard - a) of the tail.
    assert a + mean == pytest.approx(-(1 / a - 2 / a**3 + 10 / a**5), rel=1e-6, abs=4e-16 * a)
    assert variance == pytest.approx(1 / a**2 - 6 / a**4 + 50 / a**6, rel=1e-6)


@pytest.mark.parametrize(
    ("low", "high"), [(-1, 1), (-3, 0.2), (0.5, 0.7), (2, 6), (-8.99, 8.99), (4, np.inf), (-7, -6)]
)
def test_two_sided_moments_equal_scipys(low, high):
    log_probability, mean, variance = interval_moments(low, high)
    expected_mean, expected_variance = truncnorm.stats(low, high)
    assert mean == pytest.approx(float(expected_mean), rel=1e-9, abs=1e-12)
    assert variance == pytest.approx(float(expected_variance), rel=1e-7)
    mirrored = interval_moments(-high, -low)
    assert mirrored[1] == pytest.approx(-mean, abs=1e-14)
    assert log_probability <= 0


def test_narrow_intervals_are_uniform():
    for width in (1e-3, 1e-9):
        _, mean, variance = interval_moments(3.0, 3.0 + width)
        assert mean == pytest.approx(3.0 + width / 2, abs=width**2)
        assert variance == pytest.approx(width**2 / 12, rel=1e-4)


# Many dimensions.


@pytest.mark.parametrize("c", [-1e7, -1e3, -40.0, -8.0, -1.0, 0.0, 3.0, 40.0])
@pytest.mark.parametrize("method", METHODS)
def test_one_row_is_exact_in_many_dimensions(method, c):
    """1-D moments along the row, and linear regression for the other directions."""
    belief, _ = random_problem(3)
    phi = np.array([1.0, -2.0, 0.0, 0.5])
    s = math.sqrt(phi @ belief.covariance @ phi)
    b = float(phi @ belief.mean + c * s)
    rows = make_inequalities([f"x{i}" for i in range(4)], ["r"], [phi], [b])
    result = METHODS[method](belief, rows)
    _, nu, spread = interval_moments(-np.inf, c)
    gain = belief.covariance @ phi / s
    if c <= 3:
        scale = abs(c) + 1
        np.testing.assert_allclose(result.mean, belief.mean + gain * nu, atol=1e-8 * scale)
        expected = belief.covariance - np.outer(gain, gain) * (1 - spread)
        np.testing.assert_allclose(result.covariance, expected, atol=1e-9)
    else:
        np.testing.assert_array_equal(result.mean, belief.mean)
        np.testing.assert_allclose(result.covariance, belief.covariance, rtol=1e-13)
    np.linalg.cholesky(result.covariance)
    assert result.c == pytest.approx([c], rel=1e-14, abs=1e-9)


def test_sequential_truncation_equals_the_papers_formula():
    """(21) to (29) with the rotations of (21), row by row."""
    for seed in range(10):
        belief, rows = random_problem(seed)
        q, Q = belief.mean, belief.covariance
        for phi, b in zip(rows.phi, rows.b, strict=True):
            W, T = np.linalg.eigh(Q)
            root = np.sqrt(W)
            v = root * (T.T @ phi)
            c = (b - phi @ q) / np.linalg.norm(v)
            if c > 5:
                continue
            # R rotates v to the first axis.
            basis = np.linalg.qr(np.column_stack([v, np.eye(len(q))]))[0]
            R = basis.T * np.where(np.arange(len(q)) == 0, np.sign(basis[:, 0] @ v), 1.0)[:, None]
            nu = -math.sqrt(2 / math.pi) * math.exp(-c * c / 2) / (1 + math.erf(c / math.sqrt(2)))
            mu = np.r_[nu, np.zeros(len(q) - 1)]
            S = np.diag(np.r_[1 + c * nu - nu**2, np.ones(len(q) - 1)])
            back = T @ np.diag(root) @ R.T
            q, Q = back @ mu + q, back @ S @ back.T
        result = truncate_sequential(belief, rows)
        np.testing.assert_allclose(result.mean, q, atol=1e-9)
        np.testing.assert_allclose(result.covariance, Q, atol=1e-9)


def moments_by_grid(belief, rows):
    """Return log probability, mean and covariance inside the rows, by a fine grid."""
    n = len(belief.mean)
    z, step = np.linspace(-6.0, 6.0, {2: 401, 3: 81}[n], retstep=True)
    z = np.stack(np.meshgrid(*[z] * n), axis=-1).reshape(-1, n)
    x = belief.mean + z @ np.linalg.cholesky(belief.covariance).T
    inside = (x @ rows.phi.T <= rows.b).all(axis=1)
    x, weights = x[inside], np.exp(-0.5 * (z[inside] ** 2).sum(axis=1))
    total = weights.sum() * (step / math.sqrt(2.0 * math.pi)) ** n
    return math.log(total), np.average(x, axis=0, weights=weights), np.cov(x.T, aweights=weights)


@pytest.mark.parametrize(("n", "rows", "within"), [(2, 2, 0.01), (3, 5, 0.1)])
def test_joint_truncation_is_near_a_grids_and_nearer_than_the_sequential(n, rows, within):
    """Errors of means and covariances in standard deviations."""
    off = []
    for seed in range(4):
        belief, limits = random_problem(seed, n, rows, reach=2.0)
        log_probability, mean, covariance = moments_by_grid(belief, limits)
        joint, sequential = truncate_joint(belief, limits), truncate_sequential(belief, limits)
        spread = np.sqrt(np.diag(covariance))
        gaps = (joint.covariance - covariance) / np.outer(spread, spread)
        assert np.abs(gaps).max() < 2.5 * within
        assert joint.log_probability == pytest.approx(log_probability, abs=within)
        off.append([np.abs((one.mean - mean) / spread).max() for one in (joint, sequential)])
    ours, papers = np.array(off).T
    assert ours.max() < within
    assert np.median(papers) > 3.0 * np.median(ours)


def test_only_sequential_truncation_depends_on_the_order_of_rows():
    moved = []
    for seed in range(10):
        belief, rows = random_problem(seed, n=8, rows=12)
        order = np.random.default_rng(seed).permutation(len(rows))
        shuffled = rows.take(order)
        joint = [truncate_joint(belief, r) for r in (rows, shuffled)]
        np.testing.assert_array_equal(joint[0].mean, joint[1].mean)
        np.testing.assert_array_equal(joint[0].covariance, joint[1].covariance)
        np.testing.assert_array_equal(joint[0].c[order], joint[1].c)
        one, other = (truncate_sequential(belief, r) for r in (rows, shuffled))
        spread = np.sqrt(np.diag(one.covariance))
        # Converged sites do not change when they are the start.
        again = truncate_joint(belief, rows, start=joint[0].sites)
        np.testing.assert_allclose(again.mean / spread, joint[0].mean / spread, atol=1e-6)
        moved.append(np.abs((one.mean - other.mean) / spread).max())
    # The sequential form moves by a considerable part of a standard deviation.
    assert 0.05 < np.median(moved) < 3.0


@pytest.mark.parametrize("method", METHODS)
def test_distant_rows_change_nothing(method):
    for seed in range(10):
        belief, rows = random_problem(seed)
        far = two_sided(rows.columns, "far", [1, 1, 1, 1], -500, 500)
        one = METHODS[method](belief, rows)
        other = METHODS[method](belief, stack([far, rows], rows.columns))
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-12)
        np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-12)
        np.testing.assert_array_equal(other.active, np.r_[False, False, one.active])


def test_joint_truncation_counts_duplicated_rows_once():
    belief, rows = random_problem(4)
    doubled = make_inequalities(
        rows.columns,
        [*rows.rows, "again"],
        np.r_[rows.phi, 3 * rows.phi[:1]],
        np.r_[rows.b, 3 * rows.b[0]],
    )
    one, other = (truncate_joint(belief, rows), truncate_joint(belief, doubled))
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.covariance, other.covariance)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("reach", [1.0, 40.0, 1e4, 1e7])
def test_truncated_beliefs_are_finite_and_definite_and_joint_ones_inside(method, reach):
    for seed in range(25):
        belief, rows = random_problem(seed, n=5, rows=9, reach=reach)
        result = METHODS[method](belief, rows)
        assert np.isfinite(result.mean).all()
        assert np.isfinite(result.covariance).all()
        np.testing.assert_array_equal(result.covariance, result.covariance.T)
        np.linalg.cholesky(result.covariance)
        if method == "joint":
            slack = 1e-9 * (np.abs(rows.b) + np.abs(rows.phi) @ np.abs(belief.mean))
            assert (rows.margins(result.mean) > -slack).all()


@pytest.mark.parametrize("method", METHODS)
def test_elements_without_variance_do_not_move(method):
    covariance = np.diag([1.0, 0.0])
    rows = from_bounds(["a", "b"], [0.5, -1], [2, 1])
    result = METHODS[method](make_belief(np.zeros(2), covariance), rows)
    assert result.mean[1] == 0
    assert result.covariance[1, 1] == 0
    assert 0.5 < result.mean[0] < 2
    with pytest.raises(SettingsError, match="'b <= 1'"):
        METHODS[method](make_belief(np.array([0.0, 3.0]), covariance), rows)
    # Violations by rounding are tolerated for both signs.
    for sign in (1.0, -1.0):
        at = from_bounds(["a", "b"], [0.5, -0.3], [2, 0.3])
        result = METHODS[method](make_belief(np.array([0.0, sign * (0.1 + 0.2)]), covariance), at)
        assert result.mean[1] == pytest.approx(0.3 * sign)


@pytest.mark.parametrize("method", METHODS.values())
def test_beliefs_of_another_size_are_refused(method):
    with pytest.raises(SettingsError, match="for_columns"):
        method(make_belief([0, 0, 0], np.eye(3)), from_bounds(["a", "b"], [-1, -1], [1, 1]))


def test_conflicting_parallel_rows_are_named():
    rows = make_inequalities(["a"], ["up", "down"], [[2.0], [-1.0]], [1.0, -3.0])
    with pytest.raises(SettingsError, match="up; down"):
        merge_rows(rows)


def test_truncation_without_rows_changes_nothing():
    nothing = from_bounds(["a"], [-np.inf], [np.inf])
    for method in METHODS.values():
        result = method(make_belief([3.0], [[2.0]]), nothing)
        assert result.mean[0] == 3.0
        assert result.covariance[0, 0] == pytest.approx(2.0)
