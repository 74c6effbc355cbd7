"""Recorded or live pictures as Drake systems: synchronised ones, and the person's region in one."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    EventStatus,
    InputPort,
    State,
    System,
)
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.arrays import Mask, Picture
from drake_pose.camera.models import Camera
from drake_pose.camera.sources import Clock, FrameSource, TimedPicture
from drake_pose.camera.synchroniser import CameraChange, SynchronisedFrames, Synchroniser
from drake_pose.errors import CameraError, SettingsError, UnknownNameError
from drake_pose.silhouette.pictures.label_images import fill_label_image, label_image_to_mask
from drake_pose.silhouette.pictures.scenes import USUAL_RATE_HZ
from drake_pose.silhouette.segmentation import Background, person_region
from drake_pose.systems.images import colour_image_to_picture, fill_colour_image
from drake_pose.systems.ports import PortedSystem, require_period


@dataclass(frozen=True)
class CameraCount:
    """How a camera did.

    Args:
        used: pictures that were part of a moment shown.
        dropped: pictures that could not be used.
        late: pictures that came after their moment.
        changes: when it stopped and returned.
    """

    used: int
    dropped: int
    late: int
    changes: tuple[CameraChange, ...]


class PictureCapture(PortedSystem):
    """Gives the synchronised pictures of several cameras.

    .. pydrake_system::

        name: PictureCapture
        output_ports: [color_image_<camera>, label_image_<camera>, time, fresh]

    A camera whose source delivers masks has the port ``label_image_<camera>``, any other
    ``color_image_<camera>``. An image without pixels says that the camera gave no picture at that
    moment. ``time`` is the moment's time stamp [s], counted from the first one, nan before it;
    ``fresh`` is 1 where the moment is new in this period, else 0.

    Recorded sources follow the simulation's time: each moment is shown, and the simulation ends
    after the last one. If ``live``, moments follow the computer's clock: the newest one is shown;
    at first the system waits some seconds for all cameras to open. What comes from outside cannot
    be in a Context: one simulator runs one such system.

    Args:
        sources: where each camera's pictures come from, opened.
        period: time between two looks at the sources [s]; the sources' own where not given.
        live: whether the pictures come by the computer's clock; true where a source is live.
        tolerance: how far apart the pictures of one moment may be [s]; half a period where not
            given, 0.9 periods for live cameras, which are not triggered together.
        clock: the computer's [s]; the one that live sources use.
        opening: how long to wait for the first pictures of live cameras [s].

    Raises:
        SettingsError: no source, or times that cannot be.
        UnknownNameError: a source belongs to no camera.
    """

    def __init__(
        self,
        sources: Mapping[str, FrameSource],
        cameras: Mapping[str, Camera],
        period: float | None = None,
        *,
        live: bool | None = None,
        tolerance: float | None = None,
        clock: Clock = time.monotonic,
        opening: float = 8.0,
    ) -> None:
        super().__init__()
        for name in sources:
            if name not in cameras:
                raise UnknownNameError("camera", name, cameras, "the calibration")
        self._sources = dict(sources)
        devices = any(one.specification.live for one in sources.values())
        self.live = devices if live is None else live
        if devices and not self.live:
            raise SettingsError("live cameras cannot be captured by the simulation's time")
        if period is None:
            rates = [rate for one in sources.values() if (rate := one.rate_hz) is not None]
            period = 1.0 / max(rates, default=USUAL_RATE_HZ)
        self.period = period
        require_period("capture", self.period)
        if tolerance is None:
            tolerance = (0.9 if devices else 0.5) * self.period
        self._synchroniser: Synchroniser[TimedPicture] = Synchroniser(
            self._sources, tolerance, timeout=max(4.0 * self.period, tolerance)
        )
        self._clock, self._opening = clock, opening
        self._since: float | None = None
        self._opened: set[str] = set()
        self._begin: float | None = None
        self._origins: dict[str, float] = {}
        self._pending: dict[str, TimedPicture | None] = dict.fromkeys(self._sources)
        # The one that is shown; its time counts from the first one.
        self.moment: SynchronisedFrames[TimedPicture] | None = None
        self._used = dict.fromkeys(self._sources, 0)
        self._changes: dict[str, list[CameraChange]] = {name: [] for name in self._sources}
        self._reports: list[str] = []
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
        self.DeclarePeriodicUnrestrictedUpdateEvent(self.period, 0.0, self._look)
        self.DeclareForcedUnrestrictedUpdateEvent(self._look)

    def counts(self) -> dict[str, CameraCount]:
        """How each camera did so far."""
        return {
            name: CameraCount(
                self._used[name],
                source.dropped,
                self._synchroniser.late[name],
                tuple(self._changes[name]),
            )
            for name, source in self._sources.items()
        }

    def take_reports(self) -> list[str]:
        """What the user should know and was not told yet: cameras that stopped, bad pictures."""
        for source in self._sources.values():
            self._reports += source.problems
            source.problems.clear()
        reports, self._reports = self._reports, []
        return reports

    def close(self) -> None:
        """Closes files and cameras."""
        for source in self._sources.values():
            source.close()

    def _look(self, context: Context, state: State) -> EventStatus:
        if self._begin is None:
            self._begin = self._start()
        if self._begin is None:
            return EventStatus.Succeeded()
        now = self._clock() - self._begin if self.live else context.get_time()
        for name, source in self._sources.items():
            # Half a millionth of a period keeps what is due at a tick in spite of rounding.
            self._feed(name, source, now + 5e-7 * self.period)
        moment = self._synchroniser.take(now)
        while self.live and moment is not None:
            newer = self._synchroniser.take(now)
            if newer is None:
                break
            moment, self.skipped = newer, self.skipped + 1
        self._note_changes()
        state.get_mutable_discrete_state(self._fresh).SetFromVector([float(moment is not None)])
        if moment is None:
            ended = all(source.ended for source in self._sources.values())
            rest = any(self._synchroniser.waiting(name) for name in self._sources)
            if ended and not rest and not any(self._pending.values()):
                return EventStatus.ReachedTermination(self, "the recording has ended")
            return EventStatus.Succeeded()
        self.moment = moment
        for name in moment.items:
            self._used[name] += 1
        state.get_mutable_discrete_state(self._time).SetFromVector([moment.time])
        return EventStatus.Succeeded()

    def _start(self) -> float | None:
        """Time 0 by the clock [s], from which time stamps are counted; None: cameras are opening.

        Time stamps of recorded pictures are counted from the first one's.
        """
        recorded = [name for name, one in self._sources.items() if not one.specification.live]
        for name, source in self._sources.items():
            if name in recorded or source.ended or source.read() is not None:
                self._opened.add(name)
        now = self._clock()
        self._since = now if self._since is None else self._since
        if len(self._opened) < len(self._sources) and now - self._since < self._opening:
            return None
        for name in recorded:
            self._pending[name] = self._sources[name].read()
        first = min([one.time for one in self._pending.values() if one is not None], default=0.0)
        begin = self._clock() if self.live else 0.0
        self._origins = {name: first if name in recorded else begin for name in self._sources}
        return begin

    def _feed(self, name: str, source: FrameSource, now: float, ahead: int = 8) -> None:
        """Hands on the pictures of a source that are due; the first later one is kept.

        ahead: number of pictures that a recorded source is read ahead of its slowest neighbour.
        """
        origin, synchroniser = self._origins[name], self._synchroniser
        if source.specification.live:
            one = source.read()
            if one is not None:
                synchroniser.add(name, one.time - origin, one)
            elif source.ended:
                synchroniser.finish(name)
            return
        while self.live or synchroniser.waiting(name) < ahead:
            one = self._pending[name]
            if one is None:
                one = self._pending[name] = source.read()
            if one is None:
                # Live, one that is silent is waited for; a recording has waited itself.
                if source.ended or not self.live:
                    synchroniser.finish(name)
                return
            if one.time - origin > now:
                return
            synchroniser.add(name, one.time - origin, one)
            self._pending[name] = None

    def _note_changes(self) -> None:
        for change in self._synchroniser.take_changes():
            self._changes[change.camera].append(change)
            if not change.stopped:
                text = f"returned at {change.time:.2f} s"
            elif math.isnan(change.time):
                text = "gives no picture; the others go on without it"
            else:
                text = f"stopped at {change.time:.2f} s; the others go on without it"
            self._reports.append(f"camera '{change.camera}' {text}")

    def _calc_image(
        self, name: str, fill: Callable[[Any, np.ndarray], None], _: Context, output: AbstractValue
    ) -> None:
        image = output.get_mutable_value()
        one = None if self.moment is None else self.moment.items.get(name)
        if one is None:
            image.resize(0, 0)
        else:
            fill(image, one.picture)


class PersonRegion(PortedSystem):
    """Finds the person's region in one camera's picture.

    .. pydrake_system::

        name: PersonRegion
        input_ports: [color_image, label_image]
        output_ports: [region]

    The region, a mask (H, W), is that of ``label_image``, where not connected that of the
    background model; None where the image that tells it is unconnected or has no pixels: then the
    camera gave no picture at that moment.

    Attributes:
        wanted: the inputs that tell the region.

    Args:
        background: the camera's view of the empty room; None if ``label_image`` is connected.

    Raises:
        SettingsError: the background's size is not the camera's. When evaluated: there is neither a
            background nor a label image.
        CameraError: when evaluated: an image has another size than the camera's.
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
        """A given image; None while the camera has stopped; CameraError: it has another size."""
        image, camera = self.given(context, name), self._camera
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
        """The picture (H, W, 3); None while the camera has stopped."""
        image = self._image(context, "color_image")
        return None if image is None else colour_image_to_picture(image)

    def _region(self, context: Context) -> Mask | None:
        """Where the person is (H, W); None while the camera has stopped."""
        if self.GetInputPort("label_image").HasValue(context):
            image = self._image(context, "label_image")
            return None if image is None else label_image_to_mask(image)
        image = self._image(context, "color_image")
        if image is None:
            return None
        if self._background is None:
            raise SettingsError(
                f"camera '{self._camera.name}': nothing tells the person from what is behind; give "
                "a background model or connect label_image"
            )
        # It copies, piece by piece, only what it looks at, without the fourth channel.
        return person_region(image.data, self._background)


def connect_images(
    builder: DiagramBuilder, source: System | None, wanted: Mapping[str, Sequence[InputPort]]
) -> None:
    """Connects images by the names of a source's outputs, or as inputs of the diagram.

    Raises SettingsError where the source lacks one.
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
