"""A process that does heavy work in its main thread, for a worker whose threads cannot.

A worker's tasks run in a thread beside the one that talks to the scheduler. Drake's renderer and
Meshcat belong to the thread that made them, and Python's garbage collector takes them apart in
whichever thread it happens to run; so a worker has a child, and whatever crashes the child (a
broken model, too little memory) leaves the worker alive.

Run as ``python -m drake_pose.jobs.cluster.child_process MEMORY_LIMIT``: reads pickled pairs of a
function and its argument, and writes the pickled results. When its parent ends, so does it.
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
from collections.abc import Callable
from contextlib import suppress
from typing import Any, BinaryIO

from drake_pose.errors import ClusterError

# How much of what a child said last is looked at [byte].
_TAIL = 4096


class Child:
    """The child, as its parent sees it.

    Args:
        memory_limit: of its data [byte]; 0: none.
    """

    def __init__(self, memory_limit: int = 0) -> None:
        environment = dict(os.environ)
        environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
        # Whatever it says to stderr may tell why it died.
        self._remarks, name = tempfile.mkstemp()
        os.unlink(name)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "drake_pose.jobs.cluster.child_process", str(memory_limit)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._remarks,
            env=environment,
        )

    def call(self, payload: bytes) -> bytes:
        """Returns the pickled result of a pickled (function, argument).

        Raises:
            ClusterError: the child died; it cannot be used again.
        """
        process = self._process
        if process.stdin is None or process.stdout is None:
            raise ClusterError("the child has no pipes")
        try:
            process.stdin.write(payload)
            process.stdin.flush()
            return pickle.dumps(pickle.load(process.stdout))
        except (OSError, EOFError, pickle.UnpicklingError):
            raise ClusterError(self._why_dead()) from None

    def _why_dead(self) -> str:
        code = self._process.wait()
        start = max(0, os.fstat(self._remarks).st_size - _TAIL)
        remarks = os.pread(self._remarks, _TAIL, start).decode("utf-8", "replace").strip()
        os.close(self._remarks)
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
    waiting: queue.SimpleQueue[tuple[Callable[[Any], Any], Any]] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests, waiting), daemon=True).start()
    while True:
        function, argument = waiting.get()
        pickle.dump(function(argument), answers)
        answers.flush()


def _listen(
    requests: BinaryIO, waiting: queue.SimpleQueue[tuple[Callable[[Any], Any], Any]]
) -> None:
    """Passes requests on; a parent that ends takes this process with it, whatever it does."""
    with suppress(EOFError):
        while True:
            waiting.put(pickle.load(requests))
    os._exit(0)


def _limit_memory(limit: int) -> None:
    """Lets this process fail, rather than the machine, when a task takes too much memory."""
    if limit <= 0:
        return
    with suppress(ImportError, ValueError, OSError):
        import resource  # Absent on Windows.

        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    main()
