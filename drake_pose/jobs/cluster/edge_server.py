"""A worker's answers to who follows the person: sums over its cameras, by a line of their own.

A frame's fit asks several times for sums, each within milliseconds, and once for what the cameras
see; a task of Dask's would cost the process in the middle more than that. Connections
(`multiprocessing.connection`) are open to those alone who know the watch's key, which Dask has
handed over.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from multiprocessing import AuthenticationError
from multiprocessing.connection import Connection, Listener

import numpy as np

from drake_pose.fit.camera_sums import (
    Views,
    answer_request,
    compare_placed,
    pack_sum,
    unpack_surfaces,
)
from drake_pose.fit.evidence import NO_EDGE, EdgePoints, pack_evidence
from drake_pose.jobs.cluster.lines import send_at_once
from drake_pose.silhouette.areas.outline import PackedOutlines

# How many of each camera's last pictures are kept: who follows the person is a few of them behind.
_KEPT = 64

SUMS, POLLS = b"sums", b"polls"
"""What a connection is for, said first. SUMS: surfaces follow; POLLS: pickled requests."""

READY = b"ready"
"""What a server says when it can answer."""


class EdgeStore:
    """The edges of the last pictures of some cameras.

    Args:
        cameras: their names; a camera's number is its place among them.
    """

    def __init__(self, cameras: Iterable[str]) -> None:
        self._edges: dict[str, dict[float, EdgePoints]] = {name: {} for name in cameras}
        self._by_number = list(self._edges.values())

    def put(self, camera: str, time_stamp: float, edge: EdgePoints) -> None:
        """Keeps the edge of a picture, by its time stamp [s]."""
        edges = self._edges[camera]
        edges[time_stamp] = edge
        if len(edges) > _KEPT:
            del edges[next(iter(edges))]

    def find(self, number: int, time_stamp: float) -> EdgePoints | None:
        """The edge of a picture; None where it is not kept, or not any more."""
        if not 0 <= number < len(self._by_number):
            return None
        return self._by_number[number].get(time_stamp)


class EdgeServer:
    """Compares contours with the edges of a store for whoever knows the key.

    Attributes:
        port: where it listens.

    Args:
        host: the address at which it listens; no other one is open.
        key: whoever is to be answered must know it.
        store: the edges.
        on_poll: answers a pickled poll with a pickled reply.

    Raises:
        OSError: it cannot listen there.
    """

    def __init__(
        self,
        host: str,
        key: bytes,
        store: EdgeStore,
        on_poll: Callable[[bytes], bytes] = lambda data: data,
    ) -> None:
        self._store, self._on_poll, self._closed = store, on_poll, False
        self._seconds = 0.0
        self._listener = Listener((host, 0), authkey=key)
        self._address = self._listener.address
        self.port = int(self._address[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def take_seconds(self) -> float:
        """The processor's time since the last call [s]."""
        seconds, self._seconds = self._seconds, 0.0
        return seconds

    def close(self) -> None:
        """Listens no more; who is connected is answered until it closes."""
        self._closed = True
        # Wakes the thread that waits for connections.
        with suppress(OSError):
            socket.create_connection(self._address, timeout=1.0).close()

    def _accept(self) -> None:
        with self._listener:
            while not self._closed:
                # Whoever does not know the key, or goes away, is not answered.
                with suppress(OSError, EOFError, AuthenticationError):
                    connection = self._listener.accept()
                    threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: Connection) -> None:
        with connection, suppress(OSError, EOFError):
            send_at_once(connection)
            if connection.recv_bytes() == POLLS:
                connection.send_bytes(READY)
                while True:
                    connection.send_bytes(self._on_poll(connection.recv_bytes()))
            surfaces = unpack_surfaces(connection.recv_bytes())
            _load_kernels(surfaces)
            connection.send_bytes(READY)
            while True:
                data = connection.recv_bytes()
                begin = time.thread_time()
                total = answer_request(data, surfaces, self._store.find)
                connection.send_bytes(b"" if total is None else pack_sum(total))
                self._seconds += time.thread_time() - begin


def _load_kernels(surfaces: PackedOutlines) -> None:
    """Compares with nothing once: kernels are loaded by their first call."""
    nodes = len(surfaces.ordinary_ends)
    camera = np.eye(4)[None], np.ones((1, 8))
    views = Views(camera, pack_evidence([NO_EDGE]))
    compare_placed(surfaces, np.tile(np.eye(4), (nodes, 1, 1)), views, np.ones((1, 4)))
