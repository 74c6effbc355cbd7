"""Changes to a URDF model's shape, made in its text: hide, scale and shift links and joints."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.model_files import xml_text

Vectors = Mapping[str, Sequence[float]]
"""Vectors (3,) by the name of a link or joint."""

# Keep the prefix of Drake's own elements, which Drake requires.
ElementTree.register_namespace("drake", "http://drake.mit.edu")


def reshaped(
    text: str,
    *,
    hidden: Collection[str] = (),
    link_scales: Vectors = MappingProxyType({}),
    link_shifts: Vectors = MappingProxyType({}),
    joint_shifts: Vectors = MappingProxyType({}),
    joint_offsets: Mapping[str, float] | None = None,
) -> str:
    """Return a URDF text with links and joints changed.

    Args:
        text: the URDF text.
        hidden: links that lose their visual geometry.
        link_scales: by link, (3,) scale factors of its visual geometry, and of the origins of the
            joints that it carries, along the axes of its frame. Shapes other than meshes are scaled
            as their type allows: spheres and capsule radii by the geometric mean.
        link_shifts: by link, (3,) shift [m] of its visual geometry and of the joints that it
            carries, in its frame.
        joint_shifts: by joint, (3,) shift [m] of its origin in its parent link's frame.
        joint_offsets: by joint, offset [rad or m] added to its position: its origin is rotated
            about its axis or shifted along it, and its limits are moved so that they stay in place.
            None: none.
    """
    root = ElementTree.fromstring(text)
    for link in root.iterfind("link"):
        name = link.get("name", "")
        for visual in link.findall("visual"):
            if name in hidden:
                link.remove(visual)
                continue
            if name in link_scales:
                _scale_shapes(visual, np.array(link_scales[name]))
            _move_origin(visual, link_scales.get(name), link_shifts.get(name))
    for joint in root.iterfind("joint"):
        parent = joint.find("parent")
        name, link_name = joint.get("name", ""), "" if parent is None else parent.get("link", "")
        _move_origin(
            joint, link_scales.get(link_name), joint_shifts.get(name), link_shifts.get(link_name)
        )
        if joint_offsets and joint_offsets.get(name):
            _offset_joint(joint, joint_offsets[name])
    return xml_text(root)


BASE_JOINTS = ("free_x", "free_y", "free_z", "free_turn_z", "free_turn_y", "free_turn_x")
"""Joints that move a whole model: along x, y, z of the world, then about z, y, x."""


def with_base_joints(text: str, position: Sequence[float], rpy: Sequence[float]) -> str:
    """Return a URDF text whose model is mounted on ``BASE_JOINTS``.

    With these joints at zero its base is at ``position`` (3,) [m], rotated by ``rpy`` (3,) [rad].
    """
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
        is_prismatic = k < 3
        joint = ElementTree.SubElement(
            root, "joint", name=name, type="prismatic" if is_prismatic else "continuous"
        )
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=f"{name}_link")
        ElementTree.SubElement(joint, "axis", xyz=_text(np.eye(3)[k if is_prismatic else 5 - k]))
        limit = {"lower": "-100", "upper": "100"} if is_prismatic else {}
        ElementTree.SubElement(joint, "limit", {**limit, "effort": "1", "velocity": "1"})
        parent = f"{name}_link"
    # The translation axes are the world's; the model's own rotation follows the joints.
    ElementTree.SubElement(root.findall("joint")[-6], "origin", xyz=_text(position))
    for base in bases:
        joint = ElementTree.SubElement(root, "joint", name=f"free_{base}", type="fixed")
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=str(base))
        ElementTree.SubElement(joint, "origin", rpy=_text(rpy))
    return xml_text(root)


def _move_origin(
    element: ElementTree.Element,
    scale: Sequence[float] | None,
    *shifts: Sequence[float] | Array | None,
) -> None:
    """Scale the <origin> of an element by factors (3,), then add shifts (3,) [m]; None: neither."""
    vectors = [np.array(shift) for shift in shifts if shift is not None]
    if scale is None and not vectors:
        return
    position = np.array(_numbers(_origin(element).get("xyz", "0 0 0")))
    position = position if scale is None else position * scale
    _origin(element).set("xyz", _text(sum(vectors, start=position)))


def _offset_joint(joint: ElementTree.Element, offset: float) -> None:
    """Add ``offset`` [rad or m] to a joint's position by moving its origin and its limits."""
    from scipy.spatial.transform import Rotation  # Slow to import.

    axis_element = joint.find("axis")
    axis = np.array(_numbers("1 0 0" if axis_element is None else axis_element.get("xyz", "")))
    axis /= np.linalg.norm(axis)
    R = Rotation.from_euler("xyz", _numbers(_origin(joint).get("rpy", "0 0 0")))
    if joint.get("type") == "prismatic":
        _move_origin(joint, None, R.apply(offset * axis))
    else:
        _origin(joint).set("rpy", _text((R * Rotation.from_rotvec(offset * axis)).as_euler("xyz")))
    limit = joint.find("limit")
    for end in ("lower", "upper"):
        if limit is not None and joint.get("type") != "continuous" and end in limit.attrib:
            limit.set(end, _text([float(limit.get(end, "0")) - offset]))


def _origin(element: ElementTree.Element) -> ElementTree.Element:
    """Return an element's <origin>, which is added where it is missing."""
    origin = element.find("origin")
    return ElementTree.SubElement(element, "origin") if origin is None else origin


def _scale_shapes(visual: ElementTree.Element, scale: Array) -> None:
    """Scale a visual's shapes by (3,) factors; by their geometric mean if it is rotated."""
    mean = [float(np.prod(scale)) ** (1.0 / 3.0)]
    if any(_numbers(_origin(visual).get("rpy", "0 0 0"))):
        scale = np.array(mean * 3)
    for shape in visual.iterfind("geometry/*"):
        if shape.tag.removeprefix("drake:") == "mesh":
            shape.attrib.setdefault("scale", "1 1 1")
        for name, factor in (
            ("scale", scale), ("size", scale), ("a", scale[:1]), ("b", scale[1:2]),
            ("c", scale[2:]), ("radius", mean), ("length", scale[2:]),
        ):  # fmt: skip
            if name in shape.attrib:
                shape.set(name, _text(np.array(_numbers(shape.get(name, ""))) * factor))


def _numbers(text: str) -> list[float]:
    """Return the numbers in an attribute's text."""
    return [float(number) for number in text.split()]


def _text(numbers: Sequence[float] | Array) -> str:
    """Return numbers as attribute text without loss of precision."""
    return " ".join(repr(float(number)) for number in numbers)
