"""Sanitising of SDFormat files and model directives."""

import numpy as np
import pytest
import trimesh
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body import load_model
from drake_pose.errors import ModelError
from tests.body.models import BOX, WELDED_URDF, link_poses, write
from tests.body.models import link as urdf_link
from tests.body.models import urdf as urdf_file
from tests.body.test_mjcf import MJCF
from tests.body.test_urdf import STL, refusal

SHAPE = "<box><size>0.1 0.2 0.3</size></box>"
LIMITS = "<limit><lower>-1</lower><upper>1</upper></limit>"


def link(name, shape=SHAPE, more=""):
    visual = f'<visual name="v"><geometry>{shape}</geometry></visual>' if shape else ""
    return f'<link name="{name}">{visual}{more}</link>'


def joint(name, parent, child, more=LIMITS, kind="revolute"):
    return (
        f'<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>{child}</child>'
        f"<axis><xyz>0 0 1</xyz>{more}</axis></joint>"
    )


def sdf(*parts, name="m"):
    return f'<sdf version="1.9"><model name="{name}">{"".join(parts)}</model></sdf>'


def collision(mesh):
    shape = f"<geometry><mesh><uri>{mesh}</uri></mesh></geometry>"
    return f'<collision name="c">{shape}</collision>'


def test_collision_and_simulator_elements_are_left_out(tmp_path):
    plugin = '<plugin name="p" filename="x"><bogus>${x}</bogus></plugin>'
    sensor = '<sensor name="s" type="camera"/><light name="l" type="point"/>'
    text = sdf(
        link("a", more=collision("model://unknown/c.stl") + sensor),
        link("b", more=collision("gone.dae")),
        joint("elbow", "a", "b", LIMITS + "<dynamics><damping>-1</damping></dynamics>"),
        plugin,
    )
    model = load_model(write(tmp_path, text, "thing.sdf"), check=False)
    assert model.position_names[-1] == "elbow"
    assert model.warnings == ()
    bare = sdf(link("a", "", collision("c.stl")))
    assert "no visual geometry" in refusal(tmp_path, bare, "bare.sdf")


def test_warnings_name_couplings_gearboxes_and_loops(tmp_path):
    text = sdf(
        *(link(name) for name in "abcd"),
        joint("shut", "d", "c"),
        joint("one", "a", "b", LIMITS + '<mimic joint="two" axis="axis"/>'),
        joint("two", "b", "c", kind="continuous"),
        joint("three", "a", "d"),
        joint("gear", "a", "c", kind="gearbox"),
        "<bogus/>",
    )
    model = load_model(write(tmp_path, text, "thing.sdf"), check=False)
    assert set(model.position_names[-3:]) == {"one", "shut", "three"}
    warnings = "\n".join(model.warnings)
    for named in ("'one' is written to follow joint 'two'", "'gear' is a gearbox", "<bogus>"):
        assert named in warnings
    assert "joint 'two' closes a loop of links at 'c'" in warnings


PAIR, OWN = link("a") + link("b"), "<mesh><uri>thing.sdf</uri>{}</mesh>"


def test_refusals_name_link_or_joint(tmp_path):
    for text, named in (
        (sdf(link("a", "<sphere><radius>-1</radius></sphere>")), "link 'a': radius of its sphere"),
        (sdf(link("a", "<cylinder><radius>x</radius></cylinder>")), "link 'a': radius of its cyl"),
        (sdf(link("a", "<cone><radius>1</radius></cone>")), "link 'a': there is no shape <cone>"),
        (sdf(link("a", "<mesh><uri>gone.stl</uri></mesh>")), "link 'a': mesh 'gone.stl'"),
        (sdf(link("a", "<mesh/>")), "link 'a': a mesh without a <uri>"),
        (sdf(link("a", OWN.format("<submesh/>"))), "link 'a': Drake shows the whole mesh"),
        (sdf(link("a", OWN.format("<scale>1 0 1</scale>"))), "link 'a': scale of mesh"),
        (sdf(link("a", more="<pose>0 0 x 0 0 0</pose>")), "link 'a': its <pose> is '0 0 x"),
        (sdf(PAIR, joint("e", "a", "b", LIMITS.replace("-1", "2"))), "joint 'e': lower limit 2"),
        (sdf(PAIR, joint("e", "a", "b").replace("0 0 1", "0 0 0")), "joint 'e': its axis is zero"),
        (sdf(link("a"), joint("e", "a", "b")), "specified by joint with name[e] not found"),
        (sdf(link("a"), link("a")), "Non-unique name[a]"),
        (sdf(link("a")).replace(' version="1.9"', ""), "<sdf> has no version"),
        (sdf(link("${prefix}a")), "${prefix}a"),
        (sdf("<include><uri>model://nowhere</uri></include>"), "--package nowhere=FOLDER"),
        (sdf("<include/>"), "an <include> without a <uri>"),
        ("<robot/>", "its outermost element is <robot>"),
    ):
        assert named in refusal(tmp_path, text, "thing.sdf")


def test_included_models_are_sanitised(tmp_path):
    trimesh.creation.box().export(tmp_path / "c.stl")
    arm = urdf_file(urdf_link("upper", BOX + STL.format("c.stl")))
    write(tmp_path, arm, "arm.urdf")
    folder = tmp_path / "my_box"
    folder.mkdir()
    write(folder, sdf(link("old"), name="box"), "old.sdf")
    write(folder, sdf(link("new", more=collision("../c.stl")), name="box"), "new.sdf")
    config = '<model><sdf version="1.10">new.sdf</sdf><sdf version="1.9">old.sdf</sdf></model>'
    write(folder, config, "model.config")
    text = sdf(
        link("a"),
        "<include><uri>arm.urdf</uri><name>first</name><pose>1 0 0 0 0 0</pose></include>",
        "<include><uri>model://my_box</uri><name>second</name></include>",
    )
    model = load_model(write(tmp_path, text, "thing.sdf"), check=False)
    assert set(model.link_names[1:]) == {"a", "upper", "new"}
    X_WB = link_poses(model, model.default_positions)["upper"]
    np.testing.assert_allclose(X_WB[:3, 3], [1.0, 0.0, 0.0], atol=1e-12)


def directives(*lines):
    return "directives:\n" + "\n".join(lines) + "\n"


def test_models_of_directives_are_sanitised(tmp_path):
    trimesh.creation.box().export(tmp_path / "c.stl")
    write(tmp_path, WELDED_URDF.replace("</link>", STL.format("c.stl") + "</link>"), "arm.urdf")
    write(tmp_path, "\n" + MJCF, "joints.xml")
    write(tmp_path, sdf(link("box", more=collision("c.stl"))), "box.sdf")
    inner = directives("- add_model: {name: man, file: 'package://mine/joints.xml'}")
    write(tmp_path, inner, "inner.dmd.yaml")
    text = directives(
        "- add_model: &arm {name: left, file: package://mine/arm.urdf}",
        "- add_model: {<<: *arm, name: right}",
        "- add_model: {name: crate, file: box.sdf}",
        "- add_weld:",
        "    parent: world",
        "    child: crate::box",
        "    X_PC: {rotation: !Rpy {deg: [0, 0, 90]}}",
        "- add_directives: {file: package://mine/inner.dmd.yaml}",
    )
    path = write(tmp_path, text, "all.dmd.yaml")
    model = load_model(path, package_paths={"mine": tmp_path}, check=False)
    alone = load_model(tmp_path / "joints.xml", check=False)
    assert {"left::upper", "right::upper", "box", "hand"} <= set(model.link_names)
    assert {"left_a1", "left_a2", "right_a1", "right_a2"} <= set(model.position_names)
    assert len(model.add_to(MultibodyPlant(0.0))) == 4
    plant, random = model.plant, np.random.default_rng(5)
    q = random.uniform(alone.lower, alone.upper)
    context, expected = plant.CreateDefaultContext(), link_poses(alone, q)
    instance = plant.GetModelInstanceByName("man")
    plant.SetPositions(context, instance, q)
    for name in ("base", "arm", "hand"):
        X_WB = plant.GetBodyByName(name, instance).EvalPoseInWorld(context)
        np.testing.assert_allclose(X_WB.GetAsMatrix4(), expected[name], atol=1e-12)
    crate = plant.GetBodyByName("box").EvalPoseInWorld(context).rotation().matrix()
    np.testing.assert_allclose(crate[:, 0], [0.0, 1.0, 0.0], atol=1e-12)


def test_refusals_of_directives_name_the_file(tmp_path):
    for text, named in (
        (directives("- add_model: {name: a, file: package://drake_models/a.urdf}"), "--package"),
        (directives("- add_model: {name: a, file: gone.urdf}"), "add_model 'gone.urdf'"),
        (directives("- add_directives: {file: all.dmd.yaml}"), "includes itself"),
        (directives("- add_model: {name: a, file: bad.urdf}"), "link 'a': radius of its sphere"),
        (directives("- bogus: {}"), "bogus"),
        ("", "it is empty"),
        ("a: [", "it is not YAML"),
    ):
        sphere = '<visual><geometry><sphere radius="-1"/></geometry></visual>'
        write(tmp_path, urdf_file(urdf_link("a", sphere)), "bad.urdf")
        path = write(tmp_path, text, "all.dmd.yaml")
        with pytest.raises(ModelError) as caught:
            load_model(path, check=False)
        assert named in str(caught.value)
        assert ("bad.urdf" if "bad.urdf" in text else "all.dmd.yaml") in str(caught.value)
