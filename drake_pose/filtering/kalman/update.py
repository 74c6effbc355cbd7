"""The update of an extended Kalman filter, repeated where it linearises: (19), (20).

With S = H P H^T + R and K = P H^T S^-1 the mean moves by K (y - h) and the covariance becomes, in
Joseph's form, (I - K H) P (I - K H)^T + K R K^T: positive also where rounding is not kind.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotrs

from drake_pose.errors import SettingsError
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncation.truncated_normal import Truncated

Array = NDArray[np.float64]
Truncate = Callable[[Belief, Array], Truncated]

# A first guess far off is approached with more noise than there is, cooled from step to step:
# narrow curved valleys, such as that of a known scale, would stop a descent.
_GOOD_FIT = 9.0
_COOLING = 6.0
# Steps below this many predicted deviations end the iteration; with limits, below this many.
_SETTLED = 0.01
_SETTLED_WITH_LIMITS = 0.3
# From this linearisation on the steps are halved: the tangents may point to and fro.
_PATIENCE = 8


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
class LinearObservation:
    """The ``ObservationModel`` h + H (x - at), without mirrors.

    names (m), variances (m,) and wraps (m,) as of the protocol; at (n,); h (m,); H (m, n).
    """

    names: tuple[str, ...]
    variances: Array
    wraps: NDArray[np.bool_]
    at: Array
    h: Array
    H: Array

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Its value (m,) and H."""
        return self.h + self.H @ (x - self.at), self.H

    def mirrors(self, belief: Belief) -> list[Array]:
        """None."""
        return []


@dataclass(frozen=True, eq=False)
class Updated:
    """A belief after a measurement.

    Attributes:
        log_likelihood: logarithm of the measurement's probability density, from the normal
            distribution fitted at the mean.
        distance: the squared distance of mean and measurement from the prediction: chi-squared
            with ``count`` degrees of freedom if all is as modelled.
    """

    belief: Belief
    log_likelihood: float
    distance: float
    count: int
    iterations: int


@dataclass(frozen=True, eq=False)
class LimitedUpdate:
    """A belief after a measurement: without its limits, and truncated by them."""

    updated: Updated
    truncated: Truncated


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
        y, variances: (m,), NaN where occluded.

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


class _Line(NamedTuple):
    """A measurement made linear at x: innovation = H (x - prediction) + noise of these variances.

    residual: measured minus expected at x; hidden: what is measured but cannot be seen at x.
    """

    H: Array
    noise: Array
    residual: Array
    innovation: Array
    hidden: int

    @property
    def misfit(self) -> float:
        return float(np.sum(self.residual**2 / self.noise))


def _linearise(prediction: Belief, values: Array, model: ObservationModel, x: Array) -> _Line:
    h, H = model.predict(x)
    seen = np.isfinite(values)
    rows = seen & np.isfinite(h)
    residual = difference(values[rows], h[rows], model.wraps[rows])
    H, noise = H[rows], model.variances[rows]
    innovation = residual + H @ (x - prediction.mean)
    return _Line(H, noise, residual, innovation, int(np.count_nonzero(seen & ~rows)))


class _Fusion:
    """A prediction (P) and a line with noise of a temperature, S factorised.

    Raises:
        SettingsError: S is not positive definite.
    """

    def __init__(self, prediction: Belief, line: _Line, temperature: float = 1.0) -> None:
        self._prediction, self._line = prediction, line
        self._noise = temperature * line.noise
        self._HP = line.H @ prediction.covariance
        S = self._HP @ line.H.T
        S[np.diag_indices_from(S)] += self._noise
        self._root: Array
        self._root, failed = dpotrf(S, lower=1) if len(S) else (S, 0)
        if failed:
            raise SettingsError(
                "the covariance of the innovation is not positive definite: give every measurement "
                "a positive variance"
            )
        self._weighed = self._solve(line.innovation)

    def _solve(self, right: Array) -> Array:
        """S^-1 times right (m, ...)."""
        if not len(right):
            return right
        return np.asarray(dpotrs(self._root, right, lower=1)[0])

    @property
    def dual(self) -> Array:
        """H^T S^-1 innovation (n,): P times it is the mean's step."""
        return self._line.H.T @ self._weighed

    def updated(self, made: int, distance: float | None = None) -> Updated:
        """The belief after the measurement; ``distance``: if not that of the line."""
        line, count = self._line, len(self._noise)
        if distance is None:
            distance = float(line.innovation @ self._weighed)
        log_determinant = 2.0 * float(np.log(np.diag(self._root)).sum())
        log_likelihood = -0.5 * (distance + log_determinant + count * math.log(2 * math.pi))
        mean, P = self._prediction.mean, self._prediction.covariance
        gain = self._solve(self._HP).T
        root = self._prediction.root
        rest = root - gain @ (line.H @ root)
        covariance = rest @ rest.T + (gain * self._noise) @ gain.T
        belief = Belief(mean + P @ self.dual, 0.5 * (covariance + covariance.T))
        return Updated(belief, log_likelihood, distance, count, made)


def update(
    prediction: Belief,
    y: Array,
    model: ObservationModel,
    iterations: int = 1,
    start: Array | None = None,
    tempered: bool = True,
) -> Updated:
    """Fuse a belief with a measurement.

    With one iteration this is (19) and (20), linearised at ``start``. With more, each
    linearises where the last one ended (Gauss-Newton on the posterior, steps halved while they
    make it worse): the overconfidence of a single linearisation far from the truth goes away.

    Args:
        y: (m,) measured, NaN where occluded.
        start: (n,) where to linearise first; the predicted mean if not given.
        tempered: whether a far start is approached with more noise than there is.

    Raises:
        SettingsError: the measurement does not fit.
    """
    values = check_measurement(y, model)
    mean, P = prediction.mean, prediction.covariance
    x = mean if start is None else start
    deviations = np.maximum(prediction.deviations(), 1e-12)
    dual = last_dual = np.zeros_like(mean)
    last_x, last_cost, temperature, made = x, math.inf, 1.0, 0
    for attempt in range(3 * iterations):
        now = _linearise(prediction, values, model, x)
        if attempt == 0 and iterations > 1 and tempered:
            temperature = max(1.0, now.misfit / max(len(now.residual), 1) / _GOOD_FIT)
        # What is hidden at one state and seen at another must not decide between them.
        cost = float(dual @ P @ dual) + now.misfit + 9.0 * now.hidden
        if made > 1 and temperature == 1.0 and cost > last_cost + 1e-9:
            x, dual = 0.5 * (x + last_x), 0.5 * (dual + last_dual)
            if np.abs((x - last_x) / deviations).max() < 1e-3:
                break
            continue
        step = np.abs((x - last_x) / deviations).max() if attempt else math.inf
        line, line_cost = now, cost
        last_x, last_cost, last_dual = x, cost, dual
        if made == iterations or iterations == 1 or (temperature == 1.0 and step < _SETTLED):
            break
        made += 1
        dual = _Fusion(prediction, line, temperature).dual
        temperature = max(1.0, temperature / _COOLING)
        if temperature == 1.0:
            last_cost = math.inf
        x = mean + P @ dual
    return _Fusion(prediction, line).updated(max(made, 1), None if iterations == 1 else line_cost)


def limited_update(
    prediction: Belief,
    y: Array,
    model: ObservationModel,
    truncate: Truncate,
    iterations: int,
    start: Array,
    sites: Array,
    tempered: bool = True,
) -> LimitedUpdate:
    """Fuse a belief with a measurement, and truncate it.

    With one iteration this is (19), (20) and the truncation after it. With more, the measurement
    is linearised anew at the mean of the truncated belief, until that stays where it is: a
    tangent taken where the state cannot be says little about where it can be.

    Args:
        prediction, y, model, iterations, start: as of ``update``.
        truncate: a belief, and sites (S, 2) to begin with, to a result.
        tempered: as of ``update``; a mirrored start would be drawn back to the prediction by it.

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
        if made == 0 and tempered:
            temperature = max(1.0, line.misfit / max(len(line.residual), 1) / _GOOD_FIT)
        updated = _Fusion(prediction, line, temperature).updated(made + 1)
        truncated = truncate(updated.belief, sites)
        sites = truncated.sites
        step = truncated.mean - x
        size = np.abs(step / np.maximum(updated.belief.deviations(), 1e-12)).max()
        if temperature == 1.0 and size < _SETTLED_WITH_LIMITS:
            break
        x = x + (step if made < _PATIENCE else 0.5 * step)
        temperature = max(1.0, temperature / _COOLING)
    return LimitedUpdate(updated, truncated)


def difference(values: Array, expected: Array, turning: NDArray[np.bool_]) -> Array:
    """Measured minus expected, angles [rad] between -pi and pi."""
    residual = values - expected
    residual[..., turning] = np.remainder(residual[..., turning] + np.pi, 2 * np.pi) - np.pi
    return residual
