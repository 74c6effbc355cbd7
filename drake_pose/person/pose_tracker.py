"""A person followed by all silhouettes at once; a lost limb or track is searched again.

Every frame is fitted from where the last ones point to. Limbs that do not fit are placed anew
where regions are unexplained; if all is lost, the whole person, turned to all sides in turn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.fit.camera_sums import AddUp
from drake_pose.fit.contour_fit import ContourFit, PoseFit, Prior, pack_views
from drake_pose.fit.kernel import COMPARED, FITTING, SQUARES, WEIGHT
from drake_pose.person.body_plan import BodyPlan
from drake_pose.person.colour_views import ColourViews
from drake_pose.person.pose_uncertainty import pose_uncertainty
from drake_pose.person.search import (
    CYCLE,
    EXACT,
    HEADINGS,
    LIMBS_A_FRAME,
    AnnealingSchedule,
    PersonSearch,
    headings_of,
)
from drake_pose.person.views import FrameViews

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The share of the last frame's step that is expected again, and how far that is off [rad, m].
_CARRY, _ANGLE_DEVIATION, _LENGTH_DEVIATION = 0.7, 0.3, 0.15
# Where so much less of the contours fits than usual, limbs are searched again; where less than this
# share of the usual, the whole person; who is followed by colour is lost where less of a part fits.
_RETRY_BELOW, _LOST_BELOW, _PART_LOST_BELOW = 0.03, 0.75, 0.4
# For how many frames the usual share is remembered, and what it is until it is known better.
_MEMORY, _USUAL = 60.0, 0.95
# Parts of which less contour is seen, in all cameras together [m], do not say that they are off.
_TELLING = 0.3


@dataclass(frozen=True, eq=False)
class TrackState:
    """What the next frame is told of this one.

    Args:
        values, step: (m,) of the pose tree, and their change from the last frame [rad or m].
        share, usual: of the contours, what fits, and what can be expected to.
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

    @property
    def is_lost(self) -> bool:
        """Whether too little of the contours fits for the pose to be believed."""
        return self.share < _LOST_BELOW * self.usual or self.worst < _PART_LOST_BELOW


class PersonPoseTracker:
    """Follows a person.

    Args:
        fit: made for the person's pose tree.
        schedule: EXACT, or LENIENT where the model is only like the person.
        held: (m,) values that stay, such as lengths; None: none.
        rest: (m,) values of a person at rest, with the held ones; None: the tree's.

    Raises:
        ModelError: the model has no landmarks of trunk, arms and legs.
        UnknownNameError: a value of the pose tree is no position of the plant.
    """

    def __init__(
        self,
        fit: ContourFit,
        schedule: AnnealingSchedule = EXACT,
        held: Mask | None = None,
        rest: Array | None = None,
    ) -> None:
        self.fit, self.schedule, self.plan = fit, schedule, BodyPlan(fit.kinematics)
        is_angle = fit.kinematics.is_angle
        self._held = np.zeros(len(is_angle), dtype=np.bool_) if held is None else held
        self._information = np.where(is_angle, _ANGLE_DEVIATION, _LENGTH_DEVIATION) ** -2.0
        model = fit.tree.model
        self._order = np.array([model.position_index(name) for name in fit.kinematics.names])
        if rest is None:
            rest = fit.kinematics.flatten(fit.tree.default_values())
        self._search = PersonSearch(
            fit, self.plan, schedule.search, self._information, self._held, rest
        )

    def start(self, values: Array) -> TrackState:
        """A state at rest at values (m,) of the pose tree."""
        return TrackState(np.array(values, dtype=np.float64), np.zeros(len(values)), 1.0, _USUAL)

    def positions(self, values: Array) -> Array:
        """The plant's q (nq,) of values (m,), free angles within half a turn."""
        free = np.isinf(self.fit.upper)
        turned = np.where(free, np.remainder(values + np.pi, 2.0 * np.pi) - np.pi, values)
        q = np.array(self.fit.tree.model.default_positions)
        q[self._order] = turned
        return q

    def values(self, q: Array) -> Array:
        """The pose tree's values (m,) of positions q (nq,)."""
        return np.array(q, dtype=np.float64)[self._order]

    def place(self, values: Array) -> Array:
        """(3,) where a person is who has values (m,): the trunk's middle [m]."""
        return self.plan.trunk_middle(self.fit.kinematics.poses(values))

    def deviations(
        self,
        values: Array,
        seen: FrameViews | ColourViews,
        held_covariance: Array | None = None,
    ) -> Array:
        """(nq,) standard deviations of the plant's positions [rad or m] by the pictures alone.

        Args:
            values: (m,) of a frame's state; positions that are none of them deviate by 0.
            seen: the silhouettes or colours that the frame was followed by.
            held_covariance: (h, h) of the held values; None: they are exact.
        """
        last = self.schedule.follow[-1]
        if isinstance(seen, ColourViews):
            compared = seen.compare(self.fit, self.fit.body.place(values), last)
        else:
            views = pack_views(seen.cameras, [view.edge for view in seen.views])
            compared = self.fit.compare(views, values, last)
        sure = pose_uncertainty(self.fit, compared, self._held, held_covariance)
        deviations = np.zeros(len(self.fit.tree.model.position_names))
        deviations[self._order] = np.sqrt(np.diag(sure.covariance))
        return deviations

    def follow(self, last: TrackState | None, frame: FrameViews) -> TrackState | None:
        """The next state; None where nothing is known yet and not two cameras see a person."""
        if last is None:
            found = self._search.found(frame, range(HEADINGS))
            still = np.zeros(len(self._held))
            return (
                None
                if found is None
                else TrackState(found.values, still, found.inlier_ratio, _USUAL)
            )
        fitted = self._fitted(last, frame.add_up(self.fit))
        enough = last.usual - _RETRY_BELOW
        lost = fitted.inlier_ratio < _LOST_BELOW * last.usual
        due = fitted.inlier_ratio < enough and _is_due(last.troubled)
        if due and not lost:
            first = last.troubled * LIMBS_A_FRAME
            fitted = self._search.mended(fitted, frame, enough, first, LIMBS_A_FRAME)
        doubted = last.troubled < 0
        state = TrackState(
            fitted.values,
            fitted.values - last.values if last.troubled == 0 else np.zeros(len(last.values)),
            fitted.inlier_ratio,
            max(fitted.inlier_ratio, last.usual + (fitted.inlier_ratio - last.usual) / _MEMORY),
            last.troubled + 1 if doubted or fitted.inlier_ratio < enough else 0,
        )
        hopeless = due and fitted.inlier_ratio < enough and last.troubled > 0
        return self._restarted(state, last, frame) if lost or doubted or hopeless else state

    def follow_by_colour(self, last: TrackState, colours: ColourViews) -> TrackState:
        """The next frame, where pictures say where the person's edge is; no limb is searched."""
        fitted = self._fitted(last, colours.add_up(self.fit))
        step = fitted.values - last.values
        lengths, fitting = fitted.sums[:-1, [COMPARED, FITTING]].T
        worst = np.min(fitting / np.maximum(lengths, 1e-9), where=lengths >= _TELLING, initial=1.0)
        return TrackState(fitted.values, step, fitted.inlier_ratio, last.usual, worst=float(worst))

    def distance_by_colour(self, values: Array, colours: ColourViews) -> float:
        """RMS distance [pixel] of the contour at values (m,) to the colours'; nan: none is seen."""
        placement = self.fit.body.place(values)
        sums = colours.compare(self.fit, placement, self.schedule.follow[-1]).sums
        squares, weight = sums[:, :, [SQUARES, WEIGHT]].sum(axis=(0, 1))
        return float(np.sqrt(squares / weight)) if weight > 0.0 else float("nan")

    def _restarted(self, state: TrackState, last: TrackState, frame: FrameViews) -> TrackState:
        """A state, or the person found anew where that fits better, all headings in turn."""
        headings = headings_of(last.troubled)
        found = self._search.found(frame, headings, last.values, last.usual)
        if found is None or found.inlier_ratio <= state.share:
            return state
        left = last.troubled + 1 if last.troubled < 0 else 1 - CYCLE
        still = np.zeros(len(found.values))
        return replace(
            state, values=found.values, step=still, share=found.inlier_ratio, troubled=left
        )

    def _fitted(self, last: TrackState, add_up: AddUp) -> PoseFit:
        """The frame fitted from where the last ones point to."""
        expected = last.values + _CARRY * last.step
        prior = Prior(expected, self._information)
        return self.fit.fit_sums(add_up, expected, self.schedule.follow, prior, self._held)


def _is_due(troubled: int) -> bool:
    """Whether to search again after this many troubled frames: 0 to 3, then every eighth time."""
    return 0 <= troubled < 4 or troubled % 8 == 0
