"""Lenient reading of XML, checks of values, loops of joints, and search for named files."""

import os
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from drake_pose.body import bundled_model, load_model, model_files
from drake_pose.errors import ModelError, UnknownNameError
from tests.body.models import link, urdf, write

HEAD = '<?xml version="1.0" encoding="{}"?>\n'
WORD = '<a b="Fuß"/>'
# What tinyxml reads, by what a strict reader refuses.
LENIENT = {
    "latin1": (HEAD.format("ISO-8859-1") + WORD).encode("latin-1"),
    "latin1 without declaration": WORD.encode("latin-1"),
    "bom": ("\ufeff" + HEAD.format("utf-8") + WORD).encode(),
    "newline": ("\n \n" + HEAD.format("utf-8") + WORD).encode(),
    "comment": ("<!-- a -- b --->" + WORD).encode(),
    "prefix": f'<x:c y:d="e">{WORD}</x:c>'.encode(),
    "entity": f"<c>&nbsp; n & o{WORD}</c>".encode(),
}


@pytest.mark.parametrize("kind", LENIENT)
def test_xml_is_read_as_leniently_as_by_tinyxml(tmp_path, kind):
    path = tmp_path / "thing.xml"
    path.write_bytes(LENIENT[kind])
    root = model_files.read_xml(path)
    assert next(root.iter("a")).attrib == {"b": "Fuß"}
    if kind == "prefix":
        assert (root.tag, root.attrib) == ("x:c", {"y:d": "e"})
    if kind == "entity":
        assert root.text == "&nbsp; n & o"


def test_errors_of_xml_name_file_and_line(tmp_path):
    entity = '<!DOCTYPE a [<!ENTITY e SYSTEM "thing.urdf">]><a>&e;</a>'
    for text, words in (
        (
            "\n\n<a>\n<b></a>",
            r"thing\.urdf is not well-formed XML: mismatched tag: line 4, column 5",
        ),
        (entity, "external entity"),
    ):
        with pytest.raises(ModelError, match=words):
            model_files.read_xml(write(tmp_path, text))
    with pytest.raises(ModelError, match="gone cannot be read"):
        model_files.read_xml(tmp_path / "gone")


def test_numbers_colours_and_limits_of_texts():
    assert model_files.read_numbers(" 1 -2e3 ", 2, "") == [1.0, -2000.0]
    for text, found in (
        ("-1 0.5 255", "0 0.5 1"), ("0 1 0 0.25", "0 1 0 0.25"), ("1 1", None), (None, None)
    ):  # fmt: skip
        assert model_files.colour_text(text) == found
    model_files.require_size("0", 1, "radius", zero=True)
    model_files.require_size("0.1 2", 2, "size")
    for count, texts in ((1, ("x", "inf", None, "1 1", "-1")), (2, ("1", "1 nan", "1 2 3", "0 1"))):
        for text in texts:
            with pytest.raises(ModelError, match=r"^size is '"):
                model_files.require_size(text, count, "size", zero=count == 1)
    for ends, found in (
        (("-1", None), (-1.0, None)), (("-inf", "inf"), (None, None)), (("1", "1"), (1.0, 1.0))
    ):  # fmt: skip
        assert model_files.read_limits(*ends, "j") == found
    for ends, word in ((("1", "0.9"), "above"), (("nan", None), "NaN"), (("x", "1"), "'x', '1'")):
        with pytest.raises(ModelError, match=f"joint 'j'.*{word}"):
            model_files.read_limits(*ends, "j")


@pytest.mark.parametrize("seed", range(5))
def test_loops_are_opened_and_nothing_else_is_lost(seed):
    """By scipy: all links stay connected, by as few joints as can be."""
    rng, model, warnings = np.random.default_rng(seed), ElementTree.Element("robot"), []
    ends = np.array([rng.choice(8, 2, replace=False) for _ in range(10)])
    joints = [ElementTree.SubElement(model, "joint", name=str(k)) for k in range(10)]
    model_files.open_loops(model, joints, ends.astype(str).tolist(), warnings.append)
    kept = ends[[int(joint.get("name")) for joint in model]]
    parts = [
        connected_components(coo_array((np.ones(len(e)), e.T), (8, 8)))[0] for e in (ends, kept)
    ]
    assert parts[0] == parts[1] == 8 - len(kept)
    assert len(warnings) == len(ends) - len(kept)


def test_mimics_that_cannot_be_enforced_are_told():
    values = '<mimic joint="{}" multiplier="{}" offset="0.1"/>'
    elements = "<mimic joint='a'><multiplier>-2</multiplier><reference>0.2</reference></mimic>"
    for text, found in (
        (values.format("a", "0.5"), ["a", "0.5", "0.1"]),
        (elements, ["a", "-2.0", "0.4"]),
        ("<mimic joint='a'/>" + values.format("b", "3"), ["b", "3.0", "0.1"]),
        *((values.format(*wrong), None) for wrong in (("j", 1), ("gone", 1), ("a", 0))),
    ):
        warnings, joint = [], ElementTree.fromstring(f"<joint>{text}</joint>")
        told = model_files.take_mimic(joint, "j", ("a", "b", "j"), warnings.append)
        assert joint.find("mimic") is None
        assert (told and list(told.values()), bool(warnings)) == (found, found is None)
    with pytest.raises(ModelError, match="'j': multiplier of its <mimic>"):
        model_files.take_mimic(
            ElementTree.fromstring('<j><mimic multiplier="x"/></j>'), "j", (), print
        )


def make_package(folder, name=None):
    """A folder with a mesh, and with a package.xml if a name is given."""
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "a.stl").write_text("")
    if name:
        (folder / "package.xml").write_text(f"<package><name> {name} </name></package>")
    return folder


def test_packages_are_found_in_folders_above(tmp_path):
    for k, (package, name, model, slashes) in enumerate((
        ("my_arm", None, "my_arm/urdf", "//"),
        ("other_folder", "my_arm", "other_folder/urdf", "//"),
        ("my_arm", None, "my_robot/urdf", "//"),
        ("my_arm", None, "my_robot/urdf", "///"),
    )):  # fmt: skip
        place = make_package(tmp_path / str(k) / package, name) / "meshes" / "a.stl"
        uri = f"package:{slashes}my_arm/meshes/a.stl"
        file = tmp_path / str(k) / model / "m.urdf"
        assert model_files.FileFinder().resolve(uri, file, "mesh") == place


@pytest.mark.parametrize("variable", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", "SDF_PATH"])
def test_packages_are_found_in_search_paths(tmp_path, monkeypatch, variable):
    share = "share" if variable == "AMENT_PREFIX_PATH" else "."
    make_package(tmp_path / "workspace" / share / "my_arm", "my_arm")
    monkeypatch.delenv(variable, raising=False)

    def found():
        finder, file = model_files.FileFinder(), tmp_path / "models" / "m.urdf"
        return finder.resolve("model://my_arm/meshes/a.stl", file, "mesh").is_file()

    with pytest.raises(ModelError, match=r"not known.*--package my_arm=FOLDER"):
        found()
    paths = ["/nowhere", "", str(tmp_path / "workspace")]
    monkeypatch.setenv(variable, os.pathsep.join(paths))
    assert found()
    if variable == "ROS_PACKAGE_PATH":
        # A folder of packages, and one that is a package itself, whatever its name is.
        for folder in (tmp_path, make_package(tmp_path / "renamed", "my_arm")):
            monkeypatch.setenv(variable, str(folder))
            assert found()


def test_given_packages_take_precedence_and_missing_ones_are_named(tmp_path):
    make_package(tmp_path / "my_arm")
    given = make_package(tmp_path / "elsewhere")
    name, file = "package://my_arm/meshes/a.stl", tmp_path / "m.urdf"
    own = model_files.FileFinder({"my_arm": given, "drake_pose": given})
    assert own.resolve(name, file, "mesh") == given / "meshes" / "a.stl"
    assert (
        model_files.FileFinder().resolve(name, file, "mesh")
        == tmp_path / "my_arm" / "meshes" / "a.stl"
    )
    with pytest.raises(ModelError, match=r"^mesh 'package://my_arm/gone': .*gone does not exist"):
        own.resolve("package://my_arm/gone", file, "mesh")
    for wrong in ("nowhere", "drake_models", ".."):
        with pytest.raises(ModelError, match=rf"package '{wrong}' is not known.*{wrong}=FOLDER"):
            own.resolve(f"package://{wrong}/a.stl", file, "mesh")
    with pytest.raises(ModelError, match="not a local file"):
        own.resolve("http://x.org/a.obj", file, "mesh")
    with pytest.raises(ModelError, match="package 'mine': folder /nowhere"):
        model_files.package_map({"mine": "/nowhere"})
    assert model_files.package_map().Contains("drake_pose")
    assert bundled_model("hand").name == "hand.urdf"
    with pytest.raises(UnknownNameError, match=r"'goblin'.*woman"):
        bundled_model("goblin")


def test_unusual_paths_and_links_to_files_are_read(tmp_path):
    folder = tmp_path / "mein Roboter é %20"
    (folder / "meshes").mkdir(parents=True)
    trimesh.creation.box().export(folder / "meshes" / "a b.stl")
    names = ("meshes/a b.stl", f"file://{folder}/meshes/a b.stl", "package://meshes/a%20b.stl")
    mesh = '<visual><geometry><mesh filename="{}"/></geometry></visual>'
    path = write(folder, urdf(link("a", "".join(mesh.format(name) for name in names))))
    (tmp_path / "linked.urdf").symlink_to(path)
    for one in (path, tmp_path / "linked.urdf"):
        assert len(load_model(one).link_meshes["a"].triangles) == 3 * 12
