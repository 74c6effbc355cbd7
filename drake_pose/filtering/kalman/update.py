"""The update of an extended Kalman filter, repeated where it linearises: (19), (20)."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SettingsError
from drake_pose.filtering.kalman.fusion import fuse, joseph
from drake_pose.filtering.state import Belief

Array = NDArray[np.float64]

# A first guess far off is approached with more noise than there is, cooled from step to step:
# narrow curved valleys, such as that of a known scale, would stop a descent.
GOOD_FIT = 9.0
COOLING = 6.0
# Steps below this many predicted deviations end the iteration.
_SETTLED = 0.01


class ObservationModel(Protocol):
    """What a filter must know about its measurements: (7)."""

    @property
    def names(self) -> tuple[str, ...]:
        """(m) what is measured."""

    @property
    def variances(self) -> Array:
        """(m,) of the measurement noise."""

    @property
    def wraps(self) -> NDArray[np.bool_]:
        """(m,) which measurements are angles [rad], equal after a full turn."""

    def predict(self, x: Array) -> tuple[Array, Array]:
        """h(x) (m,) and its Jacobian (m, n); NaN in h where nothing can be seen at x."""

    def mirrors(self, belief: Belief) -> list[Array]:
        """States that look like the mean: the mirrored predictions of section 5."""


@dataclass(frozen=True, eq=False)
class Updated:
    """A belief after a measurement.

    Attributes:
        belief: mean and covariance.
        log_likelihood: logarithm of the measurement's probability density, from the normal
            distribution fitted at the mean.
        distance: the squared distance of mean and measurement from the prediction: chi-squared
            with ``count`` degrees of freedom if all is as modelled.
        count: how many numbers were measured.
        iterations: linearisations made.
    """

    belief: Belief
    log_likelihood: float
    distance: float
    count: int
    iterations: int


@dataclass(frozen=True, eq=False)
class _Weighed:
    """An observation model with the noise of one measurement."""

    model: ObservationModel
    variances: Array

    @property
    def names(self) -> tuple[str, ...]:
        return self.model.names

    @property
    def wraps(self) -> NDArray[np.bool_]:
        return self.model.wraps

    def predict(self, x: Array) -> tuple[Array, Array]:
        return self.model.predict(x)

    def mirrors(self, belief: Belief) -> list[Array]:
        return self.model.mirrors(belief)


def with_variances(model: ObservationModel, y: Array, variances: Array) -> ObservationModel:
    """The same model for one measurement whose noise is its own.

    Args:
        model: what is measured.
        y: (m,) the measurement, NaN where occluded.
        variances: (m,) of its noise; those of what is occluded do not matter.

    Raises:
        SettingsError: wrong sizes, or a variance of something measured that is not positive.
    """
    check_measurement(y, model)
    check_measurement(variances, model)
    bad = np.isfinite(y) & ~(variances > 0)
    if bad.any():
        name = model.names[int(np.flatnonzero(bad)[0])]
        raise SettingsError(f"the variance of measurement '{name}' must be positive")
    return _Weighed(model, np.where(np.isfinite(variances), variances, model.variances))


def check_measurement(y: Array, model: ObservationModel) -> Array:
    """(m,) a measurement, NaN where occluded.

    Raises:
        SettingsError: it has the wrong size, or holds infinity.
    """
    values = np.asarray(y, dtype=np.float64)
    if values.shape != (len(model.names),):
        raise SettingsError(
            f"a measurement has the shape {values.shape}; the model measures "
            f"{len(model.names)} numbers (NaN where occluded)"
        )
    if np.isinf(values).any():
        bad = model.names[int(np.flatnonzero(np.isinf(values))[0])]
        raise SettingsError(f"measurement '{bad}' is infinite; give NaN where it is occluded")
    return values


def update(
    prediction: Belief,
    y: Array,
    model: ObservationModel,
    iterations: int = 1,
    start: Array | None = None,
    heated: bool = True,
) -> Updated:
    """Fuse a belief with a measurement.

    With one iteration this is (19) and (20), linearised at ``start``. With more, each
    linearises where the last one ended (Gauss-Newton on the posterior, steps halved while they
    make it worse): the overconfidence of a single linearisation far from the truth goes away.
    The covariance is updated in Joseph's form.

    Args:
        prediction: the belief before.
        y: (m,) measured, NaN where occluded.
        model: says what was to be expected.
        iterations: linearisations at most.
        start: (n,) where to linearise first; the predicted mean if not given.
        heated: whether a far start is approached with more noise than there is.

    Raises:
        SettingsError: the measurement does not fit.
    """
    values = check_measurement(y, model)
    line, made = _iterate(prediction, values, model, iterations, start, heated)
    if line is None:
        return Updated(prediction, 0.0, 0.0, 0, 0)
    mean, P = prediction.mean, prediction.covariance
    dual, linear_distance, log_determinant, _ = fuse(P, line.H, line.noise, line.innovation)
    distance = linear_distance if iterations == 1 else line.cost
    covariance, definite = joseph(P, line.H, line.noise)
    if not definite:
        raise SettingsError(
            "the covariance of the innovation is not positive definite: give every measurement "
            "a positive variance"
        )
    count = len(line.innovation)
    log_likelihood = -0.5 * (distance + log_determinant + count * math.log(2 * math.pi))
    return Updated(Belief(mean + P @ dual, covariance), log_likelihood, distance, count, made)


@dataclass(frozen=True, eq=False)
class _Line:
    """A measurement made linear: innovation = H (x - prediction) + noise of these variances."""

    H: Array
    noise: Array
    innovation: Array
    cost: float


def _iterate(
    prediction: Belief,
    values: Array,
    model: ObservationModel,
    iterations: int,
    start: Array | None,
    heated: bool,
) -> tuple[_Line | None, int]:
    """Linearise again and again: the last tangent, and how many were made."""
    mean, P = prediction.mean, prediction.covariance
    seen = np.isfinite(values)
    x = mean if start is None else start
    deviations = np.maximum(prediction.deviations(), 1e-12)
    dual = last_dual = np.zeros_like(mean)
    last_x, last_cost, temperature = x, math.inf, 1.0
    line: _Line | None = None
    made = 0
    for attempt in range(3 * iterations):
        h, H = model.predict(x)
        rows = seen & np.isfinite(h)
        residual = difference(values[rows], h[rows], model.wraps[rows])
        noise = model.variances[rows]
        misfit = float(np.sum(residual**2 / noise))
        if attempt == 0 and iterations > 1 and heated:
            temperature = max(1.0, misfit / max(len(residual), 1) / GOOD_FIT)
        cost = float(dual @ P @ dual) + misfit
        # What is hidden at one state and seen at another must not decide between them.
        cost += 9.0 * int(np.count_nonzero(seen & ~rows))
        if made > 1 and temperature == 1.0 and cost > last_cost + 1e-9:
            x, dual = 0.5 * (x + last_x), 0.5 * (dual + last_dual)
            if np.abs((x - last_x) / deviations).max() < 1e-3:
                break
            continue
        step = np.abs((x - last_x) / deviations).max() if attempt else math.inf
        last_x, last_cost, last_dual = x, cost, dual
        H = H[rows]
        line = _Line(H, noise, residual + H @ (x - mean), cost)
        settled = temperature == 1.0 and step < _SETTLED
        if made == iterations or settled or iterations == 1:
            break
        made += 1
        dual, _, _, definite = fuse(P, line.H, temperature * noise, line.innovation)
        temperature = max(1.0, temperature / COOLING)
        if temperature == 1.0:
            last_cost = math.inf
        if not definite:
            break
        x = mean + P @ dual
    return line, max(made, 1)


def difference(values: Array, expected: Array, turning: NDArray[np.bool_]) -> Array:
    """Measured minus expected, angles [rad] between -pi and pi."""
    residual = values - expected
    residual[..., turning] = np.remainder(residual[..., turning] + np.pi, 2 * np.pi) - np.pi
    return residual
