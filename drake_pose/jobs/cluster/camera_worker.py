"""What a worker does for live capture: it opens some cameras' sources and says what they see.

The sources stay open from one poll to the next. Pictures do not leave the machine; what leaves it
is a few kilobytes a camera.
"""

from __future__ import annotations

import os
import pickle
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np

from drake_pose.camera.sources.files import load_background_pictures
from drake_pose.camera.sources.frame_source import FrameSource, SourceSpecification
from drake_pose.camera.sources.opening import open_source
from drake_pose.errors import DrakePoseError
from drake_pose.jobs.cluster.camera_assignment import host_of
from drake_pose.jobs.cluster.edge_server import EdgeServer, EdgeStore
from drake_pose.person.silhouette_view import see_silhouette
from drake_pose.person.view_packing import pack_view
from drake_pose.silhouette.segmentation.background import (
    Background,
    learn_background,
    person_region,
)

# Cameras for which nobody asks are let go after this time [s].
_IDLE = 30.0
# Between two checks whether a live camera has a new picture [s].
_POLL_PAUSE = 0.002


@dataclass(frozen=True)
class WatchRequest:
    """What a worker is asked for.

    Args:
        key: of the watch: the same sources stay open under it.
        specifications: of the cameras' sources.
        spacings: from edge point to edge point, by camera [pixel].
        after: by camera, the time stamp up to which nobody wants a picture any more [s]: they came
            already, or would come too late.
        count: how many pictures of each camera at most.
        patience: how long at most until a live camera gives a picture [s].
    """

    key: str
    specifications: tuple[SourceSpecification, ...]
    spacings: Mapping[str, float]
    after: Mapping[str, float]
    count: int
    patience: float


@dataclass(frozen=True, eq=False)
class PackedView:
    """What a camera said. time: stamp [s]; frame: its name; packed: of pack_view."""

    time: float
    frame: str
    packed: bytes


@dataclass(frozen=True, eq=False)
class WatchReply:
    """What a worker saw.

    Args:
        views: by camera.
        ended: the cameras that will give nothing any more.
        problems: what was wrong.
        dropped: by camera, pictures that could not be used since the sources were opened.
        rates: by camera, pictures a second, where known.
        process: the worker's process.
        seconds: of its processor's time, for views and sums [s].
        port: where it answers with sums, at the address where Dask reaches it; 0: it does not.
    """

    views: Mapping[str, tuple[PackedView, ...]]
    ended: tuple[str, ...]
    problems: tuple[str, ...]
    dropped: Mapping[str, int]
    rates: Mapping[str, float | None]
    process: int
    seconds: float
    port: int = 0


class _Watch:
    """Some cameras' sources, open."""

    def __init__(self, request: WatchRequest) -> None:
        self.lock = threading.Lock()
        self.used = time.monotonic()
        self._sources: dict[str, FrameSource] = {}
        self._backgrounds: dict[str, Background] = {}
        self._store = EdgeStore(one.camera for one in request.specifications)
        self._server: EdgeServer | None = None
        warm()
        try:
            for one in request.specifications:
                if not one.gives_masks:
                    self._backgrounds[one.camera] = learn_background(load_background_pictures(one))
                # Machines share no other clock than that of the day.
                self._sources[one.camera] = open_source(one, time.time)
            self._server = _open_server(request.key, self._store)
        except DrakePoseError:
            self.close()
            raise

    def poll(self, request: WatchRequest) -> WatchReply:
        """What the cameras see now, or next."""
        self.used = time.monotonic()
        seconds = 0.0
        views: dict[str, list[PackedView]] = {name: [] for name in self._sources}
        end = time.monotonic() + request.patience
        while request.count and not self.ended:
            begin = time.thread_time()
            for name, source in self._sources.items():
                self._see(source, views[name], request.after.get(name, -np.inf), request)
            seconds += time.thread_time() - begin
            live = any(one.specification.live for one in self._sources.values())
            if not live or any(views.values()) or time.monotonic() > end:
                break
            time.sleep(_POLL_PAUSE)
        self.used = time.monotonic()
        problems = [text for one in self._sources.values() for text in one.problems]
        for source in self._sources.values():
            source.problems.clear()
        return WatchReply(
            views={name: tuple(seen) for name, seen in views.items()},
            ended=tuple(name for name, source in self._sources.items() if source.ended),
            problems=tuple(problems),
            dropped={name: source.dropped for name, source in self._sources.items()},
            rates={name: source.rate_hz for name, source in self._sources.items()},
            process=os.getpid(),
            seconds=seconds + (self._server.take_seconds() if self._server else 0.0),
            port=self._server.port if self._server else 0,
        )

    @property
    def ended(self) -> bool:
        """Whether no camera will give anything any more."""
        return all(source.ended for source in self._sources.values())

    def _see(
        self, source: FrameSource, views: list[PackedView], after: float, request: WatchRequest
    ) -> None:
        """The next views of one camera."""
        name = source.specification.camera
        while len(views) < request.count:
            one = source.read()
            if one is None:
                return
            # A recording that is opened again begins at its beginning.
            if one.time <= after:
                continue
            if source.specification.gives_masks:
                region = np.asarray(one.picture, dtype=np.bool_)
            else:
                picture = np.asarray(one.picture, dtype=np.uint8)
                region = person_region(picture, self._backgrounds[name])
            view = see_silhouette(region, request.spacings[name])
            self._store.put(name, one.time, view.edge)
            views.append(PackedView(one.time, one.frame, pack_view(view)))

    def close(self) -> None:
        """Lets go of the sources."""
        if self._server is not None:
            self._server.close()
        for source in self._sources.values():
            source.close()


def _open_server(key: str, store: EdgeStore) -> EdgeServer | None:
    """Answers with sums where the worker listens to Dask; None where that cannot be.

    The connection is not encrypted: where Dask's are, there is none.
    """
    from distributed import get_worker

    try:
        address = get_worker().address
    except ValueError:
        # Not called by a worker.
        return None
    if not address.startswith("tcp://"):
        return None
    with suppress(OSError):
        return EdgeServer(host_of(address), key.encode(), store, _poll_pickled)
    return None


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
    """Opens the cameras' sources if they are not open yet, and says what they see.

    Raises:
        SceneError: a source cannot be opened.
    """
    with _watches_lock:
        watch = _watches.get(request.key)
        if watch is None:
            watch = _watches[request.key] = _Watch(request)
            threading.Thread(
                target=_close_when_idle, args=(request.key, watch), daemon=True
            ).start()
    with watch.lock:
        return watch.poll(request)


def _poll_pickled(data: bytes) -> bytes:
    """As poll, of a request that came by a connection of its own."""
    try:
        return pickle.dumps(poll(pickle.loads(data)))
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
