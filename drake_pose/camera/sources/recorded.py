"""Recorded pictures: a folder of files, or a video file."""

from __future__ import annotations

import math
import re
from collections.abc import Generator, Mapping
from pathlib import Path

import cv2
import numpy as np

from drake_pose.camera.picture_files import list_pictures, read_person_mask, read_picture
from drake_pose.camera.sources.frame_source import FrameSource, SourceSpecification, TimedPicture
from drake_pose.csv_files import read_csv
from drake_pose.errors import SceneError

TIME_STAMPS = "timestamps.csv"

_NUMBER = re.compile(r"(\d+)$")


class RecordedSource(FrameSource):
    """Pictures of a folder or a video, one of them read ahead, so that the end is known.

    A folder has pictures or masks `<frame>.png` or `.jpg`; their times are those of its
    `timestamps.csv` (frame, time [s]). Without it the frames follow each other in the order of
    their names at the given rate, and frames of the same name in the folders `beside` are of the
    same time; a number in a name means nothing. A video's masks are white on the person.

    Raises SceneError: names the folder or file; no picture, or the first is of another size.
    """

    def __init__(self, specification: SourceSpecification) -> None:
        super().__init__(specification)
        self._ahead: TimedPicture | None = None
        self._own_rate: float | None = None
        is_folder = specification.kind == "folder"
        self._pictures = self._of_folder() if is_folder else self._of_video()
        self._ahead = self._advance()
        if self._ahead is None:
            raise SceneError(
                f"{specification.location}: no picture can be read, though it is the source of "
                f"camera '{specification.camera}'"
            )

    @property
    def ended(self) -> bool:
        """Whether all pictures were read."""
        return self._ahead is None

    @property
    def rate_hz(self) -> float | None:
        """The given rate, or that of the time stamps or of the video."""
        return self.specification.rate_hz or self._own_rate

    def close(self) -> None:
        """Lets go of the file."""
        self._ahead = None
        self._pictures.close()

    def _read(self) -> TimedPicture | None:
        taken = self._ahead
        if taken is not None:
            self._ahead = self._advance()
        return taken

    def _advance(self) -> TimedPicture | None:
        """The next picture of the calibrated size."""
        for path, one in self._pictures:
            wrong = self.specification.wrong_size(one.picture)
            if not wrong:
                return one
            if self._ahead is None:
                raise SceneError(f"{path}: camera '{self.specification.camera}' {wrong}")
            self.drop(f"{path}: {wrong}")
        return None

    def _of_folder(self) -> Generator[tuple[Path, TimedPicture]]:
        """The pictures that can be read, and the file of each."""
        given, folder = self.specification, Path(self.specification.location)
        files = find_picture_files(folder, given.camera)
        stamped = folder / TIME_STAMPS
        times = read_time_stamps(stamped) if stamped.is_file() else _counted(given, files)
        for what, where, frames in (
            ("picture", folder, [frame for frame in times if frame not in files]),
            ("time", stamped, [frame for frame in files if frame not in times]),
        ):
            if frames:
                self.drop(f"{where}: has no {what} of {_listed(frames)}", len(frames))
        timed = [frame for frame in times if frame in files]
        if not timed:
            raise SceneError(f"{stamped}: has no time of any picture in {folder}")
        steps = np.diff([times[frame] for frame in timed])
        if np.any(steps > 0):
            self._own_rate = 1.0 / float(np.median(steps[steps > 0]))
        for frame in timed:
            try:
                read = read_person_mask if given.gives_masks else read_picture
                seen = read(files[frame], SceneError)
            except SceneError as error:
                self.drop(str(error))
                continue
            yield files[frame], TimedPicture(times[frame] + given.offset, frame, seen)

    def _of_video(self) -> Generator[tuple[Path, TimedPicture]]:
        """The pictures of a video, each with the video's name."""
        given, count = self.specification, 0
        path = Path(given.location)
        if not path.is_file():
            raise SceneError(f"{path}: no such video file of camera '{given.camera}'")
        capture = cv2.VideoCapture(str(path))
        if not capture.isOpened():
            raise SceneError(
                f"{path}: not a video that OpenCV can read, though the source of camera "
                f"'{given.camera}'"
            )
        self._own_rate = float(capture.get(cv2.CAP_PROP_FPS)) or None
        try:
            while True:
                found, picture = capture.read()
                if not found or picture is None:
                    break
                time = 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC)
                if given.rate_hz is not None:
                    time = count / given.rate_hz
                seen = given.seen(picture)
                yield path, TimedPicture(time + given.offset, f"{count:06d}", seen)
                count += 1
            promised = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
            if 0 < count < promised:
                reason = f"{given.location}: ends after {count} of {promised} pictures"
                self.drop(reason, promised - count)
        finally:
            capture.release()


def _counted(given: SourceSpecification, files: Mapping[str, Path]) -> dict[str, float]:
    """The times of a folder's frames by their rate."""
    folder = Path(given.location)
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


def find_picture_files(folder: Path, camera: str) -> dict[str, Path]:
    """The picture files of a folder, by frame, in the order of the names.

    Raises SceneError: there is no such folder, no picture in it, or a frame twice.
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
            found[frame] = float(row[header.index("time")])
        except ValueError:
            found[frame] = math.nan
        if not math.isfinite(found[frame]):
            raise SceneError(f"{path}: line {line}: the time must be a number of seconds")
    return found


def _by_number(name: str) -> tuple[str, int]:
    """A key that puts 9 before 10."""
    number = _NUMBER.search(name)
    return (name[: number.start()], int(number[1])) if number else (name, -1)


def _listed(frames: list[str]) -> str:
    """A few frames' names."""
    more = f" and {len(frames) - 5} more" if len(frames) > 5 else ""
    return f"frame{'s' if len(frames) > 1 else ''} {', '.join(frames[:5])}{more}"
