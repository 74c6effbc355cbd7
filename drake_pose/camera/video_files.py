"""The pictures of videos: by number, and with the time at which each was taken."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drake_pose.arrays import Picture
from drake_pose.errors import SceneError
from drake_pose.regular_files import require_regular

VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg")
"""How names of videos end."""

_AV1 = b"AV01"


def import_reader(library: str, path: Path) -> Any:
    """A library of the extra `episodes`; SceneError, which names both and the file, without it."""
    try:
        return import_module(library)
    except ImportError as error:
        package = library.partition(".")[0]
        raise SceneError(
            f"{path}: is read by {package}: pip install 'drake_pose[episodes]' ({error})"
        ) from error


class VideoPictures:
    """The pictures of a video, counted from 0; SceneError where it cannot be read.

    By OpenCV; AV1, which OpenCV's packages do not decode, as TimedVideo.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._capture, self._next = path, cv2.VideoCapture(str(path)), 0
        if not self._capture.isOpened():
            raise SceneError(f"{path}: not a video that OpenCV can read")
        codec = int(self._capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little")
        self._timed = TimedVideo(path) if codec.upper() == _AV1 else None

    @property
    def count(self) -> int:
        """How many pictures there are, as the file says."""
        return int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))

    @property
    def rate_hz(self) -> float | None:
        """Pictures a second, where the file says."""
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        return rate if rate > 0.0 else None

    def read(self, number: int) -> Picture:
        """A picture (H, W, 3), red, green, blue; SceneError where the video ends before it."""
        if self._timed is not None:
            return self._timed.read(number)
        if number < self._next:
            self._capture.release()
            self._capture, self._next = cv2.VideoCapture(str(self._path)), 0
        # Not every video can be wound to a picture: those between are passed over.
        while self._next < number and self._capture.grab():
            self._next += 1
        found, picture = self._capture.read()
        if self._next < number or not found:
            what = f"is cut short: it ends after {self._next} pictures, but says {self.count}"
            what = what if number < self.count else f"has no picture {number}"
            raise SceneError(
                f"{self._path}: {what}; leave the rest out (--frame), or make it whole: ffmpeg -i "
                f"{self._path.name} -c copy NEW"
            )
        self._next += 1
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


class TimedVideo:
    """The pictures of a video with their times, each read from the keyframe before it, by PyAV.

    The next picture costs one decoding; any other those from the last keyframe before it.

    Attributes:
        times: (n,) of the pictures that the file holds, from the first one on, ascending [s].
        width, height: [pixel].
        warnings: what is wrong with it.

    Raises SceneError: it is no video, has no picture, is cut short so that it cannot be read, or
    PyAV is missing.
    """

    def __init__(self, path: Path) -> None:
        av = import_reader("av", path)
        self._path, self._errors = path, (av.error.FFmpegError, OSError)
        try:
            require_regular(path)
            self._container = av.open(str(path))
            self._stream = self._container.streams.video[0]
        except (*self._errors, IndexError) as error:
            raise SceneError(
                f"{path}: not a video that PyAV can read, or its index is cut off ({error}); copy "
                "or record it again"
            ) from error
        self._packets = list(self._scan())
        if not self._packets:
            raise SceneError(f"{path}: no picture has a time; ffmpeg -i {path.name} NEW.mp4 helps")
        self._stamps = np.array([pts for pts, _ in sorted(self._packets)])
        self._keys = np.array([pts for pts, is_key in sorted(self._packets) if is_key] or [0])
        seconds = float(self._stream.time_base)
        self.times = (self._stamps - self._stamps[0]) * seconds
        self._promised = self._stream.frames or len(self.times)
        self.warnings: list[str] = []
        if self._promised > len(self.times):
            text = f"it ends after {len(self.times)} of {self._promised} pictures"
            self.warnings.append(f"{path}: is cut short: {text}")
        self._frames: Iterator[Any] = iter(())
        self._last: int | None = None
        self.height, self.width = self.read(0).shape[:2]

    def _scan(self) -> Iterator[tuple[int, bool]]:
        """The time stamp of each whole picture that is to be shown, and if it is a keyframe."""
        try:
            for packet in self._container.demux(self._stream):
                if packet.pts is not None and not (packet.is_corrupt or packet.is_discard):
                    yield packet.pts, packet.is_keyframe
        except self._errors:
            return  # What is there is used; _promised says that there was more.

    def _decode(self) -> Iterator[Any]:
        """The pictures from where the file was wound to; a packet that is cut off has none."""
        for packet in self._container.demux(self._stream):
            if not packet.is_corrupt:
                yield from packet.decode()

    def read(self, number: int) -> Picture:
        """A picture (H, W, 3), red, green, blue; SceneError: there is none, or it is damaged."""
        if not 0 <= number < len(self._stamps):
            cut = "is cut short: it " if self._promised > len(self._stamps) else ""
            raise SceneError(f"{self._path}: {cut}has pictures 0 to {len(self._stamps) - 1} only")
        wanted = int(self._stamps[number])
        key = int(self._keys[max(0, int(np.searchsorted(self._keys, wanted, side="right")) - 1)])
        previous = int(self._stamps[number - 1]) if number else None
        follows = self._last is not None and (self._last == previous or key <= self._last < wanted)
        try:
            # From the start where the file's keyframes are not what it says.
            for start in ((None,) if follows else ()) + (key, int(self._stamps[0])):
                if start is not None:
                    self._container.seek(start, stream=self._stream)
                    self._frames = self._decode()
                for frame in self._frames:
                    self._last = frame.pts
                    if frame.pts == wanted:
                        turned = np.rot90(frame.to_ndarray(format="rgb24"), frame.rotation // 90)
                        return np.ascontiguousarray(turned)
                    if frame.pts > wanted:
                        break
            reason = "it is not where its time stamp says"
        except self._errors as error:
            reason = str(error)
        self._last = None
        raise SceneError(f"{self._path}: picture {number} cannot be decoded: {reason}")
