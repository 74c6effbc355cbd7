"""Moments of a one-dimensional normal distribution between two bounds, anywhere in its tails."""

import math

import numpy as np

from drake_pose.compiled import compiled

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)
# The density is followed down to exp(-40) of its largest value: 4e-18.
_DEPTH = 40.0
# Beyond this many standard deviations a bound takes away less than 1e-18.
FAR = 9.0
_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


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
    if lower < -FAR and upper > FAR:
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
