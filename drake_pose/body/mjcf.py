"""MJCF files as MuJoCo's own compiler reads them, in the plain MJCF that Drake reads alike.

Drake 1.51 forgets inherited settings, and puts all but the last joint of a body at the parent's
origin (``multibody/parsing/detail_mujoco_parser.cc``, ParseBody). MuJoCo applies the joints of a
body one after the other, each about its ``pos`` in the body's frame: as nested bodies with one
joint each. Collision is left out.
"""

import itertools
import warnings
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_pose.body.meshes import TriangleMesh, merge_duplicate_vertices, write_obj
from drake_pose.body.model_files import Warn, read_xml, xml_text
from drake_pose.errors import ModelError

_ALMOST_MASSLESS = {"pos": "0 0 0", "mass": "1e-6", "diaginertia": "1e-9 1e-9 1e-9"}
# The group of geoms that are not drawn.
_NOT_DRAWN = 5
# How many of a shape's three sizes count, by MuJoCo's name of the shape; others are not drawn.
_SIZES = {"plane": 3, "sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3, "mesh": 0}


Couple = tuple[str, str, float, float]
"""A joint, the one that it follows, multiplier and offset [rad or m]."""


def sanitise_mjcf(path: Path, warn: Warn) -> tuple[str, list[Couple]]:
    """The text of an MJCF file, paths absolute, that Drake reads as MuJoCo does.

    Returns:
        The text, and which joints follow others, which Drake's parser passes over.

    Raises ModelError: no MJCF, or MuJoCo refuses it; the message names the file, and says why.
    """
    root = read_xml(path)
    if root.tag != "mujoco":
        hint = {"robot": "it holds a URDF: name it .urdf", "sdf": "it holds SDFormat: name it .sdf"}
        raise ModelError(
            f"{path}: the outermost element is <{root.tag}>, not <mujoco>; "
            f"{hint.get(root.tag, 'is it a model file?')}"
        )
    model, couples = _compile(path, warn)
    text = ElementTree.Element("mujoco", model=root.get("model") or path.stem)
    ElementTree.SubElement(text, "compiler", angle="radian")
    asset = ElementTree.SubElement(text, "asset")
    bodies = [ElementTree.SubElement(text, "worldbody")]
    names = [_name(model, address) for address in model.name_bodyadr]
    # Bodies without a name get one that no other has.
    free = (name for number in itertools.count(1) if (name := f"body{number}") not in names)
    for body, name in enumerate([name or next(free) for name in names[1:]], start=1):
        bodies.append(_add_body(model, body, name, bodies[model.body_parentid[body]]))
    drawn = [geom for geom in range(model.ngeom) if _kind(model, geom)]
    for mesh in sorted({model.geom_dataid[g] for g in drawn if _kind(model, g) == "mesh"}):
        file = write_obj(_mesh(model, mesh), _name(model, model.name_meshadr[mesh]))
        ElementTree.SubElement(asset, "mesh", name=f"mesh{mesh}", file=str(file))
    for geom in drawn:
        kind = _kind(model, geom)
        said = {"type": kind, "rgba": _text(model.geom_rgba[geom])}
        said |= {"contype": "0", "conaffinity": "0"}
        said |= {"pos": _text(model.geom_pos[geom]), "quat": _text(model.geom_quat[geom])}
        if kind == "mesh":
            said["mesh"] = f"mesh{model.geom_dataid[geom]}"
        else:
            said["size"] = _text(model.geom_size[geom][: _SIZES[kind]])
        ElementTree.SubElement(bodies[model.geom_bodyid[geom]], "geom", said)
    return xml_text(text), couples


def _compile(path: Path, warn: Warn) -> tuple[Any, list[Couple]]:
    """MuJoCo's model, without what neither moves nor is seen, and which joints follow others."""
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
        couples = [
            (one.name1, one.name2, float(one.data[1]), float(one.data[0]))
            for one in spec.equalities
            if one.type == mujoco.mjtEq.mjEQ_JOINT and one.active and one.name2
            if one.data[1] != 0.0 and not np.any(one.data[2:5])
        ]
        if count := len(spec.equalities) - len(couples):
            warn(f"{count} <equality> constraint{'s' * (count > 1)} of the file: not enforced")
        # Some of it names files that a package of looks lacks.
        for element in (
            *spec.sensors, *spec.actuators, *spec.equalities, *spec.tendons, *spec.keys,
            *spec.pairs, *spec.excludes, *spec.tuples, *spec.skins, *spec.textures,
        ):  # fmt: skip
            spec.delete(element)
        colours = {material.name: material.rgba for material in spec.materials}
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0
            # A geom of this colour has its material's.
            if np.allclose(geom.rgba, (0.5, 0.5, 0.5, 1.0)):
                geom.rgba = colours.get(geom.material, geom.rgba)
            geom.material = ""
            # Groups above are collision geometry, which MuJoCo's viewer does not draw.
            if geom.group > 2 or not geom.rgba[3] > 0.0:
                geom.group = _NOT_DRAWN
                if geom.meshname:
                    spec.delete(geom)
        for material in spec.materials:
            for k in range(len(material.textures)):
                material.textures[k] = ""
        used = {geom.meshname for geom in spec.geoms}
        for mesh in spec.meshes:
            # The looks of a link need not enclose a volume.
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            if mesh.name not in used:
                spec.delete(mesh)
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-9
        spec.compiler.balanceinertia = True
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # What is old in a file still counts.
            model = spec.compile()
        # It couples how far both are from where the file has them.
        places = zip(model.name_jntadr, model.jnt_qposadr, strict=True)
        start = {_name(model, name): float(model.qpos0[place]) for name, place in places}
        return model, [(a, b, k, c + start[a] - k * start[b]) for a, b, k, c in couples]
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise ModelError(f"{path}: {' '.join(str(error).split())}") from error


def _kind(model: Any, geom: int) -> str:
    """The name of a geom's shape; empty for one that is not seen, or that Drake does not draw."""
    import mujoco

    if model.geom_group[geom] == _NOT_DRAWN:
        return ""
    name = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    return name if name in _SIZES else ""


def _name(model: Any, address: int) -> str:
    """A name in whatever encoding."""
    return str(model.names[address:].split(b"\0", 1)[0].decode("utf-8", "replace"))


def _add_body(model: Any, body: int, name: str, parent: ElementTree.Element) -> ElementTree.Element:
    """Writes a body with joints j1 .. jn as n nested bodies of one joint each; the innermost."""
    first = model.body_jntadr[body]
    joints = range(first, first + model.body_jntnum[body])
    pose = {"pos": _text(model.body_pos[body]), "quat": _text(model.body_quat[body])}
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
        inertial["diaginertia"] = _text(model.body_inertia[body])
        inertial |= {"pos": _text(model.body_ipos[body]), "quat": _text(model.body_iquat[body])}
    ElementTree.SubElement(element, "inertial", inertial)
    return element


def _add_joint(model: Any, joint: int, body: ElementTree.Element) -> None:
    name = _name(model, model.name_jntadr[joint])
    said = {"name": name} if name else {}
    kind = ("free", "ball", "slide", "hinge")[model.jnt_type[joint]]
    if kind == "free":
        ElementTree.SubElement(body, "freejoint", said)
        return
    said |= {"type": kind, "pos": _text(model.jnt_pos[joint]), "limited": "false"}
    if kind != "ball":
        said["axis"] = _text(model.jnt_axis[joint])
        said["ref"] = repr(float(model.qpos0[model.jnt_qposadr[joint]]))
        said["damping"] = repr(float(np.ravel(model.dof_damping[model.jnt_dofadr[joint]])[0]))
    if model.jnt_limited[joint]:
        said |= {"limited": "true", "range": _text(model.jnt_range[joint])}
    ElementTree.SubElement(body, "joint", said)


def _mesh(model: Any, mesh: int) -> TriangleMesh:
    """A mesh in the frame in which MuJoCo keeps it."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    begin, triangles = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return merge_duplicate_vertices(
        TriangleMesh(
            model.mesh_vert[first : first + count], model.mesh_face[begin : begin + triangles]
        )
    )


def _text(values: ArrayLike) -> str:
    """Numbers as an attribute, without loss."""
    return " ".join(repr(float(value)) for value in np.ravel(values))
