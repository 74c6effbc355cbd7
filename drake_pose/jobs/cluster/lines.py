"""Connections to a worker beside Dask's: opened by a thread, so that the dead hold nobody up."""

from __future__ import annotations

import os
import pickle
import socket
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Connection
from typing import Any


def send_at_once(connection: Connection) -> None:
    """Lets a connection's small messages go at once; else they wait for others, 40 ms long."""
    with socket.socket(fileno=os.dup(connection.fileno())) as same:
        same.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def open_line(address: tuple[str, int], key: bytes, words: Sequence[bytes]) -> Future[Connection]:
    """Begins to connect to an EdgeServer.

    Args:
        address: the server's.
        key: the server's.
        words: what is said first; then the server says that it is ready.

    Returns:
        The connection, or the reason why there is none.
    """
    opening: Future[Connection] = Future()

    def connect() -> None:
        try:
            connection = Client(address, authkey=key)
            send_at_once(connection)
            for word in words:
                connection.send_bytes(word)
            connection.recv_bytes()
        except (OSError, EOFError, AuthenticationError) as error:
            opening.set_exception(error)
        else:
            opening.set_result(connection)

    threading.Thread(target=connect, daemon=True).start()
    return opening


def hang_up(opening: Future[Connection]) -> None:
    """Closes a connection as soon as it is there."""

    def close(done: Future[Connection]) -> None:
        if done.exception() is None:
            done.result().close()

    opening.add_done_callback(close)


class LineReply:
    """What will come by a connection, as a Future of Dask shows it: its status, its result.

    Args:
        connection: to a worker.
        request: to be pickled and sent.
    """

    def __init__(self, connection: Connection, request: object) -> None:
        self.status = "pending"
        self._connection, self._reply = connection, None
        try:
            connection.send_bytes(pickle.dumps(request))
        except OSError:
            self.status = "lost"

    def done(self) -> bool:
        """Whether the reply came, or will not come any more."""
        if self.status == "pending":
            try:
                if self._connection.poll():
                    self._reply = pickle.loads(self._connection.recv_bytes())
                    self.status = "error" if isinstance(self._reply, Exception) else "finished"
            except (OSError, EOFError, pickle.UnpicklingError):
                self.status = "lost"
        return self.status != "pending"

    def exception(self) -> Exception | None:
        """What the worker has raised."""
        return self._reply if isinstance(self._reply, Exception) else None

    def result(self, timeout: float | None = None) -> Any:
        """The reply, when it is done."""
        return self._reply

    def cancel(self) -> None:
        """Nobody waits for it any more; the connection cannot be used again."""
        self.status = "cancelled"
        with suppress(OSError):
            self._connection.close()
