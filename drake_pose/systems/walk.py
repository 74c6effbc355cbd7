"""A walk-through (Date, section 6.2): a captured person walks through a garden by gestures."""

import math
from collections.abc import Mapping

import numpy as np
from pydrake.geometry import Cylinder, Role, SceneGraph, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import Context, DiagramBuilder

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel, ModelSource, package_folder
from drake_pose.errors import UnknownNameError
from drake_pose.person.date.walking import (
    WALK,
    apply_command,
    count_steps,
    recognise_command,
    stance_of,
)
from drake_pose.systems.ports import MemorySystem, require_period


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

    Args:
        model: the person, with the links head, left_foot and right_foot.
        period: time between two updates [s].
        on_spot: whether standing ahead or behind is a command only while the person also walks on
            the spot, as in the paper.

    Raises:
        SettingsError: the period is not positive.
        UnknownNameError: a link is missing.
    """

    def __init__(self, model: ArticulatedModel, period: float, on_spot: bool = False) -> None:
        super().__init__()
        require_period("walker", period)
        parts = ("head", "left_foot", "right_foot")
        for part in parts:
            if part not in model.link_names:
                raise UnknownNameError("link", part, model.link_names, str(model.path))
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

    def _recognise(
        self, q: Array, known: dict[str, Array], around: float = math.radians(100.0)
    ) -> tuple[int, int]:
        """Return the command (turn, walk), each -1, 0 or 1, of a visible person; update ``known``.

        Args:
            q: (nq,) the person's positions [rad or m].
            known: state vectors by name; the person's stance and steps are overwritten.
            around: larger turns of the face between two frames are errors [rad].
        """
        self._plant.SetPositions(self._plant_context, q)
        X_WH, *X_WF = [part.EvalPoseInWorld(self._plant_context) for part in self._parts]
        feet = np.array([X.translation() for X in X_WF])
        stance = stance_of(X_WH.rotation().col(0), X_WH.translation(), feet)
        turned = math.remainder(stance[0] - known["heading"][0], 2.0 * math.pi)
        known["heading"] = stance[:1]
        if abs(turned) > around:
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
