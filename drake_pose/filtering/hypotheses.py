"""Several explanations of the same pictures, weighed against each other, each within a view.

The same view for long teaches nothing new: what one view may tell in all, and no more. A filter
linearised anew in every frame of a static view becomes ever surer: the flaw that Shimada et al.
state in section 7. Here a view keeps the tangent of its first frame; what that leaves out is an
offset of each measurement, unknown, the same in all frames of the view, of the size of the
curvature at its first frame, estimated beside the state and forgotten when the view ends.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from drake_pose.arrays import Array
from drake_pose.filtering.state import Belief, factor_of
from drake_pose.filtering.update import (
    Evidence,
    LinearObservation,
    ObservationModel,
    difference,
)

# E[(b z^2)^2] = 3 b^2 for a standard normal z.
_FOURTH_MOMENT = 3.0


@dataclass(frozen=True, eq=False)
class View:
    """Frames that show the same: the measurement (m,) of the first, and how many."""

    reference: Array
    count: int


def next_view(view: View | None, seen: Evidence, significance: float) -> View:
    """The view a measurement belongs to: the one so far, or one that begins with it.

    Args:
        significance: a view is new when noise alone would make it differ so much from the reference
            with no more than this probability; 0: every one is new.
    """
    y = seen.y
    if view is None or significance == 0 or len(view.reference) != len(y):
        return View(y, 1)
    change = difference(y, view.reference, seen.model.wraps)
    both = np.isfinite(change)
    new_rows = np.isfinite(y) & ~np.isfinite(view.reference)
    if new_rows.any() or not both.any():
        return View(y, 1)
    size = float(np.sum(change[both] ** 2 / (2.0 * np.diag(seen.covariance)[both])))
    is_new = size > _largest_change(significance, int(np.count_nonzero(both)))
    return View(y, 1) if is_new else View(view.reference, view.count + 1)


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
        total += _FOURTH_MOMENT * np.nan_to_num(bend) ** 2
    return total


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

    def moved(self, A: Array, U: Array) -> "RepeatedView":
        """One step at constant velocity; the offsets stay as they are."""
        n, P = len(self.tangent), self.belief.covariance.copy()
        mean = np.r_[A @ self.belief.mean[:n], self.belief.mean[n:]]
        P[:n, :n] = self.state().moved(A, U).covariance
        P[:n, n:] = A @ P[:n, n:]
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


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One explanation.

    Attributes:
        belief: mean and covariance, inside the limits.
        free: what is believed without the present limits; the next step is predicted from it.
        log_weight: logarithm of its weight among all.
        log_evidence: the same without what the present limits say of it.
        born: the step it was made at by mirroring; 0 for the first.
        place: which of those made at that step it is: both tell it from all others.
        active: names of the rows that cut its belief in the last step.
        sites: of the last truncation, where the next one begins; see ``Truncated``.
        tangent: (n,) where the first frame of the present view was linearised.
        repeated: what is believed within a view that lasts; None in its first frame.
    """

    belief: Belief
    free: Belief
    log_weight: float = 0.0
    log_evidence: float = 0.0
    born: int = 0
    place: int = 0
    active: tuple[str, ...] = ()
    sites: Array = field(default_factory=lambda: np.zeros((0, 2)))
    tangent: Array = field(default_factory=lambda: np.zeros(0))
    repeated: RepeatedView | None = None

    @property
    def weight(self) -> float:
        """Between 0 and 1."""
        return math.exp(self.log_weight)


@dataclass(frozen=True)
class Rejection:
    """A hypothesis that was given up.

    Attributes:
        hypothesis: as it was then; for a constraint its belief is that without the limits.
        reason: "constraint", "weight", "twin" or "cap".
        row: the violated inequality's name, for a constraint.
        c: its c_k (24), for a constraint.
    """

    step: int
    hypothesis: Hypothesis
    reason: str
    row: str = ""
    c: float = math.nan


def normalise(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The same with weights that add up to 1, the heaviest first."""
    ordered = sorted(hypotheses, key=lambda h: -h.log_weight)
    logs = np.array([h.log_weight for h in ordered])
    total = logs[0] + math.log(np.exp(logs - logs[0]).sum())
    return [
        replace(h, log_weight=h.log_weight - total, log_evidence=h.log_evidence - total)
        for h in ordered
    ]


def merge_twins(
    hypotheses: Sequence[Hypothesis], distance: float, step: int
) -> tuple[list[Hypothesis], list[Rejection]]:
    """Keep the heavier of any two nearer than so many deviations, with the weight of both."""
    kept: list[Hypothesis] = []
    rejected = []
    for candidate in hypotheses:
        for place, other in enumerate(kept):
            scale = np.maximum(other.belief.deviations(), 1e-12)
            if np.abs((candidate.belief.mean - other.belief.mean) / scale).max() < distance:
                both = float(np.logaddexp(other.log_weight, candidate.log_weight))
                gain = both - other.log_weight
                kept[place] = replace(
                    other, log_weight=both, log_evidence=other.log_evidence + gain
                )
                rejected.append(Rejection(step, candidate, "twin"))
                break
        else:
            kept.append(candidate)
    return kept, rejected


def prune(
    hypotheses: Sequence[Hypothesis], cap: int, smallest_weight: float, step: int
) -> tuple[list[Hypothesis], list[Rejection]]:
    """Keep at most ``cap``, and none lighter than ``smallest_weight``; always the heaviest."""
    ordered = normalise(hypotheses)
    kept = [h for h in ordered[1:cap] if h.weight >= smallest_weight]
    rejected = [
        Rejection(step, h, "weight" if h.weight < smallest_weight else "cap")
        for place, h in enumerate(ordered)
        if place and h not in kept
    ]
    return normalise([ordered[0], *kept]), rejected
