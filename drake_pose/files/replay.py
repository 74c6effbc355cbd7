"""replay.html: one page that plays an estimate in a browser, with no server."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams, MeshcatVisualizer, Rgba, SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_pose.body.model import ArticulatedModel
from drake_pose.body.tree.link_graph import PlantKinematics
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.systems.bodies import add_meshcat_skin, add_posed_plant

_BODY_PATH = "visualizer"
_CAMERA_COLOUR = Rgba(0.0, 0.45, 0.70, 1.0)
_CAMERA_SIZE = 0.15
_BESIDE = np.radians(20.0)


def make_replay(
    model: ArticulatedModel,
    positions: np.ndarray,
    X_WB: np.ndarray,
    cameras: Sequence[Camera],
    period: float,
) -> str:
    """The page that Meshcat records of poses of a body, and where the cameras are.

    Args:
        positions: (frames, nq) its positions [rad or m].
        X_WB: (frames, 4, 4) poses of the plant's world in the scene's world.
        period: time between two frames [s]; those a second or more apart stand still.
    """
    # Port 0: any free one. The server lives for a moment only, and listens on this machine alone.
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    finally:
        logger.setLevel(level)
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    source = builder.AddNamedSystem("positions", ConstantVectorSource(positions[0]))
    add_posed_plant(builder, scene_graph, model, source.get_output_port(), "geometry_pose")
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    add_meshcat_skin(
        builder, meshcat, model, source.get_output_port(), "body", prefix=_BODY_PATH, recorded=True
    )
    for camera in cameras:
        _draw_camera(meshcat, camera)
    _look_from(meshcat, cameras[0], _middle_of(model, positions[0], X_WB[0]))
    _record(meshcat, builder.Build(), source, positions, X_WB, period)
    return meshcat.StaticHtml()


def _record(
    meshcat: Meshcat,
    diagram: Diagram,
    source: ConstantVectorSource,
    positions: np.ndarray,
    X_WB: np.ndarray,
    period: float,
) -> None:
    """Publishes every frame at its time; stills once more just before the next."""
    context = diagram.CreateDefaultContext()
    value = source.get_mutable_source_value(source.GetMyMutableContextFromRoot(context))
    still = period >= 1.0
    offsets = (0.0, 0.9 * period) if still else (0.0,)
    meshcat.StartRecording(frames_per_second=10.0 / period if still else 1.0 / period)
    for index, (q, X) in enumerate(zip(positions, X_WB, strict=True)):
        value.SetFromVector(q)
        for offset in offsets:
            time = index * period + offset
            context.SetTime(time)
            diagram.ForcedPublish(context)
            meshcat.SetTransform(_BODY_PATH, RigidTransform(X), time)
    meshcat.StopRecording()
    meshcat.PublishRecording()


def _middle_of(model: ArticulatedModel, q: np.ndarray, X_WB: np.ndarray) -> np.ndarray:
    """Returns the mean position (3,) of the body's links in the scene's world."""
    kinematics = PlantKinematics(model)
    poses = [kinematics.pose_at(body, q) for body in range(1, model.plant.num_bodies())]
    return np.asarray((X_WB @ np.mean(poses, axis=0))[:3, 3])


def _draw_camera(meshcat: Meshcat, camera: Camera) -> None:
    """Draws a small pyramid that opens in the viewing direction."""
    corners = [(-1.0, -0.6), (1.0, -0.6), (1.0, 0.6), (-1.0, 0.6)]
    p_C = _CAMERA_SIZE * np.array([(0.0, 0.0, 0.0), *((x / 2, y / 2, 1.0) for x, y in corners)])
    p_W = p_C @ camera.X_WC[:3, :3].T + camera.X_WC[:3, 3]
    lines = [(0, k) for k in (1, 2, 3, 4)] + [(1, 2), (2, 3), (3, 4), (4, 1)]
    start, end = (p_W[[line[side] for line in lines]].T for side in (0, 1))
    meshcat.SetLineSegments(f"cameras/{camera.name}", start, end, 2.0, _CAMERA_COLOUR)


def _look_from(meshcat: Meshcat, camera: Camera, p_WT: np.ndarray) -> None:
    """Points the browser's view at a target, from beside a camera (or in its direction)."""
    p_TC_W = -3.0 * camera.X_WC[:3, 2]
    if isinstance(camera, PinholeCamera):
        p_TC_W = camera.X_WC[:3, 3] - p_WT
    # Exactly where the camera stands, its own drawing would be in the way.
    beside = RotationMatrix.MakeZRotation(_BESIDE).multiply(p_TC_W)
    meshcat.SetCameraPose(p_WT + 1.1 * beside, p_WT)
