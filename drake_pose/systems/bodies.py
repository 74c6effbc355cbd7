"""Bodies posed by position inputs in a diagram, their skin, and position messages (LCM)."""

from collections.abc import Mapping, Sequence

import numpy as np
from drake import lcmt_robot_state
from pydrake.geometry import GeometryConfigurationVector, Meshcat, Rgba, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem, OutputPort
from pydrake.systems.rendering import MultibodyPositionToGeometryPose
from pydrake.trajectories import PiecewisePolynomial, Trajectory

from drake_pose.arrays import Array
from drake_pose.body import ModelSkin, ParsedModel
from drake_pose.silhouette.pictures.label_renderer import DeformableSkin
from drake_pose.systems.ports import PortedSystem


def body_poses(plant: MultibodyPlant, q: Array, X_WB: Array | None = None) -> list[RigidTransform]:
    """Return the poses of all bodies in the plant's order at positions q (nq,).

    ``X_WB`` (4, 4) is the pose of the plant's world; None: identity.
    """
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    base = RigidTransform() if X_WB is None else RigidTransform(X_WB)
    return [base @ pose for pose in plant.get_body_poses_output_port().Eval(context)]


def add_posed_plant(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    model: ParsedModel,
    positions: OutputPort,
    name: str,
    prefix: str = "",
) -> MultibodyPlant:
    """Add a body without dynamics that is posed by an output port; return its finalized plant.

    Args:
        builder: the diagram to which the system is added.
        scene_graph: a system of the diagram, to which the body's geometry is added.
        model: the body.
        positions: port of the positions (nq,) in the plant's order [rad or m].
        name: name of the MultibodyPositionToGeometryPose that is added.
        prefix: prefix of the body's name in the SceneGraph.
    """
    plant = MultibodyPlant(0.0)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    model.add_to(plant, scene_graph, prefix=prefix)
    plant.Finalize()
    poser = builder.AddNamedSystem(
        name, MultibodyPositionToGeometryPose(plant, input_multibody_state=False)
    )
    builder.Connect(positions, poser.get_input_port())
    builder.Connect(
        poser.get_output_port(), scene_graph.get_source_pose_port(plant.get_source_id())
    )
    return plant


MESHCAT_PERIOD = 1.0 / 64.0
"""Time between two drawings [s], as in Drake's MeshcatVisualizer."""


class MeshcatSkin(LeafSystem):
    """Draws a skin in Meshcat; MeshcatVisualizer does not draw deformable geometry.

    .. pydrake_system::

        name: MeshcatSkin
        input_ports: [positions]

    A periodic publish event draws the skin every MESHCAT_PERIOD if the positions changed.

    Input ports:
        positions (nq): in the model's order [rad or m].

    Args:
        meshcat: where to draw.
        skin: the skin bands.
        position_count: nq.
        path: Meshcat path of the skin.
        colour: colour of all bands; None: the bands' own colours.
        is_recorded: whether a Meshcat recording must show the motion. Meshcat records the motion of
            objects but not of vertices, so that each new shape becomes an object that is visible
            until the next one.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        skin: ModelSkin,
        position_count: int,
        path: str,
        colour: Rgba | None = None,
        *,
        is_recorded: bool = False,
    ) -> None:
        super().__init__()
        self._meshcat, self._path = meshcat, path
        self._skin, self._colour = skin, colour
        self._recorded = is_recorded
        self._shapes = 0
        self._drawn: np.ndarray | None = None
        self._positions = self.DeclareVectorInputPort("positions", position_count)
        self.DeclarePeriodicPublishEvent(MESHCAT_PERIOD, 0.0, self._draw)
        self.DeclareForcedPublishEvent(self._draw)

    def _draw(self, context: Context) -> EventStatus:
        """Draw the skin at the context's positions unless it is drawn there already."""
        positions = np.array(self._positions.Eval(context))
        if self._drawn is not None and np.array_equal(positions, self._drawn):
            return EventStatus.DidNothing()
        path = self._path
        if self._recorded:
            path, time = f"{self._path}/{self._shapes}", context.get_time()
            # Only this shape is visible from now on.
            if self._shapes:
                before = f"{self._path}/{self._shapes - 1}"
                self._meshcat.SetProperty(before, "visible", False, time)
                if time > 0.0:
                    self._meshcat.SetProperty(path, "visible", False, 0.0)
            self._meshcat.SetProperty(path, "visible", True, time)
        for band, vertices in zip(self._skin.bands, self._skin.vertices(positions), strict=True):
            self._meshcat.SetTriangleMesh(
                f"{path}/{band.child}",
                np.asfortranarray(vertices.T),
                np.asfortranarray(band.mesh.triangles.T),
                self._colour or Rgba(*band.colour, 1.0),
            )
        self._drawn = positions
        self._shapes += 1
        return EventStatus.Succeeded()


def add_skin(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    model: ParsedModel,
    positions: OutputPort,
    labels: Mapping[str, int] | None = None,
) -> None:
    """Add a model's skin to a SceneGraph, so that sensors see it; do nothing if it has none.

    Args:
        builder: the diagram to which the system is added.
        scene_graph: a system of the diagram, which contains the body's rigid parts.
        positions: port of the positions (nq,) in the model's order [rad or m].
        labels: render label of each link, by name, which its skin takes; Drake's own are the links'
            body indices. None: none.
    """
    if not model.skin:
        return
    deformable = DeformableSkin(ModelSkin(model), scene_graph, labels or {}, "true_skin")
    poser = builder.AddNamedSystem("true_skin_poser", PortedSystem())
    q = poser.add_input("positions", model.plant.num_positions())
    poser.add_output(
        "configuration",
        GeometryConfigurationVector(),
        lambda context: deformable.configuration(deformable.skin.vertices(q.Eval(context))),
    )
    builder.Connect(positions, poser.get_input_port())
    builder.Connect(
        poser.get_output_port(), scene_graph.get_source_configuration_port(deformable.source)
    )


def add_meshcat_skin(
    builder: DiagramBuilder,
    meshcat: Meshcat,
    model: ParsedModel,
    positions: OutputPort,
    name: str,
    colour: Rgba | None = None,
    *,
    prefix: str = "visualizer",
    is_recorded: bool = False,
) -> None:
    """Show a model's skin in Meshcat; do nothing if it has none.

    Args:
        builder: the diagram to which the system is added.
        positions: port of the positions (nq,) in the model's order [rad or m].
        name: name of the skin in Meshcat, and with ``_meshcat_skin`` of the new system.
        colour, is_recorded: as in MeshcatSkin.
        prefix: Meshcat path under which it is drawn: that of the MeshcatVisualizer.
    """
    if not model.skin:
        return
    drawer = builder.AddNamedSystem(
        f"{name}_meshcat_skin",
        MeshcatSkin(
            meshcat, ModelSkin(model), model.plant.num_positions(), f"{prefix}/{name}_skin", colour,
            is_recorded=is_recorded,
        ),
    )  # fmt: skip
    builder.Connect(positions, drawer.get_input_port())


def held_positions(q: Array, period: float) -> Trajectory:
    """Return q (n, nq) as a zero-order hold: row k from k - 1/2 to k + 1/2 periods [s]."""
    times = period * (np.arange(len(q) + 1) - 0.5)
    return PiecewisePolynomial.ZeroOrderHold(times, np.vstack([q, q[-1:]]).T)


class RobotStateMessage(PortedSystem):
    """Outputs positions as an lcmt_robot_state, for an LcmPublisherSystem.

    .. pydrake_system::

        name: RobotStateMessage
        input_ports: [positions]
        output_ports: [lcmt_robot_state]

    Input ports:
        positions (nq): [rad or m].

    Output ports:
        lcmt_robot_state: joint names and positions as 32-bit floats, and the context's time [us].

    ``names``: (nq) name of each position, ``model.position_names``.
    """

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self._names = list(names)
        self.add_input("positions", len(names))
        self.add_output(
            "lcmt_robot_state", lcmt_robot_state(), self._calc, {self.all_sources_ticket()}
        )

    def _calc(self, context: Context) -> lcmt_robot_state:
        """Return the message of the context's positions and time."""
        message = lcmt_robot_state()
        message.utime = round(1e6 * context.get_time())
        message.num_joints = len(self._names)
        message.joint_name = self._names
        message.joint_position = self.GetInputPort("positions").Eval(context).tolist()
        return message
