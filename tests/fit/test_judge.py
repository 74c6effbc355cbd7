"""Tests of the judge against random processes, and of its twin against a projection."""

import numpy as np
import pytest

from drake_pose.fit.judge import (
    LEVEL,
    correlation_length,
    depth_twin,
    is_noise,
    largest_difference,
    paired_evidence,
    paired_gains,
)


def walk(rng, count, correlation):
    """Return a stationary process (count, 5) whose neighbours have a correlation."""
    rows = rng.normal(size=(count, 5))
    for k in range(1, count):
        rows[k] = correlation * rows[k - 1] + np.sqrt(1.0 - correlation**2) * rows[k]
    return rows


def agreement(frames, rows):
    """Return how well each frame agrees with each row, where nothing is hidden."""
    return 30.0 - ((frames[:, None] - rows) ** 2).sum(axis=2)


@pytest.mark.parametrize(("correlation", "most"), [(0.0, 0.03), (0.8, 0.06), (0.95, 0.08)])
def test_unrelated_rows_seldom_pass_and_own_rows_do(correlation, most):
    rng, passed = np.random.default_rng(3), list[bool]()
    for _ in range(80):
        rows, frames = walk(rng, 60, correlation), walk(rng, 60, correlation)
        passed.append(paired_evidence(agreement(frames, rows), rows, draws=400).holds)
        own = paired_evidence(agreement(rows + 0.7 * rng.normal(size=rows.shape), rows), rows)
        assert own.holds
        assert own.gain > own.wrong_gain
    assert np.mean(passed) <= most


@pytest.mark.parametrize(("count", "tested", "holds", "needed"), [
    (4, 4, False, 5), (5, 5, True, 5), (6, 1, False, 11), (12, 3, True, 11)
])  # fmt: skip
def test_too_few_frames_are_no_evidence(count, tested, holds, needed):
    rows = np.random.default_rng(1).permutation(np.eye(count))
    gains = agreement(rows, rows)
    gains[tested:] = 0.0
    found = paired_evidence(gains, rows)
    assert (found.holds, found.frames) == (holds, count)
    assert found.needed == pytest.approx(needed, abs=1)
    assert ("too few" in str(found)) == (found.least > LEVEL)


def test_gains_count_the_pixels_of_each_row():
    silhouettes = np.random.default_rng(2).random((3, 6, 7)) < 0.4
    log_odds = np.where(silhouettes, 1.0, -1.0)
    gains = paired_gains(silhouettes, log_odds)
    for i in range(3):
        for j in range(3):
            both = np.count_nonzero(silhouettes[i] & silhouettes[j])
            assert gains[i, j] == 2 * both - np.count_nonzero(silhouettes[j])


def test_rows_are_correlated_up_to_a_lag():
    t = np.arange(60.0)[:, None]
    assert correlation_length(np.random.default_rng(0).normal(size=(60, 3))) == 1
    # The cosine of 2 pi lag / 30 falls below 1/e between 5 and 6.
    assert correlation_length(np.sin(2.0 * np.pi * t / 30.0)) in (5, 6, 7)


def test_a_twin_shows_a_plane_set_alike_from_the_other_side():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(200, 3)) * [0.3, 0.2, 0.002] + [0.5, 0.2, 0.9]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    X_CW = np.eye(4)
    X_CW[:3, :3] = turn * np.sign(np.linalg.det(turn))
    X_CW[:3, 3] = np.array([0.4, -0.3, 12.0]) - X_CW[:3, :3] @ points.mean(axis=0)
    twin = depth_twin(X_CW, points)
    np.testing.assert_allclose(twin[:3, :3] @ twin[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(twin[:3, :3]) == pytest.approx(1.0)
    places = [points @ X[:3, :3].T + X[:3, 3] for X in (X_CW, twin)]
    uv = [p[:, :2] / p[:, 2:] for p in places]
    assert np.abs(uv[0] - uv[1]).mean() < 0.01 * np.ptp(uv[0], axis=0).mean()
    # What is near in one is far in the other.
    assert np.corrcoef(places[0][:, 2], places[1][:, 2])[0, 1] < -0.99


def test_noise_of_contours_is_seldom_taken_for_a_difference():
    rng = np.random.default_rng(4)
    r = np.abs(rng.normal(size=(4000, 60)))
    off = 12.0 * (r > 2.576).sum(axis=1)
    assert np.mean(~is_noise(720.0, off, 12.0)) <= LEVEL
    areas = 12.0 * 0.7 * r.sum(axis=1)
    assert 0.3 * LEVEL < np.mean(areas > largest_difference(720.0, 0.7, 12.0)) < 2.0 * LEVEL
    assert not is_noise(720.0, 72.0, 12.0)
