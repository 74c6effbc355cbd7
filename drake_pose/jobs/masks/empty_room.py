"""Masks by comparison with the empty room."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drake_pose.camera.picture_files import SUFFIXES, Picture, read_picture
from drake_pose.camera.sources.recorded import find_picture_files
from drake_pose.errors import SceneError, SettingsError
from drake_pose.jobs.masks.found import FoundMask, FoundMasks
from drake_pose.jobs.masks.settings import MEDIAN
from drake_pose.jobs.masks.sources import Source
from drake_pose.silhouette.segmentation.background import (
    Background,
    background_of_recording,
    background_support,
    learn_background,
    person_region,
)

BACKGROUND = "background"

# So many pictures of a recording make its median.
_MOST = 60
# Where less than this share of a recording shows the median it may be the body's.
_SUPPORT = 0.75
# A background is not good where so much of the masks is in doubt.
_DOUBTFUL = 0.5
# The light or the camera has changed where so much of a picture is off.
_CHANGED = 0.6


def compare_with_empty_room(source: Source, background: Path | str) -> FoundMasks:
    """Masks of what differs from the background.

    Args:
        source: pictures or videos.
        background: as of ``MaskSettings.background``.

    Raises:
        SceneError: a camera has no background, or one of another size.
        SettingsError: a recording too short for a median.
    """
    known = {name: _background(source, name, background) for name in source.names}
    for name, (room, recording) in known.items():
        doubt = _doubt(room, recording) if recording else ""
        for frame, where, picture in source.read(name):
            if picture.shape != room.mean.shape:
                height, width = room.mean.shape[:2]
                raise SceneError(
                    f"{where}: is not of the background's size, {width} x {height} (width x height)"
                )
            mask = person_region(picture, room)
            warnings = [doubt] if doubt else []
            if mask.mean() > _CHANGED:
                warnings.append(
                    f"{mask.mean():.0%} of it differ from the background: did the light change, or "
                    "the camera move?"
                )
            yield FoundMask(name, frame, where, mask, picture, "", tuple(warnings))
            doubt = ""


def _background(
    source: Source, camera: str, given: Path | str
) -> tuple[Background, Sequence[Picture]]:
    """A camera's background, and the recording's pictures where it is their median."""
    if given == MEDIAN:
        recording = _spread_pictures(source, camera)
        try:
            return background_of_recording(recording), recording
        except SettingsError as error:
            raise SettingsError(f"camera '{camera}': {error}") from error
    files = _background_files(Path(given), camera)
    pictures = [read_picture(file, SceneError) for file in files]
    for file, picture in zip(files, pictures, strict=True):
        source.check_size(camera, picture.shape[1], picture.shape[0], str(file))
    return learn_background(pictures), ()


def _background_files(given: Path, camera: str) -> list[Path]:
    """The pictures of the empty room before a camera."""
    if given.is_file():
        return [given]
    own = given / camera
    if own.is_dir():
        return list(find_picture_files(own, camera).values())
    for suffix in SUFFIXES:
        if (given / f"{camera}{suffix}").is_file():
            return [given / f"{camera}{suffix}"]
    raise SceneError(
        f"{given}: has no picture of the empty room before camera '{camera}': {camera}.png, or a "
        f"folder {camera}; or give --background median"
    )


def _spread_pictures(source: Source, camera: str) -> list[Picture]:
    """Some pictures, spread evenly over a recording whose length nobody knows."""
    kept: list[Picture] = []
    step = 1
    for k, (_, where, picture) in enumerate(source.read(camera)):
        if kept and picture.shape != kept[0].shape:
            raise SceneError(f"{where}: has another size than the pictures before")
        if k % step:
            continue
        kept.append(picture)
        if len(kept) == 2 * _MOST:
            kept, step = kept[::2], 2 * step
    return kept


def _doubt(room: Background, recording: Sequence[Picture]) -> str:
    """Why a recording's median is no good background; "" where it is one."""
    support = background_support(recording, room)
    doubtful = []
    for picture in recording:
        mask = person_region(picture, room)
        if mask.any():
            doubtful.append(float((support[mask] < _SUPPORT).mean()))
    share = float(np.median(doubtful)) if doubtful else 0.0
    if share <= _DOUBTFUL:
        return ""
    return (
        f"the median of {len(recording)} pictures is no good background, here and in this camera's "
        f"other pictures: in {share:.0%} of the masks' area it is seen in fewer than three of four "
        "pictures, so the body may stand in it; give pictures of the empty room, or a longer "
        "recording in which the body leaves every place"
    )
