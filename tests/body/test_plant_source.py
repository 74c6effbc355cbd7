"""Models of existing plants."""

import numpy as np
import pytest
from pydrake.geometry import Box, SceneGraph, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody import tree
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.errors import ModelError
from tests.body.models import FLOATING_URDF, write

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


@pytest.mark.parametrize("kind", JOINTS)
def test_copy_of_a_plant_has_the_same_poses(kind):
    plant, scene_graph = new_plant()
    instance = plant.AddModelInstance("thing")
    ends = [plant.world_body()]
    for name in ("inner", "outer"):
        ends.append(plant.AddRigidBody(name, instance, tree.SpatialInertia.Zero()))
        box, grey = Box(0.1, 0.2, 0.3), np.full(4, 0.5)
        plant.RegisterVisualGeometry(ends[-1], RigidTransform(), box, name, grey)
    frames = [body.body_frame() for body in ends[:2]]
    plant.AddJoint(tree.RevoluteJoint("first", *frames, [0, 1, 0]))
    X = RigidTransform(RollPitchYaw(0.3, 0.2, 0.1), [0.1, -0.2, 0.4])
    where = [
        plant.AddFrame(tree.FixedOffsetFrame(f"{body.name()}_here", body.body_frame(), X))
        for body in (ends[0] if "floating" in kind else ends[1], ends[2])
    ]
    plant.AddJoint(JOINTS[kind]("second", *where))
    plant.Finalize()
    copy, other = new_plant()
    ArticulatedModel.from_plant(plant, scene_graph).add_to(copy, other, prefix="copied_")
    copy.Finalize()

    q = np.random.default_rng(0).uniform(-1.0, 1.0, plant.num_positions())
    if kind == "quaternion_floating":
        start = plant.GetJointByName("second").position_start()
        q[start : start + 4] /= np.linalg.norm(q[start : start + 4])
    assert copy.GetPositionNames(False) == plant.GetPositionNames(False)
    assert np.allclose(body_poses(copy, q), body_poses(plant, q), atol=1e-14)


def test_model_from_plant_equals_model_from_file(tmp_path):
    for file in (write(tmp_path, FLOATING_URDF), bundled_model("woman")):
        read = load_model(file, check=False)
        plant, scene_graph = new_plant()
        instances = read.add_to(plant, scene_graph)
        plant.Finalize()
        made = ArticulatedModel.from_plant(plant, scene_graph, instances)
        assert made.position_names == read.position_names
        for field in ("lower", "upper", "default_positions", "is_unlimited_angle"):
            assert np.array_equal(getattr(made, field), getattr(read, field))
        assert made.link_meshes.keys() == read.link_meshes.keys()
        for name, mesh in made.link_meshes.items():
            assert np.allclose(mesh.vertices, read.link_meshes[name].vertices, atol=1e-12)


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
    bodies = {plant.get_body(tree.BodyIndex(k)).name() for k in own}
    assert bodies >= {name.rpartition("::")[2] for name in made.link_meshes}
    searched = {name for node in made.pose_tree().nodes for name in node.position_names}
    assert searched
    assert all(name.startswith("b_") for name in searched)
    assert len(ArticulatedModel.from_plant(plant, scene_graph).link_meshes) == 2 * len(made.labels)
    assert not made.changes_shape
    leg = "b_::thing::leg"
    assert {*made.link_meshes} - {*made.without([leg]).link_meshes} == {leg}


def test_unusable_plants_are_refused_by_name():
    plant, scene_graph = new_plant()
    plant.set_name("bench")
    with pytest.raises(ModelError, match="bench is not finalized"):
        ArticulatedModel.from_plant(plant, scene_graph)
    plant.Finalize()
    with pytest.raises(ModelError, match="bench is not registered"):
        ArticulatedModel.from_plant(plant, SceneGraph())
    with pytest.raises(ModelError, match="no visual geometry"):
        ArticulatedModel.from_plant(plant, scene_graph)
