"""The paper's truncation, compiled: one row after another, on the covariance's factor."""

import math

import numpy as np
from numpy.typing import NDArray

from drake_pose.compiled import compiled
from drake_pose.filtering.truncation.kernels import interval_moments

Array = NDArray[np.float64]


@compiled
def cut_one_by_one(
    mean: Array, factor: Array, phi: Array, b: Array, skip_above: float, c: Array
) -> float:
    """Truncate by (21) to (29), in place.

    Args:
        mean: (n,) changed in place.
        factor: (n, k) L of the covariance L L^T, changed in place.
        phi, b: (K, n) and (K,) the rows.
        skip_above: rows with a larger c_k are left out.
        c: (K,) receives (24) at each row's turn, infinite for rows without variance.

    Returns:
        The logarithm of the probability of all rows, as the chain of cuts has it.
    """
    total = 0.0
    n, width = factor.shape
    for row in range(phi.shape[0]):
        projected = np.zeros(width)
        value, size = 0.0, 0.0
        for i in range(n):
            if phi[row, i] != 0.0:
                value += phi[row, i] * mean[i]
                length = 0.0
                for j in range(width):
                    projected[j] += phi[row, i] * factor[i, j]
                    length += factor[i, j] * factor[i, j]
                size += abs(phi[row, i]) * math.sqrt(length)
        deviation = math.sqrt((projected * projected).sum())
        c[row] = np.inf
        if deviation <= 1e-15 * size:
            continue
        c[row] = (b[row] - value) / deviation
        if c[row] > skip_above:
            continue
        log_probability, nu, spread = interval_moments(-np.inf, c[row])
        total += log_probability
        shrink = (1.0 - math.sqrt(spread)) / deviation
        for i in range(n):
            gain = 0.0
            for j in range(width):
                gain += factor[i, j] * projected[j]
            gain /= deviation
            mean[i] += gain * nu
            for j in range(width):
                factor[i, j] -= shrink * gain * projected[j]
    return total
