"""Bodies in a diagram's SceneGraph that stand as given positions say, with no dynamics."""

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from drake_pose.arrays import Array
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.systems.ports import PortedSystem


class KnownPositions(PortedSystem):
    """Passes positions on, and others instead while they are not known.

    .. pydrake_system::

        name: KnownPositions
        input_ports: [positions]
        output_ports: [known_positions]

    A plant refuses positions that are nan, which is what estimators say before they found a body.

    Args:
        otherwise: (nq,) the output while the input is not finite.
    """

    def __init__(self, otherwise: Array) -> None:
        super().__init__()
        given = self.add_input("positions", len(otherwise))

        def known(context: Context) -> Array:
            q = given.Eval(context)
            return q if np.isfinite(q).all() else otherwise

        self.add_output("known_positions", len(otherwise), known)


def body_poses(plant: MultibodyPlant, q: Array, X_WB: Array | None = None) -> list[RigidTransform]:
    """The poses of all bodies at positions (nq,), in the plant's order; X_WB: of its world."""
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
    """Add a body that stands as positions (nq,) in its own order say; its plant, finalized.

    Args:
        name: of the system between positions and SceneGraph.
        prefix: of the body's name in the SceneGraph.
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


def add_avatar(
    builder: DiagramBuilder,
    model: ParsedModel,
    positions: OutputPort,
    meshcat: Meshcat,
    prefix: str,
    period: float,
) -> None:
    """Show a body in Meshcat, in a SceneGraph of its own that no sensor sees.

    Args:
        positions: (nq,) in its plant's order; while they are nan it stands at its model's default.
        prefix: the path below which it is drawn.
        period: time between two drawings [s].
    """
    scene_graph = builder.AddNamedSystem("avatar_scene_graph", SceneGraph())
    known = builder.AddNamedSystem("avatar_positions", KnownPositions(model.default_positions))
    builder.Connect(positions, known.get_input_port())
    add_posed_plant(builder, scene_graph, model, known.get_output_port(), "avatar_pose")
    parameters = MeshcatVisualizerParams(prefix=prefix, publish_period=period)
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, parameters)
