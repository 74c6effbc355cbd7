"""Encrypted connections to a worker beside Dask's, whose tasks cost milliseconds each (ZeroMQ)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple

import zmq

from drake_pose.errors import ClusterError

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
