"""Encrypted connections to a worker beside Dask's, whose tasks cost milliseconds each (ZeroMQ).

By them a worker is asked for views, and for sums over its cameras, never waited for long.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import NamedTuple

import zmq

from drake_pose.errors import ClusterError
from drake_pose.fit.contour_fit import (
    CameraSum,
    SumRequest,
    pack_request,
    pack_surfaces,
    unpack_sum,
)
from drake_pose.silhouette.areas.outline import PackedOutlines

SURFACES, SUM = b"surfaces", b"sum"
"""The kinds of requests."""

# How long a sum is waited for, and after which time a worker that was late is asked again [s].
_PATIENCE, _RETRY = 0.5, 10.0

# How often a server looks whether it was closed [ms].
_LOOK = 200


class Listening(NamedTuple):
    """Where a server listens. key: to be kept secret: who does not know it is not answered."""

    key: bytes
    ports: tuple[int, ...]


class Line:
    """The asking end of a connection: one request at a time; nothing waits for a dead peer."""

    def __init__(self, host: str, port: int, key: bytes) -> None:
        own, secret = zmq.curve_keypair()
        self._socket: zmq.Socket = zmq.Context.instance().socket(zmq.REQ)
        for option, value in {
            # A request whose reply did not come may be followed by another, whose reply is told
            # apart; without a connection nothing is sent.
            zmq.REQ_RELAXED: 1,
            zmq.REQ_CORRELATE: 1,
            zmq.IMMEDIATE: 1,
            zmq.LINGER: 0,
            zmq.CURVE_PUBLICKEY: own,
            zmq.CURVE_SECRETKEY: secret,
            zmq.CURVE_SERVERKEY: key,
        }.items():
            self._socket.setsockopt(option, value)
        self._socket.connect(f"tcp://{host}:{port}")

    def send(self, *parts: bytes) -> bool:
        """Sends a request; False where there is no connection, yet or any more."""
        with suppress(zmq.Again):
            self._socket.send_multipart(parts, zmq.NOBLOCK)
            return True
        return False

    def receive(self, patience: float = 0.0) -> bytes | None:
        """The reply to the last request; None where it does not come in this time [s]."""
        if not self._socket.poll(max(0, round(1e3 * patience))):
            return None
        return self._socket.recv()

    def close(self) -> None:
        """Hangs up."""
        self._socket.close()


Answer = Callable[[Sequence[bytes]], bytes]
"""The reply to a request's parts."""


def serve(host: str, answers: Sequence[Answer], closed: threading.Event) -> Listening:
    """Answers requests, each kind at a port and in a thread of its own, until it is closed.

    Raises:
        ClusterError: the host's address cannot be listened at.
    """
    key, secret = zmq.curve_keypair()
    ports = []
    for answer in answers:
        socket: zmq.Socket = zmq.Context.instance().socket(zmq.REP)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, secret)
        try:
            ports.append(socket.bind_to_random_port(f"tcp://{host}"))
        except zmq.ZMQError as error:
            closed.set()
            raise ClusterError(
                f"a worker cannot listen at its own address {host}: {error}"
            ) from None
        threading.Thread(target=_serve, args=(socket, answer, closed), daemon=True).start()
    return Listening(key, tuple(ports))


def _serve(socket: zmq.Socket, answer: Answer, closed: threading.Event) -> None:
    with socket:
        while not closed.is_set():
            if socket.poll(_LOOK):
                socket.send(answer(socket.recv_multipart()))


def listed(cameras: Iterable[str]) -> str:
    """Cameras' names, for messages."""
    return ", ".join(f"'{name}'" for name in cameras)


class RemoteKeeper:
    """Asks a worker for sums over its cameras; see EdgeKeeper. answers: how many came."""

    def __init__(self, cameras: Iterable[str], report: Callable[[str], None]) -> None:
        self._numbers = {name: k for k, name in enumerate(cameras)}
        self._report = report
        self._line: Line | None = None
        self._packed: PackedOutlines | None = None
        self._is_ready = self._is_reported = False
        self._asked_at = self._retry_at = 0.0
        self.answers = 0

    def move_to(self, line: Line | None) -> None:
        """Says by which connection the worker is asked; None: by none."""
        if self._line is not None:
            self._line.close()
        self._line, self._packed, self._retry_at = line, None, 0.0

    def ask(self, request: SumRequest) -> bool:
        """Sends a request; False where the worker cannot be asked, now or at all."""
        self._asked_at = time.monotonic()
        if self._line is None or self._asked_at < self._retry_at:
            return False
        if self._packed is not request.packed:
            self._is_ready = False
            if self._line.send(SURFACES, pack_surfaces(request.packed)):
                self._packed = request.packed
            return False
        # The worker says when it has loaded all it needs.
        self._is_ready = self._is_ready or self._line.receive() is not None
        data = pack_request(request, [self._numbers[name] for name in request.names])
        return self._is_ready and self._line.send(SUM, data)

    def answer(self) -> CameraSum | None:
        """The sum that was asked for; None where it does not come in time."""
        patience = self._asked_at + _PATIENCE - time.monotonic()
        data = None if self._line is None else self._line.receive(patience)
        if data is None:
            self._packed, self._retry_at = None, time.monotonic() + _RETRY
            if not self._is_reported:
                cameras = f"sums of camera {listed(self._numbers)}"
                self._report(f"{cameras} do not come in time; this process compares their contours")
            self._is_reported = True
            return None
        self._is_reported = False
        self.answers += bool(data)
        return unpack_sum(data) if data else None
