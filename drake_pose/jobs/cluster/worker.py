"""What runs on a worker: a light process that has a child for the heavy work."""

from __future__ import annotations

import hashlib
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from drake_pose import version
from drake_pose.errors import ClusterError
from drake_pose.jobs.cluster.child_process import Child

if TYPE_CHECKING:
    from distributed import Worker

_local = threading.local()


@dataclass(frozen=True)
class WorkerFacts:
    """What must be the same here and there.

    Args:
        version: of drake_pose.
        code: a digest of its source files; development versions differ in nothing else.
        sees: whether a file is there.
    """

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
    sees = file is None or file.is_file()
    return WorkerFacts(version.VERSION, digest.hexdigest(), sees)


def worker_resources(dask_worker: Worker) -> tuple[str, ...]:
    """The names of the resources that the worker that is asked was started with."""
    return tuple(dask_worker.state.total_resources)


def call_in_child(payload: bytes, tries: int) -> bytes:
    """Calls a function in the main thread of this worker's child.

    Args:
        payload: the pickled pair of a function and its argument.
        tries: how many children may die of it.

    Returns:
        The pickled result.

    Raises:
        ClusterError: they died.
    """
    reason = ""
    for _ in range(tries):
        child = getattr(_local, "child", None) or Child(_memory_limit())
        _local.child = child
        try:
            return child.call(payload)
        except ClusterError as error:
            reason, _local.child = str(error), None
    raise ClusterError(f"given up after {tries} tries: {reason}")


def _memory_limit() -> int:
    """What the worker may take is its child's [byte]; 0: no limit."""
    from distributed import get_worker

    try:
        return int(get_worker().memory_manager.memory_limit or 0)
    except ValueError:
        # Not called by a worker.
        return 0
