"""URDF files made fit for Drake: links, joints and looks alone, every file name absolute.

Collision geometry, transmissions and what simulators add are never drawn and move nothing, but
Drake refuses many files because of them.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

from drake_pose.body.files.packages import FileFinder
from drake_pose.body.files.xml_files import (
    OLD_XACRO_ELEMENTS,
    Warn,
    colour_text,
    leave_out,
    leave_out_mimics,
    open_loops,
    read_limits,
    read_numbers,
    read_xml,
    refuse_macros,
    require_scale,
    require_shape,
    require_size,
    xml_text,
)
from drake_pose.errors import ModelError

_READ = {
    "robot": ("link", "joint", "frame", "material", *OLD_XACRO_ELEMENTS),
    "link": ("visual", "inertial"),
    "joint": ("parent", "child", "origin", "axis", "limit", "mimic"),
    "visual": ("origin", "geometry", "material"),
}
_KNOWN = (
    "collision", "gazebo", "transmission", "sensor", "plugin", "ros2_control", "mujoco", "group",
    "group_state", "disable_collisions", "end_effector", "virtual_joint", "passive_joint",
    "contact", "self_collision_checking", "self_filter", "verbose", "version", "dynamics",
    "safety_controller", "calibration", "kinematic", "gravity", "surface",
)  # fmt: skip
# The sizes of each shape: attribute, count of numbers, and whether Drake draws one of zero.
_SIZES = {
    "box": (("size", 3, False),),
    "sphere": (("radius", 1, True),),
    "cylinder": (("radius", 1, False), ("length", 1, False)),
    "capsule": (("radius", 1, False), ("length", 1, False)),
    "ellipsoid": (("a", 1, False), ("b", 1, False), ("c", 1, False)),
    "mesh": (),
}


def cure_urdf(path: Path, finder: FileFinder, warn: Warn) -> str:
    """The text of a URDF file that Drake reads as URDF means it; it may be parsed from anywhere.

    Raises ModelError, which names the link, joint or mesh at fault.
    """
    root = read_xml(path)
    if root.tag != "robot":
        raise ModelError(f"its outermost element is <{root.tag}>; a URDF file's is <robot>")
    if not root.get("name"):
        root.set("name", path.stem)
    leave_out(root, _READ, _KNOWN, warn)
    refuse_macros(root)
    _require_names(root)
    _give_colours(root)
    for link in root.iterfind("link"):
        _leave_out_inertia(link)
        for visual in link.iterfind("visual"):
            _check_visual(visual, f"link '{link.get('name')}'", path, finder)
    joints = _joints(root)
    ends = [[_end(joint, end) for end in ("parent", "child")] for joint in joints]
    open_loops(root, joints, ends, warn)
    for joint in _joints(root):
        _check_joint(joint, warn)
    return xml_text(root)


def _joints(root: ElementTree.Element) -> list[ElementTree.Element]:
    """All joints; a path with a prefix would need a namespace."""
    return [child for child in root if child.tag in ("joint", "drake:joint")]


def _end(joint: ElementTree.Element, end: str) -> str:
    """The name of a joint's parent or child link; empty where it has none."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _require_names(root: ElementTree.Element) -> None:
    """Every link and joint has a name of its own, and joints connect links that exist."""
    links = [link.get("name") for link in root.iterfind("link")]
    joints = _joints(root)
    for kind, names in (("link", links), ("joint", [joint.get("name") for joint in joints])):
        for name, count in Counter(names).items():
            if not name:
                raise ModelError(f"{count} <{kind}> without a name; give each of them one")
            if count > 1:
                raise ModelError(f"{kind} '{name}' is defined {count} times; rename all but one")
    for joint in joints:
        for end in ("parent", "child"):
            name = _end(joint, end)
            if name != "world" and name not in links:
                raise ModelError(
                    f"joint '{joint.get('name')}': its {end} link '{name}' does not exist"
                )


def _leave_out_inertia(link: ElementTree.Element) -> None:
    """Remove an <inertial> that holds something else than numbers: poses do not need it."""
    for inertial in link.findall("inertial"):
        values = [value for element in inertial.iter() for value in element.attrib.values()]
        try:
            read_numbers(" ".join(values), len(" ".join(values).split()), "")
        except ModelError:
            link.remove(inertial)


def _check_origin(element: ElementTree.Element, where: str) -> None:
    for origin in element.iterfind("origin"):
        for name in ("xyz", "rpy"):
            if name in origin.attrib:
                read_numbers(origin.get(name), 3, f"{where}: {name} of <origin>")


def _check_visual(visual: ElementTree.Element, where: str, path: Path, finder: FileFinder) -> None:
    """Refuse what cannot be drawn, and make file names absolute."""
    _check_origin(visual, where)
    geometry = visual.find("geometry")
    shapes = [] if geometry is None else list(geometry)
    if not shapes:
        raise ModelError(f"{where}: a <visual> without a shape in its <geometry>")
    for shape in shapes:
        kind = shape.tag.removeprefix("drake:")
        require_shape(kind, _SIZES, where)
        for name, count, zero in _SIZES[kind]:
            require_size(shape.get(name), count, f"{where}: {name} of its {kind}", zero=zero)
        if kind == "mesh":
            _check_mesh(shape, where, path, finder)


def _check_mesh(mesh: ElementTree.Element, where: str, path: Path, finder: FileFinder) -> None:
    name = mesh.get("filename", "")
    if not name.strip():
        raise ModelError(f"{where}: a mesh without a filename")
    mesh.set("filename", f"file://{finder.resolve(name, path, f'{where}: mesh')}")
    if "scale" not in mesh.attrib:
        return
    text = mesh.get("scale", "")
    count = 1 if len(text.split()) == 1 else 3
    require_scale(text, count, f"{where}: scale of mesh '{name}'")
    mesh.set("scale", " ".join(text.split() * (3 // count)))


def _check_joint(joint: ElementTree.Element, warn: Warn) -> None:
    """Refuse limits that end Drake, and leave out those that do not count."""
    name = joint.get("name", "")
    _check_origin(joint, f"joint '{name}'")
    for axis in joint.iterfind("axis"):
        read_numbers(axis.get("xyz"), 3, f"joint '{name}': xyz of <axis>")
    for limit in joint.iterfind("limit"):
        if joint.get("type") == "continuous":
            # By URDF's definition a continuous joint has no limits, whatever the file says.
            texts: tuple[str | None, str | None] = (None, None)
        else:
            texts = (limit.get("lower"), limit.get("upper"))
        for side, value in zip(("lower", "upper"), read_limits(*texts, name), strict=True):
            if value is None:
                limit.attrib.pop(side, None)
        for name_of_rate in ("effort", "drake:acceleration"):
            limit.attrib.pop(name_of_rate, None)
        _check_velocity(limit, name)
    leave_out_mimics(joint, name, warn)


def _check_velocity(limit: ElementTree.Element, name: str) -> None:
    """Refuse a negative velocity limit, which ends Drake; leave out one that is no number."""
    text = limit.get("velocity", "0")
    try:
        velocity = float(text)
    except ValueError:
        velocity = math.nan
    if velocity < 0.0:
        raise ModelError(f"joint '{name}': velocity limit {text} is negative; give 0 or more")
    if not math.isfinite(velocity):
        del limit.attrib["velocity"]


def _give_colours(root: ElementTree.Element) -> None:
    """Write out each visual's colour without a name, which Drake wants to be unique."""
    everywhere = root.findall("material")
    own = [one for visual in root.iterfind("link/visual") for one in visual.iterfind("material")]
    colours: dict[str, str] = {}
    for material in [*everywhere, *own]:
        colour = _colour(material)
        if colour is not None:
            colours.setdefault(material.get("name", ""), colour)
    for material in everywhere:
        root.remove(material)
    for visual in root.iterfind("link/visual"):
        for material in visual.findall("material"):
            visual.remove(material)
            colour = _colour(material) or colours.get(material.get("name", ""))
            if colour is not None:
                plain = ElementTree.SubElement(visual, "material")
                ElementTree.SubElement(plain, "color", {"rgba": colour})


def _colour(material: ElementTree.Element) -> str | None:
    """The colour of a material, its parts within 0 and 1; None: it has none that can be read."""
    texts = (colour.get("rgba", "") for colour in material.iterfind("color"))
    return next((colour for t in texts if len(t.split()) == 4 and (colour := colour_text(t))), None)
