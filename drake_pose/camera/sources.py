"""Image sources of cameras: folders, videos and live cameras, specified in `sources.yaml`.

A problem with one image costs only that image, and is reported in `problems`.
"""

import abc
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drake_pose.arrays import Mask, Picture
from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.models import Camera, check_number
from drake_pose.camera.picture_files import (
    Video,
    find_pictures,
    frame_key,
    in_order,
    read_binary_mask,
    read_picture,
    threshold_mask,
)
from drake_pose.errors import CameraError, SceneError, listed
from drake_pose.input_files import named_fields, read_csv, read_yaml

CAMERAS, SOURCES, TIME_STAMPS = "cameras.yaml", "sources.yaml", "timestamps.csv"
"""Names of files: calibrated cameras, image sources, and times of a folder's frames."""


@dataclass(frozen=True)
class SourceSpecification:
    """Source of a camera's images; plain values, so that another machine can open it.

    Args:
        camera: name of the camera.
        kind: folder: images `<frame>.png` or `.jpg`, optionally with a `timestamps.csv` (frame,
            time [s]); video: a file; device: a live camera.
        location: path of the folder or file; number or address of a device.
        width, height: size of the images for which the camera is calibrated [pixel].
        rate_hz: images per second. A folder without time stamps needs it; a video's own rate is the
            default; images of a device have the time of their arrival.
        background: folder of images of the empty room; None: the source provides masks.
        offset: added to time stamps [s], if the cameras' clocks differ.
        beside: folders of other cameras whose images with the same name have the same time.
    """

    camera: str
    kind: str
    location: str
    width: int
    height: int
    rate_hz: float | None = None
    background: str | None = None
    offset: float = 0.0
    beside: tuple[str, ...] = ()

    @property
    def live(self) -> bool:
        """Whether images arrive by themselves and are lost if they are not read."""
        return self.kind == "device"

    @property
    def gives_masks(self) -> bool:
        """Whether the source provides masks of the person instead of images."""
        return self.background is None

    def convert(self, picture: Picture, where: str) -> Picture | Mask:
        """Return an image (H, W, 3), or its bright pixels (H, W) if the source provides masks.

        Raises SceneError, begun by ``where``: the image should be a mask and is not.
        """
        return threshold_mask(picture, where) if self.gives_masks else picture

    def size_problem(self, picture: Picture | Mask) -> str:
        """Return what is wrong with an image's size, for messages; "" if it is as calibrated."""
        height, width = picture.shape[:2]
        if (width, height) == (self.width, self.height):
            return ""
        return (
            f"has {width} x {height} pixels (width x height), but the camera is calibrated for "
            f"{self.width} x {self.height}: give pictures of that size, or calibrate again"
        )


@dataclass(frozen=True, eq=False)
class TimedPicture:
    """An image (H, W, 3) red, green, blue, or a mask (H, W), with its time stamp [s] and frame.

    The frame is the name of the image's file without suffix, or its number.
    """

    time: float
    frame: str
    picture: Picture | Mask


class FrameSource(abc.ABC):
    """Images of one camera, in the order of their time stamps.

    Attributes:
        specification: the source.
        rate_hz: approximate images per second, those of a recording that does not state them
            included; None if unknown.
        problems: problems so far, each with the camera's name; the caller may clear the list.
        dropped: number of images lost to problems.
    """

    def __init__(self, specification: SourceSpecification) -> None:
        self.specification, self.rate_hz = specification, specification.rate_hz
        self.problems: list[str] = []
        self.dropped = 0
        self._last: TimedPicture | None = None

    @property
    @abc.abstractmethod
    def ended(self) -> bool:
        """Whether no more images will come."""

    @abc.abstractmethod
    def close(self) -> None:
        """Release the file or camera; may be called twice."""

    @abc.abstractmethod
    def _read(self) -> TimedPicture | None:
        """Return the next image, whatever its time stamp."""

    def read(self) -> TimedPicture | None:
        """Return the next image, the latest one of a live camera; None if there is none (yet).

        An image whose time stamp does not exceed the previous one's is dropped.
        """
        while (one := self._read()) is not None:
            if self._last is None or one.time > self._last.time:
                self._last = one
                return one
            same = one.time == self._last.time
            what = "the same time stamp as" if same else "a time stamp before"
            self.drop(f"frame {one.frame} has {what} frame {self._last.frame}: {one.time:g} s")
        return None

    def drop(self, reason: str, count: int = 1) -> None:
        """Report why images were lost, and add their number to ``dropped``."""
        self.dropped += count
        self.report(f"{reason}; it is left out")

    def report(self, problem: str) -> None:
        """Append a problem, with the camera's name, to ``problems``."""
        self.problems.append(f"camera '{self.specification.camera}': {problem}")


class DeviceSource(FrameSource):
    """A live camera: its latest image, with its time of arrival by ``time.monotonic`` [s].

    Images that are not read in time are lost. A camera that cannot be opened or fails is reported
    once and reopened repeatedly, with growing pauses.

    ``specification``: the source. ``pauses``: initial and maximum pause before reopening [s]; they
    double until an image arrives.
    """

    def __init__(
        self, specification: SourceSpecification, pauses: tuple[float, float] = (0.5, 10.0)
    ) -> None:
        super().__init__(specification)
        self._pauses = pauses
        self._newest: deque[TimedPicture] = deque(maxlen=1)
        self._failed, self._count = False, 0
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._run, name=f"camera {specification.camera}", daemon=True
        )
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Whether it was closed, or provides images of a wrong size."""
        return self._stop.is_set()

    def close(self) -> None:
        """Stop the thread, which releases the camera."""
        self._stop.set()
        self._thread.join(2.0)  # Timeout [s], because OpenCV may hang on a network camera.

    def _read(self) -> TimedPicture | None:
        return self._newest.pop() if self._newest else None

    def _run(self) -> None:
        """Read until closed; reopen the camera after failures."""
        given, (pause, longest) = self.specification, self._pauses
        while not self.ended:
            before, place, is_open = self._count, given.location, False
            with suppress(cv2.error):
                capture = cv2.VideoCapture(int(place) if place.isdigit() else place)
                if capture.isOpened() and place.isdigit():
                    capture.set(cv2.CAP_PROP_FRAME_WIDTH, given.width)
                    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, given.height)
                    if given.rate_hz is not None:
                        capture.set(cv2.CAP_PROP_FPS, given.rate_hz)
                is_open = capture.isOpened()
            if is_open:
                self._keep_newest(capture)
                capture.release()
            if self.ended:
                return
            if not self._failed:
                what = "stopped" if self._count else "cannot be opened"
                self.report(f"'{given.location}' {what}; retrying until it answers")
                self._failed = True
            pause = self._pauses[0] if self._count > before else pause
            self._stop.wait(pause)
            pause = min(2.0 * pause, longest)

    def _keep_newest(self, capture: cv2.VideoCapture) -> None:
        """Read until the camera is closed or fails, or a picture is unusable."""
        place = f"'{self.specification.location}'"
        while not self.ended:
            found, picture = False, None
            with suppress(cv2.error):
                found, picture = capture.read()
            if not found or picture is None:
                return
            stamp = time.monotonic() + self.specification.offset
            rgb = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)
            try:
                if wrong := self.specification.size_problem(rgb):
                    raise SceneError(f"{place} {wrong}")
                seen = self.specification.convert(rgb, place)
            except SceneError as error:
                self.report(str(error))
                self._stop.set()
                return
            if self._failed:
                self.report(f"{place} answers again")
                self._failed = False
            self._newest.append(TimedPicture(stamp, f"{self._count:06d}", seen))
            self._count += 1


class RecordedSource(FrameSource):
    """Images of a folder or a video; one image is read ahead to detect the end.

    A folder has images or masks `<frame>.png` or `.jpg`, with times in `timestamps.csv` (frame,
    time [s]). Without that file frames follow each other in the order of their names at the given
    rate, and equal names in the folders `beside` have the same time; numbers in names do not count.
    Masks in a video are white on the person.

    Raises:
        SceneError: names the folder or file that has no image, or whose first image has another
            size.
    """

    def __init__(self, specification: SourceSpecification) -> None:
        super().__init__(specification)
        self._ahead: TimedPicture | None = None
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
        """Whether all images were read."""
        return self._ahead is None

    def close(self) -> None:
        """Release the file."""
        self._ahead = None
        self._pictures = iter(())

    def _read(self) -> TimedPicture | None:
        taken = self._ahead
        if taken is not None:
            self._ahead = self._advance()
        return taken

    def _advance(self) -> TimedPicture | None:
        """Return the next image that can be read, or None; SceneError: the first one's size."""
        for path, frame, seconds, read in self._pictures:
            try:
                picture = read()
            except SceneError as error:
                self.drop(str(error))
                continue
            wrong = self.specification.size_problem(picture)
            if not wrong:
                return TimedPicture(seconds + self.specification.offset, frame, picture)
            if self._ahead is None:
                raise SceneError(f"{path}: camera '{self.specification.camera}' {wrong}")
            self.drop(f"{path}: {wrong}")
        return None

    def _of_folder(self) -> Iterator[tuple[Path, str, float, Callable[[], Picture | Mask]]]:
        """Yield the file, frame, time [s] and reader of each image of a folder, in order."""
        given, folder = self.specification, Path(self.specification.location)
        files = find_pictures(folder, given.camera)
        beside = [
            frame for other in given.beside for frame in find_pictures(Path(other), given.camera)
        ]
        times, stamped = picture_times(files, given.rate_hz, beside), folder / TIME_STAMPS
        if any(map(math.isnan, times.values())):
            raise SceneError(
                f"{folder}: has no {TIME_STAMPS} (frame,time), so the source of camera "
                f"'{given.camera}' needs rate_hz, its pictures per second"
            )
        for what, where, frames in (
            ("picture", folder, [frame for frame in times if frame not in files]),
            ("time", stamped, [frame for frame in files if frame not in times]),
        ):
            if frames:
                text = f"frame{'s' if len(frames) > 1 else ''} {listed(frames)}"
                self.drop(f"{where}: has no {what} of {text}", len(frames))
        timed = [frame for frame in times if frame in files]
        steps = np.diff([times[frame] for frame in timed])
        if self.rate_hz is None and np.any(steps > 0):
            self.rate_hz = 1.0 / float(np.median(steps[steps > 0]))
        read: Callable[[Path], Picture | Mask] = read_picture
        if given.gives_masks:
            read = partial(read_binary_mask, may_be_empty=True, lossy=True)
        for frame in timed:
            yield files[frame], frame, times[frame], partial(read, files[frame])

    def _of_video(self) -> Iterator[tuple[Path, str, float, Callable[[], Picture | Mask]]]:
        """Yield the file, frame, time [s] and reader of each image of a video."""
        given, path = self.specification, Path(self.specification.location)
        try:
            video = Video(path)
        except SceneError as error:
            raise SceneError(
                f"{error}, though it is the source of camera '{given.camera}'"
            ) from None
        self.rate_hz, times = given.rate_hz or video.rate_hz, video.times - video.times[0]

        def read(k: int) -> Picture | Mask:
            return given.convert(video.read(k), f"{path}: picture {k}")

        if given.rate_hz is not None:
            times = np.arange(len(times)) / given.rate_hz
        for k, seconds in enumerate(times.tolist()):
            yield path, f"{k:06d}", seconds, partial(read, k)
        for text in video.warnings:
            self.drop(text, video.promised - len(times))


def picture_times(
    files: Mapping[str, Path], rate_hz: float | None, beside: Iterable[str] = ()
) -> dict[str, float]:
    """Return the times [s] of the frames of a folder of pictures by name, in order.

    They are those of the folder's `timestamps.csv` (7 is ``0007.png``), also of frames without a
    picture, in its order; or else follow from natural order and rate, from 0 on; or else are nan.

    ``files``: picture files by frame. ``rate_hz``: frames per second; None: unknown. ``beside``:
    other frames that are counted. Raises SceneError: `timestamps.csv` lacks a column, has a frame
    twice, no picture's time, or a time that is not a finite number.
    """
    path = next(iter(files.values())).with_name(TIME_STAMPS)
    if not path.is_file():
        rate = math.nan if rate_hz is None else rate_hz
        return {frame: k / rate for k, frame in enumerate(in_order((*files, *beside)))}
    header, rows = read_csv(path, SceneError)
    if not {"frame", "time"} <= set(header):
        raise SceneError(f"{path}: needs the columns frame and time [s] in its first line")
    found, named = dict[str, float](), {frame_key(frame): frame for frame in files}
    for line, row in rows:
        frame = row[header.index("frame")]
        frame = frame if frame in files else named.get(frame_key(frame), frame)
        if frame in found:
            raise SceneError(f"{path}: line {line}: has frame {frame} twice")
        try:
            found[frame] = float(row[header.index("time")])
        except ValueError:
            found[frame] = math.nan
        if not math.isfinite(found[frame]):
            raise SceneError(f"{path}: line {line}: the time must be a number of seconds")
    if not found.keys() & files.keys():
        raise SceneError(f"{path}: has no time of any picture in its folder")
    return found


def load_sources(
    path: str | Path, cameras: Mapping[str, Camera] | None = None
) -> dict[str, SourceSpecification]:
    """Return the image sources of all cameras by name, in the order of the calibration.

    A camera's entry has `kind` (folder, video, device) and `location` (relative to the file; a
    device's number or address), and either `masks: true`, if the source provides masks, or
    `background`, a folder of images of the empty room. `rate_hz` and `offset` [s] are optional.

    ``path``: a `sources.yaml`, or its folder. ``cameras``: the calibrated cameras; None: those of
    the `cameras.yaml` in the same folder. Raises SceneError: names the file, the camera and the
    field at fault; CameraError: the camera file is invalid.
    """
    path = Path(path)
    path = path / SOURCES if path.is_dir() else path
    content = read_yaml(path, SceneError)
    if not isinstance(content, dict) or not content:
        raise SceneError(f"{path}: expected a mapping from camera names to their sources")
    cameras = load_cameras(path.with_name(CAMERAS)) if cameras is None else cameras
    entries = {str(name): entry for name, entry in content.items()}
    if odd := sorted(entries.keys() ^ cameras.keys(), key=list({**entries, **cameras}).index):
        lacking = CAMERAS if odd[0] in entries else path.name
        raise SceneError(
            f"{path}: camera '{odd[0]}' is not in {lacking}: {CAMERAS} has {', '.join(cameras)}, "
            f"{path.name} {', '.join(entries)}; both must name the same cameras"
        )
    found = {name: _read_entry(camera, entries[name], path) for name, camera in cameras.items()}
    # Folders without time stamps, at the same rate, share one numbering of frames.
    counted = {
        name: one.rate_hz
        for name, one in found.items()
        if one.kind == "folder" and not (Path(one.location) / TIME_STAMPS).is_file()
    }
    for name, rate in counted.items():
        others = [other for other, its in counted.items() if other != name and its == rate]
        found[name] = replace(found[name], beside=tuple(found[one].location for one in others))
    return found


def open_source(specification: SourceSpecification) -> FrameSource:
    """Open a camera's source of images; a live camera's time stamps are ``time.monotonic``'s.

    Raises SceneError: a folder or video is unreadable, empty, or has images of another size than
    the calibrated one. A live camera does not raise; opening it is retried.
    """
    if specification.live:
        return DeviceSource(specification)
    return RecordedSource(specification)


def load_background_pictures(specification: SourceSpecification) -> list[Picture]:
    """Return the images (H, W, 3) of the empty room from a specification's folder.

    Raises SceneError: there is none, or one is unreadable or not of the calibrated size.
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
    for file in find_pictures(folder, camera).values():
        pictures.append(read_picture(file))
        if wrong := specification.size_problem(pictures[-1]):
            raise SceneError(f"{file}: camera '{camera}' {wrong}")
    return pictures


def _read_entry(camera: Camera, entry: Any, path: Path) -> SourceSpecification:
    """Return the specification of a camera's entry in a sources.yaml, with paths from its folder.

    ``camera``: the calibrated camera. ``entry``: the entry, not yet checked. ``path``: the
    sources.yaml. Raises SceneError: a field is missing, unknown or invalid.
    """
    where = f"{path}: camera '{camera.name}'"
    known = ("kind", "location", "rate_hz", "masks", "background", "offset")
    given = {"masks": False, "offset": 0.0} | named_fields(entry, known, where, SceneError)
    kind, location, masks, background = (
        given.get(name) for name in ("kind", "location", "masks", "background")
    )
    if kind not in ("folder", "video", "device"):
        raise SceneError(f"{where}: kind must be folder, video or device, not {kind!r}")
    if isinstance(location, bool) or not isinstance(location, str | int) or location == "":
        raise SceneError(f"{where}: location must be a path, or a device's number or address")
    if not isinstance(masks, bool) or masks == isinstance(background, str):
        raise SceneError(
            f"{where}: needs either 'masks: true', where its pictures are masks of the person, or "
            "'background: FOLDER', pictures of the empty room"
        )
    place = str(location) if kind == "device" else str(path.parent / str(location))
    room, rate = None if background is None else str(path.parent / background), given.get("rate_hz")
    try:
        rate = None if rate is None else check_number(rate, "rate_hz", where, positive=True)
        offset = check_number(given["offset"] or 0.0, "offset", where)
    except CameraError as error:
        raise SceneError(str(error)) from None
    size = camera.width, camera.height
    return SourceSpecification(camera.name, kind, place, *size, rate, room, offset)
