"""`sources.yaml`: where each camera's pictures come from, beside `cameras.yaml`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.checks import check_number
from drake_pose.camera.models import Camera
from drake_pose.camera.picture_files import Picture, read_picture
from drake_pose.camera.sources.frame_source import Clock, FrameSource, SourceSpecification
from drake_pose.camera.sources.live import DeviceSource
from drake_pose.camera.sources.recorded import TIME_STAMPS, RecordedSource, find_picture_files
from drake_pose.errors import CameraError, SceneError, SettingsError
from drake_pose.yaml_files import read_yaml

SOURCES = "sources.yaml"
CAMERAS = "cameras.yaml"

_FIELDS = ("kind", "location", "rate_hz", "masks", "background", "offset")


def load_sources(
    path: str | Path, cameras: Mapping[str, Camera] | None = None
) -> dict[str, SourceSpecification]:
    """Reads where the pictures of all cameras come from, in the order of the calibration.

    A camera's entry has `kind` (folder, video, device) and `location` (relative to the file; a
    device's number or address), and either `masks: true`, where the source delivers masks, or
    `background`, a folder of pictures of the empty room. It may have `rate_hz` and `offset` [s].

    Args:
        path: a `sources.yaml`, or the folder that holds it.
        cameras: the calibrated cameras; those of the `cameras.yaml` beside it where not given.

    Raises:
        SceneError: names the file, the camera and the field.
        CameraError: the camera file is wrong.
    """
    path = Path(path)
    path = path / SOURCES if path.is_dir() else path
    content = read_yaml(path, SceneError)
    if not isinstance(content, dict) or not content:
        raise SceneError(f"{path}: expected a mapping from camera names to their sources")
    cameras = load_cameras(path.with_name(CAMERAS)) if cameras is None else cameras
    entries = {str(name): entry for name, entry in content.items()}
    unknown = [name for name in entries if name not in cameras]
    if unknown:
        raise SceneError(
            f"{path}: camera '{unknown[0]}' is not calibrated: {CAMERAS} has only "
            f"{', '.join(cameras)}; calibrate it, or take it out of {path.name}"
        )
    missing = [name for name in cameras if name not in entries]
    if missing:
        raise SceneError(
            f"{path}: camera '{missing[0]}' of {CAMERAS} has no source; give it an entry, or take "
            f"it out of {CAMERAS}"
        )
    found = {name: _read_entry(camera, entries[name], path) for name, camera in cameras.items()}
    return _with_folders_beside(found)


def open_source(specification: SourceSpecification, clock: Clock = time.monotonic) -> FrameSource:
    """Opens a source; the clock gives the time stamps of a live camera's pictures [s].

    Raises SceneError: a folder or video that cannot be read, is empty, or whose pictures are not of
    the calibrated size. A live camera that cannot be opened is tried again and again.
    """
    if specification.live:
        return DeviceSource(specification, clock)
    return RecordedSource(specification)


def load_background_pictures(specification: SourceSpecification) -> list[Picture]:
    """The pictures (H, W, 3) of the empty room that a camera's specification names.

    Raises SceneError: there is none, or one cannot be read or is not of the calibrated size.
    """
    camera = specification.camera
    if specification.background is None:
        raise SceneError(f"camera '{camera}' delivers masks, so it has no background")
    folder = Path(specification.background)
    if not folder.is_dir():
        raise SceneError(
            f"{folder}: no such folder of pictures of the empty room before camera '{camera}'; "
            "'drake-pose empty-room FOLDER' takes them"
        )
    pictures = []
    for file in find_picture_files(folder, camera).values():
        pictures.append(read_picture(file, SceneError))
        if wrong := specification.wrong_size(pictures[-1]):
            raise SceneError(f"{file}: camera '{camera}' {wrong}")
    return pictures


def _read_entry(camera: Camera, entry: Any, path: Path) -> SourceSpecification:
    """The specification of one entry of a file."""
    where = f"{path}: camera '{camera.name}'"
    if not isinstance(entry, dict):
        raise SceneError(f"{where}: expected a mapping with kind, location and more")
    strange = [str(field)[:40] for field in entry if field not in _FIELDS]
    if strange:
        raise SceneError(f"{where}: unknown field {strange[0]}; a source has {', '.join(_FIELDS)}")
    kind, location = entry.get("kind"), entry.get("location")
    if isinstance(location, bool) or not isinstance(location, str | int) or location == "":
        raise SceneError(f"{where}: location must be a path, or a device's number or address")
    if kind != "device":
        location = path.parent / str(location)
    masks, background = entry.get("masks", False), entry.get("background")
    if not isinstance(masks, bool) or masks == (background is not None):
        raise SceneError(
            f"{where}: needs either 'masks: true', where its pictures are masks of the person, or "
            "'background: FOLDER', pictures of the empty room"
        )
    if background is not None:
        if not isinstance(background, str):
            raise SceneError(f"{where}: background must be a folder of pictures")
        background = str(path.parent / background)
    try:
        rate, offset = entry.get("rate_hz"), entry.get("offset", 0.0)
        rate = None if rate is None else check_number(rate, "rate_hz", where)
        offset = check_number(offset, "offset", where)
    except CameraError as error:
        raise SceneError(str(error)) from None
    size = camera.width, camera.height
    try:
        return SourceSpecification(
            camera.name, str(kind), str(location), *size, rate, background, offset
        )
    except SettingsError as error:
        raise SceneError(f"{path}: {error}") from None


def _with_folders_beside(found: dict[str, SourceSpecification]) -> dict[str, SourceSpecification]:
    """Folders without time stamps share their frames' names with others of the same rate."""
    counted = {
        name: one.rate_hz
        for name, one in found.items()
        if one.kind == "folder" and not (Path(one.location) / TIME_STAMPS).is_file()
    }

    def beside(name: str) -> tuple[str, ...]:
        others = [other for other in counted if name in counted and other != name]
        return tuple(found[other].location for other in others if counted[other] == counted[name])

    return {name: replace(one, beside=beside(name)) for name, one in found.items()}
