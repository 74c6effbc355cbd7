"""Who does the tasks of a batch: this process, or the workers of a cluster."""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from drake_pose.errors import ClusterError
from drake_pose.jobs.batch.tasks import Outcome, Task, describe_failure, perform
from drake_pose.jobs.cluster.scheduler import TRIES, address_of
from drake_pose.jobs.cluster.worker import call_in_child

if TYPE_CHECKING:
    from distributed import Client


class WorkerPool:
    """A pool of one worker: this process, which does a task when it is waited for."""

    def __init__(self) -> None:
        self._waiting: deque[Task] = deque()

    @property
    def size(self) -> int:
        """How many tasks can be under way at once."""
        return 1

    def start(self, task: Task) -> None:
        """Begins a task."""
        self._waiting.append(task)

    def next(self) -> tuple[Task, Outcome]:
        """Waits for a task that was begun; ClusterError: the workers are gone."""
        task = self._waiting.popleft()
        return task, perform(task)


class ClusterPool(WorkerPool):
    """The workers of a cluster; ``work`` does a task.

    At most one task a thread is under way, so that none waits at a worker that may die.
    """

    def __init__(self, client: Client, work: Callable[[Task], Outcome] = perform) -> None:
        from distributed import as_completed

        self._client, self._work = client, work
        self._completed = as_completed(loop=client.loop)
        self._tasks: dict[object, Task] = {}

    @property
    def size(self) -> int:
        """How many threads the workers have now; a worker that died is being started again."""
        return max(1, sum(self._client.nthreads().values()))

    def start(self, task: Task) -> None:
        """Sends a task to a worker."""
        # A worker that knows neither side of the pickle need not import Drake.
        payload = pickle.dumps((self._work, task))
        future = self._client.submit(call_in_child, payload, TRIES, pure=False)
        self._tasks[future.key] = task
        self._completed.add(future)

    def next(self) -> tuple[Task, Outcome]:
        """Waits for a task that was begun; ClusterError: the scheduler has gone."""
        from distributed import KilledWorker

        future = next(self._completed)
        task = self._tasks.pop(future.key)
        if future.status == "finished":
            return task, pickle.loads(future.result())
        if future.status != "error":
            raise ClusterError(
                f"the scheduler at {address_of(self._client)} has gone; finished chunks are in "
                f"{task.out}; go on with --resume"
            )
        error = future.exception()
        if isinstance(error, KilledWorker):
            return task, Outcome("given up: it has killed its worker again and again")
        return task, Outcome(describe_failure(error))
