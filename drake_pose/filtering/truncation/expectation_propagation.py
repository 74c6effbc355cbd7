"""Moments of a normal distribution under many inequalities at once: expectation propagation."""

import math

import numpy as np
from numpy.typing import NDArray

from drake_pose.compiled import compiled, copy_into
from drake_pose.filtering.factors import apply_site
from drake_pose.filtering.truncation.kernels import FAR, interval_moments

Array = NDArray[np.float64]

# Dividing a site out of a belief is safe while the belief without it is not much wider.
_SMALLEST_REST = 1e-3


@compiled
def _moments_along(mean: Array, factor: Array, direction: Array) -> tuple[float, float]:
    n, k = factor.shape
    projected = np.zeros(k)
    value = 0.0
    for i in range(n):
        if direction[i] != 0.0:
            value += direction[i] * mean[i]
            for j in range(k):
                projected[j] += direction[i] * factor[i, j]
    return value, (projected * projected).sum()


@compiled
def apply_sites(
    mean: Array, factor: Array, directions: Array, sites: Array, left_out: int, sign: float
) -> float:
    """Multiply a belief by all sites (S, 2: tau, nu) but one, or divide (sign -1), in place.

    Returns:
        The logarithm of the product's integral.
    """
    total = 0.0
    for i in range(sites.shape[0]):
        if i != left_out and (sites[i, 0] != 0.0 or sites[i, 1] != 0.0):
            total += apply_site(mean, factor, directions[i], sign * sites[i, 0], sign * sites[i, 1])
    return total


@compiled
def _cavity(
    base_mean: Array,
    base_factor: Array,
    mean: Array,
    factor: Array,
    directions: Array,
    sites: Array,
    i: int,
) -> tuple[float, float]:
    """Mean and variance along direction i of the belief without site i."""
    value, variance = _moments_along(mean, factor, directions[i])
    rest = 1.0 - sites[i, 0] * variance
    if rest > _SMALLEST_REST:
        return (value - sites[i, 1] * variance) / rest, variance / rest
    # The site has taken nearly all variance: build the belief without it from the start.
    other_mean, other_factor = base_mean.copy(), base_factor.copy()
    apply_sites(other_mean, other_factor, directions, sites, i, 1.0)
    return _moments_along(other_mean, other_factor, directions[i])


@compiled
def propagate(
    base_mean: Array,
    base_factor: Array,
    directions: Array,
    lower: Array,
    upper: Array,
    sites: Array,
    tolerance: float,
    sweep_limit: int,
) -> tuple[float, int]:
    """Find the sites that stand for lower <= directions x <= upper under a normal belief.

    Each site is the normal factor with which the rest of the belief has the mean and the variance
    that it has inside the site's own two bounds. Nothing depends on the order of the rows once the
    sites have settled.

    Args:
        base_mean: (n,) of the belief without any of the bounds.
        base_factor: (n, n) of its covariance.
        directions: (S, n).
        lower, upper: (S,) bounds, infinite for none.
        sites: (S, 2) tau and nu to start from, changed in place.
        tolerance: of the change of a marginal's mean and variance in a sweep, in standard
            deviations and relative.
        sweep_limit: after half of these sweeps the steps are halved.

    Returns:
        The logarithm of the probability of all bounds together, and the sweeps made.
    """
    count = sites.shape[0]
    corrections = np.zeros(count)
    mean, factor = base_mean.copy(), base_factor.copy()
    apply_sites(mean, factor, directions, sites, -1, 1.0)
    sweep = 0
    for sweep in range(1, sweep_limit + 1):
        largest = 0.0
        step = 1.0 if 2 * sweep <= sweep_limit else 0.5
        for i in range(count):
            value, variance = _cavity(base_mean, base_factor, mean, factor, directions, sites, i)
            if variance <= 0.0:
                continue
            deviation = math.sqrt(variance)
            alpha, beta = (lower[i] - value) / deviation, (upper[i] - value) / deviation
            tau, nu, log_probability = 0.0, 0.0, 0.0
            if alpha > -FAR or beta < FAR:
                log_probability, shift, spread = interval_moments(alpha, beta)
                tau = max((1.0 - spread) / (variance * spread), 0.0)
                nu = tau * value + shift / (deviation * spread)
            denominator = 1.0 + tau * variance
            integral = (2.0 * value * nu + variance * nu * nu - tau * value * value) / denominator
            corrections[i] = log_probability - 0.5 * integral + 0.5 * math.log(denominator)
            old_tau, old_nu = sites[i, 0], sites[i, 1]
            now = (value + variance * nu) / denominator
            before_denominator = 1.0 + old_tau * variance
            before = (value + variance * old_nu) / before_denominator
            now_deviation = deviation / math.sqrt(denominator)
            change = abs(now - before) / now_deviation
            change = max(change, abs(before_denominator / denominator - 1.0))
            largest = max(largest, change)
            sites[i, 0] += step * (tau - old_tau)
            sites[i, 1] += step * (nu - old_nu)
            if change > 0.0:
                apply_site(
                    mean, factor, directions[i], step * (tau - old_tau), step * (nu - old_nu)
                )
        if largest < tolerance:
            break
        if largest > 1e-3:
            # Rounding must not add up over steps that change much.
            copy_into(mean, base_mean)
            copy_into(factor, base_factor)
            apply_sites(mean, factor, directions, sites, -1, 1.0)
    copy_into(mean, base_mean)
    copy_into(factor, base_factor)
    return apply_sites(mean, factor, directions, sites, -1, 1.0) + corrections.sum(), sweep
