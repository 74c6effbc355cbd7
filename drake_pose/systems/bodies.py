"""Bodies posed by position inputs in a diagram, their skin, and position messages (LCM)."""

from collections.abc import Mapping, Sequence

import numpy as np
from drake import lcmt_robot_state
from pydrake.geometry import (
    GeometryConfigurationVector,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
    SceneGraph,
)
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
    prefix: str = "",
    skin_labels: Mapping[str, int] | None = None,
) -> MultibodyPlant:
    """Add a body without dynamics that is posed by an output port; return its finalized plant.

    Args:
        builder: the diagram to which the system is added.
        scene_graph: a system of the diagram, to which the body's geometry is added.
        model: the body.
        positions: port of the positions (nq,) in the plant's order [rad or m].
        prefix: prefix of the names of the body and of the systems that are added.
        skin_labels: render label of each link, by name, which its skin takes; Drake's own are the
            links' body indices. None: sensors do not see the skin.
    """
    plant = MultibodyPlant(0.0)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    model.add_to(plant, scene_graph, prefix=prefix)
    plant.Finalize()
    poser = MultibodyPositionToGeometryPose(plant, input_multibody_state=False)
    builder.AddNamedSystem(f"{prefix}_geometry_pose", poser)
    builder.Connect(positions, poser.get_input_port())
    builder.Connect(
        poser.get_output_port(), scene_graph.get_source_pose_port(plant.get_source_id())
    )
    if skin_labels is not None and model.skin:
        skin = DeformableSkin(ModelSkin(model), scene_graph, skin_labels, f"{prefix}_skin")
        bender = builder.AddNamedSystem(f"{prefix}_skin_poser", PortedSystem())
        q = bender.add_input("positions", plant.num_positions())
        bender.add_output(
            "configuration",
            GeometryConfigurationVector(),
            lambda context: skin.configuration(skin.skin.vertices(q.Eval(context))),
        )
        builder.Connect(positions, bender.get_input_port())
        configured = scene_graph.get_source_configuration_port(skin.source)
        builder.Connect(bender.get_output_port(), configured)
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
        *,
        is_recorded: bool = False,
    ) -> None:
        super().__init__()
        self._meshcat, self._path = meshcat, path
        self._skin, self._recorded, self._shapes = skin, is_recorded, 0
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
                Rgba(*band.colour, 1.0),
            )
        self._drawn = positions
        self._shapes += 1
        return EventStatus.Succeeded()


def show_in_meshcat(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    meshcat: Meshcat,
    model: ParsedModel,
    positions: OutputPort,
    prefix: str,
    *,
    is_recorded: bool = False,
) -> None:
    """Show a SceneGraph in Meshcat, with the skin of its one model.

    Args:
        builder: the diagram that contains ``scene_graph``.
        meshcat: where to draw.
        model: the body.
        positions: port of its positions (nq,) in the model's order [rad or m].
        prefix: Meshcat path; the skin is in ``<prefix>/skin``.
        is_recorded: as in MeshcatSkin.
    """
    # Cleared here, as the visualizer would clear properties of ``prefix`` at an initialization.
    meshcat.Delete(prefix)
    parameters = MeshcatVisualizerParams(prefix=prefix, delete_on_initialization_event=False)
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, parameters)
    if model.skin:
        skin = ModelSkin(model)
        count = model.plant.num_positions()
        drawer = MeshcatSkin(meshcat, skin, count, f"{prefix}/skin", is_recorded=is_recorded)
        builder.AddNamedSystem(f"{prefix}_meshcat_skin", drawer)
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
