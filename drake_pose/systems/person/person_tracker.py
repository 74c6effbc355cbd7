"""A person followed by all silhouettes at once, as a Drake system and in a ready diagram."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteStateIndex,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
)
from pydrake.systems.sensors import ImageRgba8U
from pydrake.trajectories import Trajectory

from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.fit.colour_lines import COLOURS
from drake_pose.fit.contour_fit import ContourFit, inlier_ratio_of
from drake_pose.person.colour_views import ColourViews
from drake_pose.person.frame_views import FrameViews
from drake_pose.person.recordings.other_persons import keep_views
from drake_pose.person.silhouette_tracker import SilhouetteTracker, TrackState
from drake_pose.person.silhouette_view import SilhouetteView
from drake_pose.systems.bodies.posed_geometry import add_avatar
from drake_pose.systems.person.silhouette_sensor import (
    SilhouetteSensor,
    edge_spacing,
    shows_somebody,
)
from drake_pose.systems.pictures.camera_rig import build_camera_rig

# Before the values in the state: whether the person is known, the share that fits, the usual share,
# troubled frames, whether lost, in how many more frames others are looked for, the frame's time
# stamp, and the time since the frame before.
_SCALARS = 8
_OTHERS = 5
# Who was seen beside the person is looked for in this many more frames; to look takes long.
_REMEMBERED = 15
# Silhouettes of fewer cameras do not say where the person is.
_SEERS = 2
# Cameras in which the person and another are one figure are left out where this many others remain.
_ENOUGH = 3
# After a pause a motion is expected to go on for no more than this many frames.
_LONGEST_PAUSE = 3.0


class PersonTracker(LeafSystem):
    """Follows a person from what several cameras' pictures say.

    .. pydrake_system::

        name: PersonTracker
        input_ports:
        - silhouette_<camera>
        - color_image_<camera> (where asked for)
        - time
        output_ports:
        - estimated_positions
        - last_positions
        - body_poses
        - share
        - time
        - seen
        - others
        - deviations

    ``silhouette_<camera>`` is a SilhouetteView, as SilhouetteSensor gives it, or None: then the
    others go on without the camera, as they do where the port is not connected. ``time`` is the
    pictures' time stamp [s]: while it stays the same, or is nan, there is nothing new; where it is
    not connected, every period brings new pictures.

    The estimated positions are nan until the person is found and while the person is lost or seen
    by fewer than two cameras; the last ones known, at first the model's default, are another
    output, which an avatar can always show. Further outputs: the share of the contours that fits,
    0 where nobody was seen; the time stamp of the last pictures used; for each camera whether it
    saw the person in them, 1 or 0; and ``others``, 1 where other persons were in them. Others are
    looked for at the start, while too little of the contours fits, and for a while after they were
    seen; they are cut out, and a camera in which the person and another are one figure is left out
    where three others see the person alone, else not judged by.

    ``color_image_<camera>`` of each camera named in ``color_cameras`` is an ``ImageRgba8U``. Where
    fewer than two cameras give a silhouette that shows somebody, a person who is known is followed
    by colour; the colours are learned from frame to frame. So silhouettes of one moment will do, or
    ``set_person``. A person who is lost by colour is searched in the next silhouettes.

    ``body_poses`` are the poses of all bodies at the last positions, in the plant's order, as a
    plant's output of that name gives them.

    ``deviations`` is there where it is asked for: (nq,) the positions' standard deviations
    [rad or m], by the pictures and the limits alone; nan where the positions are.

    Args:
        tracker: made for the person's pose tree.
        cameras: the calibrated cameras, in the order of the input ports.
        period: time between two looks at the inputs [s].
        with_deviations: whether the deviations are an output.
        color_cameras: names of the cameras that have a port for a colour image.

    Raises:
        UnknownNameError: a name of ``color_cameras`` is no camera's.
        SettingsError: fewer than two cameras, two of one name, or a period that is not positive.
    """

    def __init__(
        self,
        tracker: SilhouetteTracker,
        cameras: Sequence[Camera],
        period: float,
        with_deviations: bool = False,
        color_cameras: Collection[str] = (),
    ) -> None:
        super().__init__()
        names = [camera.name for camera in cameras]
        if len(names) < 2 or len(set(names)) != len(names):
            raise SettingsError(f"a person is tracked by two or more different cameras: {names}")
        if not period > 0:
            raise SettingsError(f"the tracker's period must be positive, not {period}")
        self._tracker, self._cameras = tracker, tuple(cameras)
        self._silhouettes = [
            self.DeclareAbstractInputPort(f"silhouette_{name}", AbstractValue.Make(None))
            for name in names
        ]
        self._time = self.DeclareVectorInputPort("time", 1)
        default = tracker.fit.tree.model.default_positions
        size = len(tracker.fit.lower)
        start = np.concatenate([np.zeros(_SCALARS), tracker.values(default), np.zeros(size)])
        start[_SCALARS - 2] = np.nan
        self._state = self.DeclareDiscreteState(start)
        self._seen = self.DeclareDiscreteState(len(names))
        self._last = self.DeclareDiscreteState(tracker.positions(tracker.values(default)))
        ticket = {self.discrete_state_ticket(self._state)}
        self.DeclareVectorOutputPort(
            "estimated_positions", len(default), self._calc_positions, ticket
        )
        self.DeclareStateOutputPort("last_positions", self._last)
        self.DeclareAbstractOutputPort(
            "body_poses",
            lambda: AbstractValue.Make([RigidTransform()]),
            self._calc_body_poses,
            {self.discrete_state_ticket(self._last)},
        )
        self.DeclareVectorOutputPort("share", 1, self._calc_share, ticket)
        self.DeclareVectorOutputPort("time", 1, self._calc_time, ticket)
        self.DeclareStateOutputPort("seen", self._seen)
        self._others = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("others", self._others)
        self._deviations: DiscreteStateIndex | None = None
        if with_deviations:
            self._deviations = self.DeclareDiscreteState(np.full(len(default), np.nan))
            self.DeclareStateOutputPort("deviations", self._deviations)
        self._color_ports = self._declare_color_ports(color_cameras)
        # What is known of the person's colours: state, so that a simulation can be replayed.
        self._colours_shape = (len(color_cameras), len(tracker.fit.outlines), 3, COLOURS)
        self._colours = self.DeclareDiscreteState(int(np.prod(self._colours_shape)))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._follow)

    def _declare_color_ports(self, wanted: Collection[str]) -> dict[str, InputPort]:
        """The ports of colour images by camera."""
        known = {camera.name: camera for camera in self._cameras}
        for name in wanted:
            if name not in known:
                raise UnknownNameError("camera", name, known, "color_cameras")
        return {
            name: self.DeclareAbstractInputPort(
                f"color_image_{name}",
                AbstractValue.Make(ImageRgba8U(camera.width, camera.height)),
            )
            for name, camera in known.items()
            if name in wanted
        }

    def known_person(self, context: Context) -> TrackState | None:
        """What is known of the person, lost or not; None: nobody was found yet.

        Args:
            context: this system's.
        """
        return _unpack(context.get_discrete_state(self._state).value(), 0.0)

    def set_person(self, context: Context, person: TrackState) -> None:
        """Say what is known of the person; the next pictures follow within a period.

        Args:
            context: this system's.
            person: as known_person or SilhouetteTracker.start gives it.
        """
        state = context.get_mutable_discrete_state(self._state)
        state.SetFromVector(_pack(person, self._tracker.is_lost(person), 0.0, np.nan, 0.0))

    def _follow(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        vector = context.get_discrete_state(self._state).value()
        before = float(vector[_SCALARS - 2])
        time = context.get_time()
        if self._time.HasValue(context):
            time = float(self._time.Eval(context)[0])
            if np.isnan(time) or time == before:
                return EventStatus.Succeeded()
        elapsed = 0.0 if np.isnan(before) else time - before
        last = _unpack(vector, elapsed)
        frame_views, colours = self._frame_views(context), self._colour_views(context)
        is_blind = sum(shows_somebody(view) for view in frame_views.views) < _SEERS
        found: TrackState | None
        if is_blind and colours is not None and last is not None:
            found, colours = self._followed_by_colour(last, colours)
            kept, by_colour = _FrameViews((), ()), colours
        else:
            found, kept = self._followed(last, frame_views, vector[_OTHERS] > 0)
            by_colour = None
        self._set_seen(discrete_state, kept, by_colour)
        if self._deviations is not None:
            discrete_state.get_mutable_value(self._deviations)[:] = np.nan
        if found is None and last is not None:
            found = TrackState(last.values, np.zeros(len(last.step)), 0.0, last.usual)
        if found is None:
            discrete_state.get_mutable_value(self._state)[_SCALARS - 2] = time
            return EventStatus.Succeeded()
        found = self._judged(found, kept)
        lost = self._tracker.is_lost(found)
        watched = _REMEMBERED if kept.others else max(vector[_OTHERS] - 1.0, 0.0)
        discrete_state.set_value(self._state, _pack(found, lost, watched, time, elapsed))
        if not lost:
            self._note(discrete_state, found.values, kept, colours, by_colour is not None)
        return EventStatus.Succeeded()

    def _note(
        self,
        discrete_state: DiscreteValues,
        values: np.ndarray,
        kept: _FrameViews,
        colours: ColourViews | None,
        by_colour: bool,
    ) -> None:
        """Keeps what a frame says in which the person is not lost."""
        tracker = self._tracker
        discrete_state.set_value(self._last, tracker.positions(values))
        if self._deviations is not None:
            if by_colour and colours is not None:
                sure = tracker.uncertainty_by_colour(values, colours)
            else:
                sure = tracker.uncertainty(values, kept.cameras, kept.views)
            deviations = tracker.deviations(sure.covariance)
            discrete_state.set_value(self._deviations, deviations)
        if colours is not None:
            regions = {
                camera.name: view.region
                for camera, view in zip(kept.cameras, kept.views, strict=True)
                if camera.name not in kept.merged and shows_somebody(view)
            }
            known = colours.learned(tracker.fit, values, regions)
            packed = discrete_state.get_mutable_value(self._colours).reshape(self._colours_shape)
            for k, name in enumerate(self._color_ports):
                if name in known:
                    packed[k] = known[name]

    def _set_seen(
        self, discrete_state: DiscreteValues, kept: _FrameViews, by_colour: ColourViews | None
    ) -> None:
        """Notes which cameras saw the person, and whether others were there."""
        seers = {*kept.merged} | {
            camera.name
            for camera, view in zip(kept.cameras, kept.views, strict=True)
            if shows_somebody(view)
        }
        if by_colour is not None:
            seers = {camera.name for camera in by_colour.cameras}
        seen = [float(camera.name in seers) for camera in self._cameras]
        discrete_state.set_value(self._seen, seen)
        discrete_state.set_value(self._others, [float(kept.others)])

    def _colour_views(self, context: Context) -> ColourViews | None:
        """The pictures that are there, and what is known of the colours; None: no picture."""
        cameras, pictures = [], []
        for camera in self._cameras:
            port = self._color_ports.get(camera.name)
            image = port.Eval(context) if port is not None and port.HasValue(context) else None
            # A camera that has nothing to show gives an image of no pixels.
            if image is not None and image.size():
                cameras.append(camera)
                pictures.append(np.array(image.data))
        if not cameras:
            return None
        packed = context.get_discrete_state(self._colours).value().reshape(self._colours_shape)
        known = {
            name: packed[k].astype(np.float32)
            for k, name in enumerate(self._color_ports)
            if packed[k].any()
        }
        return ColourViews(cameras, pictures, known)

    def _followed_by_colour(
        self, last: TrackState, colours: ColourViews
    ) -> tuple[TrackState, ColourViews]:
        """The next state by pictures, and the pictures with what is known of their colours."""
        if not colours.known and not self._tracker.is_lost(last):
            # The person was set: these are the first pictures.
            known = colours.learned(self._tracker.fit, last.values)
            colours = ColourViews(colours.cameras, colours.pictures, known)
        return self._tracker.follow_by_colour(last, colours), colours

    def _frame_views(self, context: Context) -> _FrameViews:
        """What those cameras say that have a picture."""
        cameras, views = [], []
        for camera, port in zip(self._cameras, self._silhouettes, strict=True):
            view = port.Eval(context) if port.HasValue(context) else None
            if view is not None:
                cameras.append(camera)
                views.append(view)
        return _FrameViews(cameras, views)

    def _followed(
        self, last: TrackState | None, frame_views: _FrameViews, is_watching: bool
    ) -> tuple[TrackState | None, _FrameViews]:
        """The next state, and what the cameras say of the person alone."""
        is_sorted = last is None or last.troubled != 0 or is_watching
        if is_sorted:
            frame_views = self._alone(frame_views, last)
        found = self._follow_one(last, frame_views)
        if not is_sorted and (found is None or found.troubled != 0):
            alone = self._alone(frame_views, last)
            if alone.others:
                return self._follow_one(last, alone), alone
        return found, frame_views

    def _follow_one(self, last: TrackState | None, frame_views: _FrameViews) -> TrackState | None:
        """The next state; None where fewer than two cameras see anybody."""
        if sum(shows_somebody(view) for view in frame_views.views) < _SEERS:
            return None
        return self._tracker.follow(last, frame_views.cameras, frame_views.views)

    def _alone(self, frame_views: _FrameViews, last: TrackState | None) -> _FrameViews:
        """What cameras say without other persons than the one who was seen last."""
        place = None if last is None else place_of_person(self._tracker, last.values)
        views, cut, merged = keep_views(frame_views.cameras, frame_views.views, edge_spacing, place)
        seers = [
            (camera, view)
            for camera, view in zip(frame_views.cameras, views, strict=True)
            if camera.name not in merged
        ]
        if merged and sum(shows_somebody(view) for _, view in seers) >= _ENOUGH:
            cameras, views = [camera for camera, _ in seers], [view for _, view in seers]
            return _FrameViews(cameras, views, True, merged)
        return _FrameViews(frame_views.cameras, views, bool(cut or merged), merged)

    def _judged(self, found: TrackState, frame_views: _FrameViews) -> TrackState:
        """A state whose share is that of the cameras in which nobody else's contours are."""
        pairs = list(zip(frame_views.cameras, frame_views.views, strict=True))
        clean = [(camera, view) for camera, view in pairs if camera.name not in frame_views.merged]
        if not 0 < len(clean) < len(pairs):
            return found
        fit = self._tracker.fit
        add_up = FrameViews([c for c, _ in clean], [view for _, view in clean]).add_up(fit)
        total = add_up(fit.body.place(found.values), self._tracker.settings.rounds[-1])
        return replace(found, share=inlier_ratio_of(total.sums))

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        vector = context.get_discrete_state(self._state).value()
        positions = self._tracker.positions(np.split(vector[_SCALARS:], 2)[0])
        known, lost = vector[0], vector[4]
        output.SetFromVector(positions if known and not lost else np.full(len(positions), np.nan))

    def _calc_body_poses(self, context: Context, output: AbstractValue) -> None:
        plant = self._tracker.fit.tree.model.plant
        plant_context = plant.CreateDefaultContext()
        plant.SetPositions(plant_context, context.get_discrete_state(self._last).value())
        output.set_value(plant.get_body_poses_output_port().Eval(plant_context))

    def _calc_share(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._state).value()[1:2])

    def _calc_time(self, context: Context, output: BasicVector) -> None:
        vector = context.get_discrete_state(self._state).value()
        output.SetFromVector(vector[_SCALARS - 2 : _SCALARS - 1])


class _FrameViews(NamedTuple):
    """What cameras say at a moment.

    Attributes:
        cameras: those that have a picture.
        views: what each of them says.
        others: whether other persons were cut out, or cameras left out because of them.
        merged: the names of the cameras in which the person and another are one figure.
    """

    cameras: Sequence[Camera]
    views: Sequence[SilhouetteView]
    others: bool = False
    merged: tuple[str, ...] = ()


def place_of_person(tracker: SilhouetteTracker, values: np.ndarray) -> np.ndarray:
    """(3,) where a person is who has values (m,) of the tracker's pose tree: the trunk [m]."""
    return tracker.plan.trunk_middle(tracker.fit.kinematics.poses(values))


def _pack(state: TrackState, lost: bool, watched: float, time: float, elapsed: float) -> np.ndarray:
    scalars = [1.0, state.share, state.usual, state.troubled, lost, watched, time, elapsed]
    return np.concatenate([scalars, state.values, state.step])


def _unpack(vector: np.ndarray, elapsed: float) -> TrackState | None:
    """The last frame's state after a time [s]; None where the person is not known yet."""
    known, share, usual, troubled, _, _, _, usually = vector[:_SCALARS]
    if not known:
        return None
    values, step = np.split(vector[_SCALARS:], 2)
    # Where frames were skipped, the motion has gone on for longer than from frame to frame.
    frames = min(elapsed / usually, _LONGEST_PAUSE) if usually > 0 and elapsed > 0 else 1.0
    return TrackState(values.copy(), frames * step, float(share), float(usual), int(troubled))


def build_person_capture(
    model: ArticulatedModel,
    cameras: Mapping[str, PinholeCamera],
    true_positions: Trajectory,
    period: float = 1.0 / 30.0,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """A simulated person, the cameras around it, what follows it, and the avatar in the browser.

    The diagram's outputs are ``estimated_positions`` and ``share``.

    Args:
        model: the person, with landmarks.yaml beside its file.
        cameras: two or more.
        true_positions: the person's positions (nq,) over time.
        period: time between two frames [s].
        meshcat: where the avatar is shown; None: nowhere.

    Raises:
        SettingsError: fewer than two cameras, or a period that is not positive.
        ModelError: the model has no landmarks of trunk, arms and legs.
    """
    builder = DiagramBuilder()
    tracker = SilhouetteTracker(ContourFit(model.pose_tree()))
    system = builder.AddNamedSystem(
        "person_tracker", PersonTracker(tracker, list(cameras.values()), period)
    )
    rig = builder.AddNamedSystem(
        "camera_rig", build_camera_rig(model, cameras, true_positions).diagram
    )
    for name, camera in cameras.items():
        sensor = builder.AddNamedSystem(f"sensor_{name}", SilhouetteSensor(camera))
        builder.Connect(rig.GetOutputPort(f"label_image_{name}"), sensor.get_input_port())
        builder.Connect(
            sensor.GetOutputPort("silhouette"), system.GetInputPort(f"silhouette_{name}")
        )
    for name in ("estimated_positions", "share"):
        builder.ExportOutput(system.GetOutputPort(name), name)
    if meshcat is not None:
        positions = system.GetOutputPort("last_positions")
        add_avatar(builder, model, positions, meshcat, "avatar", period)
    return builder.Build()
