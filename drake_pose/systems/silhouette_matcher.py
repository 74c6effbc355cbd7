"""The matcher and the tracker as Drake systems: label images in, estimated positions out."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, camera_tuple
from drake_pose.errors import SettingsError
from drake_pose.filtering.contour_tracker import TrackingSettings
from drake_pose.filtering.match_and_track import MatchAndTrack, TrackerState
from drake_pose.search import TRACKED, PoseEstimate, PoseSearch, View
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.systems.bodies import body_poses
from drake_pose.systems.images import ColourPorts
from drake_pose.systems.ports import (
    BeliefSystem,
    SharedValue,
    camera_port,
    require_different,
    require_period,
    require_time_forward,
)

STATISTICS = ("found", "J", "E_total", "first_E_total", "runs", "outside_limit", "seconds")
"""What the elements of the output ``statistics`` are."""


@dataclass(frozen=True, eq=False)
class Matched(SharedValue):
    """What is known after an update.

    Args:
        q, X_WB: (nq,) the last pose that was found, and (4, 4) its base.
        estimate: this update's; None: there was nothing to see.
        memory: what a tracker hands to its next update.
    """

    q: Array
    X_WB: Array
    estimate: PoseEstimate | None
    memory: Any


class SilhouetteMatcher(BeliefSystem[Matched]):
    """Estimates the positions of an articulated body from label images.

    .. pydrake_system::

        name: SilhouetteMatcher
        input_ports: [label_image, root_position (optional)]
        output_ports: [estimated_positions, error, base_pose, body_poses, statistics,
          proved_optimal, determined, lower, upper, mode_positions, pose_estimate]

    With several cameras the input ports are ``label_image_<camera>``; an unconnected one, or an
    image without any pixel of the body, is left out of the match. See ``labels``
    for the pixels that belong to the body.

    The match is made in a periodic update. Until the first one, and where no pose is found, the
    estimated positions are the last ones (at first the model's default), and the error is infinite.
    ``body_poses`` are the poses of all bodies in the scene's world, in the plant's order, as a
    plant's output of that name gives them. ``pose_estimate`` is the whole ``PoseEstimate`` of the
    last update, None where no camera saw the body.

    What the answer is worth: ``proved_optimal`` is 1 where it is proved that no pose of the grid
    that was searched fits better. ``determined`` is 1 for each position that the silhouettes
    determine, 0 for one that is free; ``lower`` and ``upper`` are the ends of its interval, or of
    the range seen. ``mode_positions`` are the positions of the modes that look the same, best
    first, one after another. All are NaN where the search does not say, as one without examination.

    Args:
        cameras: the calibrated cameras, in the order of the input ports, or by name.
        period: time between two matches [s].
        labels: the labels that belong to the body; None: those of its model where that was made of
            a plant (``ArticulatedModel.from_plant``), else all but Drake's reserved ones. A
            frozenset, or None, is abstract parameter 0 of the context, where it can be varied.
        mode_limit: how many modes are given out at most.

    Raises:
        SettingsError: if there is no search or no camera, two cameras share a name, the period is
            not positive, or the mode limit is below 1.
    """

    _first_memory: Any = None
    """What the first update gets as its memory."""

    def __init__(
        self,
        search: PoseSearch,
        cameras: Sequence[Camera] | Mapping[str, Camera],
        period: float,
        labels: Collection[int] | None = None,
        mode_limit: int = 4,
    ) -> None:
        super().__init__()
        if not hasattr(search, "match"):
            raise SettingsError(
                f"a matcher needs a search, as MultiStartSearch(tree): {type(search).__name__}"
            )
        cameras = camera_tuple(cameras)
        require_different(cameras, 1, "a matcher needs one or more cameras of different names")
        require_period("matcher", period)
        if mode_limit < 1:
            raise SettingsError(f"the mode limit must be 1 or more, not {mode_limit}")
        self._search, self._cameras, self._mode_limit = search, cameras, mode_limit
        labels = search.tree.model.labels if labels is None else labels
        self._labels = self.add_parameter(None if labels is None else frozenset(labels))
        known = {camera.name: camera for camera in cameras}
        self._images = self.add_camera_inputs(
            {one.name: camera_port("label_image", one, cameras) for one in cameras},
            lambda name: ImageLabel16I(known[name].width, known[name].height),
        )
        self.add_input("root_position", 3)
        q = search.tree.model.default_positions
        self.keep_belief(Matched(q, np.eye(4), None, self._first_memory), period)
        self._declare_outputs(search.tree.model.plant)

    def _declare_outputs(self, plant: MultibodyPlant) -> None:
        nq = plant.num_positions()
        self.show("estimated_positions", nq, lambda known: known.q)
        self.show("error", 1, lambda known: _statistics(known.estimate)[2:3])
        self.show("statistics", len(STATISTICS), lambda known: _statistics(known.estimate))
        self.show("base_pose", RigidTransform(), lambda known: RigidTransform(known.X_WB))
        self.show(
            "body_poses", [RigidTransform()], lambda known: body_poses(plant, known.q, known.X_WB)
        )
        self.show("pose_estimate", None, lambda known: known.estimate)
        sizes = {"proved_optimal": 1, "determined": nq, "lower": nq, "upper": nq}
        for name, size in (sizes | {"mode_positions": self._mode_limit * nq}).items():

            def worth(known: Matched, name: str = name, size: int = size) -> Array:
                return self._worth(known.estimate).get(name, np.full(size, np.nan))

            self.show(name, size, worth)

    def next_belief(self, context: Context, last: Matched) -> Matched:
        """The match of what the cameras see now."""
        images, labels = self._images(context), self._labels(context)
        masks = {name: label_image_to_mask(image, labels) for name, image in images.items()}
        views = [
            View(camera, masks[camera.name])
            for camera in self._cameras
            if camera.name in masks and masks[camera.name].any()
        ]
        estimate, memory = self._find(context, last.memory, views)
        if estimate is None or not (estimate.found or self._is_predicted(memory)):
            return Matched(last.q, last.X_WB, estimate, memory)
        return Matched(estimate.q, estimate.X_WB, estimate, memory)

    def _is_predicted(self, memory: Any) -> bool:
        """Whether an estimate that was not found is a prediction."""
        return False

    def _find(
        self, context: Context, memory: Any, views: Sequence[View]
    ) -> tuple[PoseEstimate | None, Any]:
        """The pose that the views show, if any, and what the next update gets as its memory."""
        if not views:
            return None, memory
        return self._search.match(views, self.given(context, "root_position")), memory

    def _worth(self, estimate: PoseEstimate | None) -> dict[str, Array]:
        """What an answer is worth, by port; nothing where it is not said."""
        if estimate is None or not estimate.found or estimate.pose_set is None:
            return {}
        names = self._search.tree.model.position_names
        modes = np.full((self._mode_limit, len(names)), np.nan)
        found = [mode.q for mode in estimate.pose_set.modes[: self._mode_limit]]
        modes[: len(found)] = found
        determined, lower, upper = estimate.pose_set.position_intervals(self._search.tree)
        return {
            "proved_optimal": np.array([float(estimate.proved_optimal)]),
            "determined": determined,
            "lower": lower,
            "upper": upper,
            "mode_positions": modes.ravel(),
        }


def _statistics(estimate: PoseEstimate | None) -> Array:
    """An update's STATISTICS."""
    values = np.zeros(len(STATISTICS))
    values[1:4] = np.inf
    if estimate is not None:
        limit = max(estimate.outside_limit, default=0.0)
        values[4:] = estimate.runs, limit, estimate.seconds
        if estimate.found:
            values[:4] = 1.0, estimate.J, estimate.E_total, estimate.first_E_total
    return values


TRACK = ("tracked", "matches", "distance")
"""What the elements of the output ``track`` are."""


class _Memory(NamedTuple):
    """What the next update begins with: what is followed, TRACK, and the last update's time [s]."""

    followed: TrackerState
    track: tuple[float, float, float]
    time: float


class SilhouetteTracker(SilhouetteMatcher):
    """Estimates a moving body's positions: matched at first and after a loss, else tracked.

    .. pydrake_system::

        name: SilhouetteTracker
        input_ports: [label_image, root_position (optional), measured_positions (optional),
          first_positions (optional), color_image (where asked for)]
        output_ports: [estimated_positions, error, base_pose, body_poses, statistics,
          proved_optimal, determined, lower, upper, mode_positions, pose_estimate,
          position_deviations, estimated_state, track]

    The ports are those of ``SilhouetteMatcher``, which it can replace in any diagram, and:

    - ``color_image`` (``color_image_<camera>`` where there are several cameras) of each camera
      named in ``color_cameras``: an ``ImageRgba8U``. The colours along the body's contour stand in
      where there is no label image, or one without any pixel of the body. So a label image of the
      first frame will do; or none, where measured positions say where the body is at first.
    - ``measured_positions`` (nq): about where the body is now, of encoders for example. The track
      begins there, and again after a loss; the search is asked only where the masks contradict it,
      and overrules it only by a pose that explains the masks. NaN: it is not known now.
    - ``first_positions`` (nq): about where the body is in the first image; ignored afterwards.
    - ``position_deviations`` (nq): the standard deviation of each position [rad or m]; NaN where a
      position is no part of what is tracked (held, or solved from the root's pose). Where nothing
      is seen, or no pose explains the masks because the body is hidden, the positions are predicted
      and their deviations grow; see ``tracked``. At most a tenth of the silhouettes' area may be
      hidden in a frame that is tracked.
    - ``estimated_state`` (nq + nv): the estimated positions, then the plant's velocities [rad/s or
      m/s]; these are NaN where there is no track, and where ``position_deviations`` are. They are
      what the filter believes: rates fade within ``tracking.memory``, so in steady motion they are
      too small (by a fifth at 30 frames a second with the default of 0.15 s), and right with 5 s.
    - ``track``: see ``TRACK``. ``tracked`` is 1 where the last pose was tracked and 0 where the
      search found it, or it was only predicted (``error`` is infinite then); ``matches`` counts
      how often the search was asked; ``distance`` is between
      the body's contour and the masks' edge (root mean square, robust) [pixel].

    All that is known is state of the context. Arguments are those of ``SilhouetteMatcher``, and:

    Args:
        tracking: how the body may move, and when its track is lost: abstract parameter 1 of the
            context, but for ``root_moves`` and ``scale_unknown``, on which the state depends.
        color_cameras: names of the cameras that have a port for a colour image.
        search_time: longest search by a ``MultiStartSearch`` [s]. A search that it cuts short is
            asked again in the next updates; None: no limit.

    Raises:
        SettingsError: as for ``SilhouetteMatcher``; and in a simulation, when time runs backwards,
            or the context's settings have another state.
        UnknownNameError: a name of ``color_cameras`` is no camera's.
    """

    _first_memory = _Memory(TrackerState(), (0.0, 0.0, 0.0), -np.inf)

    def __init__(
        self,
        search: PoseSearch,
        cameras: Sequence[Camera] | Mapping[str, Camera],
        period: float,
        labels: Collection[int] | None = None,
        tracking: TrackingSettings | None = None,
        color_cameras: Collection[str] = (),
        search_time: float | None = 5.0,
    ) -> None:
        super().__init__(search, cameras, period, labels)
        cameras, self._search_time = self._cameras, search_time
        tracking = tracking or TrackingSettings()
        follower = MatchAndTrack(search, cameras, period, tracking, search_time)
        self._tracking, self._followers = self.add_parameter(tracking), {tracking: follower}
        self._period, self._layout = period, follower.tracker.filter.layout
        model = search.tree.model
        nq = len(model.position_names)
        # Elements of the state that are positions, and which; the others are the root's.
        self._moving, self._still = (
            [name for name in some if name in model.position_names]
            for some in (self._layout.moving, self._layout.constant)
        )
        self.add_input("measured_positions", nq)
        self.add_input("first_positions", nq)
        self._colours = ColourPorts(
            self, cameras, color_cameras, lambda one: camera_port("color_image", one, cameras)
        )
        self.show("position_deviations", nq, self._deviations)
        self.show("estimated_state", model.plant.num_multibody_states(), self._state)
        self.show("track", len(TRACK), lambda known: known.memory.track)

    def _find(
        self, context: Context, memory: _Memory, views: Sequence[View]
    ) -> tuple[PoseEstimate | None, _Memory]:
        pictures = self._colours.pictures(context)
        last, root_position = memory.followed, self.given(context, "root_position")
        if not views and not pictures and last.track is None:
            return None, memory
        require_time_forward(self, context, memory.time)
        ports = ["measured_positions", *(["first_positions"] if last.track is None else [])]
        starts = (self.given(context, port) for port in ports)
        start = next((q for q in starts if q is not None and np.isfinite(q).all()), None)
        follower = self._follower(self._tracking(context))
        now, result = follower.next(last, views, root_position, pictures, start)
        is_tracked = result.stopped_by == TRACKED and now.matches == last.matches
        measurement = None if now.track is None else now.track.measurement
        distance = np.nan if measurement is None else measurement.distance
        track = float(result.found and is_tracked), float(now.matches), distance
        return result, _Memory(now, track, context.get_time())

    def _is_predicted(self, memory: _Memory) -> bool:
        return memory.followed.track is not None

    def with_intervals(self, context: Context) -> PoseEstimate:
        """The pose of the last update, which was tracked, with intervals; see ``MatchAndTrack``.

        They cost about as much as the update, so no port has them.
        """
        known = self.belief(context)
        assert known.estimate is not None, "nothing was tracked"
        follower = self._follower(self._tracking(context))
        return follower.with_intervals(known.memory.followed, known.estimate)

    def _follower(self, tracking: TrackingSettings) -> MatchAndTrack:
        """What follows as a context's settings say; made of them once."""
        if tracking not in self._followers:
            made = MatchAndTrack(
                self._search, self._cameras, self._period, tracking, self._search_time
            )
            if made.tracker.filter.layout.names != self._layout.names:
                raise SettingsError(
                    f"{self.get_name()}: root_moves and scale_unknown cannot be varied in a "
                    "context, whose state depends on them; make another system with them"
                )
            self._followers[tracking] = made
        return self._followers[tracking]

    def _deviations(self, known: Matched) -> Array:
        deviations, track = np.full(len(known.q), np.nan), known.memory.followed.track
        if track is not None:
            seen = [*self._moving, *self._still]
            found = track.state.best.deviations()[self._layout.indices(seen)]
            deviations[self._indices(seen)] = found
            for follower, leader, multiplier, _ in self._search.tree.followers:
                deviations[follower] = abs(multiplier) * deviations[leader]
        return deviations

    def _state(self, known: Matched) -> Array:
        plant = self._search.tree.model.plant
        qdot, track = np.full(len(known.q), np.nan), known.memory.followed.track
        if track is not None:
            rates = self._layout.indices([f"rate_{name}" for name in self._moving])
            qdot[self._indices(self._still)] = 0.0
            qdot[self._indices(self._moving)] = track.state.best.mean[rates] / self._period
            for follower, leader, multiplier, _ in self._search.tree.followers:
                qdot[follower] = multiplier * qdot[leader]
        plant_context = plant.CreateDefaultContext()
        plant.SetPositions(plant_context, known.q)
        return np.concatenate([known.q, plant.MapQDotToVelocity(plant_context, qdot)])

    def _indices(self, names: Sequence[str]) -> list[int]:
        return [self._search.tree.model.position_index(name) for name in names]
