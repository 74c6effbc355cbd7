"""A finalized plant as the source of a model: copies of it are made in other plants."""

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
    """The axis (3,) of a screw in its frame F, which Drake's Python does not say."""
    plant = joint.GetParentPlant()
    context = plant.CreateDefaultContext()
    q = np.array(plant.GetPositions(context))
    q[joint.position_start()] = 0.5
    plant.SetPositions(context, q)
    X_FM = joint.frame_on_child().CalcPose(context, joint.frame_on_parent())
    return X_FM.rotation().ToAngleAxis().axis()


_Make = Callable[[Any, str, Frame, Frame], Joint]
# Damping plays no role in what is seen.
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

    follower: int
    leader: int
    multiplier: float
    offset: float


def read_couplings(plant: MultibodyPlant) -> list[Coupling]:
    """The couplers of a finalized plant, which its Python tells through InverseKinematics alone.

    None of a plant with tendons, which InverseKinematics refuses: all its constraints are counted
    as not enforced then.
    """
    if plant.num_constraints() == 0:
        return []
    from pydrake.multibody.inverse_kinematics import InverseKinematics  # It imports the solvers.

    try:
        program = InverseKinematics(plant, with_joint_limits=False).prog()
    except RuntimeError:
        return []
    found = []
    for binding in program.linear_equality_constraints():
        index = program.FindDecisionVariableIndices(binding.variables())
        (row,), (offset,) = binding.evaluator().GetDenseA(), binding.evaluator().lower_bound()
        if np.count_nonzero(row) == 2:
            # The follower's factor is 1; where both could be it, the later one is.
            k = int(row[1] == 1.0)
            found.append(Coupling(index[k], index[1 - k], -row[1 - k] / row[k], offset / row[k]))
    return found


def add_coupler(
    plant: MultibodyPlant, follower: Joint, leader: Joint, multiplier: float, offset: float
) -> None:
    """Let a joint follow another one, as Drake's parser does: not where its solver cannot."""
    if plant.get_discrete_contact_solver() == DiscreteContactSolver.kSap:
        plant.AddCouplerConstraint(follower, leader, multiplier, offset)


class PlantSource:
    """A plant that somebody else made, in place of a model file (``ModelSource``).

    Attributes:
        kind: "plant".
        limits: none but the plant's own.

    Args:
        plant: finalized.
        scene_graph: the one that it is registered with.
        seen: the bodies whose geometry is the model's.
    """

    kind = "plant"

    def __init__(
        self, plant: MultibodyPlant, scene_graph: SceneGraph, seen: Collection[BodyIndex]
    ) -> None:
        self.plant, self.scene_graph, self.seen = plant, scene_graph, frozenset(seen)
        self.limits: dict[str, tuple[float, float]] = {}

    def parse(
        self, plant: MultibodyPlant, scene_graph: SceneGraph | None, prefix: str = ""
    ) -> tuple[list[ModelInstanceIndex], list[str]]:
        """Copy all bodies and joints, so that q means the same, and the geometry that is seen.

        Args, returns: as ``ModelSource.parse``. Raises ModelError: a joint is of a type that cannot
        be copied.
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
            if index in self.seen and plant.geometry_source_is_registered():
                for geometry in old.GetVisualGeometriesForBody(body):
                    # A geometry has its looks, but for its label, which each plant gives itself.
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
                raise ModelError(f"joint '{joint.name()}' of type '{joint.type_name()}': no copy")
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
        for one in read_couplings(old):
            follower, leader = (
                plant.GetJointByName(moving[k].name(), instances[moving[k].model_instance()])
                for k in (one.follower, one.leader)
            )
            add_coupler(plant, follower, leader, one.multiplier, one.offset)
        return list(instances.values()), []
