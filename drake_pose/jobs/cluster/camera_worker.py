"""What a worker does for live capture: it opens some cameras' sources and says what they see.

Sources stay open between polls. Of pictures, which stay here, a few kilobytes and sums are sent.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass

import cv2
import numpy as np
from distributed import get_worker

from drake_pose.camera.sources.frame_source import FrameSource, SourceSpecification
from drake_pose.camera.sources.source_files import load_background_pictures, open_source
from drake_pose.fit.camera_sums import (
    Views,
    answer_request,
    compare_placed,
    pack_sum,
    unpack_surfaces,
)
from drake_pose.fit.evidence import NO_EDGE, EdgePoints, pack_evidence
from drake_pose.jobs.cluster.lines import SURFACES, Listening, serve
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
# How long it is waited for a live camera's picture before it is said that there is none [s].
_LIVE_PATIENCE = 0.1
# How many of each camera's last pictures are kept: who follows the person is a few of them behind.
_KEPT = 64


@dataclass(frozen=True, eq=False)
class WatchReply:
    """What a worker saw.

    Args:
        views: by camera, time stamps [s], names of frames, and views as of pack_view.
        ended: the cameras that will give nothing any more.
        dropped: by camera, pictures that could not be used since the sources were opened.
        rates: by camera, pictures a second, where known.
        seconds: of its processor's time, for views and sums [s].
    """

    views: Mapping[str, Sequence[tuple[float, str, bytes]]]
    ended: tuple[str, ...]
    problems: tuple[str, ...]
    dropped: Mapping[str, int]
    rates: Mapping[str, float | None]
    seconds: float


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


class CameraWatch:
    """Some cameras' sources, open until they are closed or nobody asks; see open_watch."""

    def __init__(
        self, specifications: Sequence[SourceSpecification], spacings: Mapping[str, float]
    ) -> None:
        self._spacings, self._edges = spacings, EdgeServer(len(specifications))
        self._closed, self._lock = threading.Event(), threading.Lock()
        self._used, self._seconds = time.monotonic(), 0.0
        warm()
        with ExitStack() as opened:
            self._backgrounds: dict[str, Background] = {
                one.camera: learn_background(load_background_pictures(one))
                for one in specifications
                if not one.gives_masks
            }
            # Machines share no other clock than that of the day.
            self._sources: dict[str, FrameSource] = {
                one.camera: opened.enter_context(closing(open_source(one, time.time)))
                for one in specifications
            }
            host = host_of(get_worker().address)
            self.listening = serve(host, (self._answer, self._edges.answer), self._closed)
            self._opened = opened.pop_all()
        threading.Thread(target=self._close_when_idle, daemon=True).start()

    def close(self) -> None:
        """Lets go of the sources."""
        self._closed.set()
        with self._lock:
            self._opened.close()

    @property
    def is_closed(self) -> bool:
        """Whether the sources were let go."""
        return self._closed.is_set()

    def _close_when_idle(self) -> None:
        """Lets go of sources whose capture ended without a word."""
        while not self._closed.wait(_IDLE / 10.0):
            if time.monotonic() - self._used > _IDLE:
                self.close()

    def _answer(self, parts: Sequence[bytes]) -> bytes:
        """The pickled reply to a pickled request."""
        with self._lock:
            return pickle.dumps(self._poll(*pickle.loads(parts[0])))

    def _poll(self, count: int, after: Mapping[str, float]) -> WatchReply:
        """What the cameras see now, or next: of each so many pictures, after a time stamp [s]."""
        sources = self._sources
        views: dict[str, list[tuple[float, str, bytes]]] = {name: [] for name in sources}
        end = time.monotonic() + _LIVE_PATIENCE
        while not all(source.ended for source in sources.values()):
            begin = time.thread_time()
            for number, name in enumerate(sources):
                self._see(number, name, views[name], count, after[name])
            self._seconds += time.thread_time() - begin
            live = any(one.specification.live for one in sources.values())
            if not live or any(views.values()) or time.monotonic() > end:
                break
            time.sleep(_POLL_PAUSE)
        self._used = time.monotonic()
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
        )

    def _see(
        self,
        number: int,
        name: str,
        views: list[tuple[float, str, bytes]],
        count: int,
        after: float,
    ) -> None:
        """The next views of one camera."""
        source = self._sources[name]
        while len(views) < count and (one := source.read()) is not None:
            # A recording that is opened again begins at its beginning.
            if one.time <= after:
                continue
            if source.specification.gives_masks:
                region = np.asarray(one.picture, dtype=np.bool_)
            else:
                picture = np.asarray(one.picture, dtype=np.uint8)
                region = person_region(picture, self._backgrounds[name])
            view = see_silhouette(region, self._spacings[name])
            self._edges.put(number, one.time, view.edge)
            views.append((one.time, one.frame, pack_view(view)))


def host_of(address: str) -> str:
    """The machine of a worker's address."""
    return address.split("://")[-1].rsplit(":", 1)[0]


_watches: dict[str, CameraWatch] = {}
_watches_lock = threading.Lock()


def warm() -> None:
    """Brings all to memory that a poll needs, so that the first one is as fast as the others."""
    # A worker is one core.
    cv2.setNumThreads(1)
    region = np.zeros((64, 64), dtype=np.bool_)
    region[16:48, 16:48] = True
    pack_view(see_silhouette(region, 4.0))


def open_watch(
    key: str, specifications: Sequence[SourceSpecification], spacings: Mapping[str, float]
) -> Listening:
    """Opens sources if they are not open yet under this key; where polls and sums are answered.

    Raises:
        SceneError: a source cannot be opened.
        ClusterError: this worker's own address cannot be listened at.
    """
    with _watches_lock:
        if key not in _watches or _watches[key].is_closed:
            _watches[key] = CameraWatch(specifications, spacings)
        return _watches[key].listening


def close_watch(key: str) -> None:
    """Lets go of a watch's sources."""
    with _watches_lock:
        if key in _watches:
            _watches.pop(key).close()
