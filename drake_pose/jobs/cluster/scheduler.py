"""Workers on this machine or on others, by Dask (the extra `cluster`)."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from drake_pose import version
from drake_pose.errors import ClusterError

if TYPE_CHECKING:
    from distributed import Client

_TIMEOUT = 5.0
"""How long a scheduler and its workers may take to answer [s]."""

TRIES = 3
"""A task that has killed its process or its worker this often is given up."""

# Nothing but this machine can talk to an embedded cluster, and it says nothing of its own.
_LOOPBACK = "127.0.0.1"
_CONFIGURATION = {
    "distributed.worker.multiprocessing-method": "spawn",
    "distributed.scheduler.allowed-failures": TRIES - 1,
    # A task that waits at a worker that is killed would be suspected with the one that killed it.
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.logging.distributed": "critical",
    "distributed.admin.low-level-log-length": 0,
}


def has_dask() -> bool:
    """Whether the extra ``cluster`` is installed."""
    return find_spec("distributed") is not None


@contextmanager
def open_cluster(workers: int | None = None, scheduler: str | None = None) -> Iterator[Client]:
    """Workers, for as long as the context lasts.

    Args:
        workers: how many processes of one thread on this machine, which talk over its loopback
            address alone; None: one for each core.
        scheduler: address of a Dask scheduler whose workers are used instead.

    Raises:
        ClusterError: distributed is not installed, or the scheduler cannot be reached or has no
            workers, or these have another drake_pose.
    """
    if not has_dask():
        raise ClusterError(
            'workers need Dask distributed: pip install "drake_pose[cluster]"; or do '
            "without them: --workers 0"
        )
    opened = _embedded(workers) if scheduler is None else _connected(scheduler)
    with _quiet(), opened as client:
        yield client


@contextmanager
def _quiet() -> Iterator[None]:
    """What Dask says of workers that die is for its developers; users hear it in other words."""
    loggers = [logging.getLogger(name) for name in ("distributed", "asyncio")]
    levels = [logger.level for logger in loggers]
    try:
        # Importing it sets the level.
        import distributed  # noqa: F401

        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@contextmanager
def _embedded(workers: int | None) -> Iterator[Client]:
    """A client of workers on this machine."""
    from dask import config
    from distributed import Client, LocalCluster

    count = len(os.sched_getaffinity(0)) if workers is None else workers
    if count < 1:
        raise ClusterError(f"a cluster has one worker or more, not {count}")
    with (
        tempfile.TemporaryDirectory(prefix="drake_pose_", ignore_cleanup_errors=True) as scratch,
        config.set(_CONFIGURATION),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host=_LOOPBACK,
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": f"{_LOOPBACK}:0"},
            local_directory=scratch,
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextmanager
def _connected(address: str) -> Iterator[Client]:
    """A client of a scheduler that runs elsewhere."""
    from distributed import Client
    from distributed.comm import get_address_host_port

    try:
        get_address_host_port(address, strict=True)
    except ValueError as error:
        raise ClusterError(
            f"'{address}' is no scheduler's address; give one like tcp://10.0.0.7:8786"
        ) from error
    try:
        # A client that finds nobody would be left half made, and complain when it is destroyed.
        asyncio.run(_shake_hands(address))
        client = Client(address, timeout=_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError, EOFError, MemoryError, asyncio.TimeoutError) as error:
        # Whoever listens there may say anything: a web server's words are taken for a size of
        # exabytes.
        raise ClusterError(
            f"no scheduler answers at {address} within {_TIMEOUT:g} s; start one with "
            "'dask scheduler --host 127.0.0.1' and workers with 'dask worker ADDRESS --nthreads 1'"
        ) from error
    with client:
        yield client


async def _shake_hands(address: str) -> None:
    """Connects to a scheduler once; raises what the connection raises, in time."""
    from distributed.comm import connect

    # Its own timeout does not hold where somebody listens and says nothing.
    comm = await asyncio.wait_for(connect(address, timeout=_TIMEOUT), _TIMEOUT + 0.5)
    await comm.close()


class WorkerFacts(NamedTuple):
    """What must be the same here and there: version, the source's digest, a file that is seen."""

    version: str
    code: str
    sees: bool


def worker_facts(file: Path | None = None) -> WorkerFacts:
    """The facts of the process that is asked; ``file``: one that it should see."""
    digest = hashlib.sha256()
    package = Path(version.__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return WorkerFacts(version.VERSION, digest.hexdigest(), file is None or file.is_file())


def require_fit_workers(client: Client, out: Path | None = None) -> None:
    """Looks whether the workers have this drake_pose, and see the result's folder, if there is one.

    Raises:
        ClusterError: there is no worker, or one is not fit.
    """
    with suppress(asyncio.TimeoutError):
        client.wait_for_workers(1, timeout=_TIMEOUT)
    if not client.nthreads():
        raise ClusterError(
            f"the scheduler at {address_of(client)} has no workers; start some with "
            "'dask worker ADDRESS --nthreads 1'"
        )
    with ExitStack() as shown:
        file = None
        if out is not None:
            try:
                out.mkdir(parents=True, exist_ok=True)
                seen = shown.enter_context(tempfile.NamedTemporaryFile(prefix=".seen_", dir=out))
            except OSError as error:
                raise ClusterError(f"{out}: cannot be written: {error.strerror}") from error
            file = Path(seen.name).absolute()
        here = worker_facts(file)
        try:
            there = client.run(worker_facts, file)
        except (ImportError, AttributeError) as error:
            raise ClusterError(
                f"a worker cannot use drake_pose ({error}); install the same version there as "
                f"here, {version.VERSION}"
            ) from error
    for address, facts in there.items():
        if facts == here:
            continue
        how = (
            f"does not see the folder {out}; scenes, models and results must lie where all "
            "machines find them under the same path"
        )
        if facts.version != here.version:
            how = (
                f"has drake_pose {facts.version}, but here is {here.version}; install the same "
                "version on both"
            )
        elif facts.code != here.code:
            how = (
                f"has another development version of drake_pose {facts.version}; install the same "
                "one on both, and start the worker again"
            )
        raise ClusterError(f"the worker {address} {how}")


def address_of(client: Client) -> str:
    """A client's scheduler, for messages."""
    return "its address" if client.scheduler is None else str(client.scheduler.address)
