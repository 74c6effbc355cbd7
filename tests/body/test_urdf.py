"""Sanitising of URDF files: geometry, packages, warnings and errors."""

import os

import numpy as np
import pytest
import trimesh

from drake_pose.body import describe_model, load_model
from drake_pose.errors import ModelError
from tests.body.models import BOX, WELDED_URDF, joint, link, urdf, write

ENTITY = '<!DOCTYPE robot [<!ENTITY e SYSTEM "thing.urdf">]>'
STL = '<collision><geometry><mesh filename="{}"/></geometry></collision>'


def read(folder, text, name="thing.urdf", **options):
    return load_model(write(folder, text, name), check=False, **options)


def refusal(folder, text, name="thing.urdf"):
    with pytest.raises(ModelError) as caught:
        read(folder, text, name)
    message = str(caught.value)
    assert name in message
    for raw in ("Failure at", "condition '", "literal-string", "data-string"):
        assert raw not in message
    return message


def arm(more_of_joint="", more="", a=BOX, **options):
    elbow = joint("elbow", options.pop("kind", "revolute"), "a", "b", more=more_of_joint, **options)
    return urdf(link("a", a), link("b"), elbow, more)


def visual(shape, material=""):
    return f"<visual><geometry>{shape}</geometry>{material}</visual>"


@pytest.mark.parametrize("extension", ["stl", "dae"])
def test_collision_meshes_are_neither_drawn_nor_read(tmp_path, extension):
    trimesh.creation.box().export(tmp_path / f"c.{extension}")
    for mesh in (f"c.{extension}", "gone.stl", "package://unknown/c.stl"):
        model = read(tmp_path, WELDED_URDF.replace(BOX, BOX + STL.format(mesh)))
        assert model.position_names == ("a1", "a2")
        assert model.link_meshes.keys() == {"base", "upper", "lower"}
    bare = WELDED_URDF.replace(BOX, STL.format(f"c.{extension}"))
    assert "no visual geometry" in refusal(tmp_path, bare, "bare.urdf")


def test_materials_of_one_name_keep_their_colours(tmp_path):
    def material(rgba):
        return f'<material name="m"><color rgba="{rgba}"/></material>'

    texture = '<material name="t"><texture filename="gone.png"/></material>'
    materials = {"a": material("0 1 0 1"), "b": '<material name="m"/>', "d": material("255 0 0 1")}
    materials |= {"c": '<material name="nowhere"/>', "e": texture}
    text = urdf(
        *[material("1 0 0 1")] * 2,
        *(link(name, visual('<sphere radius="0.1"/>', own)) for name, own in materials.items()),
        *(joint(f"to_{child}", "fixed", "a", child, limits=None) for child in "bcde"),
    )
    model = read(tmp_path, text)
    inspector = model.scene_graph.model_inspector()
    for name, expected in {"a": (0, 1, 0, 1), "b": (1, 0, 0, 1), "d": (1, 0, 0, 1)}.items():
        geometry = model.plant.GetVisualGeometriesForBody(model.plant.GetBodyByName(name))[0]
        rgba = inspector.GetPerceptionProperties(geometry).GetProperty("phong", "diffuse")
        assert (rgba.r(), rgba.g(), rgba.b(), rgba.a()) == expected


@pytest.mark.parametrize(
    ("left", "named"),
    [
        ('<xacro:macro name="m"><link name="c"/></xacro:macro>', "xacro:macro"),
        ('<xacro:my_arm prefix="l"/>', "xacro:my_arm"),
        ('<link name="${prefix}c"/>', "${prefix}c"),
        ('<include filename="$(find arm)/arm.xacro"/>', "include"),
        ('<macro name="m"/>', "macro"),
        (link("c", visual('<mesh filename="$(find arm)/c.stl"/>')), "$(find arm)"),
    ],
)
@pytest.mark.parametrize("declared", [True, False])
def test_unexpanded_macros_are_refused(tmp_path, left, named, declared):
    text = arm(more=left)
    if declared:
        text = text.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ')
    message = refusal(tmp_path, text)
    assert named in message
    line = next(k for k, one in enumerate(text.splitlines(), 1) if named in one)
    assert f"in line {line}: links" in message
    assert "xacro robot.urdf.xacro > robot.urdf" in message


def test_xacro_prefix_and_properties_without_macros_are_accepted(tmp_path):
    text = arm(more='<gazebo><plugin><p>$(arg x)</p></plugin></gazebo><transmission name="t"/>'
               '<xacro:property name="w" value="${pi/2}"/><xacro:arg name="x" default="1"/>'
               '<xacro:property name="o"><origin xyz="0 0 0"/></xacro:property>')  # fmt: skip
    text = text.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ')
    model = read(tmp_path, text)
    assert model.position_names[-1] == "elbow"
    assert model.warnings == ()
    assert "expand it first" in refusal(tmp_path, text, "thing.urdf.xacro")


def test_irrelevant_elements_are_left_out_and_unknown_ones_named(tmp_path):
    text = arm(
        '<safety_controller k_velocity="1"/><dynamics damping="-1"/><mimic joint="gone"/>',
        '<transmission name="t"><joint name="gone"/></transmission><bogus/>',
        a=BOX + '<inertial><mass value="nan"/></inertial><sensor type="camera"/>',
    )
    model = read(tmp_path, text.replace(' name="thing"', ""))
    assert model.name == "thing"
    follower, unknown = sorted(model.warnings)
    assert "'elbow' is written to follow joint 'gone' (<mimic>): not enforced" in follower
    assert "robot 'thing': the element <bogus>" in unknown


def test_continuous_joints_ignore_limits(tmp_path):
    for limits in ('lower="0" upper="0"', 'lower="1" upper="-1"', None):
        model = read(tmp_path, arm(kind="continuous", limits=limits))
        assert (model.lower[-1], model.upper[-1]) == (-np.pi, np.pi)
    model = read(tmp_path, arm(limits='lower="0" upper="0"'))
    assert (model.lower[-1], model.upper[-1]) == (0.0, 0.0)
    model = read(tmp_path, arm(limits='lower="-inf" upper="inf"'))
    assert (model.lower[-1], model.upper[-1]) == (-np.pi, np.pi)


def test_refusals_name_link_or_joint(tmp_path):
    for text, named in (
        (arm(limits='lower="1" upper="-1"'), "joint 'elbow': lower limit 1"),
        (arm(limits='lower="nan" upper="1"'), "joint 'elbow': a limit is NaN"),
        (arm().replace('velocity="1"', 'velocity="-1"'), "joint 'elbow': velocity"),
        (arm(a=visual('<sphere radius="-1"/>')), "link 'a': radius of its sphere is '-1'"),
        (arm(a=visual('<box size="1 1"/>')), "link 'a': size of its box is '1 1'"),
        (arm(a=visual('<cylinder radius="0" length="1"/>')), "link 'a': radius"),
        (arm(a=visual('<drake:ellipsoid a="0" b="1" c="1"/>')), "link 'a': a of its ellipsoid"),
        (arm(a=visual('<cone radius="1"/>')), "link 'a': there is no shape <cone>"),
        (arm(a=visual("")), "link 'a': a <visual> without a shape"),
        (arm(a=visual("<mesh/>")), "link 'a': a mesh without a filename"),
        (arm(a=visual('<mesh filename="gone.obj"/>')), "link 'a': mesh 'gone.obj'"),
        (arm(a=visual('<mesh filename="http://x.org/a.obj"/>')), "link 'a': mesh 'http://x"),
        (arm(a=visual('<mesh filename="thing.urdf" scale="0 1 1"/>')), "link 'a': scale"),
        (arm(axis="0 x 0"), "joint 'elbow': xyz of <axis> is '0 x 0'"),
        (arm(axis="0 0 0"), "'elbow' axis is zero"),
        (arm(origin='xyz="0 0"'), "joint 'elbow': xyz of <origin> is '0 0'"),
        (arm(kind="weird"), "'elbow' has unrecognized type: 'weird'"),
        (arm().replace('child link="b"', 'child link="z"'), "joint 'elbow': its child link 'z'"),
        (arm(more=link("a")), "link 'a' is defined 2 times"),
        (arm(more=joint("elbow", "fixed", "b", "world")), "joint 'elbow' is defined 2 times"),
        (arm().replace(' name="elbow"', ""), "1 <joint> without a name"),
        (ENTITY + arm(more="<bogus>&e;</bogus>"), "external entity"),
        ("<sdf/>", "its outermost element is <sdf>"),
        ("<robot><link></robot>", "not well-formed XML: mismatched tag: line 1"),
    ):
        assert named in refusal(tmp_path, text)


def test_at_most_ten_warnings_of_a_kind(tmp_path):
    chain = [joint(f"j{i}", "revolute", f"l{i}", f"l{i + 1}") for i in range(15)]
    chain = [one.replace("</joint>", '<mimic joint="x"/></joint>') for one in chain]
    text = urdf(*(link(f"l{i}") for i in range(16)), *chain, "<bogus/>")
    warnings = describe_model(write(tmp_path, text)).warnings
    assert sum("<mimic>" in text for text in warnings) == 10
    (last,) = (text for text in warnings if text.endswith(" ... and 5 more of this kind"))
    assert last.startswith("joint 'j9'")
    assert sum("<bogus>" in text for text in warnings) == 1


HEAD = '<?xml version="1.0" encoding="{}"?>\n'


def test_encodings_and_text_before_the_xml_declaration(tmp_path):
    for head, encoding in (
        ("", "utf-8"),
        (HEAD.format("ISO-8859-1"), "iso-8859-1"),
        (HEAD.format("utf-8"), "utf-8-sig"),
        ("\n \n" + HEAD.format("utf-8"), "utf-8"),
        ("<!-- two -- hyphens -->", "utf-8"),
        ("", "iso-8859-1"),
    ):
        path = tmp_path / "thing.urdf"
        path.write_bytes((head + arm(more_of_joint="").replace('"b"', '"Fuß"')).encode(encoding))
        assert "Fuß" in load_model(path, check=False).link_names


def test_unusual_paths_and_read_only_folders(tmp_path):
    folder = tmp_path / "mein Roboter é %20"
    (folder / "meshes").mkdir(parents=True)
    trimesh.creation.box().export(folder / "meshes" / "a b.stl")
    names = ("meshes/a b.stl", f"file://{folder}/meshes/a b.stl", "package://meshes/a%20b.stl")
    text = arm(a="".join(visual(f'<mesh filename="{name}"/>') for name in names))
    path = write(folder, text, "mein arm.urdf")
    folder.chmod(0o555)
    try:
        (tmp_path / "linked.urdf").symlink_to(path)
        for one in (path, tmp_path / "linked.urdf"):
            assert len(load_model(one).link_meshes["a"].triangles) == 3 * 12
    finally:
        folder.chmod(0o755)


def package_urdf(name="package://my_arm/meshes/a.stl"):
    return arm(a=visual(f'<mesh filename="{name}"/>'))


def make_package(folder, name=None):
    """A folder with a mesh, and with a package.xml if a name is given."""
    (folder / "meshes").mkdir(parents=True)
    trimesh.creation.box().export(folder / "meshes" / "a.stl")
    if name:
        (folder / "package.xml").write_text(f"<package><name> {name} </name></package>")
    return folder


@pytest.mark.parametrize(
    ("package", "name", "model", "slashes"),
    [
        ("my_arm", None, "my_arm/urdf", "//"),
        ("other_folder", "my_arm", "other_folder/urdf", "//"),
        ("my_arm", None, "my_robot/urdf", "//"),
        ("my_arm", None, "my_robot/urdf", "///"),
    ],
)
def test_packages_are_found_in_folders_above(tmp_path, package, name, model, slashes):
    make_package(tmp_path / package, name)
    (tmp_path / model).mkdir(parents=True)
    text = package_urdf(f"package:{slashes}my_arm/meshes/a.stl")
    assert read(tmp_path / model, text).link_meshes["a"]


@pytest.mark.parametrize("variable", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", "SDF_PATH"])
def test_packages_are_found_in_search_paths(tmp_path, monkeypatch, variable):
    share = "share" if variable == "AMENT_PREFIX_PATH" else "."
    place = make_package(tmp_path / "workspace" / share / "my_arm", "my_arm")
    (tmp_path / "models").mkdir()
    monkeypatch.delenv(variable, raising=False)
    with pytest.raises(ModelError, match="not known"):
        read(tmp_path / "models", package_urdf())
    monkeypatch.setenv(variable, os.pathsep.join(["/nowhere", str(tmp_path / "workspace")]))
    assert read(tmp_path / "models", package_urdf()).link_meshes["a"]
    if variable == "ROS_PACKAGE_PATH":
        monkeypatch.setenv(variable, str(place.parents[1]))
        assert read(tmp_path / "models", package_urdf("model://my_arm/meshes/a.stl"))
        named = make_package(tmp_path / "renamed", "my_arm")
        monkeypatch.setenv(variable, str(named))
        assert read(tmp_path / "models", package_urdf()).link_meshes["a"]


def test_given_packages_take_precedence(tmp_path):
    make_package(tmp_path / "my_arm")
    given = make_package(tmp_path / "elsewhere")
    (given / "meshes" / "a.stl").unlink()
    trimesh.creation.icosphere(subdivisions=1).export(given / "meshes" / "a.stl")
    found = read(tmp_path, package_urdf())
    model = read(tmp_path, package_urdf(), package_paths={"my_arm": given})
    assert len(found.link_meshes["a"].triangles) == 12
    assert len(model.link_meshes["a"].triangles) == 80
    with pytest.raises(ModelError, match=r"link 'a': mesh .*gone\.stl.* does not exist"):
        read(tmp_path, package_urdf("package://my_arm/gone.stl"), package_paths={"my_arm": given})
    for name in ("nowhere", "drake_models", ".."):
        message = refusal(tmp_path, package_urdf(f"package://{name}/a.stl"))
        assert f"link 'a': mesh 'package://{name}/a.stl': package '{name}' is not known" in message
        assert f"--package {name}=FOLDER" in message


def test_implausible_sizes_and_limits_give_warnings(tmp_path):
    for scale, upper, expected in (
        (1.0, 1.0, []),
        (1000.0, 1.0, ["its lengths and the scale of its meshes are in metres"]),
        (0.001, 1.0, ["its lengths and the scale of its meshes are in metres"]),
        (1.0, 0.0, ["they never move: turn"]),
    ):
        sides = f"{0.3 * scale} {scale} {0.1 * scale}"
        box = f'<visual><geometry><box size="{sides}"/></geometry></visual>'
        at = {"axis": "0 0 1", "limits": f'lower="0" upper="{upper}"', "origin": 'xyz="0 0 0"'}
        turn = joint("turn", "revolute", "a", "b", **at)
        path = write(tmp_path, urdf(link("a", box), link("b", box), turn))
        warnings = describe_model(path).warnings
        assert len(warnings) == len(expected)
        assert all(text in warning for text, warning in zip(expected, warnings, strict=True))
