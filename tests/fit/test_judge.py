"""Tests of the judge against all permutations, random processes, and distributions."""

from itertools import permutations, product

import numpy as np
import pytest
from scipy.stats import binom, halfnorm, norm

from drake_pose.fit.judge import (
    LEVEL,
    correlation_length,
    depth_twin,
    held_out,
    is_noise,
    largest_difference,
    opposite_side,
    paired_evidence,
    paired_gains,
)

SINGLE = np.random.default_rng(1).permutation(np.eye(5))
PAIRS = np.repeat(np.eye(6)[[3, 0, 5, 1, 4, 2]], 2, axis=0)


def walk(rng, count, correlation):
    """Return a stationary process (count, 5) whose neighbours have a correlation."""
    rows = rng.normal(size=(count, 5))
    for k in range(1, count):
        rows[k] = correlation * rows[k - 1] + np.sqrt(1.0 - correlation**2) * rows[k]
    return rows


def agreement(frames, rows):
    """Return how well each frame agrees with each row, where nothing is hidden."""
    return 30.0 - ((frames[:, None] - rows) ** 2).sum(axis=2)


@pytest.mark.parametrize(("correlation", "most"), [(0.0, 0.05), (0.95, 0.1)])
def test_unrelated_rows_seldom_pass_and_own_rows_do(correlation, most):
    rng, passed = np.random.default_rng(3), list[bool]()
    for _ in range(40):
        rows, frames = walk(rng, 60, correlation), walk(rng, 60, correlation)
        passed.append(paired_evidence(agreement(frames, rows), rows, draws=200).holds)
        own = rows + 0.7 * rng.normal(size=rows.shape)
        assert paired_evidence(agreement(own, rows), rows, draws=200).holds
    assert np.mean(passed) <= most


@pytest.mark.parametrize(
    ("rows", "tested", "number", "needed"), [(SINGLE, 5, 120, 5), (SINGLE, 3, 60, 6),
                                             (PAIRS, 12, 6 * 8 * 12, 12)]
)  # fmt: skip
def test_p_values_are_those_of_all_orders_of_blocks(rows, tested, number, needed):
    """Independent rows are permuted; blocks of four also shifted, and reversed or not."""
    count, rng = len(rows), np.random.default_rng(5)
    gains = rng.normal(size=(count, count))
    gains[tested:] = 0.0
    gains[0, 0] += 0.15 * count - np.trace(gains)
    frames = np.arange(count)
    if rows is SINGLE:
        orders = [np.array(one) for one in permutations(range(count))]
    else:
        cuts, orders = np.split(frames, 3), []
        turned = permutations(range(3)), product((1, -1), repeat=3)
        for shift, order, turns in product(range(count), *turned):
            rolled = np.roll(frames, shift)
            parts = [rolled[cuts[b]][:: turns[k]] for k, b in enumerate(order)]
            orders.append(np.concatenate(parts))
    own = np.trace(gains) / count
    other = [gains[frames, one].mean() for one in orders if (one != frames).any()]
    fraction = np.mean(np.array(other) >= own - 1e-12)
    found = paired_evidence(gains, rows)
    assert found.least == pytest.approx(1.0 / number)
    assert found.p_value == pytest.approx(found.least + (1.0 - found.least) * fraction, abs=0.02)
    assert 0.1 < fraction < 0.9
    assert (found.gain, found.frames, found.needed) == (pytest.approx(own), count, needed)
    assert found.wrong_gain == pytest.approx(gains[~np.eye(count, dtype=bool)].mean())
    assert paired_evidence(gains, rows, draws=20).least == pytest.approx(1.0 / 21.0)


def test_evidence_needs_enough_frames_and_a_gain():
    rows = np.random.default_rng(1).permutation(np.eye(12))
    for count, holds, said in ((4, False, "too few"), (5, True, "less"), (12, True, "less")):
        found = paired_evidence(agreement(rows, rows)[:count, :count], rows[:count])
        assert found.holds == holds
        assert said in str(found)
    assert "about as well" in str(paired_evidence(agreement(rows[::-1], rows), rows))
    worse = paired_evidence(agreement(rows, rows) - 31.0, rows)
    assert (worse.p_value <= LEVEL, worse.holds) == (True, False)
    assert "without the body" in str(worse)
    for gains in (np.ones((1, 1)), np.zeros((12, 12))):
        assert paired_evidence(gains, rows[: len(gains)]).p_value == 1.0


def test_gains_count_the_pixels_of_each_row():
    silhouettes = np.random.default_rng(2).random((3, 6, 7)) < 0.4
    log_odds = np.where(silhouettes, 1.0, -1.0)
    gains = paired_gains(silhouettes, log_odds)
    for i, j in product(range(3), repeat=2):
        both = np.count_nonzero(silhouettes[i] & silhouettes[j])
        assert gains[i, j] == 2 * both - np.count_nonzero(silhouettes[j])


def test_rows_are_correlated_up_to_a_lag():
    """The first lag with a mean autocorrelation below 1/e; a cosine falls below at 5 to 6."""
    for seed, correlation in enumerate((0.0, 0.5, 0.7, 0.9)):
        rows = walk(np.random.default_rng(seed), 40, correlation)
        off = rows - rows.mean(axis=0)
        products = [np.mean([a @ b for a, b in zip(off[lag:], off, strict=False)])
                    for lag in range(40)]  # fmt: skip
        first = np.flatnonzero(np.array(products) < products[0] / np.e)[0]
        assert correlation_length(rows) == first
    assert correlation_length(np.sin(np.pi * np.arange(60.0)[:, None] / 15.0)) in (5, 6, 7)
    assert correlation_length(np.zeros((1, 2))) == 1


def test_every_second_block_is_held_out():
    """Single rows, blocks of twice the correlation time, or halves."""
    for rows, expected in (
        (SINGLE, "01010"), (PAIRS, "000011110000"), (np.arange(9.0)[:, None], "000001111"),
    ):  # fmt: skip
        assert "".join(map(str, held_out(rows).astype(int))) == expected


def test_twins_and_opposite_sides_look_alike():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(200, 3)) * [0.3, 0.2, 0.002] + [0.5, 0.2, 0.9]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    X_CW = np.eye(4)
    X_CW[:3, :3] = turn * np.sign(np.linalg.det(turn))
    X_CW[:3, 3] = np.array([0.4, -0.3, 12.0]) - X_CW[:3, :3] @ points.mean(axis=0)
    twin = depth_twin(X_CW, points)
    np.testing.assert_allclose(twin[:3, :3] @ twin[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(twin[:3, :3]) == pytest.approx(1.0)
    p, q = (points @ X[:3, :3].T + X[:3, 3] for X in (X_CW, twin))
    uv = [one[:, :2] / one[:, 2:] for one in (p, q)]
    assert np.abs(uv[0] - uv[1]).mean() < 0.01 * np.ptp(uv[0], axis=0).mean()
    # What is near in one is far in the other.
    assert np.corrcoef(p[:, 2], q[:, 2])[0, 1] < -0.99
    # From the opposite side a point is as far behind the middle as it was before it.
    there = opposite_side(X_CW, points.mean(axis=0))
    expected = np.column_stack([-p[:, 0], p[:, 1], 24.0 - p[:, 2]])
    np.testing.assert_allclose(points @ there[:3, :3].T + there[:3, 3], expected, atol=1e-9)


def test_noise_of_contours_is_seldom_taken_for_a_difference():
    """Pieces are off with a binomial distribution; the area has that of a sum of |r|."""
    length, off = np.meshgrid([0.0, 55.0, 240.0, 720.0], np.arange(0.0, 130.0, 5.0))
    pieces, beyond = np.rint(length / 12.0), np.floor(off / 12.0)
    expected = (beyond < 1) | (binom.sf(beyond - 1, pieces, LEVEL) > LEVEL)
    np.testing.assert_array_equal(is_noise(length, off, 12.0), expected)
    mean, variance = halfnorm.stats()
    limit = 60 * mean + norm.isf(LEVEL) * np.sqrt(60 * variance)
    assert largest_difference(720.0, 0.7, 12.0) == pytest.approx(12.0 * 0.7 * limit)
