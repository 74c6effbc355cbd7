"""The meshes of an MJCF file as OBJ files at absolute paths: Drake reads no others there."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from drake_pose.body.files.mjcf_poses import numbers
from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.body.surfaces.mesh_files import drawable_file, read_mesh_file, write_obj
from drake_pose.errors import ModelError


def write_out_meshes(root: ElementTree.Element, folder: Path, compiler: Mapping[str, str]) -> None:
    """Give the meshes in use names and OBJ files that Drake draws; remove the others.

    Args:
        root: the outermost element, whose defaults are written out.
        folder: the main file's.
        compiler: the <compiler>'s settings.

    Raises:
        ModelError: a mesh that is missing or cannot be read; the message names it and its body.
    """
    users: dict[str, str] = {}
    for body in root.iter("body"):
        for geom in body.findall("geom"):
            users.setdefault(geom.get("mesh", ""), f"body '{body.get('name')}', ")
    for geom in root.iterfind("worldbody/geom"):
        users.setdefault(geom.get("mesh", ""), "")
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
