"""A worker's edges, as who follows the person sees them: asked for sums, never waited for long."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from drake_pose.fit.camera_sums import (
    CameraSum,
    SumRequest,
    pack_request,
    pack_surfaces,
    unpack_sum,
)
from drake_pose.jobs.cluster.lines import Line
from drake_pose.silhouette.areas.outline import PackedOutlines

SURFACES, SUM = b"surfaces", b"sum"
"""The kinds of requests."""

# How long a sum, and a connection, is waited for [s].
_PATIENCE, _CONNECTING = 0.5, 5.0
# A worker that was late, or could not be reached, is tried again after longer and longer times [s].
_RETRY, _LONGEST_RETRY = 3.0, 60.0


class RemoteKeeper:
    """Asks a worker for sums over its cameras; see EdgeKeeper. answers: how many came."""

    def __init__(self, cameras: Iterable[str], report: Callable[[str], None]) -> None:
        self._numbers = {name: k for k, name in enumerate(cameras)}
        self._report = report
        self._line: Line | None = None
        self._packed: PackedOutlines | None = None
        self._is_ready = self._is_reported = False
        self._sent_at = self._retry_at = 0.0
        self._retry_pause = _RETRY
        self.answers = 0

    def move_to(self, line: Line | None) -> None:
        """Says by which connection the worker is asked; None: by none."""
        if self._line is not None:
            self._line.close()
        self._line, self._packed = line, None
        self._sent_at, self._retry_at, self._retry_pause = time.monotonic(), 0.0, _RETRY

    def ask(self, request: SumRequest) -> bool:
        """Sends a request; False where the worker cannot be asked, now or at all."""
        if self._line is None or time.monotonic() < self._retry_at:
            return False
        if self._packed is not request.packed:
            self._is_ready = False
            if self._send(self._line, SURFACES, pack_surfaces(request.packed)):
                self._packed = request.packed
            return False
        # The worker says when it has loaded all it needs.
        self._is_ready = self._is_ready or self._line.receive() is not None
        data = pack_request(request, [self._numbers[name] for name in request.names])
        return self._is_ready and self._send(self._line, SUM, data)

    def answer(self) -> CameraSum | None:
        """The sum that was asked for; None where it does not come in time."""
        patience = self._sent_at + _PATIENCE - time.monotonic()
        data = None if self._line is None else self._line.receive(patience)
        if data is None:
            self._put_off("do not come in time")
            return None
        self._retry_pause, self._is_reported = _RETRY, False
        self.answers += bool(data)
        return unpack_sum(data) if data else None

    def _send(self, line: Line, kind: bytes, data: bytes) -> bool:
        is_sent, now = line.send(kind, data), time.monotonic()
        if is_sent:
            self._sent_at = now
        elif now - self._sent_at > _CONNECTING:
            self._put_off("cannot be asked for")
        return is_sent

    def _put_off(self, why: str) -> None:
        """Tries again later."""
        self._packed = None
        self._sent_at = self._retry_at = time.monotonic() + self._retry_pause
        self._retry_pause = min(2.0 * self._retry_pause, _LONGEST_RETRY)
        if not self._is_reported:
            names = ", ".join(f"'{name}'" for name in self._numbers)
            self._report(f"sums of camera {names} {why}; this process compares their contours")
            self._is_reported = True
