"""Where a lost limb or a lost person is: coarse guesses all over, the best of them fitted.

Guesses are judged in small pictures of a few cameras; only what is promising is fitted to all.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.errors import SettingsError
from drake_pose.fit.colours import colour_numbers
from drake_pose.fit.contour_fit import ContourFit, PoseFit, Prior
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.person.body_plan import UPPER_SAMPLES, BodyPlan, PlannedLimb, crowding
from drake_pose.person.views import ColourViews, FrameViews, sum_at_points
from drake_pose.silhouette.areas.scoring import draw_mask

HEADINGS = 12
"""Into how many directions a lost person is turned."""
# How many of them in each frame of a sequence, and in how many frames all are tried.
_HEADINGS_A_FRAME = 3
CYCLE = HEADINGS // _HEADINGS_A_FRAME
LIMBS_A_FRAME = 2
"""How many doubtful limbs are searched again in each frame of a sequence."""

# A limb is searched again where less of its own contour fits, where elsewhere so much more of it
# would lie in unexplained pixels, or where it shows less contour than this share of its length.
_LIMB_FITS, _LIMB_GAIN, _LIMB_SHOWS = 0.8, 0.15, 0.5
# The share of the fresh starts, the most promising ones, that is fitted; and where nothing is known
# yet, for how many of these all doubtful limbs are searched.
_FITTED, _MENDED = 0.5, 3
# In how many ways a limb is placed by its colours.
_RECOLOURED = 3
# Limbs whose tips are farther apart are not alike, and limbs that are nearer about the same [m].
_UNALIKE, _NEAR = 0.25, 0.15
# How much of a fit tells which guess is promising.
_JUDGED, _ROUGHER = 3, 1.5


@dataclass(frozen=True)
class AnnealingSchedule:
    """The steps of a frame's fit from where the last ones point to, and from a coarse guess."""

    follow: tuple[AnnealingStage, ...]
    search: tuple[AnnealingStage, ...]

    def __post_init__(self) -> None:
        if not self.follow or not self.search:
            raise SettingsError("a tracker and its search need one round or more")


_ENDS = (AnnealingStage(0.07, 0.05), AnnealingStage(0.05, 0.05), AnnealingStage(0.04, 0.04))
EXACT = AnnealingSchedule(
    (AnnealingStage(0.08, 0.06), AnnealingStage(0.04, 0.06), AnnealingStage(0.02, 0.05)),
    (
        *(AnnealingStage(scale, 0.06) for scale in (0.15, 0.10, 0.07, 0.05)),
        AnnealingStage(0.03, 0.05),
        AnnealingStage(0.02, 0.05),
    ),
)
"""For a model that is the person."""
LENIENT = AnnealingSchedule(
    (AnnealingStage(0.10, 0.06), *_ENDS),
    (*(AnnealingStage(scale, 0.06) for scale in (0.20, 0.15, 0.10)), *_ENDS),
)
"""For a model that is only like the person: it fits to within centimetres."""


def headings_of(frame: int) -> list[int]:
    """The headings tried in a frame of trouble, all around first; CYCLE frames try all HEADINGS."""
    # Bits in reverse order make neighbours late.
    order = sorted(range(CYCLE), key=lambda k: f"{k:032b}"[::-1])
    return list(range(order[frame % CYCLE], HEADINGS, CYCLE))


class PersonSearch:
    """Searches limbs and persons by fits of some rounds from coarse guesses.

    `information`, `held` and `rest` (m,) are what is known of values near a guess, which of them
    stay, and those of a person at rest.
    """

    def __init__(
        self,
        fit: ContourFit,
        plan: BodyPlan,
        rounds: Sequence[AnnealingStage],
        information: Array,
        held: Mask,
        rest: Array,
    ) -> None:
        self._fit, self._plan, self._rounds = fit, plan, rounds
        self._information, self._held, self._rest = information, held, rest
        self._coarse = [replace(one, spacing=_ROUGHER * one.spacing) for one in rounds[:_JUDGED]]

    def mended(
        self,
        fitted: PoseFit,
        frame: FrameViews,
        enough: float = math.inf,
        first: int = 0,
        limbs: int | None = None,
    ) -> PoseFit:
        """A fit whose doubtful limbs were searched again, where that is better.

        Args:
            enough: where this much of the contours fits, the search ends.
            first: the doubtful limb to begin with; the worst is 0.
            limbs: how many limbs are searched; None: all that are doubtful.
        """
        best = _better(fitted, self._refine(fitted.values, frame))
        if best.inlier_ratio >= enough:
            return best
        doubtful = self._doubtful(best, frame)
        begin = first % len(doubtful)
        chosen = (doubtful[begin:] + doubtful[:begin])[:limbs]
        return self._searched(best, chosen, frame, enough)

    def _searched(
        self, best: PoseFit, limbs: Iterable[PlannedLimb], frame: FrameViews, enough: float
    ) -> PoseFit:
        """A fit whose limbs were searched again, until enough of the contours fits."""
        for limb in limbs:
            guesses = self._placed(best.values, limb, frame)
            for pose in (limb.poses[0], *self._relaxed(best.values, limb)):
                guesses.append(best.values.copy())
                guesses[-1][limb.values] = pose
            for values in guesses:
                best = _better(best, self._refine(values, frame))
            if best.inlier_ratio >= enough:
                break
        return best

    def found(
        self,
        frame: FrameViews,
        headings: Sequence[int],
        known: Array | None = None,
        enough: float = math.inf,
    ) -> PoseFit | None:
        """The best of fresh starts with some headings; None where not two cameras see a person.

        Args:
            headings: where not all, only the best start's limbs are searched.
            known: (m,) where held values are taken from; None: the person at rest.
            enough: where this much of the contours fits, no more limbs are searched.
        """
        middle = frame.middle()
        if middle is None:
            return None
        guesses = [self._guess(frame, heading, middle, known) for heading in headings]
        guesses.sort(key=lambda one: -one.closeness)
        promising = guesses[: math.ceil(_FITTED * len(guesses))]
        found = [self._refine(one.values, frame) for one in promising]
        found.sort(key=lambda one: -one.closeness)
        if len(headings) < HEADINGS:
            return self.mended(found[0], frame, enough, limbs=LIMBS_A_FRAME)
        mended = [self.mended(one, frame) for one in found[:_MENDED]]
        best = max(mended, key=lambda one: one.closeness)
        while True:
            others = [self._refine(values, frame) for values in self._exchanged(best.values)]
            other = max(others, key=lambda one: one.closeness)
            if other.closeness <= best.closeness:
                return self._searched(best, self._plan.limbs.values(), frame, math.inf)
            best = self.mended(other, frame)

    def _guess(
        self, frame: FrameViews, heading: int, middle: Array, known: Array | None
    ) -> PoseFit:
        """A person turned somewhere, the trunk fitted roughly, then each limb placed."""
        values = self._rest.copy() if known is None else np.where(self._held, known, self._rest)
        if self._plan.heading is not None:
            values[self._plan.heading] = 2.0 * np.pi * heading / HEADINGS
        values = self._judged(self._stand_at(values, middle), frame).values
        placed = np.ones(len(self._fit.outlines), dtype=np.bool_)
        for limb in self._plan.limbs.values():
            placed[limb.nodes] = False
        for limb in self._plan.limbs.values():
            values = self._placed(values, limb, frame, placed, 1)[0]
            placed[limb.nodes] = True
        return self._judged(values, frame)

    def _judged(self, values: Array, frame: FrameViews) -> PoseFit:
        """A few steps of a fit to a few cameras."""
        prior = Prior(values, 0.1 * self._information)
        return self._fit.fit(frame.coarse, values, self._coarse, prior, self._held)

    def _refine(self, values: Array, frame: FrameViews | ColourViews) -> PoseFit:
        """A fit from a coarse guess, which is trusted little."""
        prior = Prior(values, 0.1 * self._information)
        compare = partial(frame.compare, self._fit)
        return self._fit.fit(compare, values, self._rounds, prior, self._held)

    def _doubtful(self, fitted: PoseFit, frame: FrameViews) -> list[PlannedLimb]:
        """The limbs that fit badly, hardly show, or would fill more elsewhere; always the worst."""
        lengths, fitting = fitted.sums[:, [Sum.COMPARED, Sum.FITTING]].T
        shares = np.where(lengths > 0.0, fitting / np.maximum(lengths, 1e-9), 1.0)
        found = []
        for limb in self._plan.limbs.values():
            share = shares[limb.nodes].min()
            shown = lengths[limb.nodes].sum() / (limb.length * len(frame.cameras))
            scores, now = self._scores(fitted.values, limb, frame)
            gain = float(scores.max() - now)
            doubtful = share < _LIMB_FITS or shown < _LIMB_SHOWS or gain > _LIMB_GAIN
            found.append((not doubtful, share - gain, limb))
        found.sort(key=lambda one: one[:2])
        return [limb for k, (good, _, limb) in enumerate(found) if k == 0 or not good]

    def _scores(
        self, values: Array, limb: PlannedLimb, frame: FrameViews, placed: Mask | None = None
    ) -> tuple[Array, float]:
        """How much each pose of a limb would fill that nothing else explains, and it fills now."""
        X_WN = self._fit.kinematics.poses(values)
        others = np.ones(len(X_WN), dtype=np.bool_) if placed is None else placed.copy()
        others[limb.nodes] = False
        outlines = [self._fit.outlines[node] for node in np.flatnonzero(others)]
        X_WT = X_WN[self._plan.trunk]
        places = limb.places(X_WT)
        here = self._plan.samples(limb, X_WN)[None]
        scores, now, weights = np.zeros(len(places)), 0.0, crowding(here)
        for camera, region in zip(*frame.small, strict=True):
            # A pixel is worth 1 in the region where the others do not show, 0 where they do.
            worth = np.where(region, 1, -1).astype(np.int8)
            worth[region & draw_mask(outlines, camera.X_CW @ X_WN[others], camera)] = 0
            scores += sum_at_points(camera, worth, places, limb.weights)[0]
            now += float(sum_at_points(camera, worth, here, weights)[0][0])
        return scores / len(frame.judges), now / len(frame.judges)

    def _placed(
        self,
        values: Array,
        limb: PlannedLimb,
        frame: FrameViews,
        placed: Mask | None = None,
        count: int = 2,
    ) -> list[Array]:
        """Values (m,) with a limb where it fills most, in a few ways that are not alike."""
        scores, _ = self._scores(values, limb, frame, placed)
        return self._unalike(values, limb, scores, count)

    @staticmethod
    def _unalike(values: Array, limb: PlannedLimb, scores: Array, count: int) -> list[Array]:
        """Values (m,) with the limb's best poses by scores (n,) that are not alike."""
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

    def _relaxed(self, values: Array, limb: PlannedLimb) -> list[Array]:
        """The most relaxed values of a limb about where it is: it may be bent the wrong way."""
        off = self._off(values, limb, self._plan.samples(limb, self._fit.kinematics.poses(values)))
        poses = limb.poses[off < _NEAR]
        effort = np.abs(poses - limb.poses[0]).sum(axis=1)
        return [] if not len(poses) else [poses[np.argmin(effort)]]

    def placed_by_colour(
        self, values: Array, limb: PlannedLimb, views: ColourViews, own: Mask
    ) -> list[PoseFit]:
        """Fits whose limb was placed where its own colours (nodes, COLOURS) are seen most."""
        X_WT = self._fit.kinematics.poses(values)[self._plan.trunk]
        places = limb.places(X_WT)
        half, scores = len(limb.nodes) // 2, np.zeros(len(places))
        for camera, picture in zip(views.cameras, views.pictures, strict=True):
            colours = colour_numbers(picture)
            for nodes, points in (
                (limb.nodes[:half], np.s_[:, :UPPER_SAMPLES]),
                (limb.nodes[half:], np.s_[:, UPPER_SAMPLES:]),
            ):
                worth = np.where(own[nodes].any(axis=0), 1, -1).astype(np.int8)[colours]
                weights = np.ascontiguousarray(limb.weights[points])
                scores += sum_at_points(
                    camera, worth, np.ascontiguousarray(places[points]), weights
                )[0]
        chosen = self._unalike(values, limb, scores, _RECOLOURED)
        return [self._refine(one, views) for one in chosen]

    def _exchanged(self, values: Array) -> list[Array]:
        """Values (m,) that look much alike: both arms or legs exchanged; turned about."""
        plan, found = self._plan, []
        X_WN = self._fit.kinematics.poses(values)
        for turn, parts in ((0.0, ("arm",)), (0.0, ("leg",)), (math.pi, ("arm", "leg"))):
            other = values.copy()
            if turn and plan.heading is not None:
                other[plan.heading] += turn
                other = self._stand_at(other, plan.trunk_middle(X_WN))
            for part in parts:
                for side, its in (("left", "right"), ("right", "left")):
                    limb, there = plan.limbs[f"{side}_{part}"], plan.limbs[f"{its}_{part}"]
                    off = self._off(other, limb, plan.samples(there, X_WN))
                    other[limb.values] = limb.poses[np.argmin(off)]
            found.append(other)
        return found

    def _off(self, values: Array, limb: PlannedLimb, samples_W: Array) -> Array:
        """(n,) how far each pose of a limb is from points (m, 3) along one, at most [m]."""
        X_WT = self._fit.kinematics.poses(values)[self._plan.trunk]
        samples_T = (samples_W - X_WT[:3, 3]) @ X_WT[:3, :3]
        return np.asarray(np.linalg.norm(limb.samples_T - samples_T, axis=2).max(axis=1))

    def _stand_at(self, values: Array, middle: Array) -> Array:
        """Values (m,) with the trunk's middle at a place (3,) [m]."""
        kinematics = self._fit.kinematics
        off = middle - self._plan.trunk_middle(kinematics.poses(values))
        motions = kinematics.motions(values)
        # The root's place is three lengths along the world's axes.
        for index in np.flatnonzero(~kinematics.is_angle & motions.moves[0] & ~self._held):
            values[index] += float(motions.twists[index, 3:6] @ off)
        return values


def _better(one: PoseFit, other: PoseFit) -> PoseFit:
    return other if other.closeness > one.closeness else one
