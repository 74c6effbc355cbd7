"""A body that moves, from silhouettes: the matcher and the truncated filter as one Drake system."""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, InputPort
from pydrake.systems.sensors import ImageRgba8U

from drake_pose.camera.models import Camera
from drake_pose.errors import UnknownNameError
from drake_pose.filtering.tracking.contour_tracker import Track, TrackingSettings
from drake_pose.filtering.tracking.match_and_track import Followed, MatchAndTrack
from drake_pose.fit.colours import Picture
from drake_pose.search.estimates import TRACKED, PoseEstimate, View
from drake_pose.search.scoring import PoseSearch
from drake_pose.systems.estimators.filter_packing import FilterPacking, require_time_forward
from drake_pose.systems.estimators.silhouette_matcher import SilhouetteMatcher

Array = NDArray[np.float64]

TRACK = ("tracked", "matches", "distance")
"""What the elements of the output ``track`` are."""


def color_image_port(camera: Camera, cameras: Sequence[Camera]) -> str:
    """Name of the port that carries a camera's colour image, where there are ``cameras``."""
    return "color_image" if len(cameras) == 1 else f"color_image_{camera.name}"


class SilhouetteTracker(SilhouetteMatcher):
    """Estimates a moving body's positions: matched at first and after a loss, else tracked.

    .. pydrake_system::

        name: SilhouetteTracker
        input_ports:
        - label_image
        - root_position (optional)
        - measured_positions (optional)
        - color_image (where asked for)
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

    - ``color_image`` (``color_image_<camera>`` where there are several cameras) of each camera
      named in ``color_cameras``: an ``ImageRgba8U``. The colours along the body's contour stand in
      where there is no label image, or one without any pixel of the body. So a label image of
      the first frame will do; or none, where measured positions say where the body is at first.
    - ``measured_positions`` (nq): about where the body is, of encoders for example. The track
      begins there, and again after a loss; the search is not asked. NaN: it is not known now.
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
        self._measured = self.DeclareVectorInputPort("measured_positions", len(names))
        self._color_ports = self._declare_color_ports(cameras, color_cameras)
        # What is known of the body's colours: state, so that a simulation can be replayed.
        known = self._follower.tracker.observation.no_colours() if color_cameras else np.zeros(0)
        self._colours_shape = known.shape
        self._colours = self.DeclareDiscreteState(known.ravel().astype(np.float64))
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

    def _declare_color_ports(
        self, cameras: Sequence[Camera], wanted: Collection[str]
    ) -> dict[str, InputPort]:
        """The ports of colour images by camera."""
        known = {camera.name: camera for camera in cameras}
        for name in wanted:
            if name not in known:
                raise UnknownNameError("camera", name, known, "color_cameras")
        return {
            camera.name: self.DeclareAbstractInputPort(
                color_image_port(camera, cameras),
                AbstractValue.Make(ImageRgba8U(camera.width, camera.height)),
            )
            for camera in cameras
            if camera.name in wanted
        }

    def followed(self, context: Context) -> Followed:
        """What is known in a context."""
        has_track, reference, _, matches = context.get_discrete_state(self._record).value()[:4]
        if not has_track:
            return Followed(None, float(reference), int(matches))
        belief = np.array(context.get_discrete_state(self._belief).value())
        state = self._packing.unpack(belief, np.zeros(0), np.zeros(1), 0, 0.0, 0)
        colours = None
        if self._color_ports:
            values = context.get_discrete_state(self._colours).value()
            if np.any(values):
                colours = values.astype(np.float32).reshape(self._colours_shape)
        return Followed(Track(state, None, False, colours), float(reference), int(matches))

    def _pictures(self, context: Context) -> dict[str, Picture]:
        """The colour images that are there, by camera."""
        images = {
            name: port.Eval(context)
            for name, port in self._color_ports.items()
            if port.HasValue(context)
        }
        # A camera that has nothing to show gives an image of no pixels.
        return {name: np.array(image.data) for name, image in images.items() if image.size()}

    def _start(self, context: Context) -> Array | None:
        """Where the body is measured to be; None where it is not."""
        if not self._measured.HasValue(context):
            return None
        q = np.array(self._measured.Eval(context))
        return q if np.all(np.isfinite(q)) else None

    def _is_seen(self, context: Context, views: Sequence[View]) -> bool:
        return bool(views) or bool(self._pictures(context))

    def _find(
        self,
        context: Context,
        discrete_state: DiscreteValues,
        views: Sequence[View],
        root_position: Array | None,
    ) -> PoseEstimate:
        last_time = context.get_discrete_state(self._record).value()[-1]
        require_time_forward(self, context, last_time)
        now, result = self._follower.next(
            self.followed(context), views, root_position, self._pictures(context),
            self._start(context),
        )  # fmt: skip
        distance = np.nan
        if now.track is not None:
            discrete_state.set_value(self._belief, self._packing.pack(now.track.state)[0])
            if now.track.colours is not None:
                discrete_state.set_value(self._colours, now.track.colours.ravel())
            if now.track.measurement is not None:
                distance = now.track.measurement.distance
        tracked = float(
            result.found and result.stopped_by == TRACKED and now.matches == self._matches(context)
        )
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
