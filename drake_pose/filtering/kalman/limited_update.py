"""An update that linearises where the truncated belief lies."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SettingsError
from drake_pose.filtering.kalman.fusion import fuse, joseph
from drake_pose.filtering.kalman.update import (
    COOLING,
    GOOD_FIT,
    ObservationModel,
    Updated,
    check_measurement,
    difference,
    update,
)
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncation.truncated_normal import Truncated

Array = NDArray[np.float64]
Truncate = Callable[[Belief, Array], Truncated]

# Steps below this many deviations end the iteration.
_SETTLED = 0.3
# From this linearisation on the steps are halved: the tangents may point to and fro.
_PATIENCE = 8


@dataclass(frozen=True, eq=False)
class LimitedUpdate:
    """A belief after a measurement, without its limits and with them.

    Attributes:
        updated: by the measurement alone.
        truncated: the same inside the limits.
    """

    updated: Updated
    truncated: Truncated


def limited_update(
    prediction: Belief,
    y: Array,
    model: ObservationModel,
    truncate: Truncate,
    iterations: int,
    start: Array,
    sites: Array,
    heated: bool = True,
) -> LimitedUpdate:
    """Fuse a belief with a measurement, and truncate it.

    With one iteration this is (19), (20) and the truncation after it. With more, the measurement
    is linearised anew at the mean of the truncated belief, until that stays where it is: a
    tangent taken where the state cannot be says little about where it can be.

    Args:
        prediction: the belief before.
        y: (m,) measured, NaN where occluded.
        model: says what was to be expected.
        truncate: a belief, and sites (S, 2) to begin with, to a result.
        iterations: linearisations at most.
        start: (n,) where to linearise first.
        sites: for the first truncation.
        heated: whether a far start is approached with more noise than there is; a mirrored one
            would be drawn back to the prediction by it.

    Raises:
        SettingsError: the measurement does not fit, or the belief has no density inside.
    """
    values = check_measurement(y, model)
    if iterations == 1 or not np.isfinite(values).any():
        updated = update(prediction, values, model, 1, start)
        return LimitedUpdate(updated, truncate(updated.belief, sites))
    x, temperature = start, 1.0
    for made in range(iterations):
        line = _linearise(prediction, values, model, x)
        if made == 0 and heated:
            misfit = float(np.mean(line.residual**2 / line.noise)) if len(line.residual) else 0.0
            temperature = max(1.0, misfit / GOOD_FIT)
        updated = _fuse(prediction, line, temperature, made + 1)
        belief = updated.belief
        truncated = truncate(belief, sites)
        sites = truncated.sites
        step = truncated.mean - x
        size = np.abs(step / np.maximum(belief.deviations(), 1e-12)).max()
        if temperature == 1.0 and size < _SETTLED:
            break
        x = x + (step if made < _PATIENCE else 0.5 * step)
        temperature = max(1.0, temperature / COOLING)
    return LimitedUpdate(updated, truncated)


@dataclass(frozen=True, eq=False)
class _Line:
    """A measurement made linear at x: residual there, slope and noise of what is seen."""

    H: Array
    noise: Array
    residual: Array
    innovation: Array


def _linearise(prediction: Belief, values: Array, model: ObservationModel, x: Array) -> _Line:
    h, H = model.predict(x)
    rows = np.isfinite(values) & np.isfinite(h)
    residual = difference(values[rows], h[rows], model.wraps[rows])
    H = H[rows]
    return _Line(H, model.variances[rows], residual, residual + H @ (x - prediction.mean))


def _fuse(prediction: Belief, line: _Line, temperature: float, made: int) -> Updated:
    P, noise = prediction.covariance, temperature * line.noise
    dual, distance, log_determinant, definite = fuse(P, line.H, noise, line.innovation)
    covariance, _ = joseph(P, line.H, noise)
    if not definite:
        raise SettingsError(
            "the covariance of the innovation is not positive definite: give every measurement "
            "a positive variance"
        )
    count = len(line.residual)
    log_likelihood = -0.5 * (distance + log_determinant + count * math.log(2 * math.pi))
    belief = Belief(prediction.mean + P @ dual, covariance)
    return Updated(belief, log_likelihood, distance, count, made)
