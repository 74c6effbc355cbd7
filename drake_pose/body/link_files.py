"""Sanitising of URDF, SDFormat and MJCF files before Drake parses them.

Only links, joints and visual geometry are kept, and file names are made absolute. Collision
geometry, transmissions and simulator elements do not affect silhouettes, but make Drake refuse many
files.

MJCF is compiled by MuJoCo and written as plain MJCF that Drake reads alike. Drake 1.51 ignores
inherited defaults, and places all but the last joint of a body at the parent's origin
(``multibody/parsing/detail_mujoco_parser.cc``, ParseBody). MuJoCo applies the joints of a body one
after the other, each about its ``pos`` in the body's frame. They are therefore written as nested
bodies with one joint each.
"""

import itertools
import math
import warnings
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.body.meshes import TriangleMesh, merge_duplicate_vertices, write_obj
from drake_pose.body.model_files import (
    FOLLOWING,
    OLD_XACRO_ELEMENTS,
    FileFinder,
    Warn,
    colour_text,
    leave_out,
    number_text,
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
    refuse_macros(root, path)
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
    refuse_macros(root, path)
    for include in root.iter("include"):
        uri, name = _uri(include, "an <include> without a <uri>")
        found = finder.resolve(name, path, "included model")
        if found.is_dir():
            config = found / "model.config"
            if not config.is_file():
                raise ModelError(f"included model '{name}': {config} does not exist")
            files = [file for file in read_xml(config).iterfind("sdf") if (file.text or "").strip()]
            if not files:
                raise ModelError(f"included model '{name}': {config} names no <sdf> file")
            versions = [[int(p) for p in file.get("version", "0").split(".")] for file in files]
            found /= (files[versions.index(max(versions))].text or "").strip()
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
    # Drake's parser does not read the limits of these joints.
    suffixes = {"universal": {"axis": "_qx", "axis2": "_qy"}, "screw": {"axis": ""}}
    for joint in root.iter("joint"):
        name, kind = joint.get("name", "(unnamed)"), joint.get("type", "")
        _check_poses(joint, f"joint '{name}'")
        for axis in [*joint.findall("axis"), *joint.findall("axis2")]:
            xyz = axis.findtext("xyz")
            if xyz is not None and not any(read_numbers(xyz, 3, f"joint '{name}': its <xyz>")):
                raise ModelError(f"joint '{name}': its axis is zero")
            texts = [axis.findtext(f"limit/{side}") for side in ("lower", "upper")]
            lower, upper = read_limits(texts[0], texts[1], name)
            if axis.tag in suffixes.get(kind, {}) and lower is not None and upper is not None:
                limits[f"{name}{suffixes[kind][axis.tag]}"] = (lower, upper)
    return xml_text(root), limits


def _uri(element: ElementTree.Element, missing: str) -> tuple[ElementTree.Element, str]:
    """Return an element's <uri> and its text; ModelError(``missing``) if there is none."""
    uri = element.find("uri")
    name = "" if uri is None else (uri.text or "").strip()
    if uri is None or not name:
        raise ModelError(missing)
    return uri, name


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


# The inertia of bodies that have none.
_ALMOST_MASSLESS = {"pos": "0 0 0", "mass": "1e-6", "diaginertia": "1e-9 1e-9 1e-9"}
# The geom group that marks geoms as not drawn.
_NOT_DRAWN = 5
# Number of sizes of each drawn shape, by MuJoCo's name of the shape.
_SIZES = {"plane": 3, "sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3, "mesh": 0}


MjcfCoupling = tuple[str, str, float, float]
"""Follower and leader joint, multiplier, and offset [rad or m]."""


def sanitise_mjcf(path: Path, warn: Warn) -> tuple[str, list[MjcfCoupling]]:
    """Return the text of an MJCF file, with absolute paths, that Drake reads as MuJoCo does.

    ``path``: the MJCF file. ``warn``: receives a message for each constraint that is not enforced.
    Returns the text, and the couplings between joints, which Drake's parser does not read. Raises
    ModelError: the file is no MJCF, or MuJoCo refuses it; the message says why.
    """
    root = read_xml(path)
    if root.tag != "mujoco":
        hint = {"robot": "it holds a URDF: name it .urdf", "sdf": "it holds SDFormat: name it .sdf"}
        raise ModelError(
            f"{path}: the outermost element is <{root.tag}>, not <mujoco>; "
            f"{hint.get(root.tag, 'is it a model file?')}"
        )
    model, couplings = _compile(path, warn)
    text = ElementTree.Element("mujoco", model=root.get("model") or path.stem)
    ElementTree.SubElement(text, "compiler", angle="radian")
    asset = ElementTree.SubElement(text, "asset")
    bodies = [ElementTree.SubElement(text, "worldbody")]
    names = [_name(model, address) for address in model.name_bodyadr]
    # Bodies without a name get a unique one.
    free = (name for number in itertools.count(1) if (name := f"body{number}") not in names)
    for body, name in enumerate([name or next(free) for name in names[1:]], start=1):
        bodies.append(_add_body(model, body, name, bodies[model.body_parentid[body]]))
    drawn = [geom for geom in range(model.ngeom) if _shape_name(model, geom)]
    for mesh in sorted({model.geom_dataid[g] for g in drawn if _shape_name(model, g) == "mesh"}):
        file = write_obj(_mesh(model, mesh), _name(model, model.name_meshadr[mesh]))
        ElementTree.SubElement(asset, "mesh", name=f"mesh{mesh}", file=str(file))
    for geom in drawn:
        kind = _shape_name(model, geom)
        attributes = {"type": kind, "rgba": number_text(model.geom_rgba[geom])}
        attributes |= {"contype": "0", "conaffinity": "0"}
        attributes |= {
            "pos": number_text(model.geom_pos[geom]),
            "quat": number_text(model.geom_quat[geom]),
        }
        if kind == "mesh":
            attributes["mesh"] = f"mesh{model.geom_dataid[geom]}"
        else:
            attributes["size"] = number_text(model.geom_size[geom][: _SIZES[kind]])
        ElementTree.SubElement(bodies[model.geom_bodyid[geom]], "geom", attributes)
    return xml_text(text), couplings


def _compile(path: Path, warn: Warn) -> tuple[Any, list[MjcfCoupling]]:
    """Return MuJoCo's compiled model without undrawn parts, and the couplings between joints.

    ``warn`` receives a message about constraints that are not enforced.
    """
    try:
        import mujoco
    except ModuleNotFoundError as error:
        raise ModelError(
            f'{path}: MJCF files are read by MuJoCo: pip install "drake_pose[mjcf]"'
        ) from error
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if spec.flexes:
            raise ModelError(f"{path}: <flex> '{spec.flexes[0].name}' is not rigid: not read")
        couplings = [
            (equality.name1, equality.name2, float(equality.data[1]), float(equality.data[0]))
            for equality in spec.equalities
            if equality.type == mujoco.mjtEq.mjEQ_JOINT and equality.active and equality.name2
            if equality.data[1] != 0.0 and not np.any(equality.data[2:5])
        ]
        if count := len(spec.equalities) - len(couplings):
            warn(f"{count} <equality> constraint{'s' * (count > 1)} of the file: not enforced")
        # Removed because some name files that may be missing, such as textures.
        for element in (
            *spec.sensors, *spec.actuators, *spec.equalities, *spec.tendons, *spec.keys,
            *spec.pairs, *spec.excludes, *spec.tuples, *spec.skins, *spec.textures,
        ):  # fmt: skip
            spec.delete(element)
        colours = {material.name: material.rgba for material in spec.materials}
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0
            # MuJoCo's default colour means that the material's colour counts.
            if np.allclose(geom.rgba, (0.5, 0.5, 0.5, 1.0)):
                geom.rgba = colours.get(geom.material, geom.rgba)
            geom.material = ""
            # By convention, groups above 2 are collision geometry, which MuJoCo's viewer hides.
            if geom.group > 2 or not geom.rgba[3] > 0.0:
                geom.group = _NOT_DRAWN
                if geom.meshname:
                    spec.delete(geom)
        for material in spec.materials:
            for k in range(len(material.textures)):
                material.textures[k] = ""
        used = {geom.meshname for geom in spec.geoms}
        for mesh in spec.meshes:
            # Visual meshes need not enclose a volume.
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            if mesh.name not in used:
                spec.delete(mesh)
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-9
        spec.compiler.balanceinertia = True
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Deprecated elements still count.
            model = spec.compile()
        # MuJoCo couples displacements from the reference positions qpos0.
        places = zip(model.name_jntadr, model.jnt_qposadr, strict=True)
        start = {_name(model, name): float(model.qpos0[place]) for name, place in places}
        return model, [(a, b, k, c + start[a] - k * start[b]) for a, b, k, c in couplings]
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise ModelError(f"{path}: {' '.join(str(error).split())}") from error


def _shape_name(model: Any, geom: int) -> str:
    """Return the shape of the geom of index ``geom`` in a compiled model; "" if it is not drawn."""
    import mujoco

    if model.geom_group[geom] == _NOT_DRAWN:
        return ""
    name = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    return name if name in _SIZES else ""


def _name(model: Any, address: int) -> str:
    """Return the name at an address in a compiled model's names, as UTF-8 where possible."""
    return str(model.names[address:].split(b"\0", 1)[0].decode("utf-8", "replace"))


def _add_body(model: Any, body: int, name: str, parent: ElementTree.Element) -> ElementTree.Element:
    """Write a body with n joints as n nested bodies of one joint each; return the innermost.

    ``model``: MuJoCo's compiled model. ``body``: its index. ``name``: of the innermost body.
    ``parent``: the element that the outermost body is added to.
    """
    first = model.body_jntadr[body]
    joints = range(first, first + model.body_jntnum[body])
    pose = {"pos": number_text(model.body_pos[body]), "quat": number_text(model.body_quat[body])}
    names = [f"{name}__{_name(model, model.name_jntadr[j]) or k}" for k, j in enumerate(joints)]
    element = parent
    for nested, joint in itertools.zip_longest([*names[:-1], name], joints):
        element = ElementTree.SubElement(element, "body", {"name": nested, **pose})
        pose = {}
        if joint is not None:
            _add_joint(model, joint, element)
        if nested != name:
            ElementTree.SubElement(element, "inertial", _ALMOST_MASSLESS)
    inertial = dict(_ALMOST_MASSLESS)
    if model.body_mass[body] > 0.0:
        inertial["mass"] = repr(float(model.body_mass[body]))
        inertial["diaginertia"] = number_text(model.body_inertia[body])
        inertial |= {
            "pos": number_text(model.body_ipos[body]),
            "quat": number_text(model.body_iquat[body]),
        }
    ElementTree.SubElement(element, "inertial", inertial)
    return element


def _add_joint(model: Any, joint: int, body: ElementTree.Element) -> None:
    """Write the joint of index ``joint`` of a compiled model into a body element."""
    name = _name(model, model.name_jntadr[joint])
    attributes = {"name": name} if name else {}
    kind = ("free", "ball", "slide", "hinge")[model.jnt_type[joint]]
    if kind == "free":
        ElementTree.SubElement(body, "freejoint", attributes)
        return
    attributes |= {"type": kind, "pos": number_text(model.jnt_pos[joint]), "limited": "false"}
    if kind != "ball":
        attributes["axis"] = number_text(model.jnt_axis[joint])
        attributes["ref"] = repr(float(model.qpos0[model.jnt_qposadr[joint]]))
        attributes["damping"] = repr(float(np.ravel(model.dof_damping[model.jnt_dofadr[joint]])[0]))
    if model.jnt_limited[joint]:
        attributes |= {"limited": "true", "range": number_text(model.jnt_range[joint])}
    ElementTree.SubElement(body, "joint", attributes)


def _mesh(model: Any, mesh: int) -> TriangleMesh:
    """Return the mesh of index ``mesh`` of a compiled model in MuJoCo's own mesh frame."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    begin, triangles = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return merge_duplicate_vertices(
        TriangleMesh(
            model.mesh_vert[first : first + count], model.mesh_face[begin : begin + triangles]
        )
    )
