"""Capture of a person from all silhouettes at once, as Drake systems: pictures in, poses out.

A `Walker` follows the commands in the poses through a garden (Date et al., section 6.2).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydrake.geometry import Cylinder, Role, SceneGraph, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import Context, DiagramBuilder, System

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel, ModelSource, package_folder
from drake_pose.camera.models import Camera, camera_tuple
from drake_pose.errors import SettingsError, require_known
from drake_pose.fit.contour_fit import inlier_ratio_of
from drake_pose.person.date.walking import (
    WALK,
    apply_command,
    count_steps,
    recognise_command,
    stance_of,
)
from drake_pose.person.figures import keep_views
from drake_pose.person.pose_tracker import PersonBelief, PersonPoseTracker
from drake_pose.person.views import (
    EDGE_POINTS,
    FrameViews,
    SilhouetteView,
    edge_spacing,
    see_silhouette,
)
from drake_pose.silhouette.segmentation import Background
from drake_pose.systems.bodies import body_poses
from drake_pose.systems.picture_capture import PersonRegion, connect_images
from drake_pose.systems.ports import (
    MemorySystem,
    StagedDiagram,
    export_outputs,
    require_distinct_cameras,
    require_period,
)

# Number of frames for which others are looked for after they were visible; this is slow.
_WATCHED_FRAMES = 15

# Larger turns of a face between two frames are errors [rad].
_AROUND = math.radians(100.0)


class PersonTracker(MemorySystem):
    """Tracks a person in the pictures of several cameras.

    .. pydrake_system::

        name: PersonTracker
        input_ports: [silhouette_<camera>, time]
        output_ports: [estimated_positions, last_positions, body_poses, inlier_ratio, time, visible,
          others, deviations (if asked for)]

    A periodic update fits the pose to the current pictures; output ports read the result. All input
    ports are optional.

    Other persons are cut out. A camera in which the person and another are one figure is ignored if
    three other cameras see the person alone; otherwise it does not count for ``inlier_ratio``.

    Input ports:
        silhouette_<camera> (SilhouetteView): from a SilhouetteSensor; None: no picture.
        time (1): time stamp of the pictures [s]. Nothing is new while it is NaN or unchanged; if it
            is not connected, each update has new pictures.

    Output ports:
        estimated_positions (nq): NaN until the person is found, while another pose explains the
            pictures as well, and while fewer than two cameras see the person [rad or m].
        last_positions (nq): the last known ones, initially the model's default [rad or m].
        body_poses: poses of all bodies at ``last_positions``, in the plant's order.
        inlier_ratio (1): fraction of the contours that fits; 0 if no person is visible.
        time (1): time stamp of the last pictures used [s].
        visible (cameras): 1 if the person is visible in the camera's last picture, else 0.
        others (1): 1 if other persons are in the last pictures, else 0.
        deviations (nq): standard deviations from pictures and limits alone [rad or m].

    Args:
        tracker: the method, with the person's model.
        cameras: calibrated, in the order of the input ports, or by name.
        period: time between two updates [s].
        with_deviations: whether there is an output port ``deviations``.

    Raises:
        SettingsError: there are fewer than two cameras, two have the same name, or the period is
            not positive.
    """

    def __init__(
        self,
        tracker: PersonPoseTracker,
        cameras: Sequence[Camera] | Mapping[str, Camera],
        period: float,
        with_deviations: bool = False,
    ) -> None:
        super().__init__()
        cameras = camera_tuple(cameras)
        require_distinct_cameras(cameras, 2, "a person is tracked by two or more different cameras")
        require_period("tracker", period)
        self._tracker, self._cameras, self._period = tracker, cameras, period
        self._with_deviations = with_deviations
        self._views = self.add_camera_inputs({c.name: f"silhouette_{c.name}" for c in cameras})
        self.add_input("time", 1)
        model = tracker.fit.tree.model
        values = tracker.values(model.default_positions)
        unknown = np.full(len(model.default_positions), np.nan)
        outputs = {
            "estimated_positions": unknown,
            "last_positions": tracker.positions(values),
            "inlier_ratio": np.zeros(1),
            "time": np.full(1, np.nan),
            "visible": np.zeros(len(cameras)),
            "others": np.zeros(1),
        }
        if with_deviations:
            outputs["deviations"] = unknown
        # usual_misfit: 0 before a person is found. watched: number of frames in which others are
        # still looked for.
        scalars = {name: np.zeros(1) for name in (*_SCALARS, "watched")}
        inner = {"values": values, "step": np.zeros(len(values)), **scalars}
        self.declare_vectors(outputs | inner, outputs, period)
        last = self.GetOutputPort("last_positions")
        self.add_output(
            "body_poses",
            [RigidTransform()],
            lambda context: body_poses(model.plant, last.Eval(context)),
            {self.all_state_ticket()},
        )

    def known_person(self, context: Context) -> PersonBelief | None:
        """Return the belief in a context, tracked or lost; None before a person was found."""
        return _belief(self.vectors(context))

    def set_person(self, context: Context, person: PersonBelief) -> None:
        """Set the belief; the next pictures are expected within a period."""
        fresh = {"watched": np.zeros(1), "time": np.full(1, np.nan)}
        state = context.get_mutable_discrete_state()
        self.set_vectors(state, self._packed(person) | fresh)

    def next_vectors(self, context: Context, known: dict[str, Array]) -> Mapping[str, Array]:
        """Return the state vectors that new pictures change, by name; ``known``: copies of all."""
        before, time = float(known["time"][0]), context.get_time()
        stamp = self.eval_input(context, "time")
        if stamp is not None:
            time = float(stamp[0])
            if np.isnan(time) or time == before:
                return {}
        last = _belief(known)
        if last is not None:
            frames = 1.0 if np.isnan(before) else abs(time - before) / self._period
            last = self._tracker.predict(last, frames)
        views = self._views(context)
        cameras = [camera for camera in self._cameras if camera.name in views]
        separated = _SeparatedViews(FrameViews(cameras, list(views.values())))
        found, separated = self._follow(last, separated, known["watched"][0] > 0)
        visible = {*separated.views.showing, *separated.merged}
        changed = {
            "time": np.array([time]),
            "visible": np.array([float(camera.name in visible) for camera in self._cameras]),
            "others": np.array([float(separated.others)]),
        }
        if self._with_deviations:
            changed["deviations"] = np.full(len(known["last_positions"]), np.nan)
        if found is None and last is not None:
            found = self._tracker.start(known["values"])
            found = replace(found, inlier_ratio=0.0, usual_misfit=last.usual_misfit)
        if found is None:
            return changed
        clean = separated.views.without(separated.merged)
        if 0 < len(clean.cameras) < len(separated.views.cameras):
            # The inlier ratio counts only cameras that show this person alone.
            fit, step = self._tracker.fit, self._tracker.settings.follow[-1]
            sums = clean.compare(fit, fit.body.place(found.values), step).sums
            found = replace(found, inlier_ratio=inlier_ratio_of(sums))
        watched = _WATCHED_FRAMES if separated.others else max(known["watched"][0] - 1.0, 0.0)
        changed |= {"watched": np.array([watched])} | self._packed(found)
        if not found.is_lost:
            changed["last_positions"] = self._tracker.positions(found.values)
            if self._with_deviations:
                changed["deviations"] = self._tracker.deviations(found.values, separated.views)
        return changed

    def _packed(self, person: PersonBelief) -> dict[str, Array]:
        """Return a belief as state vectors by name."""
        q = self._tracker.positions(person.values)
        return {
            "estimated_positions": np.full(len(q), np.nan) if person.is_lost else q,
            "values": person.values,
            "step": person.step,
            **{name: np.array([float(getattr(person, name))]) for name in _SCALARS},
        }

    def _follow(
        self, last: PersonBelief | None, separated: "_SeparatedViews", is_watching: bool
    ) -> "tuple[PersonBelief | None, _SeparatedViews]":
        """Return the person's next state, and the views without other persons.

        Others are cut out if there is no last state, while tracking is in trouble, and if
        ``is_watching``; in other frames only if the person is not followed well with them.

        ``last``: the person's last state; None: no person was found yet. ``separated``: all views
        of the frame.
        """
        is_separated = last is None or last.troubled_frames != 0 or is_watching
        if is_separated:
            separated = self._without_others(separated.views, last)
        found = self._follow_one(last, separated.views)
        if not is_separated and (found is None or found.troubled_frames != 0):
            single = self._without_others(separated.views, last)
            if single.others:
                return self._follow_one(last, single.views), single
        return found, separated

    def _follow_one(self, last: PersonBelief | None, seen: FrameViews) -> PersonBelief | None:
        """Return the person's next state in ``seen``; None: no person, or fewer than two views."""
        return self._tracker.update(last, seen) if len(seen.showing) >= 2 else None

    def _without_others(self, seen: FrameViews, last: PersonBelief | None) -> "_SeparatedViews":
        """Return the views ``seen`` without other persons than the one in the last state.

        If ``last`` is None, the tracker chooses the person. Cameras in which the person and another
        are one figure are left out if three others see somebody.
        """
        place = None if last is None else self._tracker.trunk_middle(last.values)
        single, cut, merged = keep_views(seen, place)
        clean = single.without(merged)
        if merged and len(clean.showing) >= 3:
            single = clean
        return _SeparatedViews(single, bool(cut or merged), merged)


class _SeparatedViews(NamedTuple):
    """Views of one person."""

    views: FrameViews  # The cameras that have a picture, and the silhouettes in them.
    others: bool = False  # Whether there were other persons.
    # Names of the cameras in which the person and another are one figure.
    merged: tuple[str, ...] = ()


# Scalar fields of a belief that are state vectors; the first one is an output port as well.
_SCALARS = (
    "inlier_ratio", "misfit", "usual_misfit", "troubled_frames", "evidence", "judged",
)  # fmt: skip


def _belief(known: Mapping[str, Array]) -> PersonBelief | None:
    """Return the belief in a PersonTracker's state vectors by name; None: no person was found."""
    numbers = {name: float(known[name][0]) for name in _SCALARS}
    troubled, judged = int(numbers.pop("troubled_frames")), int(numbers.pop("judged"))
    if not numbers["usual_misfit"]:
        return None
    return PersonBelief(
        known["values"], known["step"], **numbers, troubled_frames=troubled, judged=judged
    )


class SilhouetteSensor(PersonRegion):
    """Extracts the person's silhouette from one camera's picture.

    .. pydrake_system::

        name: SilhouetteSensor
        input_ports: [color_image (optional), label_image (optional)]
        output_ports: [region, silhouette]

    The system has no state. Ports, arguments and errors are those of ``PersonRegion``, and:

    Output ports:
        silhouette: a SilhouetteView of the region, or None.

    ``edge_points``: the picture's height divided by the spacing of edge points.
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
    """Add a SilhouetteSensor for each camera, and the source of their images; return the sensors.

    The sensors are by name of the camera.

    Args:
        builder: the diagram to which the systems are added.
        source: has an output port ``color_image_<camera>`` for each camera, or
            ``label_image_<camera>`` for a camera without background; None: the images are inputs of
            the diagram.
        cameras: cameras by name.
        backgrounds: background models by name of the camera.
        edge_points: as in SilhouetteSensor.

    Raises SettingsError: a camera has neither a background nor a source, or the source lacks an
    output port.
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
    with_deviations: bool = False,
) -> StagedDiagram[PersonTracker]:
    """Build a diagram that tracks a person in the cameras' images.

    Its input ports are ``color_image_<camera>``, its output ports those of PersonTracker and
    ``silhouette_<camera>``, and its stages ``region`` and ``edge``.

    Args:
        tracker: the method, with the person's model.
        cameras: two or more, by name.
        backgrounds: background models by name of the camera; a camera without one needs a source
            with label images.
        period: time between two frames [s].
        edge_points: as in SilhouetteSensor.
        source: of the images instead of input ports, for example a rig's diagram or a
            PictureCapture; see add_silhouette_sensors. Without an output port ``time``, each update
            has new pictures.
        with_deviations: whether there is an output port ``deviations``.

    Raises SettingsError: there are fewer than two cameras, one has no background, or the period is
    not positive.
    """
    builder = DiagramBuilder()
    sensors = add_silhouette_sensors(builder, source, cameras, backgrounds, edge_points)
    person = PersonTracker(tracker, list(cameras.values()), period, with_deviations)
    builder.AddNamedSystem("person_tracker", person)
    for name, sensor in sensors.items():
        builder.Connect(sensor.silhouette, person.GetInputPort(f"silhouette_{name}"))
    if source is not None and source.HasOutputPort("time"):
        builder.Connect(source.GetOutputPort("time"), person.GetInputPort("time"))
    for name, sensor in sensors.items():
        builder.ExportOutput(sensor.silhouette, f"silhouette_{name}")
    export_outputs(builder, person)
    stages = {
        "region": tuple(sensor.region for sensor in sensors.values()),
        "edge": tuple(sensor.silhouette for sensor in sensors.values()),
    }
    return StagedDiagram(builder.Build(), stages, person)


class Walker(MemorySystem):
    """Recognises commands in a person's poses and follows them through a garden.

    .. pydrake_system::

        name: Walker
        input_ports: [positions]
        output_ports: [walker_pose, command, rest]

    A periodic update recognises the command and moves the walker; output ports read the result. The
    rest stance is the first in which the person is seen. There is no command while ``positions``
    are not finite. If the face turns by more than 100 degrees between two frames, its direction was
    wrong before, also at rest: the rest stance turns with it.

    Input ports:
        positions (nq): the person's [rad or m].

    Output ports:
        walker_pose (3): the walker's x, y [m] and heading [rad] in the garden.
        command (2): turn (1 left, -1 right) and walk (1 ahead, -1 behind).
        rest (5): the rest stance; NaN before it is known.

    ``model``: the person, with the links head, left_foot and right_foot. ``period``: time between
    two updates [s]. ``on_spot``: whether standing ahead or behind is a command only while the
    person also walks on the spot, as in the paper.

    Raises SettingsError: the period is not positive; UnknownNameError: a link is missing.
    """

    def __init__(self, model: ArticulatedModel, period: float, on_spot: bool = False) -> None:
        super().__init__()
        require_period("walker", period)
        parts = ("head", "left_foot", "right_foot")
        require_known("link", parts, model.link_names, str(model.path))
        self._plant, self._period = model.plant, period
        self._parts = [model.plant.GetBodyByName(part) for part in parts]
        self._plant_context = model.plant.CreateDefaultContext()
        self._on_spot = on_spot
        self._obstacles = garden_obstacles()
        self.add_input("positions", model.plant.num_positions())
        outputs = {
            "walker_pose": np.array(WALK.start),
            "command": np.zeros(2),
            "rest": np.full(5, np.nan),
        }
        inner = {"heading": np.full(1, np.nan), "steps": np.zeros(3)}
        self.declare_vectors(outputs | inner, outputs, period)

    def next_vectors(self, context: Context, known: dict[str, Array]) -> Mapping[str, Array]:
        """Return the state vectors after the next step, by name; ``known``: the last ones."""
        q = self.GetInputPort("positions").Eval(context)
        turn, walk = 0, 0
        if np.isfinite(q).all():
            turn, walk = self._recognise(q, known)
        else:
            known["heading"], known["steps"] = np.full(1, np.nan), np.zeros(3)
        known["command"] = np.array([turn, walk], dtype=float)
        known["walker_pose"] = apply_command(
            known["walker_pose"], (turn, walk), self._period, self._obstacles
        )
        return known

    def _recognise(self, q: Array, known: dict[str, Array]) -> tuple[int, int]:
        """Return the command (turn, walk), each -1, 0 or 1, of a visible person; update ``known``.

        ``q``: (nq,) the person's positions [rad or m]. ``known``: state vectors by name; the
        person's stance and steps are overwritten.
        """
        self._plant.SetPositions(self._plant_context, q)
        X_WH, *X_WF = [part.EvalPoseInWorld(self._plant_context) for part in self._parts]
        feet = np.array([X.translation() for X in X_WF])
        stance = stance_of(X_WH.rotation().col(0), X_WH.translation(), feet)
        turned = math.remainder(stance[0] - known["heading"][0], 2.0 * math.pi)
        known["heading"] = stance[:1]
        if abs(turned) > _AROUND:
            known["rest"][0] += turned
        if not np.isfinite(known["rest"]).all():
            known["rest"] = stance
        last = known["command"].astype(int)
        turn, walk = recognise_command(stance, known["rest"], (last[0], last[1]))
        lift = float(feet[0, 2] - feet[1, 2])
        known["steps"] = count_steps(lift, known["steps"], self._period)
        is_walking = known["steps"][2] >= 2.0 or not self._on_spot
        return turn, walk if is_walking else 0


def add_garden(builder: DiagramBuilder, X_WG: RigidTransform | None = None) -> SceneGraph:
    """Add urdf/garden/garden.sdf, at X_WG (None: identity), to a diagram; return its SceneGraph."""
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    ModelSource(package_folder() / "garden" / "garden.sdf", {}).parse(plant, scene_graph)
    frame = plant.GetFrameByName("garden")
    plant.WeldFrames(plant.world_frame(), frame, X_WG or RigidTransform())
    plant.Finalize()
    return scene_graph


def garden_obstacles() -> Array:
    """Return obstacles (n, 3): x, y and radius [m] of the garden's cylinders and spheres."""
    inspector = add_garden(DiagramBuilder()).model_inspector()
    obstacles = []
    for geometry in inspector.GetAllGeometryIds(Role.kPerception):
        shape, place = inspector.GetShape(geometry), inspector.GetPoseInFrame(geometry)
        if isinstance(shape, Cylinder | Sphere):
            obstacles.append((*place.translation()[:2], shape.radius()))
    return np.array(obstacles)


def view_from_behind(pose: Array) -> tuple[Array, Array]:
    """Return eye and target (3,) [m] of a view from behind and above a walker.

    ``pose``: (3,) the walker's x, y [m] and heading [rad].
    """
    forward = np.array([math.cos(pose[2]), math.sin(pose[2]), 0.0])
    ground = np.array([pose[0], pose[1], 0.0])
    inside = WALK.half_size - 0.3
    eye = np.clip(ground - 3.2 * forward, -inside, inside)
    eye[2], target = 2.1, ground + 1.5 * forward + (0.0, 0.0, 1.1)
    return eye, target


def walker_transform(pose: Array, rest: Array) -> RigidTransform:
    """Return X_PR of the room in the place, which moves a person at rest to the walker's pose.

    ``pose``: (3,) x, y [m] and heading [rad]. ``rest``: (5,) stance; heading and feet are used.
    """
    turn = RollPitchYaw(0.0, 0.0, pose[2] - rest[0])
    X_PF = RigidTransform(turn, [pose[0], pose[1], 0.0])
    return X_PF.multiply(RigidTransform([-rest[3], -rest[4], 0.0]))
