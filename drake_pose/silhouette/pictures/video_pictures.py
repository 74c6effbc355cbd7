"""The pictures of a video by number, read in order where they are asked for in order."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SceneError

VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg")
"""How names of videos end."""


class VideoPictures:
    """The pictures of a video, counted from 0; SceneError where OpenCV cannot read it."""

    def __init__(self, path: Path) -> None:
        self._path, self._capture, self._next = path, cv2.VideoCapture(str(path)), 0
        if not self._capture.isOpened():
            raise SceneError(f"{path}: not a video that OpenCV can read")

    @property
    def count(self) -> int:
        """How many pictures there are, as the file says."""
        return int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))

    @property
    def rate_hz(self) -> float | None:
        """Pictures a second, where the file says."""
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        return rate if rate > 0.0 else None

    def read(self, number: int) -> NDArray[np.uint8]:
        """A picture (H, W, 3), red, green, blue; SceneError where the video ends before it."""
        if number < self._next:
            self._capture.release()
            self._capture, self._next = cv2.VideoCapture(str(self._path)), 0
        # Not every video can be wound to a picture: those between are passed over.
        while self._next < number and self._capture.grab():
            self._next += 1
        found, picture = self._capture.read()
        if self._next < number or not found:
            raise SceneError(f"{self._path}: ends after {self._next} pictures, {number} asked for")
        self._next += 1
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)
