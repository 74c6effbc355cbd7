"""A person followed by all silhouettes at once; a lost limb or track is searched again.

Every frame is fitted from where the last ones point to. Where too little of the contours fits, the
limbs that do not fit are placed anew where the regions are unexplained; where all is lost, the
whole person is, turned to all sides in turn. No registered pose and no skin colour is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera import Camera
from drake_pose.errors import SettingsError
from drake_pose.multiview.body_plan import BodyPlan, PlannedLimb, crowding
from drake_pose.multiview.limb_places import score_places, worth_of_pixels
from drake_pose.multiview.rays import meeting_of_all
from drake_pose.multiview.silhouette_edges import EdgePoints, find_edge_points
from drake_pose.multiview.silhouette_fit import PoseFit, Prior, Round, SilhouetteFit

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


# Limbs whose tips are farther apart are not alike [m].
_UNALIKE = 0.25
# So many of the best fresh starts are searched further.
_MENDED = 3
# What share of the contours fits where the model is the person, until it is known better.
_USUAL = 0.95


@dataclass(frozen=True)
class TrackerSettings:
    """How a person is followed.

    Args:
        rounds: the steps of a frame's fit.
        restart_rounds: the steps from a rough guess.
        carry: the share of the last frame's step that is expected again.
        angle_deviation, length_deviation: how far the expectation is off [rad, m].
        retry_below: where so much less of the contours fits than usual, limbs are searched again.
        lost_below: where less than this share of the usual fits, the whole person is.
        limb_fits: a limb is searched again where less of its own contour fits.
        limb_gain: or where elsewhere so much more of it would lie in unexplained pixels.
        limb_shows: or where it shows less contour than this share of its length in each camera.
        memory: for how many frames the usual share is remembered.
        headings: into how many directions a lost person is turned.
        headings_a_frame: so many of them in each frame.
    """

    rounds: tuple[Round, ...] = (
        Round(0.08, 0.06),
        Round(0.04, 0.06),
        Round(0.02, 0.05),
    )
    restart_rounds: tuple[Round, ...] = (
        Round(0.15, 0.06),
        Round(0.10, 0.06),
        Round(0.07, 0.06),
        Round(0.05, 0.06),
        Round(0.03, 0.05),
        Round(0.02, 0.05),
    )
    carry: float = 0.7
    angle_deviation: float = 0.3
    length_deviation: float = 0.15
    retry_below: float = 0.03
    lost_below: float = 0.75
    limb_fits: float = 0.8
    limb_gain: float = 0.15
    limb_shows: float = 0.5
    memory: float = 60.0
    headings: int = 12
    headings_a_frame: int = 4

    def __post_init__(self) -> None:
        if not self.rounds or not self.restart_rounds:
            raise SettingsError("a tracker needs one round or more")
        if self.headings < 1 or self.headings_a_frame < 1:
            raise SettingsError("a tracker must turn a lost person into one direction or more")


@dataclass(frozen=True, eq=False)
class SilhouetteView:
    """What one camera says.

    Args:
        region: (H, W) the person.
        edge: points of the region's edge.
    """

    region: Mask
    edge: EdgePoints


@dataclass(frozen=True, eq=False)
class TrackState:
    """What the next frame is told of this one.

    Args:
        values: (m,) of the pose tree [rad or m].
        step: (m,) how they changed from the frame before.
        share: of the contours, what fits.
        usual: the share that can be expected.
        troubled: for how many frames too little has fitted.
    """

    values: Array
    step: Array
    share: float
    usual: float
    troubled: int = 0


def see_silhouette(region: Mask, spacing: float) -> SilhouetteView:
    """One camera's share: the edge of the person's region, a point every so many pixels."""
    return SilhouetteView(region, find_edge_points(region, spacing))


class SilhouetteTracker:
    """Follows a person.

    Attributes:
        fit: what compares a pose with the regions.
        plan: the person's limbs.
        settings: how.

    Args:
        fit: made for the person's pose tree.
        settings: how.
        held: (m,) values that stay, such as lengths; None: none.
        rest: (m,) values of a person at rest, with the held ones; None: the tree's.

    Raises:
        ModelError: the model has no landmarks of trunk, arms and legs.
        UnknownNameError: a value of the pose tree is no position of the plant.
    """

    def __init__(
        self,
        fit: SilhouetteFit,
        settings: TrackerSettings | None = None,
        held: Mask | None = None,
        rest: Array | None = None,
    ) -> None:
        self.fit, self.settings = fit, settings or TrackerSettings()
        self.plan = BodyPlan(fit.kinematics)
        is_angle = fit.kinematics.is_angle
        self._held = np.zeros(len(is_angle), dtype=np.bool_) if held is None else held
        settings = self.settings
        deviation = np.where(is_angle, settings.angle_deviation, settings.length_deviation)
        self._information = 1.0 / deviation**2
        model = fit.tree.model
        self._order = np.array([model.position_index(name) for name in fit.kinematics.names])
        usual = fit.kinematics.flatten(fit.tree.default_values())
        self._rest = usual if rest is None else rest

    def start(self, values: Array) -> TrackState:
        """A state at rest at values (m,) of the pose tree."""
        return TrackState(np.array(values, dtype=np.float64), np.zeros(len(values)), 1.0, _USUAL)

    def positions(self, values: Array) -> Array:
        """The plant's positions q (nq,) of values (m,), angles that turn freely within half a turn.

        The pose tree's root must hang on joints, as that of urdf/person does.
        """
        free = np.isinf(self.fit.upper)
        turned = np.where(free, np.remainder(values + np.pi, 2.0 * np.pi) - np.pi, values)
        q = np.array(self.fit.tree.model.default_positions)
        q[self._order] = turned
        return q

    def values(self, q: Array) -> Array:
        """The pose tree's values (m,) of positions q (nq,)."""
        return np.array(q, dtype=np.float64)[self._order]

    def follow(
        self,
        last: TrackState | None,
        cameras: Sequence[Camera],
        views: Sequence[SilhouetteView],
    ) -> TrackState | None:
        """The next frame.

        Args:
            last: the last frame's state; None where nothing is known yet.
            cameras: those that have a picture.
            views: what each of them says.

        Returns:
            None where nothing is known yet and fewer than two cameras see a person.
        """
        if last is None:
            return self._restart(None, cameras, views, range(self.settings.headings))
        edges = [view.edge for view in views]
        expected = last.values + self.settings.carry * last.step
        fitted = self.fit.fit(
            cameras,
            edges,
            expected,
            self.settings.rounds,
            Prior(expected, self._information),
            self._held,
        )
        settings = self.settings
        enough = last.usual - settings.retry_below
        due = fitted.share < enough and _is_due(last.troubled)
        if due:
            fitted = self._mended(fitted, cameras, views)
        state = TrackState(
            fitted.values,
            fitted.values - last.values if last.troubled == 0 else np.zeros(len(last.values)),
            fitted.share,
            max(fitted.share, last.usual + (fitted.share - last.usual) / settings.memory),
            last.troubled + 1 if fitted.share < enough else 0,
        )
        lost = fitted.share < settings.lost_below * last.usual
        if not lost and not (due and fitted.share < enough and last.troubled > 0):
            return state
        first = last.troubled * settings.headings_a_frame
        turns = [k % settings.headings for k in range(first, first + settings.headings_a_frame)]
        return self._restart(state, cameras, views, turns)

    def _mended(
        self, fitted: PoseFit, cameras: Sequence[Camera], views: Sequence[SilhouetteView]
    ) -> PoseFit:
        """A fit whose doubtful limbs were searched again, where that is better."""
        best = _better(fitted, self._refine(fitted.values, cameras, views))
        for limb in self._doubtful(best, cameras, views):
            rested = best.values.copy()
            rested[limb.values] = limb.poses[0]
            for values in (*self._placed(best.values, limb, cameras, views), rested):
                best = _better(best, self._refine(values, cameras, views))
        return best

    def _doubtful(
        self, fitted: PoseFit, cameras: Sequence[Camera], views: Sequence[SilhouetteView]
    ) -> list[PlannedLimb]:
        """The limbs that fit badly, hardly show, or would fill much more of the regions elsewhere.

        The worst one is always among them: somewhere something does not fit.
        """
        settings = self.settings
        lengths, fitting = fitted.agreement.T
        shares = np.where(lengths > 0.0, fitting / np.maximum(lengths, 1e-9), 1.0)
        found = []
        for limb in self.plan.limbs.values():
            share = shares[limb.nodes].min()
            shown = lengths[limb.nodes].sum() / (limb.length * len(cameras))
            scores, now = self._scores(fitted.values, limb, cameras, views)
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
        self,
        values: Array,
        limb: PlannedLimb,
        cameras: Sequence[Camera],
        views: Sequence[SilhouetteView],
        placed: Mask | None = None,
    ) -> tuple[Array, float]:
        """How much each pose of a limb would fill, and how much the limb fills where it is."""
        X_WN = self.fit.kinematics.poses(values)
        others = np.ones(len(X_WN), dtype=np.bool_) if placed is None else placed.copy()
        others[limb.nodes] = False
        outlines = [self.fit.outlines[node] for node in np.flatnonzero(others)]
        worth = worth_of_pixels(cameras, [view.region for view in views], outlines, X_WN[others])
        X_WT = X_WN[self.plan.trunk]
        places = limb.samples_T @ X_WT[:3, :3].T + X_WT[:3, 3]
        here = self.plan.samples(limb, X_WN)[None]
        now = score_places(here, crowding(here), cameras, worth)[0]
        return score_places(places, limb.weights, cameras, worth), float(now)

    def _placed(
        self,
        values: Array,
        limb: PlannedLimb,
        cameras: Sequence[Camera],
        views: Sequence[SilhouetteView],
        placed: Mask | None = None,
        count: int = 2,
    ) -> list[Array]:
        """Values (m,) with a limb where it fills most, in a few ways that are not alike."""
        scores, _ = self._scores(values, limb, cameras, views, placed)
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

    def _refine(
        self, values: Array, cameras: Sequence[Camera], views: Sequence[SilhouetteView]
    ) -> PoseFit:
        """A fit from a rough guess, which is trusted little."""
        return self.fit.fit(
            cameras,
            [view.edge for view in views],
            values,
            self.settings.restart_rounds,
            Prior(values, 0.1 * self._information),
            self._held,
        )

    def _restart(
        self,
        last: TrackState | None,
        cameras: Sequence[Camera],
        views: Sequence[SilhouetteView],
        turns: Sequence[int],
    ) -> TrackState | None:
        """The best of fresh starts with some headings, or the last state where that is better."""
        seers = [(c, v) for c, v in zip(cameras, views, strict=True) if len(v.edge.uv)]
        if len(seers) < 2:
            return last
        middle = meeting_of_all([c for c, _ in seers], [v.edge.middle for _, v in seers])
        found = []
        for turn in turns:
            values = np.where(self._held, self._rest if last is None else last.values, self._rest)
            if self.plan.heading is not None:
                values[self.plan.heading] = 2.0 * np.pi * turn / self.settings.headings
            values = self._refine(self._stand_at(values, middle), cameras, views).values
            placed = np.ones(len(self.fit.outlines), dtype=np.bool_)
            for limb in self.plan.limbs.values():
                placed[limb.nodes] = False
            for limb in self.plan.limbs.values():
                values = self._placed(values, limb, cameras, views, placed, 1)[0]
                placed[limb.nodes] = True
            found.append(self._refine(values, cameras, views))
        found.sort(key=lambda one: -one.share)
        best = max(
            (self._mended(one, cameras, views) for one in found[:_MENDED]),
            key=lambda one: one.share,
        )
        if last is not None and best.share <= last.share:
            return last
        still = np.zeros(len(best.values))
        if last is None:
            return TrackState(best.values, still, best.share, _USUAL)
        return TrackState(best.values, still, best.share, last.usual, last.troubled)

    def _stand_at(self, values: Array, middle: Array) -> Array:
        """Values (m,) with the trunk's middle at a place (3,) [m]."""
        kinematics = self.fit.kinematics
        off = middle - self.plan.trunk_middle(kinematics.poses(values))
        motions = kinematics.motions(values)
        root = np.flatnonzero(~kinematics.is_angle & motions.moves[0] & ~self._held)
        # The root's place is three lengths along the world's axes.
        for index in root:
            values[index] += float(motions.twists[index, 3:6] @ off)
        return values


def _better(one: PoseFit, other: PoseFit) -> PoseFit:
    """The one of which more fits."""
    return other if other.share > one.share else one


def _is_due(troubled: int) -> bool:
    """Whether to search again after so many troubled frames: 0 to 3, then every eighth time."""
    return troubled < 4 or troubled % 8 == 0
