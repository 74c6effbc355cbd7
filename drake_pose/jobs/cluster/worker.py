"""A worker's child: a process that does heavy work in its main thread, as no worker's thread can.

Drake's renderer and Meshcat belong to the thread that made them, and Python's garbage collector
takes them apart in any thread of a worker; and what crashes the child leaves the worker alive.

Run as ``python -m drake_pose.jobs.cluster.worker MEMORY_LIMIT``: reads pickled pairs of a function
and its argument, writes the pickled results, and ends with its parent.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, BinaryIO

from drake_pose.errors import ClusterError

if TYPE_CHECKING:
    from distributed import Worker

# How much of what a child said last is looked at [byte].
_TAIL = 4096
_local = threading.local()


def worker_resources(dask_worker: Worker) -> tuple[str, ...]:
    """The names of the resources that the worker that is asked was started with."""
    return tuple(dask_worker.state.total_resources)


def call_in_child(payload: bytes) -> bytes:
    """Calls a pickled pair of a function and its argument in the main thread of a worker's child.

    Returns:
        The pickled result.

    Raises:
        ClusterError: the child died of it.
    """
    child = getattr(_local, "child", None) or _Child(_memory_limit())
    _local.child = None
    result = child.call(payload)
    _local.child = child
    return result


def _memory_limit() -> int:
    """What the worker may take is its child's [byte]; 0: no limit."""
    from distributed import get_worker

    try:
        return int(get_worker().memory_manager.memory_limit or 0)
    except ValueError:
        # Not called by a worker.
        return 0


class _Child:
    """The child, as its parent sees it. memory_limit: of its data [byte]; 0: none."""

    def __init__(self, memory_limit: int) -> None:
        paths = os.pathsep.join(path for path in sys.path if path)
        # Whatever it says to stderr may tell why it died.
        self._remarks = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(memory_limit)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._remarks,
            env={**os.environ, "PYTHONPATH": paths},
        )

    def call(self, payload: bytes) -> bytes:
        """As call_in_child; ClusterError: the child died and cannot be used again."""
        process = self._process
        assert process.stdin is not None, "it is a pipe"
        assert process.stdout is not None, "it is a pipe"
        try:
            process.stdin.write(payload)
            process.stdin.flush()
            return pickle.dumps(pickle.load(process.stdout))
        except (OSError, EOFError, pickle.UnpicklingError):
            raise ClusterError(self._why_dead()) from None

    def _why_dead(self) -> str:
        code = self._process.wait()
        with self._remarks as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL))
            remarks = file.read().decode("utf-8", "replace").strip()
        how = f"exit status {code}" if code >= 0 else signal.Signals(-code).name
        return f"its process died ({how}){': ' + remarks.splitlines()[-1] if remarks else ''}"


def main() -> None:
    """Do what the parent asks for until it ends."""
    # Ctrl-C is the parent's business.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _limit_memory(int(sys.argv[1]))
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    # What a task prints must not mix with the answers.
    os.dup2(2, 1)
    waiting: queue.SimpleQueue = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests, waiting), daemon=True).start()
    while True:
        function, argument = waiting.get()
        pickle.dump(function(argument), answers)
        answers.flush()


def _listen(requests: BinaryIO, waiting: queue.SimpleQueue) -> None:
    """Passes requests on; a parent that ends takes this process with it, whatever it does."""
    with suppress(EOFError):
        while True:
            waiting.put(pickle.load(requests))
    os._exit(0)


def _limit_memory(limit: int) -> None:
    """Lets this process fail, rather than the machine, when a task takes too much memory."""
    if limit > 0:
        with suppress(ImportError, ValueError, OSError):
            import resource  # Absent on Windows.

            resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    main()
