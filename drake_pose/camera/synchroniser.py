"""Group the images of several cameras by their time stamps."""

import math
from collections import deque
from collections.abc import Iterable
from typing import Generic, NamedTuple, TypeVar

from drake_pose.errors import SettingsError, UnknownNameError

Item = TypeVar("Item")


class CameraChange(NamedTuple):
    """A camera that stopped or returned."""

    camera: str  # Name of the camera.
    # Its last (stopped) or first (returned) time stamp [s]; nan if it never had an image.
    time: float
    stopped: bool  # Whether it stopped; else it returned.


class Synchroniser(Generic[Item]):
    """Groups the images of several cameras into synchronised frames.

    A group starts with the earliest unused image; each other camera contributes its earliest image
    if that is at most the tolerance later. A group is complete once each camera has provided its
    image or a later one. A camera that provides none is awaited for the timeout, then left out of
    the group, and not awaited again until it provides an image. An image that arrives after its
    group is dropped, and counted in `late` by camera.

    ``cameras``: names of the cameras. ``tolerance``: maximum time between images of one group [s];
    half a period for cameras that are triggered together. ``timeout``: timeout for a camera [s], at
    least the tolerance.

    Raises SettingsError: no camera, a duplicate camera, or invalid times.
    """

    def __init__(self, cameras: Iterable[str], tolerance: float, timeout: float) -> None:
        self.cameras = tuple(cameras)
        if not self.cameras or len(set(self.cameras)) != len(self.cameras):
            raise SettingsError(f"expected different cameras, not {list(self.cameras)}")
        if not (math.isfinite(tolerance) and tolerance >= 0.0):
            raise SettingsError(f"the tolerance must be 0 s or more, not {tolerance}")
        if not (math.isfinite(timeout) and timeout >= tolerance):
            raise SettingsError(
                f"the timeout must be at least the tolerance ({tolerance:g} s), not {timeout}"
            )
        self.tolerance, self.timeout = tolerance, timeout
        self.late = dict.fromkeys(self.cameras, 0)
        self._queues = {name: deque[tuple[float, Item]]() for name in self.cameras}
        self._last_times: dict[str, float] = {}
        self._newest = -math.inf
        self._group_time = -math.inf
        self._group_cameras: set[str] = set()
        self._ignored_cameras: set[str] = set()
        self._finished: set[str] = set()
        self._changes: list[CameraChange] = []

    def waiting(self, camera: str) -> int:
        """Return the number of a camera's images that wait for their group."""
        return len(self._queues[camera])

    def add(self, camera: str, time: float, item: Item) -> bool:
        """Add a camera's next image; return whether it can be part of a group.

        If not, because its group was taken or its time stamp is not later than the camera's last
        one, the image is dropped and counted in `late`.

        ``time``: time stamp [s]. ``item``: the image, or anything else that ``take`` shall return
        for it. Raises UnknownNameError: there is no such camera.
        """
        if camera not in self._queues:
            raise UnknownNameError("camera", camera, self.cameras, "the synchroniser")
        missed = time <= self._group_time + self.tolerance and camera not in self._group_cameras
        if missed or time <= self._group_time or time <= self._last_times.get(camera, -math.inf):
            self.late[camera] += 1
            return False
        if camera in self._ignored_cameras:
            self._ignored_cameras.discard(camera)
            self._changes.append(CameraChange(camera, time, stopped=False))
        self._queues[camera].append((time, item))
        self._last_times[camera] = time
        self._newest = max(self._newest, time)
        return True

    def finish(self, camera: str) -> None:
        """Declare that a camera will provide no more images, so that it is not awaited."""
        self._finished.add(camera)

    def take(self, now: float | None = None) -> tuple[float, dict[str, Item]] | None:
        """Return the next group: its earliest time stamp [s], and its items by camera.

        None if there is none, or a camera is still awaited.

        ``now``: the time [s]; None: the latest time stamp.
        """
        heads = {name: queue[0][0] for name, queue in self._queues.items() if queue}
        if not heads:
            return None
        begin = min(heads.values())
        there = {*heads, *self._ignored_cameras, *self._finished}
        awaited = [name for name in self.cameras if name not in there]
        if awaited:
            if (self._newest if now is None else max(now, self._newest)) < begin + self.timeout:
                return None
            self._ignored_cameras.update(awaited)
            for name in awaited:
                last = self._last_times.get(name, math.nan)
                self._changes.append(CameraChange(name, last, stopped=True))
        items = {
            name: self._queues[name].popleft()[1]
            for name in self.cameras
            if name in heads and heads[name] <= begin + self.tolerance
        }
        self._group_time, self._group_cameras = begin, set(items)
        return begin, items

    def take_changes(self) -> list[CameraChange]:
        """Return the cameras that stopped or returned since the last call."""
        changes, self._changes = self._changes, []
        return changes
