"""Where a lost limb or a lost person is: coarse guesses all over, the best of them fitted.

Guesses are judged in small pictures of a few cameras; only what is promising is fitted to all.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import ContourFit, PoseFit, Prior
from drake_pose.fit.kernel import COMPARED, FITTING
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.person.body_plan import BodyPlan, PlannedLimb, crowding
from drake_pose.person.frame_views import FrameViews
from drake_pose.person.limb_placement import score_limb_placements, worth_of_pixels

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Limbs whose tips are farther apart are not alike [m].
_UNALIKE = 0.25
# How much of its length a nearly stretched limb reaches.
_NEARLY = 0.9
# Tips that are nearer are about in the same place [m].
_NEAR = 0.15
# How much of a fit tells which guess is promising.
_JUDGED = 3
_ROUGHER = 1.5


@dataclass(frozen=True)
class SearchSettings:
    """How a lost limb or person is searched.

    Args:
        rounds: the steps of a fit from a coarse guess.
        limb_fits: a limb is searched again where less of its own contour fits.
        limb_gain: or where elsewhere so much more of it would lie in unexplained pixels.
        limb_shows: or where it shows less contour than this share of its length in each camera.
        headings: into how many directions a lost person is turned.
        headings_a_frame: how many of them in each frame of a sequence.
        limbs_a_frame: how many doubtful limbs are searched again in each frame of a sequence.
        fitted: the share of the fresh starts, the most promising ones, that is fitted.
        mended: where nothing is known yet, for how many of these all doubtful limbs are searched.
    """

    rounds: tuple[AnnealingStage, ...] = (
        AnnealingStage(0.15, 0.06),
        AnnealingStage(0.10, 0.06),
        AnnealingStage(0.07, 0.06),
        AnnealingStage(0.05, 0.06),
        AnnealingStage(0.03, 0.05),
        AnnealingStage(0.02, 0.05),
    )
    limb_fits: float = 0.8
    limb_gain: float = 0.15
    limb_shows: float = 0.5
    headings: int = 12
    headings_a_frame: int = 3
    limbs_a_frame: int = 2
    fitted: float = 0.5
    mended: int = 3

    def __post_init__(self) -> None:
        if not self.rounds:
            raise SettingsError("a search needs one round or more")
        for name in ("headings", "headings_a_frame", "limbs_a_frame", "mended"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} must be 1 or more, not {getattr(self, name)}")
        if not 0.0 < self.fitted <= 1.0:
            raise SettingsError(f"fitted must be a share above 0, at most 1, not {self.fitted}")

    @property
    def cycle(self) -> int:
        """In how many frames all headings are tried."""
        return -(-self.headings // self.headings_a_frame)

    def turns(self, frame: int) -> list[int]:
        """The headings tried in a frame, counted since the trouble began: all around, then between.

        Together the frames try all of them.
        """
        # Bits in reverse order make neighbours late.
        order = sorted(range(self.cycle), key=lambda k: f"{k:032b}"[::-1])
        return list(range(order[frame % self.cycle], self.headings, self.cycle))


class PersonSearch:
    """Searches limbs and persons.

    Attributes:
        settings: how.

    Args:
        fit: what compares a pose with the regions.
        plan: the person's limbs.
        settings: how.
        information: (m,) what is known of values near a guess.
        held: (m,) values that stay.
        rest: (m,) values of a person at rest, with the held ones.
    """

    def __init__(
        self,
        fit: ContourFit,
        plan: BodyPlan,
        settings: SearchSettings,
        information: Array,
        held: Mask,
        rest: Array,
    ) -> None:
        self.settings = settings
        self._fit, self._plan = fit, plan
        self._information, self._held, self._rest = information, held, rest
        self._coarse_rounds = [
            replace(one, spacing=_ROUGHER * one.spacing) for one in settings.rounds[:_JUDGED]
        ]

    def mended(
        self, fitted: PoseFit, frame_views: FrameViews, enough: float = math.inf, first: int = 0,
        limbs: int | None = None,
    ) -> PoseFit:  # fmt: skip
        """A fit whose doubtful limbs were searched again, where that is better.

        Args:
            fitted: the fit.
            frame_views: the frame.
            enough: where this much of the contours fits, the search ends.
            first: the doubtful limb to begin with; the worst is 0.
            limbs: how many limbs are searched; None: all that are doubtful.
        """
        best = _better(fitted, self._refine(fitted.values, frame_views))
        if best.inlier_ratio >= enough:
            return best
        doubtful = self._doubtful(best, frame_views)
        begin = first % len(doubtful)
        chosen = (doubtful[begin:] + doubtful[:begin])[:limbs]
        return self._searched(best, chosen, frame_views, enough)

    def _searched(
        self, best: PoseFit, limbs: Iterable[PlannedLimb], frame_views: FrameViews, enough: float
    ) -> PoseFit:
        """A fit whose limbs were searched again, until enough of the contours fits."""
        for limb in limbs:
            guesses = self._placed(best.values, limb, frame_views)
            for pose in (limb.poses[0], *self._stretched(best.values, limb)):
                guesses.append(best.values.copy())
                guesses[-1][limb.values] = pose
            for values in guesses:
                best = _better(best, self._refine(values, frame_views))
            if best.inlier_ratio >= enough:
                break
        return best

    def found(
        self,
        frame_views: FrameViews,
        turns: Sequence[int],
        known: Array | None = None,
        enough: float = math.inf,
    ) -> PoseFit | None:
        """The best of fresh starts with some headings.

        Args:
            frame_views: the frame.
            turns: which of the headings; where not all, only the best start's limbs are searched.
            known: (m,) where held values are taken from; None: the person at rest.
            enough: where this much of the contours fits, no more limbs are searched.

        Returns:
            None where fewer than two cameras see a person.
        """
        middle = frame_views.middle()
        if middle is None:
            return None
        guesses = [self._guess(frame_views, turn, middle, known) for turn in turns]
        guesses.sort(key=lambda one: -one.closeness)
        promising = guesses[: math.ceil(self.settings.fitted * len(guesses))]
        found = [self._refine(one.values, frame_views) for one in promising]
        found.sort(key=lambda one: -one.closeness)
        if len(turns) < self.settings.headings:
            return self.mended(found[0], frame_views, enough, limbs=self.settings.limbs_a_frame)
        mended = [self.mended(one, frame_views) for one in found[: self.settings.mended]]
        best = max(mended, key=lambda one: one.closeness)
        return self._searched(best, self._plan.limbs.values(), frame_views, math.inf)

    def _guess(
        self, frame_views: FrameViews, turn: int, middle: Array, known: Array | None
    ) -> PoseFit:
        """A person turned somewhere, the trunk fitted roughly, then each limb placed."""
        values = self._rest.copy() if known is None else np.where(self._held, known, self._rest)
        if self._plan.heading is not None:
            values[self._plan.heading] = 2.0 * np.pi * turn / self.settings.headings
        values = self._judged(self._stand_at(values, middle), frame_views).values
        placed = np.ones(len(self._fit.outlines), dtype=np.bool_)
        for limb in self._plan.limbs.values():
            placed[limb.nodes] = False
        for limb in self._plan.limbs.values():
            values = self._placed(values, limb, frame_views, placed, 1)[0]
            placed[limb.nodes] = True
        return self._judged(values, frame_views)

    def _judged(self, values: Array, frame_views: FrameViews) -> PoseFit:
        """A few steps of a fit to a few cameras."""
        prior = Prior(values, 0.1 * self._information)
        return self._fit.fit(*frame_views.coarse, values, self._coarse_rounds, prior, self._held)

    def _refine(self, values: Array, frame_views: FrameViews) -> PoseFit:
        """A fit from a coarse guess, which is trusted little."""
        prior = Prior(values, 0.1 * self._information)
        rounds = self.settings.rounds
        add_up = frame_views.add_up(self._fit)
        return self._fit.fit_sums(add_up, values, rounds, prior, self._held)

    def _doubtful(self, fitted: PoseFit, frame_views: FrameViews) -> list[PlannedLimb]:
        """The limbs that fit badly, hardly show, or would fill much more of the regions elsewhere.

        The worst one is always among them: somewhere something does not fit.
        """
        settings = self.settings
        lengths, fitting = fitted.sums[:, [COMPARED, FITTING]].T
        shares = np.where(lengths > 0.0, fitting / np.maximum(lengths, 1e-9), 1.0)
        found = []
        for limb in self._plan.limbs.values():
            share = shares[limb.nodes].min()
            shown = lengths[limb.nodes].sum() / (limb.length * len(frame_views.cameras))
            scores, now = self._scores(fitted.values, limb, frame_views)
            gain = float(scores.max() - now)
            doubtful = (
                share < settings.limb_fits
                or shown < settings.limb_shows
                or gain > settings.limb_gain
            )
            found.append((not doubtful, share - gain, limb))
        found.sort(key=lambda one: one[:2])
        return [limb for k, (good, _, limb) in enumerate(found) if k == 0 or not good]

    def _scores(
        self, values: Array, limb: PlannedLimb, frame_views: FrameViews, placed: Mask | None = None
    ) -> tuple[Array, float]:
        """How much each pose of a limb would fill, and how much the limb fills where it is."""
        X_WN = self._fit.kinematics.poses(values)
        others = np.ones(len(X_WN), dtype=np.bool_) if placed is None else placed.copy()
        others[limb.nodes] = False
        outlines = [self._fit.outlines[node] for node in np.flatnonzero(others)]
        cameras, regions = frame_views.small
        worth = worth_of_pixels(cameras, regions, outlines, X_WN[others])
        X_WT = X_WN[self._plan.trunk]
        places = limb.samples_T @ X_WT[:3, :3].T + X_WT[:3, 3]
        here = self._plan.samples(limb, X_WN)[None]
        now = score_limb_placements(here, crowding(here), cameras, worth)[0]
        return score_limb_placements(places, limb.weights, cameras, worth), float(now)

    def _placed(
        self,
        values: Array,
        limb: PlannedLimb,
        frame_views: FrameViews,
        placed: Mask | None = None,
        count: int = 2,
    ) -> list[Array]:
        """Values (m,) with a limb where it fills most, in a few ways that are not alike."""
        scores, _ = self._scores(values, limb, frame_views, placed)
        found: list[Array] = []
        tips: list[Array] = []
        for index in np.argsort(-scores):
            tip = limb.samples_T[index, -1]
            if all(np.linalg.norm(tip - other) > _UNALIKE for other in tips):
                tips.append(tip)
                found.append(values.copy())
                found[-1][limb.values] = limb.poses[index]
                if len(found) == count:
                    break
        return found

    def _stretched(self, values: Array, limb: PlannedLimb) -> list[Array]:
        """A nearly stretched limb's values, quite stretched: one slightly bent the wrong way is.

        Of the poses about there it is the most relaxed one, as such a limb hardly shows its twist.
        """
        X_WN = self._fit.kinematics.poses(values)
        root, _, end = self._plan.landmarks.positions(X_WN)[limb.joints]
        if np.linalg.norm(end - root) < _NEARLY * limb.length:
            return []
        X_WT = X_WN[self._plan.trunk]
        tip = (self._plan.samples(limb, X_WN)[-1] - X_WT[:3, 3]) @ X_WT[:3, :3]
        off = np.linalg.norm(limb.samples_T[limb.stretched, -1] - tip, axis=1)
        poses = limb.poses[limb.stretched[off < _NEAR]]
        effort = np.abs(poses - limb.poses[0]).sum(axis=1)
        return [] if not len(poses) else [poses[np.argmin(effort)]]

    def _stand_at(self, values: Array, middle: Array) -> Array:
        """Values (m,) with the trunk's middle at a place (3,) [m]."""
        kinematics = self._fit.kinematics
        off = middle - self._plan.trunk_middle(kinematics.poses(values))
        motions = kinematics.motions(values)
        root = np.flatnonzero(~kinematics.is_angle & motions.moves[0] & ~self._held)
        # The root's place is three lengths along the world's axes.
        for index in root:
            values[index] += float(motions.twists[index, 3:6] @ off)
        return values


def _better(one: PoseFit, other: PoseFit) -> PoseFit:
    """The one that fits better."""
    return other if other.closeness > one.closeness else one
