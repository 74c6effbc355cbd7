"""What an answer on a grid is worth: whether it is proved best, and what else looks the same.

A complete branch and bound without a find proves that J is greater than its limit everywhere: just
below the best J known. One that is not leaves a smaller bound.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.grid.branch_and_bound import PosesWithin, branch_and_bound
from drake_pose.search.grid.pose_families import find_families, samples_at
from drake_pose.search.grid.sampled_body import SampledBody
from drake_pose.search.settings import BoundLimits


@dataclass(frozen=True)
class ExaminationSettings:
    """Parameters of an examination.

    Args:
        proof_time_limit: the proof ends after this time [s], proved or not; None: no limit, 0: it
            is not tried. An answer with J = 0 needs none.
        family_time_limit: the same of the search for all poses as good; it then answers with those
            it has, and no joint is called determined.
        proof_poses: the proof ends after so many poses of nodes are drawn: unlike a
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
        self.limits("family"), self.limits("proof")

    def limits(self, step: str) -> BoundLimits:
        """Those of the "proof", or of the search for all poses as good, of a "family"."""
        poses, seconds = getattr(self, f"{step}_poses"), getattr(self, f"{step}_time_limit")
        return BoundLimits(poses=poses, memory=self.memory, time_limit=seconds)


def examine(
    body: SampledBody,
    views: Sequence[View],
    result: PoseEstimate,
    settings: ExaminationSettings,
    root_position: np.ndarray | None = None,
    within: PosesWithin | None = None,
) -> PoseEstimate:
    """The result, or a better pose, with ``lower_bound``, ``budget_spent`` and ``pose_set``.

    ``within``: all poses within a tolerance of exactness, where the search has found them.

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
    if within is None and J > 0.0 and settings.proof_time_limit != 0.0:
        better = branch_and_bound(body, views, J - 1.0, settings.limits("proof"))
        if better.graph.best_J < J:
            J, samples = better.graph.best_J, better.graph.central()
        lower_bound, spent = J if better.complete else better.lower_bound, better.limited
    answer = find_families(
        body, views, samples, J, settings.tolerance, settings.families, settings.limits("family"),
        within if settings.tolerance is None else None,
    )  # fmt: skip
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
