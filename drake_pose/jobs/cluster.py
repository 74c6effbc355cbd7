"""Dask workers on this machine or on others (needs the extra `cluster`)."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_pose import version
from drake_pose.errors import ClusterError

if TYPE_CHECKING:
    from distributed import Client

_local = threading.local()


def has_dask() -> bool:
    """Return whether Dask distributed (extra ``cluster``) is installed."""
    return find_spec("distributed") is not None


@contextmanager
def open_cluster(
    workers: int | None = None, scheduler: str | None = None, timeout: float = 5.0
) -> Iterator[Client]:
    """Open a Dask client and, without ``scheduler``, workers on this machine; yields the client.

    ``workers``: number of worker processes with one thread each, which listen on the loopback
    address only; None: one for each core. ``scheduler``: address of a Dask scheduler whose workers
    are used instead; None: no scheduler. ``timeout``: timeout of the connection to a scheduler [s].

    Raises ClusterError: distributed is not installed, or the scheduler cannot be reached.
    """
    if not has_dask():
        raise ClusterError(
            'workers need Dask distributed: pip install "drake_pose[cluster]"; or use --workers 0'
        )
    # Importing distributed sets log levels; they are changed below.
    import distributed

    # A batch reports dead workers itself.
    loggers = [logging.getLogger(name) for name in ("distributed", "asyncio")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        if scheduler is not None:
            with _connect(scheduler, timeout) as client:
                yield client
            return
        count = len(os.sched_getaffinity(0)) if workers is None else workers
        if count < 1:
            raise ClusterError(f"a cluster has one worker or more, not {count}")
        import dask

        settings = {
            "distributed.worker.multiprocessing-method": "spawn",
            # Tasks that wait at a killed worker would count as having killed it.
            "distributed.scheduler.worker-saturation": 1.0,
            "distributed.logging.distributed": "critical",
            "distributed.admin.low-level-log-length": 0,
            # Dask's default adds MALLOC_TRIM_THRESHOLD_, after which glibc returns each picture to
            # the system when it is freed: 6 s of system time for an episode of 60 pictures.
            "distributed.nanny.pre-spawn-environ": dict.fromkeys(
                ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), 1
            ),
        }
        with (
            tempfile.TemporaryDirectory(
                prefix="drake_pose_", ignore_cleanup_errors=True
            ) as scratch,
            dask.config.set(settings),
            distributed.LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address=None,
                scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
                local_directory=scratch,
                silence_logs=logging.CRITICAL,
            ) as cluster,
            distributed.Client(cluster, set_as_default=False) as client,
        ):
            yield client
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _connect(address: str, timeout: float) -> Client:
    """Return a client of a running scheduler at an address such as tcp://10.0.0.7:8786.

    ``timeout``: [s]. Raises ClusterError: the address is malformed, or no scheduler answers.
    """
    from distributed import Client
    from distributed.comm import connect, get_address_host_port

    try:
        get_address_host_port(address, strict=True)
    except ValueError as error:
        raise ClusterError(
            f"'{address}' is not a scheduler's address like tcp://10.0.0.7:8786"
        ) from error

    async def shake_hands() -> None:
        # The timeout of connect does not cover a server that accepts and does not answer.
        await (await asyncio.wait_for(connect(address, timeout=timeout), timeout + 0.5)).close()

    try:
        # Before the Client is made: a Client without scheduler logs errors when it is destroyed.
        asyncio.run(shake_hands())
        return Client(address, timeout=timeout, set_as_default=False)
    except (TimeoutError, OSError, ValueError, TypeError, EOFError, MemoryError) as error:
        # Another kind of server may answer anything; bytes of a web page, read as the size of a
        # message, cause a MemoryError.
        raise ClusterError(
            f"no scheduler answers at {address} within {timeout:g} s; start one with "
            "'dask scheduler --host 127.0.0.1' and workers with 'dask worker ADDRESS --nthreads 1'"
        ) from error


def address_of(client: Client) -> str:
    """Return the address of a client's scheduler, for messages."""
    return "its address" if client.scheduler is None else str(client.scheduler.address)


def worker_facts(file: Path | None = None) -> tuple[str, str, bool]:
    """Return this process's version, its code's SHA-256, and whether a file (or None) exists."""
    digest = hashlib.sha256()
    package = Path(version.__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return version.VERSION, digest.hexdigest(), file is None or file.is_file()


def require_fit_workers(client: Client, out: Path, timeout: float = 5.0) -> None:
    """Check that all workers have this version of drake_pose and see a folder.

    ``client``: client of the workers. ``out``: the folder, which is created if it does not exist.
    ``timeout``: time for which a first worker is waited for [s].

    Raises ClusterError: there is no worker, the folder cannot be written, or a worker fails a
    check.
    """
    with suppress(asyncio.TimeoutError):
        client.wait_for_workers(1, timeout=timeout)
    if not client.nthreads():
        raise ClusterError(
            f"the scheduler at {address_of(client)} has no workers; start some with "
            "'dask worker ADDRESS --nthreads 1'"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(prefix=".seen_", dir=out) as probe:
            file = Path(probe.name).absolute()
            here, there = worker_facts(file), client.run(worker_facts, file)
    except OSError as error:
        raise ClusterError(f"{out}: cannot be written: {error.strerror}") from error
    except (ImportError, AttributeError) as error:
        raise ClusterError(
            f"a worker cannot use drake_pose ({error}); install the same version there as here, "
            f"{version.VERSION}"
        ) from error
    for address, facts in there.items():
        if facts[0] != here[0]:
            how = f"has drake_pose {facts[0]}, but here is {here[0]}; install the same version"
        elif facts[1] != here[1]:
            how = (
                f"has another development version of drake_pose {facts[0]}; install the same one "
                "on both, and start the worker again"
            )
        elif not facts[2]:
            how = (
                f"does not see the folder {out}; all machines must find scenes, models and "
                "results at the same paths"
            )
        else:
            continue
        raise ClusterError(f"the worker {address} {how}")


def call_in_child(payload: bytes) -> bytes:
    """Call a function in a child process of this thread, which is kept for the next call.

    Drake's renderer and Meshcat must be destroyed in the thread that made them, so that the work is
    done in the main thread of a child. A crash ends the child, not the worker.

    ``payload``: pickled pair of a function and its argument. Returns the pickled result. Raises
    ClusterError: the child died.
    """
    child = getattr(_local, "child", None)
    if child is None:
        from distributed import get_worker

        limit = None
        with suppress(ValueError):  # Raised outside of a worker.
            limit = get_worker().memory_manager.memory_limit
        # Dask starts workers as daemons, which multiprocessing allows no children.
        multiprocessing.current_process().daemon = False
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_answer, args=(theirs, limit), daemon=True)
        process.start()
        theirs.close()
        child = ours, process
    _local.child = None
    connection, process = child
    try:
        connection.send_bytes(payload)
        result: bytes = connection.recv_bytes()
    except (OSError, EOFError):
        process.join()
        code = process.exitcode or 0
        how = f"exit status {code}" if code >= 0 else signal.Signals(-code).name
        raise ClusterError(f"its process died ({how})") from None
    _local.child = child
    return result


def _answer(requests: Connection, memory_limit: int | None) -> None:
    """Serve the parent's calls until the parent ends.

    ``requests``: gets each ``payload`` of `call_in_child`, and sends the pickled result.
    ``memory_limit``: limit of this process's data [bytes]; None or 0: unlimited.
    """
    # The parent handles Ctrl-C.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if memory_limit:
        # Too large a task fails by itself instead of exhausting the machine's memory.
        with suppress(ImportError, ValueError, OSError):
            import resource  # Absent on Windows.

            resource.setrlimit(resource.RLIMIT_DATA, (memory_limit, memory_limit))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(EOFError, OSError):
        while True:
            function: Callable[[Any], Any]
            function, argument = pickle.loads(requests.recv_bytes())
            requests.send_bytes(pickle.dumps(function(argument)))
