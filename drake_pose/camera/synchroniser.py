"""Groups the pictures of several cameras by their time stamps."""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Generic, NamedTuple, TypeVar

from drake_pose.errors import SettingsError, UnknownNameError

Item = TypeVar("Item")


class SynchronisedFrames(NamedTuple, Generic[Item]):
    """What the cameras saw at one moment: its earliest time stamp [s], and the items by camera.

    A camera that saw nothing then is missing.
    """

    time: float
    items: Mapping[str, Item]


class CameraChange(NamedTuple):
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

    def take(self, now: float | None = None) -> SynchronisedFrames[Item] | None:
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
        return SynchronisedFrames(begin, items)

    def take_changes(self) -> list[CameraChange]:
        """The cameras that stopped or returned since this was asked last."""
        changes, self._changes = self._changes, []
        return changes
