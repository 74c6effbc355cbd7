"""What a worker does for live capture: it opens some cameras' sources and says what they see.

Sources stay open between polls. Of pictures, which stay here, a few kilobytes and sums are sent.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from drake_pose.camera.sources.files import load_background_pictures, open_source
from drake_pose.camera.sources.frame_source import FrameSource, SourceSpecification
from drake_pose.errors import DrakePoseError
from drake_pose.fit.camera_sums import (
    Views,
    answer_request,
    compare_placed,
    pack_sum,
    unpack_surfaces,
)
from drake_pose.fit.evidence import NO_EDGE, EdgePoints, pack_evidence
from drake_pose.jobs.cluster.lines import Listening, serve
from drake_pose.jobs.cluster.remote_keeper import SURFACES
from drake_pose.person.views import pack_view, see_silhouette
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.segmentation.background import (
    Background,
    learn_background,
    person_region,
)

# Cameras for which nobody asks are let go after this time [s].
_IDLE = 30.0
# Between two checks whether a live camera has a new picture [s].
_POLL_PAUSE = 0.002
# How many of each camera's last pictures are kept: who follows the person is a few of them behind.
_KEPT = 64


@dataclass(frozen=True)
class WatchRequest:
    """What a worker is asked for.

    Args:
        key: the same sources stay open under it.
        spacings: from edge point to edge point, by camera [pixel].
        after: by camera, the time stamp up to which pictures came already or come too late [s].
        count: how many pictures of each camera at most; 0: the sources are opened, no more.
        patience: how long at most until a live camera gives a picture [s].
    """

    key: str
    specifications: tuple[SourceSpecification, ...]
    spacings: Mapping[str, float]
    after: Mapping[str, float]
    count: int
    patience: float


@dataclass(frozen=True, eq=False)
class WatchReply:
    """What a worker saw.

    Args:
        views: by camera, time stamps [s], names of frames, and views as of pack_view.
        ended: the cameras that will give nothing any more.
        dropped: by camera, pictures that could not be used since the sources were opened.
        rates: by camera, pictures a second, where known.
        seconds: of its processor's time, for views and sums [s].
        listening: the ports for polls and sums, at the address where Dask reaches the worker.
    """

    views: Mapping[str, Sequence[tuple[float, str, bytes]]]
    ended: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    dropped: Mapping[str, int] = field(default_factory=dict)
    rates: Mapping[str, float | None] = field(default_factory=dict)
    seconds: float = 0.0
    listening: Listening | None = None


class EdgeServer:
    """Compares contours with the edges of some cameras' last pictures.

    A camera's number is its place among them. seconds: of the processor's time [s].
    """

    def __init__(self, cameras: int) -> None:
        self._edges: list[dict[float, EdgePoints]] = [{} for _ in range(cameras)]
        self._surfaces: PackedOutlines | None = None
        self.seconds = 0.0

    def put(self, number: int, time_stamp: float, edge: EdgePoints) -> None:
        """Keeps a picture's edge."""
        edges = self._edges[number]
        edges[time_stamp] = edge
        if len(edges) > _KEPT:
            del edges[next(iter(edges))]

    def find(self, number: int, time_stamp: float) -> EdgePoints | None:
        """The edge of a picture; None where it is not kept, or not any more."""
        return self._edges[number].get(time_stamp)

    def answer(self, parts: Sequence[bytes]) -> bytes:
        """Takes a body's surfaces, or adds up; nothing where edges are not kept any more."""
        begin = time.thread_time()
        kind, data = parts
        if kind == SURFACES:
            self._surfaces = unpack_surfaces(data)
            _load_kernels(self._surfaces)
            return b""
        total = None
        if self._surfaces is not None:
            total = answer_request(data, self._surfaces, self.find)
        reply = b"" if total is None else pack_sum(total)
        self.seconds += time.thread_time() - begin
        return reply


def _load_kernels(surfaces: PackedOutlines) -> None:
    """Compares with nothing once: kernels are loaded by their first call."""
    nodes = len(surfaces.ordinary_ends)
    views = Views((np.eye(4)[None], np.ones((1, 8))), pack_evidence([NO_EDGE]))
    compare_placed(surfaces, np.tile(np.eye(4), (nodes, 1, 1)), views, np.ones((1, 4)))


class _Watch:
    """Some cameras' sources, open."""

    def __init__(self, request: WatchRequest) -> None:
        self.lock = threading.Lock()
        self.used = time.monotonic()
        self._closed = threading.Event()
        self._sources: dict[str, FrameSource] = {}
        self._backgrounds: dict[str, Background] = {}
        self._edges = EdgeServer(len(request.specifications))
        self._seconds = 0.0
        warm()
        try:
            for one in request.specifications:
                if not one.gives_masks:
                    self._backgrounds[one.camera] = learn_background(load_background_pictures(one))
                # Machines share no other clock than that of the day.
                self._sources[one.camera] = open_source(one, time.time)
        except DrakePoseError:
            self.close()
            raise
        host = _own_host()
        answers = (_poll_pickled, self._edges.answer)
        self._listening = None if host is None else serve(host, answers, self._closed)

    def poll(self, request: WatchRequest) -> WatchReply:
        """What the cameras see now, or next."""
        sources = self._sources
        views: dict[str, list[tuple[float, str, bytes]]] = {name: [] for name in sources}
        end = time.monotonic() + request.patience
        while request.count and not all(source.ended for source in sources.values()):
            begin = time.thread_time()
            for number, (name, source) in enumerate(sources.items()):
                self._see(number, source, views[name], request)
            self._seconds += time.thread_time() - begin
            live = any(one.specification.live for one in sources.values())
            if not live or any(views.values()) or time.monotonic() > end:
                break
            time.sleep(_POLL_PAUSE)
        self.used = time.monotonic()
        problems = tuple(text for one in sources.values() for text in one.problems)
        for source in sources.values():
            source.problems.clear()
        seconds, self._seconds, self._edges.seconds = self._seconds + self._edges.seconds, 0.0, 0.0
        return WatchReply(
            views,
            tuple(name for name, source in sources.items() if source.ended),
            problems,
            {name: source.dropped for name, source in sources.items()},
            {name: source.rate_hz for name, source in sources.items()},
            seconds,
            self._listening,
        )

    def _see(
        self,
        number: int,
        source: FrameSource,
        views: list[tuple[float, str, bytes]],
        request: WatchRequest,
    ) -> None:
        """The next views of one camera."""
        name = source.specification.camera
        while len(views) < request.count and (one := source.read()) is not None:
            # A recording that is opened again begins at its beginning.
            if one.time <= request.after.get(name, -np.inf):
                continue
            if source.specification.gives_masks:
                region = np.asarray(one.picture, dtype=np.bool_)
            else:
                picture = np.asarray(one.picture, dtype=np.uint8)
                region = person_region(picture, self._backgrounds[name])
            view = see_silhouette(region, request.spacings[name])
            self._edges.put(number, one.time, view.edge)
            views.append((one.time, one.frame, pack_view(view)))

    def close(self) -> None:
        """Lets go of the sources."""
        self._closed.set()
        for source in self._sources.values():
            source.close()


def _own_host() -> str | None:
    """Where this worker listens to Dask; None where it is no worker."""
    from distributed import get_worker

    try:
        return host_of(get_worker().address)
    except ValueError:
        return None


def host_of(address: str) -> str:
    """The machine of a worker's address."""
    return address.split("://")[-1].rsplit(":", 1)[0]


_watches: dict[str, _Watch] = {}
_watches_lock = threading.Lock()


def warm() -> None:
    """Brings all to memory that a poll needs, so that the first one is as fast as the others."""
    # A worker is one core.
    cv2.setNumThreads(1)
    region = np.zeros((64, 64), dtype=np.bool_)
    region[16:48, 16:48] = True
    pack_view(see_silhouette(region, 4.0))


def poll(request: WatchRequest) -> WatchReply:
    """Opens the sources if they are not open yet (SceneError), and says what the cameras see."""
    with _watches_lock:
        watch = _watches.get(request.key)
        if watch is None:
            watch = _watches[request.key] = _Watch(request)
            threading.Thread(
                target=_close_when_idle, args=(request.key, watch), daemon=True
            ).start()
    with watch.lock:
        return watch.poll(request)


def _poll_pickled(parts: Sequence[bytes]) -> bytes:
    """As poll, of a request that came by a connection of its own."""
    try:
        return pickle.dumps(poll(pickle.loads(parts[0])))
    except DrakePoseError as error:
        return pickle.dumps(error)


def close(key: str) -> None:
    """Lets go of a watch's sources."""
    with _watches_lock:
        watch = _watches.pop(key, None)
    if watch is not None:
        with watch.lock:
            watch.close()


def _close_when_idle(key: str, watch: _Watch) -> None:
    """Lets go of sources whose capture ended without a word."""
    while _watches.get(key) is watch:
        time.sleep(0.1 * _IDLE)
        if time.monotonic() - watch.used > _IDLE:
            close(key)
