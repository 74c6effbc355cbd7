"""MJCF files made safe for Drake: what MuJoCo says of bodies, joints and looks, in plain elements.

Drake 1.51 puts all but the last joint of a body at the parent's origin
(``multibody/parsing/detail_mujoco_parser.cc``, ParseBody). MuJoCo applies the joints of a body one
after the other, each about its ``pos`` in the body's frame: as nested bodies with one joint each.
Drake also forgets inherited settings, so every element here says all of itself. Collision is left
out. Source: MuJoCo's XML reference, "default" and "compiler", tried with MuJoCo 4.0.
"""

import itertools
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from drake_pose.body.formats.mjcf_geometry import (
    ORIENTATIONS,
    numbers,
    write_out_meshes,
    write_out_poses,
)
from drake_pose.body.formats.xml_files import read_xml, xml_text
from drake_pose.errors import ModelError

# Elements that make bodies, joints or shapes and that Drake ignores.
_IGNORED_BY_DRAKE = ("composite", "flexcomp", "attach", "replicate")
# What neither moves a body nor is a part of one; Drake refuses or remarks on some of it.
_WITHOUT_EFFECT = (
    "camera", "light", "site", "texture", "contact", "sensor", "keyframe", "visual", "statistic",
    "option",
)  # fmt: skip
# Attributes about contact and forces: Drake remarks on each of them that it does not use it.
_FORCES = {
    "joint": (
        "actuatorfrclimited", "actuatorfrcrange", "actuatorgravcomp", "frictionloss", "group",
        "margin", "solimpfriction", "solimplimit", "solreffriction", "solreflimit", "springdamper",
        "springref", "stiffness", "user",
    ),
    "geom": (
        "condim", "fluidcoef", "fluidshape", "friction", "gap", "margin", "priority", "solimp",
        "solmix", "solref", "user",
    ),
    "body": ("gravcomp", "mocap", "sleep", "user"),
}  # fmt: skip
_ALMOST_MASSLESS = {"pos": "0 0 0", "mass": "1e-6", "diaginertia": "1e-9 1e-9 1e-9"}
_MAXIMUM_INCLUDE_DEPTH = 20
_Settings = dict[str, dict[str, str]]


def cure_mjcf(path: Path) -> str:
    """The text of an MJCF file, paths absolute, that Drake reads as MuJoCo does.

    Raises ModelError: unreadable, no MJCF, an include that includes itself, a broken mesh, or an
    element that Drake ignores although it carries bodies, joints or shapes.
    """
    folder = path.resolve().parent
    root = read_xml(path)
    if root.tag != "mujoco":
        hint = {"robot": "it holds a URDF: name it .urdf", "sdf": "it holds SDFormat: name it .sdf"}
        raise ModelError(
            f"{path}: the outermost element is <{root.tag}>, not <mujoco>; "
            f"{hint.get(root.tag, 'is it a model file?')}"
        )
    _expand_includes(root, folder, (path.resolve(),))
    root.set("model", root.get("model") or path.stem)
    try:
        _refuse_ignored(root)
        compiler = _merge_compilers(root)
        _write_out_defaults(root)
        for element in list(root.iter()):
            element[:] = [child for child in element if child.tag not in _WITHOUT_EFFECT]
        _choose_geoms(root, compiler)
        for worldbody in root.iter("worldbody"):
            write_out_poses(worldbody, compiler)
        _name_bodies(root)
        write_out_meshes(root, folder, compiler)
        # With this setting Drake and MuJoCo refuse a body that states no inertia.
        needs_inertia = compiler.get("inertiafromgeom") == "false"
        _write_out_joints(root, compiler)
        for inertial in root.iter("inertial"):
            # Drake refuses bodies without a mass, and MuJoCo takes fixed ones.
            if not numbers(inertial, "mass", 1, "0")[0] > 0.0:
                inertial.attrib.pop("fullinertia", None)
                inertial.attrib.update(_ALMOST_MASSLESS)
        for tag, names in _FORCES.items():
            for element in root.iter(tag):
                for name in names:
                    element.attrib.pop(name, None)
        for body in list(root.iter("body")):
            _nest_joints(body, needs_inertia=needs_inertia)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    return xml_text(root)


def _expand_includes(element: ElementTree.Element, folder: Path, chain: tuple[Path, ...]) -> None:
    """Replace each <include> by the children of the included file's outermost element."""
    for index, child in reversed(list(enumerate(element))):
        if child.tag != "include":
            _expand_includes(child, folder, chain)
            continue
        name = child.get("file", "").replace("\\", "/")
        included = (folder / name).resolve()
        if not included.is_file():
            included = (chain[-1].parent / name).resolve()
        if included in chain or len(chain) > _MAXIMUM_INCLUDE_DEPTH:
            raise ModelError(f"{chain[-1]}: <include> of {included} never ends")
        if not included.is_file():
            raise ModelError(f"{chain[-1]}: included file {folder / name} does not exist")
        content = read_xml(included)
        _expand_includes(content, folder, (*chain, included))
        element.remove(child)
        for offset, grandchild in enumerate(content):
            element.insert(index + offset, grandchild)


def _refuse_ignored(root: ElementTree.Element) -> None:
    """Refuse what would be missing or misplaced without a word."""
    for worldbody in root.iter("worldbody"):
        for element in worldbody.iter():
            if element.tag in _IGNORED_BY_DRAKE:
                name = element.get("name") or element.get("prefix") or "(unnamed)"
                raise ModelError(
                    f"Drake ignores <{element.tag}> '{name}', so bodies or shapes would be missing "
                    "or misplaced; write its content out (MuJoCo's 'compile' tool does that)"
                )


def _merge_compilers(root: ElementTree.Element) -> dict[str, str]:
    """Leave one <compiler> with what all of them say, the last one winning; returns it."""
    settings: dict[str, str] = {}
    for compiler in root.findall("compiler"):
        if "assetdir" in compiler.attrib:
            settings |= dict.fromkeys(("meshdir", "texturedir"), compiler.attrib["assetdir"])
        settings |= compiler.attrib
        root.remove(compiler)
    root.insert(0, ElementTree.Element("compiler", settings))
    return settings


def _write_out_defaults(root: ElementTree.Element) -> None:
    """Give every element what its class says and it does not; remove the classes."""
    classes: dict[str, _Settings] = {"main": {}}
    for default in root.findall("default"):
        _read_class(default, classes["main"], classes)
        root.remove(default)
    _apply(root, "main", classes)


def _read_class(
    default: ElementTree.Element, settings: _Settings, classes: dict[str, _Settings]
) -> None:
    """Add what a <default> says to its class's settings, and the classes inside it."""
    for element in default:
        if element.tag != "default":
            outer = settings.get(element.tag, {})
            settings[element.tag] = _completed(element.attrib, outer)
    for inner in default.findall("default"):
        copy = {tag: dict(attributes) for tag, attributes in settings.items()}
        _read_class(inner, copy, classes)
        classes[inner.get("class", "")] = copy


def _apply(element: ElementTree.Element, childclass: str, classes: dict[str, _Settings]) -> None:
    """Complete an element and everything inside it."""
    childclass = element.attrib.pop("childclass", "") or childclass
    name = element.attrib.pop("class", "") or childclass
    for class_name in {name, childclass} - classes.keys():
        raise ModelError(
            f"<{element.tag}> '{element.get('name', '(unnamed)')}': no <default> defines "
            f"class '{class_name}'"
        )
    if element.tag in classes[name]:
        completed = _completed(element.attrib, classes[name][element.tag])
        element.attrib.clear()
        element.attrib.update(completed)
    for child in element:
        _apply(child, childclass, classes)


def _completed(own: dict[str, str], outer: dict[str, str]) -> dict[str, str]:
    """An element's attributes with those of its class that it does not say itself."""
    oriented = not own.keys().isdisjoint(ORIENTATIONS)
    inherited = {
        name: value for name, value in outer.items() if not (oriented and name in ORIENTATIONS)
    }
    completed = inherited | own
    if "size" in own and "size" in inherited:
        # Sizes of fewer numbers take the further ones from the class.
        numbers = own["size"].split()
        completed["size"] = " ".join(numbers + inherited["size"].split()[len(numbers) :])
    return completed


def _choose_geoms(root: ElementTree.Element, compiler: dict[str, str]) -> None:
    """Leave geoms no collision, and only the looks that MuJoCo's viewer draws: groups 0 to 2."""
    opaque = {
        material.get("name"): bool(numbers(material, "rgba", 4, "1 1 1 1")[3] > 0.0)
        for material in root.iterfind("asset/material")
    }
    for parent in root.iter():
        has_inertial = parent.find("inertial") is not None
        geoms_count = parent.tag == "body" and not (
            has_inertial and compiler.get("inertiafromgeom") != "true"
        )
        for geom in parent.findall("geom"):
            if _is_drawn(geom, opaque):
                geom.attrib.pop("group", None)
            elif geoms_count:
                geom.set("group", "3")
            else:
                parent.remove(geom)
            # Drake numbers geoms without a name, and refuses a name that it gave before.
            if re.fullmatch(r"(geom\d+)?", geom.get("name", "")):
                geom.attrib.pop("name", None)
            geom.set("contype", "0")
            geom.set("conaffinity", "0")


def _is_drawn(geom: ElementTree.Element, opaque: dict[str | None, bool]) -> bool:
    """True for a geom of groups 0 to 2 that is not wholly transparent."""
    if "group" in geom.attrib and numbers(geom, "group", 1)[0] > 2:
        return False
    if "rgba" in geom.attrib:
        return bool(numbers(geom, "rgba", 4)[3] > 0.0)
    return opaque.get(geom.get("material"), True)


def _name_bodies(root: ElementTree.Element) -> None:
    """Give each body without a name one that no other body has."""
    bodies = list(root.iter("body"))
    taken = {body.get("name") for body in bodies}
    free = (name for number in itertools.count(1) if (name := f"body{number}") not in taken)
    for body in bodies:
        if not body.get("name"):
            body.set("name", next(free))


def _write_out_joints(root: ElementTree.Element, compiler: dict[str, str]) -> None:
    """Say of each joint whether it is limited, and leave only actuators that Drake can have."""
    movable = set()
    for joint in root.iter("joint"):
        if not joint.get("name", "unsaid"):
            del joint.attrib["name"]
        name = joint.get("name", "(unnamed)")
        if joint.get("type", "hinge") not in ("hinge", "slide"):
            continue
        movable.add(name)
        if not np.linalg.norm(numbers(joint, "axis", 3, "0 0 1")) > 1e-10:
            raise ModelError(f"joint '{name}': axis=\"{joint.get('axis')}\" has no length")
        limited = joint.get("limited", "auto")
        if limited == "auto" and "range" in joint.attrib:
            if compiler.get("autolimits") == "false":
                raise ModelError(
                    f'joint \'{name}\' has a range, and autolimits="false": say limited="true" or '
                    'limited="false"'
                )
            lower, upper = numbers(joint, "range", 2)
            limited = "true" if lower < upper else "false"
        joint.set("limited", "true" if limited == "true" else "false")
    for actuator in root.iter("actuator"):
        for element in list(actuator):
            if "joint" in element.attrib and element.get("joint") not in movable:
                actuator.remove(element)


def _nest_joints(body: ElementTree.Element, *, needs_inertia: bool) -> None:
    """Turn a body with joints j1 .. jn into n nested bodies with one joint each, in that order."""
    joints = body.findall("joint")
    if len(joints) < 2 and not (joints and body.find("freejoint") is not None):
        return
    name = body.get("name", "")
    if any(joint.get("type") == "free" for joint in joints) or body.find("freejoint") is not None:
        raise ModelError(f"body '{name}' has a free joint beside other joints")
    content = [child for child in body if child.tag != "joint"]
    body[:] = []
    body.set("name", f"{name}__{joints[0].get('name', '0')}")
    current = body
    for number, joint in enumerate(joints):
        if number > 0:
            last = number == len(joints) - 1
            inner_name = name if last else f"{name}__{joint.get('name', str(number))}"
            current = ElementTree.SubElement(current, "body", {"name": inner_name})
        current.append(joint)
        if number < len(joints) - 1 and needs_inertia:
            ElementTree.SubElement(current, "inertial", _ALMOST_MASSLESS)
    current.extend(content)
