"""Sanitising of MJCF files: MuJoCo compiles them, and plain MJCF that Drake reads alike is written.

Drake 1.51 ignores inherited defaults, and places all but the last joint of a body at the parent's
origin (``multibody/parsing/detail_mujoco_parser.cc``, ParseBody). MuJoCo applies the joints of a
body one after the other, each about its ``pos`` in the body's frame. They are therefore written as
nested bodies with one joint each. Collision geometry is left out.
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
        attributes = {"type": kind, "rgba": _text(model.geom_rgba[geom])}
        attributes |= {"contype": "0", "conaffinity": "0"}
        attributes |= {"pos": _text(model.geom_pos[geom]), "quat": _text(model.geom_quat[geom])}
        if kind == "mesh":
            attributes["mesh"] = f"mesh{model.geom_dataid[geom]}"
        else:
            attributes["size"] = _text(model.geom_size[geom][: _SIZES[kind]])
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
    """Write the joint of index ``joint`` of a compiled model into a body element."""
    name = _name(model, model.name_jntadr[joint])
    attributes = {"name": name} if name else {}
    kind = ("free", "ball", "slide", "hinge")[model.jnt_type[joint]]
    if kind == "free":
        ElementTree.SubElement(body, "freejoint", attributes)
        return
    attributes |= {"type": kind, "pos": _text(model.jnt_pos[joint]), "limited": "false"}
    if kind != "ball":
        attributes["axis"] = _text(model.jnt_axis[joint])
        attributes["ref"] = repr(float(model.qpos0[model.jnt_qposadr[joint]]))
        attributes["damping"] = repr(float(np.ravel(model.dof_damping[model.jnt_dofadr[joint]])[0]))
    if model.jnt_limited[joint]:
        attributes |= {"limited": "true", "range": _text(model.jnt_range[joint])}
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


def _text(values: ArrayLike) -> str:
    """Return numbers as attribute text without loss of precision."""
    return " ".join(repr(float(value)) for value in np.ravel(values))
