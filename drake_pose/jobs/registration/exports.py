"""Cameras that were found, as other programs read them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.drake import dump_scenario
from drake_pose.camera.exports import mujoco_cameras, ros_camera_info, ros_transforms
from drake_pose.camera.models import Camera
from drake_pose.files.folder import write_file
from drake_pose.files.replay import Pictures, import_rerun, make_recording
from drake_pose.jobs.registration.inputs import Inputs

_DRAKE, _MUJOCO, _RERUN = "drake.yaml", "mujoco.xml", "rerun.rrd"
_LAUNCH = "ros/static_transforms.launch.xml"
# A link stands in the world's origin that is off by less [m and rad].
_ORIGIN = 1e-6


def check_exports(formats: Collection[str], cameras: Iterable[Camera]) -> None:
    """Refuses before any work what could not be written after it.

    Raises:
        CameraError: a camera that one of the formats does not have.
        OutputError: a library is missing.
    """
    if "rerun" in formats:
        import_rerun()
    _texts(formats, list(cameras), "world", {})


def write_exports(
    folder: Path,
    formats: Collection[str],
    inputs: Inputs,
    cameras: Iterable[Camera],
    links: Mapping[str, str],
    pictures: Pictures,
) -> None:
    """Writes files of other programs into a result's folder.

    Args:
        formats: of `ros`, `mujoco`, `drake` and `rerun`.
        cameras: whose poses are in the world, or in the frames of links.
        links: on which cameras ride, by camera's name.

    Raises:
        OutputError: they cannot be written.
    """
    cameras = list(cameras)
    for name, text in _texts(formats, cameras, _world(inputs.tree), links).items():
        write_file(folder, name, text)
    if "rerun" in formats:
        recording = make_recording(inputs.tree, cameras, inputs.frames, pictures)
        write_file(folder, _RERUN, recording)


def _texts(
    formats: Collection[str], cameras: list[Camera], world: str, links: Mapping[str, str]
) -> dict[str, str]:
    """Texts by file's name; world: what ROS calls the frame of cameras that ride on no link."""
    texts: dict[str, str] = {}
    if "ros" in formats:
        texts |= {f"ros/{camera.name}.yaml": ros_camera_info(camera) for camera in cameras}
        frames = {camera.name: links.get(camera.name, world) for camera in cameras}
        texts[_LAUNCH] = ros_transforms(cameras, frames)
    if "mujoco" in formats:
        texts[_MUJOCO] = mujoco_cameras(cameras)
    if "drake" in formats:
        texts[_DRAKE] = dump_scenario(cameras, links)
    return texts


def _world(tree: PoseTree) -> str:
    """What ROS calls the frame of a tree's world: the link that is fixed at its origin, if any."""
    kinematics = TreeKinematics(tree)
    poses = kinematics.poses(kinematics.flatten(tree.default_values()))
    for node, X_WN in zip(tree.nodes, poses, strict=True):
        if node.parent < 0 and not node.value_names and np.allclose(X_WN, np.eye(4), atol=_ORIGIN):
            return node.name
    return "world"
