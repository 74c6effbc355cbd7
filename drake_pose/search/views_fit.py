"""The robust fit of one instant's silhouettes, however damaged, and what silhouettes leave open.

Where neither scale nor distance of a body is known, lengths in a picture are only told by the
silhouettes themselves: the unit of length is the root of their mean area.

A covariance says how far a right pose may be off. Other optima show whether another pose fits as
well: those as good are modes of their own. Exact masks, drawn by pixels, and damaged
masks or bodies that fit badly are treated apart (``find_intervals``, ``RobustModes``).
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

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
    values_covariance,
    vuong_statistic,
)
from drake_pose.fit.evidence import find_edge_points
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.search.estimates import (
    JointEstimate,
    PoseEstimate,
    PoseMode,
    PoseSet,
    View,
    joint_estimates,
)
from drake_pose.search.self_motions import Flip, flips
from drake_pose.search.settings import RobustSettings
from drake_pose.silhouette.outline import Outline
from drake_pose.workers import map_ordered


class FittedPose(NamedTuple):
    """A pose found: values (m,), what does not fit [pixel], and what its values may be.

    Costs are comparable at one scale and spacing. ``low``, ``high``: (m,) the ends of intervals,
    where they are known; ``size``: how many poses are in it.
    """

    values: np.ndarray
    cost: float = 0.0
    low: np.ndarray = np.zeros(0)
    high: np.ndarray = np.zeros(0)
    size: int = 1


class ViewsFit:
    """One body and the silhouettes of one instant.

    Attributes:
        size: the root of the silhouettes' mean area [pixel], the unit of length of all rounds.
        edge_length: the length of the silhouettes' edges [pixel].
        evaluations: how often contours were compared.

    Args:
        outlines: a surface for each node; few triangles will do, see ``simplify_surfaces``.
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
        steps = StepSettings(longest=0.3, damping=1e-2, even_damping=1e-3)
        cameras = [view.camera for view in views]
        self._levels = []
        # From one point of a silhouette's edge to the next, as a share of its size, in rough rounds
        # and in others.
        spacings = 1.0 / 50.0, 1.0 / 80.0
        for surfaces, share in zip((rough or outlines, outlines), spacings, strict=True):
            spacing = max(1.0, share * self.size // 1.0)
            edges = [find_edge_points(view.mask, spacing) for view in views]
            fit = ContourFit(kinematics, surfaces, even, steps, pixels=self.size)
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

    def tile_costs(self, values: np.ndarray, step: AnnealingStage) -> np.ndarray:
        """What does not fit at values (m,), by pieces of the pictures that err on their own.

        What is missing or too much is about as large as a piece, a fifth of the silhouettes' size.
        """
        self._count(1)
        side = max(1.0, 0.2 * self.size)
        fit, views = self._level(step)
        costs = fit.tile_costs(views, values, step, side)
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
        """The fit and the views as finely as a step looks at them; rough: so far apart or more."""
        return self._levels[step.spacing < 0.026]

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

        def refined(start: tuple[int, np.ndarray], rounds: Any = rounds) -> FittedPose | None:
            # The first in any case, others while there is time.
            return fit.refine(start[1], rounds) if start[0] == 0 or proceed() else None

        found = [one for one in map_ordered(refined, enumerate(values)) if one is not None]
        kept = distinct(found, count, fit.kinematics.turns_around)
        values = [pose.values for pose in kept]
    return kept


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


def describe_modes(
    kinematics: TreeKinematics,
    tree: PoseTree,
    modes: Sequence[FittedPose],
    Js: Sequence[float],
    tolerance: float,
    is_known: bool,
) -> PoseSet:
    """The set of modes, the best first; where it is not known, no value is determined."""

    def joints(some: Sequence[FittedPose]) -> tuple[JointEstimate, ...]:
        # All in the turns nearest to the first one.
        first = some[0].values
        turns = [kinematics.nearest_turns(one.values, first) - one.values for one in some]
        lower, upper = kinematics.reach(first)
        low = np.maximum(np.min([one.low for one in some] + np.array(turns), axis=0), lower)
        high = np.minimum(np.max([one.high for one in some] + np.array(turns), axis=0), upper)
        widest = RobustSettings.widest(kinematics.is_angle)
        return joint_estimates(kinematics, low, high, (high - low <= widest) & is_known)

    described = tuple(
        PoseMode.of_values(tree, kinematics.split(one.values), J, joints([one]), one.size)
        for one, J in zip(modes, Js, strict=True)
    )
    return PoseSet(described, joints(modes), tolerance, False, len(described))


def covariance_pose_set(
    tree: PoseTree, pose: PoseEstimate, covariance: np.ndarray, pictures: int
) -> PoseSet:
    """What the covariance (m, m) of the tree's values says about a pose, where no other is sought.

    The size of errors was estimated from ``pictures`` pictures.
    """
    kinematics, settings = TreeKinematics(tree), RobustSettings()
    values = kinematics.flatten(pose.node_values)
    widths = stdtrit(settings.camera_freedom * pictures, settings.one_sided) * np.sqrt(
        np.diag(covariance)
    )
    lower, upper = kinematics.reach(values)
    mode = FittedPose(
        values,
        low=np.maximum(values - widths, lower),
        high=np.minimum(values + widths, upper),
    )
    described = describe_modes(kinematics, tree, [mode], [pose.J], 0.0, True)
    # The tree may hold its root elsewhere.
    own = replace(described.modes[0], q=pose.q, X_WB=pose.X_WB)
    return replace(described, modes=(own,))


class RobustModes:
    """The modes of one match, where parts, masks and cameras err together.

    What no pose explains, such as a part that is missing in a mask, costs all poses alike and says
    nothing. A value that may go far is moved step by step, the others following, until what does
    not fit any more is significant.
    """

    def __init__(
        self, fit: ViewsFit, proceed: Callable[[], bool], settings: RobustSettings | None = None
    ) -> None:
        self._fit, self._kinematics, self._proceed = fit, fit.kinematics, proceed
        self._settings = settings or RobustSettings()
        self._pieces, self._tolerance = np.zeros(0), 0.0
        self._sizes: ErrorSizes | None = None

    def find(self, poses: Sequence[FittedPose], J: Callable[[np.ndarray], float]) -> PoseSet:
        """The poses that fit as well as the best of some, the answer first; J (1) of values."""
        look = self._settings.comparison
        pieces = map_ordered(lambda pose: self._fit.tile_costs(pose.values, look), poses)
        self._pieces = min(pieces, key=lambda one: float(one.sum()))
        modes: list[FittedPose] = []
        for k, (pose, one) in enumerate(zip(poses, pieces, strict=True)):
            as_good = self._is_as_good(one)
            is_new = (as_good or k == 0) and not self._is_in(modes, pose.values)
            if is_new and self._has_room(modes):
                modes.append(self._spread(pose.values))
                self._add_flipped(modes, modes[-1])
        return self._described(modes, [J(one.values) for one in modes])

    def around(self, values: np.ndarray, J: float) -> PoseSet:
        """What the silhouettes say about one pose (m,), where no other is looked for."""
        self._pieces = self._fit.tile_costs(values, self._settings.comparison)
        return self._described([self._spread(values, moves=False)], [J])

    def _described(self, modes: Sequence[FittedPose], Js: Sequence[float]) -> PoseSet:
        # A fit of which most does not fit can be wrong altogether: no robust estimate outlives it.
        known = float(self._pieces.sum()) <= self._fit.edge_length
        tree = self._kinematics.tree
        return describe_modes(self._kinematics, tree, modes, Js, self._tolerance, known)

    def _is_as_good(self, pieces: np.ndarray) -> bool:
        """Whether costs by pieces are not significantly above the best pose's."""
        as_good = vuong_statistic(pieces, self._pieces) <= self._settings.significance
        if as_good:
            self._tolerance = max(self._tolerance, float((pieces - self._pieces).sum()))
        return as_good

    def _has_room(self, modes: Sequence[FittedPose]) -> bool:
        return not modes or (len(modes) < self._settings.modes and self._proceed())

    def _is_in(self, modes: list[FittedPose], values: np.ndarray) -> bool:
        """Whether some mode holds a pose; it is counted there.

        What is free in a mode may be anything: that widens it.
        """
        widest = self._settings.widest(self._kinematics.is_angle)
        for i, mode in enumerate(modes):
            near = self._kinematics.nearest_turns(values, mode.values)
            outside = (near < mode.low - 1e-9) | (near > mode.high + 1e-9)
            if not np.any(outside & (mode.high - mode.low <= widest)):
                low, high = np.minimum(mode.low, near), np.maximum(mode.high, near)
                modes[i] = mode._replace(low=low, high=high, size=mode.size + 1)
                return True
        return False

    def _add_flipped(self, modes: list[FittedPose], mode: FittedPose) -> None:
        """Add what flips make of a mode, as far as it fits: intervals flip as middles do."""
        kinematics, look = self._kinematics, self._settings.comparison

        def settle(flip: Flip) -> tuple[np.ndarray, np.ndarray]:
            seen = self._fit.refine(flip.values, (look,)).values
            return seen, self._fit.tile_costs(seen, look)

        others = flips(kinematics, mode.values) if self._has_room(modes) else []
        for flip, (seen, pieces) in zip(others, map_ordered(settle, others), strict=True):
            if not self._has_room(modes):
                return
            if not self._is_as_good(pieces) or self._is_in(modes, seen):
                continue
            values = kinematics.nearest_turns(seen)
            below, above = mode.values - mode.low, mode.high - mode.values
            lower, upper = kinematics.reach(mode.values)
            # Where a limit ended the interval, the flipped one may go further.
            below = np.where(flip.changed & (mode.low <= lower + 1e-9), math.inf, below)
            above = np.where(flip.changed & (mode.high >= upper - 1e-9), math.inf, above)
            swapped = np.where(flip.mirrored, [above, below], [below, above])
            lower, upper = kinematics.reach(values)
            low, high = (
                np.maximum(values - swapped[0], lower),
                np.minimum(values + swapped[1], upper),
            )
            modes.append(FittedPose(values, low=low, high=high))

    def _spread(self, values: np.ndarray, moves: bool = True) -> FittedPose:
        """What the values (m,) may be about a pose; unless it moves them, by covariance alone."""
        kinematics, own = self._kinematics, self._settings
        lower, upper = kinematics.reach(values)
        free = np.flatnonzero(upper > lower)
        seen = self._fit.distances(values, own.measure)
        if self._sizes is None:
            self._sizes = estimate_sizes(seen, kinematics.is_angle)
        covariance = values_covariance(seen, self._sizes, free, kinematics.is_angle)
        low, high = values.copy(), values.copy()
        freedom = own.camera_freedom * self._fit.camera_count
        widths = stdtrit(freedom, own.one_sided) * np.sqrt(np.diag(covariance))
        low[free], high[free] = values[free] - widths, values[free] + widths
        wide = widths > np.where(kinematics.is_angle[free], *own.moved)

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
        return FittedPose(values, low=np.maximum(low, lower), high=np.minimum(high, upper))

    def _move(
        self, values: np.ndarray, index: int, along: np.ndarray, width: float
    ) -> list[np.ndarray]:
        """Poses (m,) that fit as well, a value moved from some, the others following along (m,).

        ``width``: how far the value may go in any case.
        """
        own = self._settings
        longest = own.longest_steps[0 if self._kinematics.is_angle[index] else 1]
        lower, upper = self._kinematics.lower.copy(), self._kinematics.upper.copy()
        # Beyond half a turn the values come back from the other side.
        lower[index], upper[index] = (ends[index] for ends in self._kinematics.reach(values))
        step, found, worse = width, [values], 0.0
        while lower[index] < found[-1][index] < upper[index] and self._proceed():
            trial = np.clip(found[-1] + min(step, longest) * along, lower, upper)
            looked = self._fit.refine(trial, own.follow, held=(index,)).values
            costs = self._fit.tile_costs(looked, own.comparison)
            before, worse = worse, vuong_statistic(costs, self._pieces)
            if worse > own.significance:
                # Costs are parabolas in the rough, and their differences scatter as values differ.
                share = (own.significance - before) / (worse - before)
                return [*found, found[-1] + share * (looked - found[-1])]
            found.append(looked)
            step *= own.step_factor
        return found
