"""Recorded pictures, a folder or a video, and `sources.yaml`, which says where pictures are."""

import math
import re
import time
from collections.abc import Generator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.frame_source import (
    Clock,
    DeviceSource,
    FrameSource,
    SourceSpecification,
    TimedPicture,
)
from drake_pose.camera.models import Camera, check_number
from drake_pose.camera.picture_files import (
    Mask,
    Picture,
    list_pictures,
    read_picture,
    read_two_colours,
)
from drake_pose.csv_files import read_csv
from drake_pose.errors import CameraError, SceneError, SettingsError, listed
from drake_pose.yaml_files import read_yaml

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
                self.drop(f"{where}: has no {what} of {_frames_listed(frames)}", len(frames))
        timed = [frame for frame in times if frame in files]
        if not timed:
            raise SceneError(f"{stamped}: has no time of any picture in {folder}")
        steps = np.diff([times[frame] for frame in timed])
        if np.any(steps > 0):
            self._own_rate = 1.0 / float(np.median(steps[steps > 0]))
        for frame in timed:
            seen: Picture | Mask
            try:
                if given.gives_masks:
                    seen = read_two_colours(files[frame], SceneError, may_be_empty=True, lossy=True)
                else:
                    seen = read_picture(files[frame], SceneError)
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
                one = TimedPicture(time + given.offset, f"{count:06d}", given.seen(picture))
                yield path, one
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


def _frames_listed(frames: list[str]) -> str:
    """A few frames' names."""
    return f"frame{'s' if len(frames) > 1 else ''} {listed(frames)}"


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
