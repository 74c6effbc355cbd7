"""A recording for the rerun viewer: a body, cameras, what they show, frame by frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.surfaces.meshes import TriangleMesh
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import HALF_PIXEL, Camera, PinholeCamera
from drake_pose.errors import OutputError
from drake_pose.files.overlay import EXCESS_RGB
from drake_pose.registration.posed_frames import SeenFrame

Pictures = Mapping[str, Mapping[str, NDArray[np.uint8]]]
"""Pictures (H, W, 3) by camera and frame."""


def import_rerun() -> Any:
    """The library rerun of the extra `rerun`; OutputError without it."""
    try:
        return import_module("rerun")
    except ImportError as error:
        raise OutputError(
            f"recordings for rerun are written by rerun-sdk: pip install 'drake_pose[rerun]' "
            f"({error})"
        ) from error


def make_recording(
    tree: PoseTree, cameras: Iterable[Camera], frames: Sequence[SeenFrame], pictures: Pictures
) -> bytes:
    """The bytes of a file .rrd.

    Args:
        tree: the body, in the world or whatever the cameras' X_WC are given in.
        cameras: pinholes are shown.
        frames: in the order of the timeline `frame`.

    Raises OutputError: rerun-sdk is not installed.
    """
    rr = import_rerun()
    recording = rr.RecordingStream("drake_pose")
    stream = recording.memory_recording()
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for node in tree.nodes:
        recording.log(["world", "body", node.name], _mesh(rr, node.mesh), static=True)
    shown = [one.name for one in cameras if _log_camera(rr, recording, one)]
    kinematics = TreeKinematics(tree)
    for k, frame in enumerate(frames):
        recording.set_time("frame", sequence=k)
        recording.log("frame", rr.TextLog(frame.name))
        values = kinematics.split(frame.values)
        for node, X_WN, own in zip(tree.nodes, kinematics.poses(frame.values), values, strict=True):
            recording.log(["world", "body", node.name], _transform(rr, X_WN))
            if node.skin is not None:
                recording.log(["world", "body", node.name], _mesh(rr, node.surface(own)))
        for name in (one for one in shown if one in frame.masks):
            place = ["world", name, "picture"]
            if (picture := pictures.get(name, {}).get(frame.name)) is not None:
                recording.log(place, rr.Image(picture).compress(jpeg_quality=90))
            mask = frame.masks[name].astype(np.uint8)
            recording.log([*place, "mask"], rr.SegmentationImage(mask))
    return bytes(stream.drain_as_bytes())


def _log_camera(rr: Any, recording: Any, camera: Camera) -> bool:
    """Logs a pinhole's pose and lens; False: it is none."""
    if not isinstance(camera, PinholeCamera):
        return False
    place = ["world", camera.name]
    recording.log(place, _transform(rr, camera.X_WC), static=True)
    lens = rr.Pinhole(
        focal_length=[camera.focal_x, camera.focal_y],
        # rerun counts from the picture's corner.
        principal_point=[camera.center_x + HALF_PIXEL, camera.center_y + HALF_PIXEL],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
    )
    recording.log([*place, "picture"], lens, static=True)
    colours = rr.AnnotationContext([(1, "body", EXCESS_RGB)])
    recording.log([*place, "picture", "mask"], colours, static=True)
    return True


def _mesh(rr: Any, mesh: TriangleMesh) -> Any:
    surface = mesh.vertices, mesh.triangles
    return rr.Mesh3D(vertex_positions=surface[0], triangle_indices=surface[1])


def _transform(rr: Any, X_AB: NDArray[np.float64]) -> Any:
    return rr.Transform3D(translation=X_AB[:3, 3], mat3x3=X_AB[:3, :3])
