"""A folder of cameras and where their pictures come from, opened to be captured or walked with."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import cv2

from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.frame_source import Clock, FrameSource, Picture, SourceSpecification
from drake_pose.camera.models import Camera
from drake_pose.camera.source_files import (
    CAMERAS,
    SOURCES,
    load_background_pictures,
    load_sources,
    open_source,
)
from drake_pose.errors import OutputError, SceneError
from drake_pose.files.folder import write_file
from drake_pose.silhouette.segmentation.background import Background, learn_background
from drake_pose.systems.person.live_capture import LiveSensors

# How long it is waited for a camera that is to show the empty room [s].
_PATIENCE = 30.0
# Between two looks at live cameras [s].
_PAUSE = 0.005


@dataclass(frozen=True, eq=False)
class LiveScene:
    """Calibrated cameras, where their pictures come from, and how the empty room looks.

    A camera whose source delivers masks has no background.
    """

    path: Path
    cameras: Mapping[str, Camera]
    specifications: Mapping[str, SourceSpecification]
    backgrounds: Mapping[str, Background]

    def open_sensors(self, live: bool | None = None, tolerance: float | None = None) -> LiveSensors:
        """Opens the sources, and the sensors that see with them.

        Args:
            live: whether the computer's clock decides; where not given, if a camera is live.
            tolerance: how far apart the pictures of one moment may be [s].

        Raises:
            SceneError: a source cannot be opened; what was opened is closed.
            SettingsError: the tolerance cannot be.
        """
        with ExitStack() as opened:
            sources = open_sources(self.specifications, opened)
            sensors = LiveSensors(
                sources, self.cameras, self.backgrounds, live=live, tolerance=tolerance
            )
            opened.pop_all()
        return sensors


def open_sources(
    given: Mapping[str, SourceSpecification], opened: ExitStack, clock: Clock = time.monotonic
) -> dict[str, FrameSource]:
    """Opens sources, which ``opened`` closes; SceneError: one cannot be."""
    return {k: opened.enter_context(closing(open_source(one, clock))) for k, one in given.items()}


def learn_backgrounds(given: Mapping[str, SourceSpecification]) -> dict[str, Background]:
    """How the empty room looks to the cameras whose sources do not deliver masks."""
    return {
        name: learn_background(load_background_pictures(one))
        for name, one in given.items()
        if not one.gives_masks
    }


def hush_opencv() -> None:
    """Keeps OpenCV from writing to the terminal whenever a camera is tried again."""
    # FFmpeg's part reads it when the first camera or video is opened; -8: nothing at all.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def is_live_scene(path: Path) -> bool:
    """Whether a folder says where its cameras' pictures come from."""
    return (path / SOURCES).is_file()


def load_live_scene(path: Path) -> LiveScene:
    """Reads cameras.yaml, sources.yaml and the pictures of the empty room.

    Raises:
        SceneError, CameraError: a file is missing or wrong; names it.
    """
    if not path.is_dir():
        raise SceneError(f"{path}: no such folder; it needs {CAMERAS} and {SOURCES}")
    if not is_live_scene(path):
        raise SceneError(f"{path}: has no {SOURCES}, which says where its cameras' pictures are")
    cameras = load_cameras(path / CAMERAS)
    if len(cameras) < 2:
        raise SceneError(f"{path}: a person is captured by two calibrated cameras or more")
    specifications = load_sources(path / SOURCES, cameras)
    return LiveScene(path, cameras, specifications, learn_backgrounds(specifications))


def take_empty_room(folder: Path, count: int) -> dict[str, Path]:
    """Writes each camera's first pictures to its background folder; by camera, where that is.

    Raises:
        SceneError: a camera gives too few pictures, or none needs a background.
        OutputError: a background folder holds something already, or cannot be written.
    """
    specifications = {
        name: one for name, one in load_sources(folder).items() if one.background is not None
    }
    if not specifications:
        raise SceneError(f"{folder}: all sources deliver masks, so none needs a background")
    places = {name: Path(str(one.background)) for name, one in specifications.items()}
    for name, place in places.items():
        if place.exists() and (not place.is_dir() or any(place.iterdir())):
            raise OutputError(
                f"{place}: the background of camera '{name}' exists already; move it away first"
            )
    with ExitStack() as opened:
        pictures = _take(open_sources(specifications, opened), count)
    for name, place in places.items():
        for k, picture in enumerate(pictures[name]):
            _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
            write_file(place, f"{k:03d}.png", data.tobytes())
    return places


def _take(sources: Mapping[str, FrameSource], count: int) -> dict[str, list[Picture]]:
    """This many pictures of each camera."""
    pictures: dict[str, list[Picture]] = {name: [] for name in sources}
    end = time.monotonic() + _PATIENCE
    while slow := [name for name, some in pictures.items() if len(some) < count]:
        for name in slow:
            if (taken := sources[name].read()) is not None:
                pictures[name].append(taken.picture.astype("uint8"))
            elif sources[name].ended or time.monotonic() > end:
                reasons = "; ".join(sources[name].problems)
                raise SceneError(
                    f"camera '{name}' gave {len(pictures[name])} of {count} pictures"
                    f"{': ' if reasons else ''}{reasons}"
                )
        time.sleep(_PAUSE)
    return pictures
