"""Poses and meshes of MJCF, written out as Drake reads them.

Orientations become quaternions, ``fromto`` a pose and a size, and <frame>, which Drake 1.51
ignores, is applied to what is in it. Drake turns ``zaxis`` and ``fromto`` that point down about
another axis than MuJoCo, leaves boxes and ellipsoids with ``fromto`` out, and reads OBJ meshes
alone. Source: MuJoCo's XML reference, tried with MuJoCo 4.0.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from drake_pose.body.formats.xml_files import read_numbers
from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.body.surfaces.mesh_files import drawable_file, read_mesh_file, write_obj
from drake_pose.errors import ModelError

# How many numbers each way to say an orientation has.
ORIENTATIONS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}

# Elements in a body that have a place, and that Drake reads.
_PLACED = ("body", "geom", "inertial")


def write_out_poses(parent: ElementTree.Element, compiler: Mapping[str, str]) -> None:
    """Write the poses in a <worldbody> as ``pos`` and ``quat``, and replace its frames.

    The defaults of ``parent`` are written out. Raises ModelError, which names the element.
    """
    for child in parent:
        if child.tag == "geom" and "fromto" in child.attrib:
            _write_out_fromto(child)
        if child.tag in _PLACED:
            _write_pose(child, *_pose(child, compiler))
        write_out_poses(child, compiler)
    children = []
    for child in parent:
        if child.tag != "frame":
            children.append(child)
            continue
        p_PF, R_PF = _pose(child, compiler)
        for element in child:
            _move(element, p_PF, R_PF, compiler)
            children.append(element)
    parent[:] = children


def numbers(
    element: ElementTree.Element, attribute: str, count: int, default: str = ""
) -> NDArray[np.float64]:
    """The numbers of an attribute, of which there must be ``count``; else a ModelError."""
    where = f"<{element.tag}> '{element.get('name', '(unnamed)')}': {attribute}"
    return np.array(read_numbers(element.get(attribute, default), count, where))


def _number_text(values: NDArray[np.float64]) -> str:
    """Numbers as an attribute, without loss."""
    return " ".join(repr(float(value)) for value in values)


def _rotation_to_direction(direction: NDArray[np.float64]) -> Rotation:
    """The smallest rotation that turns z to a direction (3,); half a turn about x for -z."""
    direction = direction / np.linalg.norm(direction)
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine = np.linalg.norm(axis)
    axis = axis / sine if sine > 1e-10 else np.array([1.0, 0.0, 0.0])
    return Rotation.from_rotvec(axis * np.arctan2(sine, direction[2]))


def _pose(
    element: ElementTree.Element, compiler: Mapping[str, str]
) -> tuple[NDArray[np.float64], Rotation]:
    """Position (3,) [m] and rotation of an element in its parent's frame."""
    position = numbers(element, "pos", 3, "0 0 0")
    given = [name for name in ORIENTATIONS if name in element.attrib]
    name = element.get("name", "(unnamed)")
    if len(given) > 1:
        raise ModelError(f"<{element.tag}> '{name}' has several orientations: {', '.join(given)}")
    if not given:
        return position, Rotation.identity()
    kind = given[0]
    values = numbers(element, kind, ORIENTATIONS[kind])
    unit = np.pi / 180.0 if compiler.get("angle", "degree") == "degree" else 1.0
    if kind == "euler":
        return position, _euler(values * unit, compiler.get("eulerseq", "xyz"))
    vectors = {"axisangle": [values[:3]], "xyaxes": [values[:3], values[3:]]}.get(kind, [values])
    lengths = [np.linalg.norm(vector) for vector in vectors]
    if min(lengths) < 1e-10:
        raise ModelError(f"<{element.tag}> '{name}': {kind}=\"{element.get(kind)}\" has no length")
    first = vectors[0] / lengths[0]
    if kind == "quat":
        return position, Rotation.from_quat(values[[1, 2, 3, 0]])
    if kind == "axisangle":
        return position, Rotation.from_rotvec(first * values[3] * unit)
    if kind == "zaxis":
        return position, _rotation_to_direction(values)
    y = values[3:] - (first @ values[3:]) * first
    if np.linalg.norm(y) < 1e-10:
        raise ModelError(f"<{element.tag}> '{name}': the axes of xyaxes are parallel")
    y = y / np.linalg.norm(y)
    return position, Rotation.from_matrix(np.stack([first, y, np.cross(first, y)], axis=1))


def _euler(angles: NDArray[np.float64], sequence: str) -> Rotation:
    """Turns about moving axes (x, y, z) and fixed ones (X, Y, Z), one after the other."""
    if len(sequence) != 3 or not set(sequence) <= set("xyzXYZ"):
        raise ModelError(f'<compiler>: eulerseq="{sequence}" must be three of x, y, z, X, Y, Z')
    rotation = Rotation.identity()
    for letter, angle in zip(sequence, angles, strict=True):
        turn = Rotation.from_euler(letter.lower(), angle)
        rotation = rotation * turn if letter.islower() else turn * rotation
    return rotation


def _write_pose(
    element: ElementTree.Element, position: NDArray[np.float64], rotation: Rotation
) -> None:
    """Let an element say its pose by ``pos`` and ``quat``."""
    for attribute in ORIENTATIONS:
        element.attrib.pop(attribute, None)
    element.set("pos", _number_text(position))
    element.set("quat", _number_text(rotation.as_quat()[[3, 0, 1, 2]]))


def _write_out_fromto(geom: ElementTree.Element) -> None:
    """Let a geom that lies between two points say so by its pose and size, as MuJoCo does."""
    ends = numbers(geom, "fromto", 6)
    axis = ends[:3] - ends[3:]
    half = np.linalg.norm(axis) / 2.0
    size = geom.get("size", "").split()[:1]
    name = geom.get("name", "(unnamed)")
    if half < 1e-10 or not size:
        raise ModelError(f"<geom> '{name}': fromto needs two different points and a size")
    if geom.get("type") in ("box", "ellipsoid"):
        size = size * 2
    geom.set("size", " ".join([*size, repr(float(half))]))
    del geom.attrib["fromto"]
    _write_pose(geom, (ends[:3] + ends[3:]) / 2.0, _rotation_to_direction(axis))


def _move(
    element: ElementTree.Element,
    p_PF: NDArray[np.float64],
    R_PF: Rotation,
    compiler: Mapping[str, str],
) -> None:
    """Say an element of frame F in the body P that F stands in."""
    if element.tag in _PLACED:
        if "fullinertia" in element.attrib:
            raise ModelError(
                "an <inertial> with fullinertia inside <frame> is not read: write diaginertia, or "
                "write it outside the frame"
            )
        p_FE, R_FE = _pose(element, compiler)
        _write_pose(element, p_PF + R_PF.apply(p_FE), R_PF * R_FE)
    elif element.tag == "joint":
        position, axis = numbers(element, "pos", 3, "0 0 0"), numbers(element, "axis", 3, "0 0 1")
        element.set("pos", _number_text(p_PF + R_PF.apply(position)))
        element.set("axis", _number_text(R_PF.apply(axis)))


def write_out_meshes(root: ElementTree.Element, folder: Path, compiler: Mapping[str, str]) -> None:
    """Give the meshes in use names and OBJ files that Drake draws; remove the others.

    The defaults of ``root`` are written out. Raises ModelError, which names a mesh and its body.
    """
    users: dict[str, str] = {}
    for body in [*root.iter("body"), *root.iter("worldbody")]:
        where = f"body '{body.get('name')}', " if body.tag == "body" else ""
        for geom in body.findall("geom"):
            users.setdefault(geom.get("mesh", ""), where)
    for asset in root.iter("asset"):
        for mesh in asset.findall("mesh"):
            file = mesh.get("file", "").replace("\\", "/")
            name = mesh.get("name") or Path(file).stem
            if name not in users:
                asset.remove(mesh)
                continue
            mesh.set("name", name)
            try:
                path = _file(mesh, file, folder, compiler)
            except ModelError as error:
                raise ModelError(f"{users.pop(name)}mesh '{name}': {error}") from error
            for attribute in ("vertex", "face", "normal", "texcoord", "refpos", "refquat"):
                mesh.attrib.pop(attribute, None)
            mesh.set("file", str(path))


def _file(mesh: ElementTree.Element, file: str, folder: Path, compiler: Mapping[str, str]) -> Path:
    """An OBJ file that holds what a <mesh> shows, at the size before ``scale``."""
    if file:
        if compiler.get("strippath") == "true":
            file = Path(file).name
        path = folder / compiler.get("meshdir", "").replace("\\", "/") / file
        if "refpos" not in mesh.attrib and "refquat" not in mesh.attrib:
            if not path.is_file():
                raise ModelError(f"{path} does not exist")
            return path if path.suffix.lower() == ".obj" else drawable_file(path)
        surface = read_mesh_file(path)
    elif "vertex" in mesh.attrib:
        surface = _written_mesh(mesh)
    else:
        raise ModelError(
            "it has neither a file nor vertices; builtin and plugin meshes are not read"
        )
    # MuJoCo moves a mesh to its reference pose before it scales it.
    w, x, y, z = numbers(mesh, "refquat", 4, "1 0 0 0")
    vertices = surface.vertices - numbers(mesh, "refpos", 3, "0 0 0")
    vertices = Rotation.from_quat([x, y, z, w]).inv().apply(vertices)
    return write_obj(TriangleMesh(vertices, surface.triangles), mesh.get("name", "mesh"))


def _written_mesh(mesh: ElementTree.Element) -> TriangleMesh:
    """A mesh whose vertices the MJCF file itself holds: its faces, or their convex hull."""
    try:
        vertices = np.array(mesh.get("vertex", "").split(), dtype=np.float64).reshape(-1, 3)
        triangles = np.array(mesh.get("face", "").split(), dtype=np.int64).reshape(-1, 3)
        if not len(triangles):
            hull = ConvexHull(vertices)
            # Qhull does not say on which side of a facet the outside is, but its equations do.
            corners = vertices[hull.simplices]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0.0
            triangles = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    except (ValueError, QhullError) as error:
        raise ModelError(f"its vertices or faces cannot be read: {error}") from error
    if not np.all(np.isfinite(vertices)) or not 0 <= triangles.min() <= triangles.max() < len(
        vertices
    ):
        raise ModelError("a vertex is not finite, or a face names one that does not exist")
    return TriangleMesh(vertices, triangles.astype(np.int32))
