"""A finalized plant as the source of a model, and copies of it in other plants."""

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import numpy as np
from pydrake.geometry import (
    GeometryInstance,
    IllustrationProperties,
    PerceptionProperties,
    SceneGraph,
)
from pydrake.multibody.plant import DiscreteContactSolver, MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    BodyIndex,
    FixedOffsetFrame,
    Frame,
    Joint,
    ModelInstanceIndex,
    PlanarJoint,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    ScrewJoint,
    UniversalJoint,
    WeldJoint,
)

from drake_pose.errors import ModelError


def _screw_axis(joint: ScrewJoint) -> Any:
    """Return a screw joint's axis (3,) in its frame F, which pydrake does not expose."""
    plant = joint.GetParentPlant()
    context = plant.CreateDefaultContext()
    q = np.array(plant.GetPositions(context))
    q[joint.position_start()] = 0.5
    plant.SetPositions(context, q)
    X_FM = joint.frame_on_child().CalcPose(context, joint.frame_on_parent())
    return X_FM.rotation().ToAngleAxis().axis()


_Make = Callable[[Any, str, Frame, Frame], Joint]
# The copies have no damping, which does not affect poses.
_JOINTS: dict[str, _Make] = {
    "weld": lambda joint, *where: WeldJoint(*where, joint.X_FM()),
    "revolute": lambda joint, *where: RevoluteJoint(*where, joint.revolute_axis()),
    "prismatic": lambda joint, *where: PrismaticJoint(*where, joint.translation_axis()),
    "screw": lambda joint, *where: ScrewJoint(*where, _screw_axis(joint), joint.screw_pitch(), 0.0),
    "universal": lambda _, *where: UniversalJoint(*where),
    "ball_rpy": lambda _, *where: BallRpyJoint(*where),
    "planar": lambda _, *where: PlanarJoint(*where),
    "rpy_floating": lambda _, *where: RpyFloatingJoint(*where),
    "quaternion_floating": lambda _, *where: QuaternionFloatingJoint(*where),
}


class Coupling(NamedTuple):
    """A position that follows another one: q[follower] = multiplier * q[leader] + offset."""

    follower: int  # Index in q.
    leader: int  # Index in q, or where stated so among the values of a tree's node.
    multiplier: float  # Factor of the leader's value.
    offset: float  # Constant [rad or m].


def told_multiplier(multiplier: float) -> float:
    """Return the multiplier of a coupler that is added to a plant.

    A plant's constraint tells the follower by its factor 1. A multiplier of -1 gives both joints
    that factor; it is written as the next number.
    """
    return float(np.nextafter(-1.0, -2.0)) if multiplier == -1.0 else multiplier


def read_couplings(plant: MultibodyPlant) -> list[Coupling]:
    """Return the coupler constraints of a finalized plant.

    pydrake exposes them through InverseKinematics only, which refuses plants with tendons. Such a
    plant has no couplings here, and all its constraints are reported as not enforced.
    """
    if plant.num_constraints() == 0:
        return []
    from pydrake.multibody.inverse_kinematics import InverseKinematics  # Slow to import.

    try:
        program = InverseKinematics(plant, with_joint_limits=False).prog()
    except RuntimeError:
        return []
    found = []
    for binding in program.linear_equality_constraints():
        index = program.FindDecisionVariableIndices(binding.variables())
        (row,), (offset,) = binding.evaluator().GetDenseA(), binding.evaluator().lower_bound()
        if np.count_nonzero(row) == 2:
            # The follower has the factor 1; if both have it, the second is the follower.
            k = int(row[1] == 1.0)
            multiplier = -1.0 if row[1 - k] == -told_multiplier(-1.0) else -row[1 - k] / row[k]
            found.append(Coupling(index[k], index[1 - k], multiplier, offset / row[k]))
    return found


def add_coupler(
    plant: MultibodyPlant, follower: Joint, leader: Joint, multiplier: float, offset: float
) -> None:
    """Add q_follower = multiplier * q_leader + offset [rad or m], if the plant supports it."""
    if plant.get_discrete_contact_solver() == DiscreteContactSolver.kSap:
        plant.AddCouplerConstraint(follower, leader, told_multiplier(multiplier), offset)


class PlantSource:
    """An existing plant in place of a model file (``ModelSource``).

    Attributes:
        kind: "plant".
        limits: empty; the limits are the plant's own.

    Args:
        scene_graph: the SceneGraph that the plant is registered with.
        drawn: the bodies whose geometry belongs to the model.
    """

    kind = "plant"

    def __init__(
        self, plant: MultibodyPlant, scene_graph: SceneGraph, drawn: Collection[BodyIndex]
    ) -> None:
        self.plant, self.scene_graph, self.drawn = plant, scene_graph, frozenset(drawn)
        self.limits: dict[str, tuple[float, float]] = {}

    def parse(
        self, plant: MultibodyPlant, scene_graph: SceneGraph | None, prefix: str = ""
    ) -> tuple[list[ModelInstanceIndex], list[str]]:
        """Copy all bodies and joints, which keeps the meaning of q, and the drawn bodies' geometry.

        ``plant``: a plant that is not finalized. ``scene_graph``: the SceneGraph to register the
        plant with; None: the plant is registered already or gets no geometry. ``prefix``: put
        before the names of model instances.

        Returns the model instances of the copy, and no warnings.

        Raises ModelError: a joint has a type that cannot be copied.
        """
        if scene_graph is not None and not plant.geometry_source_is_registered():
            plant.RegisterAsSourceForSceneGraph(scene_graph)
        old, inspector = self.plant, self.scene_graph.model_inspector()
        instances = {ModelInstanceIndex(k): ModelInstanceIndex(k) for k in range(2)}
        for k in range(2, old.num_model_instances()):
            name = prefix + old.GetModelInstanceName(ModelInstanceIndex(k))
            while plant.HasModelInstanceNamed(name):
                name += "_copy"
            instances[ModelInstanceIndex(k)] = plant.AddModelInstance(name)
        bodies = {BodyIndex(0): plant.world_body()}
        for index in (BodyIndex(k) for k in range(1, old.num_bodies())):
            body = old.get_body(index)
            instance, inertia = instances[body.model_instance()], body.default_spatial_inertia()
            bodies[index] = plant.AddRigidBody(body.name(), instance, inertia)
            if index in self.drawn and plant.geometry_source_is_registered():
                for geometry in old.GetVisualGeometriesForBody(body):
                    # Each plant assigns its own render labels, so the label is not copied.
                    name = inspector.GetName(geometry).rpartition("::")[2]
                    X_BG, shape = inspector.GetPoseInFrame(geometry), inspector.GetShape(geometry)
                    own = GeometryInstance(X_BG, shape, name)
                    shown = inspector.GetIllustrationProperties(geometry)
                    rendered = inspector.GetPerceptionProperties(geometry)
                    if shown is not None:
                        own.set_illustration_properties(IllustrationProperties(shown))
                    if rendered is not None:
                        own.set_perception_properties(PerceptionProperties(rendered))
                        own.mutable_perception_properties().RemoveProperty("label", "id")
                    plant.RegisterVisualGeometry(bodies[index], own)
        joints = [old.get_joint(index) for index in old.GetJointIndices()]
        for joint in joints:
            if joint.type_name() not in _JOINTS:
                raise ModelError(
                    f"joint '{joint.name()}' of type '{joint.type_name()}' cannot be copied"
                )
            instance = instances[joint.model_instance()]
            ends = []
            for end, frame in ("F", joint.frame_on_parent()), ("M", joint.frame_on_child()):
                name, X_BE = f"{prefix}{joint.name()}_{end}", frame.GetFixedPoseInBodyFrame()
                on = bodies[frame.body().index()].body_frame()
                ends.append(plant.AddFrame(FixedOffsetFrame(name, on, X_BE, instance)))
            copy = plant.AddJoint(_JOINTS[joint.type_name()](joint, joint.name(), *ends))
            if copy.num_positions():
                limits = joint.position_lower_limits(), joint.position_upper_limits()
                copy.set_position_limits(*limits)
                copy.set_default_positions(joint.default_positions())
        moving = {joint.position_start(): joint for joint in joints if joint.num_positions()}
        for coupling in read_couplings(old):
            follower, leader = (
                plant.GetJointByName(moving[k].name(), instances[moving[k].model_instance()])
                for k in (coupling.follower, coupling.leader)
            )
            add_coupler(plant, follower, leader, coupling.multiplier, coupling.offset)
        return list(instances.values()), []
