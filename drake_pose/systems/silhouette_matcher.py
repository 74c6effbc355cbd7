"""The matcher and the tracker as Drake systems: label images in, estimated positions out."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, camera_tuple
from drake_pose.errors import SettingsError, require_at_least, require_known
from drake_pose.filtering.contour_tracker import MatchAndTrack, TrackerState, TrackingSettings
from drake_pose.search import TRACKED, PoseEstimate, PoseSearch, View
from drake_pose.silhouette.pictures.label_renderer import label_image_to_mask
from drake_pose.systems.bodies import body_poses
from drake_pose.systems.ports import (
    BeliefSystem,
    ImmutableValue,
    camera_port,
    require_distinct_cameras,
    require_period,
    require_time_forward,
)

STATISTICS = ("found", "J", "E_total", "first_E_total", "runs", "outside_limit", "seconds")
"""Names of the elements of the output port ``statistics``."""


@dataclass(frozen=True, eq=False)
class MatcherState(ImmutableValue):
    """The state of a SilhouetteMatcher."""

    q: Array  # (nq,) positions of the last pose found.
    X_WB: Array  # (4, 4) pose of its base.
    estimate: PoseEstimate | None  # Estimate of the last update; None: no camera saw the body.
    memory: Any  # A subclass's own state; None: it has none.


class SilhouetteMatcher(BeliefSystem[MatcherState]):
    """Estimates the positions of an articulated body from label images.

    .. pydrake_system::

        name: SilhouetteMatcher
        input_ports: [label_image, root_position (optional)]
        output_ports: [estimated_positions, error, base_pose, body_poses, statistics,
          proved_optimal, determined, lower, upper, mode_positions, pose_estimate]

    A periodic update searches for the pose; output ports read the result. Before the first update,
    and if no pose is found, the estimated positions are the last ones (initially the model's
    default) and the error is infinite.

    Input ports:
        label_image (ImageLabel16I): ``label_image_<camera>`` with several cameras. A camera whose
            port is not connected, or whose image shows no pixel of the body, is ignored.
        root_position (3): known position of the root in the world [m].

    Output ports:
        estimated_positions (nq): in the plant's order [rad or m].
        error (1): E_total, the differing area as a fraction of the masks' area.
        base_pose (RigidTransform): pose X_WB of the plant's world.
        body_poses: poses of all bodies in the scene's world, as a plant's port of that name.
        statistics (7): see ``STATISTICS``.
        proved_optimal (1): 1 if it is proved that no pose of the searched grid fits better.
        determined (nq): 1 for a position that the silhouettes determine, else 0.
        lower, upper (nq): ends of each position's interval, or of the range found [rad or m].
        mode_positions (mode_limit x nq, row by row): positions of the modes that look the same,
            best first.
        pose_estimate: the ``PoseEstimate`` of the last update; None if no camera saw the body.

    The ports from ``proved_optimal`` to ``mode_positions`` are NaN if the search does not examine
    its result.

    Args:
        search: the search for the poses of a body.
        cameras: calibrated, in the order of the input ports, or by name.
        period: time between two updates [s].
        labels: render labels of the body; None: those of its model if made of a plant
            (``ArticulatedModel.from_plant``), else all but Drake's reserved ones. They are abstract
            parameter 0 of the context (a frozenset or None).
        mode_limit: largest number of modes in ``mode_positions``.

    Raises:
        SettingsError: there is no search or no camera, two cameras share a name, the period is not
            positive, or the mode limit is below 1.
    """

    _first_memory: Any = None
    """Initial value of ``MatcherState.memory``."""

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
        require_distinct_cameras(
            cameras, 1, "a matcher needs one or more cameras of different names"
        )
        require_period("matcher", period)
        require_at_least(1, mode_limit=mode_limit)
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
        self.declare_belief(MatcherState(q, np.eye(4), None, self._first_memory), period)
        plant, nq = search.tree.model.plant, len(q)
        self.add_belief_output("estimated_positions", nq, lambda known: known.q)
        self.add_belief_output("error", 1, lambda known: _statistics(known.estimate)[2:3])
        self.add_belief_output(
            "statistics", len(STATISTICS), lambda known: _statistics(known.estimate)
        )
        self.add_belief_output(
            "base_pose", RigidTransform(), lambda known: RigidTransform(known.X_WB)
        )
        self.add_belief_output(
            "body_poses", [RigidTransform()], lambda known: body_poses(plant, known.q, known.X_WB)
        )
        self.add_belief_output("pose_estimate", None, lambda known: known.estimate)
        sizes = {"proved_optimal": 1, "determined": nq, "lower": nq, "upper": nq}
        for name, size in (sizes | {"mode_positions": self._mode_limit * nq}).items():

            def read(known: MatcherState, name: str = name, size: int = size) -> Array:
                return self._pose_set_values(known.estimate).get(name, np.full(size, np.nan))

            self.add_belief_output(name, size, read)

    def next_belief(self, context: Context, last: MatcherState) -> MatcherState:
        """Return the state after matching the context's images, given the last state."""
        images, labels = self._images(context), self._labels(context)
        masks = {name: label_image_to_mask(image, labels) for name, image in images.items()}
        seen = {name: mask for name, mask in masks.items() if mask.any()}
        views = [View(one, seen[one.name]) for one in self._cameras if one.name in seen]
        estimate, memory, is_shown = self._find(context, last.memory, views)
        if estimate is None or not is_shown:
            return MatcherState(last.q, last.X_WB, estimate, memory)
        return MatcherState(estimate.q, estimate.X_WB, estimate, memory)

    def _find(
        self, context: Context, memory: Any, views: Sequence[View]
    ) -> tuple[PoseEstimate | None, Any, bool]:
        """Return the pose that the views show, None without any; next memory; whether to show it.

        ``memory``: ``MatcherState.memory`` of the last update. ``views``: the cameras that see the
        body, with its mask.
        """
        if not views:
            return None, memory, False
        found = self._search.match(views, self.eval_input(context, "root_position"))
        return found, memory, found.found

    def _pose_set_values(self, estimate: PoseEstimate | None) -> dict[str, Array]:
        """Return the outputs from an estimate's pose set, by name of the port; {} without one."""
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
    """Return the elements of STATISTICS (7,): differences are infinite without a pose."""
    values = np.zeros(len(STATISTICS))
    values[1:4] = np.inf
    if estimate is not None:
        limit = max(estimate.outside_limit, default=0.0)
        values[4:] = estimate.runs, limit, estimate.seconds
        if estimate.found:
            values[:4] = 1.0, estimate.J, estimate.E_total, estimate.first_E_total
    return values


TRACK = ("tracked", "matches", "distance")
"""Names of the elements of the output port ``track``."""


class _Memory(NamedTuple):
    """The state of a SilhouetteTracker."""

    tracker_state: TrackerState  # State of the ``MatchAndTrack``.
    track: tuple[float, float, float]  # Elements of TRACK.
    time: float  # Time of the last update [s].


class SilhouetteTracker(SilhouetteMatcher):
    """Estimates the positions of a moving body: matched at first and after a loss, else tracked.

    .. pydrake_system::

        name: SilhouetteTracker
        input_ports: [label_image, root_position (optional), measured_positions (optional),
          first_positions (optional), color_image (of color_cameras)]
        output_ports: [estimated_positions, error, base_pose, body_poses, statistics,
          proved_optimal, determined, lower, upper, mode_positions, pose_estimate,
          position_deviations, estimated_state, track]

    A periodic update tracks or searches for the pose; output ports read the result. Ports and
    arguments are those of ``SilhouetteMatcher``, which it can replace in a diagram, and those
    below. All state is in the context.

    Input ports:
        color_image (ImageRgba8U): ``color_image_<camera>`` with several cameras; for the cameras in
            ``color_cameras``. The colours along the body's contour are used if there is no label
            image, or none with a pixel of the body. One label image of the first frame is enough,
            or none if measured positions say where the body is at first.
        measured_positions (nq): approximate positions now, for example of encoders; NaN if unknown.
            The track starts from them, also after a loss. The search is used only if the masks do
            not fit them, and replaces them only by a pose that explains the masks.
        first_positions (nq): approximate positions in the first image; ignored later.

    Output ports:
        position_deviations (nq): standard deviation of each position [rad or m]; NaN for positions
            that are not tracked (fixed, or solved from the root's pose). Without evidence, or if no
            pose explains the masks because the body is occluded, positions are predicted and their
            deviations grow. At most a tenth of the silhouettes' area may be occluded in a tracked
            frame.
        estimated_state (nq + nv): the estimated positions, then the plant's velocities [rad/s or
            m/s]; velocities are NaN without a track and where ``position_deviations`` are. The
            filter's rates decay with the time constant ``tracking.memory``: in steady motion at 30
            Hz they are a fifth too small with the default of 0.15 s, and right with 5 s.
        track (3): see ``TRACK``. ``tracked`` is 1 if the last pose was tracked, 0 if it was
            searched or only predicted (``error`` is infinite then). ``matches`` is the number of
            searches. ``distance`` is the robust root mean square distance of the body's contour
            from the edges [pixel].

    ``tracking``: settings of the tracker; None: TrackingSettings(). They are abstract parameter 1
    of the context, where all but ``root_moves`` and ``scale_unknown`` can be changed.
    ``color_cameras``: names of the cameras that have a port for a colour image. ``search_time``:
    time limit of a ``MultiStartSearch`` [s]; a search that reaches it is repeated in the next
    updates. None: no limit.

    Raises SettingsError: as for ``SilhouetteMatcher``. In a simulation: time runs backwards, or the
    context's settings have another state; UnknownNameError: a name in ``color_cameras`` is no
    camera's.
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
        # Elements of the filter's state that are positions; the others are the root's.
        self._moving, self._still = (
            [name for name in some if name in model.position_names]
            for some in (self._layout.moving, self._layout.constant)
        )
        self.add_input("measured_positions", nq)
        self.add_input("first_positions", nq)
        known = {camera.name: camera for camera in cameras}
        require_known("camera", color_cameras, known, "color_cameras")
        self._colours = self.add_camera_inputs(
            {
                one.name: camera_port("color_image", one, cameras)
                for one in cameras
                if one.name in color_cameras
            },
            lambda name: ImageRgba8U(known[name].width, known[name].height),
        )
        self.add_belief_output("position_deviations", nq, self._deviations)
        self.add_belief_output("estimated_state", model.plant.num_multibody_states(), self._state)
        self.add_belief_output("track", len(TRACK), lambda known: known.memory.track)

    def _find(
        self, context: Context, memory: _Memory, views: Sequence[View]
    ) -> tuple[PoseEstimate | None, _Memory, bool]:
        """Return the tracked or searched pose, None before any evidence; next memory; as above.

        A track predicts a pose that is not found.
        """
        # Views of the images' writable data, as compiled kernels require.
        images = self._colours(context)
        pictures = {name: one.mutable_data for name, one in images.items() if one.size()}
        last, root_position = memory.tracker_state, self.eval_input(context, "root_position")
        if not views and not pictures and last.track is None:
            return None, memory, False
        require_time_forward(self, context, memory.time)
        ports = ["measured_positions", *(["first_positions"] if last.track is None else [])]
        starts = (self.eval_input(context, port) for port in ports)
        start = next((q for q in starts if q is not None and np.isfinite(q).all()), None)
        follower = self._follower(self._tracking(context))
        now, result = follower.next(last, views, root_position, pictures, start)
        is_tracked = result.stopped_by == TRACKED and now.matches == last.matches
        measurement = None if now.track is None else now.track.measurement
        distance = np.nan if measurement is None else measurement.distance
        track = float(result.found and is_tracked), float(now.matches), distance
        is_shown = result.found or now.track is not None
        return result, _Memory(now, track, context.get_time()), is_shown

    def with_intervals(self, context: Context) -> PoseEstimate:
        """Return the last tracked pose with intervals, at the cost of an update."""
        known = self.belief(context)
        assert known.estimate is not None, "nothing was tracked"
        follower = self._follower(self._tracking(context))
        return follower.with_intervals(known.memory.tracker_state, known.estimate)

    def _follower(self, tracking: TrackingSettings) -> MatchAndTrack:
        """Return the ``MatchAndTrack`` for a context's settings, created on first use."""
        if tracking not in self._followers:
            made = MatchAndTrack(
                self._search, self._cameras, self._period, tracking, self._search_time
            )
            if made.tracker.filter.layout.names != self._layout.names:
                raise SettingsError(
                    f"{self.get_name()}: root_moves and scale_unknown cannot be changed in a "
                    "context, because the size of the state depends on them; create another system"
                )
            self._followers[tracking] = made
        return self._followers[tracking]

    def _deviations(self, known: MatcherState) -> Array:
        """Return the output ``position_deviations`` (nq,)."""
        deviations, track = np.full(len(known.q), np.nan), known.memory.tracker_state.track
        if track is not None:
            seen = [*self._moving, *self._still]
            found = track.state.best.deviations()[self._layout.indices(seen)]
            deviations[self._indices(seen)] = found
            for follower, leader, multiplier, _ in self._search.tree.followers:
                deviations[follower] = abs(multiplier) * deviations[leader]
        return deviations

    def _state(self, known: MatcherState) -> Array:
        """Return the output ``estimated_state`` (nq + nv,): q, then velocities."""
        plant = self._search.tree.model.plant
        qdot, track = np.full(len(known.q), np.nan), known.memory.tracker_state.track
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
        """Return the indices in q of named positions."""
        return [self._search.tree.model.position_index(name) for name in names]
