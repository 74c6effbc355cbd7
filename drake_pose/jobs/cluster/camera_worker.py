"""What a worker does for live capture: it opens some cameras' sources and says what they see.

Sources stay open between polls. Of pictures, which stay here, a few kilobytes and sums are sent.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import islice
from typing import NamedTuple

import cv2
import numpy as np
from distributed import get_worker

from drake_pose.camera.frame_source import SourceSpecification
from drake_pose.fit.contour_fit import (
    Views,
    answer_request,
    compare_placed,
    pack_sum,
    unpack_surfaces,
)
from drake_pose.fit.evidence import NO_EDGE, EdgePoints, pack_evidence
from drake_pose.jobs.cluster.lines import SURFACES, Listening, serve
from drake_pose.jobs.cluster.scheduler import host_of
from drake_pose.jobs.live.scene import learn_backgrounds, open_sources
from drake_pose.person.views import pack_view, see_silhouette
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.segmentation.background import person_region

COUNT = 4
"""How many pictures of each camera are asked for at once, and again when fewer wait."""

# Cameras for which nobody asks are let go after this time [s].
_IDLE = 30.0
# Between two checks whether a live camera has a new picture [s].
_POLL_PAUSE = 0.002
# How long it is waited for a live camera's picture before it is said that there is none [s].
_LIVE_PATIENCE = 0.1
# How many of each camera's last pictures are kept: who follows the person is a few of them behind.
_KEPT = 64


class WatchReply(NamedTuple):
    """What a worker saw.

    views: by camera, time stamps [s], names of frames, and views as of pack_view.
    states: by camera, whether it will give nothing any more, pictures that could not be used since
    the sources were opened, and pictures a second, where known. seconds: of its processor's time,
    for views and sums [s].
    """

    views: Mapping[str, Sequence[tuple[float, str, bytes]]]
    states: Mapping[str, tuple[bool, int, float | None]]
    problems: tuple[str, ...]
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
        self._closed, self._lock, self._used = threading.Event(), threading.Lock(), time.monotonic()
        warm()
        with ExitStack() as opened:
            given = {one.camera: one for one in specifications}
            self._backgrounds = learn_backgrounds(given)
            # Machines share no other clock than that of the day.
            self._sources = open_sources(given, opened, time.time)
            host = host_of(get_worker().address)
            self.listening = serve(host, (self._answer, self._edges.answer), self._closed)
            self._opened = opened.pop_all()
        self._keeping_open = threading.Thread(target=self._keep_open, daemon=True)
        self._keeping_open.start()

    def close(self) -> None:
        """Lets go of the sources."""
        self._closed.set()
        self._keeping_open.join()

    def _keep_open(self) -> None:
        """Lets go of the sources when they are closed, or the capture ended without a word."""
        while not self._closed.wait(_IDLE / 10.0) and time.monotonic() - self._used < _IDLE:
            pass
        self._closed.set()
        with self._lock:
            self._opened.close()

    def _answer(self, parts: Sequence[bytes]) -> bytes:
        """The pickled reply: what each camera sees now, or next after a pickled time stamp [s]."""
        after: Mapping[str, float] = pickle.loads(parts[0])
        with self._lock:
            begin, end = time.thread_time(), time.monotonic() + _LIVE_PATIENCE
            while True:
                views = {
                    name: list(islice(self._see(number, name, after[name]), COUNT))
                    for number, name in enumerate(self._sources)
                }
                live = [o for o in self._sources.values() if o.specification.live and not o.ended]
                if any(views.values()) or not live or time.monotonic() > end:
                    break
                time.sleep(_POLL_PAUSE)
            self._used = time.monotonic()
            problems = tuple(text for one in self._sources.values() for text in one.problems)
            for source in self._sources.values():
                source.problems.clear()
            states = {
                name: (one.ended, one.dropped, one.rate_hz) for name, one in self._sources.items()
            }
            seconds = time.thread_time() - begin + self._edges.seconds
            self._edges.seconds = 0.0
            return pickle.dumps(WatchReply(views, states, problems, seconds))

    def _see(self, number: int, name: str, after: float) -> Iterator[tuple[float, str, bytes]]:
        """The views of one camera that are there now."""
        source = self._sources[name]
        while (one := source.read()) is not None:
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
            yield one.time, one.frame, pack_view(view)


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
    key: str,
    specifications: Sequence[SourceSpecification],
    spacings: Mapping[str, float],
) -> Listening:
    """Opens sources, under this key anew; where requests for views and for sums are answered.

    Args:
        spacings: from edge point to edge point, by camera [pixel].

    Raises:
        SceneError: a source cannot be opened.
        ClusterError: this worker's own address cannot be listened at.
    """
    close_watch(key)
    with _watches_lock:
        _watches[key] = CameraWatch(specifications, spacings)
        return _watches[key].listening


def close_watch(key: str) -> None:
    """Lets go of a watch's sources."""
    with _watches_lock:
        if key in _watches:
            _watches.pop(key).close()
