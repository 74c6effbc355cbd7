"""Gibbs sampling of a truncated normal distribution: the oracle that works everywhere."""

import numpy as np
from scipy.special import ndtr, ndtri

from drake_pose.filtering.inequalities import Inequalities, inner_point


def sample_truncated(
    mean: np.ndarray,
    covariance: np.ndarray,
    inequalities: Inequalities,
    chains: int = 2000,
    sweeps: int = 150,
    kept: int = 50,
    seed: int = 0,
) -> np.ndarray:
    """(chains * kept, n) draws: coordinate by coordinate in whitened coordinates."""
    generator = np.random.default_rng(seed)
    factor = np.linalg.cholesky(covariance)
    rows = inequalities.phi @ factor
    bounds = inequalities.b - inequalities.phi @ mean
    start = np.linalg.solve(factor, inner_point(inequalities) - mean)
    z = np.tile(start, (chains, 1))
    slack = bounds - z @ rows.T
    draws = []
    for sweep in range(sweeps):
        for j in range(len(mean)):
            column = rows[:, j]
            slack += z[:, j : j + 1] * column
            up, down = column > 1e-12, column < -1e-12
            upper = np.min(slack[:, up] / column[up], axis=1, initial=np.inf)
            lower = np.max(slack[:, down] / column[down], axis=1, initial=-np.inf)
            # In the upper tail the distribution function loses its digits: mirror it.
            flip = lower > 0
            low, high = np.where(flip, -upper, lower), np.where(flip, -lower, upper)
            u = generator.uniform(size=chains)
            value = ndtri(ndtr(low) + u * (ndtr(high) - ndtr(low)))
            value = np.clip(value, low, high)
            z[:, j] = np.where(flip, -value, value)
            slack -= z[:, j : j + 1] * column
        if sweep >= sweeps - kept:
            draws.append(mean + z @ factor.T)
    return np.concatenate(draws)
