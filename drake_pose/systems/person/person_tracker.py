"""A person followed by all silhouettes at once, as a Drake system."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteStateIndex,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
)
from pydrake.systems.sensors import ImageRgba8U

from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.fit.colour_lines import COLOURS
from drake_pose.fit.contour_fit import inlier_ratio_of
from drake_pose.person.colour_views import ColourViews
from drake_pose.person.pose_tracker import PersonPoseTracker, TrackState
from drake_pose.person.recordings.persons_in_view import keep_views
from drake_pose.person.views import FrameViews, SilhouetteView, shows_somebody

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
        input_ports: [silhouette_<camera>, color_image_<camera> (of color_cameras), time]
        output_ports: [estimated_positions, last_positions, body_poses, share, time, seen, others,
          deviations]

    ``silhouette_<camera>`` is a SilhouetteView, as SilhouetteSensor gives it; where it is None or
    not connected the others go on without the camera. ``time`` is the pictures' time stamp [s]:
    while it stays the same, or is nan, there is nothing new; where it is not connected, every
    period brings new pictures.

    ``estimated_positions`` are nan until the person is found, while lost, and while fewer than two
    cameras see the person; ``last_positions`` are the last ones known, at first the model's
    default, and ``body_poses`` those of all bodies there, in the plant's order. ``share`` is that
    of the contours that fits, 0 where nobody was seen; ``time`` the stamp of the last pictures
    used; ``seen`` for each camera whether it saw the person in them, 1 or 0; ``others`` 1 where
    other persons were in them. Others are cut out; a camera in which the person and another are one
    figure is left out where three others see the person alone, else not judged by. ``deviations``,
    where asked for, are standard deviations [rad or m] by the pictures and the limits
    alone.

    Where fewer than two cameras give a silhouette that shows somebody, a person who is known is
    followed by colour in ``color_image_<camera>``, an ``ImageRgba8U``; the colours are learned from
    frame to frame. So silhouettes of one moment will do, or ``set_person``. A person who is lost by
    colour is searched in the next silhouettes.

    Args:
        cameras: calibrated, in the order of the input ports.
        period: time between two looks at the inputs [s].
        with_deviations: whether the deviations are an output.
        color_cameras: names of the cameras that have a port for a colour image.

    Raises:
        UnknownNameError: a name of ``color_cameras`` is no camera's.
        SettingsError: fewer than two cameras, two of one name, or a period that is not positive.
    """

    def __init__(
        self,
        tracker: PersonPoseTracker,
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
        """What is known of the person, lost or not; None: nobody was found yet."""
        return _unpack(context.get_discrete_state(self._state).value(), 0.0)

    def set_person(self, context: Context, person: TrackState) -> None:
        """Say what is known of the person; the next pictures follow within a period."""
        state = context.get_mutable_discrete_state(self._state)
        state.SetFromVector(_pack(person, 0.0, np.nan, 0.0))

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
        moment, colours = self._moment(context), self._colour_views(context)
        is_blind = sum(shows_somebody(view) for view in moment.seen.views) < _SEERS
        found: TrackState | None
        if is_blind and colours is not None and last is not None:
            found, colours = self._followed_by_colour(last, colours)
            kept, by_colour = _Moment(FrameViews((), ())), colours
        else:
            found, kept = self._followed(last, moment, vector[_OTHERS] > 0)
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
        watched = _REMEMBERED if kept.others else max(vector[_OTHERS] - 1.0, 0.0)
        discrete_state.set_value(self._state, _pack(found, watched, time, elapsed))
        if not found.is_lost:
            self._note(discrete_state, found.values, kept, colours, by_colour is not None)
        return EventStatus.Succeeded()

    def _note(
        self,
        discrete_state: DiscreteValues,
        values: np.ndarray,
        kept: _Moment,
        colours: ColourViews | None,
        by_colour: bool,
    ) -> None:
        """Keeps what a frame says in which the person is not lost."""
        tracker = self._tracker
        discrete_state.set_value(self._last, tracker.positions(values))
        if self._deviations is not None:
            seen = colours if by_colour and colours is not None else kept.seen
            discrete_state.set_value(self._deviations, tracker.deviations(values, seen))
        if colours is not None:
            regions = {
                camera.name: view.region
                for camera, view in kept.pairs
                if camera.name not in kept.merged and shows_somebody(view)
            }
            known = colours.learned(tracker.fit, values, regions)
            packed = discrete_state.get_mutable_value(self._colours).reshape(self._colours_shape)
            for k, name in enumerate(self._color_ports):
                if name in known:
                    packed[k] = known[name]

    def _set_seen(
        self, discrete_state: DiscreteValues, kept: _Moment, by_colour: ColourViews | None
    ) -> None:
        """Notes which cameras saw the person, and whether others were there."""
        seers = {camera.name for camera, view in kept.pairs if shows_somebody(view)}
        seers |= {*kept.merged}
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
        if not colours.known and not last.is_lost:
            # The person was set: these are the first pictures.
            known = colours.learned(self._tracker.fit, last.values)
            colours = ColourViews(colours.cameras, colours.pictures, known)
        return self._tracker.follow_by_colour(last, colours), colours

    def _moment(self, context: Context) -> _Moment:
        """What those cameras see that have a picture."""
        pairs = [
            (camera, view)
            for camera, port in zip(self._cameras, self._silhouettes, strict=True)
            if (view := port.Eval(context) if port.HasValue(context) else None) is not None
        ]
        return _Moment(FrameViews([camera for camera, _ in pairs], [view for _, view in pairs]))

    def _followed(
        self, last: TrackState | None, moment: _Moment, is_watching: bool
    ) -> tuple[TrackState | None, _Moment]:
        """The next state, and what the cameras see of the person alone."""
        is_sorted = last is None or last.troubled != 0 or is_watching
        if is_sorted:
            moment = self._alone(moment.seen, last)
        found = self._follow_one(last, moment.seen)
        if not is_sorted and (found is None or found.troubled != 0):
            alone = self._alone(moment.seen, last)
            if alone.others:
                return self._follow_one(last, alone.seen), alone
        return found, moment

    def _follow_one(self, last: TrackState | None, seen: FrameViews) -> TrackState | None:
        """The next state; None where fewer than two cameras see anybody."""
        if sum(shows_somebody(view) for view in seen.views) < _SEERS:
            return None
        return self._tracker.follow(last, seen)

    def _alone(self, seen: FrameViews, last: TrackState | None) -> _Moment:
        """What cameras see without other persons than the one who was seen last."""
        place = None if last is None else self._tracker.place(last.values)
        alone, kept = keep_views(seen, place)
        clean = _without(alone, kept.merged)
        if kept.merged and sum(shows_somebody(view) for view in clean.views) >= _ENOUGH:
            return _Moment(clean, True, kept.merged)
        return _Moment(alone, bool(kept.cut or kept.merged), kept.merged)

    def _judged(self, found: TrackState, moment: _Moment) -> TrackState:
        """A state whose share is that of the cameras in which nobody else's contours are."""
        clean = _without(moment.seen, moment.merged)
        if not 0 < len(clean.cameras) < len(moment.seen.cameras):
            return found
        fit = self._tracker.fit
        step = self._tracker.schedule.follow[-1]
        total = clean.add_up(fit)(fit.body.place(found.values), step)
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


def _without(seen: FrameViews, names: Collection[str]) -> FrameViews:
    """What the cameras see that are not named."""
    chosen = [k for k, camera in enumerate(seen.cameras) if camera.name not in names]
    return FrameViews([seen.cameras[k] for k in chosen], [seen.views[k] for k in chosen])


class _Moment(NamedTuple):
    """What cameras see; whether others were cut out, and who merges person and others."""

    seen: FrameViews
    others: bool = False
    merged: tuple[str, ...] = ()

    @property
    def pairs(self) -> list[tuple[Camera, SilhouetteView]]:
        """Cameras and their views."""
        return list(zip(self.seen.cameras, self.seen.views, strict=True))


def _pack(state: TrackState, watched: float, time: float, elapsed: float) -> np.ndarray:
    lost = state.is_lost
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
