"""A body that moves, from silhouettes: the matcher and the truncated filter as one Drake system."""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from drake_pose.camera import Camera
from drake_pose.filtering.tracking.contour_tracker import Track, TrackingSettings
from drake_pose.filtering.tracking.match_and_track import TRACKED, Followed, MatchAndTrack
from drake_pose.matching import MatchResult, PoseSearch
from drake_pose.matching.result import View
from drake_pose.systems.estimators.filter_packing import FilterPacking, require_time_forward
from drake_pose.systems.estimators.silhouette_matcher import SilhouetteMatcher

Array = NDArray[np.float64]

TRACK = ("tracked", "matches", "distance")
"""What the elements of the output ``track`` are."""


class SilhouetteTracker(SilhouetteMatcher):
    """Estimates a moving body's positions: matched at first and after a loss, else tracked.

    .. pydrake_system::

        name: SilhouetteTracker
        input_ports:
        - label_image
        - root_position (optional)
        output_ports:
        - estimated_positions
        - error
        - base_pose
        - body_poses
        - statistics
        - proved_optimal
        - determined
        - lower
        - upper
        - family_positions
        - position_deviations
        - estimated_state
        - track

    The ports are those of ``SilhouetteMatcher``, which it can replace in any diagram, and:

    - ``position_deviations`` (nq): the standard deviation of each position [rad or m]; NaN where
      a position is no part of what is tracked (held, or solved from the root's pose).
    - ``estimated_state`` (nq + nv): the estimated positions, then the plant's velocities [rad/s or
      m/s]; these are NaN where there is no track, and where ``position_deviations`` are. They are
      what the filter believes: rates fade within ``tracking.memory``, so in steady motion they are
      too small (by a fifth at 30 frames a second with the default of 0.15 s), and right with 5 s.
    - ``track``: see ``TRACK``. ``tracked`` is 1 where the last pose was tracked and 0 where the
      search found it; ``matches`` counts how often the search was asked; ``distance`` is between
      the body's contour and the masks' edge (root mean square, robust) [pixel].

    The belief is state of the context, so that a simulation can be reset, copied and replayed.

    Args:
        search: asked in the first frame and when the track is lost.
        cameras: the calibrated cameras, in the order of the input ports.
        period: time between two frames [s].
        offset: time of the first one [s].
        labels: the labels that belong to the body; None: all that are not reserved.
        tracking: how the body may move, and when its track is lost.

    Raises:
        SettingsError: as for ``SilhouetteMatcher``; and in a simulation, when time runs backwards.
    """

    def __init__(
        self,
        search: PoseSearch,
        cameras: Sequence[Camera],
        period: float,
        offset: float = 0.0,
        labels: Collection[int] | None = None,
        tracking: TrackingSettings | None = None,
    ) -> None:
        super().__init__(search, cameras, period, offset, labels)
        self._follower = MatchAndTrack(search, cameras, period, tracking)
        belief_filter = self._follower.tracker.filter
        self._packing = FilterPacking(belief_filter, 0)
        names = search.tree.model.position_names
        layout = belief_filter.layout
        # Which position each element of the state that is one stands for.
        seen = [name for name in (*layout.moving, *layout.constant) if name in names]
        self._elements = layout.indices(seen)
        self._rates = layout.indices([f"rate_{name}" for name in layout.moving if name in names])
        self._moving = np.array(
            [names.index(name) for name in layout.moving if name in names], dtype=np.intp
        )
        self._still = np.array(
            [names.index(name) for name in layout.constant if name in names], dtype=np.intp
        )
        self._period = period
        self._tracked_positions = np.array([names.index(name) for name in seen], dtype=np.intp)
        width = self._packing.cap * self._packing.belief_width
        self._belief = self.DeclareDiscreteState(np.zeros(width))
        # Whether there is a track; the reference; TRACK; the last time.
        self._record = self.DeclareDiscreteState(np.r_[np.zeros(2 + len(TRACK)), -np.inf])
        self.DeclareVectorOutputPort(
            "position_deviations",
            len(names),
            self._calc_deviations,
            {self.discrete_state_ticket(self._belief), self.discrete_state_ticket(self._record)},
        )
        self.DeclareVectorOutputPort(
            "estimated_state",
            search.tree.model.plant.num_multibody_states(),
            self._calc_state,
            {
                self.discrete_state_ticket(index)
                for index in (self._positions, self._belief, self._record)
            },
        )
        self.DeclareVectorOutputPort(
            "track", len(TRACK), self._calc_track, {self.discrete_state_ticket(self._record)}
        )

    def followed(self, context: Context) -> Followed:
        """What is known in a context."""
        has_track, reference, _, matches = context.get_discrete_state(self._record).value()[:4]
        if not has_track:
            return Followed(None, float(reference), int(matches))
        belief = np.array(context.get_discrete_state(self._belief).value())
        state = self._packing.unpack(belief, np.zeros(0), np.zeros(1), 0, 0.0, 0)
        return Followed(Track(state, None, False), float(reference), int(matches))

    def _find(
        self,
        context: Context,
        discrete_state: DiscreteValues,
        views: Sequence[View],
        root_position: Array | None,
    ) -> MatchResult:
        last_time = context.get_discrete_state(self._record).value()[-1]
        require_time_forward(self, context, last_time)
        now, result = self._follower.next(self.followed(context), views, root_position)
        distance = np.nan
        if now.track is not None:
            discrete_state.set_value(self._belief, self._packing.pack(now.track.state)[0])
            if now.track.measurement is not None:
                distance = now.track.measurement.distance
        tracked = float(result.stopped_by == TRACKED and now.matches == self._matches(context))
        record = [float(now.track is not None), now.reference, tracked, now.matches, distance]
        record.append(context.get_time())
        discrete_state.set_value(self._record, np.array(record))
        return result

    def _matches(self, context: Context) -> int:
        return int(context.get_discrete_state(self._record).value()[3])

    def _calc_deviations(self, context: Context, output: BasicVector) -> None:
        deviations = np.full(output.size(), np.nan)
        track = self.followed(context).track
        if track is not None:
            deviations[self._tracked_positions] = track.state.best.deviations()[self._elements]
        output.SetFromVector(deviations)

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        q = context.get_discrete_state(self._positions).value()
        qdot = np.full(len(q), np.nan)
        track = self.followed(context).track
        if track is not None:
            qdot[self._still] = 0.0
            qdot[self._moving] = track.state.best.mean[self._rates] / self._period
        plant = self._search.tree.model.plant
        plant_context = plant.CreateDefaultContext()
        plant.SetPositions(plant_context, q)
        v = plant.MapQDotToVelocity(plant_context, qdot)
        output.SetFromVector(np.concatenate([q, v]))

    def _calc_track(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._record).value()[2:-1])
