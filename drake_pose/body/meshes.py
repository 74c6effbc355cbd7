"""Triangle meshes, read from mesh files and written as files that Drake's renderer draws."""

import functools
import hashlib
import io
import itertools
import re
import shutil
import struct
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from multiprocessing.util import Finalize
from operator import methodcaller
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Mesh,
    ReadObjToTriangleSurfaceMesh,
    RenderLabel,
    Role,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody

from drake_pose.arrays import Array
from drake_pose.errors import ModelError


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A surface of triangles, which need not be closed or connected. Immutable."""

    vertices: Array  # (n, 3) float64 points [m], usually in a link's frame.
    triangles: NDArray[np.int32]  # (m, 3) int32 indices of vertices.

    def __post_init__(self) -> None:
        """Store private read-only copies of the arrays."""
        vertices = np.array(self.vertices, dtype=np.float64).reshape(-1, 3)
        triangles = np.array(self.triangles, dtype=np.int32).reshape(-1, 3)
        vertices.setflags(write=False)
        triangles.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles)

    @staticmethod
    def empty() -> "TriangleMesh":
        """Return a mesh without triangles."""
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))

    @property
    def is_empty(self) -> bool:
        """Whether the mesh has no triangles."""
        return len(self.triangles) == 0

    def transformed(self, X_AB: Array) -> "TriangleMesh":
        """Return the surface in frame A, given this mesh in frame B and X_AB (4, 4)."""
        vertices_A = self.vertices @ X_AB[:3, :3].T + X_AB[:3, 3]
        return TriangleMesh(vertices_A, self.triangles)


def merge_duplicate_vertices(mesh: TriangleMesh) -> TriangleMesh:
    """Return the mesh with equal vertices merged, and without degenerate triangles."""
    if mesh.is_empty:
        return TriangleMesh.empty()
    # Five times as fast as np.unique over a million rows.
    by_place = np.lexsort(mesh.vertices.T)
    ordered = mesh.vertices[by_place]
    begins = np.concatenate([[True], np.any(ordered[1:] != ordered[:-1], axis=1)])
    first = np.empty_like(by_place)
    first[by_place] = by_place[begins][np.cumsum(begins) - 1]
    a, b, c = triangles = first[mesh.triangles].T
    triangles = triangles[:, (a != b) & (b != c) & (c != a)].T
    used, renumbered = np.unique(triangles, return_inverse=True)
    return TriangleMesh(mesh.vertices[used], renumbered.reshape(-1, 3).astype(np.int32))


def join_meshes(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Return one mesh with the triangles of several meshes, whose vertices are in one frame."""
    parts = [mesh for mesh in meshes if not mesh.is_empty]
    if not parts:
        return TriangleMesh.empty()
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in parts[:-1]])
    triangles = [mesh.triangles + offset for mesh, offset in zip(parts, offsets, strict=True)]
    return TriangleMesh(np.concatenate([m.vertices for m in parts]), np.concatenate(triangles))


def is_watertight(mesh: TriangleMesh) -> bool:
    """Return whether every edge is used exactly once in each of its two directions."""
    if mesh.is_empty:
        return False
    edges = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]]])
    edges = np.concatenate([edges, mesh.triangles[:, [2, 0]]]).astype(np.int64)
    count = len(mesh.vertices)
    forward = np.sort(edges[:, 0] * count + edges[:, 1])
    backward = np.sort(edges[:, 1] * count + edges[:, 0])
    return bool(np.all(np.diff(forward) > 0) and np.array_equal(forward, backward))


read_meshes: dict[Path, TriangleMesh] = {}
"""The 64 meshes read last, unscaled, by resolved file path."""


def read_mesh_file(path: Path, scale: Array | None = None) -> TriangleMesh:
    """Return the triangles of an OBJ, glTF, GLB, STL or DAE file, with duplicate vertices merged.

    The 64 files read last are not read again. ``scale``: (3,) factors along x, y and z; None: the
    file's own size.

    Raises ModelError: the extension is unknown, the file cannot be read or holds no triangle, or a
    coordinate is not finite.
    """
    path = path.resolve()
    if path not in read_meshes:
        read_meshes[path] = _read_unscaled(path)
        for old in list(read_meshes)[:-64]:
            del read_meshes[old]
    mesh = read_meshes[path]
    if scale is None:
        return mesh
    triangles = mesh.triangles if np.prod(scale) > 0 else mesh.triangles[:, ::-1]
    return TriangleMesh(mesh.vertices * scale, triangles)


def _read_unscaled(path: Path) -> TriangleMesh:
    """As ``read_mesh_file``, at the file's own size and without the cache."""
    if not path.is_file():
        raise ModelError(f"mesh file {path} does not exist")
    extension = path.suffix.lower()
    readers = {".obj": _read_obj, ".gltf": _read_gltf, ".glb": _read_gltf, ".stl": _read_stl}
    readers[".dae"] = _read_dae
    if extension not in readers:
        raise ModelError(
            f"mesh file {path}: '{extension}' is not a format that can be read; "
            f"use one of {', '.join(readers)}"
        )
    if path in _written:
        return _written[path]
    try:
        mesh = readers[extension](path)
    except OSError as error:
        raise ModelError(f"mesh file {path} cannot be read: {error.strerror or error}") from error
    if mesh.triangles.size and not (
        0 <= mesh.triangles.min() <= mesh.triangles.max() < len(mesh.vertices)
    ):
        raise ModelError(f"mesh file {path}: a face names a vertex that does not exist")
    if not np.all(np.isfinite(mesh.vertices)):
        raise ModelError(f"mesh file {path}: a vertex coordinate is not a finite number")
    mesh = merge_duplicate_vertices(mesh)
    if mesh.is_empty:
        raise ModelError(f"mesh file {path} holds no triangle: nothing would be drawn")
    return mesh


def _read_obj(path: Path) -> TriangleMesh:
    """Read an OBJ file as Drake does."""
    # Drake reads NaN and infinite coordinates as zero. Searching line by line is slow.
    data = path.read_bytes().lower()
    may_be_invalid = b"nan" in data or b"inf" in data
    if may_be_invalid and re.search(rb"^v\s[^\n]*(nan|inf)", data, re.MULTILINE):
        raise ModelError(f"mesh file {path}: a vertex coordinate is not a finite number")
    try:
        surface = ReadObjToTriangleSurfaceMesh(path)
    except RuntimeError as error:
        raise ModelError(f"mesh file {path} cannot be read: {error}") from error
    vertices = np.array(surface.vertices(), dtype=np.float64)
    faces = surface.triangles()
    corners = [
        np.fromiter(map(methodcaller("vertex", corner), faces), np.int32, len(faces))
        for corner in range(3)
    ]
    return TriangleMesh(vertices, np.stack(corners, axis=1))


def _read_gltf(path: Path) -> TriangleMesh:
    """Read a glTF or GLB file with all its parts in place."""
    mesh = _read_with_trimesh(path, path, path.suffix)
    # Up is y in glTF and z in Drake.
    x, y, z = mesh.vertices.T
    return TriangleMesh(np.stack([x, -z, y], axis=1), mesh.triangles)


def _read_stl(path: Path) -> TriangleMesh:
    """Read a binary STL file, whatever its header says, or a text one; ModelError if damaged."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * count and count > 0:
        triangle = np.dtype(
            [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
        )
        corners = np.frombuffer(data, triangle, offset=84)["corners"]
        order = np.arange(3 * count, dtype=np.int32)
        return TriangleMesh(corners.reshape(-1, 3), order)
    words = data.lower().split()
    if not words or not words[0].startswith(b"solid") or b"facet" not in words[:100]:
        raise ModelError(
            f"mesh file {path} declares {count} triangles, which take {84 + 50 * count} bytes, "
            f"but has {len(data)} bytes: it is truncated or damaged"
        )
    text = data.decode("ascii", "replace").replace("\ufffd", "?").encode()
    mesh = _read_with_trimesh(path, io.BytesIO(text), ".stl")
    count = max(words.count(b"facet"), words.count(b"vertex") // 3)
    if len(mesh.triangles) != count:
        raise ModelError(
            f"mesh file {path} has {count} facets, but {len(mesh.triangles)} can be read: it is "
            "truncated or damaged"
        )
    return mesh


def _read_dae(path: Path) -> TriangleMesh:
    """Read a COLLADA file in metres with all its parts in place; ignore materials."""
    try:
        import collada  # Slow to import, and needed for DAE files only.
    except ModuleNotFoundError as error:
        raise ModelError(f"mesh file {path}: install 'pycollada' to read DAE files") from error
    appearance = ("library_images", "library_effects", "library_materials", "bind_material")
    parts = []
    try:
        # pycollada drops triangles whose material names a missing texture.
        root = ElementTree.parse(path).getroot()
        for parent in list(root.iter()):
            parent[:] = [
                child for child in parent if child.tag.rpartition("}")[2] not in appearance
            ]
        document = collada.Collada(io.BytesIO(ElementTree.tostring(root)))
        if document.scene is None:
            raise ModelError(f"mesh file {path} has no scene: nothing would be drawn")
        for geometry in document.scene.objects("geometry"):
            for primitive in geometry.primitives():
                if hasattr(primitive, "triangleset"):
                    primitive = primitive.triangleset()
                if isinstance(primitive, collada.triangleset.BoundTriangleSet):
                    parts.append(TriangleMesh(primitive.vertex, primitive.vertex_index))
    except (*_READER_ERRORS, collada.common.DaeError) as error:
        raise ModelError(f"mesh file {path} cannot be read: {error}") from error
    mesh = join_meshes(parts)
    # As in RViz and Gazebo, <unit> is applied and <up_axis> ignored; pinocchio ignores <unit>.
    unit = document.assetInfo.unitmeter
    return TriangleMesh(mesh.vertices * (1.0 if unit is None else unit), mesh.triangles)


def _read_with_trimesh(path: Path, source: Path | io.BytesIO, extension: str) -> TriangleMesh:
    """Return the mesh that trimesh reads from ``source``, a file or its content.

    ``path`` names the file in messages; ``extension`` is its format, for example ".stl".
    """
    import trimesh  # Slow to import, and needed for few models.

    try:
        surface = trimesh.load_mesh(source, file_type=extension[1:].lower(), process=False)
    except _READER_ERRORS as error:
        raise ModelError(f"mesh file {path} cannot be read: {error}") from error
    return TriangleMesh(surface.vertices, surface.faces)


# The exceptions that trimesh, pycollada and their readers raise for broken files.
_READER_ERRORS = (
    ValueError, LookupError, TypeError, AttributeError, OSError, EOFError, SyntaxError,
    struct.error,
)  # fmt: skip


def is_drawn_by_drake(path: Path) -> bool:
    """Return whether Drake's VTK renderer draws a mesh file: glTF, or OBJ with normals."""
    extension = path.suffix.lower()
    if extension == ".gltf":
        return True
    if extension != ".obj":
        return False
    data = path.read_bytes()
    return data.startswith(b"vn") or b"\nvn" in data


@functools.cache
def workspace() -> Path:
    """Return this process's temporary folder for converted files, which is removed at exit."""
    folder = tempfile.mkdtemp(prefix="drake_pose_")
    # atexit does not run in processes of multiprocessing. A fork does not inherit Finalize, so
    # only the process that made the folder removes it.
    Finalize(None, shutil.rmtree, (folder, True), exitpriority=0)
    return Path(folder)


# The meshes of the files that write_obj wrote, which need not be read again.
_written: dict[Path, TriangleMesh] = {}


@functools.cache  # By identity, as a mesh is not hashed again each time its model is loaded.
def write_obj(mesh: TriangleMesh, name: str) -> Path:
    """Write an OBJ file with normals in a temporary folder; meshes equal in ``name`` share it."""
    digest = hashlib.sha256(mesh.vertices.tobytes() + mesh.triangles.tobytes()).hexdigest()[:16]
    path = workspace() / f"{re.sub(r'[^A-Za-z0-9_-]', '_', name)}_{digest}.obj"
    if path in _written or path.exists():
        _written[path] = mesh
        return path
    # Vertex normals are area-weighted means of triangle normals.
    triangles = mesh.triangles
    a, b, c = (mesh.vertices[triangles[:, corner]] for corner in range(3))
    area_normals = np.cross(b - a, c - a)
    corners, count = triangles.ravel(), len(mesh.vertices)
    sums = [np.bincount(corners, np.repeat(one, 3), count) for one in area_normals.T]
    normals = np.stack(sums, axis=1)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    # If this process crashes, its parent process finds a complete file or none.
    unfinished = path.with_suffix(".part")
    with unfinished.open("w", encoding="ascii") as file:
        _write_lines(file, "v %.15g %.15g %.15g\n", mesh.vertices)
        _write_lines(file, "vn %.4g %.4g %.4g\n", normals)
        _write_lines(file, "f %d//%d %d//%d %d//%d\n", np.repeat(triangles + 1, 2, axis=1))
    unfinished.replace(path)
    _written[path] = mesh
    return path


def _write_lines(file: TextIO, line: str, rows: NDArray[Any]) -> None:
    """Write one line per row (n, k), in large chunks, by ``line``, a %-format of k numbers."""
    for start in range(0, len(rows), 65536):
        chunk = rows[start : start + 65536]
        file.write((line * len(chunk)) % tuple(chunk.ravel().tolist()))


def shape_mesh(shape: Shape) -> TriangleMesh:
    """Return a Drake shape as triangles in its own frame; ModelError if it has no surface."""
    if isinstance(shape, Box):
        ends = (-0.5, 0.5)
        corners = np.array([[x, y, z] for x in ends for y in ends for z in ends])
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        triangles = [(a, b, c) for a, b, c, _ in faces] + [(a, c, d) for a, _, c, d in faces]
        return TriangleMesh(corners * shape.size(), np.array(triangles, dtype=np.int32))
    if isinstance(shape, Sphere):
        return _ellipsoid_mesh(*[shape.radius()] * 3)
    if isinstance(shape, Ellipsoid):
        return _ellipsoid_mesh(shape.a(), shape.b(), shape.c())
    # Drake rotates VTK's cylinder by a quarter turn, so the first vertex lies on y.
    if isinstance(shape, Cylinder):
        half, radii = 0.5 * shape.length(), shape.radius() * np.array([0.0, 1.0, 1.0, 0.0])
        return _round_mesh(radii, np.array([half, half, -half, -half]), np.pi / 2.0)
    if isinstance(shape, Capsule):
        quarter, half = np.linspace(0.0, np.pi / 2.0, 49), 0.5 * shape.length()
        radii, heights = shape.radius() * np.sin(quarter), shape.radius() * np.cos(quarter) + half
        profile = np.concatenate([radii, radii[::-1]]), np.concatenate([heights, -heights[::-1]])
        return _round_mesh(*profile, np.pi / 2.0)
    if isinstance(shape, (Mesh, Convex)) and not shape.source().is_path():
        raise ModelError("an in-memory mesh cannot be read; write it to a file")
    if isinstance(shape, Mesh):
        return read_mesh_file(Path(shape.source().path()), np.asarray(shape.scale3()))
    if not isinstance(shape, Convex):
        raise ModelError(f"a {type(shape).__name__} cannot be drawn as triangles")
    # The convex hull of a mesh file, its polygons split into triangle fans.
    path = Path(shape.source().path())
    read_mesh_file(path)
    try:
        hull = shape.GetConvexHull()
    except RuntimeError as error:
        raise ModelError(f"mesh file {path} has no convex hull: {error}") from error
    fans = list[tuple[int, int, int]]()
    for face in range(hull.num_elements()):
        polygon = hull.element(face)
        first, *others = (polygon.vertex(corner) for corner in range(polygon.num_vertices()))
        fans += [(first, b, c) for b, c in itertools.pairwise(others)]
    vertices = np.array([hull.vertex(index) for index in range(hull.num_vertices())])
    return merge_duplicate_vertices(TriangleMesh(vertices, np.array(fans, dtype=np.int32)))


def labelled_meshes(
    plant: MultibodyPlant, scene_graph: SceneGraph, body: RigidBody
) -> dict[int, TriangleMesh]:
    """Return the rendered geometry of one body in its frame, by Drake's integer render label.

    Ground planes and geometry labelled "do not render" are left out. ``scene_graph`` is the one
    with which the plant is registered.

    Raises ModelError, which names the link: a shape cannot be drawn.
    """
    inspector = scene_graph.model_inspector()
    meshes: dict[int, list[TriangleMesh]] = {}
    for geometry in plant.GetVisualGeometriesForBody(body):
        properties = inspector.GetPerceptionProperties(geometry)
        shape = inspector.GetShape(geometry)
        if properties is None or isinstance(shape, HalfSpace):
            continue
        label = int(properties.GetPropertyOrDefault("label", "id", RenderLabel.kDontCare))
        if label == int(RenderLabel.kDoNotRender):
            continue
        X_BG = np.array(inspector.GetPoseInFrame(geometry).GetAsMatrix4(), dtype=np.float64)
        try:
            meshes.setdefault(label, []).append(shape_mesh(shape).transformed(X_BG))
        except ModelError as error:
            raise ModelError(f"link '{body.name()}': {error}") from error
    return {label: join_meshes(parts) for label, parts in meshes.items()}


def make_drawable(
    plant: MultibodyPlant, scene_graph: SceneGraph | None, instances: Iterable[ModelInstanceIndex]
) -> None:
    """Replace mesh files that Drake's renderer would silently skip, and hide ground planes.

    STL, DAE and GLB files and OBJ files without normals are replaced by OBJ files with normals in a
    temporary folder. A half space loses its perception role. The world body's geometry is included.

    ``plant``: the plant that registered the geometry. ``scene_graph``: the SceneGraph with the
    geometry; None: a file that must be replaced is an error. ``instances``: the model instances
    whose bodies are processed.

    Raises ModelError: a mesh file cannot be drawn, or ``scene_graph`` is missing.
    """
    bodies = [plant.get_body(index) for i in instances for index in plant.GetBodyIndices(i)]
    source = plant.get_source_id()
    if source is None:
        return
    for body in [plant.world_body(), *bodies]:
        for geometry in plant.GetVisualGeometriesForBody(body):
            if scene_graph is None:
                raise ModelError(
                    "add_to needs the scene_graph the plant is registered with, "
                    "because mesh files may have to be converted"
                )
            inspector = scene_graph.model_inspector()
            if inspector.GetPerceptionProperties(geometry) is None:
                continue
            shape = inspector.GetShape(geometry)
            if isinstance(shape, HalfSpace):
                scene_graph.RemoveRole(source, geometry, Role.kPerception)
            elif isinstance(shape, (Mesh, Convex)) and shape.source().is_path():
                path = Path(shape.source().path())
                if path.is_file() and is_drawn_by_drake(path):
                    continue
                scale: Any = shape.scale3()  # Drake's type stubs do not accept numpy's array type.
                try:
                    replacement = type(shape)(
                        write_obj(read_mesh_file(path), path.resolve().stem), scale
                    )
                except ModelError as error:
                    raise ModelError(f"link '{body.name()}': {error}") from error
                scene_graph.ChangeShape(source, geometry, replacement)


def draws_given_files(scene_graph: SceneGraph) -> bool:
    """Return whether Drake's renderer reads meshes or textures not written by this package."""
    inspector = scene_graph.model_inspector()
    for geometry in inspector.GetAllGeometryIds(Role.kPerception):
        shape = inspector.GetShape(geometry)
        is_file = isinstance(shape, (Mesh, Convex)) and shape.source().is_path()
        if is_file and Path(shape.source().path()) not in _written:
            return True
        if inspector.GetPerceptionProperties(geometry).HasProperty("phong", "diffuse_map"):
            return True
    return False


def _round_mesh(
    radii: Array, heights: Array, start_angle: float, resolution: int = 50
) -> TriangleMesh:
    """Return a closed surface of revolution about z.

    ``radii``, ``heights``: (n,) of its rings, from the top down [m]. ``start_angle``: of each
    ring's first vertex, from x [rad]. ``resolution``: number of vertices of a ring.
    """
    angle = start_angle + np.arange(resolution) * (2.0 * np.pi / resolution)
    level = np.broadcast_to(heights[:, None], (len(heights), resolution))
    points = np.stack([np.outer(radii, np.cos(angle)), np.outer(radii, np.sin(angle)), level], -1)
    index = np.arange(level.size).reshape(level.shape)
    above, below = index[:-1], index[1:]
    above_next, below_next = np.roll(above, -1, axis=1), np.roll(below, -1, axis=1)
    triangles = [(above, below, below_next), (above, below_next, above_next)]
    corners = np.concatenate([np.stack(three, axis=-1).reshape(-1, 3) for three in triangles])
    return merge_duplicate_vertices(TriangleMesh(points.reshape(-1, 3), corners.astype(np.int32)))


def _ellipsoid_mesh(a: float, b: float, c: float) -> TriangleMesh:
    """Return an ellipsoid with half axes a, b, c [m] along x, y and z."""
    polar = np.linspace(0.0, np.pi, 51)
    sine = np.sin(polar)
    sine[[0, -1]] = 0.0  # Without rounding, so that each pole becomes one vertex.
    ball = _round_mesh(sine, np.cos(polar), 0.0)
    return TriangleMesh(ball.vertices * (a, b, c), ball.triangles)
