"""A body that moves, from silhouettes: the matcher and the truncated filter as one Drake system."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import Context

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera
from drake_pose.filtering.tracking.contour_tracker import TrackingSettings
from drake_pose.filtering.tracking.match_and_track import Followed, MatchAndTrack
from drake_pose.search.estimates import TRACKED, PoseEstimate, View
from drake_pose.search.scoring import PoseSearch
from drake_pose.systems.colour_images import ColourPorts
from drake_pose.systems.estimators.silhouette_matcher import (
    Matched,
    SilhouetteMatcher,
    camera_port,
)
from drake_pose.systems.ports import require_time_forward

TRACK = ("tracked", "matches", "distance")
"""What the elements of the output ``track`` are."""


class _Memory(NamedTuple):
    """What the next update begins with: what is followed, TRACK, and the last update's time [s]."""

    followed: Followed
    track: tuple[float, float, float]
    time: float


class SilhouetteTracker(SilhouetteMatcher):
    """Estimates a moving body's positions: matched at first and after a loss, else tracked.

    .. pydrake_system::

        name: SilhouetteTracker
        input_ports: [label_image, root_position (optional), measured_positions (optional),
          color_image (where asked for)]
        output_ports: [estimated_positions, error, base_pose, body_poses, statistics,
          proved_optimal, determined, lower, upper, family_positions, pose_estimate,
          position_deviations, estimated_state, track]

    The ports are those of ``SilhouetteMatcher``, which it can replace in any diagram, and:

    - ``color_image`` (``color_image_<camera>`` where there are several cameras) of each camera
      named in ``color_cameras``: an ``ImageRgba8U``. The colours along the body's contour stand in
      where there is no label image, or one without any pixel of the body. So a label image of the
      first frame will do; or none, where measured positions say where the body is at first.
    - ``measured_positions`` (nq): about where the body is, of encoders for example. The track
      begins there, and again after a loss; the search is not asked. NaN: it is not known now.
    - ``position_deviations`` (nq): the standard deviation of each position [rad or m]; NaN where a
      position is no part of what is tracked (held, or solved from the root's pose).
    - ``estimated_state`` (nq + nv): the estimated positions, then the plant's velocities [rad/s or
      m/s]; these are NaN where there is no track, and where ``position_deviations`` are. They are
      what the filter believes: rates fade within ``tracking.memory``, so in steady motion they are
      too small (by a fifth at 30 frames a second with the default of 0.15 s), and right with 5 s.
    - ``track``: see ``TRACK``. ``tracked`` is 1 where the last pose was tracked and 0 where the
      search found it; ``matches`` counts how often the search was asked; ``distance`` is between
      the body's contour and the masks' edge (root mean square, robust) [pixel].

    All that is known is state of the context. Arguments are those of ``SilhouetteMatcher``, and:

    Args:
        tracking: how the body may move, and when its track is lost.
        color_cameras: names of the cameras that have a port for a colour image.

    Raises:
        SettingsError: as for ``SilhouetteMatcher``; and in a simulation, when time runs backwards.
        UnknownNameError: a name of ``color_cameras`` is no camera's.
    """

    def __init__(
        self,
        search: PoseSearch,
        cameras: Sequence[Camera],
        period: float,
        offset: float = 0.0,
        labels: Collection[int] | None = None,
        tracking: TrackingSettings | None = None,
        color_cameras: Collection[str] = (),
    ) -> None:
        super().__init__(search, cameras, period, offset, labels)
        self._follower = MatchAndTrack(search, cameras, period, tracking)
        self._period, self._layout = period, self._follower.tracker.filter.layout
        model = search.tree.model
        nq = len(model.position_names)
        # Elements of the state that are positions, and which; the others are the root's.
        self._moving, self._still = (
            [name for name in some if name in model.position_names]
            for some in (self._layout.moving, self._layout.constant)
        )
        self.add_input("measured_positions", nq)
        self._colours = ColourPorts(
            self, cameras, color_cameras, lambda one: camera_port("color_image", one, cameras)
        )
        self.show("position_deviations", nq, self._deviations)
        self.show("estimated_state", model.plant.num_multibody_states(), self._state)
        self.show("track", len(TRACK), lambda known: known.memory.track)

    def _first_memory(self) -> _Memory:
        return _Memory(Followed(), (0.0, 0.0, 0.0), -np.inf)

    def _find(
        self, context: Context, memory: _Memory, views: Sequence[View]
    ) -> tuple[PoseEstimate | None, _Memory]:
        pictures = self._colours.pictures(context)
        if not views and not pictures:
            return None, memory
        require_time_forward(self, context, memory.time)
        start = self.given(context, "measured_positions")
        if start is not None and not np.all(np.isfinite(start)):
            start = None
        last, root_position = memory.followed, self.given(context, "root_position")
        now, result = self._follower.next(last, views, root_position, pictures, start)
        is_tracked = result.stopped_by == TRACKED and now.matches == last.matches
        measurement = None if now.track is None else now.track.measurement
        distance = np.nan if measurement is None else measurement.distance
        track = float(result.found and is_tracked), float(now.matches), distance
        return result, _Memory(now, track, context.get_time())

    def _deviations(self, known: Matched) -> Array:
        deviations, track = np.full(len(known.q), np.nan), known.memory.followed.track
        if track is not None:
            seen = [*self._moving, *self._still]
            found = track.state.best.deviations()[self._layout.indices(seen)]
            deviations[self._indices(seen)] = found
        return deviations

    def _state(self, known: Matched) -> Array:
        plant = self._search.tree.model.plant
        qdot, track = np.full(len(known.q), np.nan), known.memory.followed.track
        if track is not None:
            rates = self._layout.indices([f"rate_{name}" for name in self._moving])
            qdot[self._indices(self._still)] = 0.0
            qdot[self._indices(self._moving)] = track.state.best.mean[rates] / self._period
        plant_context = plant.CreateDefaultContext()
        plant.SetPositions(plant_context, known.q)
        return np.concatenate([known.q, plant.MapQDotToVelocity(plant_context, qdot)])

    def _indices(self, names: Sequence[str]) -> list[int]:
        return [self._search.tree.model.position_index(name) for name in names]
