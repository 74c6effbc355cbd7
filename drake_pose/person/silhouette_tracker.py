"""A person followed by all silhouettes at once; a lost limb or track is searched again.

Every frame is fitted from where the last ones point to. Where too little of the contours fits, the
limbs that do not fit are placed anew where the regions are unexplained; where all is lost, the
whole person is, turned to all sides in turn. No registered pose and no skin colour is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.fit.camera_sums import AddUp
from drake_pose.fit.contour_fit import ContourFit, PoseFit, Prior
from drake_pose.fit.kernel import COMPARED, FITTING, SQUARES, WEIGHT
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.person.body_plan import BodyPlan
from drake_pose.person.colour_views import ColourViews
from drake_pose.person.frame_views import FrameViews
from drake_pose.person.pose_uncertainty import PoseUncertainty, pose_uncertainty
from drake_pose.person.search import PersonSearch, SearchSettings
from drake_pose.person.silhouette_view import SilhouetteView

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


# Parts of which less contour is seen, in all cameras together [m], do not say that they are off.
_TELLING = 0.3

# What share of the contours fits where the model is the person, until it is known better.
_USUAL = 0.95


@dataclass(frozen=True)
class TrackerSettings:
    """How a person is followed.

    Args:
        rounds: the steps of a frame's fit.
        carry: the share of the last frame's step that is expected again.
        angle_deviation, length_deviation: how far the expectation is off [rad, m].
        retry_below: where so much less of the contours fits than usual, limbs are searched again.
        lost_below: where less than this share of the usual fits, the whole person is.
        part_lost_below: who is followed by colour is lost where less of one part's contour fits.
        memory: for how many frames the usual share is remembered.
        search: how limbs and persons are searched.
    """

    rounds: tuple[AnnealingStage, ...] = (
        AnnealingStage(0.08, 0.06),
        AnnealingStage(0.04, 0.06),
        AnnealingStage(0.02, 0.05),
    )
    carry: float = 0.7
    angle_deviation: float = 0.3
    length_deviation: float = 0.15
    retry_below: float = 0.03
    lost_below: float = 0.75
    part_lost_below: float = 0.4
    memory: float = 60.0
    search: SearchSettings = field(default_factory=SearchSettings)

    def __post_init__(self) -> None:
        if not self.rounds:
            raise SettingsError("a tracker needs one round or more")


@dataclass(frozen=True, eq=False)
class TrackState:
    """What the next frame is told of this one.

    Args:
        values: (m,) of the pose tree [rad or m].
        step: (m,) how they changed from the frame before.
        share: of the contours, what fits.
        usual: the share that can be expected.
        troubled: for how many frames too little has fitted; below 0: the person was found anew, and
            in this many frames all directions will have been tried.
        worst: of the contour of the part that fits worst, what fits, where colours say so.
    """

    values: Array
    step: Array
    share: float
    usual: float
    troubled: int = 0
    worst: float = 1.0


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
        fit: ContourFit,
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
        self._search = PersonSearch(
            fit,
            self.plan,
            settings.search,
            self._information,
            self._held,
            usual if rest is None else rest,
        )

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

    def uncertainty(
        self,
        values: Array,
        cameras: Sequence[Camera],
        views: Sequence[SilhouetteView],
        held_covariance: Array | None = None,
    ) -> PoseUncertainty:
        """How sure a frame's pose is, by its silhouettes alone.

        Args:
            values: (m,) of the frame's state.
            cameras, views: as in follow.
            held_covariance: (h, h) of the held values; None: they are exact.
        """
        edges = [view.edge for view in views]
        compared = self.fit.compare(cameras, edges, values, self.settings.rounds[-1])
        return pose_uncertainty(self.fit, compared, self._held, held_covariance)

    def uncertainty_by_colour(
        self, values: Array, colours: ColourViews, held_covariance: Array | None = None
    ) -> PoseUncertainty:
        """As uncertainty, of a frame that was followed by colour."""
        placement = self.fit.body.place(values)
        compared = colours.compare(self.fit, placement, self.settings.rounds[-1])
        return pose_uncertainty(self.fit, compared, self._held, held_covariance)

    def deviations(self, covariance: Array) -> Array:
        """(nq,) standard deviations of the plant's positions [rad or m] of a covariance (m, m).

        Positions that are no values of the pose tree have none: 0.
        """
        deviations = np.zeros(len(self.fit.tree.model.position_names))
        deviations[self._order] = np.sqrt(np.diag(covariance))
        return deviations

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
        frame_views = FrameViews(cameras, views)
        if last is None:
            found = self._search.found(frame_views, range(self.settings.search.headings))
            still = np.zeros(len(self._held))
            if found is None:
                return None
            return TrackState(found.values, still, found.inlier_ratio, _USUAL)
        fitted = self._fitted(last, frame_views.add_up(self.fit))
        settings, search = self.settings, self.settings.search
        enough = last.usual - settings.retry_below
        lost = fitted.inlier_ratio < settings.lost_below * last.usual
        due = fitted.inlier_ratio < enough and _is_due(last.troubled)
        if due and not lost:
            fitted = self._search.mended(
                fitted,
                frame_views,
                enough,
                last.troubled * search.limbs_a_frame,
                search.limbs_a_frame,
            )
        doubted = last.troubled < 0
        state = TrackState(
            fitted.values,
            fitted.values - last.values if last.troubled == 0 else np.zeros(len(last.values)),
            fitted.inlier_ratio,
            max(
                fitted.inlier_ratio,
                last.usual + (fitted.inlier_ratio - last.usual) / settings.memory,
            ),
            last.troubled + 1 if doubted or fitted.inlier_ratio < enough else 0,
        )
        hopeless = due and fitted.inlier_ratio < enough and last.troubled > 0
        return self._restarted(state, last, frame_views) if lost or doubted or hopeless else state

    def follow_by_colour(self, last: TrackState, colours: ColourViews) -> TrackState:
        """The next frame, where pictures say where the person's edge is.

        No limb is searched again: how lost the person is, `is_lost` says.

        Args:
            last: the last frame's state.
            colours: the pictures.
        """
        fitted = self._fitted(last, colours.add_up(self.fit))
        step = fitted.values - last.values
        lengths, fitting = fitted.sums[:-1, [COMPARED, FITTING]].T
        worst = np.min(fitting / np.maximum(lengths, 1e-9), where=lengths >= _TELLING, initial=1.0)
        return TrackState(fitted.values, step, fitted.inlier_ratio, last.usual, worst=float(worst))

    def distance_by_colour(self, values: Array, colours: ColourViews) -> float:
        """How far the contour at values (m,) is from the one that colours show, typically [pixel].

        nan where colours show none.
        """
        placement = self.fit.body.place(values)
        sums = colours.compare(self.fit, placement, self.settings.rounds[-1]).sums
        squares, weight = sums[:, :, [SQUARES, WEIGHT]].sum(axis=(0, 1))
        return float(np.sqrt(squares / weight)) if weight > 0.0 else float("nan")

    def is_lost(self, state: TrackState) -> bool:
        """Whether too little of the contours fits for the pose to be believed."""
        settings = self.settings
        return (
            state.share < settings.lost_below * state.usual
            or state.worst < settings.part_lost_below
        )

    def _restarted(
        self, state: TrackState, last: TrackState, frame_views: FrameViews
    ) -> TrackState:
        """A state, or the person found anew with some headings, where that fits better.

        The first heading that fits need not be the right one: people look alike from behind. So the
        search goes on until all have been tried.
        """
        search = self.settings.search
        turns = search.turns(last.troubled)
        found = self._search.found(frame_views, turns, last.values, last.usual)
        if found is None or found.inlier_ratio <= state.share:
            return state
        left = last.troubled + 1 if last.troubled < 0 else 1 - search.cycle
        still = np.zeros(len(found.values))
        return replace(
            state, values=found.values, step=still, share=found.inlier_ratio, troubled=left
        )

    def _fitted(self, last: TrackState, add_up: AddUp) -> PoseFit:
        """The frame fitted from where the last ones point to."""
        expected = last.values + self.settings.carry * last.step
        return self.fit.fit_sums(
            add_up,
            expected,
            self.settings.rounds,
            Prior(expected, self._information),
            self._held,
        )


def _is_due(troubled: int) -> bool:
    """Whether to search again after this many troubled frames: 0 to 3, then every eighth time."""
    return 0 <= troubled < 4 or troubled % 8 == 0
