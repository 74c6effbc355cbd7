"""A person captured by all silhouettes at once, as Drake systems: pictures in, poses out."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, System

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, camera_tuple
from drake_pose.errors import SettingsError
from drake_pose.fit.colours import COLOURS
from drake_pose.fit.contour_fit import inlier_ratio_of
from drake_pose.person.figures import keep_views
from drake_pose.person.pose_tracker import PersonPoseTracker, TrackState
from drake_pose.person.views import (
    EDGE_POINTS,
    ColourViews,
    FrameViews,
    SilhouetteView,
    edge_spacing,
    see_silhouette,
    shows_somebody,
)
from drake_pose.silhouette.segmentation import Background
from drake_pose.systems.bodies import add_avatar, body_poses
from drake_pose.systems.images import ColourPorts
from drake_pose.systems.picture_capture import PersonRegion, connect_images
from drake_pose.systems.ports import (
    MemorySystem,
    StagedDiagram,
    export_outputs,
    require_different,
    require_period,
)


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
    of the contours that fits, 0 where no person was seen; ``time`` the stamp of the last pictures
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
        remembered: in how many more frames others are looked for after they were seen; to look
            takes long.

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
        remembered: int = 15,
    ) -> None:
        super().__init__()
        cameras = camera_tuple(cameras)
        require_different(cameras, 2, "a person is tracked by two or more different cameras")
        require_period("tracker", period)
        self._tracker, self._cameras = tracker, cameras
        self._with_deviations, self._remembered = with_deviations, remembered
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
        """What is known of the person, lost or not; None: no person was found yet."""
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
        found: TrackState | None
        if len(moment.seen.showing) < 2 and colours is not None and last is not None:
            if not colours.known and not last.is_lost:
                # The person was set: these are the first pictures.
                learned = colours.updated_colours(self._tracker.fit, last.values)
                colours = ColourViews(colours.cameras, colours.pictures, learned)
            found, seen = self._tracker.follow_by_colour(last, colours), colours
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
            found = TrackState(last.values, np.zeros(len(last.step)), 0.0, last.usual_ratio)
        if found is None:
            return changed
        clean = moment.seen.without(moment.merged)
        if 0 < len(clean.cameras) < len(moment.seen.cameras):
            # Its inlier ratio is that of the cameras that show this person alone.
            fit, step = self._tracker.fit, self._tracker.settings.follow[-1]
            sums = clean.compare(fit, fit.body.place(found.values), step).sums
            found = replace(found, inlier_ratio=inlier_ratio_of(sums))
        watched = self._remembered if moment.others else max(known["watched"][0] - 1.0, 0.0)
        changed |= {"watched": np.array([watched]), "elapsed": np.array([elapsed])}
        changed |= self._packed(found)
        if not found.is_lost:
            changed["last_positions"] = self._tracker.positions(found.values)
            if self._with_deviations:
                changed["deviations"] = self._tracker.deviations(found.values, seen)
            if colours is not None:
                regions = {k.name: view.region for k, view in clean.pairs if shows_somebody(view)}
                learned = colours.updated_colours(self._tracker.fit, found.values, regions)
                packed = known["colours"].reshape(self._colours_shape)
                for k, name in enumerate(self._colours.cameras):
                    if name in learned:
                        packed[k] = learned[name]
                changed["colours"] = packed
        return changed

    def _packed(self, person: TrackState) -> dict[str, Array]:
        """What is known of the person, as vectors."""
        q = self._tracker.positions(person.values)
        numbers = {
            "share": person.inlier_ratio,
            "usual": person.usual_ratio,
            "troubled": person.troubled_frames,
        }
        return {
            "estimated_positions": np.full(len(q), np.nan) if person.is_lost else q,
            "values": person.values,
            "step": person.step,
            **{name: np.array([float(number)]) for name, number in numbers.items()},
        }

    def _colour_views(self, context: Context, colours: Array) -> ColourViews | None:
        """The pictures that are there, and what is known of the colours; None: no picture."""
        pictures = self._colours.pictures(context)
        if not pictures:
            return None
        packed = zip(self._colours.cameras, colours.reshape(self._colours_shape), strict=True)
        known = {name: one.astype(np.float32) for name, one in packed if one.any()}
        cameras = [camera for camera in self._cameras if camera.name in pictures]
        return ColourViews(cameras, [pictures[camera.name] for camera in cameras], known)

    def _followed(
        self, last: TrackState | None, moment: "_Moment", is_watching: bool
    ) -> "tuple[TrackState | None, _Moment]":
        """The next state, and what the cameras see of the person alone."""
        is_sorted = last is None or last.troubled_frames != 0 or is_watching
        if is_sorted:
            moment = self._alone(moment.seen, last)
        found = self._follow_one(last, moment.seen)
        if not is_sorted and (found is None or found.troubled_frames != 0):
            alone = self._alone(moment.seen, last)
            if alone.others:
                return self._follow_one(last, alone.seen), alone
        return found, moment

    def _follow_one(self, last: TrackState | None, seen: FrameViews) -> TrackState | None:
        """The next state; None where fewer than two cameras see anybody."""
        return self._tracker.follow(last, seen) if len(seen.showing) >= 2 else None

    def _alone(self, seen: FrameViews, last: TrackState | None) -> "_Moment":
        """What cameras see without other persons than the one who was seen last.

        Cameras in which the person and another are one figure are left out where three others show
        somebody.
        """
        place = None if last is None else self._tracker.trunk_middle(last.values)
        alone, cut, merged = keep_views(seen, place)
        clean = alone.without(merged)
        if merged and len(clean.showing) >= 3:
            alone = clean
        return _Moment(alone, bool(cut or merged), merged)


class _Moment(NamedTuple):
    """What cameras see; whether others were cut out, and who merges person and others."""

    seen: FrameViews
    others: bool = False
    merged: tuple[str, ...] = ()


def _person(known: Mapping[str, Array], elapsed: float, longest: float = 3.0) -> TrackState | None:
    """The last frame's state after a time [s]; None where the person is not known yet.

    After a pause a motion is expected to go on for no more than `longest` frames.
    """
    share, usual, troubled, usually = (
        float(known[name][0]) for name in ("share", "usual", "troubled", "elapsed")
    )
    if not usual:
        return None
    # Where frames were skipped, the motion has gone on for longer than from frame to frame.
    frames = min(elapsed / usually, longest) if usually > 0 and elapsed > 0 else 1.0
    return TrackState(known["values"], frames * known["step"], share, usual, int(troubled))


class SilhouetteSensor(PersonRegion):
    """What one camera's picture says of the person.

    .. pydrake_system::

        name: SilhouetteSensor
        input_ports: [color_image, label_image]
        output_ports: [region, silhouette]

    ``silhouette`` is a SilhouetteView of the region (see PersonRegion), or None.

    Args:
        edge_points: the picture's height over the spacing of the edge points.
    """

    def __init__(
        self, camera: Camera, background: Background | None = None, edge_points: float = EDGE_POINTS
    ) -> None:
        super().__init__(camera, background)
        spacing = edge_spacing(camera, edge_points)

        def view(context: Context) -> SilhouetteView | None:
            seen = self.region.Eval(context)
            return None if seen is None else see_silhouette(seen, spacing)

        self.silhouette = self.add_output("silhouette", None, view)


def add_silhouette_sensors(
    builder: DiagramBuilder,
    source: System | None,
    cameras: Mapping[str, Camera],
    backgrounds: Mapping[str, Background],
    edge_points: float = EDGE_POINTS,
) -> dict[str, SilhouetteSensor]:
    """Add a source of images, and a sensor for each camera; without a source images are inputs.

    Args:
        source: what has ``color_image_<camera>``, or ``label_image_<camera>`` of a camera without
            background.

    Raises:
        SettingsError: without a source a camera has no background; or the source lacks an output.
    """
    for name in cameras:
        if source is None and name not in backgrounds:
            raise SettingsError(
                f"camera '{name}' has no background: give one for each of {', '.join(cameras)}"
            )
    if source is not None:
        builder.AddNamedSystem("source", source)
    sensors = {}
    for name, camera in cameras.items():
        sensor = SilhouetteSensor(camera, backgrounds.get(name), edge_points)
        sensors[name] = builder.AddNamedSystem(f"sensor_{name}", sensor)
        wanted = {f"{kind}_{name}": [sensor.GetInputPort(kind)] for kind in sensor.wanted}
        connect_images(builder, source, wanted)
    return sensors


def build_silhouette_capture(
    tracker: PersonPoseTracker,
    cameras: Mapping[str, Camera],
    backgrounds: Mapping[str, Background],
    period: float = 1.0 / 30.0,
    edge_points: float = EDGE_POINTS,
    source: System | None = None,
    meshcat: Meshcat | None = None,
    with_deviations: bool = False,
) -> StagedDiagram[PersonTracker]:
    """Wire the cameras' images to their sensors, and these to what follows the person.

    The diagram's inputs are ``color_image_<camera>``, its outputs those of PersonTracker and
    ``silhouette_<camera>``, and its stages ``region`` and ``edge``.

    Args:
        backgrounds: of all cameras, two or more, unless a source gives label images.
        period: time between two frames [s].
        edge_points: a picture's height over the spacing of the edge points.
        source: of the images in place of the inputs, as a rig's diagram or a PictureCapture; see
            add_silhouette_sensors. Without an output ``time`` every period brings new pictures.
        meshcat: where to show the person.
        with_deviations: whether the positions' standard deviations are an output.

    Raises:
        SettingsError: fewer than two cameras, one without a background, or a period that is not
            positive.
    """
    builder = DiagramBuilder()
    person, sensors = add_person_tracker(
        builder, tracker, cameras, backgrounds, period, edge_points, source, with_deviations
    )
    if meshcat is not None:
        positions = person.GetOutputPort("last_positions")
        add_avatar(builder, tracker.fit.tree.model, positions, meshcat, "avatar", period)
    for name, sensor in sensors.items():
        builder.ExportOutput(sensor.silhouette, f"silhouette_{name}")
    export_outputs(builder, person)
    stages = {
        "region": tuple(sensor.region for sensor in sensors.values()),
        "edge": tuple(sensor.silhouette for sensor in sensors.values()),
    }
    return StagedDiagram(builder.Build(), stages, person)


def add_person_tracker(
    builder: DiagramBuilder,
    tracker: PersonPoseTracker,
    cameras: Mapping[str, Camera],
    backgrounds: Mapping[str, Background],
    period: float,
    edge_points: float = EDGE_POINTS,
    source: System | None = None,
    with_deviations: bool = False,
) -> tuple[PersonTracker, dict[str, SilhouetteSensor]]:
    """Add what follows a person, its sensors and the source; as of build_silhouette_capture."""
    sensors = add_silhouette_sensors(builder, source, cameras, backgrounds, edge_points)
    person = PersonTracker(tracker, list(cameras.values()), period, with_deviations)
    builder.AddNamedSystem("person_tracker", person)
    for name, sensor in sensors.items():
        builder.Connect(sensor.silhouette, person.GetInputPort(f"silhouette_{name}"))
    if source is not None and source.HasOutputPort("time"):
        builder.Connect(source.GetOutputPort("time"), person.GetInputPort("time"))
    return person, sensors
