"""The sensors of a live capture on workers: each opens the sources of its cameras itself.

A worker that dies is replaced.
"""

from __future__ import annotations

import asyncio
import math
import pickle
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import Context, DependencyTicket, DiagramBuilder, OutputPort

from drake_pose.camera.frame_source import (
    Clock,
    FrameSource,
    SourceSpecification,
    TimedPicture,
)
from drake_pose.camera.models import Camera
from drake_pose.errors import ClusterError, DrakePoseError
from drake_pose.jobs.cluster import camera_worker
from drake_pose.jobs.cluster.camera_worker import COUNT, WatchReply
from drake_pose.jobs.cluster.lines import Line, Listening, RemoteKeeper, listed
from drake_pose.jobs.cluster.scheduler import CameraAssignment, assign_cameras, host_of
from drake_pose.jobs.cluster.worker import worker_resources
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.person.views import KeptEdge, SilhouetteView, edge_spacing, unpack_view
from drake_pose.systems.person.live_capture import LiveSensors

if TYPE_CHECKING:
    from distributed import Client, Future

# How long a recording waits for a worker, which may be started again meanwhile [s].
_PATIENCE = 10.0
# How long opening the sources may take, with all that a worker must import for it [s].
_OPENING = 120.0
# How often it is looked whether a worker that does not answer is still there [s].
_ALIVE_PERIOD = 0.25
# A worker that does not answer for this long is said to be silent [s].
_SILENCE = 3.0
_POLL_PAUSE = 0.0005


class ClusterSensors(LiveSensors):
    """Gives the synchronised views of cameras that workers look through, each its own group.

    .. pydrake_system::

        name: ClusterSensors
        output_ports: [silhouette_<camera>, time, fresh]

    A worker says in a few kilobytes what its cameras see, and adds up what they say of a pose, as
    often as a fit asks. A worker that dies costs the others nothing; another one, or itself when it
    was started again, goes on with its cameras.

    Attributes:
        groups: of cameras, one for each worker.
        reports: what the user should know and was not told yet.

    Args:
        live: whether the computer's clock decides; where not given, if a camera is live.
        tolerance: how far apart the pictures of one moment may be [s].
        clock: the one of live cameras' time stamps; machines share none but that of the day.

    Raises:
        SceneError: a source cannot be opened.
        SettingsError: the tolerance cannot be.
        ClusterError: there is no worker, or they do not get ready.
    """

    def __init__(
        self,
        client: Client,
        scene: LiveScene,
        live: bool | None = None,
        tolerance: float | None = None,
        clock: Clock = time.time,
    ) -> None:
        given = scene.specifications
        self.client, self.reports = client, list[str]()
        self.spacings = {name: edge_spacing(camera) for name, camera in scene.cameras.items()}
        # A worker that does not answer is waited for, as a recording can.
        self.waits = not (any(one.live for one in given.values()) if live is None else live)
        self._addresses: tuple[str, ...] = ()
        self._warm: dict[str, Future] = {}
        self._looked = self._pumped = -math.inf
        # Where they lie before their first moment is known.
        self.moment, self._origins = None, {}
        assignments = assign_cameras(list(given.values()), client.run(worker_resources))
        self.groups = [WatchedGroup(self, assignment) for assignment in assignments]
        try:
            for group in self.groups:
                group.settle()
            for group in self.groups:
                group.require_ready()
        except DrakePoseError:
            self.close()
            raise
        self._keepers = {name: group.keeper for group in self.groups for name in group.sources}
        sources = {name: one for group in self.groups for name, one in group.sources.items()}
        super().__init__(sources, scene.cameras, {}, live=live, tolerance=tolerance, clock=clock)

    def add(self, builder: DiagramBuilder) -> dict[str, OutputPort]:
        """Adds itself to a diagram; by camera the port of a view or None."""
        builder.AddNamedSystem("remote_sensors", self)
        return {name: self.GetOutputPort(f"silhouette_{name}") for name in self._sources}

    def take_reports(self) -> list[str]:
        """What the user should know and was not told yet."""
        reports = [*self.reports, *super().take_reports()]
        self.reports.clear()
        return reports

    def close(self) -> None:
        """Lets go of the cameras."""
        for group in self.groups:
            group.close()

    def addresses(self) -> tuple[str, ...]:
        """The workers that are there, looked up a few times a second."""
        if time.monotonic() - self._looked > _ALIVE_PERIOD:
            self._addresses = tuple(sorted(self.client.nthreads()))
            self._looked = time.monotonic()
        return self._addresses

    def free_address(self, group: WatchedGroup) -> tuple[str, bool]:
        """The worker with the fewest groups, "" where there is none; whether it has no group."""
        loads = dict.fromkeys(filter(group.assignment.allows, self.addresses()), 0)
        for other in self.groups if loads else ():
            if other is not group and other.address in loads:
                loads[other.address] += 1
        best = min(loads, key=loads.__getitem__, default="")
        return best, not loads.get(best)

    def is_warm(self, address: str) -> bool:
        """Whether a worker has imported what it needs; it begins to where it has not."""
        if address not in self._warm:
            self._warm[address] = self.submit(address, camera_worker.warm)
        return bool(self._warm[address].done())

    def submit(self, address: str, function: Callable, *arguments: object) -> Future:
        """Has a worker call a function."""
        return self.client.submit(function, *arguments, workers=[address], pure=False)

    def pump(self) -> None:
        """Takes what came, and asks for more."""
        now = time.monotonic()
        # Every camera calls, a hundred of them at once.
        if now - self._pumped >= _POLL_PAUSE:
            self._pumped = now
            for group in self.groups:
                group.pump()

    def overdue(self, camera: str) -> float:
        """The time stamp up to which a camera's pictures come too late [s]."""
        if self.waits or self.moment is None:
            return -math.inf
        return self._origins[camera] + self.moment.time

    def _declare_outputs(self, cameras: Mapping[str, Camera], ticket: DependencyTicket) -> None:
        for name in self._sources:
            self.add_output(f"silhouette_{name}", None, partial(self._view, name), {ticket})

    def _feed(self, name: str, source: FrameSource, now: float) -> None:
        """Hands on the views of a camera that are due; one that is silent is waited for."""
        self._feed_due(name, source, now)

    def _view(self, name: str, _: Context) -> SilhouetteView | None:
        one = None if self.moment is None else self.moment.items.get(name)
        if one is None:
            return None
        return unpack_view(one.picture.tobytes(), KeptEdge(self._keepers[name], name, one.time))


class WatchedSource(FrameSource):
    """A camera whose pictures stay where they are: gives packed views in their place.

    Attributes:
        queue: what came and was not read yet.
        is_over: whether the worker has said that nothing will come any more.
        rate: pictures a second, where known.
    """

    def __init__(self, specification: SourceSpecification, look: Callable[[], None]) -> None:
        super().__init__(specification)
        self.queue: deque[TimedPicture] = deque()
        self.is_over = False
        self.rate: float | None = None
        self._look = look

    @property
    def ended(self) -> bool:
        """Whether nothing will come any more."""
        return self.is_over and not self.queue

    @property
    def rate_hz(self) -> float | None:
        """As the source says where it is open."""
        return self.rate

    def close(self) -> None:
        """Nothing is held open here."""

    def _read(self) -> TimedPicture | None:
        self._look()
        return self.queue.popleft() if self.queue else None


class WatchedGroup:
    """Cameras that one worker, of an address, watches: Dask opens them, a line brings their views.

    Attributes:
        sources: by camera.
        keeper: asks the worker for sums over its cameras.
        views, view_bytes, seconds: how many views came, of how many bytes, and the work for them.
    """

    def __init__(self, sensors: ClusterSensors, assignment: CameraAssignment) -> None:
        self.assignment, self.address = assignment, ""
        self.sources = {
            one.camera: WatchedSource(one, partial(self._look, one.camera))
            for one in assignment.specifications
        }
        self.views, self.view_bytes, self.seconds = 0, 0, 0.0
        self.keeper = RemoteKeeper(self.sources, sensors.reports.append)
        self._sensors, self._key = sensors, uuid.uuid4().hex
        self._names = listed(self.sources)
        self._last = dict.fromkeys(self.sources, -np.inf)
        self._opening: Future | None = None
        self._line: Line | None = None
        # Since when the worker has not answered; whether it has been asked.
        self._since, self._is_asked = time.monotonic(), False
        self._silent = self._given_up = self._has_answered = False

    def settle(self) -> None:
        """Finds a worker where there is none; moves to a free one from one that has two groups."""
        sensors = self._sensors
        best, is_free = sensors.free_address(self)
        if self.address:
            shares = any(o.address == self.address for o in sensors.groups if o is not self)
            if not (best and is_free and shares and sensors.is_warm(best)):
                return
            sensors.reports.append(f"camera {self._names} moves to a worker of its own")
            self._close_watch()
            self._hang_up()
        self.address = best
        if best:
            given = self._key, self.assignment.specifications, sensors.spacings
            self._opening = sensors.submit(best, camera_worker.open_watch, *given)
            self._since = time.monotonic()

    def require_ready(self) -> None:
        """Waits until the sources are open and answer, or raises why they do not."""
        if self._opening is None:
            return
        try:
            self._connect(self._opening.result(timeout=_OPENING))
        except asyncio.TimeoutError:
            raise ClusterError(f"the worker of camera {self._names} does not get ready") from None
        # What it says of the pictures' rates decides how often the sensors are looked at.
        end = time.monotonic() + _PATIENCE
        while not self._has_answered:
            if time.monotonic() > end:
                raise ClusterError(
                    f"the worker of camera {self._names} at {self.address} cannot be reached at a "
                    "port of its own, beside Dask's: let programs on its machine listen"
                )
            time.sleep(_POLL_PAUSE)
            self._exchange()

    def pump(self) -> None:
        """Takes what came, asks for more, and looks for another worker where this one died."""
        if self.address and self.address not in self._sensors.addresses():
            self._lose("was lost")
        elif self._opening is not None:
            if self._opening.done():
                self._finish_opening(self._opening)
        else:
            self._exchange()
        silence = time.monotonic() - self._since
        if self.address and silence > _SILENCE:
            self._report_silence("does not answer")
            if self._opening is None and silence > _PATIENCE:
                # The connection may be dead and the worker alive: Dask finds out.
                self._lose("does not answer")

    def close(self) -> None:
        """Lets go of the sources."""
        self._hang_up()
        for source in self.sources.values():
            source.is_over = True
        if self.address in self._sensors.addresses():
            with suppress(asyncio.TimeoutError):
                self._close_watch().exception(timeout=_PATIENCE)

    def _look(self, camera: str) -> None:
        """Takes what came; a recording waits until there is something of a camera, or never is."""
        self._sensors.pump()
        begin, source = time.monotonic(), self.sources[camera]
        while self._sensors.waits and not (source.queue or source.is_over or self._given_up):
            self._sensors.pump()
            # The next time nobody waits, until it answers.
            self._given_up = time.monotonic() - begin > _PATIENCE
            time.sleep(_POLL_PAUSE)

    def _exchange(self) -> None:
        """Takes the reply if it came, and asks again where too little waits here."""
        if self._is_asked and self._line is not None:
            if (data := self._line.receive()) is None:
                return
            self._is_asked = False
            self._take(pickle.loads(data))
        self.settle()
        waiting = [len(one.queue) for one in self.sources.values() if not one.is_over]
        is_wanted = self._line is not None and min(waiting, default=COUNT) < COUNT
        if self._line is not None and is_wanted:
            overdue = self._sensors.overdue
            after = {name: max(stamp, overdue(name)) for name, stamp in self._last.items()}
            self._is_asked = self._line.send(pickle.dumps(after))
        if self._is_asked or not is_wanted:
            self._since = time.monotonic()

    def _take(self, reply: WatchReply) -> None:
        if self._silent:
            self._sensors.reports.append(f"a worker goes on with camera {self._names}")
        self._silent, self._given_up, self._has_answered = False, False, True
        for name, views in reply.views.items():
            for stamp, frame, view in views:
                packed = np.frombuffer(view, dtype=np.uint8)
                self.sources[name].queue.append(TimedPicture(stamp, frame, packed))
                self._last[name] = stamp
                self.view_bytes += len(view)
            self.views += len(views)
        for name, source in self.sources.items():
            source.is_over, source.dropped, source.rate = reply.states[name]
        self.seconds += reply.seconds
        self._sensors.reports.extend(reply.problems)

    def _finish_opening(self, opening: Future) -> None:
        how = "its task was lost"
        try:
            self._connect(opening.result(timeout=_ALIVE_PERIOD))
            return
        except DrakePoseError as error:
            how = str(error)
        except (Exception, asyncio.CancelledError):  # noqa: BLE001
            # Whatever a task raises comes here: Dask's own errors, too.
            pass
        self._lose(f"failed ({how})")

    def _connect(self, listening: Listening) -> None:
        """Connects to where the worker listens beside Dask."""
        host = host_of(self.address)
        self._line, sums = (Line(host, port, listening.key) for port in listening.ports)
        self.keeper.move_to(sums)
        self._opening, self._is_asked, self._since = None, False, time.monotonic()

    def _hang_up(self) -> None:
        self.keeper.move_to(None)
        if self._line is not None:
            self._line.close()
        if self._opening is not None:
            self._opening.cancel()
        self._line, self._opening, self._is_asked = None, None, False

    def _lose(self, how: str) -> None:
        self._report_silence(how)
        self._hang_up()
        self.address = ""

    def _report_silence(self, how: str) -> None:
        if not self._silent:
            self._sensors.reports.append(
                f"the worker of camera {self._names} {how}; the others go on without"
            )
        self._silent = True

    def _close_watch(self) -> Future:
        return self._sensors.submit(self.address, camera_worker.close_watch, self._key)
