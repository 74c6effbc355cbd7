"""A person followed by all silhouettes at once, as a Drake system."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, camera_tuple
from drake_pose.fit.colours import COLOURS
from drake_pose.fit.contour_fit import inlier_ratio_of
from drake_pose.person.figures import keep_views
from drake_pose.person.pose_tracker import PersonPoseTracker, TrackState
from drake_pose.person.views import ColourViews, FrameViews, shows_somebody
from drake_pose.systems.bodies import body_poses
from drake_pose.systems.images import ColourPorts
from drake_pose.systems.ports import MemorySystem, require_different, require_period

# Who was seen beside the person is looked for in this many more frames; to look takes long.
_REMEMBERED = 15
# Silhouettes of fewer cameras do not say where the person is.
_SEERS = 2
# Cameras in which the person and another are one figure are left out where this many others remain.
_ENOUGH = 3
# After a pause a motion is expected to go on for no more than this many frames.
_LONGEST_PAUSE = 3.0


class PersonTracker(MemorySystem):
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
        cameras: Sequence[Camera] | Mapping[str, Camera],
        period: float,
        with_deviations: bool = False,
        color_cameras: Collection[str] = (),
    ) -> None:
        super().__init__()
        cameras = camera_tuple(cameras)
        require_different(cameras, 2, "a person is tracked by two or more different cameras")
        require_period("tracker", period)
        self._tracker, self._cameras = tracker, cameras
        self._with_deviations = with_deviations
        self._views = self.add_camera_inputs({c.name: f"silhouette_{c.name}" for c in cameras})
        self.add_input("time", 1)
        self._colours = ColourPorts(
            self, cameras, color_cameras, lambda one: f"color_image_{one.name}"
        )
        # What is known of the person's colours: state, so that a simulation can be replayed.
        self._colours_shape = (len(self._colours.cameras), len(tracker.fit.outlines), 3, COLOURS)
        model = tracker.fit.tree.model
        values = tracker.values(model.default_positions)
        unknown = np.full(len(model.default_positions), np.nan)
        shown = {
            "estimated_positions": unknown,
            "last_positions": tracker.positions(values),
            "share": np.zeros(1),
            "time": np.full(1, np.nan),
            "seen": np.zeros(len(cameras)),
            "others": np.zeros(1),
        }
        if with_deviations:
            shown["deviations"] = unknown
        # The usual share is 0 until the person is known; in as many more frames as are watched
        # others are looked for; elapsed is the time between the last two frames.
        inner = {
            "values": values,
            "step": np.zeros(len(values)),
            **{name: np.zeros(1) for name in ("usual", "troubled", "watched", "elapsed")},
            "colours": np.zeros(int(np.prod(self._colours_shape))),
        }
        self.keep_vectors(shown | inner, shown, period)
        last = self.GetOutputPort("last_positions")
        self.add_output(
            "body_poses",
            [RigidTransform()],
            lambda context: body_poses(model.plant, last.Eval(context)),
            {self.all_state_ticket()},
        )

    def known_person(self, context: Context) -> TrackState | None:
        """What is known of the person, lost or not; None: nobody was found yet."""
        return _person(self.vectors(context), 0.0)

    def set_person(self, context: Context, person: TrackState) -> None:
        """Say what is known of the person; the next pictures follow within a period."""
        fresh = {"watched": np.zeros(1), "time": np.full(1, np.nan), "elapsed": np.zeros(1)}
        state = context.get_mutable_discrete_state()
        self.set_vectors(state, self._packed(person) | fresh)

    def next_vectors(self, context: Context, known: dict[str, Array]) -> Mapping[str, Array]:
        """What is known with the pictures of one moment more."""
        before, time = float(known["time"][0]), context.get_time()
        stamp = self.given(context, "time")
        if stamp is not None:
            time = float(stamp[0])
            if np.isnan(time) or time == before:
                return {}
        elapsed = 0.0 if np.isnan(before) else time - before
        last = _person(known, elapsed)
        views = self._views(context)
        cameras = [camera for camera in self._cameras if camera.name in views]
        moment = _Moment(FrameViews(cameras, list(views.values())))
        colours = self._colour_views(context, known["colours"])
        seen: FrameViews | ColourViews
        if len(moment.seen.showing) < _SEERS and colours is not None and last is not None:
            found: TrackState | None
            found, seen = self._followed_by_colour(last, colours)
            moment, seers = _Moment(FrameViews((), ())), {one.name for one in seen.cameras}
        else:
            found, moment = self._followed(last, moment, known["watched"][0] > 0)
            seen, seers = moment.seen, {*moment.seen.showing, *moment.merged}
        changed = {
            "time": np.array([time]),
            "seen": np.array([float(camera.name in seers) for camera in self._cameras]),
            "others": np.array([float(moment.others)]),
        }
        if self._with_deviations:
            changed["deviations"] = np.full(len(known["last_positions"]), np.nan)
        if found is None and last is not None:
            found = TrackState(last.values, np.zeros(len(last.step)), 0.0, last.usual)
        if found is None:
            return changed
        found = self._judged(found, moment)
        watched = _REMEMBERED if moment.others else max(known["watched"][0] - 1.0, 0.0)
        changed |= {"watched": np.array([watched]), "elapsed": np.array([elapsed])}
        changed |= self._packed(found)
        if not found.is_lost:
            changed["last_positions"] = self._tracker.positions(found.values)
            if self._with_deviations:
                changed["deviations"] = self._tracker.deviations(found.values, seen)
            if colours is not None:
                colours = seen if isinstance(seen, ColourViews) else colours
                changed["colours"] = self._learned(found.values, moment, colours, known["colours"])
        return changed

    def _packed(self, person: TrackState) -> dict[str, Array]:
        """What is known of the person, as vectors."""
        q = self._tracker.positions(person.values)
        numbers = {"share": person.share, "usual": person.usual, "troubled": person.troubled}
        return {
            "estimated_positions": np.full(len(q), np.nan) if person.is_lost else q,
            "values": person.values,
            "step": person.step,
            **{name: np.array([float(number)]) for name, number in numbers.items()},
        }

    def _learned(
        self, values: Array, moment: _Moment, colours: ColourViews, before: Array
    ) -> Array:
        """What is known of the colours after a frame in which the person is not lost."""
        alone = moment.seen.without(moment.merged)
        regions = {one.name: view.region for one, view in alone.pairs if shows_somebody(view)}
        known = colours.learned(self._tracker.fit, values, regions)
        packed = before.reshape(self._colours_shape)
        for k, name in enumerate(self._colours.cameras):
            if name in known:
                packed[k] = known[name]
        return packed

    def _colour_views(self, context: Context, colours: Array) -> ColourViews | None:
        """The pictures that are there, and what is known of the colours; None: no picture."""
        pictures = self._colours.pictures(context)
        if not pictures:
            return None
        packed = zip(self._colours.cameras, colours.reshape(self._colours_shape), strict=True)
        known = {name: one.astype(np.float32) for name, one in packed if one.any()}
        cameras = [camera for camera in self._cameras if camera.name in pictures]
        return ColourViews(cameras, [pictures[camera.name] for camera in cameras], known)

    def _followed_by_colour(
        self, last: TrackState, colours: ColourViews
    ) -> tuple[TrackState, ColourViews]:
        """The next state by pictures, and the pictures with what is known of their colours."""
        if not colours.known and not last.is_lost:
            # The person was set: these are the first pictures.
            known = colours.learned(self._tracker.fit, last.values)
            colours = ColourViews(colours.cameras, colours.pictures, known)
        return self._tracker.follow_by_colour(last, colours), colours

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
        return self._tracker.follow(last, seen) if len(seen.showing) >= _SEERS else None

    def _alone(self, seen: FrameViews, last: TrackState | None) -> _Moment:
        """What cameras see without other persons than the one who was seen last."""
        place = None if last is None else self._tracker.place(last.values)
        alone, cut, merged = keep_views(seen, place)
        clean = alone.without(merged)
        if merged and len(clean.showing) >= _ENOUGH:
            alone = clean
        return _Moment(alone, bool(cut or merged), merged)

    def _judged(self, found: TrackState, moment: _Moment) -> TrackState:
        """A state whose share is that of the cameras in which nobody else's contours are."""
        clean = moment.seen.without(moment.merged)
        if not 0 < len(clean.cameras) < len(moment.seen.cameras):
            return found
        fit = self._tracker.fit
        step = self._tracker.settings.follow[-1]
        total = clean.compare(fit, fit.body.place(found.values), step)
        return replace(found, share=inlier_ratio_of(total.sums))


class _Moment(NamedTuple):
    """What cameras see; whether others were cut out, and who merges person and others."""

    seen: FrameViews
    others: bool = False
    merged: tuple[str, ...] = ()


def _person(known: Mapping[str, Array], elapsed: float) -> TrackState | None:
    """The last frame's state after a time [s]; None where the person is not known yet."""
    share, usual, troubled, usually = (
        float(known[name][0]) for name in ("share", "usual", "troubled", "elapsed")
    )
    if not usual:
        return None
    # Where frames were skipped, the motion has gone on for longer than from frame to frame.
    frames = min(elapsed / usually, _LONGEST_PAUSE) if usually > 0 and elapsed > 0 else 1.0
    return TrackState(known["values"], frames * known["step"], share, usual, int(troubled))
