"""Static views: successive frames that show the same measurement within noise.

A filter that linearises anew in each frame of a static view becomes overconfident (Shimada et al.,
section 7), because the linearisation error is the same in all its frames. Here a view keeps the
tangent of its first frame. The linearisation error is estimated beside the state as an unknown
offset of each measurement, with the size of the curvature at the first frame, and dropped when the
view ends.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from drake_pose.arrays import Array
from drake_pose.filtering.linearisation import Linear, wrapped_difference
from drake_pose.filtering.state import Belief, factor_of
from drake_pose.filtering.update import LinearObservation, Measurement, ObservationModel


@dataclass(frozen=True, eq=False)
class StaticView:
    """A static view."""

    reference: Array  # (m,) measurement of its first frame, NaN where occluded.
    count: int  # Number of its frames so far.


def next_view(view: StaticView | None, measurement: Measurement, significance: float) -> StaticView:
    """Return the static view that a measurement belongs to: the current one, or a new one.

    A view is new if a measurement becomes visible, if no measurement is visible in both frames, or
    if the difference from the view's reference is significant.

    ``view``: the current view; None: there is none. ``measurement``: the next frame's measurement.
    ``significance``: p-value of the difference, under noise alone, below which a view is new; 0:
    every view is new.
    """
    y = measurement.y
    if view is None or significance == 0 or len(view.reference) != len(y):
        return StaticView(y, 1)
    change = wrapped_difference(y, view.reference, measurement.model.wraps)
    both = np.isfinite(change)
    new_rows = np.isfinite(y) & ~np.isfinite(view.reference)
    if new_rows.any() or not both.any():
        return StaticView(y, 1)
    size = float(np.sum(change[both] ** 2 / (2.0 * np.diag(measurement.covariance)[both])))
    is_new = size > _largest_change(significance, int(np.count_nonzero(both)))
    return StaticView(y, 1) if is_new else StaticView(view.reference, view.count + 1)


@lru_cache(maxsize=1024)
def _largest_change(significance: float, count: int) -> float:
    """Return the chi-squared value with ``count`` degrees of freedom and this p-value."""
    return float(chdtri(count, significance))


def measure_curvature(model: ObservationModel, belief: Belief) -> Array:
    """Return the mean squares (m,) of the linearisation error of a model's measurements.

    The model is linearised at the mean of ``belief``, over which the mean is taken. By second
    differences along the columns of the covariance's root.
    """
    h, H = model.predict(belief.mean)
    used = np.flatnonzero(np.abs(H).sum(axis=0) > 0)
    root = factor_of(belief.covariance[np.ix_(used, used)])
    total = np.zeros(len(h))
    for column in root.T:
        step = np.zeros_like(belief.mean)
        step[used] = column
        ends = [model.predict(belief.mean + sign * step)[0] for sign in (1.0, -1.0)]
        bend = 0.5 * sum(wrapped_difference(end, h, model.wraps) for end in ends)
        # E[(b z^2)^2] = 3 b^2 for a standard normal z.
        total += 3.0 * np.nan_to_num(bend) ** 2
    return total


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
    """Return a view at its second frame; the offsets have mean 0 and the curvature as variance.

    Args:
        model: the observation of both frames.
        free: the prediction for the second frame, without limits.
        state: belief whose covariance is the range over which the curvature is measured.
        tangent: (n,) state at which the first frame was linearised.
    """
    curvature = measure_curvature(model, Belief(tangent, state.covariance))
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
