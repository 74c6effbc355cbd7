"""Animations of estimates: replay.html, a Meshcat page without server."""

import logging
from collections.abc import Sequence
from itertools import product

import numpy as np
from pydrake.geometry import Mesh, Meshcat, MeshcatParams, Rgba, Role, SceneGraph, SourceId
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_pose.body import ArticulatedModel
from drake_pose.body.meshes import shape_mesh, write_obj
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.fit.surfaces import reduce_meshes
from drake_pose.systems.bodies import add_posed_plant, body_poses, show_in_meshcat

_BODY_PATH, _MEASURED_PATH = "visualizer", "measured"


def make_replay(
    model: ArticulatedModel,
    positions: np.ndarray,
    X_WB: np.ndarray,
    cameras: Sequence[Camera],
    period: float,
    measured: np.ndarray | None,
    most_triangles: int = 8_000,
) -> str:
    """Return the HTML page of a Meshcat animation of a body and the cameras.

    Args:
        model: the body's model.
        positions: (frames, nq) positions [rad or m].
        X_WB: (frames, 4, 4) poses of the plant's world in the scene's world.
        cameras: cameras to draw; the view starts near the first one.
        period: time between two frames [s]; from 1 s on, the body stands still between frames.
        measured: (frames, nq) positions of a ghost of the body; None: no ghost.
        most_triangles: maximum number of triangles of the body; a ghost has at most half of it. A
            triangle takes about 100 bytes.
    """
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)  # Drake logs the server's address.
    try:
        meshcat = Meshcat(MeshcatParams(host="localhost", port=0))  # Port 0 is any free port.
    finally:
        logger.setLevel(level)
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    source = builder.AddNamedSystem("positions", ConstantVectorSource(positions[0]))
    plant = add_posed_plant(builder, scene_graph, model, source.get_output_port())
    _lighten(scene_graph, plant.get_source_id(), most_triangles)
    show_in_meshcat(
        builder, scene_graph, meshcat, model, source.get_output_port(), _BODY_PATH, is_recorded=True
    )
    own = [*model.link_meshes.values()]
    ghosts = [] if measured is None else reduce_meshes(own, most_triangles // 2)
    for link, mesh in zip(model.link_meshes, ghosts, strict=False):
        surface = mesh.vertices.T, mesh.triangles.T
        meshcat.SetTriangleMesh(f"{_MEASURED_PATH}/{link}", *surface, Rgba(0.0, 0.62, 0.45, 0.4))
    shown = [positions] if measured is None else [positions, measured]
    p_WO, radius = _extent(model, np.concatenate(shown), np.concatenate(len(shown) * [X_WB]))
    for camera in cameras:
        _draw_camera(meshcat, camera, p_WO, radius)
    # View the body from the direction of the first camera, turned so that its frustum is not in the
    # way. Meshcat's field of view of 75 degrees shows a whole ball from 1.65 radii.
    p_OC_W = cameras[0].X_WC[:3, 3] - p_WO
    if isinstance(cameras[0], ParallelCamera):
        p_OC_W = -cameras[0].X_WC[:3, 2]
    beside = RotationMatrix.MakeZRotation(np.radians(20.0)).multiply(p_OC_W)
    meshcat.SetCameraPose(p_WO + 1.7 * radius * beside / np.linalg.norm(beside), p_WO)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    value = source.get_mutable_source_value(source.GetMyMutableContextFromRoot(context))
    # From a period of 1 s on, a frame is repeated just before the next one.
    still = period >= 1.0
    offsets = (0.0, 0.9 * period) if still else (0.0,)
    meshcat.StartRecording(frames_per_second=10.0 / period if still else 1.0 / period)
    for index, (q, X) in enumerate(zip(positions, X_WB, strict=True)):
        value.SetFromVector(q)
        poses = {_BODY_PATH: RigidTransform(X)}
        if measured is not None:
            of_bodies = body_poses(model.plant, measured[index], X)
            poses |= {
                f"{_MEASURED_PATH}/{link}": of_bodies[model.link_index(link)]
                for link in model.link_meshes
            }
        for offset in offsets:
            time = index * period + offset
            context.SetTime(time)
            diagram.ForcedPublish(context)
            for path, pose in poses.items():
                meshcat.SetTransform(path, pose, time)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return meshcat.StaticHtml()


def _lighten(scene_graph: SceneGraph, source: SourceId, most: int) -> None:
    """Simplify illustration meshes of a scene graph to at most ``most`` triangles in all.

    ``source`` is the geometry source of the meshes, such as a plant's; others stay unchanged.
    """
    inspector = scene_graph.model_inspector()
    shown = {
        one: shape
        for one in inspector.GetAllGeometryIds(Role.kIllustration)
        if inspector.BelongsToSource(one, source)
        and isinstance(shape := inspector.GetShape(one), Mesh)
    }
    meshes = [shape_mesh(one) for one in shown.values()]
    for one, mesh, light in zip(shown, meshes, reduce_meshes(meshes, most), strict=True):
        if light is not mesh:
            scene_graph.ChangeShape(source, one, Mesh(write_obj(light, "replay")))


def _extent(
    model: ArticulatedModel, positions: np.ndarray, X_WB: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return centre (3,) in the world and radius [m] of the body's bounding box, over all frames.

    positions (frames, nq) and X_WB (frames, 4, 4) are as in `make_replay`.
    """
    boxes = {
        model.link_index(link): np.array(
            [*product(*np.c_[mesh.vertices.min(0), mesh.vertices.max(0)])]
        ).T
        for link, mesh in model.link_meshes.items()
    }
    corners = []
    for q, X in zip(positions, X_WB, strict=True):
        poses = body_poses(model.plant, q, X)
        corners += [poses[body].multiply(box) for body, box in boxes.items()]
    low, high = np.hstack(corners).min(axis=1), np.hstack(corners).max(axis=1)
    return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))


def _draw_camera(
    meshcat: Meshcat, camera: Camera, p_WO: np.ndarray, radius: float, length: float = 0.25
) -> None:
    """Draw a camera's frustum; that of a parallel camera begins outside the object.

    ``p_WO``, ``radius``: centre (3,) of the object in the world, and its radius [m]. ``length``:
    length of the frustum, in radii.
    """
    parallel, f_x, f_y, c_x, c_y, *_ = camera.kernel_parameters()
    across, down = np.array([0, 1, 1, 0]), np.array([0, 0, 1, 1])
    x, y = (camera.width * across - 0.5 - c_x) / f_x, (camera.height * down - 0.5 - c_y) / f_y
    depth, (*_, z_WC, p_WC) = length * radius, camera.X_WC[:3].T
    far = np.column_stack([x, y, np.ones(4)]) * [1.0, 1.0, depth]
    near = far * [1.0, 1.0, 0.0]
    if parallel:
        p_WC = p_WC + z_WC * (z_WC @ (p_WO - p_WC) - 2.0 * radius)
    else:
        far[:, :2] *= depth
        near *= 0.0
    p_W = np.concatenate([near, far]) @ camera.X_WC[:3, :3].T + p_WC
    lines = [(k, 4 + k) for k in range(4)] + [(4 + k, 4 + (k + 1) % 4) for k in range(4)]
    start, end = (p_W[[line[side] for line in lines]].T for side in (0, 1))
    blue = Rgba(0.0, 0.45, 0.70, 1.0)
    meshcat.SetLineSegments(f"cameras/{camera.name}", start, end, 2.0, blue)
