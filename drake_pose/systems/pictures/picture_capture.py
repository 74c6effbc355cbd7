"""The cameras' pictures as a Drake system: recorded or live, synchronised by their time stamps."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DependencyTicket, EventStatus, State
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.camera.frame_source import (
    CameraChange,
    Clock,
    FrameSource,
    Moment,
    Synchroniser,
    TimedPicture,
)
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.silhouette.pictures.label_images import fill_label_image
from drake_pose.systems.images import fill_colour_image
from drake_pose.systems.ports import PortedSystem, require_period

USUAL_RATE_HZ = 30.0
"""Pictures a second where no source says."""

# A recorded source is read this many pictures ahead of its slowest neighbour.
_AHEAD = 8
# Half a millionth of a period keeps what is due at a tick in spite of rounding.
_ROUNDING = 5e-7
# Live cameras are seldom triggered together: so much of a period may lie between their pictures.
_LIVE_TOLERANCE = 0.9
_PERIODS_OF_PATIENCE = 4.0
# How long it is waited at first for live cameras to give pictures [s].
_OPENING = 8.0


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

    Recorded sources are read as the simulation's time goes on, each moment is shown, and after the
    last one the simulation is told to end. Where `live`, the computer's clock decides, and only the
    newest moment is shown; at first it is waited some seconds for every camera to open. What comes
    from outside cannot be in a Context: one simulator runs one such system.

    Args:
        sources: where each camera's pictures come from, opened.
        period: time between two looks at the sources [s]; the sources' own where not given.
        live: whether the pictures come by the computer's clock; true where a source is live.
        tolerance: how far apart the pictures of one moment may be [s]; half a period where not
            given, 0.9 periods for live cameras, which are not triggered together.
        clock: the computer's [s]; the one that live sources use.

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
        self.period = _usual_period(sources) if period is None else period
        require_period("capture", self.period)
        share = _LIVE_TOLERANCE if devices else 0.5
        tolerance = share * self.period if tolerance is None else tolerance
        patience = max(_PERIODS_OF_PATIENCE * self.period, tolerance)
        self._synchroniser: Synchroniser[TimedPicture] = Synchroniser(
            self._sources, tolerance, patience
        )
        self._clock = clock
        self._since: float | None = None
        self._opened: set[str] = set()
        self._begin: float | None = None
        self._origins: dict[str, float] = {}
        self._pending: dict[str, TimedPicture | None] = dict.fromkeys(self._sources)
        # The one that is shown; its time counts from the first one.
        self.moment: Moment[TimedPicture] | None = None
        self._used = dict.fromkeys(self._sources, 0)
        self._changes: dict[str, list[CameraChange]] = {name: [] for name in self._sources}
        self._reports: list[str] = []
        self.skipped = 0
        self._time = self.DeclareDiscreteState(np.array([math.nan]))
        self._fresh = self.DeclareDiscreteState(1)
        self._declare_outputs(cameras, self.discrete_state_ticket(self._time))
        self.DeclareStateOutputPort("time", self._time)
        self.DeclareStateOutputPort("fresh", self._fresh)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self.period, 0.0, self._look)
        self.DeclareForcedUnrestrictedUpdateEvent(self._look)

    def _declare_outputs(self, cameras: Mapping[str, Camera], ticket: DependencyTicket) -> None:
        """One output a camera."""
        for name, source in self._sources.items():
            size = cameras[name].width, cameras[name].height
            fill: Callable[[Any, np.ndarray], None]
            if source.specification.gives_masks:
                port, image, fill = "label_image", ImageLabel16I(*size), fill_label_image
            else:
                port, image, fill = "color_image", ImageRgba8U(*size), fill_colour_image
            self.DeclareAbstractOutputPort(
                f"{port}_{name}",
                AbstractValue.Make(image).Clone,
                partial(self._calc_image, name, fill),
                {ticket},
            )

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
        """Lets go of files and cameras."""
        for source in self._sources.values():
            source.close()

    def _look(self, context: Context, state: State) -> EventStatus:
        if self._begin is None:
            if self._is_opening():
                return EventStatus.Succeeded()
            self._begin = self._start()
        now = self._clock() - self._begin if self.live else context.get_time()
        for name, source in self._sources.items():
            self._feed(name, source, now + _ROUNDING * self.period)
        moment = self._take(now)
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

    def _is_opening(self) -> bool:
        """Whether it is still waited for the first pictures of live cameras."""
        for name, source in self._sources.items():
            if not source.specification.live or source.ended or source.read() is not None:
                self._opened.add(name)
        if self._since is None:
            self._since = self._clock()
        waited = self._clock() - self._since
        return len(self._opened) < len(self._sources) and waited < _OPENING

    def _start(self) -> float:
        """What is the time 0 of the clock; and that of each camera's time stamps."""
        recorded = []
        for name, source in self._sources.items():
            if not source.specification.live:
                one = self._pending[name] = source.read()
                recorded += [] if one is None else [one.time]
        first = min(recorded, default=0.0)
        begin = self._clock() if self.live else 0.0
        for name, source in self._sources.items():
            self._origins[name] = begin if source.specification.live else first
        return begin

    def _feed(self, name: str, source: FrameSource, now: float) -> None:
        """Hands on the pictures of a source that are due."""
        if source.specification.live:
            one = source.read()
            if one is not None:
                self._synchroniser.add(name, one.time - self._origins[name], one)
            elif source.ended:
                self._synchroniser.finish(name)
            return
        self._feed_due(name, source, now)

    def _feed_due(self, name: str, source: FrameSource, now: float) -> None:
        """Hands on what a source has given up to now; the first later one is kept for its time."""
        while self.live or self._synchroniser.waiting(name) < _AHEAD:
            one = self._pending[name]
            if one is None:
                one = self._pending[name] = source.read()
            if one is None:
                # Live, one that is silent is waited for; a recording has waited itself.
                if source.ended or not self.live:
                    self._synchroniser.finish(name)
                return
            if one.time - self._origins[name] > now:
                return
            self._synchroniser.add(name, one.time - self._origins[name], one)
            self._pending[name] = None

    def _take(self, now: float) -> Moment[TimedPicture] | None:
        """The next moment, or the newest where live."""
        moment = self._synchroniser.take(now)
        while self.live and moment is not None:
            newer = self._synchroniser.take(now)
            if newer is None:
                break
            moment, self.skipped = newer, self.skipped + 1
        return moment

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


def _usual_period(sources: Mapping[str, FrameSource]) -> float:
    """Time between two pictures of the fastest source [s]; 1/30 where none says."""
    rates = [rate for one in sources.values() if (rate := one.rate_hz) is not None]
    return 1.0 / max(rates, default=USUAL_RATE_HZ)
