"""The pose of one instant's silhouettes, however damaged, in the unit of their own size.

Where neither scale nor distance of a body is known, lengths in a picture are only told by the
silhouettes themselves: the unit of length is the root of their mean area.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Lock

import numpy as np

from drake_pose.body.parsed_model import nearest_turn
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.fit.camera_sums import Views
from drake_pose.fit.contour_fit import (
    FINEST_SCALE,
    ContourFit,
    Noise,
    pack_views,
)
from drake_pose.fit.covariance import Distances, distances, error_unit
from drake_pose.fit.evidence import find_edge_points
from drake_pose.fit.kernel import COST
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.search.estimates import View
from drake_pose.silhouette.areas.outline import Outline
from drake_pose.workers import map_ordered

_STEPS = StepSettings(longest=0.3, damping=1e-2, even_damping=1e-3)
# Rounds that sample the body's contour so far apart or more are rough. From one point of a
# silhouette's edge to the next, as a share of its size, in rough rounds and in others.
_ROUGH, _EDGE_SPACINGS = 0.026, (1.0 / 50.0, 1.0 / 80.0)
# What is missing or too much is about as large, as a share of the silhouettes' size.
_PIECE = 0.2


@dataclass(frozen=True)
class FittedPose:
    """Fitted values (m,), and what does not fit [pixel], comparable at one scale and spacing."""

    values: np.ndarray
    cost: float


class ViewsFit:
    """One body and the silhouettes of one instant.

    Attributes:
        size: the root of the silhouettes' mean area [pixel], the unit of length of all rounds.
        edge_length: the length of the silhouettes' edges [pixel].
        evaluations: how often contours were compared.

    Args:
        outlines: a surface for each node; few triangles will do, see ``few_triangles``.
        rough: those of rough rounds, of fewer triangles; None: the same.
    """

    def __init__(
        self,
        kinematics: TreeKinematics,
        outlines: tuple[Outline, ...],
        views: Sequence[View],
        rough: tuple[Outline, ...] | None = None,
    ) -> None:
        self.kinematics = kinematics
        self.size = math.sqrt(float(np.mean([np.count_nonzero(view.mask) for view in views])))
        # A pixel of contour counts one, whatever its noise: the cost is in pixels.
        even = Noise(deviation=1.0, correlation=0.5 / self.size**3)
        cameras = [view.camera for view in views]
        self._levels = []
        for surfaces, share in zip((rough or outlines, outlines), _EDGE_SPACINGS, strict=True):
            spacing = max(1.0, share * self.size // 1.0)
            edges = [find_edge_points(view.mask, spacing) for view in views]
            fit = ContourFit(kinematics, surfaces, even, _STEPS, pixels=self.size)
            self._levels.append((fit, pack_views(cameras, edges)))
        self.edge_length = max(1.0, float(self._levels[-1][1].evidence.lengths.sum()))
        self.camera_count = len(views)
        self.evaluations, self._counting = 0, Lock()

    def cost(self, values: np.ndarray, step: AnnealingStage) -> float:
        """What does not fit at values (m,) [pixel]."""
        self._count(1)
        fit, views = self._level(step)
        sums = fit.compare(views, values, step).sums
        return float(sums[..., COST].sum()) / self._scale(step) ** 2

    def distances(self, values: np.ndarray, step: AnnealingStage) -> Distances:
        """What is left of the contours' distances at values (m,)."""
        self._count(1)
        fit, views = self._level(step)
        compared = fit.compare(views, values, step)
        moves, unit = compared.placement.dense(len(values)), error_unit(self.size)
        return distances(fit.outlines, views.cameras, compared, moves, unit)

    def piece_costs(self, values: np.ndarray, step: AnnealingStage) -> np.ndarray:
        """What does not fit at values (m,), by pieces of the pictures that err on their own."""
        self._count(1)
        side = max(1.0, _PIECE * self.size)
        fit, views = self._level(step)
        costs = fit.piece_costs(views, values, step, side)
        return costs / self._scale(step) ** 2

    def refine(
        self, values: np.ndarray, rounds: Sequence[AnnealingStage], held: Sequence[int] = ()
    ) -> FittedPose:
        """Refine values (m,), but for some that are held, by indices."""
        fixed = self.kinematics.upper <= self.kinematics.lower
        fixed[list(held)] = True
        fit, views = self._level(rounds[-1])
        found = fit.fit(views, values, rounds, None, fixed)
        self._count(found.evaluations)
        return FittedPose(found.values, found.cost / self._scale(rounds[-1]) ** 2)

    def _level(self, step: AnnealingStage) -> tuple[ContourFit, Views]:
        """The fit and the views as finely as a step looks at them."""
        return self._levels[step.spacing < _ROUGH]

    def _count(self, evaluations: int) -> None:
        with self._counting:  # Threads fit side by side.
            self.evaluations += evaluations

    def _scale(self, step: AnnealingStage) -> float:
        return max(FINEST_SCALE, step.scale * self.size)


def refine_best(
    fit: ViewsFit,
    starts: Sequence[np.ndarray],
    parts: Sequence[tuple[Sequence[AnnealingStage], int]],
    proceed: Callable[[], bool],
) -> list[FittedPose]:
    """Refine many poses, after each pass only the best of those that still differ.

    Args:
        starts: each (m,), best first.
        parts: rounds, and how many poses are kept after each.

    Returns:
        The poses kept after the last pass, best first; at least one.
    """
    values = list(starts)
    kept: list[FittedPose] = []
    for rounds, count in parts:
        found = map_ordered(partial(_refined, fit, rounds, proceed), enumerate(values))
        refined = [one for one in found if one is not None]
        kept = distinct(refined, count, fit.kinematics.turns_around)
        values = [pose.values for pose in kept]
    return kept


def _refined(
    fit: ViewsFit,
    rounds: Sequence[AnnealingStage],
    proceed: Callable[[], bool],
    start: tuple[int, np.ndarray],
) -> FittedPose | None:
    """The how manieth start (m,) refined; the first in any case, others while there is time."""
    return fit.refine(start[1], rounds) if start[0] == 0 or proceed() else None


def distinct(
    poses: Sequence[FittedPose],
    count: int,
    turns_around: np.ndarray | bool = False,
    apart: float = 0.05,
) -> list[FittedPose]:
    """The best poses some value of which is more than ``apart`` [rad or m] from better ones.

    ``turns_around``: (m,) the values that are the same after a full turn.
    """
    chosen: list[FittedPose] = []
    for pose in sorted(poses, key=lambda one: one.cost):
        gaps = (
            nearest_turn(pose.values, other.values, turns_around) - other.values for other in chosen
        )
        if all(np.abs(gap).max(initial=0.0) > apart for gap in gaps):
            chosen.append(pose)
        if len(chosen) >= count:
            break
    return chosen
