"""What damaged silhouettes leave open: poses that fit as well as the best, in families.

Where the body fits badly and masks are damaged, the misfit itself is the only measure of the noise:
the larger the share of the silhouettes' edges that the best pose leaves unexplained, the larger the
cost of poses that count as good. What well determined values may do within that follows from the
cost's curvature; a weakly determined value is moved step by step, the others following, until the
cost or a limit ends it. Other optima that fit, and flipped joints, make further families.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.matching.fit.levenberg_marquardt import Round
from drake_pose.matching.fit.views_fit import FittedPose, ViewsFit
from drake_pose.matching.pose_families import JointEstimate, PoseFamily, PoseSet
from drake_pose.matching.starts.self_motions import Flip, flips

_LOOK = Round(0.0125, 0.026, 2)
# The first and the longest step of a value that is moved, angle [rad] and length [m].
_FIRST_STEPS, _LONGEST_STEPS = (0.05, 0.01), (0.35, 0.1)
# Each step of a value that is moved is longer by this factor.
_GROWTH = 1.6
# A value without any effect has this curvature, so that equations can be solved [pixel/rad^2].
_LEAST_CURVATURE = 1e-2
# A pose that is hardly good enough may still do so much of what the best may.
_LEAST_ROOM = 0.5
# Up to this share of the edges left unexplained, the tolerance is a share of the best cost.
_SMALL_MISFIT = 0.5
_ROUNDING = 1e-9


@dataclass(frozen=True)
class RobustFamilySettings:
    """Parameters of the answer as a set; angles in rad, lengths in m.

    Args:
        tolerance: how much more cost is as good as the best: this times the square of the best
            cost, both as shares of the length of the silhouettes' edges; of a best cost below a
            half, half of this times it. Found on drawn arms with damaged masks and links too thick
            or thin.
        widest_angle, widest_length: a value is free whose interval is wider than this on either
            side.
        moved_angle, moved_length: a value that the curvature lets go so far is moved step by step.
        families: at most this many are told apart.

    Raises:
        SettingsError: if a value is out of its range.
    """

    tolerance: float = 0.6
    widest_angle: float = math.radians(10.0)
    widest_length: float = 0.02
    moved_angle: float = math.radians(3.0)
    moved_length: float = 0.01
    families: int = 8

    def __post_init__(self) -> None:
        for name in ("tolerance", "widest_angle", "widest_length", "moved_angle", "moved_length"):
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"{name} must be positive, not {getattr(self, name)}")
        if self.families < 1:
            raise SettingsError(f"families must be 1 or more, not {self.families}")


@dataclass(frozen=True, eq=False)
class _Family:
    """A pose (m,), the ends (m,) of what its values may be, and how many poses are in it."""

    values: np.ndarray
    low: np.ndarray
    high: np.ndarray
    size: int = 1

    def holds(self, values: np.ndarray) -> bool:
        """Whether values (m,), of angles in the turn nearest to the family's, are in it."""
        inside = (values >= self.low - _ROUNDING) & (values <= self.high + _ROUNDING)
        return bool(inside.all())


class RobustFamilies:
    """Finds the families of one match.

    Args:
        fit: the body and the silhouettes.
        settings: the parameters.
        proceed: asked again and again whether to go on.
    """

    def __init__(
        self, fit: ViewsFit, settings: RobustFamilySettings, proceed: Callable[[], bool]
    ) -> None:
        self._fit = fit
        self._kinematics = fit.kinematics
        self._settings = settings
        self._proceed = proceed
        self._tolerance = 0.0
        self._limit = math.inf

    def find(self, poses: Sequence[FittedPose], J: Callable[[np.ndarray], float]) -> PoseSet:
        """The poses that fit as well as the best.

        Args:
            poses: refined, best first; the first is the answer.
            J: the objective (1) at values (m,) [pixel].
        """
        costs = [self._cost(pose.values) for pose in poses]
        best = min(costs)
        misfit = max(best / self._fit.edge_length, _SMALL_MISFIT)
        self._tolerance = self._settings.tolerance * best * misfit
        self._limit = best + self._tolerance
        good = [pose.values for pose, cost in zip(poses, costs, strict=True) if cost <= self._limit]
        families: list[_Family] = []
        for values in good or [poses[0].values]:
            if self._is_in(families, values) or not self._has_room(families):
                continue
            whole = self._spread(values)
            families.append(whole)
            self._add_flipped(families, whole)
        return self._describe(families, J)

    def _cost(self, values: np.ndarray) -> float:
        return self._fit.cost(values, _LOOK)

    def _has_room(self, families: Sequence[_Family]) -> bool:
        return not families or (len(families) < self._settings.families and self._proceed())

    def _is_in(self, families: list[_Family], values: np.ndarray) -> bool:
        """Whether some family holds a pose; it is counted there."""
        for i, family in enumerate(families):
            if family.holds(self._kinematics.nearest_turns(values, family.values)):
                families[i] = _Family(family.values, family.low, family.high, family.size + 1)
                return True
        return False

    def _add_flipped(self, families: list[_Family], family: _Family) -> None:
        """Add what flips make of a family, as far as it fits."""
        for flip in flips(self._kinematics, family.values):
            if not self._has_room(families):
                return
            look = self._fit.refine(flip.values, (_LOOK,))
            if look.cost <= self._limit and not self._is_in(families, look.values):
                values = self._kinematics.nearest_turns(look.values)
                families.append(self._flipped(family, flip, values))

    def _flipped(self, family: _Family, flip: Flip, values: np.ndarray) -> _Family:
        """A family after a flip, about a pose (m,): an interval flips as its middle does."""
        below, above = family.values - family.low, family.high - family.values
        lower, upper = self._kinematics.reach(family.values)
        # Where a limit ended the interval, the flipped one may go further.
        below = np.where(flip.changed & (family.low <= lower + _ROUNDING), math.inf, below)
        above = np.where(flip.changed & (family.high >= upper - _ROUNDING), math.inf, above)
        below, above = (
            np.where(flip.mirrored, above, below),
            np.where(flip.mirrored, below, above),
        )
        lower, upper = self._kinematics.reach(values)
        return _Family(values, np.maximum(values - below, lower), np.minimum(values + above, upper))

    def _spread(self, values: np.ndarray) -> _Family:
        """What the values (m,) may be about a pose."""
        lower, upper = self._kinematics.reach(values)
        cost = self._cost(values)
        room = max(self._limit - cost, _LEAST_ROOM * self._tolerance)
        H = self._fit.curvature(values, _LOOK)
        free = np.flatnonzero(upper > lower)
        low, high = values.copy(), values.copy()
        covariance = np.linalg.inv(H[np.ix_(free, free)] + _LEAST_CURVATURE * np.eye(len(free)))
        widths = np.sqrt(2.0 * room * np.diag(covariance))
        for column, (index, width) in enumerate(zip(free, widths, strict=True)):
            angle = bool(self._kinematics.is_angle[index])
            moved = self._settings.moved_angle if angle else self._settings.moved_length
            if width <= moved or not self._proceed():
                low[index], high[index] = values[index] - width, values[index] + width
                continue
            along = np.zeros(len(values))
            along[free] = covariance[:, column] / covariance[column, column]
            low[index] = self._move(values, int(index), -along, cost)
            high[index] = self._move(values, int(index), along, cost)
        return _Family(values, np.maximum(low, lower), np.minimum(high, upper))

    def _move(self, values: np.ndarray, index: int, along: np.ndarray, cost: float) -> float:
        """How far a value can go, the others following along (m,), from a pose of some cost."""
        kind = 0 if self._kinematics.is_angle[index] else 1
        lower, upper = self._kinematics.lower.copy(), self._kinematics.upper.copy()
        # Beyond half a turn the values come back from the other side.
        lower[index], upper[index] = (ends[index] for ends in self._kinematics.reach(values))
        step, best = _FIRST_STEPS[kind], cost
        while self._proceed():
            before, before_cost = values[index], cost
            trial = np.clip(values + step * along, lower, upper)
            look = self._fit.refine(trial, (_LOOK,), held=(index,))
            values, cost = look.values, look.cost
            if cost > self._limit:
                # Costs are roughly parabolas.
                a, b, c = (
                    math.sqrt(max(one - best, 0.0)) for one in (before_cost, self._limit, cost)
                )
                return float(before + (values[index] - before) * (b - a) / max(c - a, _ROUNDING))
            best = min(best, cost)
            if not lower[index] < values[index] < upper[index]:
                break
            step = min(_GROWTH * step, _LONGEST_STEPS[kind])
        return float(values[index])

    def _describe(self, families: Sequence[_Family], J: Callable[[np.ndarray], float]) -> PoseSet:
        kinematics = self._kinematics
        described = []
        for family in families:
            node_values = tuple(kinematics.split(family.values))
            q, X_WB = kinematics.tree.positions_from(node_values)
            described.append(
                PoseFamily(
                    q, X_WB, node_values, J(family.values), self._joints([family]), family.size
                )
            )
        return PoseSet(
            tuple(described), self._joints(families), self._tolerance, False, len(described)
        )

    def _joints(self, families: Sequence[_Family]) -> tuple[JointEstimate, ...]:
        """Each value over some families."""
        kinematics, settings = self._kinematics, self._settings
        # All in the turns nearest to the first one.
        seen = np.array(
            [kinematics.nearest_turns(family.values, families[0].values) for family in families]
        )
        turns = seen - [family.values for family in families]
        lower, upper = kinematics.reach(families[0].values)
        low = np.maximum(np.min([one.low for one in families] + turns, axis=0), lower)
        high = np.minimum(np.max([one.high for one in families] + turns, axis=0), upper)
        estimates = []
        for i, name in enumerate(kinematics.names):
            widest = settings.widest_angle if kinematics.is_angle[i] else settings.widest_length
            determined = bool(high[i] - low[i] <= 2.0 * widest)
            estimates.append(
                JointEstimate(
                    name,
                    int(kinematics.value_nodes[i]),
                    determined,
                    float(low[i]),
                    float(high[i]),
                    np.unique(np.round(seen[:, i], 12)),
                    bool(kinematics.turns_around[i]),
                )
            )
        return tuple(estimates)
