"""Recorded pictures: a folder of files, or a video file."""

from __future__ import annotations

import math
import re
from pathlib import Path

import cv2
import numpy as np

from drake_pose.camera.picture_files import (
    Mask,
    Picture,
    list_pictures,
    mask_of_picture,
    read_person_mask,
    read_picture,
)
from drake_pose.camera.sources.frame_source import (
    FrameSource,
    SourceSpecification,
    TimedPicture,
)
from drake_pose.csv_files import read_csv
from drake_pose.errors import SceneError

TIME_STAMPS = "timestamps.csv"

_NUMBER = re.compile(r"(\d+)$")


class FolderSource(FrameSource):
    """Pictures or masks `<frame>.png` or `.jpg` of a folder.

    Their times are those of `timestamps.csv` (frame, time [s]) in that folder. Without it the
    frames follow each other in the order of their names at the given rate, and frames of the same
    name in the folders `beside` are of the same time; a number in a name means nothing.

    Raises:
        SceneError: names the folder; no picture, no times, or pictures of another size.
    """

    def __init__(self, specification: SourceSpecification) -> None:
        super().__init__(specification)
        folder = Path(specification.location)
        files = find_picture_files(folder, specification.camera)
        stamped = folder / TIME_STAMPS
        times = read_time_stamps(stamped) if stamped.is_file() else self._counted(folder, files)
        missing = [frame for frame in times if frame not in files]
        if missing:
            self.drop(f"{folder}: has no picture of {_listed(missing)}", len(missing))
        strangers = [frame for frame in files if frame not in times]
        if strangers:
            self.drop(f"{stamped}: has no time of {_listed(strangers)}", len(strangers))
        self._rows = [(files[frame], frame, times[frame]) for frame in times if frame in files]
        if not self._rows:
            raise SceneError(f"{stamped}: has no time of any picture in {folder}")
        self._next = 0
        # Pictures of a wrong size are refused before work begins.
        for path, _, _ in self._rows:
            try:
                wrong = self.wrong_size(self._picture(path))
            except SceneError:
                continue  # It is named when its turn comes.
            if wrong:
                raise SceneError(f"{path}: camera '{specification.camera}' {wrong}")
            return
        raise SceneError(f"{folder}: not one of its pictures can be read")

    @property
    def ended(self) -> bool:
        """Whether all pictures were read."""
        return self._next >= len(self._rows)

    @property
    def rate_hz(self) -> float | None:
        """The given rate, or that of the time stamps."""
        steps = np.diff([time for _, _, time in self._rows])
        steps = steps[steps > 0]
        return self.specification.rate_hz or (1.0 / float(np.median(steps)) if len(steps) else None)

    def close(self) -> None:
        """Nothing is held open."""

    def _counted(self, folder: Path, files: dict[str, Path]) -> dict[str, float]:
        """The frames' times by their rate."""
        given = self.specification
        if given.rate_hz is None:
            raise SceneError(
                f"{folder}: has no {TIME_STAMPS} (frame,time), so the source of camera "
                f"'{given.camera}' needs rate_hz, its pictures a second"
            )
        names = set(files)
        for other in given.beside:
            names |= set(find_picture_files(Path(other), given.camera))
        ordered = sorted(names)
        if ordered != sorted(names, key=_by_number):
            raise SceneError(
                f"{folder}: the frames' names are numbers of different lengths, so their "
                f"order is unclear; fill them with zeros (0009, 0010) or give a {TIME_STAMPS}"
            )
        return {frame: k / given.rate_hz for k, frame in enumerate(ordered)}

    def _picture(self, path: Path) -> Picture | Mask:
        read = read_person_mask if self.specification.gives_masks else read_picture
        return read(path, SceneError)

    def _read(self) -> TimedPicture | None:
        while self._next < len(self._rows):
            path, frame, time = self._rows[self._next]
            self._next += 1
            try:
                picture = self._picture(path)
            except SceneError as error:
                self.drop(str(error))
                continue
            if wrong := self.wrong_size(picture):
                self.drop(f"{path}: {wrong}")
                continue
            return TimedPicture(time + self.specification.offset, frame, picture)
        return None


class VideoSource(FrameSource):
    """A video file's pictures, or masks, white on the person.

    Raises:
        SceneError: names the file; when it is no video, or of another size.
    """

    def __init__(self, specification: SourceSpecification) -> None:
        super().__init__(specification)
        path = specification.location
        if not Path(path).is_file():
            raise SceneError(f"{path}: no such video file of camera '{specification.camera}'")
        self._capture = cv2.VideoCapture(path)
        self._count = 0
        self._ahead = self._advance()
        if self._ahead is None:
            raise SceneError(
                f"{path}: not a video that OpenCV can read, though the source of camera "
                f"'{specification.camera}'"
            )
        if wrong := self.wrong_size(self._ahead.picture):
            self.close()
            raise SceneError(f"{path}: camera '{specification.camera}' {wrong}")

    @property
    def ended(self) -> bool:
        """Whether all pictures were read."""
        return self._ahead is None

    @property
    def rate_hz(self) -> float | None:
        """The given rate, or the file's own."""
        own = float(self._capture.get(cv2.CAP_PROP_FPS))
        return self.specification.rate_hz or (own if own > 0 else None)

    def close(self) -> None:
        """Lets go of the file."""
        self._capture.release()
        self._ahead = None

    def _read(self) -> TimedPicture | None:
        taken = self._ahead
        if taken is not None:
            self._ahead = self._advance()
        return taken

    def _advance(self) -> TimedPicture | None:
        """Reads one picture ahead, so that the end is known."""
        given = self.specification
        found, picture = self._capture.read()
        if not found or picture is None:
            promised = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
            if 0 < self._count < promised:
                reason = f"{given.location}: ends after {self._count} of {promised} pictures"
                self.drop(reason, promised - self._count)
            return None
        time = 1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC)
        if given.rate_hz is not None:
            time = self._count / given.rate_hz
        self._count += 1
        rgb = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        seen = mask_of_picture(rgb) if given.gives_masks else rgb
        return TimedPicture(time + given.offset, f"{self._count - 1:06d}", seen)


def find_picture_files(folder: Path, camera: str) -> dict[str, Path]:
    """The picture files of a folder, by frame, in the order of the names.

    Raises:
        SceneError: there is no such folder, no picture in it, or a frame twice.
    """
    if not folder.is_dir():
        raise SceneError(f"{folder}: no such folder of camera '{camera}'s pictures")
    files = list_pictures(folder, SceneError)
    if not files:
        raise SceneError(f"{folder}: holds no picture <frame>.png or .jpg of camera '{camera}'")
    return files


def read_time_stamps(path: Path) -> dict[str, float]:
    """The times [s] by frame of a `timestamps.csv`; SceneError names the file and the line."""
    header, rows = read_csv(path, SceneError)
    if not {"frame", "time"} <= set(header):
        raise SceneError(f"{path}: needs the columns frame and time [s] in its first line")
    found: dict[str, float] = {}
    for line, row in rows:
        frame = row[header.index("frame")]
        if frame in found:
            raise SceneError(f"{path}: line {line}: has frame {frame} twice")
        try:
            time = float(row[header.index("time")])
        except ValueError:
            time = math.nan
        if not math.isfinite(time):
            raise SceneError(f"{path}: line {line}: the time must be a number of seconds")
        found[frame] = time
    return found


def _by_number(name: str) -> tuple[str, int]:
    """A key that puts 9 before 10."""
    number = _NUMBER.search(name)
    return (name[: number.start()], int(number[1])) if number else (name, -1)


def _listed(frames: list[str]) -> str:
    """A few frames' names."""
    some = ", ".join(frames[:5])
    more = f" and {len(frames) - 5} more" if len(frames) > 5 else ""
    return f"frame{'s' if len(frames) > 1 else ''} {some}{more}"
