"""Animations of estimates: replay.html, a Meshcat page without server, and rerun recordings."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Mesh,
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    Rgba,
    Role,
    SceneGraph,
    SourceId,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_pose.body import ArticulatedModel, PoseTree, TriangleMesh
from drake_pose.body.meshes import shape_mesh, write_obj
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import HALF_PIXEL, Camera, ParallelCamera, PinholeCamera
from drake_pose.errors import OutputError
from drake_pose.files.overlay import EXCESS_RGB
from drake_pose.fit.surfaces import reduce_meshes
from drake_pose.registration.posed_frames import MultiViewFrame
from drake_pose.systems.bodies import add_meshcat_skin, add_posed_plant, body_poses

_BODY_PATH, _MEASURED_PATH = "visualizer", "measured"


def make_replay(
    model: ArticulatedModel,
    positions: np.ndarray,
    X_WB: np.ndarray,
    cameras: Sequence[Camera],
    period: float,
    measured: np.ndarray | None = None,
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
    meshcat = open_meshcat(port=0)  # Port 0 is any free port.
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    source = builder.AddNamedSystem("positions", ConstantVectorSource(positions[0]))
    plant = add_posed_plant(builder, scene_graph, model, source.get_output_port(), "geometry_pose")
    _lighten(scene_graph, plant.get_source_id(), most_triangles)
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    add_meshcat_skin(
        builder, meshcat, model, source.get_output_port(), "body", prefix=_BODY_PATH,
        is_recorded=True,
    )  # fmt: skip
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
    _record(meshcat, builder.Build(), source, positions, X_WB, period, model, measured)
    return meshcat.StaticHtml()


def open_meshcat(**params: Any) -> Meshcat:
    """Return a Meshcat server that listens on the loopback address only; Drake logs no address.

    ``params``: fields of Drake's MeshcatParams. Raises RuntimeError: the port cannot be used.
    """
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        return Meshcat(MeshcatParams(host="localhost", **params))
    finally:
        logger.setLevel(level)


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


def _record(
    meshcat: Meshcat,
    diagram: Diagram,
    source: ConstantVectorSource,
    positions: np.ndarray,
    X_WB: np.ndarray,
    period: float,
    model: ArticulatedModel,
    measured: np.ndarray | None,
) -> None:
    """Record the animation of all frames, and publish it to Meshcat.

    Frame k is at k times ``period``; from a period of 1 s on it is repeated just before the next
    frame. positions, X_WB, period, model and measured are as in `make_replay`.

    ``meshcat``: the page. ``diagram``: diagram that publishes the body to the page. ``source``: the
    diagram's source of positions (nq,).
    """
    context = diagram.CreateDefaultContext()
    value = source.get_mutable_source_value(source.GetMyMutableContextFromRoot(context))
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


Pictures = Mapping[str, Mapping[str, NDArray[np.uint8]]]
"""Pictures (H, W, 3) by camera and frame."""


def import_rerun() -> Any:
    """Return the module rerun.

    Raises OutputError: rerun-sdk is not installed.
    """
    try:
        return import_module("rerun")
    except ImportError as error:
        raise OutputError(
            f"recordings for rerun need rerun-sdk: pip install 'drake_pose[rerun]' ({error})"
        ) from error


def make_recording(
    tree: PoseTree, cameras: Iterable[Camera], frames: Sequence[MultiViewFrame], pictures: Pictures
) -> bytes:
    """Return the bytes of a .rrd file of a body, cameras and their pictures.

    Args:
        tree: the body, in the frame of the cameras' X_WC.
        cameras: cameras; only pinhole cameras are shown.
        frames: values of the pose tree and masks of each frame, in the order of the timeline
            `frame`.
        pictures: pictures by camera and frame; pictures may be missing.

    Raises OutputError: rerun-sdk is not installed.
    """
    rr = import_rerun()
    recording = rr.RecordingStream("drake_pose")
    stream = recording.memory_recording()
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for node in tree.nodes:
        recording.log(["world", "body", node.name], _rerun_mesh(rr, node.mesh), static=True)
    shown = [one.name for one in cameras if _log_rerun_camera(rr, recording, one)]
    kinematics = TreeKinematics(tree)
    for k, frame in enumerate(frames):
        recording.set_time("frame", sequence=k)
        recording.log("frame", rr.TextLog(frame.name))
        values = kinematics.split(frame.values)
        for node, X_WN, own in zip(tree.nodes, kinematics.poses(frame.values), values, strict=True):
            recording.log(["world", "body", node.name], _rerun_pose(rr, X_WN))
            if node.skin is not None:
                recording.log(["world", "body", node.name], _rerun_mesh(rr, node.surface(own)))
        for name in (one for one in shown if one in frame.masks):
            place = ["world", name, "picture"]
            if (picture := pictures.get(name, {}).get(frame.name)) is not None:
                recording.log(place, rr.Image(picture).compress(jpeg_quality=90))
            mask = frame.masks[name].astype(np.uint8)
            recording.log([*place, "mask"], rr.SegmentationImage(mask))
    return bytes(stream.drain_as_bytes())


def _log_rerun_camera(rr: Any, recording: Any, camera: Camera) -> bool:
    """Log a pinhole camera's pose and intrinsics; log nothing and return False for another camera.

    ``rr`` is the module rerun, ``recording`` its RecordingStream.
    """
    if not isinstance(camera, PinholeCamera):
        return False
    place = ["world", camera.name]
    recording.log(place, _rerun_pose(rr, camera.X_WC), static=True)
    lens = rr.Pinhole(
        focal_length=[camera.focal_x, camera.focal_y],
        # The origin of rerun's pixel coordinates is the picture's corner.
        principal_point=[camera.center_x + HALF_PIXEL, camera.center_y + HALF_PIXEL],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
    )
    recording.log([*place, "picture"], lens, static=True)
    colours = rr.AnnotationContext([(1, "body", EXCESS_RGB)])
    recording.log([*place, "picture", "mask"], colours, static=True)
    return True


def _rerun_mesh(rr: Any, mesh: TriangleMesh) -> Any:
    """Return a mesh as a Mesh3D of the module rerun, ``rr``."""
    surface = mesh.vertices, mesh.triangles
    return rr.Mesh3D(vertex_positions=surface[0], triangle_indices=surface[1])


def _rerun_pose(rr: Any, X_AB: NDArray[np.float64]) -> Any:
    """Return a pose (4, 4) as a Transform3D of the module rerun, ``rr``."""
    return rr.Transform3D(translation=X_AB[:3, 3], mat3x3=X_AB[:3, :3])
