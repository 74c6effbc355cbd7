"""Models of existing plants."""

import numpy as np
import pytest
from pydrake.geometry import Box, SceneGraph, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody import tree
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    DiscreteContactApproximation,
    MultibodyPlant,
)
from pydrake.systems.framework import DiagramBuilder

from drake_pose.body import ArticulatedModel, load_model
from drake_pose.errors import ModelError
from tests.body import sdf_models as sdf
from tests.body.models import FLOATING_URDF, HAND, write

AXIS = np.array([0.6, 0.0, 0.8])
JOINTS = {
    "weld": lambda *where: tree.WeldJoint(*where, RigidTransform([0.1, 0.2, 0.3])),
    "revolute": lambda *where: tree.RevoluteJoint(*where, AXIS),
    "prismatic": lambda *where: tree.PrismaticJoint(*where, AXIS),
    "screw": lambda *where: tree.ScrewJoint(*where, AXIS, 0.3, 0.0),
    "universal": tree.UniversalJoint,
    "ball_rpy": tree.BallRpyJoint,
    "planar": tree.PlanarJoint,
    "rpy_floating": tree.RpyFloatingJoint,
    "quaternion_floating": tree.QuaternionFloatingJoint,
}


def new_plant():
    plant, scene_graph = MultibodyPlant(0.0), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    return plant, scene_graph


def body_poses(plant, q):
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    return [X.GetAsMatrix4() for X in plant.get_body_poses_output_port().Eval(context)]


def test_copies_of_a_plant_have_its_poses_limits_and_defaults():
    """A body on joints of all types in a row, and one that floats by roll, pitch and yaw."""
    plant, scene_graph = new_plant()
    instance = plant.AddModelInstance("thing")
    X = RigidTransform(RollPitchYaw(0.3, 0.2, 0.1), [0.1, -0.2, 0.4])
    body, box = plant.world_body(), Box(0.1, 0.2, 0.3)
    for kind, make in reversed(JOINTS.items()):
        child = plant.AddRigidBody(f"on_{kind}", instance, tree.SpatialInertia.Zero())
        plant.RegisterVisualGeometry(child, X, box, child.name(), np.full(4, 0.5))
        parent = plant.world_body() if "floating" in kind else body
        where = [
            plant.AddFrame(tree.FixedOffsetFrame(f"{one.name()}_{kind}", one.body_frame(), X))
            for one in (parent, child)
        ]
        joint = plant.AddJoint(make(kind, *where))
        if kind in ("revolute", "universal", "screw"):
            count = joint.num_positions()
            joint.set_position_limits(np.full(count, -0.5), np.full(count, 1.5))
            joint.set_default_positions(np.full(count, 0.25))
        body = child
    plant.Finalize()
    copy, other = new_plant()
    model = ArticulatedModel.from_plant(plant, scene_graph)
    copies = [model.add_to(copy, other, prefix="copied_")[-1] for _ in range(2)]
    copy.Finalize()
    names = [copy.GetModelInstanceName(one) for one in copies]
    assert names == ["copied_thing", "copied_thing_copy"]
    q = np.random.default_rng(0).uniform(-1.0, 1.0, plant.num_positions())
    start = plant.GetJointByName("quaternion_floating").position_start()
    q[start : start + 4] /= np.linalg.norm(q[start : start + 4])
    expected = body_poses(plant, q)
    found = body_poses(copy, np.concatenate([q, q]))
    np.testing.assert_allclose(found, [*expected, *expected[1:]], atol=1e-14)
    for ends in ("GetPositionLowerLimits", "GetPositionUpperLimits", "GetDefaultPositions"):
        own = getattr(plant, ends)()
        np.testing.assert_array_equal(getattr(copy, ends)(), np.concatenate([own, own]))
    again = ArticulatedModel.from_plant(copy, other, copies[:1])
    for one, mesh in zip(again.link_meshes.values(), model.link_meshes.values(), strict=True):
        np.testing.assert_allclose(one.vertices, mesh.vertices, atol=1e-15)


def test_model_has_the_chosen_instances_bodies_only(tmp_path):
    plant, scene_graph = new_plant()
    model = load_model(write(tmp_path, FLOATING_URDF), check=False)
    _, second = (model.add_to(plant, scene_graph, prefix=name) for name in ("a_", "b_"))
    black = np.array([0.0, 0.0, 0.0, 1.0])
    plant.RegisterVisualGeometry(plant.world_body(), RigidTransform(), Sphere(1.0), "moon", black)
    plant.Finalize()
    made = ArticulatedModel.from_plant(plant, scene_graph, second)
    own = {int(index) for index in plant.GetBodyIndices(second[0])}
    # Two links have no visual geometry.
    assert made.labels < own
    assert len(made.labels) == len(made.link_meshes) == len(own) - 2
    searched = {name for node in made.pose_tree().nodes for name in node.position_names}
    assert {name[:2] for name in searched} == {"b_"}
    assert len(ArticulatedModel.from_plant(plant, scene_graph).link_meshes) == 2 * len(made.labels)
    for field in ("lower", "upper", "default_positions", "is_unlimited_angle"):
        np.testing.assert_array_equal(getattr(made, field)[12:], getattr(model, field))


def test_unusable_plants_are_refused_by_name():
    plant, scene_graph = new_plant()
    plant.set_name("bench")
    for graph, word in (
        (scene_graph, "not finalized"),
        (SceneGraph(), "not registered"),
        (scene_graph, "no visual geometry"),
    ):
        with pytest.raises(ModelError, match=f"bench .*{word}"):
            ArticulatedModel.from_plant(plant, graph)
        if not plant.is_finalized():
            plant.Finalize()


MIMIC = """<mimic joint="lead"><multiplier>-2</multiplier><offset>.1</offset>
<reference>.2</reference></mimic>"""
SDF = sdf.sdf(
    *map(sdf.link, "abc"),
    sdf.joint("lead", "a", "b", kind="prismatic"),
    sdf.joint("follow", "a", "c", sdf.LIMITS + MIMIC, kind="prismatic"),
)
MJCF = """<mujoco model="m"><worldbody><body name="a"><geom type="box" size=".1 .1 .1"/>
<body name="b"><joint name="lead" type="slide" axis="0 1 0" ref=".05"/>
<geom type="box" size=".1 .1 .1"/></body>
<body name="c"><joint name="follow" type="slide" axis="0 1 0" range="-9 9" ref="-.2"/>
<geom type="box" size=".1 .1 .1"/></body></body></worldbody>
<equality><joint joint1="follow" joint2="lead" polycoef=".6 -2 0 0 0"/></equality></mujoco>"""


@pytest.mark.parametrize(("text", "name"), [(SDF, "m.sdf"), (MJCF, "m.xml")], ids=["sdf", "mjcf"])
def test_every_format_gives_the_same_coupling(tmp_path, text, name):
    model = load_model(write(tmp_path, text, name), check=False)
    (one,) = model.couplings
    plant = MultibodyPlant(0.001)
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kTamsi)
    model.add_to(plant)
    assert [model.position_names[k] for k in one[:2]] == ["follow", "lead"]
    np.testing.assert_allclose(one[2:], (-2.0, 0.5), atol=1e-12)


def test_plant_and_file_give_the_same_couplings(tmp_path):
    path = write(tmp_path, HAND)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    Parser(plant).AddModels(str(path))
    plant.Finalize()
    own = ArticulatedModel.from_plant(plant, scene_graph)
    assert plant.num_constraints() == 3
    assert own.couplings == load_model(path, check=False).couplings
    names = own.position_names
    found = [(names[a], names[b], multiplier, offset) for a, b, multiplier, offset in own.couplings]
    leads = [("mirror", "lead", -1.0, 0.1), ("bend", "lead", -0.5, 0.0), ("far", "lead", 1.0, 0.0)]
    assert found == leads
    other, scene_graph = MultibodyPlant(0.0), SceneGraph()
    own.add_to(other, scene_graph)
    other.Finalize()
    assert other.num_constraints() == 3
