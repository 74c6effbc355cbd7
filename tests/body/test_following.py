"""Coupled joints, against Drake's plant and parser."""

import numpy as np
import pytest
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    DiscreteContactApproximation,
    MultibodyPlant,
)
from pydrake.systems.framework import DiagramBuilder

from drake_pose.body import ArticulatedModel, describe_model, load_model, model_warnings
from drake_pose.body.tree_kinematics import TreeKinematics, link_vectors
from drake_pose.errors import ModelError, SettingsError
from drake_pose.fit.parameters import BodyParameters
from drake_pose.fit.surfaces import VERY_FEW, simplify_surfaces
from drake_pose.silhouette.outline import TreeSurfaces
from tests.body import test_sdf as sdf
from tests.body.models import joint, link, link_poses, urdf, write
from tests.fit.motions import assert_motions_are_derivatives

LIMITS = 'lower="0" upper="0.8"'
# A driven finger, a finger that follows it, its tip, which follows by half, and a nail on the tip;
# last a follower that cannot be enforced, because other joints move it, too.
LINKS = (link("world", ""), *map(link, ("palm", "one", "two", "tip", "nail", "far")))
JOINTS = (
    joint("wrist", "revolute", "world", "palm", axis="0 1 0"),
    joint("lead", "revolute", "palm", "one", axis="1 0 0", limits=LIMITS),
    joint("mirror", "revolute", "palm", "two", axis="1 1 0", limits='lower="-0.6" upper="0.1"',
          more='<mimic joint="lead" multiplier="-1" offset="0.1"/>'),
    joint("bend", "revolute", "two", "tip", axis="0 1 0",
          more='<mimic joint="mirror" multiplier="0.5" offset="-0.05"/>'),
    joint("scratch", "revolute", "tip", "nail", axis="0 0 1"),
    joint("far", "prismatic", "nail", "far", axis="0 0 1", more='<mimic joint="lead"/>'),
)  # fmt: skip
HAND = urdf(*LINKS, *JOINTS)


def tree_of(folder, text=HAND, **options):
    return load_model(write(folder, text), check=False).pose_tree(**options)


def drawn(tree, generator):
    kinematics = TreeKinematics(tree)
    low, high = np.maximum(kinematics.lower, -1.0), np.minimum(kinematics.upper, 1.0)
    return kinematics, generator.uniform(low, high)


@pytest.mark.parametrize("root", [None, "tip", "one"])
@pytest.mark.parametrize("step", [1, -1], ids=["leader first", "leader last"])
def test_node_poses_of_coupled_joints_match_the_plant(tmp_path, root, step):
    text, start = urdf(*LINKS, *JOINTS[::step]), None if root is None else [0.1, 0.2, 0.3]
    tree = tree_of(tmp_path, text, root=root, root_position=start)
    model = tree.model
    kinematics = TreeKinematics(tree)
    if root is None:
        assert kinematics.names == ("wrist", "lead", "scratch", "far")
        sources = [tree.nodes[tree.source(i)].name for i in range(6)]
        assert sources == ["palm", "one", "one", "one", "nail", "far"]
    generator = np.random.default_rng(3)
    for _ in range(5):
        _, values = drawn(tree, generator)
        q, X_WB = tree.positions_from(kinematics.split(values))
        positions = dict(zip(model.position_names, q, strict=True))
        np.testing.assert_allclose(positions["mirror"], 0.1 - positions["lead"], atol=1e-9)
        np.testing.assert_allclose(positions["bend"], -0.5 * positions["lead"], atol=1e-9)
        poses = link_poses(model, q)
        for node, X_WN in zip(tree.nodes, kinematics.poses(values), strict=True):
            np.testing.assert_allclose(X_WN, X_WB @ poses[node.name], atol=1e-9)
        back = kinematics.flatten(tree.values_from_positions(q, X_WB))
        broken = q + 0.1 * (np.array(model.position_names) == "bend")
        with pytest.warns(UserWarning, match=r"joint 'bend' is .* joint 'lead' \(<mimic>: -0.5"):
            tree.values_from_positions(broken, X_WB)
        np.testing.assert_allclose(kinematics.poses(back), kinematics.poses(values), atol=1e-9)


def test_report_lists_enforced_couplings_and_warns_of_others(tmp_path):
    tree = tree_of(tmp_path)
    (warning,) = model_warnings(tree.model, tree)
    assert "'far' is written to follow joint 'lead'" in warning
    nodes = {node["name"]: node["joints"] for node in describe_model(write(tmp_path, HAND)).nodes}
    assert [nodes[name][0]["follows"] for name in ("one", "two")] == ["", "-1 lead +0.1"]
    # A leader behind its follower: the tree has the follower's position, the report the model's.
    mimic = '<mimic joint="B" multiplier="2"/>'
    serial = joint("A", "revolute", "world", "a", more=mimic), joint("B", "revolute", "a", "b")
    path = write(tmp_path, urdf(link("world", ""), *map(link, "ab"), *serial))
    joints = [one["joints"][0] for one in describe_model(path).nodes]
    assert [(one["name"], one["follows"]) for one in joints] == [("A", "2 B +0"), ("B", "")]


@pytest.mark.parametrize("lengths", [False, True])
def test_motions_against_finite_differences(tmp_path, lengths):
    kinematics, values = drawn(tree_of(tmp_path), np.random.default_rng(1))
    surfaces = simplify_surfaces(TreeSurfaces(kinematics.tree), VERY_FEW)
    body = BodyParameters(kinematics, surfaces, offsets=link_vectors(kinematics.tree))
    logs = [0.0] * 4 + np.linspace(0.1, 0.2, len(body.links)).tolist() if lengths else []
    assert_motions_are_derivatives(body, np.append(values, logs))


def test_couplings_intersect_limits_and_propagate_held_values(tmp_path):
    model = load_model(write(tmp_path, HAND), check=False)
    lead, mirror = model.position_index("lead"), model.position_index("mirror")
    np.testing.assert_allclose([model.lower[lead], model.upper[lead]], [0.0, 0.7])
    np.testing.assert_allclose([model.lower[mirror], model.upper[mirror]], [-0.6, 0.1])
    tree = model.pose_tree(held={"mirror": -0.3})
    assert tree.held[lead] == pytest.approx(0.4)
    np.testing.assert_allclose(tree.held[model.position_index("bend")], -0.2)
    with pytest.raises(SettingsError, match=r"'mirror' is held at -0.3, but it follows .* 'lead'"):
        model.pose_tree(held={"mirror": -0.3, "lead": 0.1})
    apart = HAND.replace('lower="-0.6" upper="0.1"', 'lower="0.5" upper="0.9"')
    with pytest.raises(ModelError, match=r"'mirror' follows joint 'lead'.*leave no value"):
        tree_of(tmp_path, apart)


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
<body name="c"><joint name="follow" type="slide" axis="0 1 0" range="-9 9"/>
<geom type="box" size=".1 .1 .1"/></body></body></worldbody>
<equality><joint joint1="follow" joint2="lead" polycoef=".4 -2 0 0 0"/></equality></mujoco>"""


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
    other, scene_graph = MultibodyPlant(0.0), SceneGraph()
    own.add_to(other, scene_graph)
    other.Finalize()
    assert other.num_constraints() == 3
