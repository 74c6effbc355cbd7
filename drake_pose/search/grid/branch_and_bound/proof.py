"""Proof that no pose of the grid has a smaller objective: branch and bound over the whole grid.

The branch and bound drops a partial pose only if no completion can be within a limit. So a complete
search without a find proves that the objective is greater than the limit everywhere, and one with
a find proves the best of it the best of all. The limit is raised step by step from 0 to just below
the best objective known: a bound is so proved even where time does not suffice for the whole.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.search.estimates import View
from drake_pose.search.grid.branch_and_bound.full_detail import BoundLimits
from drake_pose.search.grid.branch_and_bound.search import branch_and_bound
from drake_pose.search.grid.sampled_body import SampledBody

_FIRST_LIMIT = 8.0


@dataclass(frozen=True)
class Proof:
    """What is proved of an objective.

    Attributes:
        proved: whether no pose of the grid has a smaller objective than J.
        budget_spent: whether a limit on time or room ended the proof before that was settled.
        J: the smallest objective known [pixel].
        samples: (nodes,) the samples of a pose that has it.
        lower_bound: no pose of the grid has a smaller objective than this [pixel].
        states: how many partial poses were looked at.
    """

    proved: bool
    budget_spent: bool
    J: float
    samples: np.ndarray
    lower_bound: float
    states: int


def prove_optimal(
    body: SampledBody,
    views: Sequence[View],
    samples: np.ndarray,
    J: float,
    time_limit: float | None = None,
    states: int = 20_000,
    pairs: int = 1_000_000,
    poses: int = BoundLimits.poses,
    memory: int = BoundLimits.memory,
) -> Proof:
    """Prove a pose the best of the grid, or find the best.

    Args:
        body: the body.
        views: the silhouettes.
        samples: (nodes,) the samples of the best pose known.
        J: its objective [pixel].
        time_limit: it returns what it has after this time [s]; None: no limit.
        states: how many partial poses are kept after each node; more end the proof.
        pairs: the same of pairs of a partial pose and a pose of the next node.
        poses, memory: as in BoundLimits, the latter in bytes.
    """
    deadline = np.inf if time_limit is None else time.perf_counter() + time_limit
    limits = BoundLimits(states, pairs, poses, memory, deadline)
    best, bound, visited, J_limit, spent = samples, 0.0, 0, 0.0, False
    while bound < J:
        J_limit = min(J_limit, J - 1.0)
        found = branch_and_bound(body, views, J_limit, limits)
        visited += found.states
        if found.graph.best_J < J:
            J, best = found.graph.best_J, found.graph.central()
        bound = max(bound, min(J, found.lower_bound))
        if not found.complete:
            spent = found.limited
            break
        J_limit = max(_FIRST_LIMIT, 2.0 * J_limit)
    proved = bound >= J
    return Proof(proved, spent and not proved, J, best, bound, visited)
