"""The update of an extended Kalman filter, repeated where it linearises: (19), (20).

With S = H P H^T + R and K = P H^T S^-1 the mean moves by K (y - h) and the covariance becomes, in
Joseph's form, (I - K H) P (I - K H)^T + K R K^T: positive also where rounding is not kind.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from drake_pose.arrays import Array, Mask
from drake_pose.errors import SettingsError
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncated_normal import Truncated, unlimited

Truncate = Callable[[Belief, Array], Truncated]


class ObservationModel(Protocol):
    """What a filter must know about its measurements: (7)."""

    @property
    def names(self) -> tuple[str, ...]:
        """(m) what is measured."""

    @property
    def variances(self) -> Array:
        """(m,) of the measurement noise."""

    @property
    def wraps(self) -> Mask:
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
    wraps: Mask
    at: Array
    h: Array
    H: Array

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Its value (m,) and H."""
        return self.h + self.H @ (x - self.at), self.H

    def mirrors(self, belief: Belief) -> list[Array]:
        """None."""
        return []


class Measurement(NamedTuple):
    """A measurement y (m,), NaN where occluded, of a model, with its noise's covariance (m, m)."""

    model: ObservationModel
    y: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Updated:
    """A belief after a measurement.

    Attributes:
        belief: without limits.
        truncated: by the limits.
        log_likelihood: logarithm of the measurement's probability density, from the normal
            distribution fitted at the mean.
        distance: the squared distance of mean and measurement from the prediction: chi-squared
            with ``count`` degrees of freedom if all is as modelled.
    """

    belief: Belief
    truncated: Truncated
    log_likelihood: float
    distance: float
    count: int


def make_measurement(
    model: ObservationModel, y: Array, variances: Array | None = None
) -> Measurement:
    """A measurement y (m,), NaN where occluded, and its noise, else the model's.

    Args:
        variances: (m,) of its noise, or the noise's covariance (m, m); finite where y is.

    Raises:
        SettingsError: a wrong size, infinity, or a variance of something measured that is not
            positive.
    """
    m = len(model.names)
    for values, shapes in ((y, [(m,)]), (variances, [(m,), (m, m)])):
        if values is None:
            continue
        if np.shape(values) not in shapes:
            raise SettingsError(
                f"a measurement has the shape {np.shape(values)}; the model measures "
                f"{m} numbers (NaN where occluded)"
            )
        infinite = np.argwhere(np.isinf(values))
        if len(infinite):
            raise SettingsError(
                f"measurement '{model.names[infinite[0, 0]]}' is infinite; give NaN where it is "
                "occluded"
            )
    own = np.diag(model.variances)
    if variances is None:
        return Measurement(model, np.asarray(y, dtype=np.float64), own)
    noise = variances if np.ndim(variances) == 2 else np.diag(variances)
    bad = np.flatnonzero(np.isfinite(y) & ~(np.diag(noise) > 0))
    if len(bad):
        raise SettingsError(f"the variance of measurement '{model.names[bad[0]]}' must be positive")
    return Measurement(model, y, np.where(np.isfinite(noise), noise, own))


def update(
    prediction: Belief,
    seen: Measurement,
    iterations: int = 1,
    start: Array | None = None,
    tempered: bool = True,
    truncate: Truncate | None = None,
    sites: Array | None = None,
) -> Updated:
    """Fuse a belief with a measurement, and truncate it.

    With one iteration this is (19) and (20), linearised at ``start``, and the truncation after it.
    With more, the measurement is linearised anew at the mean of the truncated belief, until that
    stays where it is: a tangent taken where the state cannot be says little about where it can be.

    Args:
        start: (n,) where to linearise first; the predicted mean if not given.
        tempered: whether a far start is approached with more noise than there is, which would
            draw a mirrored one back to the prediction.
        truncate: a belief, and sites (S, 2) to begin with, to a result; None: there are no limits.
        sites: of the last truncation.

    Raises:
        SettingsError: the belief has no density inside the limits, or a variance is not positive.
    """
    x, temperature = prediction.mean if start is None else start, 1.0
    sites = np.zeros((0, 2)) if sites is None else sites
    # A first guess far off is approached with more noise than there is, cooled from step to step:
    # narrow curved valleys, such as that of a known scale, would stop a descent. Steps below
    # ``settled`` deviations end it; later ones are halved, as tangents may point to and fro.
    good_fit, cooling, full_steps = 9.0, 6.0, 8
    settled = 0.01 if truncate is None else 0.3
    if not np.isfinite(seen.y).any():
        iterations = 1
    P = prediction.covariance
    for made in range(iterations):
        # Made linear at x: innovation = H (x - prediction) + noise, over what is measured there.
        h, H = seen.model.predict(x)
        rows = np.isfinite(seen.y) & np.isfinite(h)
        count = int(np.count_nonzero(rows))
        residual = difference(seen.y[rows], h[rows], seen.model.wraps[rows])
        H, plain = H[rows], seen.covariance[np.ix_(rows, rows)]
        innovation = residual + H @ (x - prediction.mean)
        if made == 0 and iterations > 1 and tempered:
            misfit = float(residual @ np.linalg.solve(plain, residual)) / max(count, 1)
            temperature = max(1.0, misfit / good_fit)
        belief, log_likelihood, distance = prediction, 0.0, 0.0
        if count:
            noise, HP = temperature * plain, H @ P
            root, failed = dpotrf(HP @ H.T + noise, lower=1)
            if failed:
                raise SettingsError(
                    "the covariance of the innovation is not positive definite: give every "
                    "measurement a positive variance"
                )
            weighed = dpotrs(root, innovation, lower=1)[0]
            distance = float(innovation @ weighed)
            log_determinant = 2.0 * float(np.log(np.diag(root)).sum())
            log_likelihood = -0.5 * (distance + log_determinant + count * math.log(2 * math.pi))
            gain = dpotrs(root, HP, lower=1)[0].T
            rest = prediction.root - gain @ (H @ prediction.root)
            covariance = rest @ rest.T + gain @ noise @ gain.T
            mean = prediction.mean + P @ (H.T @ weighed)
            belief = Belief(mean, 0.5 * (covariance + covariance.T))
        truncated = unlimited(belief) if truncate is None else truncate(belief, sites)
        sites = truncated.sites
        step = truncated.mean - x
        size = np.abs(step / np.maximum(belief.deviations(), 1e-12)).max()
        if temperature == 1.0 and size < settled:
            break
        x = x + (step if made < full_steps else 0.5 * step)
        temperature = max(1.0, temperature / cooling)
    return Updated(belief, truncated, log_likelihood, distance, count)


def difference(values: Array, expected: Array, turning: Mask) -> Array:
    """Measured minus expected, angles [rad] between -pi and pi."""
    residual = values - expected
    residual[..., turning] = np.remainder(residual[..., turning] + np.pi, 2 * np.pi) - np.pi
    return residual
