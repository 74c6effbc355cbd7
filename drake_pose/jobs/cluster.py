"""Workers on this machine or on others, by Dask (the extra `cluster`)."""

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
    """Whether the extra ``cluster`` is installed."""
    return find_spec("distributed") is not None


@contextmanager
def open_cluster(
    workers: int | None = None,
    scheduler: str | None = None,
    tries: int = 3,
    timeout: float = 5.0,
) -> Iterator[Client]:
    """Workers, for as long as the context lasts.

    Args:
        workers: number of processes of one thread on this machine, which use its loopback address
            alone; None: one for each core.
        scheduler: address of a Dask scheduler whose workers are used instead.
        tries: a task that has killed its worker this often fails.
        timeout: of the connection to a scheduler [s].

    Raises:
        ClusterError: distributed is not installed, or the scheduler cannot be reached.
    """
    if not has_dask():
        raise ClusterError(
            'workers need Dask distributed: pip install "drake_pose[cluster]"; or do without them: '
            "--workers 0"
        )
    # Importing it sets the level.
    import distributed

    # Dask logs dead workers for its developers; batch says the same in its own words.
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
            "distributed.scheduler.allowed-failures": tries - 1,
            # A task that waits at a worker that is killed would be suspected of having killed it.
            "distributed.scheduler.worker-saturation": 1.0,
            "distributed.logging.distributed": "critical",
            "distributed.admin.low-level-log-length": 0,
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
    """A client of a scheduler that runs elsewhere."""
    from distributed import Client
    from distributed.comm import connect, get_address_host_port

    try:
        get_address_host_port(address, strict=True)
    except ValueError as error:
        raise ClusterError(
            f"'{address}' is no scheduler's address; give one like tcp://10.0.0.7:8786"
        ) from error

    async def shake_hands() -> None:
        # connect's own timeout does not hold where a server accepts and says nothing.
        await (await asyncio.wait_for(connect(address, timeout=timeout), timeout + 0.5)).close()

    try:
        # Before a Client is made: one without a scheduler complains when it is destroyed.
        asyncio.run(shake_hands())
        return Client(address, timeout=timeout, set_as_default=False)
    except (TimeoutError, OSError, ValueError, TypeError, EOFError, MemoryError) as error:
        # A server that is no scheduler may answer anything: bytes of a web page are taken for the
        # size of a message, exabytes.
        raise ClusterError(
            f"no scheduler answers at {address} within {timeout:g} s; start one with "
            "'dask scheduler --host 127.0.0.1' and workers with 'dask worker ADDRESS --nthreads 1'"
        ) from error


def address_of(client: Client) -> str:
    """A client's scheduler, for messages."""
    return "its address" if client.scheduler is None else str(client.scheduler.address)


def worker_facts(file: Path | None = None) -> tuple[str, str, bool]:
    """This process's version, the SHA-256 of its source code, and whether it sees a file."""
    digest = hashlib.sha256()
    package = Path(version.__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return version.VERSION, digest.hexdigest(), file is None or file.is_file()


def require_fit_workers(client: Client, out: Path, timeout: float = 5.0) -> None:
    """Checks that all workers have this drake_pose and see the folder of the result.

    Raises:
        ClusterError: there is no worker within the timeout [s], or one is not fit.
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
        with tempfile.NamedTemporaryFile(prefix=".seen_", dir=out) as seen:
            file = Path(seen.name).absolute()
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
                f"does not see the folder {out}; scenes, models and results must lie where all "
                "machines find them under the same path"
            )
        else:
            continue
        raise ClusterError(f"the worker {address} {how}")


def call_in_child(payload: bytes) -> bytes:
    """Calls a pickled pair of a function and its argument in a child of this worker's thread.

    Drake's renderer and Meshcat must be destroyed in the thread that made them: work is done in a
    child's main thread. A crash ends the child, not the worker. A child is kept for the next call.

    Returns:
        The pickled result.

    Raises:
        ClusterError: the child died.
    """
    child = getattr(_local, "child", None)
    if child is None:
        from distributed import get_worker

        limit = None
        with suppress(ValueError):  # Not called by a worker.
            limit = get_worker().memory_manager.memory_limit
        # Dask's nannies make workers daemons, which multiprocessing allows no children.
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
    """Calls what the parent asks for until the parent ends."""
    # Ctrl-C is the parent's business.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if memory_limit:
        # The task fails, rather than the machine.
        with suppress(ImportError, ValueError, OSError):
            import resource  # Absent on Windows.

            resource.setrlimit(resource.RLIMIT_DATA, (memory_limit, memory_limit))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(EOFError, OSError):
        while True:
            function: Callable[[Any], Any]
            function, argument = pickle.loads(requests.recv_bytes())
            requests.send_bytes(pickle.dumps(function(argument)))
