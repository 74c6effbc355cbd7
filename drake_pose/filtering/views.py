"""One view for long: frames that show the same teach nothing new.

What one view may tell in all, and no more. A filter linearised anew in every frame of a static view
becomes ever surer: the flaw that Shimada et al. state in section 7. Here a view keeps the tangent
of its first frame; what that leaves out is an offset of each measurement, unknown, the same in all
frames of the view, of the size of the curvature at its first frame, estimated beside the state and
forgotten when the view ends.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from drake_pose.arrays import Array
from drake_pose.filtering.linearisation import Linear, difference
from drake_pose.filtering.state import Belief, factor_of
from drake_pose.filtering.update import LinearObservation, Measurement, ObservationModel


@dataclass(frozen=True, eq=False)
class StaticView:
    """Frames that show the same: the measurement (m,) of the first, and how many."""

    reference: Array
    count: int


def next_view(view: StaticView | None, seen: Measurement, significance: float) -> StaticView:
    """The view a measurement belongs to: the one so far, or one that begins with it.

    Args:
        significance: a view is new when noise alone would make it differ so much from the reference
            with no more than this probability; 0: every one is new.
    """
    y = seen.y
    if view is None or significance == 0 or len(view.reference) != len(y):
        return StaticView(y, 1)
    change = difference(y, view.reference, seen.model.wraps)
    both = np.isfinite(change)
    new_rows = np.isfinite(y) & ~np.isfinite(view.reference)
    if new_rows.any() or not both.any():
        return StaticView(y, 1)
    size = float(np.sum(change[both] ** 2 / (2.0 * np.diag(seen.covariance)[both])))
    is_new = size > _largest_change(significance, int(np.count_nonzero(both)))
    return StaticView(y, 1) if is_new else StaticView(view.reference, view.count + 1)


@lru_cache(maxsize=1024)
def _largest_change(significance: float, count: int) -> float:
    return float(chdtri(count, significance))


def measure_curvature(model: ObservationModel, belief: Belief) -> Array:
    """(m,) mean square of what the tangent at a belief's mean leaves out of a measurement.

    By second differences along the columns of the covariance's root.
    """
    h, H = model.predict(belief.mean)
    used = np.flatnonzero(np.abs(H).sum(axis=0) > 0)
    root = factor_of(belief.covariance[np.ix_(used, used)])
    total = np.zeros(len(h))
    for column in root.T:
        step = np.zeros_like(belief.mean)
        step[used] = column
        ends = [model.predict(belief.mean + sign * step)[0] for sign in (1.0, -1.0)]
        bend = 0.5 * sum(difference(end, h, model.wraps) for end in ends)
        # E[(b z^2)^2] = 3 b^2 for a standard normal z.
        total += 3.0 * np.nan_to_num(bend) ** 2
    return total


def moved(belief: Belief, step: Linear, U: Array) -> Belief:
    """The belief (6) after a step with noise of covariance U (n, n)."""
    noise = U if step.rest is None else U + step.rest
    P = step.slope @ belief.covariance @ step.slope.T + noise
    return Belief(step.value + step.slope @ (belief.mean - step.at), 0.5 * (P + P.T))


@dataclass(frozen=True, eq=False)
class RepeatedView:
    """What is believed within a view: the state, and beside it the tangent's offsets.

    Attributes:
        tangent: (n,) where the view's first frame was linearised.
        belief: over n + m numbers: the state, then what the tangent leaves out of each measurement.
    """

    tangent: Array
    belief: Belief

    def state(self) -> Belief:
        """The belief about the state alone."""
        n = len(self.tangent)
        return Belief(self.belief.mean[:n].copy(), self.belief.covariance[:n, :n].copy())

    def moved(self, step: Linear, U: Array) -> "RepeatedView":
        """A step with noise of covariance U (n, n); the offsets stay as they are."""
        n, P = len(self.tangent), self.belief.covariance.copy()
        state = moved(self.state(), step, U)
        mean = np.r_[state.mean, self.belief.mean[n:]]
        P[:n, :n] = state.covariance
        P[:n, n:] = step.slope @ P[:n, n:]
        P[n:, :n] = P[:n, n:].T
        return RepeatedView(self.tangent, Belief(mean, P))


def begin_repeated_view(
    model: ObservationModel, free: Belief, seen: Belief, tangent: Array
) -> RepeatedView:
    """A view's second frame: nothing is known yet of the offsets but how large they may be.

    Args:
        free: the prediction of the second frame, without its limits.
        seen: how far the state may be from the tangent, where the curvature is measured.
        tangent: (n,) where the first frame was linearised.
    """
    curvature = measure_curvature(model, Belief(tangent, seen.covariance))
    n, m = len(tangent), len(curvature)
    P = np.zeros((n + m, n + m))
    P[:n, :n] = free.covariance
    P[n:, n:] = np.diag(curvature)
    return RepeatedView(tangent, Belief(np.r_[free.mean, np.zeros(m)], P))


def anchored(model: ObservationModel, tangent: Array) -> LinearObservation:
    """A model held at the tangent (n,) of one state, with offsets: linear in both, (n + m,)."""
    h, H = model.predict(tangent)
    at, slope = np.r_[tangent, np.zeros(len(h))], np.hstack([H, np.eye(len(h))])
    return LinearObservation(model.names, model.variances, model.wraps, at, h, slope)
