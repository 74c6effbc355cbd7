"""Measurement update of an extended Kalman filter, iterated, with truncation: (19), (20).

With S = H P H^T + R and K = P H^T S^-1 the mean moves by K (y - h), and the covariance becomes, in
Joseph's form, (I - K H) P (I - K H)^T + K R K^T, which stays positive in spite of rounding. Here x
(n,) is the state with covariance P, y (m,) the measurement with noise covariance R, and h(x) the
observation with Jacobian H.

Static views: a filter that linearises anew in each frame of a static view becomes overconfident
(Shimada et al., section 7), because the linearisation error is the same in all its frames.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dpotrf, dpotrs
from scipy.special import chdtri

from drake_pose.arrays import Array, Mask
from drake_pose.errors import SettingsError, require_known
from drake_pose.filtering.state import (
    Belief,
    Function,
    Linear,
    function_without_jacobian,
    linearise_over,
    numerical_jacobian,
    wrapped_difference,
)
from drake_pose.filtering.truncated_normal import Truncated, untruncated

Truncate = Callable[[Belief, Array], Truncated]
"""Maps a belief and initial sites (S, 2) to the truncated belief."""


class ObservationModel(Protocol):
    """An observation y = h(x) + noise, as a filter needs it: (7)."""

    @property
    def names(self) -> tuple[str, ...]:
        """(m) names of the measurements."""

    @property
    def variances(self) -> Array:
        """(m,) variances of the measurement noise."""

    @property
    def wraps(self) -> Mask:
        """(m,) which measurements are angles [rad], compared modulo a full turn."""

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Return h(x) (m,), NaN where occluded, and its Jacobian (m, n)."""

    def mirrors(self, belief: Belief) -> list[Array]:
        """Return states (n,) whose measurement is about that of the belief's mean: section 5."""


@dataclass(frozen=True, eq=False)
class LinearObservation:
    """The ``ObservationModel`` h + H (x - at), without mirrors."""

    # names, variances, wraps: (m), (m,) and (m,); see ``ObservationModel``.
    names: tuple[str, ...]
    variances: Array
    wraps: Mask
    at: Array  # (n,) point of linearisation.
    h: Array  # (m,) value at ``at``.
    H: Array  # (m, n) Jacobian.

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Return the value (m,) at x (n,), and H (m, n)."""
        return self.h + self.H @ (x - self.at), self.H

    def mirrors(self, belief: Belief) -> list[Array]:
        """Return no mirrored states."""
        return []


@dataclass(frozen=True, eq=False)
class FunctionObservation:
    """An ``ObservationModel`` from any function of the state, without mirrors.

    Args:
        names: (m) names of the measurements.
        deviations: standard deviation of the measurement noise, scalar or (m,).
        function: maps x (n,) to the noise-free measurement (m,); NaN where occluded.
        jacobian: maps x (n,) to (m, n); None: central differences, 2 n evaluations.
        angles: names of the measurements that are angles [rad], compared modulo a full turn.

    Raises:
        SettingsError: deviations are not positive or have another shape, or a name occurs twice.
        UnknownNameError: a name in ``angles`` is not a measurement.
    """

    names: tuple[str, ...]
    deviations: ArrayLike
    function: Function
    jacobian: Function | None = None
    angles: Sequence[str] = ()

    def __post_init__(self) -> None:
        if isinstance(self.names, str) or len(set(self.names)) != len(self.names):
            raise SettingsError(f"measurements need different names, not {self.names!r}")
        size = np.shape(self.deviations)
        if size not in ((), (len(self.names),)) or not (np.asarray(self.deviations) > 0).all():
            raise SettingsError(
                f"the deviations of {len(self.names)} measurements must be one positive number "
                f"or as many, not {self.deviations!r}"
            )
        require_known("measurement", self.angles, self.names, "the observation")

    @cached_property
    def variances(self) -> Array:
        """(m,) variances of the measurement noise."""
        return np.full(len(self.names), 1.0) * np.square(self.deviations)

    @cached_property
    def wraps(self) -> Mask:
        """(m,) which measurements are angles."""
        return np.array([name in self.angles for name in self.names], dtype=np.bool_)

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Return the function's value (m,) at x (n,), and its Jacobian (m, n)."""
        value = np.asarray(self.function(x), dtype=np.float64)
        if self.jacobian is not None:
            return value, np.asarray(self.jacobian(x), dtype=np.float64)
        is_angle = self.wraps if value.shape == self.wraps.shape else np.zeros(0, dtype=np.bool_)
        return value, numerical_jacobian(self.function, x, is_angle, 1.0)

    def mirrors(self, belief: Belief) -> list[Array]:
        """Return no mirrored states."""
        return []


class Measurement(NamedTuple):
    """A measurement of a state.

    Attributes:
        model: the observation that predicts it.
        y: (m,) measured values, NaN where occluded.
        covariance: (m, m) of the measurement noise.
    """

    model: ObservationModel
    y: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Updated:
    """A belief after a measurement."""

    belief: Belief  # Without limits.
    truncated: Truncated  # Inside the limits.
    log_likelihood: float  # Log probability density of the measurement under the linearised model.
    # Squared Mahalanobis distance of the innovation; chi-squared distributed with ``count`` degrees
    # of freedom if the models are right.
    distance: float
    count: int  # Number of measurements used.
    # Variance of the linearisation error relative to that of the noise, and the direction (n,)
    # along which a narrower belief would reduce it most; 0 and None if it is not estimated.
    bend: float = 0.0
    direction: Array | None = None


def make_measurement(
    model: ObservationModel, y: Array, variances: Array | None = None
) -> Measurement:
    """Return a checked measurement.

    ``model``: the observation that predicts y. ``y``: (m,) NaN where occluded. ``variances``: noise
    variances (m,) or covariance (m, m), NaN where nothing is measured; None: the model's. Raises
    SettingsError: a wrong shape, an infinite number, or a variance that is not positive.
    """
    m = len(model.names)
    for values, shapes in ((y, [(m,)]), (variances, [(m,), (m, m)])):
        if values is None:
            continue
        if np.shape(values) not in shapes:
            raise SettingsError(
                f"a measurement has the shape {np.shape(values)}; the model has {m} measurements "
                "(NaN where occluded)"
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
    y = np.where(np.isnan(np.diag(noise)), np.nan, y)
    bad = np.flatnonzero(np.isfinite(y) & ~(np.diag(noise) > 0))
    if len(bad):
        raise SettingsError(f"the variance of measurement '{model.names[bad[0]]}' must be positive")
    return Measurement(model, y, np.where(np.isfinite(noise), noise, own))


def update(
    prediction: Belief,
    measurement: Measurement,
    iterations: int = 1,
    start: Array | None = None,
    tempered: bool = True,
    truncate: Truncate | None = None,
    sites: Array | None = None,
    remainder_weight: float = 0.0,
) -> Updated:
    """Update a belief by a measurement, and truncate it.

    One iteration is (19) and (20), linearised at ``start``, followed by the truncation. With more
    iterations the measurement is linearised again at the mean of the truncated belief until that
    converges, because a tangent at a state outside the limits may be useless inside.

    Args:
        prediction: the belief before the measurement, without limits.
        measurement: y, its noise, and the observation h.
        iterations: largest number of linearisations.
        start: (n,) point of the first linearisation; None: the predicted mean.
        tempered: whether noise is inflated at first if the start fits badly; only of several
            iterations, without ``remainder_weight``. Not for a mirrored start, which it would move.
        truncate: maps a belief and initial sites (S, 2) to the truncated belief; None: no limits.
        sites: (S, 2) sites of the last truncation; None: none.
        remainder_weight: 0: linearise at a point. Otherwise linearise over the belief (unless
            ``start`` is given), and add this multiple of the remainder's covariance to the noise;
            more than 1, as the remainder repeats from frame to frame. See ``linearise_over``.

    Raises SettingsError: the belief violates a row along which it has no variance, or a noise
    variance is not positive.
    """
    sites, temperature = np.zeros((0, 2)) if sites is None else sites, 1.0
    x, range_covariance = prediction.mean if start is None else start, None
    if remainder_weight and start is None:
        first = prediction if truncate is None else truncate(prediction, sites)
        x, range_covariance = first.mean, first.covariance
    # Annealing: a start that fits badly is updated with inflated noise, which is reduced from step
    # to step. Narrow curved valleys, for example of a known scale, would otherwise stop it. Steps
    # below ``settled`` standard deviations end it; later steps are halved, as tangents may make it
    # oscillate.
    good_fit, cooling, full_steps = 9.0, 6.0, 8
    settled = 0.01 if truncate is None else 0.3
    bend, direction = 0.0, None
    if not np.isfinite(measurement.y).any():
        iterations, range_covariance = 1, None
    P, values = prediction.covariance, function_without_jacobian(measurement.model)
    for made in range(iterations):
        # Linearised at x, over the measurements that are visible there.
        model = measurement.model
        spread = None if range_covariance is None else Belief(x, range_covariance)
        _, h, H, remainder, bends = (
            Linear(x, *model.predict(x))
            if spread is None
            else linearise_over(model.predict, spread, model.wraps, values)
        )
        rows = np.isfinite(measurement.y) & np.isfinite(h)
        count = int(np.count_nonzero(rows))
        residual = wrapped_difference(measurement.y[rows], h[rows], measurement.model.wraps[rows])
        H, R = H[rows], measurement.covariance[np.ix_(rows, rows)]
        if remainder is not None and spread is not None and bends is not None and count:
            white = np.linalg.solve(np.linalg.cholesky(R), bends[rows].reshape(count, -1))
            white = white.reshape(-1, len(x))
            sizes, axes = np.linalg.eigh(white.T @ white)
            # A function that is 1 at one standard deviation along the axis, 0 along others.
            direction = np.linalg.lstsq(spread.root.T, axes[:, -1], rcond=None)[0]
            bend = 0.5 * float(sizes.sum())
            R = R + remainder_weight * remainder[np.ix_(rows, rows)]
        innovation = residual + H @ (x - prediction.mean)
        if made == 0 and iterations > 1 and tempered and not remainder_weight:
            misfit = float(residual @ np.linalg.solve(R, residual)) / max(count, 1)
            temperature = max(1.0, misfit / good_fit)
        belief, log_likelihood, distance = prediction, 0.0, 0.0
        if count:
            noise, HP = temperature * R, H @ P
            root, failed = dpotrf(HP @ H.T + noise, lower=1)
            if failed:
                raise SettingsError(
                    "the covariance of the innovation is not positive definite: give every "
                    "measurement a positive variance"
                )
            weighted = dpotrs(root, innovation, lower=1)[0]
            distance = float(innovation @ weighted)
            log_determinant = 2.0 * float(np.log(np.diag(root)).sum())
            log_likelihood = -0.5 * (distance + log_determinant + count * math.log(2 * math.pi))
            gain = dpotrs(root, HP, lower=1)[0].T
            reduced = prediction.root - gain @ (H @ prediction.root)
            covariance = reduced @ reduced.T + gain @ noise @ gain.T
            mean = prediction.mean + P @ (H.T @ weighted)
            belief = Belief(mean, 0.5 * (covariance + covariance.T))
        truncated = untruncated(belief) if truncate is None else truncate(belief, sites)
        sites = truncated.sites
        step = truncated.mean - x
        range_covariance = truncated.covariance if remainder_weight else None
        size = np.abs(step / np.maximum(belief.deviations(), 1e-12)).max()
        if temperature == 1.0 and size < settled:
            break
        x = x + (step if made < full_steps else 0.5 * step)
        temperature = max(1.0, temperature / cooling)
    return Updated(belief, truncated, log_likelihood, distance, count, bend, direction)


def slices(free: Belief, wide: Updated) -> Iterator[tuple[float, Belief]]:
    """Yield parts of a belief before an update, with logarithms of their weights.

    Their mixture is the belief without its tails beyond 2.5 standard deviations. Along the
    direction of ``wide``, the belief's update, the measurement is straight over each.
    """
    a = wide.direction
    assert a is not None
    across = free.covariance @ a
    deviation = math.sqrt(a @ across)
    # The error's variance grows with the fourth power of the width.
    width = math.sqrt(a @ wide.truncated.covariance @ a / math.sqrt(wide.bend)) / deviation
    width = min(max(width, 0.2), 0.7)
    # Normal densities 1.5 standard deviations apart add up to a flat one within 1 %.
    spread, step = math.sqrt(1.0 - width**2), 1.5 * width
    count = math.ceil(2.5 * spread / step)
    centers = step * np.arange(-count, count + 1)
    logs = -0.5 * (centers / spread) ** 2
    P = free.covariance - spread**2 * np.outer(across, across) / deviation**2
    P = 0.5 * (P + P.T)
    for center, log_weight in zip(centers, logs - np.logaddexp.reduce(logs), strict=True):
        yield float(log_weight), Belief(free.mean + center / deviation * across, P)


def next_view(
    view: tuple[Array, int] | None, measurement: Measurement, significance: float
) -> tuple[Array, int]:
    """Return the static view that a measurement belongs to: the current one, or a new one.

    A view is the measurement (m,) of its first frame, NaN where occluded, and the number of its
    frames so far.

    A view is new if a measurement becomes visible, if no measurement is visible in both frames, or
    if the difference from the view's reference is significant.

    ``view``: the current view; None: there is none. ``measurement``: the next frame's measurement.
    ``significance``: p-value of the difference, under noise alone, below which a view is new; 0:
    every view is new.
    """
    y = measurement.y
    if view is None or significance == 0 or len(view[0]) != len(y):
        return y, 1
    reference, count = view
    change = wrapped_difference(y, reference, measurement.model.wraps)
    both = np.isfinite(change)
    new_rows = np.isfinite(y) & ~np.isfinite(reference)
    if new_rows.any() or not both.any():
        return y, 1
    size = float(np.sum(change[both] ** 2 / (2.0 * np.diag(measurement.covariance)[both])))
    # The chi-squared value with as many degrees of freedom and this p-value.
    is_new = size > float(chdtri(int(np.count_nonzero(both)), significance))
    return (y, 1) if is_new else (reference, count + 1)


def after_step(belief: Belief, step: Linear, U: Array) -> Belief:
    """Return a belief after one step of a motion, with process noise covariance U (n, n): (6).

    ``step``: the motion, linearised; the covariance of its remainder is added to U.
    """
    noise = U if step.remainder is None else U + step.remainder
    P = step.slope @ belief.covariance @ step.slope.T + noise
    return Belief(step.value + step.slope @ (belief.mean - step.at), 0.5 * (P + P.T))


@dataclass(frozen=True, eq=False)
class RepeatedView:
    """The belief within a static view: the state and the offsets of the tangent."""

    tangent: Array  # (n,) state at which the view's first frame was linearised.
    # Over n + m numbers: the state, then the linearisation error of each measurement.
    belief: Belief

    def state(self) -> Belief:
        """Return the marginal belief of the state (n,)."""
        n = len(self.tangent)
        return Belief(self.belief.mean[:n].copy(), self.belief.covariance[:n, :n].copy())

    def after_step(self, step: Linear, U: Array) -> "RepeatedView":
        """Return the view after ``after_step`` of the state; the offsets keep their belief."""
        n, P = len(self.tangent), self.belief.covariance.copy()
        state = after_step(self.state(), step, U)
        mean = np.r_[state.mean, self.belief.mean[n:]]
        P[:n, :n] = state.covariance
        P[:n, n:] = step.slope @ P[:n, n:]
        P[n:, :n] = P[:n, n:].T
        return RepeatedView(self.tangent, Belief(mean, P))


def begin_repeated_view(
    model: ObservationModel, free: Belief, state: Belief, tangent: Array
) -> RepeatedView:
    """Return a view at its second frame; the offsets have mean 0.

    Args:
        model: the observation of both frames.
        free: the prediction for the second frame, without limits.
        state: belief whose covariance is the range over which the mean squares of the linearisation
            error are taken; these are the offsets' variances.
        tangent: (n,) state at which the first frame was linearised.
    """
    over = linearise_over(model.predict, Belief(tangent, state.covariance), model.wraps)
    assert over.remainder is not None
    h, _ = model.predict(tangent)
    shift = np.nan_to_num(wrapped_difference(over.value, h, model.wraps))
    curvature = shift**2 + np.diag(over.remainder)
    n, m = len(tangent), len(curvature)
    P = np.zeros((n + m, n + m))
    P[:n, :n] = free.covariance
    P[n:, n:] = np.diag(curvature)
    return RepeatedView(tangent, Belief(np.r_[free.mean, np.zeros(m)], P))


def anchored_observation(model: ObservationModel, tangent: Array) -> LinearObservation:
    """Return an observation h(tangent) + H (x - tangent) + offset, linear in (x, offset) (n + m,).

    ``model`` gives h and H; ``tangent``: (n,) state at which it is linearised.
    """
    h, H = model.predict(tangent)
    at, slope = np.r_[tangent, np.zeros(len(h))], np.hstack([H, np.eye(len(h))])
    return LinearObservation(model.names, model.variances, model.wraps, at, h, slope)
