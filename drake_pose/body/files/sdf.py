"""SDFormat files made fit for Drake: links, joints and looks alone, every file name absolute."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

from drake_pose.body.files.packages import FileFinder
from drake_pose.body.files.xml_files import (
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
}  # fmt: skip
_KNOWN = (
    "light", "actor", "plugin", "physics", "scene", "gui", "gravity", "magnetic_field", "wind",
    "atmosphere", "audio", "state", "road", "spherical_coordinates", "population", "gripper",
    "self_collide", "allow_auto_disable", "enable_wind", "collision", "sensor", "projector",
    "audio_source", "audio_sink", "battery", "particle_emitter", "must_be_base_link", "kinematic",
    "velocity_decay", "cast_shadows", "laser_retro", "transparency", "visibility_flags", "meta",
    "script", "shader", "render_order", "lighting", "ambient", "specular", "emissive", "shininess",
    "double_sided", "pbr", "physics", "dynamics", "gearbox_ratio", "gearbox_reference_body",
    "effort", "velocity", "stiffness", "dissipation", "initial_position",
)  # fmt: skip
# The sizes of each shape: element, and count of numbers; a missing one has a default.
_SIZES = {
    "box": (("size", 3),),
    "sphere": (("radius", 1),),
    "cylinder": (("radius", 1), ("length", 1)),
    "capsule": (("radius", 1), ("length", 1)),
    "ellipsoid": (("radii", 3), ("a", 1), ("b", 1), ("c", 1)),
    "mesh": (),
    "plane": (),
    "empty": (),
}
Limits = dict[str, tuple[float, float]]


def cure_sdf(
    path: Path, finder: FileFinder, warn: Warn, cure_file: Callable[[Path], Path]
) -> tuple[str, Limits]:
    """The text of an SDFormat file that Drake reads; it may be parsed from anywhere.

    ``cure_file`` makes a file that stands in for an included model.

    Returns:
        The text, and the limits (lower, upper) [rad] by position name of universal and screw
        joints, which Drake's parser passes over.

    Raises:
        ModelError: names the link, joint or mesh at fault.
    """
    root = read_xml(path)
    if root.tag != "sdf":
        raise ModelError(f"its outermost element is <{root.tag}>; an SDFormat file's is <sdf>")
    if "version" not in root.attrib:
        raise ModelError('its <sdf> has no version; write for example <sdf version="1.9">')
    leave_out(root, _READ, _KNOWN, warn)
    refuse_macros(root)
    for include in root.iter("include"):
        _cure_include(include, path, finder, cure_file)
    for link in root.iter("link"):
        where = f"link '{link.get('name', '(unnamed)')}'"
        _check_poses(link, where)
        for visual in link.iterfind("visual"):
            _check_visual(visual, where, path, finder)
    for model in [*root.iter("model"), *root.iter("world")]:
        _leave_out_constraints(model, warn)
    limits: Limits = {}
    for joint in root.iter("joint"):
        limits.update(_check_joint(joint, warn))
    return xml_text(root), limits


def _cure_include(
    include: ElementTree.Element,
    path: Path,
    finder: FileFinder,
    cure_file: Callable[[Path], Path],
) -> None:
    """Name the file that stands in for an included model."""
    uri = include.find("uri")
    name = "" if uri is None else (uri.text or "").strip()
    if uri is None or not name:
        raise ModelError("an <include> without a <uri>")
    found = finder.resolve(name, path, "included model")
    if found.is_dir():
        found = _model_of_folder(found, name)
    uri.text = f"file://{cure_file(found)}"


def _model_of_folder(folder: Path, name: str) -> Path:
    """The newest model that a folder's model.config names."""
    config = folder / "model.config"
    if not config.is_file():
        raise ModelError(f"included model '{name}': {config} does not exist")
    files = [one for one in read_xml(config).iterfind("sdf") if (one.text or "").strip()]
    if not files:
        raise ModelError(f"included model '{name}': {config} names no <sdf> file")
    newest = max(files, key=lambda one: [int(p) for p in one.get("version", "0").split(".")])
    return folder / (newest.text or "").strip()


def _check_poses(element: ElementTree.Element, where: str) -> None:
    """Refuse a pose that holds something else than numbers."""
    for pose in element.iterfind("pose"):
        if (pose.text or "").strip() and pose.get("rotation_format", "euler_rpy") == "euler_rpy":
            read_numbers(pose.text, 6, f"{where}: its <pose>")


def _check_visual(visual: ElementTree.Element, where: str, path: Path, finder: FileFinder) -> None:
    """Refuse what cannot be drawn or would be drawn otherwise, and make file names absolute."""
    _check_poses(visual, where)
    for material in visual.findall("material"):
        for colour in material.findall("diffuse"):
            colour.text = colour_text(colour.text)
            if colour.text is None:
                material.remove(colour)
    for shape in visual.findall("geometry/*"):
        kind = shape.tag.removeprefix("drake:")
        require_shape(kind, _SIZES, where)
        # SDFormat's own reader takes sizes that cannot be for 1 m.
        for name, count in _SIZES[kind]:
            for size in shape.iterfind(name):
                require_size(size.text, count, f"{where}: {name} of its {kind}")
        if kind == "mesh":
            _check_mesh(shape, where, path, finder)


def _check_mesh(mesh: ElementTree.Element, where: str, path: Path, finder: FileFinder) -> None:
    uri = mesh.find("uri")
    name = "" if uri is None else (uri.text or "").strip()
    if uri is None or not name:
        raise ModelError(f"{where}: a mesh without a <uri>")
    uri.text = f"file://{finder.resolve(name, path, f'{where}: mesh')}"
    if mesh.find("submesh") is not None:
        raise ModelError(
            f"{where}: Drake shows the whole mesh '{name}', not its <submesh> alone; put that part "
            "into a file of its own"
        )
    scale = mesh.findtext("scale")
    if scale is not None:
        require_scale(scale, 3, f"{where}: scale of mesh '{name}'")


def _leave_out_constraints(model: ElementTree.Element, warn: Warn) -> None:
    """Remove joints that couple others, or close a loop of links: Drake refuses both."""
    for joint in model.findall("joint"):
        if joint.get("type") == "gearbox":
            model.remove(joint)
            warn(f"joint '{joint.get('name')}' is a gearbox: not enforced, it is left out")
    joints = model.findall("joint")
    ends = [
        [(joint.findtext(end) or "").strip() for end in ("parent", "child")] for joint in joints
    ]
    open_loops(model, joints, ends, warn)


def _check_joint(joint: ElementTree.Element, warn: Warn) -> Limits:
    """Refuse limits that Drake refuses; returns those that its parser passes over."""
    name, kind = joint.get("name", "(unnamed)"), joint.get("type", "")
    _check_poses(joint, f"joint '{name}'")
    suffixes = {"universal": {"axis": "_qx", "axis2": "_qy"}, "screw": {"axis": ""}}
    passed_over: Limits = {}
    for tag in ("axis", "axis2"):
        for axis in joint.iterfind(tag):
            if axis.findtext("xyz") is not None:
                numbers = read_numbers(axis.findtext("xyz"), 3, f"joint '{name}': its <xyz>")
                if not any(numbers):
                    raise ModelError(f"joint '{name}': its axis is zero")
            leave_out_mimics(axis, name, warn)
            texts = [axis.findtext(f"limit/{side}") for side in ("lower", "upper")]
            lower, upper = read_limits(texts[0], texts[1], name)
            if tag in suffixes.get(kind, {}) and lower is not None and upper is not None:
                passed_over[f"{name}{suffixes[kind][tag]}"] = (lower, upper)
    return passed_over
