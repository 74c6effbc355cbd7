"""Where a camera's pictures come from, a live camera's newest one, and pictures of one moment.

What is wrong with one picture costs only that picture, and is said in `problems`. Pictures of
several cameras are grouped to moments by their time stamps.
"""

import abc
import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.picture_files import Mask, Picture, mask_of_picture
from drake_pose.errors import SettingsError, UnknownNameError

KINDS = ("folder", "video", "device")

Clock = Callable[[], float]


@dataclass(frozen=True)
class SourceSpecification:
    """Where a camera's pictures come from; plain values, so that another machine may open it.

    Args:
        kind: folder: of pictures `<frame>.png` or `.jpg`, perhaps with a `timestamps.csv` (frame,
            time [s]); video: a file that OpenCV reads; device: a live camera.
        location: the folder's or file's path; a device's number or address.
        width, height: of the pictures that the camera is calibrated for [pixel].
        rate_hz: pictures a second. A folder without time stamps needs it; a video's own is used
            where not given; a live camera's pictures bear the time at which they come.
        background: a folder of pictures of the empty room; None: the source delivers masks.
        offset: is added to time stamps [s], where cameras' clocks differ.
        beside: other cameras' folders whose pictures of the same name were taken at the same time.

    Raises SettingsError: an unknown kind, a size or a rate that cannot be.
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

    def __post_init__(self) -> None:
        where = f"the source of camera '{self.camera}'"
        if self.kind not in KINDS:
            raise SettingsError(f"{where}: kind must be {', '.join(KINDS)}, not {self.kind!r}")
        if self.width < 1 or self.height < 1:
            raise SettingsError(f"{where}: pictures of {self.width} x {self.height} cannot be")
        if self.rate_hz is not None and not (math.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise SettingsError(f"{where}: rate_hz must be a positive number, not {self.rate_hz}")

    @property
    def live(self) -> bool:
        """Whether pictures come by themselves, and are gone where nobody takes them."""
        return self.kind == "device"

    @property
    def gives_masks(self) -> bool:
        """Whether the source delivers masks of the person instead of pictures."""
        return self.background is None

    def seen(self, picture: NDArray[Any]) -> Picture | Mask:
        """The picture red, green, blue, or the mask, of one (H, W, 3) blue, green, red."""
        rgb = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        return mask_of_picture(rgb) if self.gives_masks else rgb

    def wrong_size(self, picture: NDArray[Any]) -> str:
        """What is wrong with a picture's size; "" where it is the calibrated one."""
        height, width = picture.shape[:2]
        if (width, height) == (self.width, self.height):
            return ""
        return (
            f"has {width} x {height} pixels (width x height), but the camera is calibrated for "
            f"{self.width} x {self.height}: give pictures of that size, or calibrate again"
        )


@dataclass(frozen=True, eq=False)
class TimedPicture:
    """A picture (H, W, 3) red, green, blue, or a mask (H, W), and its time stamp [s]."""

    time: float
    frame: str
    picture: Picture | Mask


class FrameSource(abc.ABC):
    """One camera's pictures, in the order of their time stamps.

    Attributes:
        problems: what was wrong so far, each with the camera's name; a reader may empty the list.
        dropped: how many pictures were lost for that.
    """

    def __init__(self, specification: SourceSpecification) -> None:
        self.specification = specification
        self.problems: list[str] = []
        self.dropped = 0
        self._last: TimedPicture | None = None

    @property
    @abc.abstractmethod
    def ended(self) -> bool:
        """Whether no picture will come any more."""

    @property
    def rate_hz(self) -> float | None:
        """About how many pictures come a second; None where nobody knows."""
        return self.specification.rate_hz

    @abc.abstractmethod
    def close(self) -> None:
        """Lets go of the file or camera; may be called twice."""

    @abc.abstractmethod
    def _read(self) -> TimedPicture | None:
        """The next picture, whatever its time stamp."""

    def read(self) -> TimedPicture | None:
        """The next picture, a live camera's newest; None: none now, or none any more (`ended`).

        A picture whose time stamp does not lie after the last one's is dropped.
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
        """Notes that pictures were lost."""
        self.dropped += count
        self.report(f"{reason}; it is left out")

    def report(self, problem: str) -> None:
        """Notes a problem."""
        self.problems.append(f"camera '{self.specification.camera}': {problem}")


FIRST_PAUSE = 0.5
"""After a failure a camera is opened again after this time [s], then after twice as much, ..."""

LONGEST_PAUSE = 10.0
"""... but never later than this [s]."""

# How long closing waits for the thread; OpenCV may hang on a network camera [s].
_PATIENCE = 2.0


class DeviceSource(FrameSource):
    """A live camera: its newest picture, with the time at which it came by the clock [s].

    A slow reader never sees old pictures: those that were not read in time are gone. A camera that
    cannot be opened or fails is reported once and opened again, after growing pauses.
    """

    def __init__(self, specification: SourceSpecification, clock: Clock) -> None:
        super().__init__(specification)
        self._clock = clock
        self._newest: deque[TimedPicture] = deque(maxlen=1)
        self._failed = False
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._run, name=f"camera {specification.camera}", daemon=True
        )
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Whether it was closed, or gives pictures of a wrong size."""
        return self._stop.is_set()

    def close(self) -> None:
        """Ends the thread, which lets go of the camera."""
        self._stop.set()
        self._thread.join(_PATIENCE)

    def _read(self) -> TimedPicture | None:
        return self._newest.pop() if self._newest else None

    def _run(self) -> None:
        """Reads until closed; opens the camera again and again."""
        pause, count = FIRST_PAUSE, 0
        while not self.ended:
            before, capture = count, self._open()
            if capture is not None:
                count = self._keep_newest(capture, count)
                capture.release()
            if self.ended:
                return
            if not self._failed:
                what = "stopped" if count else "cannot be opened"
                self.report(
                    f"'{self.specification.location}' {what}; it is tried again until it answers"
                )
                self._failed = True
            pause = FIRST_PAUSE if count > before else pause
            self._stop.wait(pause)
            pause = min(2.0 * pause, LONGEST_PAUSE)

    def _open(self) -> cv2.VideoCapture | None:
        """The camera, asked for pictures of the calibrated size."""
        given = self.specification
        by_number = given.location.isdigit()
        with suppress(cv2.error):
            capture = cv2.VideoCapture(int(given.location) if by_number else given.location)
            if not capture.isOpened():
                return None
            if by_number:
                capture.set(cv2.CAP_PROP_FRAME_WIDTH, given.width)
                capture.set(cv2.CAP_PROP_FRAME_HEIGHT, given.height)
                if given.rate_hz is not None:
                    capture.set(cv2.CAP_PROP_FPS, given.rate_hz)
            return capture
        return None

    def _keep_newest(self, capture: cv2.VideoCapture, count: int) -> int:
        """Reads until the camera fails or is not wanted; the number of pictures in all."""
        while not self.ended:
            found, picture = False, None
            with suppress(cv2.error):
                found, picture = capture.read()
            if not found or picture is None:
                return count
            time = self._clock() + self.specification.offset
            if wrong := self.specification.wrong_size(picture):
                self.report(f"'{self.specification.location}' {wrong}")
                self._stop.set()
                return count
            if self._failed:
                self.report(f"'{self.specification.location}' answers again")
                self._failed = False
            self._newest.append(
                TimedPicture(time, f"{count:06d}", self.specification.seen(picture))
            )
            count += 1
        return count


Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class Moment(Generic[Item]):
    """What the cameras saw at one moment: its earliest time stamp [s], and the items by camera.

    A camera that saw nothing then is missing.
    """

    time: float
    items: Mapping[str, Item]


@dataclass(frozen=True)
class CameraChange:
    """A camera that is waited for no more, or again.

    Args:
        time: its last, or its first, time stamp [s]; nan where it never gave a picture.
        stopped: whether it stopped; else it returned.
    """

    camera: str
    time: float
    stopped: bool


class Synchroniser(Generic[Item]):
    """Groups the pictures of several cameras to moments.

    A moment begins with the earliest picture not used yet; every other camera gives its earliest
    one, if that is at most the tolerance later. A moment is complete when every camera has given
    its picture or a later one. A camera that gives none is waited for a while; then it is left out
    of this moment and waited for no more until it gives a picture again. A picture that comes after
    its moment is dropped, and counted in `late` by camera.

    Args:
        tolerance: how far apart the pictures of one moment may be [s]; half of the time between two
            frames where the cameras are triggered together.
        patience: how long a moment waits for a camera [s], at least the tolerance.

    Raises SettingsError: no camera, one twice, or times that cannot be.
    """

    def __init__(self, cameras: Iterable[str], tolerance: float, patience: float) -> None:
        self.cameras = tuple(cameras)
        if not self.cameras or len(set(self.cameras)) != len(self.cameras):
            raise SettingsError(f"different cameras are synchronised, not {list(self.cameras)}")
        if not (math.isfinite(tolerance) and tolerance >= 0.0):
            raise SettingsError(f"the tolerance must be 0 s or more, not {tolerance}")
        if not (math.isfinite(patience) and patience >= tolerance):
            raise SettingsError(
                f"the patience must be the tolerance ({tolerance:g} s) or more, not {patience}"
            )
        self.tolerance, self.patience = tolerance, patience
        self.late = dict.fromkeys(self.cameras, 0)
        self._queues = {name: deque[tuple[float, Item]]() for name in self.cameras}
        self._last_times: dict[str, float] = {}
        self._newest = -math.inf
        self._moment_time = -math.inf
        self._moment_cameras: set[str] = set()
        self._left_out: set[str] = set()
        self._finished: set[str] = set()
        self._changes: list[CameraChange] = []

    @property
    def left_out(self) -> tuple[str, ...]:
        """The cameras that are not waited for now."""
        return tuple(name for name in self.cameras if name in self._left_out)

    def waiting(self, camera: str) -> int:
        """How many of a camera's pictures wait for their moment."""
        return len(self._queues[camera])

    def add(self, camera: str, time: float, item: Item) -> bool:
        """Takes a camera's next picture, of a time stamp [s]; whether it can be part of a moment.

        Raises UnknownNameError: there is no such camera.
        """
        if camera not in self._queues:
            raise UnknownNameError("camera", camera, self.cameras, "the synchroniser")
        missed = time <= self._moment_time + self.tolerance and camera not in self._moment_cameras
        if missed or time <= self._moment_time or time <= self._last_times.get(camera, -math.inf):
            self.late[camera] += 1
            return False
        if camera in self._left_out:
            self._left_out.discard(camera)
            self._changes.append(CameraChange(camera, time, stopped=False))
        self._queues[camera].append((time, item))
        self._last_times[camera] = time
        self._newest = max(self._newest, time)
        return True

    def finish(self, camera: str) -> None:
        """Tells that a camera will give no more pictures, so that nobody waits for it."""
        self._finished.add(camera)

    def take(self, now: float | None = None) -> Moment[Item] | None:
        """The next moment; None where there is none, or one that still waits for a camera.

        Args:
            now: the time [s]; the newest time stamp where not given.
        """
        heads = {name: queue[0][0] for name, queue in self._queues.items() if queue}
        if not heads:
            return None
        begin = min(heads.values())
        awaited = [
            name
            for name in self.cameras
            if name not in heads and name not in self._left_out and name not in self._finished
        ]
        if awaited:
            if (self._newest if now is None else max(now, self._newest)) < begin + self.patience:
                return None
            self._left_out.update(awaited)
            for name in awaited:
                last = self._last_times.get(name, math.nan)
                self._changes.append(CameraChange(name, last, stopped=True))
        items = {
            name: self._queues[name].popleft()[1]
            for name in self.cameras
            if name in heads and heads[name] <= begin + self.tolerance
        }
        self._moment_time, self._moment_cameras = begin, set(items)
        return Moment(begin, items)

    def take_changes(self) -> list[CameraChange]:
        """The cameras that stopped or returned since this was asked last."""
        changes, self._changes = self._changes, []
        return changes
