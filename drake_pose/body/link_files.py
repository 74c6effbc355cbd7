"""Sanitising of URDF and SDFormat files before Drake parses them.

Only links, joints and visual geometry are kept, and file names are made absolute. Collision
geometry, transmissions and simulator elements do not affect silhouettes, but make Drake refuse many
files.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from drake_pose.body.model_files import (
    FOLLOWING,
    OLD_XACRO_ELEMENTS,
    FileFinder,
    Warn,
    colour_text,
    leave_out,
    open_loops,
    read_limits,
    read_numbers,
    read_xml,
    refuse_macros,
    require_scale,
    require_size,
    take_mimic,
    xml_text,
)
from drake_pose.errors import ModelError

# The child elements that are read, by element.
_READ = {
    "urdf": {
        "robot": ("link", "joint", "frame", "material", *OLD_XACRO_ELEMENTS),
        "link": ("visual", "inertial"),
        "joint": ("parent", "child", "origin", "axis", "limit", "mimic"),
        "visual": ("origin", "geometry", "material"),
    },
    "sdf": {
        "sdf": ("model", "world"),
        "world": ("model", "include", "frame", "joint"),
        "model": ("pose", "link", "joint", "frame", "include", "model", "static"),
        "link": ("pose", "visual", "inertial"),
        "visual": ("pose", "geometry", "material"),
        "material": ("diffuse",),
        "joint": (
            "pose", "parent", "child", "axis", "axis2", "screw_thread_pitch", "thread_pitch",
        ),
        **dict.fromkeys(("axis", "axis2"), ("xyz", "limit", "mimic", "use_parent_model_frame")),
        "limit": ("lower", "upper"),
    },
}  # fmt: skip
# Other elements that do not affect kinematics or visual geometry; no warning names them.
_IGNORED = (
    "collision", "sensor", "plugin", "kinematic", "gravity", "dynamics",
    "gazebo", "transmission", "ros2_control", "mujoco", "group", "group_state",
    "disable_collisions", "end_effector", "virtual_joint", "passive_joint", "contact", "surface",
    "self_collision_checking", "self_filter", "verbose", "version", "safety_controller",
    "calibration", "light", "actor", "physics", "scene", "gui", "magnetic_field", "wind",
    "atmosphere", "audio", "state", "road", "spherical_coordinates", "population", "gripper",
    "self_collide", "allow_auto_disable", "enable_wind", "projector", "audio_source", "audio_sink",
    "battery", "particle_emitter", "must_be_base_link", "velocity_decay", "cast_shadows",
    "laser_retro", "transparency", "visibility_flags", "meta", "script", "shader", "render_order",
    "lighting", "ambient", "specular", "emissive", "shininess", "double_sided", "pbr",
    "gearbox_ratio", "gearbox_reference_body", "effort", "velocity", "stiffness", "dissipation",
    "initial_position",
)  # fmt: skip
Limits = dict[str, tuple[float, float]]
"""Limits (lower, upper) [rad or m] by position name."""


def sanitise_urdf(path: Path, finder: FileFinder, warn: Warn) -> str:
    """Return the text of a URDF file, without relative paths, that Drake reads as URDF defines.

    ``path``: the URDF file. ``finder``: finds the files that the URDF names. ``warn``: receives a
    message for each part that is not read or not enforced. Raises ModelError: the file is invalid;
    the message names the link, joint or mesh.
    """
    root = read_xml(path)
    if root.tag != "robot":
        raise ModelError(f"its outermost element is <{root.tag}>; a URDF file's is <robot>")
    if not root.get("name"):
        root.set("name", path.stem)
    leave_out(root, _READ["urdf"], _IGNORED, warn)
    refuse_macros(root)
    joints = _joints(root)
    ends = [[_end(joint, end) for end in ("parent", "child")] for joint in joints]
    links = [link.get("name") for link in root.iterfind("link")]
    for kind, names in (("link", links), ("joint", [joint.get("name") for joint in joints])):
        for name, count in Counter(names).items():
            if not name:
                raise ModelError(f"{count} <{kind}> without a name; give each of them one")
            if count > 1:
                raise ModelError(f"{kind} '{name}' is defined {count} times; rename all but one")
    for joint, both in zip(joints, ends, strict=True):
        for end, name in zip(("parent", "child"), both, strict=True):
            if name != "world" and name not in links:
                raise ModelError(
                    f"joint '{joint.get('name')}': its {end} link '{name}' does not exist"
                )
    _inline_colours(root)
    for link in root.iterfind("link"):
        for inertial in link.findall("inertial"):
            values = " ".join(v for element in inertial.iter() for v in element.attrib.values())
            try:
                read_numbers(values, len(values.split()), "")
            except ModelError:  # Kinematics do not need the inertia.
                link.remove(inertial)
        for visual in link.iterfind("visual"):
            _check_urdf_visual(visual, f"link '{link.get('name')}'", path, finder)
    open_loops(root, joints, ends, warn)
    kept_joints = root.findall("joint")
    leaders = [joint.get("name", "") for joint in kept_joints if joint.get("type") in FOLLOWING]
    for joint in _joints(root):
        _check_urdf_joint(joint)
        name = joint.get("name", "")
        if mimic := take_mimic(joint, name, leaders if name in leaders else (), warn):
            ElementTree.SubElement(joint, "mimic", mimic)
    return xml_text(root)


def _joints(root: ElementTree.Element) -> list[ElementTree.Element]:
    """Return all joint elements of a <robot>, ``drake:joint`` included."""
    return [child for child in root if child.tag in ("joint", "drake:joint")]


def _end(joint: ElementTree.Element, end: str) -> str:
    """Return the name of the link at a joint's ``end``, "parent" or "child"; "" if it has none."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _check_origin(element: ElementTree.Element, where: str) -> None:
    """Raise ModelError, which begins with ``where``, unless an <origin> holds finite numbers."""
    for origin in element.iterfind("origin"):
        for name in ("xyz", "rpy"):
            if name in origin.attrib:
                read_numbers(origin.get(name), 3, f"{where}: {name} of <origin>")


def _check_urdf_visual(
    visual: ElementTree.Element, where: str, path: Path, finder: FileFinder
) -> None:
    """Refuse a URDF <visual> that cannot be drawn, and make its file names absolute, in place.

    ``where``: the link, at the beginning of messages. ``path``: the URDF file. ``finder``: finds
    the mesh files.
    """
    _check_origin(visual, where)
    shapes = visual.findall("geometry/*")
    if not shapes:
        raise ModelError(f"{where}: a <visual> without a shape in its <geometry>")
    for shape in shapes:
        if _checked_shape(shape, where, is_urdf=True) != "mesh":
            continue
        name = shape.get("filename", "")
        if not name.strip():
            raise ModelError(f"{where}: a mesh without a filename")
        shape.set("filename", f"file://{finder.resolve(name, path, f'{where}: mesh')}")
        if "scale" in shape.attrib:
            text = shape.get("scale", "")
            count = 1 if len(text.split()) == 1 else 3
            require_scale(text, count, f"{where}: scale of mesh '{name}'")
            shape.set("scale", " ".join(text.split() * (3 // count)))


def _check_urdf_joint(joint: ElementTree.Element) -> None:
    """Refuse a URDF joint's invalid numbers; remove limits that have no effect, in place.

    Refused are an origin or axis that is not finite, limits that are not numbers or crossed, and
    negative velocity limits. Removed are infinite limits, those of continuous joints, and limits of
    effort and acceleration.

    Raises ModelError: a number is refused.
    """
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
        for rate in ("effort", "drake:acceleration"):
            limit.attrib.pop(rate, None)
        text = limit.get("velocity", "0")
        try:
            velocity = float(text)
        except ValueError:
            velocity = math.nan
        if velocity < 0.0:
            raise ModelError(f"joint '{name}': velocity limit {text} is negative; give 0 or more")
        if not math.isfinite(velocity):
            del limit.attrib["velocity"]


def _inline_colours(root: ElementTree.Element) -> None:
    """Replace visuals' materials in a <robot> by unnamed colours: Drake needs unique names."""
    shared = root.findall("material")
    per_visual = root.findall("link/visual/material")
    colours: dict[str, str] = {}
    for material in [*shared, *per_visual]:
        colour = _colour(material)
        if colour is not None:
            colours.setdefault(material.get("name", ""), colour)
    for material in shared:
        root.remove(material)
    for visual in root.iterfind("link/visual"):
        for material in visual.findall("material"):
            visual.remove(material)
            colour = _colour(material) or colours.get(material.get("name", ""))
            if colour is not None:
                plain = ElementTree.SubElement(visual, "material")
                ElementTree.SubElement(plain, "color", {"rgba": colour})


def _colour(material: ElementTree.Element) -> str | None:
    """Return a material's colour (r, g, b, a) in [0, 1] as text; None if it has no valid one."""
    texts = (colour.get("rgba", "") for colour in material.iterfind("color"))
    return next((colour for t in texts if len(t.split()) == 4 and (colour := colour_text(t))), None)


def _checked_shape(shape: ElementTree.Element, where: str, *, is_urdf: bool) -> str:
    """Return the type of a shape; raise ModelError for an unknown type or an invalid size.

    Sizes must be positive; the radius of a URDF sphere may be 0. Messages begin with ``where``.
    ``is_urdf``: the shape is from a URDF file, else SDFormat.
    """
    # The sizes of each shape and how many numbers each has: URDF attributes, SDFormat elements.
    known: dict[str, dict[str, int]] = {
        "box": {"size": 3},
        "sphere": {"radius": 1},
        "cylinder": {"radius": 1, "length": 1},
        "capsule": {"radius": 1, "length": 1},
        "ellipsoid": {"a": 1, "b": 1, "c": 1} if is_urdf else {"radii": 3},
        "mesh": {},
    }
    known |= {} if is_urdf else {"plane": {}, "empty": {}}
    kind = shape.tag.removeprefix("drake:")
    if kind not in known:
        raise ModelError(f"{where}: there is no shape <{kind}>; use one of {', '.join(known)}")
    for name, count in known[kind].items():
        # SDFormat's own reader replaces an invalid size by 1 m.
        texts = [shape.get(name)] if is_urdf else [size.text for size in shape.iterfind(name)]
        for text in texts:
            zero = is_urdf and kind == "sphere"
            require_size(text, count, f"{where}: {name} of its {kind}", zero=zero)
    return kind


def sanitise_sdf(
    path: Path, finder: FileFinder, warn: Warn, sanitise_file: Callable[[Path], Path]
) -> tuple[str, Limits]:
    """Return the text of an SDFormat file, without relative paths, that Drake reads.

    Args:
        path: the SDFormat file.
        finder: finds the files that the SDFormat file names.
        warn: receives a message for each part that is not read or not enforced.
        sanitise_file: returns the path of a sanitised copy of an included model file.

    Returns the text, and the limits (lower, upper) [rad] of universal and screw joints by position
    name, which Drake's parser does not read.

    Raises ModelError: the file is invalid; the message names the link, joint or mesh.
    """
    root = read_xml(path)
    if root.tag != "sdf":
        raise ModelError(f"its outermost element is <{root.tag}>; an SDFormat file's is <sdf>")
    if "version" not in root.attrib:
        raise ModelError('its <sdf> has no version; write for example <sdf version="1.9">')
    leave_out(root, _READ["sdf"], _IGNORED, warn)
    refuse_macros(root)
    for include in root.iter("include"):
        uri, name = _uri(include, "an <include> without a <uri>")
        found = finder.resolve(name, path, "included model")
        if found.is_dir():
            found = _model_of_folder(found, name)
        uri.text = f"file://{sanitise_file(found)}"
    for link in root.iter("link"):
        where = f"link '{link.get('name', '(unnamed)')}'"
        _check_poses(link, where)
        for visual in link.iterfind("visual"):
            _check_sdf_visual(visual, where, path, finder)
    for model in [*root.iter("model"), *root.iter("world")]:
        # Drake refuses gearboxes and joints that close a loop of links.
        for joint in model.findall("joint"):
            if joint.get("type") == "gearbox":
                model.remove(joint)
                warn(f"joint '{joint.get('name')}' is a gearbox: not enforced, it is left out")
        joints = model.findall("joint")
        ends = [
            [(joint.findtext(end) or "").strip() for end in ("parent", "child")] for joint in joints
        ]
        open_loops(model, joints, ends, warn)
        joints = model.findall("joint")
        leaders = [joint.get("name", "") for joint in joints if joint.get("type") in FOLLOWING]
        for joint in joints:
            name = joint.get("name", "")
            for axis in [*joint.findall("axis"), *joint.findall("axis2")]:
                if mimic := take_mimic(axis, name, leaders if name in leaders else (), warn):
                    ElementTree.SubElement(joint, "drake:mimic", mimic)
    limits: Limits = {}
    for joint in root.iter("joint"):
        limits.update(_check_sdf_joint(joint))
    return xml_text(root), limits


def _uri(element: ElementTree.Element, missing: str) -> tuple[ElementTree.Element, str]:
    """Return an element's <uri> and its text; ModelError(``missing``) if there is none."""
    uri = element.find("uri")
    name = "" if uri is None else (uri.text or "").strip()
    if uri is None or not name:
        raise ModelError(missing)
    return uri, name


def _model_of_folder(folder: Path, name: str) -> Path:
    """Return the newest model file in a folder's model.config; messages name the URI ``name``."""
    config = folder / "model.config"
    if not config.is_file():
        raise ModelError(f"included model '{name}': {config} does not exist")
    files = [file for file in read_xml(config).iterfind("sdf") if (file.text or "").strip()]
    if not files:
        raise ModelError(f"included model '{name}': {config} names no <sdf> file")
    newest = max(files, key=lambda file: [int(p) for p in file.get("version", "0").split(".")])
    return folder / (newest.text or "").strip()


def _check_poses(element: ElementTree.Element, where: str) -> None:
    """Raise ModelError, begun by ``where``, unless an Euler-angle <pose> has six finite numbers."""
    for pose in element.iterfind("pose"):
        if (pose.text or "").strip() and pose.get("rotation_format", "euler_rpy") == "euler_rpy":
            read_numbers(pose.text, 6, f"{where}: its <pose>")


def _check_sdf_visual(
    visual: ElementTree.Element, where: str, path: Path, finder: FileFinder
) -> None:
    """Refuse an SDFormat <visual> that Drake cannot draw; make its file names absolute, in place.

    The arguments are those of ``_check_urdf_visual``; ``path`` is the SDFormat file.
    """
    _check_poses(visual, where)
    for material in visual.findall("material"):
        for colour in material.findall("diffuse"):
            colour.text = colour_text(colour.text)
            if colour.text is None:
                material.remove(colour)
    for shape in visual.findall("geometry/*"):
        if _checked_shape(shape, where, is_urdf=False) != "mesh":
            continue
        uri, name = _uri(shape, f"{where}: a mesh without a <uri>")
        uri.text = f"file://{finder.resolve(name, path, f'{where}: mesh')}"
        if shape.find("submesh") is not None:
            raise ModelError(
                f"{where}: Drake shows the whole mesh '{name}', not its <submesh> alone; save the "
                "submesh as a file of its own"
            )
        scale = shape.findtext("scale")
        if scale is not None:
            require_scale(scale, 3, f"{where}: scale of mesh '{name}'")


def _check_sdf_joint(joint: ElementTree.Element) -> Limits:
    """Refuse an SDFormat joint's invalid poses, axes and limits (ModelError).

    Returns:
        Limits (lower, upper) [rad] of universal and screw joints by position name, which Drake's
        parser does not read; empty for other joints.
    """
    name, kind = joint.get("name", "(unnamed)"), joint.get("type", "")
    _check_poses(joint, f"joint '{name}'")
    suffixes = {"universal": {"axis": "_qx", "axis2": "_qy"}, "screw": {"axis": ""}}
    unread: Limits = {}
    for axis in [*joint.findall("axis"), *joint.findall("axis2")]:
        xyz = axis.findtext("xyz")
        if xyz is not None and not any(read_numbers(xyz, 3, f"joint '{name}': its <xyz>")):
            raise ModelError(f"joint '{name}': its axis is zero")
        texts = [axis.findtext(f"limit/{side}") for side in ("lower", "upper")]
        lower, upper = read_limits(texts[0], texts[1], name)
        if axis.tag in suffixes.get(kind, {}) and lower is not None and upper is not None:
            unread[f"{name}{suffixes[kind][axis.tag]}"] = (lower, upper)
    return unread
