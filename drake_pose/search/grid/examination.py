"""What an answer on a grid is worth: whether it is proved best, and what else looks the same.

A complete branch and bound without a find proves that J is greater than its limit everywhere. The
limit is raised from 0 to just below the best J known: a bound is proved whenever time ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.grid.branch_and_bound import branch_and_bound
from drake_pose.search.grid.pose_families import find_families, samples_at
from drake_pose.search.grid.sampled_body import SampledBody
from drake_pose.search.settings import BoundLimits

_FIRST_LIMIT = 8.0


@dataclass(frozen=True)
class ExaminationSettings:
    """Parameters of an examination.

    Args:
        proof_time_limit: the proof ends after this time [s], proved or not; None: no limit, 0: it
            is not tried. An answer with J = 0 needs none.
        family_time_limit: the same of the search for all poses as good; it then answers with those
            it has, and no joint is called determined.
        proof_poses: each step of the proof ends after so many poses of nodes are drawn: unlike a
            limit on time, with the same result on every machine.
        family_poses: the same of the search for all poses as good: about two seconds.
        memory: of each of the two, for what it keeps; it ends as if its time were over [byte].
        families: how many families are described at most.
        tolerance: as in ``find_families`` [pixel].

    Raises:
        SettingsError: if a value is out of its range.
    """

    proof_time_limit: float | None = None
    family_time_limit: float | None = None
    proof_poses: int = 25_000
    family_poses: int = 50_000
    memory: int = BoundLimits.memory
    families: int = 32
    tolerance: float | None = None

    def __post_init__(self) -> None:
        if self.tolerance is not None and not self.tolerance >= 0.0:
            raise SettingsError(f"tolerance must be 0 pixels or more, not {self.tolerance}")
        if self.families < 1:
            raise SettingsError(f"families must be 1 or more, not {self.families}")
        self.family_limits(), self.proof_limits()

    def family_limits(self) -> BoundLimits:
        """Those of the search for all poses as good."""
        return BoundLimits(
            poses=self.family_poses, memory=self.memory, time_limit=self.family_time_limit
        )

    def proof_limits(self) -> BoundLimits:
        """Those of the proof."""
        return BoundLimits(
            poses=self.proof_poses, memory=self.memory, time_limit=self.proof_time_limit
        )


def examine(
    body: SampledBody,
    views: Sequence[View],
    result: PoseEstimate,
    settings: ExaminationSettings,
    root_position: np.ndarray | None = None,
) -> PoseEstimate:
    """Examine what a search on a body's grid found.

    Returns:
        The result with ``lower_bound``, ``budget_spent`` and ``pose_set``; a
        better pose in place of the one found if the proof met one. Nothing found stays as it is.

    Raises:
        SettingsError: if the result is not of the body's grid.
    """
    if not result.found:
        return result
    if root_position is not None:
        body = body.with_root_position(root_position)
    samples = samples_at(body.sampled, result.node_values)
    if samples is None:
        raise SettingsError("the pose to be examined is not on the body's sampling grid")
    J, lower_bound, spent = result.J, 0.0, result.J > 0.0
    if J > 0.0 and settings.proof_time_limit != 0.0:
        proof = prove_optimal(body, views, samples, J, settings.proof_limits())
        samples, J, lower_bound = proof.samples, proof.J, proof.lower_bound
        spent = proof.budget_spent
    answer = find_families(
        body, views, samples, J, settings.tolerance, settings.families, settings.family_limits()
    )
    best = answer.families[0]
    J = min(J, best.J)
    if J < result.J:
        q, X_WB, values = best.q, best.X_WB, best.node_values
        result = replace(result, q=q, X_WB=X_WB, node_values=values, J=J)
    # A complete set has all that is as good or better.
    lower_bound = J if answer.complete else min(lower_bound, J)
    return replace(
        result,
        lower_bound=lower_bound,
        budget_spent=answer.budget_spent or (spent and lower_bound < J),
        pose_set=answer,
    )


@dataclass(frozen=True)
class Proof:
    """What is proved of an objective.

    Attributes:
        proved: whether no pose of the grid has a smaller objective than J.
        budget_spent: whether a limit on time or room ended the proof before that was settled.
        samples: (nodes,) the samples of a pose that has it.
        lower_bound: no pose of the grid has a smaller objective than this [pixel].
    """

    proved: bool
    budget_spent: bool
    J: float
    samples: np.ndarray
    lower_bound: float


def prove_optimal(
    body: SampledBody,
    views: Sequence[View],
    samples: np.ndarray,
    J: float,
    limits: BoundLimits | None = None,
) -> Proof:
    """Prove a pose, samples (nodes,) with objective J [pixel], the best of the grid; or find it."""
    limits = limits or BoundLimits()
    deadline = limits.deadline
    best, bound, J_limit, spent = samples, 0.0, 0.0, False
    while bound < J:
        J_limit = min(J_limit, J - 1.0)
        found = branch_and_bound(body, views, J_limit, limits, deadline=deadline)
        if found.graph.best_J < J:
            J, best = found.graph.best_J, found.graph.central()
        bound = max(bound, min(J, found.lower_bound))
        if not found.complete:
            spent = found.limited
            break
        J_limit = max(_FIRST_LIMIT, 2.0 * J_limit)
    proved = bound >= J
    return Proof(proved, spent and not proved, J, best, bound)
