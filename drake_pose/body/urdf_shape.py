"""Changes of a URDF model's shape, made in its text: parts hidden, stretched, moved, re-zeroed."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.model_files import xml_text

Vectors = Mapping[str, Sequence[float]]
"""(3,) by the name of a link or joint."""

# Drake's own elements keep the prefix that Drake looks for.
ElementTree.register_namespace("drake", "http://drake.mit.edu")


def reshaped(
    text: str,
    *,
    hidden: Collection[str] = (),
    factors: Vectors = MappingProxyType({}),
    moves: Vectors = MappingProxyType({}),
    shifts: Vectors = MappingProxyType({}),
    zeros: Mapping[str, float] | None = None,
) -> str:
    """A URDF text in which links and joints are otherwise.

    Args:
        hidden: links without looks.
        factors: so many times a link's size along its frame's axes, with the joints that it
            carries. A shape that is no mesh is stretched as its kind allows: spheres and capsules
            by the mean.
        moves: how far a link's looks, and the joints that it carries, lie elsewhere on it [m].
        shifts: how far a joint stands elsewhere on its parent link [m].
        zeros: by how much a joint stands further where it reads the same [rad or m]: its origin is
            turned about its axis, or shifted along it; its limits stay in place.
    """
    root = ElementTree.fromstring(text)
    for link in root.iterfind("link"):
        name = link.get("name", "")
        for visual in link.findall("visual"):
            if name in hidden:
                link.remove(visual)
                continue
            if name in factors:
                _stretch_shapes(visual, np.array(factors[name]))
            _place(visual, factors.get(name), moves.get(name))
    for joint in root.iterfind("joint"):
        parent = joint.find("parent")
        name, link_name = joint.get("name", ""), "" if parent is None else parent.get("link", "")
        _place(joint, factors.get(link_name), shifts.get(name), moves.get(link_name))
        if zeros and zeros.get(name):
            _turn(joint, zeros[name])
    return xml_text(root)


BASE_JOINTS = ("free_x", "free_y", "free_z", "free_turn_z", "free_turn_y", "free_turn_x")
"""Joints that move a whole model: along the world's axes, then about them, the last one first."""


def with_base_joints(text: str, place: Sequence[float], rpy: Sequence[float]) -> str:
    """A URDF text moved by BASE_JOINTS from a place (3,) [m], turned there by rpy (3,) [rad]."""
    root = ElementTree.fromstring(text)
    for element in root.iter():
        for key in ("name", "link"):
            if element.tag in ("link", "parent", "child") and element.get(key) == "world":
                element.set(key, "free_base")
    carried = {child.get("link") for child in root.iterfind("joint/child")}
    names = [link.get("name") for link in root.iterfind("link")]
    bases = [name for name in names if name not in carried]
    ElementTree.SubElement(root, "link", name="world")
    parent = "world"
    for k, name in enumerate(BASE_JOINTS):
        ElementTree.SubElement(root, "link", name=f"{name}_link")
        slides = k < 3
        joint = ElementTree.SubElement(
            root, "joint", name=name, type="prismatic" if slides else "continuous"
        )
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=f"{name}_link")
        ElementTree.SubElement(joint, "axis", xyz=_text(np.eye(3)[k if slides else 5 - k]))
        limit = {"lower": "-100", "upper": "100"} if slides else {}
        ElementTree.SubElement(joint, "limit", {**limit, "effort": "1", "velocity": "1"})
        parent = f"{name}_link"
    # The axes along which it moves are the world's; how it is turned comes after them.
    ElementTree.SubElement(root.findall("joint")[-6], "origin", xyz=_text(place))
    for base in bases:
        joint = ElementTree.SubElement(root, "joint", name=f"free_{base}", type="fixed")
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=str(base))
        ElementTree.SubElement(joint, "origin", rpy=_text(rpy))
    return xml_text(root)


def _place(
    element: ElementTree.Element,
    factor: Sequence[float] | None,
    *moves: Sequence[float] | Array | None,
) -> None:
    """Stretch an element's place (3,), then move it."""
    given = [np.array(move) for move in moves if move is not None]
    if factor is None and not given:
        return
    place = np.array(_numbers(_origin(element).get("xyz", "0 0 0")))
    place = place if factor is None else place * factor
    _origin(element).set("xyz", _text(sum(given, start=place)))


def _turn(joint: ElementTree.Element, zero: float) -> None:
    """Let a joint stand further by a constant [rad or m] where it reads the same."""
    from scipy.spatial.transform import Rotation  # Slow to import; reading needs none.

    axis_element = joint.find("axis")
    axis = np.array(_numbers("1 0 0" if axis_element is None else axis_element.get("xyz", "")))
    axis /= np.linalg.norm(axis)
    R = Rotation.from_euler("xyz", _numbers(_origin(joint).get("rpy", "0 0 0")))
    if joint.get("type") == "prismatic":
        _place(joint, None, R.apply(zero * axis))
    else:
        _origin(joint).set("rpy", _text((R * Rotation.from_rotvec(zero * axis)).as_euler("xyz")))
    limit = joint.find("limit")
    for end in ("lower", "upper"):
        if limit is not None and joint.get("type") != "continuous" and end in limit.attrib:
            limit.set(end, _text([float(limit.get(end, "0")) - zero]))


def _origin(element: ElementTree.Element) -> ElementTree.Element:
    """An element's origin, which is made where it has none."""
    origin = element.find("origin")
    return ElementTree.SubElement(element, "origin") if origin is None else origin


def _stretch_shapes(visual: ElementTree.Element, factor: Array) -> None:
    """Make what a visual shows larger; where it is turned, by the mean."""
    mean = [float(np.prod(factor)) ** (1.0 / 3.0)]
    if any(_numbers(_origin(visual).get("rpy", "0 0 0"))):
        factor = np.array(mean * 3)
    for shape in visual.iterfind("geometry/*"):
        if shape.tag.removeprefix("drake:") == "mesh":
            shape.attrib.setdefault("scale", "1 1 1")
        for name, by in (
            ("scale", factor), ("size", factor), ("a", factor[:1]), ("b", factor[1:2]),
            ("c", factor[2:]), ("radius", mean), ("length", factor[2:]),
        ):  # fmt: skip
            if name in shape.attrib:
                shape.set(name, _text(np.array(_numbers(shape.get(name, ""))) * by))


def _numbers(text: str) -> list[float]:
    return [float(number) for number in text.split()]


def _text(numbers: Sequence[float] | Array) -> str:
    return " ".join(repr(float(number)) for number in numbers)
