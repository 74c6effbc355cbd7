"""Recorded or live pictures as Drake systems: synchronised frames, and a person's region in one."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, InputPort, State, System
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.arrays import Mask, Picture
from drake_pose.camera.models import Camera
from drake_pose.camera.sources import FrameSource, TimedPicture
from drake_pose.errors import CameraError, SettingsError, require_known
from drake_pose.silhouette.pictures.label_renderer import fill_label_image, label_image_to_mask
from drake_pose.silhouette.pictures.scenes import USUAL_RATE_HZ
from drake_pose.silhouette.segmentation import Background, person_region
from drake_pose.systems.cameras import colour_image_to_picture, fill_colour_image
from drake_pose.systems.ports import PortedSystem, require_period

# Longest time to wait for the first pictures of live cameras [s].
_OPENING_TIMEOUT = 8.0

# Number of a recorded camera's pictures that wait for other cameras at most.
_AHEAD = 8


class Synchroniser:
    """Groups the pictures of several cameras into synchronised frames.

    A group starts with the earliest unused picture; each other camera contributes its earliest
    picture if that is at most the tolerance later. A group is complete once each camera has
    provided its picture or a later one. A camera that provides none is awaited for the timeout,
    then left out of the group, and not awaited again until it provides a picture. A picture that
    arrives after its group is dropped.

    Args:
        cameras: names of the cameras.
        tolerance: maximum time between pictures of one group [s]; half a period for cameras that
            are triggered together.
        timeout: timeout for a camera [s], at least the tolerance.

    Attributes:
        late: number of dropped pictures by camera.
        changes: (camera, time, stopped) of each camera that stopped or returned so far; the time is
            that of its last picture before it stopped (nan if it never had one), or of its first
            one after it returned [s].
    """

    def __init__(self, cameras: Iterable[str], tolerance: float, timeout: float) -> None:
        self.cameras, self.tolerance, self.timeout = tuple(cameras), tolerance, timeout
        self.late = dict.fromkeys(self.cameras, 0)
        self.changes: list[tuple[str, float, bool]] = []
        self._queues = {name: deque[tuple[float, TimedPicture]]() for name in self.cameras}
        self._last_times: dict[str, float] = {}
        self._newest = -math.inf
        self._group_time = -math.inf
        self._group_cameras: set[str] = set()
        self._ignored_cameras: set[str] = set()
        self._finished: set[str] = set()

    def waiting(self, camera: str) -> int:
        """Return the number of a camera's pictures that wait for their group."""
        return len(self._queues[camera])

    def add(self, camera: str, time: float, picture: TimedPicture) -> bool:
        """Add a camera's next picture; return whether it can be part of a group.

        If not, because its group was taken or its time stamp is not later than the camera's last
        one, the picture is dropped. ``time``: time stamp [s].
        """
        missed = time <= self._group_time + self.tolerance and camera not in self._group_cameras
        if missed or time <= self._group_time or time <= self._last_times.get(camera, -math.inf):
            self.late[camera] += 1
            return False
        if camera in self._ignored_cameras:
            self._ignored_cameras.discard(camera)
            self.changes.append((camera, time, False))
        self._queues[camera].append((time, picture))
        self._last_times[camera] = time
        self._newest = max(self._newest, time)
        return True

    def finish(self, camera: str) -> None:
        """Declare that a camera will provide no more pictures, so that it is not awaited."""
        self._finished.add(camera)

    def take(self, now: float = -math.inf) -> tuple[float, dict[str, TimedPicture]] | None:
        """Return the next group: its earliest time stamp [s], and its pictures by camera.

        None if there is none, or a camera is still awaited. ``now``: the time [s], if it is later
        than the latest time stamp.
        """
        heads = {name: queue[0][0] for name, queue in self._queues.items() if queue}
        if not heads:
            return None
        begin = min(heads.values())
        there = {*heads, *self._ignored_cameras, *self._finished}
        awaited = [name for name in self.cameras if name not in there]
        if awaited:
            if max(now, self._newest) < begin + self.timeout:
                return None
            self._ignored_cameras.update(awaited)
            self.changes += [(one, self._last_times.get(one, math.nan), True) for one in awaited]
        pictures = {
            name: self._queues[name].popleft()[1]
            for name in self.cameras
            if name in heads and heads[name] <= begin + self.tolerance
        }
        self._group_time, self._group_cameras = begin, set(pictures)
        return begin, pictures


class PictureCapture(PortedSystem):
    """Outputs the synchronised pictures of several cameras.

    .. pydrake_system::

        name: PictureCapture
        output_ports: [color_image_<camera>, label_image_<camera>, time, fresh]

    A periodic update reads the sources; output ports show the last synchronised frames. Recorded
    sources follow the simulation's time: all frames are shown, and the simulation terminates after
    the last. If a source is live, all follow the computer's clock: the newest frames are shown,
    after waiting for all cameras to open. Pictures half a period apart are of one time, those of
    live cameras, which are not triggered together, 0.9 periods apart. External devices cannot be
    part of a Context, so that a PictureCapture works in one simulator only.

    Output ports:
        color_image_<camera> (ImageRgba8U): without pixels if the camera has no picture in these
            frames.
        label_image_<camera> (ImageLabel16I): instead of it, for a source of masks.
        time (1): time stamp of the frames, counted from the first ones [s]; NaN before them.
        fresh (1): 1 if this update brought new frames, else 0.

    Args:
        sources: opened sources of pictures, by name of the camera.
        cameras: cameras by name, which give the sizes of the images.
        clock: returns the computer's time [s]; that of the live sources.

    Attributes:
        period: time between two updates, that of the fastest source [s].
        live: whether the pictures come by the computer's clock.
        frames: the synchronised frames shown; None before the first ones.
        skipped: number of synchronised frames that were skipped for newer ones.

    Raises:
        SettingsError: there is no source, or a time is invalid.
        UnknownNameError: a source belongs to no camera.
    """

    def __init__(
        self,
        sources: Mapping[str, FrameSource],
        cameras: Mapping[str, Camera],
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        require_known("camera", sources, cameras, "the calibration")
        if not sources:
            raise SettingsError("a capture needs the source of at least one camera")
        self._sources = dict(sources)
        self.live = any(one.specification.live for one in sources.values())
        rates = [rate for one in sources.values() if (rate := one.rate_hz) is not None]
        self.period = 1.0 / max(rates, default=USUAL_RATE_HZ)
        require_period("capture", self.period)
        tolerance = (0.9 if self.live else 0.5) * self.period
        self._synchroniser = Synchroniser(self._sources, tolerance, timeout=4.0 * self.period)
        self._clock = clock
        self._since: float | None = None
        self._opened: set[str] = set()
        self._begin: float | None = None
        self._origins: dict[str, float] = {}
        self._pending: dict[str, TimedPicture | None] = dict.fromkeys(self._sources)
        self.frames: tuple[float, dict[str, TimedPicture]] | None = None  # Time [s], by camera.
        self._used = dict.fromkeys(self._sources, 0)
        self._reports: list[str] = []
        self._reported = 0
        self.skipped = 0
        self._time = self.DeclareDiscreteState(np.array([math.nan]))
        self._fresh = self.DeclareDiscreteState(1)
        for name, source in self._sources.items():
            size = cameras[name].width, cameras[name].height
            is_mask = source.specification.gives_masks
            port = f"label_image_{name}" if is_mask else f"color_image_{name}"
            image = ImageLabel16I(*size) if is_mask else ImageRgba8U(*size)
            calc = partial(
                self._calc_image, name, fill_label_image if is_mask else fill_colour_image
            )
            ticket = {self.discrete_state_ticket(self._time)}
            self.DeclareAbstractOutputPort(port, AbstractValue.Make(image).Clone, calc, ticket)
        self.DeclareStateOutputPort("time", self._time)
        self.DeclareStateOutputPort("fresh", self._fresh)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self.period, 0.0, self._update)
        self.DeclareForcedUnrestrictedUpdateEvent(self._update)

    def counts(self) -> dict[str, dict[str, Any]]:
        """Return what became of each camera's pictures, by the camera's name.

        ``used``, ``dropped``, ``late``: number of pictures in synchronised frames that were shown,
        of those that could not be used, and of those that arrived after their synchronised frames.
        ``changes``: each ``time`` [s] at which the camera stopped or returned, and ``what`` it did.
        """
        what, synchroniser = ("returned", "stopped"), self._synchroniser
        return {
            name: {
                "used": self._used[name],
                "dropped": one.dropped,
                "late": synchroniser.late[name],
                "changes": [
                    {"time": time, "what": what[stopped]}
                    for camera, time, stopped in synchroniser.changes
                    if camera == name
                ],
            }
            for name, one in self._sources.items()
        }

    def take_reports(self) -> list[str]:
        """Return new messages for the user: stopped cameras, bad pictures."""
        for source in self._sources.values():
            self._reports += source.problems
            source.problems.clear()
        reports, self._reports = self._reports, []
        return reports

    def close(self) -> None:
        """Close all sources."""
        for source in self._sources.values():
            source.close()

    def _update(self, context: Context, state: State) -> EventStatus:
        """Read the sources, and show the next synchronised frames if there are any."""
        if self._begin is None:
            self._begin = self._start()
        if self._begin is None:
            return EventStatus.Succeeded()
        now = self._clock() - self._begin if self.live else context.get_time()
        for name, source in self._sources.items():
            # The offset of 5e-7 periods makes pictures due at an update in spite of rounding.
            self._feed(name, source, now + 5e-7 * self.period)
        frames = self._synchroniser.take(now)
        while self.live and frames is not None:
            newer = self._synchroniser.take(now)
            if newer is None:
                break
            frames, self.skipped = newer, self.skipped + 1
        for camera, at, stopped in self._synchroniser.changes[self._reported :]:
            if not stopped:
                text = f"returned at {at:.2f} s"
            elif math.isnan(at):
                text = "gives no picture; the others go on without it"
            else:
                text = f"stopped at {at:.2f} s; the others go on without it"
            self._reports.append(f"camera '{camera}' {text}")
        self._reported = len(self._synchroniser.changes)
        state.get_mutable_discrete_state(self._fresh).SetFromVector([float(frames is not None)])
        if frames is None:
            ended = all(source.ended for source in self._sources.values())
            has_waiting = any(self._synchroniser.waiting(name) for name in self._sources)
            if ended and not has_waiting and not any(self._pending.values()):
                return EventStatus.ReachedTermination(self, "the recording has ended")
            return EventStatus.Succeeded()
        self.frames = frames
        begin, pictures = frames
        for name in pictures:
            self._used[name] += 1
        state.get_mutable_discrete_state(self._time).SetFromVector([begin])
        return EventStatus.Succeeded()

    def _start(self) -> float | None:
        """Return time 0 by the clock [s]; None while cameras are opening.

        Recorded time stamps are counted from the earliest first picture, live ones from time 0.
        """
        recorded = [name for name, one in self._sources.items() if not one.specification.live]
        for name, source in self._sources.items():
            if name in recorded or source.ended or source.read() is not None:
                self._opened.add(name)
        now = self._clock()
        self._since = now if self._since is None else self._since
        if len(self._opened) < len(self._sources) and now - self._since < _OPENING_TIMEOUT:
            return None
        for name in recorded:
            self._pending[name] = self._sources[name].read()
        first = min([one.time for one in self._pending.values() if one is not None], default=0.0)
        begin = self._clock() if self.live else 0.0
        self._origins = {name: first if name in recorded else begin for name in self._sources}
        return begin

    def _feed(self, name: str, source: FrameSource, now: float) -> None:
        """Pass new pictures of a source to the synchroniser, or tell it that the source has ended.

        A live source gives its newest picture, if it is new. A recorded one gives all pictures that
        are due at ``now`` [s]; the next one is kept until it is due. In a capture that is not live,
        reading stops while _AHEAD pictures of the camera ``name`` wait for other cameras.
        """
        origin, synchroniser = self._origins[name], self._synchroniser
        if source.specification.live:
            one = source.read()
            if one is not None:
                synchroniser.add(name, one.time - origin, one)
            elif source.ended:
                synchroniser.finish(name)
            return
        while self.live or synchroniser.waiting(name) < _AHEAD:
            one = self._pending[name]
            if one is None:
                one = self._pending[name] = source.read()
            if one is None:
                # A live source without a picture may have one later, a recorded one has ended.
                if source.ended or not self.live:
                    synchroniser.finish(name)
                return
            if one.time - origin > now:
                return
            synchroniser.add(name, one.time - origin, one)
            self._pending[name] = None

    def _calc_image(
        self, name: str, fill: Callable[[Any, np.ndarray], None], _: Context, output: AbstractValue
    ) -> None:
        """Write the shown picture of the camera ``name`` to an output; ``fill`` copies it."""
        image = output.get_mutable_value()
        one = None if self.frames is None else self.frames[1].get(name)
        if one is None:
            image.resize(0, 0)
        else:
            fill(image, one.picture)


class PersonRegion(PortedSystem):
    """Finds the person's region in one camera's picture.

    .. pydrake_system::

        name: PersonRegion
        input_ports: [color_image (optional), label_image (optional)]
        output_ports: [region]

    The system has no state.

    Input ports:
        color_image (ImageRgba8U): used with the background model if ``label_image`` is not
            connected.
        label_image (ImageLabel16I): gives the region if connected.

    Output ports:
        region: a mask (H, W); None if the image that gives it is not connected or without pixels,
            because the camera has no picture.

    Args:
        camera: the camera, which gives the size of the images.
        background: background model of the camera; None: ``label_image`` must be connected.

    Attributes:
        wanted: names of the input ports that give the region.

    Raises:
        SettingsError: the background's size is not the camera's. On evaluation: there is neither a
            background nor a label image.
        CameraError: on evaluation: an image has another size than the camera.
    """

    def __init__(self, camera: Camera, background: Background | None = None) -> None:
        super().__init__()
        size = camera.width, camera.height
        if background is not None and background.mean.shape[1::-1] != size:
            width, height = background.mean.shape[1::-1]
            raise SettingsError(
                f"camera '{camera.name}' has {size[0]} x {size[1]} pixels (width x height), but "
                f"its background {width} x {height}"
            )
        self._camera, self._background = camera, background
        self.wanted: tuple[str, ...] = ("label_image",) if background is None else ("color_image",)
        self.add_input("color_image", ImageRgba8U(*size))
        self.add_input("label_image", ImageLabel16I(*size))
        self.picture = self.add_cache("picture", self._picture)
        self.region = self.add_output("region", None, self._region)

    def _image(self, context: Context, name: str) -> Any:
        """Return the image at the input port ``name``; None if the camera has no picture.

        Raises CameraError: the image has another size than the camera.
        """
        image, camera = self.eval_input(context, name), self._camera
        if image is None or not image.size():
            return None
        if (image.width(), image.height()) != (camera.width, camera.height):
            raise CameraError(
                f"camera '{camera.name}': its {name.replace('_', ' ')} has {image.width()} x "
                f"{image.height()} pixels (width x height), but it was calibrated with "
                f"{camera.width} x {camera.height}"
            )
        return image

    def _picture(self, context: Context) -> Picture | None:
        """Return the picture (H, W, 3); None if the camera has no picture."""
        image = self._image(context, "color_image")
        return None if image is None else colour_image_to_picture(image)

    def _region(self, context: Context) -> Mask | None:
        """Return the person's region (H, W); None if the camera has no picture."""
        if self.GetInputPort("label_image").HasValue(context):
            image = self._image(context, "label_image")
            return None if image is None else label_image_to_mask(image)
        image = self._image(context, "color_image")
        if image is None:
            return None
        if self._background is None:
            raise SettingsError(
                f"camera '{self._camera.name}': give a background model or connect label_image, "
                "to find the person's region"
            )
        # The four channels need no copy: person_region copies the pieces that it uses.
        return person_region(image.data, self._background)


def connect_images(
    builder: DiagramBuilder, source: System | None, wanted: Mapping[str, Sequence[InputPort]]
) -> None:
    """Connect input ports to a source's output ports by name, or export them from the diagram.

    ``builder``: the diagram that contains the input ports and the source. ``source``: source of
    images; None: the input ports become inputs of the diagram. ``wanted``: input ports by the name
    of the source's output port, or of the diagram's input.

    Raises SettingsError: the source lacks an output port.
    """
    for name, ports in wanted.items():
        if source is None:
            builder.ExportInput(ports[0], name)
            for port in ports[1:]:
                builder.ConnectInput(name, port)
            continue
        if not source.HasOutputPort(name):
            kind, camera = name[:11], name[12:]
            background = " (or a background in the setup)" if kind == "label_image" else ""
            known = [source.get_output_port(k).get_name() for k in range(source.num_output_ports())]
            raise SettingsError(
                f"camera '{camera}': the source needs an output port {name}{background}; it has: "
                + ", ".join(known)
            )
        for port in ports:
            builder.Connect(source.GetOutputPort(name), port)
