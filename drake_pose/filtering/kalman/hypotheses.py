"""Several explanations of the same pictures, weighed against each other."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.filtering.kalman.repeated_views import RepeatedView
from drake_pose.filtering.state import Belief

Array = NDArray[np.float64]


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
