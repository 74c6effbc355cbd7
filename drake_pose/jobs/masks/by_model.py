"""Masks by the object's own model: pose and mask in turn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from drake_pose.body.model import load_model
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.errors import CameraError, SceneError
from drake_pose.jobs.estimate.inputs import make_tree
from drake_pose.jobs.masks.settings import MaskSettings
from drake_pose.jobs.masks.sources import CAMERAS, FoundMask, Source
from drake_pose.jobs.registration.positions import read_known_positions
from drake_pose.results.settings import EstimateSettings
from drake_pose.search.segmentation.pose_and_mask import (
    FoundPose,
    PoseAndMask,
    PoseAndMaskSettings,
)
from drake_pose.silhouette.pictures.scene_files import natural_key

# Pose and colours that overlap less do not agree, or hardly.
_REFUSED, _DOUBTED = 0.85, 0.9
# A value so many standard deviations from its start is suspicious.
_FAR = 3.0


def find_by_model(source: Source, model: Path, settings: MaskSettings) -> Iterator[FoundMask]:
    """The masks of a body whose pose is about known in each frame (``settings.start``).

    Raises:
        CameraError: a camera has no X_WC.
        SceneError: a frame has no row in the table of joint positions.
    """
    cameras = _placed_cameras(source)
    body = load_model(model, package_paths=settings.packages)
    kinematics = TreeKinematics(make_tree(body, EstimateSettings(hold=settings.hold), None))
    if settings.start is None:
        raise SceneError(f"{model}: needs rough joint positions of each frame (--start FILE.csv)")
    table = read_known_positions(settings.start, kinematics)
    seen = {
        name: {frame: (where, picture) for frame, where, picture in source.read(name)}
        for name in source.names
    }
    frames = sorted({frame for own in seen.values() for frame in own}, key=natural_key)
    starts = [
        table.of(frame, next(name for name in seen if frame in seen[name])) for frame in frames
    ]
    pictures = [
        [own[frame][1] if frame in own else None for own in seen.values()] for frame in frames
    ]
    search = PoseAndMask(
        kinematics, cameras, PoseAndMaskSettings(angle=math.radians(settings.start_error))
    )
    found = search.run(pictures, starts)
    warned = table.warnings
    for c, (name, own) in enumerate(seen.items()):
        for frame, pose in zip(frames, found, strict=True):
            mask = pose.masks[c]
            if mask is not None:
                where, picture = own[frame]
                refusal, warnings = _judge(pose, c, kinematics.names)
                yield FoundMask(name, frame, where, mask, picture, refusal, (*warned, *warnings))
                warned = ()


def _placed_cameras(source: Source) -> list[Camera]:
    """The cameras of all pictures, which have an X_WC."""
    if source.cameras is None:
        raise CameraError(
            f"{source.path}: a model's silhouette needs to know the cameras: {CAMERAS} or --cameras"
        )
    for name in source.names:
        if name in source.cameras.links:
            raise CameraError(
                f"{source.camera_file}: camera '{name}' rides on a link, but the background "
                "beside a body is told from cameras that stand still"
            )
        if name in source.cameras.unplaced:
            raise CameraError(
                f"{source.camera_file}: camera '{name}' needs X_WC: where it stands before the body"
            )
    return [source.cameras.cameras[name] for name in source.names]


def _judge(pose: FoundPose, camera: int, names: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """Why a mask is not good, and what is suspicious of it."""
    agreement = pose.agreements[camera]
    if agreement < _REFUSED:
        return (
            "pose and colours do not agree: the model's silhouette and what colours tell from the "
            f"background overlap by {agreement:.0%} (IoU); is the start too far off, the object "
            "hidden, or the model another?",
            (),
        )
    warnings = []
    if agreement < _DOUBTED:
        warnings.append(
            f"pose and colours hardly agree: they overlap by {agreement:.0%} (IoU); look at the "
            "overlay"
        )
    worst = int(np.argmax(np.abs(pose.deviations)))
    if abs(pose.deviations[worst]) > _FAR:
        warnings.append(
            f"joint {names[worst]} is {abs(pose.deviations[worst]):.1f} standard deviations from "
            "its start (--start-error); look at the overlay"
        )
    return "", tuple(warnings)
