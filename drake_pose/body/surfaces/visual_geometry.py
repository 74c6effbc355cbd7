"""What Drake draws, read back from SceneGraph (perception role): visual geometry as triangles.

Primitive shapes have the surface of Drake's VTK renderer. Sources: RobotLocomotion/drake
``geometry/render_vtk/internal_render_engine_vtk_base.cc`` (resolutions), Kitware/VTK
``vtkTexturedSphereSource`` and ``vtkCylinderSource`` (vertices).
"""

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Mesh,
    RenderLabel,
    Role,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody

from drake_pose.arrays import Array
from drake_pose.body.surfaces.meshes import (
    TriangleMesh,
    drawable_file,
    is_drawn_by_drake,
    join_meshes,
    merge_duplicate_vertices,
    read_mesh_file,
    was_written,
)
from drake_pose.errors import ModelError

_VTK_RESOLUTION = 50


def shape_mesh(shape: Shape) -> TriangleMesh:
    """A Drake shape as triangles in its own frame; ModelError where it has no surface here."""
    if isinstance(shape, Box):
        return _box_mesh(shape.width(), shape.depth(), shape.height())
    if isinstance(shape, Sphere):
        return _ellipsoid_mesh(*[shape.radius()] * 3)
    if isinstance(shape, Cylinder):
        return _cylinder_mesh(shape.radius(), shape.length())
    if isinstance(shape, Capsule):
        return _capsule_mesh(shape.radius(), shape.length())
    if isinstance(shape, Ellipsoid):
        return _ellipsoid_mesh(shape.a(), shape.b(), shape.c())
    if isinstance(shape, (Mesh, Convex)) and not shape.source().is_path():
        raise ModelError("a mesh that lies in memory cannot be read; write it to a file")
    if isinstance(shape, Mesh):
        return read_mesh_file(Path(shape.source().path()), np.asarray(shape.scale3()))
    if isinstance(shape, Convex):
        return _convex_mesh(shape)
    raise ModelError(f"a {type(shape).__name__} cannot be drawn as triangles")


def _convex_mesh(shape: Convex) -> TriangleMesh:
    """The convex hull of a mesh file, its polygons cut into fans."""
    path = Path(shape.source().path())
    read_mesh_file(path)
    try:
        hull = shape.GetConvexHull()
    except RuntimeError as error:
        raise ModelError(f"mesh file {path} has no convex hull: {error}") from error
    triangles = []
    for face in range(hull.num_elements()):
        polygon = hull.element(face)
        corners = [polygon.vertex(corner) for corner in range(polygon.num_vertices())]
        triangles += [(corners[0], b, c) for b, c in itertools.pairwise(corners[1:])]
    vertices = np.array([hull.vertex(index) for index in range(hull.num_vertices())])
    return merge_duplicate_vertices(TriangleMesh(vertices, np.array(triangles, dtype=np.int32)))


def body_mesh(plant: MultibodyPlant, scene_graph: SceneGraph, body: RigidBody) -> TriangleMesh:
    """One body's visual geometry in its frame, less ground planes; ModelError names the link."""
    return join_meshes(list(labelled_meshes(plant, scene_graph, body).values()))


def labelled_meshes(
    plant: MultibodyPlant, scene_graph: SceneGraph, body: RigidBody
) -> dict[int, TriangleMesh]:
    """What is rendered of a body, in its frame, by render label; ModelError names the link."""
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
    """Replace mesh files that Drake's renderer would silently not draw, and hide ground planes.

    STL, DAE, GLB and OBJ without normals become OBJ with normals in a temporary folder. A half
    space loses its perception role. The world's own geometry is looked at with the instances'.

    Raises ModelError: a mesh file cannot be drawn, or one must be replaced and scene_graph is None.
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
                try:
                    replacement = _drawable_shape(shape)
                except ModelError as error:
                    raise ModelError(f"link '{body.name()}': {error}") from error
                if replacement is not None:
                    scene_graph.ChangeShape(source, geometry, replacement)


def draws_given_files(scene_graph: SceneGraph) -> bool:
    """Whether Drake's renderer reads files that were not written here: meshes, or textures."""
    inspector = scene_graph.model_inspector()
    for geometry in inspector.GetAllGeometryIds(Role.kPerception):
        shape, looks = inspector.GetShape(geometry), inspector.GetPerceptionProperties(geometry)
        is_file = isinstance(shape, (Mesh, Convex)) and shape.source().is_path()
        if is_file and not was_written(Path(shape.source().path())):
            return True
        if looks.HasProperty("phong", "diffuse_map"):
            return True
    return False


def _drawable_shape(shape: Mesh | Convex) -> Mesh | Convex | None:
    """What stands in for a mesh file that Drake's renderer does not draw; None: it draws it."""
    path = Path(shape.source().path())
    if path.is_file() and is_drawn_by_drake(path):
        return None
    scale: Any = shape.scale3()  # Drake's type stubs name no array type that numpy has.
    return type(shape)(drawable_file(path), scale)


def _box_mesh(width: float, depth: float, height: float) -> TriangleMesh:
    """A box centred at the origin, with edges [m] along x, y and z."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [(a, b, c) for a, b, c, _ in faces] + [(a, c, d) for a, _, c, d in faces]
    return TriangleMesh(corners * (width, depth, height), np.array(triangles, dtype=np.int32))


def _round_mesh(radii: Array, heights: Array, first: float = 0.0) -> TriangleMesh:
    """A surface about z, closed between rings of radii (n,) at heights (n,) [m], the highest first.

    The first vertex of each ring lies at the angle ``first`` [rad] from x.
    """
    angle = first + np.arange(_VTK_RESOLUTION) * (2.0 * np.pi / _VTK_RESOLUTION)
    level = np.broadcast_to(heights[:, None], (len(heights), _VTK_RESOLUTION))
    points = np.stack([np.outer(radii, np.cos(angle)), np.outer(radii, np.sin(angle)), level], -1)
    index = np.arange(level.size).reshape(level.shape)
    above, below = index[:-1], index[1:]
    above_next, below_next = np.roll(above, -1, axis=1), np.roll(below, -1, axis=1)
    triangles = [(above, below, below_next), (above, below_next, above_next)]
    corners = np.concatenate([np.stack(three, axis=-1).reshape(-1, 3) for three in triangles])
    return merge_duplicate_vertices(TriangleMesh(points.reshape(-1, 3), corners.astype(np.int32)))


def _ellipsoid_mesh(a: float, b: float, c: float) -> TriangleMesh:
    """An ellipsoid with half axes a, b, c [m] along x, y and z."""
    polar = np.linspace(0.0, np.pi, _VTK_RESOLUTION + 1)
    sine = np.sin(polar)
    sine[[0, -1]] = 0.0  # Both poles are exact.
    ball = _round_mesh(sine, np.cos(polar))
    return TriangleMesh(ball.vertices * (a, b, c), ball.triangles)


def _cylinder_mesh(radius: float, length: float) -> TriangleMesh:
    """A cylinder along z, centred at the origin, of the given radius and length [m]."""
    # Drake turns VTK's cylinder a quarter about its axis, so the first vertex lies on y.
    half = 0.5 * length
    radii = np.array([0.0, radius, radius, 0.0])
    return _round_mesh(radii, np.array([half, half, -half, -half]), np.pi / 2.0)


def _capsule_mesh(radius: float, length: float) -> TriangleMesh:
    """A capsule along z, centred at the origin; length [m] is that of its cylindrical part."""
    quarter = np.linspace(0.0, np.pi / 2.0, _VTK_RESOLUTION - 1)
    radii, heights = radius * np.sin(quarter), radius * np.cos(quarter) + 0.5 * length
    every = np.concatenate([radii, radii[::-1]]), np.concatenate([heights, -heights[::-1]])
    return _round_mesh(*every, np.pi / 2.0)
