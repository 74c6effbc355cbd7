"""What damaged silhouettes leave open: poses that fit as well as the best, in families.

Two questions are put to the silhouettes. How far a pose may be off that is right: its covariance,
where parts, masks and cameras err together (``fit.covariance``), as 95 % intervals; a value that
may go far is moved step by step, the others following, until what does not fit any more is
significant. Whether another pose fits as well: other optima that were found, and flipped joints,
make families of their own unless significantly worse (``fit.covariance.excess``). What no pose
explains, such as a part that is missing in a mask, costs all of them alike and says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from drake_pose.errors import SettingsError
from drake_pose.fit.covariance import ErrorSizes, estimate_sizes, excess, values_covariance
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.search.continuous.views_fit import FittedPose, ViewsFit
from drake_pose.search.estimates import JointEstimate, PoseFamily, PoseSet, joint_estimates
from drake_pose.search.starts.self_motions import Flip, flips

_LOOK = AnnealingStage(0.0125, 0.026, 2)
# What follows a value that is moved.
_FOLLOW = (AnnealingStage(0.025, 0.026, 2), AnnealingStage(0.0125, 0.026, 2))
# Distances that count less in the fit tell of errors, too.
_FINE = AnnealingStage(0.025, 0.0125)
# The longest step of a value that is moved, angle [rad] and length [m].
_LONGEST_STEPS = 0.5, 0.1
# Each step of a value that is moved is longer by this factor.
_GROWTH = 1.6
# The first step is this share of what the covariance allows.
_FIRST_STEP = 0.5
# As often shall a value lie below the upper end of its interval, and above the lower one.
_ONE_SIDED = 0.975
# How large errors are is told by the motions of each camera.
_CAMERA_MOTIONS = 6
# A fit of which most does not fit can be wrong altogether: no robust estimate outlives that.
_BREAKDOWN = 0.5
_ROUNDING = 1e-9


@dataclass(frozen=True)
class RobustFamilySettings:
    """Parameters of the answer as a set; angles in rad, lengths in m.

    Args:
        significance: poses are as good as the best whose cost is larger by no more than so many
            standard deviations of the difference.
        widest_angle, widest_length: a value is free whose interval is wider than this on either
            side.
        moved_angle, moved_length: a value that the covariance lets go so far is moved step by step.
        families: at most this many are told apart.

    Raises:
        SettingsError: if a value is out of its range.
    """

    significance: float = 1.96
    widest_angle: float = math.radians(10.0)
    widest_length: float = 0.02
    moved_angle: float = math.radians(3.0)
    moved_length: float = 0.01
    families: int = 8

    def __post_init__(self) -> None:
        for name in (
            "significance",
            "widest_angle",
            "widest_length",
            "moved_angle",
            "moved_length",
        ):
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

    def outside(self, values: np.ndarray) -> np.ndarray:
        """Which values (m,), of angles in the turn nearest to the family's, are not in it."""
        return np.asarray((values < self.low - _ROUNDING) | (values > self.high + _ROUNDING))


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
        self._pieces = np.zeros(0)
        self._tolerance = 0.0
        self._sizes: ErrorSizes | None = None
        self._broken = False

    def find(self, poses: Sequence[FittedPose], J: Callable[[np.ndarray], float]) -> PoseSet:
        """The poses that fit as well as the best.

        Args:
            poses: refined, best first; the first is the answer.
            J: the objective (1) at values (m,) [pixel].
        """
        pieces = [self._fit.piece_costs(pose.values, _LOOK) for pose in poses]
        self._pieces = min(pieces, key=lambda one: float(one.sum()))
        self._broken = float(self._pieces.sum()) > _BREAKDOWN * 2.0 * self._fit.edge_length
        good = [
            pose.values for pose, one in zip(poses, pieces, strict=True) if self._is_as_good(one)
        ]
        families: list[_Family] = []
        for values in good or [poses[0].values]:
            if self._is_in(families, values) or not self._has_room(families):
                continue
            whole = self._spread(values)
            families.append(whole)
            self._add_flipped(families, whole)
        return self._describe(families, J)

    def _excess(self, pieces: np.ndarray) -> float:
        """By how many standard deviations costs by pieces are above the best pose's."""
        return excess(pieces, self._pieces)

    def _is_as_good(self, pieces: np.ndarray) -> bool:
        """Whether costs by pieces are not significantly above the best pose's."""
        as_good = self._excess(pieces) <= self._settings.significance
        if as_good:
            self._tolerance = max(self._tolerance, float((pieces - self._pieces).sum()))
        return as_good

    def _has_room(self, families: Sequence[_Family]) -> bool:
        return not families or (len(families) < self._settings.families and self._proceed())

    def _is_in(self, families: list[_Family], values: np.ndarray) -> bool:
        """Whether some family holds a pose; it is counted there.

        What is free in a family may be anything: that widens it.
        """
        for i, family in enumerate(families):
            near = self._kinematics.nearest_turns(values, family.values)
            if not np.any(family.outside(near) & (family.high - family.low <= self._widest())):
                low, high = np.minimum(family.low, near), np.maximum(family.high, near)
                families[i] = _Family(family.values, low, high, family.size + 1)
                return True
        return False

    def _widest(self) -> np.ndarray:
        """(m,) how wide the intervals of determined values are at most."""
        settings = self._settings
        return 2.0 * np.where(
            self._kinematics.is_angle, settings.widest_angle, settings.widest_length
        )

    def _add_flipped(self, families: list[_Family], family: _Family) -> None:
        """Add what flips make of a family, as far as it fits."""
        for flip in flips(self._kinematics, family.values):
            if not self._has_room(families):
                return
            look = self._fit.refine(flip.values, (_LOOK,))
            if not self._is_as_good(self._fit.piece_costs(look.values, _LOOK)):
                continue
            if not self._is_in(families, look.values):
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
        angles = kinematics.is_angle[free]
        wide = widths > np.where(angles, self._settings.moved_angle, self._settings.moved_length)
        found = [values]
        for column in np.flatnonzero(wide):
            along = np.zeros(len(values))
            along[free] = covariance[:, column] / covariance[column, column]
            for way in (-along, along):
                found += self._move(values, int(free[column]), way, float(widths[column]))
        # Poses found while one value was moved show what others may be, too.
        moved = free[wide]
        low[moved] = np.minimum(low[moved], np.min(found, axis=0)[moved])
        high[moved] = np.maximum(high[moved], np.max(found, axis=0)[moved])
        return _Family(values, np.maximum(low, lower), np.minimum(high, upper))

    def _move(
        self, values: np.ndarray, index: int, along: np.ndarray, width: float
    ) -> list[np.ndarray]:
        """Poses (m,) that fit as well, with a value farther and farther away.

        Args:
            values: (m,) where it begins.
            index: of the value.
            along: (m,) how the others follow it.
            width: how far it may go in any case.
        """
        longest = _LONGEST_STEPS[0 if self._kinematics.is_angle[index] else 1]
        lower, upper = self._kinematics.lower.copy(), self._kinematics.upper.copy()
        # Beyond half a turn the values come back from the other side.
        lower[index], upper[index] = (ends[index] for ends in self._kinematics.reach(values))
        step, most = _FIRST_STEP * width, self._settings.significance
        found, worse = [values], 0.0
        while lower[index] < found[-1][index] < upper[index] and self._proceed():
            trial = np.clip(found[-1] + min(step, longest) * along, lower, upper)
            looked = self._fit.refine(trial, _FOLLOW, held=(index,)).values
            before, worse = worse, self._excess(self._fit.piece_costs(looked, _LOOK))
            if worse > most:
                # Costs are parabolas in the rough, and their differences scatter as values differ.
                share = (most - before) / (worse - before)
                return [*found, found[-1] + share * (looked - found[-1])]
            found.append(looked)
            step *= _GROWTH
        return found

    def _describe(self, families: Sequence[_Family], J: Callable[[np.ndarray], float]) -> PoseSet:
        kinematics = self._kinematics
        described = tuple(
            PoseFamily.of_values(
                kinematics.tree, kinematics.split(family.values), J(family.values),
                self._joints([family]), family.size,
            )
            for family in families
        )  # fmt: skip
        return PoseSet(described, self._joints(families), self._tolerance, False, len(described))

    def _joints(self, families: Sequence[_Family]) -> tuple[JointEstimate, ...]:
        """Each value over some families."""
        kinematics = self._kinematics
        # All in the turns nearest to the first one.
        seen = np.array(
            [kinematics.nearest_turns(family.values, families[0].values) for family in families]
        )
        turns = seen - [family.values for family in families]
        lower, upper = kinematics.reach(families[0].values)
        low = np.maximum(np.min([one.low for one in families] + turns, axis=0), lower)
        high = np.minimum(np.max([one.high for one in families] + turns, axis=0), upper)
        determined = (high - low <= self._widest()) & (not self._broken)
        return joint_estimates(kinematics, low, high, determined, np.round(seen, 12))
