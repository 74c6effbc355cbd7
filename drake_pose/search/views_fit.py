"""Fit a body robustly to the silhouettes of one frame, and compute modes and joint intervals.

The unit of length in an image is the square root of the silhouettes' mean area, since neither the
scale nor the distance of the body may be known.

The covariance of the fit gives intervals of the values around one optimum. Other optima that fit as
well are further modes. ``RobustModes`` computes both for damaged masks and models that fit only
approximately; ``exact_search.find_intervals`` is the counterpart for exact masks.
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
from drake_pose.fit.contour_fit import FINEST_SCALE, ContourFit, Noise, Views, pack_views
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
from drake_pose.silhouette.outline import Outline
from drake_pose.workers import map_ordered


class RobustSettings(NamedTuple):
    """Parameters of the intervals and modes computed from damaged masks."""

    # Stage at which costs of poses are compared.
    comparison: AnnealingStage = AnnealingStage(0.0125, 0.026, 2)
    measure: AnnealingStage = AnnealingStage(0.025, 0.0125)  # Stage at which errors are measured.
    # Difference of costs that is significant [standard deviations].
    significance: float = 1.96
    confidence: float = 0.95  # Probability that an interval contains the true value.
    modes: int = 8  # Greatest number of modes.
    # Values whose interval by covariance is wider on a side are moved step by step [rad, m].
    moved: tuple[float, float] = (math.radians(3.0), 0.01)
    longest_steps: tuple[float, float] = (0.5, 0.1)  # Longest step of a moved value [rad, m].
    step_factor: float = 1.6  # Ratio of successive steps.
    camera_freedom: int = 6  # Degrees of freedom of a camera's error.

    @staticmethod
    def widest(is_angle: np.ndarray) -> np.ndarray:
        """Return (m,) the greatest width of a determined value's interval [rad or m].

        It is 10 degrees, or 2 cm, on each side. ``is_angle``: (m,) bool whether each of the pose
        tree's m values is an angle.
        """
        return 2.0 * np.where(is_angle, math.radians(10.0), 0.02)


class FittedPose(NamedTuple):
    """A fitted pose, and its mode's intervals."""

    values: np.ndarray  # (m,) values of the pose tree [rad or m].
    cost: float = 0.0  # Robust cost [pixel]; comparable only at the same scale and spacing.
    # low, high: (m,) ends of the intervals [rad or m]; (0,) if they were not computed.
    low: np.ndarray = np.zeros(0)
    high: np.ndarray = np.zeros(0)
    size: int = 1  # Number of poses in the mode.


class ViewsFit:
    """The robust fit of one body to the silhouettes of one frame.

    Attributes:
        size: square root of the silhouettes' mean area [pixel], the unit of length of all stages.
        edge_length: length of the silhouettes' edges [pixel].
        camera_count: number of views.
        evaluations: number of comparisons of contours until now.

    Args:
        kinematics: kinematics of the pose tree, with m values.
        outlines: a surface for each node; few triangles suffice, see ``simplify_surfaces``.
        views: the silhouettes, one per camera.
        rough: surfaces with fewer triangles, for stages of large spacing; None: ``outlines``.
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
        # Unit weight per pixel of contour, so that the cost is in pixels.
        even = Noise(deviation=1.0, correlation=0.5 / self.size**3)
        steps = StepSettings(max_step=0.3, damping=1e-2, uniform_damping=1e-3)
        cameras = [view.camera for view in views]
        self._levels = []
        # Distance of neighbouring points of a silhouette's edge, as a fraction of its size, at
        # rough and at fine stages.
        fractions = 1.0 / 50.0, 1.0 / 80.0
        for surfaces, fraction in zip((rough or outlines, outlines), fractions, strict=True):
            spacing = max(1.0, fraction * self.size // 1.0)
            edges = [find_edge_points(view.mask, spacing) for view in views]
            fit = ContourFit(kinematics, surfaces, even, steps, pixels=self.size)
            self._levels.append((fit, pack_views(cameras, edges)))
        self.edge_length = max(1.0, float(self._levels[-1][1].evidence.lengths.sum()))
        self.camera_count = len(views)
        self.evaluations, self._counting = 0, Lock()

    def cost(self, values: np.ndarray, stage: AnnealingStage) -> float:
        """Return the robust cost [pixel] at values (m,); ``stage``: its scale and spacing."""
        self._count(1)
        fit, views = self._level(stage)
        sums = fit.compare(views, values, stage).sums
        return float(sums[..., Sum.COST].sum()) / self._scale(stage) ** 2

    def distances(self, values: np.ndarray, stage: AnnealingStage) -> Distances:
        """Return the residuals of the contours' distances at values (m,); arguments as ``cost``."""
        self._count(1)
        fit, views = self._level(stage)
        compared = fit.compare(views, values, stage)
        moves, unit = compared.placement.dense(len(values)), error_unit(self.size)
        return distances(fit.outlines, views.cameras, compared, moves, unit)

    def tile_costs(self, values: np.ndarray, stage: AnnealingStage) -> np.ndarray:
        """Return (cameras, 64, 64) the robust cost at values (m,) in each image tile [pixel].

        The errors of different tiles are regarded as independent. A tile's side is a fifth of the
        silhouettes' size, about the size of usual defects of masks. Arguments as ``cost``.
        """
        self._count(1)
        side = max(1.0, 0.2 * self.size)
        fit, views = self._level(stage)
        costs = fit.tile_costs(views, values, stage, side)
        return costs / self._scale(stage) ** 2

    def refine(
        self, values: np.ndarray, stages: Sequence[AnnealingStage], held: Sequence[int] = ()
    ) -> FittedPose:
        """Return the pose fitted from values (m,) in stages, with the cost at the last stage.

        ``held``: indices of values that do not change.
        """
        fixed = self.kinematics.upper <= self.kinematics.lower
        fixed[list(held)] = True
        fit, views = self._level(stages[-1])
        found = fit.fit(views, values, stages, None, fixed)
        self._count(found.evaluations)
        return FittedPose(found.values, found.cost / self._scale(stages[-1]) ** 2)

    def _level(self, stage: AnnealingStage) -> tuple[ContourFit, Views]:
        """Return fit and views for a stage: fine ones below a spacing of 0.026, else rough ones."""
        return self._levels[stage.spacing < 0.026]

    def _count(self, evaluations: int) -> None:
        """Add to the number of evaluations."""
        with self._counting:  # Threads fit side by side.
            self.evaluations += evaluations

    def _scale(self, stage: AnnealingStage) -> float:
        """Return a stage's scale [pixel]."""
        return max(FINEST_SCALE, stage.scale * self.size)


def refine_best(
    fit: ViewsFit,
    starts: Sequence[np.ndarray],
    passes: Sequence[tuple[Sequence[AnnealingStage], int]],
    proceed: Callable[[], bool],
) -> list[FittedPose]:
    """Refine many poses, and keep after each pass only the best distinct ones.

    Args:
        fit: the robust fit.
        starts: the tree's values (m,) of each start, best first; at least one.
        passes: for each pass its stages, and the number of poses kept after it.
        proceed: returns whether there is time left; if not, only the first pose is refined.

    Returns the poses kept after the last pass, best first; at least one.
    """
    values = list(starts)
    kept: list[FittedPose] = []
    for stages, count in passes:

        def refined(start: tuple[int, np.ndarray], stages: Any = stages) -> FittedPose | None:
            # The first pose is always refined, so that there is a result.
            return fit.refine(start[1], stages) if start[0] == 0 or proceed() else None

        found = [one for one in map_ordered(refined, enumerate(values)) if one is not None]
        kept = distinct(found, count, fit.kinematics.covers_full_turn)
        values = [pose.values for pose in kept]
    return kept


def distinct(
    poses: Sequence[FittedPose],
    count: int,
    covers_full_turn: np.ndarray | bool = False,
    apart: float = 0.05,
) -> list[FittedPose]:
    """Return the best distinct poses, sorted by cost.

    Args:
        poses: the poses, in any order.
        count: greatest number of poses that are returned.
        covers_full_turn: (m,) bool whether each value is an angle that is the same after a full
            turn; False: none is.
        apart: a pose is distinct if some value differs by more than this from that of every better
            pose [rad or m].
    """
    chosen: list[FittedPose] = []
    for pose in sorted(poses, key=lambda one: one.cost):
        gaps = (
            nearest_turn(pose.values, other.values, covers_full_turn) - other.values
            for other in chosen
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
    """Return the pose set of some modes, marked as incomplete.

    Args:
        kinematics: kinematics of the pose tree.
        tree: the pose tree, with its root where the body is.
        modes: the modes with their intervals, best first.
        Js: the objective J of each [pixel].
        tolerance: greatest excess of the modes' costs, stored in the set [pixel].
        is_known: whether intervals are reliable; if not, no value is determined.
    """

    def joints(some: Sequence[FittedPose]) -> tuple[JointEstimate, ...]:
        # Angles of all modes are given in the turn nearest to the first one.
        first = some[0].values
        turns = [kinematics.nearest_turns(one.values, first) - one.values for one in some]
        lower, upper = kinematics.local_limits(first)
        low = np.maximum(np.min([one.low for one in some] + np.array(turns), axis=0), lower)
        high = np.minimum(np.max([one.high for one in some] + np.array(turns), axis=0), upper)
        widest = RobustSettings.widest(kinematics.is_angle)
        return joint_estimates(kinematics, low, high, (high - low <= widest) & is_known)

    described = tuple(
        PoseMode.of_values(tree, kinematics.split(one.values), J, joints([one]), one.size)
        for one, J in zip(modes, Js, strict=True)
    )
    return PoseSet(described, joints(modes), tolerance, False, len(described))


def interval_widths(covariance: np.ndarray, degrees_of_freedom: int) -> np.ndarray:
    """Return half the widths (m,) of intervals by a covariance (m, m), with Student's quantile."""
    one_sided = 0.5 + 0.5 * RobustSettings().confidence
    return np.asarray(stdtrit(degrees_of_freedom, one_sided) * np.sqrt(np.diag(covariance)))


def covariance_pose_set(
    tree: PoseTree, pose: PoseEstimate, covariance: np.ndarray, image_count: int
) -> PoseSet:
    """Return the pose set of a single pose, with 95 % intervals from a covariance.

    Args:
        tree: the pose tree, with m values.
        pose: the pose.
        covariance: (m, m) covariance of the tree's values [rad^2, rad m or m^2].
        image_count: number of images from which the sizes of errors were estimated; it sets the
            degrees of freedom of Student's distribution.
    """
    kinematics, settings = TreeKinematics(tree), RobustSettings()
    values = kinematics.flatten(pose.node_values)
    widths = interval_widths(covariance, settings.camera_freedom * image_count)
    lower, upper = kinematics.local_limits(values)
    mode = FittedPose(
        values, low=np.maximum(values - widths, lower), high=np.minimum(values + widths, upper)
    )
    described = describe_modes(kinematics, tree, [mode], [pose.J], 0.0, True)
    # Keep the pose's own root, which may differ from the tree's.
    own = replace(described.modes[0], q=pose.q, X_WB=pose.X_WB)
    return replace(described, modes=(own,))


class RobustModes:
    """Computes the modes and intervals of one match with damaged masks.

    Poses are compared by the difference of their costs, so defects that no pose explains, such as a
    part missing in a mask, cancel. A value with a wide interval is moved step by step, with the
    other values fitted, until the increase of the cost is significant (profile likelihood).

    ``fit``: the robust fit to the match's views. ``proceed``: returns whether there is time left.
    ``settings``: parameters of modes and intervals; None: the defaults.
    """

    def __init__(
        self, fit: ViewsFit, proceed: Callable[[], bool], settings: RobustSettings | None = None
    ) -> None:
        self._fit, self._kinematics, self._proceed = fit, fit.kinematics, proceed
        self._settings = settings or RobustSettings()
        self._best_costs, self._tolerance = np.zeros(0), 0.0
        self._sizes: ErrorSizes | None = None

    def find(self, poses: Sequence[FittedPose], J: Callable[[np.ndarray], float]) -> PoseSet:
        """Return the set of poses that fit as well as the best of some, flipped poses included.

        ``poses``: fitted poses; the first is the answer and the representative of the first mode.
        ``J``: returns the objective J at values (m,) [pixel].
        """
        stage = self._settings.comparison
        costs = map_ordered(lambda pose: self._fit.tile_costs(pose.values, stage), poses)
        self._best_costs = min(costs, key=lambda one: float(one.sum()))
        modes: list[FittedPose] = []
        for k, (pose, one) in enumerate(zip(poses, costs, strict=True)):
            as_good = self._is_as_good(one)
            is_new = (as_good or k == 0) and not self._add_to_known(modes, pose.values)
            if is_new and self._has_room(modes):
                modes.append(self._with_intervals(pose.values))
                self._add_flipped(modes, modes[-1])
        return self._pose_set(modes, [J(one.values) for one in modes])

    def around(self, values: np.ndarray, J: float) -> PoseSet:
        """Return the set of the single pose with values (m,) and objective J [pixel]."""
        self._best_costs = self._fit.tile_costs(values, self._settings.comparison)
        return self._pose_set([self._with_intervals(values, moves=False)], [J])

    def _pose_set(self, modes: Sequence[FittedPose], Js: Sequence[float]) -> PoseSet:
        """Return the pose set of modes with objectives ``Js`` [pixel]."""
        # If the cost exceeds one per pixel of edge, most of the contour does not fit, and the pose
        # may be entirely wrong: the intervals are not reliable.
        known = float(self._best_costs.sum()) <= self._fit.edge_length
        tree = self._kinematics.tree
        return describe_modes(self._kinematics, tree, modes, Js, self._tolerance, known)

    def _is_as_good(self, costs: np.ndarray) -> bool:
        """Return whether costs by ``tile_costs`` are not significantly above the best pose's.

        If so, the pose set's tolerance grows to their excess.
        """
        as_good = vuong_statistic(costs, self._best_costs) <= self._settings.significance
        if as_good:
            self._tolerance = max(self._tolerance, float((costs - self._best_costs).sum()))
        return as_good

    def _has_room(self, modes: Sequence[FittedPose]) -> bool:
        """Return whether one more mode is allowed by their number and the time."""
        return not modes or (len(modes) < self._settings.modes and self._proceed())

    def _add_to_known(self, modes: list[FittedPose], values: np.ndarray) -> bool:
        """Return whether values (m,) belong to one of the modes, which they then widen."""
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
        """Add a mode's flipped poses that fit as well, to ``modes`` or to one of these."""
        kinematics, stage = self._kinematics, self._settings.comparison

        def settle(flip: Flip) -> tuple[np.ndarray, np.ndarray]:
            fitted = self._fit.refine(flip.values, (stage,)).values
            return fitted, self._fit.tile_costs(fitted, stage)

        others = flips(kinematics, mode.values) if self._has_room(modes) else []
        for flip, (fitted, costs) in zip(others, map_ordered(settle, others), strict=True):
            if not self._has_room(modes):
                return
            if not self._is_as_good(costs) or self._add_to_known(modes, fitted):
                continue
            values = kinematics.nearest_turns(fitted)
            below, above = mode.values - mode.low, mode.high - mode.values
            lower, upper = kinematics.local_limits(mode.values)
            # An interval that ended at a joint's limit may extend further after the flip.
            below = np.where(flip.changed & (mode.low <= lower + 1e-9), math.inf, below)
            above = np.where(flip.changed & (mode.high >= upper - 1e-9), math.inf, above)
            swapped = np.where(flip.mirrored, [above, below], [below, above])
            lower, upper = kinematics.local_limits(values)
            low = np.maximum(values - swapped[0], lower)
            high = np.minimum(values + swapped[1], upper)
            modes.append(FittedPose(values, low=low, high=high))

    def _with_intervals(self, values: np.ndarray, moves: bool = True) -> FittedPose:
        """Return the pose with values (m,) and its intervals.

        ``moves``: whether values with a wide interval are moved; else the intervals follow from the
        covariance alone.
        """
        kinematics, settings = self._kinematics, self._settings
        lower, upper = kinematics.local_limits(values)
        free = np.flatnonzero(upper > lower)
        residuals = self._fit.distances(values, settings.measure)
        if self._sizes is None:
            self._sizes = estimate_sizes(residuals, kinematics.is_angle)
        covariance = values_covariance(residuals, self._sizes, free, kinematics.is_angle)
        low, high = values.copy(), values.copy()
        widths = interval_widths(covariance, settings.camera_freedom * self._fit.camera_count)
        low[free], high[free] = values[free] - widths, values[free] + widths
        wide = widths > np.where(kinematics.is_angle[free], *settings.moved)

        def move(direction: tuple[int, float]) -> list[np.ndarray]:
            column, sign = direction
            along = np.zeros(len(values))
            along[free] = sign * covariance[:, column] / covariance[column, column]
            return self._profile(values, int(free[column]), along, float(widths[column]))

        # A value is not moved towards a limit that lies within its interval by covariance.
        directions = [
            (column, sign)
            for column in np.flatnonzero(wide & moves).tolist()
            for sign, open_end in ((-1.0, low > lower), (1.0, high < upper))
            if open_end[free[column]]
        ]
        found = [values, *itertools.chain.from_iterable(map_ordered(move, directions))]
        # Poses found while one value was moved may widen the intervals of other moved values.
        moved = free[wide]
        low[moved] = np.minimum(low[moved], np.min(found, axis=0)[moved])
        high[moved] = np.maximum(high[moved], np.max(found, axis=0)[moved])
        return FittedPose(values, low=np.maximum(low, lower), high=np.minimum(high, upper))

    def _profile(
        self, values: np.ndarray, index: int, along: np.ndarray, width: float
    ) -> list[np.ndarray]:
        """Move one value step by step, with the others fitted, while the pose fits as well.

        ``values``: (m,) the start [rad or m]. ``along``: (m,) change of all values per unit of the
        moved one; its sign is the direction. ``width``: first step [rad or m]. Returns the poses'
        values, the given ones first. The last is interpolated to where the increase of the cost
        becomes significant, unless the value's limit or the end of the time comes first.
        """
        settings = self._settings
        # The others follow in two stages; the last is that at which costs are compared.
        last = settings.comparison
        stages = (replace(last, scale=2.0 * last.scale), last)
        longest = settings.longest_steps[0 if self._kinematics.is_angle[index] else 1]
        lower, upper = self._kinematics.lower.copy(), self._kinematics.upper.copy()
        # An angle that turns around is moved by at most half a turn.
        lower[index], upper[index] = (ends[index] for ends in self._kinematics.local_limits(values))
        step, found, worse = width, [values], 0.0
        while lower[index] < found[-1][index] < upper[index] and self._proceed():
            trial = np.clip(found[-1] + min(step, longest) * along, lower, upper)
            fitted = self._fit.refine(trial, stages, held=(index,)).values
            costs = self._fit.tile_costs(fitted, settings.comparison)
            before, worse = worse, vuong_statistic(costs, self._best_costs)
            if worse > settings.significance:
                # The cost is roughly a parabola and the standard deviation of a difference grows
                # linearly, so the statistic is interpolated linearly.
                fraction = (settings.significance - before) / (worse - before)
                return [*found, found[-1] + fraction * (fitted - found[-1])]
            found.append(fitted)
            step *= settings.step_factor
        return found
