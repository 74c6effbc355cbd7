"""Groups of cameras, each watched by a worker; a worker that dies is replaced."""

from __future__ import annotations

import asyncio
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Future as OpeningFuture
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING

import numpy as np

from drake_pose.camera.sources.frame_source import FrameSource, SourceSpecification, TimedPicture
from drake_pose.errors import ClusterError, DrakePoseError
from drake_pose.fit.camera_sums import EdgeKeeper
from drake_pose.jobs.cluster import camera_worker
from drake_pose.jobs.cluster.camera_assignment import CameraAssignment, assign_cameras, host_of
from drake_pose.jobs.cluster.camera_worker import WatchReply, WatchRequest
from drake_pose.jobs.cluster.edge_server import POLLS
from drake_pose.jobs.cluster.lines import LineReply, hang_up, open_line
from drake_pose.jobs.cluster.remote_keeper import RemoteKeeper
from drake_pose.jobs.cluster.worker import worker_resources

if TYPE_CHECKING:
    from distributed import Client, Future

# How many pictures of each camera are asked for at once, and asked for again when fewer wait here.
_COUNT = 4
# How long a worker waits for a live camera's picture before it says that there is none [s].
_LIVE_PATIENCE = 0.1
# How long a recording waits for a worker, which may be started again meanwhile [s].
_PATIENCE = 10.0
# How long opening the sources may take, with all that a worker must import for it [s].
_OPENING = 120.0
# How often it is looked whether a worker that does not answer is still there [s].
_ALIVE_PERIOD = 0.25
# A worker that does not answer for this long is said to be silent [s].
_SILENCE = 3.0
_POLL_PAUSE = 0.0005


class Watchers:
    """Workers that watch cameras.

    Attributes:
        groups: of cameras, one for each worker.
        reports: what the user should know and was not told yet.
        overdue: says up to which time stamp a camera's pictures come too late [s].

    Args:
        client: of the cluster.
        specifications: of the cameras' sources.
        spacings: from edge point to edge point, by camera [pixel].
        waits: whether a recording waits for a worker that does not answer; live, it goes on.

    Raises:
        ClusterError: there is no worker, or they do not get ready.
        SceneError: a source cannot be opened.
    """

    def __init__(
        self,
        client: Client,
        specifications: Sequence[SourceSpecification],
        spacings: Mapping[str, float],
        waits: bool,
    ) -> None:
        self._client, self.waits = client, waits
        self.reports: list[str] = []
        self.overdue: Callable[[str], float] = lambda _: -np.inf
        self._addresses: tuple[str, ...] = ()
        self._warm: dict[str, Future] = {}
        self._looked = self._pumped = -np.inf
        assignments = assign_cameras(specifications, client.run(worker_resources))
        self.groups = [WatchedGroup(self, assignment, spacings) for assignment in assignments]
        try:
            for group in self.groups:
                group.prepare()
            for group in self.groups:
                group.require_ready()
        except DrakePoseError:
            self.close()
            raise

    @property
    def client(self) -> Client:
        """Of the cluster."""
        return self._client

    def addresses(self) -> tuple[str, ...]:
        """The workers that are there, looked up a few times a second."""
        if time.monotonic() - self._looked > _ALIVE_PERIOD:
            self._addresses = tuple(sorted(self._client.nthreads()))
            self._looked = time.monotonic()
        return self._addresses

    def free_address(self, group: WatchedGroup) -> str | None:
        """The worker with the fewest groups; None where none can look through the cameras."""
        loads = dict.fromkeys(filter(group.assignment.allows, self.addresses()), 0)
        for other in self.groups:
            if other is not group and other.address in loads:
                loads[other.address] += 1
        return min(loads, key=loads.__getitem__, default=None)

    def is_warm(self, address: str) -> bool:
        """Whether a worker has imported what it needs; it begins to where it has not."""
        if address not in self._warm:
            self._warm[address] = self._client.submit(
                camera_worker.warm, workers=[address], pure=False
            )
        return bool(self._warm[address].done())

    def pump(self) -> None:
        """Takes what came, and asks for more."""
        now = time.monotonic()
        if now - self._pumped < _POLL_PAUSE:
            # Every camera calls, a hundred of them at once.
            return
        self._pumped = now
        for group in self.groups:
            group.pump()

    def close(self) -> None:
        """Lets go of the cameras."""
        for group in self.groups:
            group.close()


class WatchedGroup:
    """Cameras that one worker watches.

    Attributes:
        assignment: the cameras, and where they can be looked through.
        address: of the worker.
        specifications: by camera, of the cameras' sources.
        queues: by camera, what came and was not read yet.
        ended: the cameras that will give nothing any more.
        rates: by camera, pictures a second, where known.
        dropped: by camera, pictures that could not be used.
        keeper: asks the worker for sums over its cameras.
        views, view_bytes, seconds: how many views came, of how many bytes, and the work for them.

    Args:
        watchers: all of them.
        assignment: the cameras, and where they can be looked through.
        spacings: from edge point to edge point, by camera [pixel].
    """

    def __init__(
        self,
        watchers: Watchers,
        assignment: CameraAssignment,
        spacings: Mapping[str, float],
    ) -> None:
        self.assignment = assignment
        self.specifications = {one.camera: one for one in assignment.specifications}
        self.address = ""
        self.queues: dict[str, deque[TimedPicture]] = {
            name: deque() for name in self.specifications
        }
        self.ended: set[str] = set()
        self.rates: dict[str, float | None] = dict.fromkeys(self.specifications)
        self.dropped = dict.fromkeys(self.specifications, 0)
        self.views, self.view_bytes, self.seconds = 0, 0, 0.0
        self._watchers, self._spacings = watchers, spacings
        self._key = uuid.uuid4().hex
        self.keeper = RemoteKeeper(
            self.specifications, self._key.encode(), lambda text: watchers.reports.append(text)
        )
        self._after = dict.fromkeys(self.specifications, -np.inf)
        self._future: Future | LineReply | None = None
        self._line: OpeningFuture[Connection] | None = None
        self._listening = "", 0
        self._asked = 0.0
        self._silent = self._given_up = False

    @property
    def names(self) -> str:
        """The cameras, for messages."""
        return ", ".join(f"'{name}'" for name in self.specifications)

    def prepare(self) -> None:
        """Begins to open the sources."""
        self.address = self._watchers.free_address(self) or ""
        self._ask(0)

    def require_ready(self) -> None:
        """Waits until the sources are open.

        Raises:
            SceneError: a source cannot be opened.
            ClusterError: the worker does not get ready.
        """
        begin = time.monotonic()
        while self._future is not None:
            if time.monotonic() - begin > _OPENING:
                raise ClusterError(f"the worker of camera {self.names} does not get ready")
            time.sleep(_POLL_PAUSE)
            if self._future.done():
                future, self._future = self._future, None
                self._take(future.result())

    def pump(self) -> None:
        """Takes what came, asks for more, and looks for another worker where this one died."""
        if self._future is None:
            self._settle()
            waiting = [len(q) for name, q in self.queues.items() if name not in self.ended]
            if self.address and min(waiting, default=_COUNT) < _COUNT:
                self._ask(_COUNT)
        elif self.address not in self._watchers.addresses():
            self._future.cancel()
            self._lose("was lost")
        elif self._future.done():
            self._note(self._future)
        elif time.monotonic() - self._asked > _SILENCE:
            self._report_silence("does not answer")
            if isinstance(self._future, LineReply) and time.monotonic() - self._asked > _PATIENCE:
                # The line may be dead and the worker alive: Dask finds out.
                self._future.cancel()
                self._hang_up()
                self._future = None

    def await_camera(self, camera: str) -> None:
        """Waits until there is something of a camera, or nothing is to be expected."""
        begin = time.monotonic()
        while not (self.queues[camera] or camera in self.ended or self._given_up):
            self._watchers.pump()
            # The next time nobody waits, until it answers.
            self._given_up = time.monotonic() - begin > _PATIENCE
            time.sleep(_POLL_PAUSE)

    def close(self) -> None:
        """Lets go of the sources."""
        self.keeper.close()
        self._hang_up()
        if self._future is not None:
            self._future.cancel()
            self._future = None
        self.ended.update(self.specifications)
        if self.address in self._watchers.addresses():
            with suppress(asyncio.TimeoutError):
                self._close_watch().exception(timeout=_PATIENCE)

    @property
    def _client(self) -> Client:
        return self._watchers.client

    def _ask(self, count: int) -> None:
        request = WatchRequest(
            self._key,
            tuple(self.specifications.values()),
            self._spacings,
            {name: max(time, self._watchers.overdue(name)) for name, time in self._after.items()},
            count,
            _LIVE_PATIENCE,
        )
        self._asked = time.monotonic()
        connection = self._line_to_worker() if count else None
        if connection is not None:
            self._future = LineReply(connection, request)
            return
        self._future = self._client.submit(
            camera_worker.poll, request, workers=[self.address], pure=False
        )

    def _line_to_worker(self) -> Connection | None:
        """The connection beside Dask, where there is one by now: Dask costs milliseconds a task."""
        if self._line is None or not self._line.done() or self._line.exception() is not None:
            return None
        return self._line.result()

    def _move_to(self, address: tuple[str, int]) -> None:
        """Connects to where the worker listens; port 0: nowhere."""
        self.keeper.move_to(*address)
        if address == self._listening:
            return
        self._hang_up()
        self._listening = address
        if address[1]:
            self._line = open_line(address, self._key.encode(), [POLLS])

    def _hang_up(self) -> None:
        line, self._line, self._listening = self._line, None, ("", 0)
        if line is not None:
            hang_up(line)

    def _note(self, future: Future | LineReply) -> None:
        """Takes a reply; it may have died with its worker."""
        error = future.exception() if future.status == "error" else None
        if future.status != "finished":
            self._lose(f"failed ({error})" if isinstance(error, DrakePoseError) else "was lost")
            return
        with suppress(asyncio.TimeoutError, asyncio.CancelledError, futures.CancelledError):
            reply = future.result(timeout=_ALIVE_PERIOD)
            self._future = None
            self._take(reply)

    def _lose(self, how: str) -> None:
        self._report_silence(how)
        self._hang_up()
        self._future, self.address = None, ""

    def _report_silence(self, how: str) -> None:
        if not self._silent:
            self._watchers.reports.append(
                f"the worker of camera {self.names} {how}; the others go on without"
            )
        self._silent = True

    def _settle(self) -> None:
        """Finds a worker where there is none; moves to a free one from one that has two groups."""
        from distributed import fire_and_forget

        free = self._watchers.free_address(self)
        if free is None:
            return
        taken = {group.address for group in self._watchers.groups if group is not self}
        if not self.address:
            self.address = free
        elif self.address in taken and free not in taken and self._watchers.is_warm(free):
            fire_and_forget(self._close_watch())
            self._watchers.reports.append(f"camera {self.names} moves to a worker of its own")
            self._hang_up()
            self.address = free

    def _close_watch(self) -> Future:
        return self._client.submit(
            camera_worker.close, self._key, workers=[self.address], pure=False
        )

    def _take(self, reply: WatchReply) -> None:
        if self._silent:
            self._watchers.reports.append(f"a worker goes on with camera {self.names}")
        self._silent = self._given_up = False
        self._move_to((host_of(self.address), reply.port))
        for name, views in reply.views.items():
            for one in views:
                packed = np.frombuffer(one.packed, dtype=np.uint8)
                self.queues[name].append(TimedPicture(one.time, one.frame, packed))
                self._after[name] = one.time
                self.view_bytes += len(one.packed)
            self.views += len(views)
        self.ended.update(reply.ended)
        self.rates.update(reply.rates)
        self.dropped.update(reply.dropped)
        self.seconds += reply.seconds
        self._watchers.reports.extend(reply.problems)


class WatchedSource(FrameSource):
    """A camera whose pictures stay where they are: gives packed views in their place.

    Args:
        specification: where the pictures come from.
        group: to which the camera belongs.
        watchers: all of them.
    """

    def __init__(
        self, specification: SourceSpecification, group: WatchedGroup, watchers: Watchers
    ) -> None:
        super().__init__(specification)
        self._group, self._watchers = group, watchers

    @property
    def ended(self) -> bool:
        """Whether nothing will come any more."""
        name = self.specification.camera
        return name in self._group.ended and not self._group.queues[name]

    @property
    def rate_hz(self) -> float | None:
        """As the source says where it is open."""
        return self._group.rates[self.specification.camera]

    @property
    def keeper(self) -> EdgeKeeper:
        """Who has the edges of the camera's pictures."""
        return self._group.keeper

    def close(self) -> None:
        """Nothing is held open here."""

    def _read(self) -> TimedPicture | None:
        name = self.specification.camera
        self._watchers.pump()
        if self._watchers.waits:
            self._group.await_camera(name)
        self.dropped = self._group.dropped[name]
        queue = self._group.queues[name]
        return queue.popleft() if queue else None
