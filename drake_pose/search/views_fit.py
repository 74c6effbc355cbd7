"""The robust fit of one instant's silhouettes, however damaged, and what silhouettes leave open.

Where neither scale nor distance of a body is known, lengths in a picture are only told by the
silhouettes themselves: the unit of length is the root of their mean area.

How far a right pose may be off is told by its covariance. Whether another pose fits as well is told
by other optima: those as good are families of their own. Exact masks, drawn by pixels, and damaged
masks or bodies that fit badly are treated apart (``find_intervals``, ``RobustFamilies``).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from drake_pose.body import PoseTree, nearest_turn
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.fit.contour_fit import (
    FINEST_SCALE,
    ContourFit,
    Noise,
    Views,
    pack_views,
)
from drake_pose.fit.covariance import (
    Distances,
    ErrorSizes,
    distances,
    error_unit,
    estimate_sizes,
    excess,
    values_covariance,
)
from drake_pose.fit.evidence import find_edge_points
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.search.estimates import (
    JointEstimate,
    PoseEstimate,
    PoseFamily,
    PoseSet,
    View,
    joint_estimates,
)
from drake_pose.search.refinement import FINE_PASSES, RefinementProblem
from drake_pose.search.self_motions import Flip, flips
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
        return float(sums[..., Sum.COST].sum()) / self._scale(step) ** 2

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


# A value is free whose interval is wider than this on either side, angle [rad] and length [m].
_WIDEST = math.radians(10.0), 0.02


class _Family(NamedTuple):
    """A pose (m,), the ends (m,) of what its values may be, and how many poses are in it."""

    values: np.ndarray
    low: np.ndarray
    high: np.ndarray
    size: int = 1


def _widest(kinematics: TreeKinematics) -> np.ndarray:
    """(m,) how wide the intervals of determined values are at most."""
    return 2.0 * np.where(kinematics.is_angle, *_WIDEST)


def _describe(
    kinematics: TreeKinematics,
    tree: PoseTree,
    families: Sequence[_Family],
    Js: Sequence[float],
    tolerance: float,
    is_known: bool,
) -> PoseSet:
    """The set of families, the best first; where it is not known, no value is determined."""

    def joints(some: Sequence[_Family]) -> tuple[JointEstimate, ...]:
        # All in the turns nearest to the first one.
        first = some[0].values
        turns = [kinematics.nearest_turns(one.values, first) - one.values for one in some]
        lower, upper = kinematics.reach(first)
        low = np.maximum(np.min([one.low for one in some] + np.array(turns), axis=0), lower)
        high = np.minimum(np.max([one.high for one in some] + np.array(turns), axis=0), upper)
        determined = (high - low <= _widest(kinematics)) & is_known
        return joint_estimates(kinematics, low, high, determined)

    described = tuple(
        PoseFamily.of_values(tree, kinematics.split(one.values), J, joints([one]), one.size)
        for one, J in zip(families, Js, strict=True)
    )
    return PoseSet(described, joints(families), tolerance, False, len(described))


def covariance_pose_set(
    tree: PoseTree, pose: PoseEstimate, covariance: np.ndarray, pictures: int
) -> PoseSet:
    """What the covariance (m, m) of the tree's values says about a pose, where no other is sought.

    How large errors are was told by so many pictures.
    """
    kinematics = TreeKinematics(tree)
    values = kinematics.flatten(pose.node_values)
    widths = stdtrit(_CAMERA_MOTIONS * pictures, _ONE_SIDED) * np.sqrt(np.diag(covariance))
    lower, upper = kinematics.reach(values)
    family = _Family(values, np.maximum(values - widths, lower), np.minimum(values + widths, upper))
    described = _describe(kinematics, tree, [family], [pose.J], 0.0, True)
    # The tree may hold its root elsewhere.
    own = replace(described.families[0], q=pose.q, X_WB=pose.X_WB)
    return replace(described, families=(own,))


# Of exact masks.

CONFIDENCE = 0.95
"""How often the truth shall lie in a determined value's interval, where masks are exact."""

TOLERANCE, SAME = 0.03, 0.1
"""Poses are as good as the best whose J is larger by no more than this share of the contours'
length, and one whose values differ by no more than this [rad or m]."""

# The variance of a border that lies anywhere between two pixel centres [pixel^2].
_PIXEL_VARIANCE = 1.0 / 12.0
# How much larger the standard deviation is than if the distances of all rows and columns were
# independent; and the share of the contours' pixels that a pose which was found does not leave
# wrong: found on drawn bodies.
_NOISE_FACTOR, _MISFIT = 1.4, 0.025


def find_intervals(
    problem: RefinementProblem,
    others: Sequence[np.ndarray],
    parameters: np.ndarray,
    tree: PoseTree | None = None,
) -> tuple[PoseSet, np.ndarray]:
    """What exact silhouettes say of each value.

    Where more pixels are wrong than a found pose leaves, the pose may be another one altogether:
    nothing is known then. Where intervals missed the truth on drawn bodies, it was by another
    optimum, and no margin would have held it; about the true optimum they held 99 %.

    Args:
        problem: the silhouettes.
        others: (m + 4,) each: other poses that are as good, best first.
        parameters: (m + 4,) the best pose, refined.
        tree: the pose tree, with its root where the body is; None: the body's.

    Returns:
        The poses that are as good, the best leading the first family, and the covariance (m, m) of
        the tree's values about the best pose, 0 where they are held.
    """
    body, kinematics = problem.body, problem.body.kinematics
    count = len(kinematics.names)
    covariance = _covariance(problem, parameters)
    margins = float(ndtri(0.5 + 0.5 * CONFIDENCE)) * np.sqrt(np.diag(covariance))
    fits = problem.J(parameters) <= _MISFIT * problem.border_length
    near = np.maximum(margins, SAME)
    groups = [[parameters]]
    for other in others:
        # The same pose is not another one for a full turn.
        pose = body.nearest_turns(other, parameters)
        # What differs less is the same optimum, not quite reached.
        if np.abs(pose - parameters).max() <= SAME:
            continue
        of_group = (g for g in groups if np.all(np.abs(pose - g[0])[:count] <= near))
        group = next(of_group, None)
        if group is None:
            groups.append([pose])
        else:
            group.append(pose)
    families, Js = [], []
    for group in groups:
        first = body.nearest_turns(group[0])
        poses = [body.nearest_turns(member, first)[:count] for member in group]
        ends = np.min(poses, axis=0) - margins, np.max(poses, axis=0) + margins
        if not fits:
            ends = np.full(count, -np.inf), np.full(count, np.inf)
        families.append(_Family(poses[0], *ends, len(poses)))
        Js.append(float(problem.J(first)))
    tolerance = TOLERANCE * problem.border_length
    described = _describe(kinematics, tree or body.tree, families, Js, tolerance, fits)
    return described, covariance


def _covariance(problem: RefinementProblem, parameters: np.ndarray) -> np.ndarray:
    """The covariance (m, m) of the tree's values about the best pose."""
    body = problem.body
    free = body.freedom()
    equations = problem.equations(parameters, free, FINE_PASSES[-1])
    variance = max(_PIXEL_VARIANCE, equations.squares / max(equations.weight, 1e-9))
    variance *= _NOISE_FACTOR**2
    # Limits are worth what a value spread evenly between them is.
    spans = np.clip(body.upper[free.columns] - body.lower[free.columns], 1e-6, 2.0 * np.pi)
    information = equations.H[0] / variance + np.diag(12.0 / spans**2)
    covariance = np.zeros((len(body.kinematics.names),) * 2)
    covariance[np.ix_(free.columns, free.columns)] = np.linalg.inv(information)
    return covariance


# Of damaged masks, or where the body fits badly.

_LOOK = AnnealingStage(0.0125, 0.026, 2)
# What follows a value that is moved.
_FOLLOW = (AnnealingStage(0.025, 0.026, 2), AnnealingStage(0.0125, 0.026, 2))
# Distances that count less in the fit tell of errors, too.
_FINE = AnnealingStage(0.025, 0.0125)
# Poses are as good as the best whose cost is larger by no more than so many standard deviations of
# the difference; and at most so many families are told apart.
_SIGNIFICANCE, _FAMILIES = 1.96, 8
# A value that the covariance lets go so far is moved step by step, angle [rad] and length [m]:
# first as far as that; its longest step, and by what factor each step is longer.
_MOVED = math.radians(3.0), 0.01
_LONGEST_STEPS, _GROWTH = (0.5, 0.1), 1.6
# As often shall a value lie below the upper end of its interval, and above the lower one.
_ONE_SIDED = 0.975
# How large errors are is told by the motions of each camera.
_CAMERA_MOTIONS = 6
# A fit of which most does not fit can be wrong altogether: no robust estimate outlives that.
_BREAKDOWN = 0.5
_ROUNDING = 1e-9


class RobustFamilies:
    """The families of one match, where parts, masks and cameras err together.

    What no pose explains, such as a part that is missing in a mask, costs all poses alike and says
    nothing. A value that may go far is moved step by step, the others following, until what does
    not fit any more is significant.
    """

    def __init__(self, fit: ViewsFit, proceed: Callable[[], bool]) -> None:
        self._fit, self._kinematics, self._proceed = fit, fit.kinematics, proceed
        self._pieces, self._tolerance = np.zeros(0), 0.0
        self._sizes: ErrorSizes | None = None

    def find(self, poses: Sequence[FittedPose], J: Callable[[np.ndarray], float]) -> PoseSet:
        """The poses that fit as well as the best of some, the answer first; J (1) of values."""
        pieces = map_ordered(lambda pose: self._fit.piece_costs(pose.values, _LOOK), poses)
        self._pieces = min(pieces, key=lambda one: float(one.sum()))
        good = [
            pose.values for pose, one in zip(poses, pieces, strict=True) if self._is_as_good(one)
        ]
        families: list[_Family] = []
        for values in good or [poses[0].values]:
            if not self._is_in(families, values) and self._has_room(families):
                families.append(self._spread(values))
                self._add_flipped(families, families[-1])
        return self._described(families, [J(one.values) for one in families])

    def around(self, values: np.ndarray, J: float) -> PoseSet:
        """What the silhouettes say about one pose (m,), where no other is looked for."""
        self._pieces = self._fit.piece_costs(values, _LOOK)
        return self._described([self._spread(values, moves=False)], [J])

    def _described(self, families: Sequence[_Family], Js: Sequence[float]) -> PoseSet:
        broken = float(self._pieces.sum()) > _BREAKDOWN * 2.0 * self._fit.edge_length
        tree = self._kinematics.tree
        return _describe(self._kinematics, tree, families, Js, self._tolerance, not broken)

    def _is_as_good(self, pieces: np.ndarray) -> bool:
        """Whether costs by pieces are not significantly above the best pose's."""
        as_good = excess(pieces, self._pieces) <= _SIGNIFICANCE
        if as_good:
            self._tolerance = max(self._tolerance, float((pieces - self._pieces).sum()))
        return as_good

    def _has_room(self, families: Sequence[_Family]) -> bool:
        return not families or (len(families) < _FAMILIES and self._proceed())

    def _is_in(self, families: list[_Family], values: np.ndarray) -> bool:
        """Whether some family holds a pose; it is counted there.

        What is free in a family may be anything: that widens it.
        """
        for i, family in enumerate(families):
            near = self._kinematics.nearest_turns(values, family.values)
            outside = (near < family.low - _ROUNDING) | (near > family.high + _ROUNDING)
            if not np.any(outside & (family.high - family.low <= _widest(self._kinematics))):
                low, high = np.minimum(family.low, near), np.maximum(family.high, near)
                families[i] = _Family(family.values, low, high, family.size + 1)
                return True
        return False

    def _add_flipped(self, families: list[_Family], family: _Family) -> None:
        """Add what flips make of a family, as far as it fits."""

        def look(flip: Flip) -> tuple[np.ndarray, np.ndarray]:
            seen = self._fit.refine(flip.values, (_LOOK,)).values
            return seen, self._fit.piece_costs(seen, _LOOK)

        others = flips(self._kinematics, family.values) if self._has_room(families) else []
        for flip, (seen, pieces) in zip(others, map_ordered(look, others), strict=True):
            if not self._has_room(families):
                return
            if self._is_as_good(pieces) and not self._is_in(families, seen):
                values = self._kinematics.nearest_turns(seen)
                families.append(self._flipped(family, flip, values))

    def _flipped(self, family: _Family, flip: Flip, values: np.ndarray) -> _Family:
        """A family after a flip, about a pose (m,): an interval flips as its middle does."""
        below, above = family.values - family.low, family.high - family.values
        lower, upper = self._kinematics.reach(family.values)
        # Where a limit ended the interval, the flipped one may go further.
        below = np.where(flip.changed & (family.low <= lower + _ROUNDING), math.inf, below)
        above = np.where(flip.changed & (family.high >= upper - _ROUNDING), math.inf, above)
        swapped = np.where(flip.mirrored, [above, below], [below, above])
        lower, upper = self._kinematics.reach(values)
        low, high = values - swapped[0], values + swapped[1]
        return _Family(values, np.maximum(low, lower), np.minimum(high, upper))

    def _spread(self, values: np.ndarray, moves: bool = True) -> _Family:
        """What the values (m,) may be about a pose; unless it moves them, by covariance alone."""
        kinematics = self._kinematics
        lower, upper = kinematics.reach(values)
        free = np.flatnonzero(upper > lower)
        seen = self._fit.distances(values, _FINE)
        if self._sizes is None:
            self._sizes = estimate_sizes(seen, kinematics.is_angle)
        covariance = values_covariance(seen, self._sizes, free, kinematics.is_angle)
        low, high = values.copy(), values.copy()
        freedom = _CAMERA_MOTIONS * self._fit.camera_count
        widths = stdtrit(freedom, _ONE_SIDED) * np.sqrt(np.diag(covariance))
        low[free], high[free] = values[free] - widths, values[free] + widths
        wide = widths > np.where(kinematics.is_angle[free], *_MOVED)

        def move(way: tuple[int, float]) -> list[np.ndarray]:
            column, sign = way
            along = np.zeros(len(values))
            along[free] = sign * covariance[:, column] / covariance[column, column]
            return self._move(values, int(free[column]), along, float(widths[column]))

        # Where the covariance lets a value go to its limit it need not be moved.
        ways = [
            (column, sign)
            for column in np.flatnonzero(wide & moves).tolist()
            for sign, open_end in ((-1.0, low > lower), (1.0, high < upper))
            if open_end[free[column]]
        ]
        found = [values, *itertools.chain.from_iterable(map_ordered(move, ways))]
        # Poses found while one value was moved show what others may be, too.
        moved = free[wide]
        low[moved] = np.minimum(low[moved], np.min(found, axis=0)[moved])
        high[moved] = np.maximum(high[moved], np.max(found, axis=0)[moved])
        return _Family(values, np.maximum(low, lower), np.minimum(high, upper))

    def _move(
        self, values: np.ndarray, index: int, along: np.ndarray, width: float
    ) -> list[np.ndarray]:
        """Poses (m,) that fit as well, a value moved from some, the others following along (m,).

        ``width``: how far the value may go in any case.
        """
        longest = _LONGEST_STEPS[0 if self._kinematics.is_angle[index] else 1]
        lower, upper = self._kinematics.lower.copy(), self._kinematics.upper.copy()
        # Beyond half a turn the values come back from the other side.
        lower[index], upper[index] = (ends[index] for ends in self._kinematics.reach(values))
        step, found, worse = width, [values], 0.0
        while lower[index] < found[-1][index] < upper[index] and self._proceed():
            trial = np.clip(found[-1] + min(step, longest) * along, lower, upper)
            looked = self._fit.refine(trial, _FOLLOW, held=(index,)).values
            costs = self._fit.piece_costs(looked, _LOOK)
            before, worse = worse, excess(costs, self._pieces)
            if worse > _SIGNIFICANCE:
                # Costs are parabolas in the rough, and their differences scatter as values differ.
                share = (_SIGNIFICANCE - before) / (worse - before)
                return [*found, found[-1] + share * (looked - found[-1])]
            found.append(looked)
            step *= _GROWTH
        return found
