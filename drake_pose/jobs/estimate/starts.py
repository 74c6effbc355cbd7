"""Where the body is in the first frame of a sequence, which colours alone do not say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.models import Camera
from drake_pose.errors import SceneError, SettingsError
from drake_pose.jobs.estimate.measurements import read_true_angles
from drake_pose.results.settings import EstimateSettings
from drake_pose.silhouette.pictures.scenes import Scene


def read_starts(
    scene: Scene,
    cameras: Sequence[Camera],
    frames: Sequence[str],
    model: ArticulatedModel,
    settings: EstimateSettings,
) -> dict[str, np.ndarray]:
    """The plant's positions (nq,) by frame, of ``settings.start``.

    Every picture is read once: a bad one is better met now than in the middle.

    Raises:
        SceneError: nothing says where the body is in the first frame, or a picture cannot be read.
        SettingsError: a start is given, or pictures without masks, where nothing is tracked.
    """
    starts = _read(frames, model, settings)
    if starts and not (scene.sequence and settings.track):
        raise SettingsError(
            f"{scene.path}: --start is where a track begins, but the frames are not tracked: "
            "scene.yaml needs sequence: true"
        )
    names = [camera.name for camera in cameras]
    bare = [
        frame
        for frame in frames
        if scene.images and not any((name, frame) in scene.masks for name in names)
    ]
    if not bare:
        return starts
    if not settings.track:
        raise SettingsError(
            f"{scene.path}: frame '{bare[0]}' has pictures but no mask, which can only be tracked "
            "by colour: leave --no-track out, or make masks (drake-pose masks)"
        )
    first = frames[0]
    if first in bare and first not in starts:
        where = f"masks/{names[0]}/{first}.png"
        raise SceneError(
            f"{scene.path}: nothing says where the body is in the first frame, '{first}': add its "
            f"mask {where} (drake-pose masks makes one), or its joint positions (--start FILE.csv)"
        )
    for name, frame in scene.images:
        if name in names and frame in frames:
            scene.read_image(name, frame)
    return starts


def _read(
    frames: Sequence[str], model: ArticulatedModel, settings: EstimateSettings
) -> dict[str, np.ndarray]:
    if settings.start is None:
        return {}
    known = read_true_angles(settings.start, model.position_names)
    places = [model.position_index(name) for name in known.names]
    starts = {}
    for frame in frames:
        values = known.of(frame)
        if values is not None:
            starts[frame] = model.default_positions.copy()
            starts[frame][places] = values
    if frames[0] not in starts:
        raise SceneError(
            f"{settings.start}: has no row of the first frame, '{frames[0]}', in which the track "
            "is to begin"
        )
    return starts
