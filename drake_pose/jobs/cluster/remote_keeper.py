"""A worker's edges, as who follows the person sees them: asked for sums, never waited for long."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from multiprocessing.connection import Connection

from drake_pose.fit.camera_sums import (
    CameraSum,
    SumRequest,
    pack_request,
    pack_surfaces,
    unpack_sum,
)
from drake_pose.jobs.cluster.edge_server import SUMS
from drake_pose.jobs.cluster.lines import hang_up, open_line
from drake_pose.silhouette.areas.outline import PackedOutlines

# How long a sum is waited for [s].
_PATIENCE = 0.5
# A worker that was late, or could not be reached, is tried again after longer and longer times [s].
_RETRY, _LONGEST_RETRY = 3.0, 60.0


class RemoteKeeper:
    """Asks the EdgeServer of a worker; see EdgeKeeper.

    Attributes:
        answers: how many sums came.
        bytes: sent and received.

    Args:
        cameras: the names of the worker's cameras, in its order.
        key: the server's.
        report: hears what the user should know.
    """

    def __init__(self, cameras: Iterable[str], key: bytes, report: Callable[[str], None]) -> None:
        self._numbers = {name: k for k, name in enumerate(cameras)}
        self._key, self._report = key, report
        self._address: tuple[str, int] | None = None
        self._packed: PackedOutlines | None = None
        self._opening: Future[Connection] | None = None
        self._asked, self._is_pending = 0.0, False
        self._retry_at, self._retry_pause, self._is_reported = 0.0, _RETRY, False
        self.answers = self.bytes = 0

    def move_to(self, host: str, port: int) -> None:
        """Says where the worker listens; port 0: nowhere."""
        address = (host, port) if port else None
        if address != self._address:
            self.close()
            self._address, self._retry_at, self._retry_pause = address, 0.0, _RETRY

    def ask(self, request: SumRequest) -> bool:
        """Sends a request; False where the worker cannot be asked, now or at all."""
        if self._packed is not request.packed or self._is_pending:
            # An answer that nobody took would be taken for the next one.
            self.close()
            self._packed = request.packed
        connection = self._connection()
        if connection is None:
            return False
        numbers = [self._numbers[name] for name in request.names]
        data = pack_request(request, numbers)
        try:
            connection.send_bytes(data)
        except OSError:
            self._put_off()
            return False
        self._asked, self._is_pending = time.monotonic(), True
        self.bytes += len(data)
        return True

    def answer(self) -> CameraSum | None:
        """The sum that was asked for; None where it does not come in time."""
        connection = self._connection()
        if connection is None or not self._is_pending:
            return None
        try:
            if not connection.poll(max(0.0, self._asked + _PATIENCE - time.monotonic())):
                self._put_off("do not come in time")
                return None
            data = connection.recv_bytes()
        except (OSError, EOFError):
            # Whoever watches the worker says that it was lost.
            self._put_off()
            return None
        self._is_pending = False
        self._retry_pause, self._is_reported = _RETRY, False
        self.answers += bool(data)
        self.bytes += len(data)
        return unpack_sum(data) if data else None

    def close(self) -> None:
        """Hangs up."""
        self._is_pending = False
        opening, self._opening = self._opening, None
        if opening is not None:
            hang_up(opening)

    def _connection(self) -> Connection | None:
        """The connection, where there is one; begins to connect where not."""
        if self._opening is None:
            if self._address and self._packed and time.monotonic() >= self._retry_at:
                words = SUMS, pack_surfaces(self._packed)
                self._opening = open_line(self._address, self._key, words)
            return None
        if not self._opening.done():
            return None
        if self._opening.exception() is not None:
            self._put_off(f"cannot be asked for ({self._opening.exception()})")
            return None
        return self._opening.result()

    def _put_off(self, why: str = "") -> None:
        """Hangs up, and tries again later."""
        self.close()
        self._retry_at = time.monotonic() + self._retry_pause
        self._retry_pause = min(2.0 * self._retry_pause, _LONGEST_RETRY)
        if why and not self._is_reported:
            names = ", ".join(f"'{name}'" for name in self._numbers)
            self._report(f"sums of camera {names} {why}; this process compares their contours")
            self._is_reported = True
