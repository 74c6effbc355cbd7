"""Changes of a URDF model's shape, made in its cured text: parts not drawn, parts stretched."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_pose.body.files.xml_files import xml_text

Factors = Mapping[str, Sequence[float]]
"""For links by name, so many times (3,) a link's size along its frame's axes."""


def without_visuals(text: str, links: Collection[str]) -> str:
    """A URDF text in which some links have no looks."""
    root = ElementTree.fromstring(text)
    for link in root.iterfind("link"):
        if link.get("name") in links:
            for visual in link.findall("visual"):
                link.remove(visual)
    return xml_text(root)


def stretched(text: str, factors: Factors) -> str:
    """A URDF text in which some links are longer or wider, with the joints that they carry.

    A shape that is no mesh is stretched as its kind allows: spheres and capsules by the mean.
    """
    root = ElementTree.fromstring(text)
    for link in root.iterfind("link"):
        factor = factors.get(link.get("name", ""))
        if factor is None:
            continue
        for visual in link.iterfind("visual"):
            origin = visual.find("origin")
            turned = origin is not None and any(_numbers(origin.get("rpy", "0 0 0")))
            _stretch_origin(visual, factor)
            mean = float(np.prod(factor)) ** (1.0 / 3.0)
            for shape in visual.iterfind("geometry/*"):
                _stretch_shape(shape, [mean] * 3 if turned else factor)
    for joint in root.iterfind("joint"):
        parent = joint.find("parent")
        factor = None if parent is None else factors.get(parent.get("link", ""))
        if factor is not None:
            _stretch_origin(joint, factor)
    return xml_text(root)


def with_zeros(text: str, zeros: Mapping[str, float]) -> str:
    """A URDF text in which joints stand further by constants [rad or m] where they read the same.

    Each joint's origin is turned about its axis, or shifted along it; its limits stay in place.
    """
    root = ElementTree.fromstring(text)
    for joint in root.iterfind("joint"):
        zero = zeros.get(joint.get("name", ""))
        if not zero:
            continue
        axis_element = joint.find("axis")
        axis = np.array(_numbers("1 0 0" if axis_element is None else axis_element.get("xyz", "")))
        axis /= np.linalg.norm(axis)
        origin = _origin(joint)
        R = Rotation.from_euler("xyz", _numbers(origin.get("rpy", "0 0 0")))
        if joint.get("type") == "prismatic":
            _move(origin, R.apply(zero * axis))
        else:
            turned = R * Rotation.from_rotvec(zero * axis)
            origin.set("rpy", _text(turned.as_euler("xyz")))
        limit = joint.find("limit")
        for end in ("lower", "upper"):
            if limit is not None and joint.get("type") != "continuous" and end in limit.attrib:
                limit.set(end, _text(np.array([float(limit.get(end, "0")) - zero])))
    return xml_text(root)


def with_shifted_joints(text: str, shifts: Mapping[str, Sequence[float]]) -> str:
    """A URDF text in which joints stand elsewhere: (3,) along their parent links' axes [m]."""
    root = ElementTree.fromstring(text)
    for joint in root.iterfind("joint"):
        shift = shifts.get(joint.get("name", ""))
        if shift is not None:
            _move(_origin(joint), shift)
    return xml_text(root)


def with_moved_looks(text: str, moves: Mapping[str, Sequence[float]]) -> str:
    """A URDF text in which links look elsewhere, their joints too: (3,) along their axes [m]."""
    root = ElementTree.fromstring(text)
    moved = [
        (visual, moves.get(link.get("name", "")))
        for link in root.iterfind("link")
        for visual in link.iterfind("visual")
    ]
    for joint in root.iterfind("joint"):
        parent = joint.find("parent")
        moved.append((joint, None if parent is None else moves.get(parent.get("link", ""))))
    for element, move in moved:
        if move is not None:
            _move(_origin(element), move)
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
    _origin(root.findall("joint")[-6]).set("xyz", _text(np.array(place)))
    for base in bases:
        joint = ElementTree.SubElement(root, "joint", name=f"free_{base}", type="fixed")
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=str(base))
        ElementTree.SubElement(joint, "origin", rpy=_text(np.array(rpy)))
    return xml_text(root)


def _move(origin: ElementTree.Element, move: Sequence[float] | NDArray[np.float64]) -> None:
    """Moves an origin by (3,) [m]."""
    origin.set("xyz", _text(np.array(_numbers(origin.get("xyz", "0 0 0"))) + move))


def _origin(element: ElementTree.Element) -> ElementTree.Element:
    """An element's origin, which is made where it has none."""
    origin = element.find("origin")
    return ElementTree.SubElement(element, "origin") if origin is None else origin


def _stretch_origin(element: ElementTree.Element, factor: Sequence[float]) -> None:
    """Moves what stands on a link."""
    origin = element.find("origin")
    if origin is not None and "xyz" in origin.attrib:
        origin.set("xyz", _text(np.array(_numbers(origin.get("xyz", ""))) * factor))


def _stretch_shape(shape: ElementTree.Element, factor: Sequence[float]) -> None:
    """Makes a shape larger."""
    mean = float(np.prod(factor)) ** (1.0 / 3.0)
    for name, by in (
        ("scale", factor), ("size", factor), ("a", factor[:1]), ("b", factor[1:2]),
        ("c", factor[2:]), ("radius", [mean]), ("length", [factor[2]]),
    ):  # fmt: skip
        if name in shape.attrib:
            shape.set(name, _text(np.array(_numbers(shape.get(name, ""))) * by))
        elif name == "scale" and shape.tag.removeprefix("drake:") == "mesh":
            shape.set(name, _text(np.array(factor)))


def _numbers(text: str) -> list[float]:
    return [float(number) for number in text.split()]


def _text(numbers: np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in numbers)
