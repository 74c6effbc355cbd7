"""Kernels of the truncation: expectation propagation, and the paper's rows one after another.

A belief N(mean, L L^T) is kept by its factor L; a site multiplies it by exp(-tau s^2 / 2 + nu s),
s = direction^T x, and changes mean and factor in place.
"""

import math

import numpy as np

from drake_pose.arrays import Array
from drake_pose.compiled import compiled, copy_into

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)
# The density is followed down to exp(-40) of its largest value: 4e-18.
_DEPTH = 40.0
# Beyond this many standard deviations a bound takes away less than 1e-18.
_FAR = 9.0
_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)
# Dividing a site out of a belief is safe while the belief without it is not much wider.
_SMALLEST_REST = 1e-3


@compiled
def interval_moments(lower: float, upper: float) -> tuple[float, float, float]:
    """Moments of a standard normal variable, given that it lies between two bounds.

    (25) to (27) of Shimada et al. are the case ``lower = -inf``. Their closed form cancels to
    nothing below c = -8. This integrates the density relative to its largest value, over the part
    where it counts, so that all terms are positive: 13 digits for any bounds, be they 1e7
    standard deviations away or 1e-12 apart.

    Args:
        lower, upper: lower < upper; infinite for none.

    Returns:
        The logarithm of the probability of the interval, the mean and the variance inside it.
    """
    if lower < -_FAR and upper > _FAR:
        return 0.0, 0.0, 1.0
    mirror = 1.0
    if upper < 0.0:
        mirror = -1.0
        lower, upper = -upper, -lower
    anchor = max(lower, 0.0)
    # x = anchor + u; the density falls by anchor u + u^2 / 2.
    reach = 2.0 * _DEPTH / (anchor + math.sqrt(anchor * anchor + 2.0 * _DEPTH))
    low = max(lower - anchor, -reach)
    high = min(upper - anchor, reach)
    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    total, first = 0.0, 0.0
    density = np.empty(_NODES.size)
    for k in range(_NODES.size):
        u = middle + half * _NODES[k]
        density[k] = _WEIGHTS[k] * math.exp(-u * (anchor + 0.5 * u))
        total += density[k]
        first += density[k] * half * _NODES[k]
    offset = first / total
    second = 0.0
    for k in range(_NODES.size):
        difference = half * _NODES[k] - offset
        second += density[k] * difference * difference
    log_probability = math.log(half * total) - 0.5 * anchor * anchor - _HALF_LOG_TWO_PI
    return min(log_probability, 0.0), mirror * (anchor + (middle + offset)), second / total


@compiled
def project(mean: Array, factor: Array, direction: Array) -> tuple[float, Array]:
    """direction^T mean, and direction^T L (k,), whose square is the variance along it."""
    n, k = factor.shape
    projected = np.zeros(k)
    value = 0.0
    for i in range(n):
        if direction[i] != 0.0:
            value += direction[i] * mean[i]
            for j in range(k):
                projected[j] += direction[i] * factor[i, j]
    return value, projected


@compiled
def apply_sites(
    mean: Array, factor: Array, directions: Array, sites: Array, left_out: int, scale: float
) -> float:
    """Multiply a belief by all sites (S, 2: tau, nu) times ``scale`` but one, in place.

    Returns:
        The logarithm of the product's integral.
    """
    total = 0.0
    n, k = factor.shape
    for site in range(sites.shape[0]):
        tau, nu = scale * sites[site, 0], scale * sites[site, 1]
        if site == left_out or (tau == 0.0 and nu == 0.0):
            continue
        value, projected = project(mean, factor, directions[site])
        variance = (projected * projected).sum()
        denominator = 1.0 + tau * variance
        exponent = (2.0 * value * nu + variance * nu * nu - tau * value * value) / denominator
        total += 0.5 * exponent - 0.5 * math.log(denominator)
        if variance > 0.0:
            shift = (nu - tau * value) / denominator
            shrink = (1.0 - 1.0 / math.sqrt(denominator)) / variance
            for i in range(n):
                gain = 0.0
                for j in range(k):
                    gain += factor[i, j] * projected[j]
                mean[i] += gain * shift
                for j in range(k):
                    factor[i, j] -= shrink * gain * projected[j]
    return total


@compiled
def interval_site(
    value: float, variance: float, lower: float, upper: float
) -> tuple[float, float, float]:
    """The site with which a belief along a line has its mean and variance between two bounds.

    Returns:
        tau and nu, 0 where both bounds are far, and the logarithm of the probability between them.
    """
    deviation = math.sqrt(variance)
    alpha, beta = (lower - value) / deviation, (upper - value) / deviation
    if alpha < -_FAR and beta > _FAR:
        return 0.0, 0.0, 0.0
    log_probability, shift, spread = interval_moments(alpha, beta)
    tau = max((1.0 - spread) / (variance * spread), 0.0)
    return tau, tau * value + shift / (deviation * spread), log_probability


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
        base_mean, base_factor: (n,) and (n, n) of the belief without any of the bounds.
        directions, lower, upper: (S, n), (S,) and (S,), infinite for none.
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
    change_of_site = np.empty((1, 2))
    apply_sites(mean, factor, directions, sites, -1, 1.0)
    sweep = 0
    for sweep in range(1, sweep_limit + 1):
        largest = 0.0
        step = 1.0 if 2 * sweep <= sweep_limit else 0.5
        for i in range(count):
            # Mean and variance along the direction of the belief without this site.
            value, projected = project(mean, factor, directions[i])
            variance = (projected * projected).sum()
            rest = 1.0 - sites[i, 0] * variance
            if rest > _SMALLEST_REST:
                value, variance = (value - sites[i, 1] * variance) / rest, variance / rest
            else:
                # The site has taken nearly all variance: build that belief from the start.
                other_mean, other_factor = base_mean.copy(), base_factor.copy()
                apply_sites(other_mean, other_factor, directions, sites, i, 1.0)
                value, projected = project(other_mean, other_factor, directions[i])
                variance = (projected * projected).sum()
            if variance <= 0.0:
                continue
            tau, nu, log_probability = interval_site(value, variance, lower[i], upper[i])
            denominator = 1.0 + tau * variance
            integral = (2.0 * value * nu + variance * nu * nu - tau * value * value) / denominator
            corrections[i] = log_probability - 0.5 * integral + 0.5 * math.log(denominator)
            old_tau, old_nu = sites[i, 0], sites[i, 1]
            now = (value + variance * nu) / denominator
            before_denominator = 1.0 + old_tau * variance
            before = (value + variance * old_nu) / before_denominator
            change = abs(now - before) / math.sqrt(variance / denominator)
            change = max(change, abs(before_denominator / denominator - 1.0))
            largest = max(largest, change)
            change_of_site[0, 0], change_of_site[0, 1] = tau - old_tau, nu - old_nu
            sites[i, 0] += step * change_of_site[0, 0]
            sites[i, 1] += step * change_of_site[0, 1]
            if change > 0.0:
                apply_sites(mean, factor, directions[i : i + 1], change_of_site, -1, step)
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


@compiled
def cut_one_by_one(
    mean: Array, factor: Array, phi: Array, b: Array, skip_above: float, c: Array
) -> float:
    """Truncate by (21) to (29), in place.

    Args:
        mean, factor: (n,) and (n, k) L of the covariance L L^T, changed in place.
        phi, b: (K, n) and (K,) the rows.
        skip_above: rows with a larger c_k are left out.
        c: (K,) receives (24) at each row's turn, infinite for rows without variance.

    Returns:
        The logarithm of the probability of all rows, as the chain of cuts has it.
    """
    total, site = 0.0, np.empty((1, 2))
    for row in range(phi.shape[0]):
        value, projected = project(mean, factor, phi[row])
        variance, size = (projected * projected).sum(), 0.0
        for i in range(len(mean)):
            if phi[row, i] != 0.0:
                size += abs(phi[row, i]) * math.sqrt((factor[i] * factor[i]).sum())
        c[row] = np.inf
        if math.sqrt(variance) <= 1e-15 * size:
            continue
        c[row] = (b[row] - value) / math.sqrt(variance)
        if c[row] <= skip_above:
            site[0, 0], site[0, 1], log_probability = interval_site(
                value, variance, -np.inf, b[row]
            )
            apply_sites(mean, factor, phi[row : row + 1], site, -1, 1.0)
            total += log_probability
    return total
