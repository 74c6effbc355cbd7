"""Mesh files to triangles, and to files that Drake's renderer draws."""

import atexit
import functools
import hashlib
import re
import struct
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import ReadObjToTriangleSurfaceMesh

from drake_pose.body.mesh import TriangleMesh, merge_duplicate_vertices
from drake_pose.errors import ModelError

READABLE_EXTENSIONS = (".obj", ".gltf", ".glb", ".stl", ".dae")
# glTF's vertical axis is y, Drake's is z: (x, y, z) becomes (x, -z, y).
_R_DRAKE_GLTF = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def read_mesh_file(path: Path, scale: NDArray[np.float64] | None = None) -> TriangleMesh:
    """The triangles of an OBJ, glTF, GLB, STL or DAE file.

    Args:
        path: the mesh file.
        scale: (3,) factors along x, y and z; None for the file's own size.

    Returns:
        The mesh, duplicate vertices merged.

    Raises:
        ModelError: unknown extension, unreadable, no triangle, or a coordinate that is not finite.
    """
    mesh = _read_unscaled(path.resolve())
    if scale is None:
        return mesh
    triangles = mesh.triangles if np.prod(scale) > 0 else mesh.triangles[:, ::-1]
    return TriangleMesh(mesh.vertices * scale, triangles)


@functools.lru_cache(maxsize=64)
def _read_unscaled(path: Path) -> TriangleMesh:
    """As read_mesh_file, at the file's own size."""
    if not path.is_file():
        raise ModelError(f"mesh file {path} does not exist")
    extension = path.suffix.lower()
    if extension not in READABLE_EXTENSIONS:
        raise ModelError(
            f"mesh file {path}: '{extension}' is not a format that can be read; "
            f"use one of {', '.join(READABLE_EXTENSIONS)}"
        )
    mesh = _read_obj(path) if extension == ".obj" else _read_with_trimesh(path)
    if not np.all(np.isfinite(mesh.vertices)):
        raise ModelError(f"mesh file {path}: a vertex coordinate is not a finite number")
    mesh = merge_duplicate_vertices(mesh)
    if mesh.is_empty:
        raise ModelError(f"mesh file {path} holds no triangle: nothing would be drawn")
    return mesh


def _read_obj(path: Path) -> TriangleMesh:
    """An OBJ file as Drake itself reads it."""
    # Drake takes a coordinate that is not a number for zero.
    if re.search(rb"^v\s[^\n]*(nan|inf)", path.read_bytes(), re.MULTILINE | re.IGNORECASE):
        raise ModelError(f"mesh file {path}: a vertex coordinate is not a finite number")
    try:
        surface = ReadObjToTriangleSurfaceMesh(path)
    except RuntimeError as error:
        raise ModelError(f"mesh file {path} cannot be read: {error}") from error
    vertices = np.array(surface.vertices(), dtype=np.float64)
    triangles = np.array(
        [[face.vertex(corner) for corner in range(3)] for face in surface.triangles()],
        dtype=np.int32,
    ).reshape(-1, 3)
    if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise ModelError(f"mesh file {path}: a face names a vertex that does not exist")
    return TriangleMesh(vertices, triangles)


def _read_with_trimesh(path: Path) -> TriangleMesh:
    """A glTF, GLB, STL or DAE file, all its parts at their places."""
    import trimesh  # Slow to import, and needed for few models.

    try:
        surface = trimesh.load_mesh(str(path), process=False)
    except _reader_errors(path) as error:
        raise ModelError(f"mesh file {path} cannot be read: {error}") from error
    vertices = np.asarray(surface.vertices, dtype=np.float64)
    triangles = np.asarray(surface.faces, dtype=np.int64)
    if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise ModelError(f"mesh file {path}: a face names a vertex that does not exist")
    if path.suffix.lower() in (".gltf", ".glb"):
        vertices = vertices @ _R_DRAKE_GLTF.T
    return TriangleMesh(vertices, triangles.astype(np.int32))


def _reader_errors(path: Path) -> tuple[type[Exception], ...]:
    """What trimesh and its readers raise for broken files."""
    errors: tuple[type[Exception], ...] = (
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        OSError,
        EOFError,
        SyntaxError,
        struct.error,
    )
    if path.suffix.lower() != ".dae":
        return errors
    try:
        from collada.common import DaeError  # Needed for DAE files alone.
    except ModuleNotFoundError as error:
        raise ModelError(f"mesh file {path}: install 'pycollada' to read DAE files") from error
    return (*errors, DaeError)


def is_drawn_by_drake(path: Path) -> bool:
    """True where Drake's VTK renderer draws this mesh file: glTF, and OBJ with normals."""
    extension = path.suffix.lower()
    if extension == ".gltf":
        return True
    if extension != ".obj":
        return False
    with path.open("rb") as file:
        return any(line.startswith(b"vn") for line in file)


@functools.cache
def workspace() -> Path:
    """This process's temporary folder for converted files; it is removed at exit."""
    folder = tempfile.TemporaryDirectory(prefix="drake_pose_")
    atexit.register(folder.cleanup)
    return Path(folder.name)


def drawable_file(path: Path) -> Path:
    """An OBJ file with normals that shows what ``path`` shows, made on the first call.

    Raises:
        ModelError: as read_mesh_file.
    """
    import trimesh  # Slow to import, and needed for few models.

    path = path.resolve()
    stamp = f"{path}|{path.stat().st_mtime_ns if path.exists() else 0}"
    name = f"{path.stem}_{hashlib.sha256(stamp.encode()).hexdigest()[:16]}.obj"
    converted = workspace() / name
    if not converted.exists():
        mesh = read_mesh_file(path)
        surface = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
        text = trimesh.exchange.obj.export_obj(surface, include_normals=True, digits=12)
        converted.write_text(text, encoding="utf-8")
    return converted
