"""A worker's child: a process that does heavy work in its main thread, as no worker's thread can.

Drake's renderer and Meshcat belong to the thread that made them, and Python's garbage collector
takes them apart in any thread of a worker; and what crashes the child leaves the worker alive.

Run as ``python -m drake_pose.jobs.cluster.worker MEMORY_LIMIT``: reads pickled pairs of a function
and its argument, writes the pickled results, and ends with its parent.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from typing import IO

from drake_pose.errors import ClusterError

# Between two looks of a child whether its parent is there [s].
_LOOK = 0.2
# How much of what a child said last is looked at [byte].
_TAIL = 4096
_local = threading.local()


def call_in_child(payload: bytes) -> bytes:
    """Calls a pickled pair of a function and its argument in the main thread of a worker's child.

    Returns:
        The pickled result.

    Raises:
        ClusterError: the child died of it.
    """
    process, remarks = getattr(_local, "child", None) or _start_child()
    _local.child = None
    assert process.stdin is not None, "it is a pipe"
    assert process.stdout is not None, "it is a pipe"
    try:
        process.stdin.write(payload)
        process.stdin.flush()
        result = pickle.dumps(pickle.load(process.stdout))
    except (OSError, EOFError, pickle.UnpicklingError):
        code = process.wait()
        with remarks:
            remarks.seek(max(0, remarks.seek(0, os.SEEK_END) - _TAIL))
            said = remarks.read().decode("utf-8", "replace").strip()
        how = f"exit status {code}" if code >= 0 else signal.Signals(-code).name
        why = f": {said.splitlines()[-1]}" if said else ""
        raise ClusterError(f"its process died ({how}){why}") from None
    _local.child = process, remarks
    return result


def _start_child() -> tuple[subprocess.Popen[bytes], IO[bytes]]:
    """A child of this worker, and the file of what it says to stderr: perhaps why it dies."""
    from distributed import get_worker

    try:
        limit = int(get_worker().memory_manager.memory_limit or 0)
    except ValueError:
        # Not called by a worker.
        limit = 0
    remarks = tempfile.TemporaryFile()  # noqa: SIM115
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, str(limit)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=remarks,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
    )
    return process, remarks


def main() -> None:
    """Do what the parent asks for until it ends."""
    # Ctrl-C is the parent's business.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _limit_memory(int(sys.argv[1]))
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    # What a task prints must not mix with the answers.
    os.dup2(2, 1)
    with suppress(EOFError):
        while True:
            function, argument = pickle.load(requests)
            pickle.dump(function(argument), answers)
            answers.flush()


def _end_with(parent: int) -> None:
    """Ends this process with its parent, whatever it does."""
    while os.getppid() == parent:
        time.sleep(_LOOK)
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
