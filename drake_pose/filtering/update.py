"""The update of an extended Kalman filter, repeated where it linearises: (19), (20).

With S = H P H^T + R and K = P H^T S^-1 the mean moves by K (y - h) and the covariance becomes, in
Joseph's form, (I - K H) P (I - K H)^T + K R K^T: positive also where rounding is not kind.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dpotrf, dpotrs

from drake_pose.arrays import Array, Mask
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.linearisation import (
    Function,
    Linear,
    difference,
    differences,
    linear_over,
    values_alone,
)
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


@dataclass(frozen=True, eq=False)
class FunctionObservation:
    """The ``ObservationModel`` of any function of the state, without mirrors.

    Args:
        names: (m) what is measured.
        deviations: standard deviation of the measurement noise, one for all or (m,).
        function: x (n,) to what would be measured without noise (m,); NaN where nothing can be
            seen at x.
        jacobian: x (n,) to (m, n); None: by differences, at 2 n calls of the function.
        angles: those of names that are angles [rad], equal after a full turn.

    Raises:
        SettingsError: deviations that are not positive, or not one or (m,); a name given twice.
        UnknownNameError: an angle that is not measured.
    """

    names: tuple[str, ...]
    deviations: ArrayLike
    function: Function
    jacobian: Function | None = None
    angles: Sequence[str] = ()

    def __post_init__(self) -> None:
        if isinstance(self.names, str) or len(set(self.names)) != len(self.names):
            raise SettingsError(f"what is measured has different names, not {self.names!r}")
        size = np.shape(self.deviations)
        if size not in ((), (len(self.names),)) or not (np.asarray(self.deviations) > 0).all():
            raise SettingsError(
                f"the deviations of {len(self.names)} measurements are one positive number, or "
                f"as many, not {self.deviations!r}"
            )
        for name in self.angles:
            if name not in self.names:
                raise UnknownNameError("measurement", name, self.names, "the observation")

    @cached_property
    def variances(self) -> Array:
        """(m,) of the measurement noise."""
        return np.full(len(self.names), 1.0) * np.square(self.deviations)

    @cached_property
    def wraps(self) -> Mask:
        """(m,) which measurements are angles."""
        return np.array([name in self.angles for name in self.names], dtype=np.bool_)

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Its value (m,) and Jacobian (m, n)."""
        value = np.asarray(self.function(x), dtype=np.float64)
        if self.jacobian is not None:
            return value, np.asarray(self.jacobian(x), dtype=np.float64)
        turning = self.wraps if value.shape == self.wraps.shape else np.zeros(0, dtype=np.bool_)
        return value, differences(self.function, x, turning)

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
    spread: float = 0.0,
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
        spread: 0: the measurement is linearised at a point. Else over the belief, but for a start
            that is given, see ``linear_over``; what that leaves out counts as this many times its
            covariance, as it repeats itself from frame to frame.

    Raises:
        SettingsError: the belief has no density inside the limits, or a variance is not positive.
    """
    sites, temperature = np.zeros((0, 2)) if sites is None else sites, 1.0
    x, width = prediction.mean if start is None else start, None
    if spread and start is None:
        first = prediction if truncate is None else truncate(prediction, sites)
        x, width = first.mean, first.covariance
    # A first guess far off is approached with more noise than there is, cooled from step to step:
    # narrow curved valleys, such as that of a known scale, would stop a descent. Steps below
    # ``settled`` deviations end it; later ones are halved, as tangents may point to and fro.
    good_fit, cooling, full_steps = 9.0, 6.0, 8
    settled = 0.01 if truncate is None else 0.3
    if not np.isfinite(seen.y).any():
        iterations, width = 1, None
    P, values = prediction.covariance, values_alone(seen.model)
    for made in range(iterations):
        # Made linear at x: innovation = H (x - prediction) + noise, over what is measured there.
        _, h, H, left_out = (
            linear_over(seen.model.predict, Belief(x, width), seen.model.wraps, values)
            if width is not None
            else Linear(x, *seen.model.predict(x))
        )
        rows = np.isfinite(seen.y) & np.isfinite(h)
        count = int(np.count_nonzero(rows))
        residual = difference(seen.y[rows], h[rows], seen.model.wraps[rows])
        H, plain = H[rows], seen.covariance[np.ix_(rows, rows)]
        if left_out is not None:
            plain = plain + spread * left_out[np.ix_(rows, rows)]
        innovation = residual + H @ (x - prediction.mean)
        if made == 0 and iterations > 1 and tempered and not spread:
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
        step, width = truncated.mean - x, truncated.covariance if spread else None
        size = np.abs(step / np.maximum(belief.deviations(), 1e-12)).max()
        if temperature == 1.0 and size < settled:
            break
        x = x + (step if made < full_steps else 0.5 * step)
        temperature = max(1.0, temperature / cooling)
    return Updated(belief, truncated, log_likelihood, distance, count)
