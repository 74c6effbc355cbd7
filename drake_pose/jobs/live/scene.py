"""A folder of cameras and where their pictures come from, opened to be captured or walked with."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2

from drake_pose.camera.files import load_cameras
from drake_pose.camera.models import Camera
from drake_pose.camera.sources.files import (
    CAMERAS,
    SOURCES,
    load_background_pictures,
    load_sources,
    open_source,
)
from drake_pose.camera.sources.frame_source import FrameSource, SourceSpecification
from drake_pose.errors import DrakePoseError, SceneError
from drake_pose.silhouette.segmentation.background import Background, learn_background
from drake_pose.systems.person.live_capture import LocalSensors
from drake_pose.systems.pictures.picture_capture import PictureCapture


@dataclass(frozen=True, eq=False)
class LiveScene:
    """Calibrated cameras and where their pictures come from.

    Args:
        path: the folder.
        cameras: by name.
        specifications: of their sources.
        backgrounds: of the cameras whose sources do not deliver masks.
    """

    path: Path
    cameras: Mapping[str, Camera]
    specifications: Mapping[str, SourceSpecification]
    backgrounds: Mapping[str, Background]

    def open_sensors(
        self, live: bool | None = None, tolerance: float | None = None
    ) -> LocalSensors:
        """Opens the sources, and the sensors that see with them.

        Args:
            live: whether the computer's clock decides; where not given, if a camera is live.
            tolerance: how far apart the pictures of one moment may be [s].

        Raises:
            SceneError: a source cannot be opened; what was opened is closed.
            SettingsError: the tolerance cannot be.
        """
        opened: dict[str, FrameSource] = {}
        try:
            for name, one in self.specifications.items():
                opened[name] = open_source(one)
            capture = PictureCapture(opened, self.cameras, live=live, tolerance=tolerance)
        except DrakePoseError:
            for source in opened.values():
                source.close()
            raise
        return LocalSensors(capture, self.cameras, self.backgrounds)


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
    backgrounds = {
        name: learn_background(load_background_pictures(one))
        for name, one in specifications.items()
        if not one.gives_masks
    }
    return LiveScene(path, cameras, specifications, backgrounds)
