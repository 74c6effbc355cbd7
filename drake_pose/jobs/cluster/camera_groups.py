"""Groups of cameras, each watched by a worker; a worker that dies is replaced."""

from __future__ import annotations

import asyncio
import pickle
import time
import uuid
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drake_pose.camera.sources.frame_source import FrameSource, SourceSpecification, TimedPicture
from drake_pose.errors import ClusterError, DrakePoseError
from drake_pose.jobs.cluster import camera_worker
from drake_pose.jobs.cluster.camera_worker import WatchReply, host_of
from drake_pose.jobs.cluster.lines import Line, Listening, RemoteKeeper
from drake_pose.jobs.cluster.worker import worker_resources

if TYPE_CHECKING:
    from distributed import Client, Future

# How many pictures of each camera are asked for at once, and asked for again when fewer wait here.
_COUNT = 4
# How long a recording waits for a worker, which may be started again meanwhile [s].
_PATIENCE = 10.0
# How long opening the sources may take, with all that a worker must import for it [s].
_OPENING = 120.0
# How often it is looked whether a worker that does not answer is still there [s].
_ALIVE_PERIOD = 0.25
# A worker that does not answer for this long is said to be silent [s].
_SILENCE = 3.0
_POLL_PAUSE = 0.0005


class CameraAssignment(NamedTuple):
    """Cameras that one worker looks through. hosts: where; empty: anywhere."""

    specifications: tuple[SourceSpecification, ...]
    hosts: frozenset[str] = frozenset()

    def allows(self, address: str) -> bool:
        """Whether the worker of an address can look through them."""
        return not self.hosts or host_of(address) in self.hosts


def assign_cameras(
    specifications: Sequence[SourceSpecification], workers: Mapping[str, Collection[str]]
) -> list[CameraAssignment]:
    """Shares cameras out among workers.

    Recordings and cameras in a network can be opened anywhere. A camera that hangs on a machine is
    looked through by the workers there: where workers run on several machines, those that were
    started with a resource of the camera's name (``workers``: those names by address).

    Raises:
        ClusterError: there is no worker, or nobody says where a camera is.
    """
    if not workers:
        raise ClusterError("there are no workers to watch cameras; start some")
    all_hosts = sorted({host_of(address) for address in workers})
    groups: dict[frozenset[str], list[SourceSpecification]] = {}
    for one in specifications:
        hosts: frozenset[str] = frozenset()
        if len(all_hosts) > 1 and one.live and "://" not in one.location:
            hosts = frozenset(host_of(a) for a, names in workers.items() if one.camera in names)
            if not hosts:
                raise ClusterError(
                    f"camera '{one.camera}' hangs on one of {', '.join(all_hosts)}, and nobody "
                    f'says on which: start a worker there with --resources "{one.camera}=1"'
                )
        groups.setdefault(hosts, []).append(one)
    assignments = []
    for hosts, group in groups.items():
        count = sum(not hosts or host_of(address) in hosts for address in workers)
        # Neighbours stay together.
        for part in np.array_split(np.arange(len(group)), min(count, len(group))):
            assignments.append(CameraAssignment(tuple(group[k] for k in part), hosts))
    return assignments


class Watchers:
    """Workers that watch cameras.

    Attributes:
        groups: of cameras, one for each worker.
        reports: what the user should know and was not told yet.
        overdue: says up to which time stamp a camera's pictures come too late [s].

    Args:
        spacings: from edge point to edge point, by camera [pixel].
        waits: whether a worker that does not answer is waited for, as a recording can.

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
        self.client, self.spacings, self.waits = client, spacings, waits
        self.reports: list[str] = []
        self.overdue: Callable[[str], float] = lambda _: -np.inf
        self._addresses: tuple[str, ...] = ()
        self._warm: dict[str, Future] = {}
        self._looked = self._pumped = -np.inf
        assignments = assign_cameras(specifications, client.run(worker_resources))
        self.groups = [WatchedGroup(self, assignment) for assignment in assignments]
        try:
            for group in self.groups:
                group.settle()
            for group in self.groups:
                group.require_ready()
        except DrakePoseError:
            self.close()
            raise

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

    def close(self) -> None:
        """Lets go of the cameras."""
        for group in self.groups:
            group.close()


class WatchedGroup:
    """Cameras that one worker, of an address, watches: Dask opens them, a line brings their views.

    Attributes:
        queues: by camera, what came and was not read yet.
        ended: the cameras that will give nothing any more.
        rates, dropped: by camera, pictures a second, where known; pictures that were unusable.
        keeper: asks the worker for sums over its cameras.
        views, view_bytes, seconds: how many views came, of how many bytes, and the work for them.
    """

    def __init__(self, watchers: Watchers, assignment: CameraAssignment) -> None:
        self.assignment, self.address = assignment, ""
        self.specifications = {one.camera: one for one in assignment.specifications}
        names = tuple(self.specifications)
        self.queues: dict[str, deque[TimedPicture]] = {name: deque() for name in names}
        self.ended: set[str] = set()
        self.rates: dict[str, float | None] = dict.fromkeys(names)
        self.dropped = dict.fromkeys(names, 0)
        self.views, self.view_bytes, self.seconds = 0, 0, 0.0
        self.keeper = RemoteKeeper(names, lambda text: watchers.reports.append(text))
        self._watchers, self._key = watchers, uuid.uuid4().hex
        self._names = ", ".join(f"'{name}'" for name in names)
        self._after = dict.fromkeys(names, -np.inf)
        self._opening: Future | None = None
        self._line: Line | None = None
        # Since when the worker has not answered; whether it is still to be asked.
        self._since, self._is_asked = time.monotonic(), False
        self._silent = self._given_up = False

    def settle(self) -> None:
        """Finds a worker where there is none; moves to a free one from one that has two groups."""
        watchers = self._watchers
        best, is_free = watchers.free_address(self)
        if self.address:
            shares = any(o.address == self.address for o in watchers.groups if o is not self)
            if not (best and is_free and shares and watchers.is_warm(best)):
                return
            watchers.reports.append(f"camera {self._names} moves to a worker of its own")
            self._close_watch()
            self._hang_up()
        self.address = best
        if best:
            given = self._key, self.assignment.specifications, watchers.spacings
            self._opening = watchers.submit(best, camera_worker.open_watch, *given)
            self._since = time.monotonic()

    def require_ready(self) -> None:
        """Waits until the sources are open and answer, or raises why they do not."""
        if self._opening is None:
            return
        try:
            self._connect(self._opening.result(timeout=_OPENING))
        except asyncio.TimeoutError:
            raise ClusterError(f"the worker of camera {self._names} does not get ready") from None
        end, line = time.monotonic() + _PATIENCE, self._line
        while line is not None and not self._ask(line, 0):
            if time.monotonic() > end:
                raise ClusterError(
                    f"the worker of camera {self._names} at {self.address} cannot be reached at a "
                    "port of its own, beside Dask's: let programs on its machine listen"
                )
            time.sleep(_POLL_PAUSE)
        # What it says of the pictures' rates decides how often the sensors are looked at.
        self._receive(_PATIENCE)

    def pump(self) -> None:
        """Takes what came, asks for more, and looks for another worker where this one died."""
        if self.address and self.address not in self._watchers.addresses():
            self._lose("was lost")
        elif self._opening is not None:
            if self._opening.done():
                self._finish_opening(self._opening)
        elif self._is_asked:
            self._receive()
        else:
            self.settle()
            waiting = [len(q) for name, q in self.queues.items() if name not in self.ended]
            if self._line is not None and min(waiting, default=_COUNT) < _COUNT:
                self._ask(self._line, _COUNT)
            else:
                self._since = time.monotonic()
        silence = time.monotonic() - self._since
        if self.address and silence > _SILENCE:
            self._report_silence("does not answer")
            if self._opening is None and silence > _PATIENCE:
                # The connection may be dead and the worker alive: Dask finds out.
                self._lose("does not answer")

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
        self._hang_up()
        self.ended.update(self.specifications)
        if self.address in self._watchers.addresses():
            with suppress(asyncio.TimeoutError):
                self._close_watch().exception(timeout=_PATIENCE)

    def _ask(self, line: Line, count: int) -> bool:
        """Asks for views; False where there is no connection, yet or any more."""
        overdue = self._watchers.overdue
        after = {name: max(stamp, overdue(name)) for name, stamp in self._after.items()}
        self._is_asked = line.send(pickle.dumps((count, after)))
        if self._is_asked:
            self._since = time.monotonic()
        return self._is_asked

    def _receive(self, patience: float = 0.0) -> None:
        data = None if self._line is None else self._line.receive(patience)
        if data is not None:
            self._is_asked, self._since = False, time.monotonic()
            self._take(pickle.loads(data))

    def _finish_opening(self, opening: Future) -> None:
        self._opening = None
        try:
            self._connect(opening.result(timeout=_ALIVE_PERIOD))
        except (asyncio.TimeoutError, asyncio.CancelledError):
            self._lose("failed (its task was lost)")
        except Exception as error:  # noqa: BLE001
            # Whatever a task raises comes here: Dask's own errors, too.
            is_ours = isinstance(error, DrakePoseError)
            self._lose(f"failed ({error if is_ours else 'its task was lost'})")

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
        self._line = self._opening = None
        self._is_asked = False

    def _lose(self, how: str) -> None:
        self._report_silence(how)
        self._hang_up()
        self.address = ""

    def _report_silence(self, how: str) -> None:
        if not self._silent:
            self._watchers.reports.append(
                f"the worker of camera {self._names} {how}; the others go on without"
            )
        self._silent = True

    def _close_watch(self) -> Future:
        return self._watchers.submit(self.address, camera_worker.close_watch, self._key)

    def _take(self, reply: WatchReply) -> None:
        if self._silent:
            self._watchers.reports.append(f"a worker goes on with camera {self._names}")
        self._silent = self._given_up = False
        for name, views in reply.views.items():
            for stamp, frame, view in views:
                packed = np.frombuffer(view, dtype=np.uint8)
                self.queues[name].append(TimedPicture(stamp, frame, packed))
                self._after[name] = stamp
                self.view_bytes += len(view)
            self.views += len(views)
        self.ended.update(reply.ended)
        self.rates.update(reply.rates)
        self.dropped.update(reply.dropped)
        self.seconds += reply.seconds
        self._watchers.reports.extend(reply.problems)


class WatchedSource(FrameSource):
    """A camera whose pictures stay where they are: gives packed views in their place."""

    def __init__(
        self, specification: SourceSpecification, group: WatchedGroup, watchers: Watchers
    ) -> None:
        super().__init__(specification)
        self._name, self._group, self._watchers = specification.camera, group, watchers

    @property
    def ended(self) -> bool:
        """Whether nothing will come any more."""
        return self._name in self._group.ended and not self._group.queues[self._name]

    @property
    def rate_hz(self) -> float | None:
        """As the source says where it is open."""
        return self._group.rates[self._name]

    def close(self) -> None:
        """Nothing is held open here."""

    def _read(self) -> TimedPicture | None:
        self._watchers.pump()
        if self._watchers.waits:
            self._group.await_camera(self._name)
        self.dropped = self._group.dropped[self._name]
        queue = self._group.queues[self._name]
        return queue.popleft() if queue else None
