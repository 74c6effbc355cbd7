"""What an answer on a grid is worth: whether it is proved best, and what else looks the same.

The search is quick because it drops poses by guess. What it finds is examined afterwards: bounds
over the whole grid prove it best or find a better one (``proof``), and all poses as good as it are
gathered (``family_search``), each within its own time.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.grid.branch_and_bound.full_detail import BoundLimits
from drake_pose.search.grid.branch_and_bound.proof import prove_optimal
from drake_pose.search.grid.families.search import FamilySettings, find_families, samples_at
from drake_pose.search.grid.sampled_body import SampledBody


@dataclass(frozen=True)
class ExaminationSettings:
    """Parameters of an examination.

    Args:
        proof_time_limit: the proof ends after this time [s], proved or not; None: no limit, 0: it
            is not tried. An answer with J = 0 needs none.
        family_time_limit: the same of the search for all poses as good; it then answers with those
            it has, and no joint is called determined.
        proof_poses: each step of the proof ends after this many poses of nodes are drawn, which
            takes nearly all its time: about a second by default. Unlike a limit on time, it gives
            the same result on every machine.
        family_poses: the same of the search for all poses as good: about two seconds.
        memory: of each of the two, for what it keeps; it ends as if its time were over [byte].
        families: how many families are described at most.
        tolerance: as in ``FamilySettings``.

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
        for name in ("proof_time_limit", "family_time_limit"):
            limit = getattr(self, name)
            if limit is not None and not (math.isfinite(limit) and limit >= 0.0):
                raise SettingsError(f"{name} must be 0 s or more, not {limit}")
        if self.proof_poses < 1:
            raise SettingsError(f"proof_poses must be 1 or more, not {self.proof_poses}")
        self.family_settings()

    def family_settings(self) -> FamilySettings:
        """Those of the search for families."""
        return FamilySettings(
            tolerance=self.tolerance,
            families=self.families,
            poses=self.family_poses,
            time_limit=self.family_time_limit,
            memory=self.memory,
        )


def examine(
    body: SampledBody,
    views: Sequence[View],
    result: PoseEstimate,
    settings: ExaminationSettings,
    root_position: np.ndarray | None = None,
) -> PoseEstimate:
    """Examine what a search on a body's grid found.

    Args:
        body: the body whose grid was searched.
        views: the silhouettes.
        result: what was found in them.
        settings: the parameters.
        root_position: (3,) as the search was given it [m].

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
        proof = prove_optimal(
            body,
            views,
            samples,
            J,
            settings.proof_time_limit,
            poses=settings.proof_poses,
            memory=settings.memory,
        )
        samples, J, lower_bound = proof.samples, proof.J, proof.lower_bound
        spent = proof.budget_spent
    answer = find_families(body, views, samples, J, settings.family_settings())
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
