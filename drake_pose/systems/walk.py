"""A walk-through (Date, section 6.2): a captured person walks through a garden by gestures."""

import math
from collections.abc import Callable, Mapping

import numpy as np
from pydrake.geometry import (
    Cylinder,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    OutputPort,
)
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import Trajectory

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel, ModelSource, package_folder
from drake_pose.errors import UnknownNameError, require_at_least
from drake_pose.person.date.walking import (
    WALK,
    apply_command,
    count_steps,
    recognise_command,
    stance_of,
)
from drake_pose.systems.bodies import add_avatar
from drake_pose.systems.ports import MemorySystem, connect_matching_ports, require_period

KEYS = {"ahead": "ArrowUp", "behind": "ArrowDown", "left": "ArrowLeft", "right": "ArrowRight"}
"""Meshcat's buttons and the keys that press them."""


class Walker(MemorySystem):
    """Recognises commands in a person's poses and follows them through a garden.

    .. pydrake_system::

        name: Walker
        input_ports: [positions, keys (optional)]
        output_ports: [walker_pose, command, rest, avatar_positions]

    A periodic update recognises the command and moves the walker; output ports read the result. The
    rest stance is the first in which the person stands still. There is no command before it, or
    while ``positions`` are not finite. If the face turns by more than 100 degrees between two
    frames, its direction was wrong before, also at rest: the rest stance turns with it.

    Input ports:
        positions (nq): the person's [rad or m].
        keys (2): turn and walk; where not 0, used instead of the gestures.

    Output ports:
        walker_pose (3): the walker's x, y [m] and heading [rad] in the garden.
        command (2): turn (1 left, -1 right) and walk (1 ahead, -1 behind).
        rest (5): the rest stance; NaN before it is known.
        avatar_positions (nq): the last known positions [rad or m].

    Args:
        model: the person, with the links head, left_foot and right_foot.
        standing: (nq,) initial ``avatar_positions`` [rad or m].
        period: time between two updates [s].
        on_spot: whether standing ahead or behind is a command only while the person also walks on
            the spot, as in the paper.
        settle: time for which the person must stand still at first [s]; 0: the first pose is the
            rest stance.

    Raises:
        SettingsError: the period is not positive, or ``settle`` is negative.
        UnknownNameError: a link is missing.
    """

    def __init__(
        self,
        model: ArticulatedModel,
        standing: Array,
        period: float,
        on_spot: bool = False,
        settle: float = 0.0,
    ) -> None:
        super().__init__()
        require_period("walker", period)
        require_at_least(0, settle=settle)
        parts = ("head", "left_foot", "right_foot")
        for part in parts:
            if part not in model.link_names:
                raise UnknownNameError("link", part, model.link_names, str(model.path))
        self._plant, self._period, self._settle = model.plant, period, settle
        self._parts = [model.plant.GetBodyByName(part) for part in parts]
        self._plant_context = model.plant.CreateDefaultContext()
        self._on_spot = on_spot
        self._obstacles = garden_obstacles()
        self.add_input("positions", len(standing))
        self.add_input("keys", 2)
        outputs = {
            "walker_pose": np.array(WALK.start),
            "command": np.zeros(2),
            "rest": np.full(5, np.nan),
            "avatar_positions": standing,
        }
        inner = {
            # Candidate of the rest stance, and the time since which the person stands in it [s].
            "settling": np.append(np.full(5, np.nan), 0.0),
            "heading": np.full(1, np.nan),
            "steps": np.zeros(3),
        }
        self.declare_vectors(outputs | inner, outputs, period)

    def next_vectors(self, context: Context, known: dict[str, Array]) -> Mapping[str, Array]:
        """Return the state vectors after the next step, by name; ``known``: the last ones."""
        q = self.GetInputPort("positions").Eval(context)
        turn, walk = 0, 0
        if np.isfinite(q).all():
            turn, walk = self._recognise(q, known, context.get_time())
        else:
            known["heading"], known["steps"] = np.full(1, np.nan), np.zeros(3)
        pressed = self.eval_input(context, "keys")
        if pressed is not None:
            turn, walk = int(pressed[0]) or turn, int(pressed[1]) or walk
        known["command"] = np.array([turn, walk], dtype=float)
        known["walker_pose"] = apply_command(
            known["walker_pose"], (turn, walk), self._period, self._obstacles
        )
        return known

    def _recognise(
        self,
        q: Array,
        known: dict[str, Array],
        time: float,
        *,
        still: float = 0.08,
        facing: float = 0.25,
        around: float = math.radians(100.0),
    ) -> tuple[int, int]:
        """Return the command (turn, walk), each -1, 0 or 1, of a visible person; update ``known``.

        It is (0, 0) until the rest stance is known.

        Args:
            q: (nq,) the person's positions [rad or m].
            known: state vectors by name; the person's stance and steps are overwritten.
            time: now [s].
            still, facing: a person who stands still moves head and feet by less [m], and turns the
                face by less [rad].
            around: larger turns of the face between two frames are errors [rad].
        """
        known["avatar_positions"] = q
        self._plant.SetPositions(self._plant_context, q)
        X_WH, *X_WF = [part.EvalPoseInWorld(self._plant_context) for part in self._parts]
        feet = np.array([X.translation() for X in X_WF])
        stance = stance_of(X_WH.rotation().col(0), X_WH.translation(), feet)
        turned = math.remainder(stance[0] - known["heading"][0], 2.0 * math.pi)
        known["heading"] = stance[:1]
        if abs(turned) > around:
            known["rest"][0] += turned
        if not np.isfinite(known["rest"]).all():
            moved = np.abs(stance - known["settling"][:5])
            if not (moved[0] <= facing and (moved[1:] <= still).all()):
                known["settling"] = np.append(stance, time)
            if time - known["settling"][5] < self._settle:
                return 0, 0
            known["rest"] = stance
        last = known["command"].astype(int)
        turn, walk = recognise_command(stance, known["rest"], (last[0], last[1]))
        lift = float(feet[0, 2] - feet[1, 2])
        known["steps"] = count_steps(lift, known["steps"], self._period)
        is_walking = known["steps"][2] >= 2.0 or not self._on_spot
        return turn, walk if is_walking else 0


class WalkKeys(MemorySystem):
    """Reads Meshcat's buttons, or the arrow keys, as commands.

    .. pydrake_system::

        name: WalkKeys
        output_ports: [keys, positions]

    A periodic update reads the buttons; output ports read the result.

    Output ports:
        keys (2): turn (1 left, -1 right) and walk (1 ahead, -1 behind).
        positions (nq): of a person who strides while a key is held, and stands otherwise.

    Args:
        meshcat: where the buttons are added.
        stride: (n, nq) positions of one stride that ends standing [rad or m].
        period: time between two updates [s].
        held: time for which a press counts [s]. A key that is held down repeats its press, the
            first time after half a second.
    """

    def __init__(self, meshcat: Meshcat, stride: Array, period: float, held: float = 0.55) -> None:
        super().__init__()
        self._meshcat, self._stride, self._period = meshcat, stride, period
        self._held = held
        for name, key in KEYS.items():
            meshcat.AddButton(name, key)
        # By button: number of presses, and the time for which the last one still counts [s].
        starts = {name: np.zeros(len(KEYS)) for name in ("pressed", "left")}
        self.declare_vectors(starts | {"frame": np.zeros(1)}, (), period)
        tickets = {self.all_state_ticket()}

        def command(context: Context) -> list[float]:
            ahead, behind, left, right = self.vectors(context)["left"] > 0.0
            return [float(left) - float(right), float(ahead) - float(behind)]

        self.add_output("keys", 2, command, tickets)
        self.add_output(
            "positions",
            stride.shape[1],
            lambda context: stride[int(self.vectors(context)["frame"][0]) - 1],
            tickets,
        )

    def next_vectors(self, context: Context, known: dict[str, Array]) -> Mapping[str, Array]:
        """Return the state vectors ``pressed`` and ``left`` of the buttons, and ``frame``.

        ``known``: the last state vectors by name. Row ``frame - 1`` of the stride is shown, the
        last row if ``frame`` is 0.
        """
        pressed = np.array([float(self._meshcat.GetButtonClicks(name)) for name in KEYS])
        held = np.maximum(known["left"] - self._period, 0.0)
        left = np.where(pressed > known["pressed"], self._held, held)
        frame = known["frame"]
        if left.any() or frame[0]:
            frame = (frame + 1.0) % len(self._stride)
        return {"pressed": pressed, "left": left, "frame": frame}


class WalkView(LeafSystem):
    """Moves the avatar through the garden in Meshcat, and the view with it.

    .. pydrake_system::

        name: WalkView
        input_ports: [walker_pose, rest]

    A periodic publish event updates Meshcat.

    Input ports:
        walker_pose, rest: of a ``Walker``.

    Args:
        meshcat: where the avatar is drawn, under the path ``walker``.
        period: time between two updates [s].
    """

    def __init__(self, meshcat: Meshcat, period: float) -> None:
        super().__init__()
        self._meshcat = meshcat
        self._pose = self.DeclareVectorInputPort("walker_pose", 3)
        self._rest = self.DeclareVectorInputPort("rest", 5)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._show)
        self.DeclareForcedPublishEvent(self._show)

    def _show(self, context: Context) -> EventStatus:
        """Move the avatar, once the rest stance is known, and the view."""
        pose, rest = self._pose.Eval(context), self._rest.Eval(context)
        if np.isfinite(rest).all():
            self._meshcat.SetTransform("walker", walker_transform(pose, rest))
        self._meshcat.SetCameraPose(*view_from_behind(pose))
        return EventStatus.Succeeded()


AddPositions = Callable[[DiagramBuilder], OutputPort]
"""Adds systems to a diagram's builder, and returns their port of the person's positions (nq)."""


def build_walk(
    model: ArticulatedModel,
    meshcat: Meshcat,
    positions: Trajectory | AddPositions | None,
    stride: Array,
    period: float = 1.0 / 30.0,
    on_spot: bool = False,
    settle: float = 0.0,
) -> Diagram:
    """Build a diagram of a person who walks through a garden in Meshcat by gestures or keys.

    Its output ports are ``walker_pose`` and ``command``.

    Args:
        model: the person.
        meshcat: where to show the garden.
        positions: the person's positions (nq,) over time, in a room with z upward, NaN where
            unknown; or a function that adds systems which output them; None: keys only.
        stride: (n, nq) one stride on the spot that ends standing, for the keys.
        period, on_spot, settle: as in Walker.
    """
    builder = DiagramBuilder()
    garden = add_garden(builder)
    # MeshcatVisualizer draws once: nothing in the garden moves.
    parameters = MeshcatVisualizerParams(prefix="place", publish_period=math.inf)
    MeshcatVisualizer.AddToBuilder(builder, garden, meshcat, parameters)
    _light(meshcat)
    keys = builder.AddNamedSystem("keys", WalkKeys(meshcat, stride, period))
    walker = builder.AddNamedSystem("walker", Walker(model, stride[-1], period, on_spot, settle))
    if positions is None:
        source = keys.GetOutputPort("positions")
    elif callable(positions):
        source = positions(builder)
    else:
        source = builder.AddNamedSystem("positions", TrajectorySource(positions)).get_output_port()
    builder.Connect(source, walker.GetInputPort("positions"))
    builder.Connect(keys.GetOutputPort("keys"), walker.GetInputPort("keys"))
    view = builder.AddNamedSystem("view", WalkView(meshcat, period))
    connect_matching_ports(builder, walker, view)
    avatar = walker.GetOutputPort("avatar_positions")
    add_avatar(builder, model, avatar, meshcat, "walker/avatar", period)
    for name in ("walker_pose", "command"):
        builder.ExportOutput(walker.GetOutputPort(name), name)
    return builder.Build()


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


def _light(meshcat: Meshcat) -> None:
    """Set up daylight and a sky in Meshcat, and turn off its point lights near the origin."""
    for name in ("/Grid", "/Axes"):
        meshcat.SetProperty(name, "visible", False)
    for name, intensity in {"AmbientLight": 1.6, "FillLight": 1.6}.items():
        meshcat.SetProperty(f"/Lights/{name}/<object>", "intensity", intensity)
    for name in ("PointLightNegativeX", "PointLightPositiveX"):
        meshcat.SetProperty(f"/Lights/{name}/<object>", "intensity", 0.0)
    meshcat.SetProperty("/Background", "top_color", [0.45, 0.65, 0.90])
    meshcat.SetProperty("/Background", "bottom_color", [0.85, 0.92, 0.98])


def view_from_behind(pose: Array) -> tuple[Array, Array]:
    """Return eye and target (3,) [m] of a view from behind and above a walker.

    Args:
        pose: (3,) the walker's x, y [m] and heading [rad].
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
