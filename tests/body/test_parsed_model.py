"""Joint limits, and the ranges that are searched and reported."""

import math

import numpy as np
import pytest
from pydrake.math import RotationMatrix

from drake_pose.body import RootRotation, load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import ModelError
from tests.body.models import JOINTS_SDF, joint, link, link_poses, urdf, write

FULL = 2.0 * math.pi


def one_joint(tmp_path, limits, kind="revolute", given=None, mount="fixed"):
    """Two links with a joint between them; limits are URDF attributes."""
    text = urdf(
        link("a"),
        link("b"),
        joint("mount", mount, "world", "a"),
        joint("j", kind, "a", "b", limits=limits),
    )
    return load_model(write(tmp_path, text), limits=given, check=False)


def test_limits_wider_than_four_turns_are_ignored(tmp_path):
    for limits, kind in (
        (None, "continuous"),
        (None, "revolute"),
        ('lower="-1e16" upper="1e16"', "revolute"),
        ('lower="-10000" upper="10000"', "revolute"),
        ('lower="-12.6" upper="12.6"', "revolute"),
    ):
        model = one_joint(tmp_path, limits, kind)
        np.testing.assert_allclose([model.lower[0], model.upper[0]], [-math.pi, math.pi])
        assert model.is_unlimited_angle[0]
        about_joint = [warning for warning in model.warnings if "joint 'j'" in warning]
        assert len(about_joint) == (limits is not None)
        if limits is not None:
            assert "turn freely" in about_joint[0]
            assert f"{float(limits.split(chr(34))[3]):g} rad" in about_joint[0]
        tree = model.pose_tree()
        node = tree.node_index("b")
        grid = np.degrees(tree.grid(node, math.radians(20.0))[:, 0])
        assert len(grid) == 18
        assert np.abs(grid).max() <= 180.0 + 1e-9
        assert np.isinf(tree.value_limits(node)).all()


@pytest.mark.parametrize("high", [3.1, math.pi, FULL, 2.0 * FULL])
def test_one_turn_is_searched_of_limits_of_several_turns(tmp_path, high):
    model = one_joint(tmp_path, f'lower="{-high}" upper="{high}"')
    assert not model.is_unlimited_angle[0]
    assert not model.warnings
    np.testing.assert_allclose([model.lower[0], model.upper[0]], [-high, high])
    tree = model.pose_tree()
    node, around = tree.node_index("b"), high >= math.pi
    np.testing.assert_allclose(np.ravel(tree.value_limits(node)), [-high, high])
    searched = min(high, math.pi)
    np.testing.assert_allclose(np.ravel(tree.value_bounds(node)), [-searched, searched])
    assert tree.covers_full_turn(node).all() == around
    assert not model.pose_tree(held={"j": 0.3}).covers_full_turn(node).any()
    kinematics = TreeKinematics(tree)
    reach = np.inf if around else high
    assert (kinematics.lower[0], kinematics.upper[0]) == (-reach, reach)
    turned = 9.0 - FULL if around else 9.0
    np.testing.assert_allclose(kinematics.nearest_turns(np.array([9.0])), [turned])


def test_searched_turn_is_inside_limits_about_the_default(tmp_path):
    text = """<sdf version="1.9"><model name="m"><link name="a"><visual name="v"><geometry><box>
    <size>1 1 1</size></box></geometry></visual></link><joint name="j" type="revolute"><parent>world
    </parent><child>a</child><axis><xyz>0 0 1</xyz>
    <limit><lower>{}</lower><upper>{}</upper></limit></axis></joint></model></sdf>"""
    # A joint without a default position has 0, moved inside its limits.
    for limits, turn in (
        ((-math.pi, 3 * math.pi), (-math.pi, math.pi)),
        ((-1.0, 9.0), (-1.0, FULL - 1.0)),
        ((-9.0, 0.5), (0.5 - FULL, 0.5)),
        ((2.0, 2.0 + 1.5 * FULL), (2.0, 2.0 + FULL)),
        ((2.0, 1e16), (2.0, 2.0 + FULL)),
    ):
        file = write(tmp_path, text.format(*limits), "m.sdf")
        tree = load_model(file, check=False).pose_tree()
        np.testing.assert_allclose(np.ravel(tree.value_bounds(0)), turn, atol=1e-9)
        grid = tree.grid(0, math.radians(20.0))[:, 0]
        assert turn[0] - 1e-9 <= grid.min() <= grid.max() <= turn[1] + 1e-9
        assert len(np.unique(np.round(np.degrees(grid) % 360.0, 6) % 360.0)) == len(grid) == 18


def test_given_limits_replace_those_of_the_file(tmp_path):
    model = one_joint(tmp_path, None, "continuous", {"j": (-500.0, 500.0)})
    assert model.is_unlimited_angle[0]
    assert "joint 'j'" in model.warnings[0]
    model = one_joint(tmp_path, 'lower="-1e16" upper="1e16"', given={"j": (-0.5, 0.25)})
    assert not model.warnings
    np.testing.assert_allclose([model.lower[0], model.upper[0]], [-0.5, 0.25])
    model = one_joint(tmp_path, 'lower="-1e16" upper="1e16"', "prismatic")
    assert np.isinf([model.lower[0], model.upper[0]]).all(), "a slide with absurd limits"
    assert "joint 'j' has limits of -1e+16 and 1e+16 m" in model.warnings[0]
    # A slide with no limit, or with one, gives no warning before it is searched.
    for none in (None, 'upper="1"'):
        assert not one_joint(tmp_path, none, "prismatic").warnings
    for wrong, message in (((2.0, 1.0), "lower limit 2 is above upper"), ((np.nan, 1.0), "NaN")):
        with pytest.raises(ModelError, match=f"joint 'j': .*{message}"):
            one_joint(tmp_path, None, "continuous", {"j": wrong})


def test_joints_that_cannot_be_searched_are_refused_by_name(tmp_path):
    for limits, kind, message in (
        ('lower="-1e16" upper="1e16"', "prismatic", r"joint 'j' has no limits, or limits too wide"),
        ('lower="0" upper="5000"', "prismatic", r"'j' .*limits={'j': \(low, high\)}"),
        ('upper="1"', "prismatic", r"joint 'j' has no limits"),
        ('lower="-1"', "revolute", r"joint 'j' has no limits: .*upper inf \[rad\]"),
    ):
        with pytest.raises(ModelError, match=message):
            one_joint(tmp_path, limits, kind, mount="revolute").pose_tree()
        model = one_joint(tmp_path, limits, kind, {"j": (-0.5, 0.5)}, mount="revolute")
        assert model.pose_tree().model.upper[model.position_index("j")] == 0.5


def test_screw_is_not_periodic(tmp_path):
    three_turns = JOINTS_SDF.replace(">-3</lower><upper>3<", ">-9</lower><upper>9<")
    model = load_model(write(tmp_path, three_turns, "m.sdf"), check=False)
    index = model.position_index("screw")
    assert not model.periodic[index]
    assert model.periodic[model.position_index("turn")]
    tree = model.pose_tree()
    node = next(i for i, one in enumerate(tree.nodes) if "screw" in one.value_names)
    column = tree.nodes[node].value_names.index("screw")
    assert not tree.covers_full_turn(node)[column]
    grid = tree.grid(node, 1.0)
    np.testing.assert_allclose(np.unique(grid[:, column]), np.arange(-9.0, 10.0))
    without = JOINTS_SDF.replace(
        "<limit><lower>-3</lower><upper>3</upper><effort>0</effort></limit>", ""
    )
    model = load_model(write(tmp_path, without, "m.sdf"), check=False)
    assert any("'screw' is a screw without limits" in warning for warning in model.warnings)


def test_full_turns_do_not_change_drakes_poses(tmp_path):
    model = one_joint(tmp_path, 'lower="-6.2831853" upper="6.2831853"')
    tree = model.pose_tree()
    kinematics = TreeKinematics(tree)

    def pose(q):
        return link_poses(model, q)["b"]

    random = np.random.default_rng(3)
    for values in random.uniform(-FULL, FULL, (40, 1)):
        turned = kinematics.nearest_turns(values)
        assert abs(turned[0]) <= math.pi
        np.testing.assert_allclose(pose(turned), pose(values), atol=1e-12)
        near = random.uniform(-20.0, 20.0, 1)
        followed = kinematics.nearest_turns(values, near)
        assert abs(followed[0] - near[0]) <= math.pi + 1e-12
        np.testing.assert_allclose(pose(followed), pose(values), atol=1e-12)
        inside = kinematics.within_limits(followed)
        assert abs(inside[0]) <= FULL
        if abs(followed[0]) <= FULL - 1e-6:
            assert inside[0] == followed[0]
        np.testing.assert_allclose(pose(inside), pose(values), atol=1e-12)
    assert kinematics.within_limits(np.array([400.0]))[0] == pytest.approx(400.0 - 63 * FULL)


def test_root_rotation_angles_are_within_limits():
    """Euler angles between -180 and 180 degrees must be moved into the limits."""
    rotation = RootRotation.limited([("y", 90.0, 270.0)])
    for angle in (100.0, 190.0, 265.0):
        R = RotationMatrix.MakeYRotation(math.radians(angle)).matrix()
        values = rotation.values_from(R)
        np.testing.assert_allclose(np.degrees(values), [angle], atol=1e-9)
