import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad

from drake_pose.errors import SettingsError
from drake_pose.filtering.inequalities import Inequalities, from_bounds, make_inequalities
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


ENDS = [-35.0, -8.0, -3.0, -0.5, 0.0, 0.7, 2.0, 5.0]
INTERVALS = [
    (-1, 1),
    (-3, 0.2),
    (0.5, 0.7),
    (2, 6),
    (-8.99, 8.99),
    (4, np.inf),
    (-7, -6),
    (3, 3 + 1e-9),
]


@pytest.mark.parametrize(("low", "high"), [*((-np.inf, end) for end in ENDS), *INTERVALS])
def test_moments_equal_quadrature(low, high):
    """Of the density relative to that at the bound next to 0, which avoids tiny numbers."""
    log_probability, mean, variance = interval_moments(low, high)
    anchor = min(max(low, 0.0), high)

    def integral(power, about=0.0):
        def term(u):
            return (anchor + u - about) ** power * math.exp(-anchor * u - 0.5 * u * u)

        ends = max(low - anchor, -40.0), 0.0, min(high - anchor, 40.0)
        parts = itertools.pairwise(ends)
        return sum(quad(term, *part, epsabs=0, epsrel=1e-12, limit=200)[0] for part in parts)

    total = integral(0)
    assert mean == pytest.approx(integral(1) / total, rel=1e-9, abs=1e-12)
    assert variance == pytest.approx(integral(2, mean) / total, rel=1e-8)
    log = math.log(total) - 0.5 * anchor**2 - 0.5 * math.log(2 * math.pi)
    assert log_probability == pytest.approx(log, rel=1e-10, abs=1e-13)
    assert interval_moments(-high, -low)[1] == pytest.approx(-mean, abs=1e-14)


@pytest.mark.parametrize("c", [-1e7, -40.0, -1.0, 3.0, 40.0])
@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_one_row_is_exact_in_many_dimensions(method, c):
    """1-D moments along the row, and linear regression for the other directions."""
    belief, phi = random_problem(3)[0], np.array([1.0, -2.0, 0.0, 0.5])
    s = math.sqrt(phi @ belief.covariance @ phi)
    b = float(phi @ belief.mean + c * s)
    result = method(belief, make_inequalities("wxyz", ["r"], [phi], [b]))
    _, nu, spread = interval_moments(-np.inf, c) if c < 5 else (0.0, 0.0, 1.0)
    gain = belief.covariance @ phi / s
    np.testing.assert_allclose(result.mean, belief.mean + gain * nu, atol=1e-8 * (abs(c) + 1))
    expected = belief.covariance - np.outer(gain, gain) * (1 - spread)
    np.testing.assert_allclose(result.covariance, expected, atol=1e-9)
    assert result.c == pytest.approx([c], rel=1e-14, abs=1e-9)
    assert result.active.tolist() == [c < 5]


def test_sequential_truncation_cuts_one_row_after_another():
    """By (26) to (29) of Shimada et al. in the row's own direction."""
    for seed in range(10):
        belief, rows = random_problem(seed)
        q, Q = belief.mean, belief.covariance
        for phi, b in zip(rows.phi, rows.b, strict=True):
            s = math.sqrt(phi @ Q @ phi)
            c = (b - phi @ q) / s
            if c <= 5:
                nu = (
                    -math.sqrt(2 / math.pi)
                    * math.exp(-c * c / 2)
                    / (1 + math.erf(c / math.sqrt(2)))
                )
                q = q + Q @ phi * nu / s
                Q = Q - np.outer(Q @ phi, Q @ phi) * (nu**2 - c * nu) / s**2
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
        # Joint truncation counts duplicated rows once.
        doubled = Inequalities(
            rows.columns, (*rows.rows, "again"), np.r_[rows.phi, 3 * rows.phi[:1]],
            np.r_[rows.b, 3 * rows.b[0]],
        )  # fmt: skip
        names = [rows.rows[k] for k in order]
        shuffled = make_inequalities(rows.columns, names, rows.phi[order], rows.b[order])
        joint = [truncate_joint(belief, r) for r in (rows, shuffled)]
        np.testing.assert_array_equal(joint[0].mean, joint[1].mean)
        np.testing.assert_array_equal(joint[0].covariance, joint[1].covariance)
        np.testing.assert_array_equal(joint[0].c[order], joint[1].c)
        again = truncate_joint(belief, doubled)
        np.testing.assert_allclose(again.covariance, joint[0].covariance, rtol=1e-9)
        one, other = (truncate_sequential(belief, r) for r in (rows, shuffled))
        spread = np.sqrt(np.diag(one.covariance))
        # Converged sites do not change when they are the start.
        again = truncate_joint(belief, rows, start=joint[0].sites)
        np.testing.assert_allclose(again.mean / spread, joint[0].mean / spread, atol=1e-6)
        moved.append(np.abs((one.mean - other.mean) / spread).max())
    # The sequential form moves by a considerable part of a standard deviation.
    assert 0.05 < np.median(moved) < 3.0


@pytest.mark.parametrize("reach", [1.0, 40.0, 1e4, 1e7])
def test_truncated_beliefs_are_definite_and_joint_ones_inside(reach):
    for seed in range(8):
        belief, rows = random_problem(seed, n=5, rows=9, reach=reach)
        for method in METHODS.values():
            result = method(belief, rows)
            np.testing.assert_array_equal(result.covariance, result.covariance.T)
            np.linalg.cholesky(result.covariance)
        slack = 1e-9 * (np.abs(rows.b) + np.abs(rows.phi) @ np.abs(belief.mean))
        assert (rows.margins(truncate_joint(belief, rows).mean) > -slack).all()


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_elements_without_variance_do_not_move(method):
    """Violations by rounding are tolerated for both signs."""
    covariance = np.diag([1.0, 0.0])
    for sign in (1.0, -1.0):
        start = make_belief([0.0, sign * (0.1 + 0.2)], covariance)
        result = method(start, from_bounds(["a", "b"], [0.5, -0.3], [2, 0.3]))
        assert result.mean[1] == start.mean[1]
        assert result.covariance[1, 1] == 0
        assert 0.5 < result.mean[0] < 2
    with pytest.raises(SettingsError, match="'b <= 1'"):
        method(make_belief([0.0, 3.0], covariance), from_bounds(["a", "b"], [0.5, -1], [2, 1]))


def test_beliefs_of_another_size_and_conflicting_parallel_rows_are_refused():
    for method in METHODS.values():
        with pytest.raises(SettingsError, match="for_columns"):
            method(make_belief([0, 0, 0], np.eye(3)), from_bounds(["a", "b"], [-1, -1], [1, 1]))
    rows = make_inequalities(["a"], ["up", "down"], [[2.0], [-1.0]], [1.0, -3.0])
    with pytest.raises(SettingsError, match="up; down"):
        merge_rows(rows)
