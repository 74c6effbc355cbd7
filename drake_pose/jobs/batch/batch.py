"""Many scenes, long ones in chunks, on any number of workers; the result does not depend on it."""

from __future__ import annotations

import pickle
import shutil
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from drake_pose.errors import ClusterError, DrakePoseError
from drake_pose.files.folder import require_empty
from drake_pose.jobs.batch.job import SceneJob
from drake_pose.jobs.batch.state import (
    FAILED,
    FINISHED,
    BatchResult,
    SceneState,
    check_same_batch,
)
from drake_pose.jobs.batch.tasks import (
    Outcome,
    Task,
    count_attempts,
    describe_failure,
    finishing_task,
    perform,
    plan_scene,
    remove_parts,
    work_folder,
)
from drake_pose.jobs.cluster.scheduler import TRIES, address_of
from drake_pose.jobs.cluster.worker import call_in_child

if TYPE_CHECKING:
    from distributed import Client, Future

# A scene of which this many chunks have failed is given up.
_HOPELESS = 3
# Whatever ends the batch writes its summary; this is for one that is killed [s].
_SUMMARY_PERIOD = 2.0

OnProgress = Callable[[int, int, str], None]
"""Called with the number of frames done, that of all frames, and what went wrong just now or ""."""


def run_batch(
    jobs: Sequence[SceneJob],
    out: Path,
    client: Client | None = None,
    resume: bool = False,
    on_progress: OnProgress = lambda *_: None,
    work: Callable[[Task], Outcome] = perform,
) -> BatchResult:
    """Estimates many scenes; each gets a result folder in ``out``, which is empty or not there.

    A scene that fails does not stop the others. Interrupted, finished chunks are in ``out``.

    Args:
        client: of the workers; this process works where None.
        resume: go on with what is in ``out``, and try failed scenes again.
        work: does a task.

    Raises:
        OutputError: the folder cannot be used, or holds another job.
        ClusterError: the workers are gone.
    """
    out = out.absolute()
    if resume:
        check_same_batch(jobs, out)
    else:
        require_empty(out)
    batch = _Batch(jobs, out, on_progress)
    try:
        batch.write()
        batch.plan()
        batch.run(client, work)
    finally:
        batch.write()
    return batch.result()


class _Batch:
    """A batch under way."""

    def __init__(self, jobs: Sequence[SceneJob], out: Path, on_progress: OnProgress) -> None:
        self._out, self._on_progress = out, on_progress
        self._scenes = {job.name: SceneState(job, job.describe()) for job in jobs}
        self._waiting: deque[Task] = deque()
        self._begin = time.monotonic()
        self._written = 0.0

    def plan(self) -> None:
        """Lists what is missing; what lies there is not done again."""
        remove_parts(self._out)
        for state in self._scenes.values():
            try:
                state.tasks = plan_scene(state.job, self._out)
            except DrakePoseError as error:
                self._fail(state, "", str(error))
                continue
            whole = finishing_task(state.tasks)
            is_whole = whole.place.is_dir()
            missing = [task for task in state.tasks if not (is_whole or task.place.is_dir())]
            state.done.update({task.index for task in state.tasks if task not in missing})
            self._waiting.extend(missing or [whole])
        self._report()

    def run(self, client: Client | None, work: Callable[[Task], Outcome]) -> None:
        """Does what is missing."""
        if client is not None:
            self._run_on(client, work)
        while self._waiting:
            task = self._waiting.popleft()
            self._note(task, work(task))

    def _run_on(self, client: Client, work: Callable[[Task], Outcome]) -> None:
        """Does it on workers, a task a thread, so that none waits at a worker that may die."""
        from distributed import as_completed

        completed, tasks = as_completed(loop=client.loop), dict[object, Task]()
        while self._waiting or tasks:
            # A worker that died is being started again.
            while self._waiting and len(tasks) < max(1, sum(client.nthreads().values())):
                task = self._waiting.popleft()
                # A worker that knows neither side of the pickle need not import Drake.
                payload = pickle.dumps((work, task))
                future = client.submit(call_in_child, payload, retries=TRIES - 1, pure=False)
                tasks[future.key] = task
                completed.add(future)
            future = next(completed)
            task = tasks.pop(future.key)
            if future.status not in ("finished", "error"):
                raise ClusterError(
                    f"the scheduler at {address_of(client)} has gone; finished chunks are in "
                    f"{self._out}; go on with --resume"
                )
            self._note(task, _outcome(future))

    def result(self) -> BatchResult:
        """What became of it."""
        return BatchResult(self._scenes, time.monotonic() - self._begin, self._out)

    def write(self) -> None:
        """Writes batch.json."""
        self.result().write()
        self._written = time.monotonic()

    def _note(self, task: Task, outcome: Outcome) -> None:
        state, work = self._scenes[task.job.name], work_folder(self._out, task.job)
        state.seconds += outcome.seconds
        if outcome.error is not None:
            self._fail(state, task.extent, outcome.error)
        elif task.index is None:
            self._finish(state, outcome)
        else:
            state.done.add(task.index)
            if len(state.done) == len(state.tasks):
                self._waiting.appendleft(finishing_task(state.tasks))
        state.attempts = max(state.attempts, count_attempts(work))
        if state.state == FINISHED:
            shutil.rmtree(work, ignore_errors=True)
            with suppress(OSError):
                # The last scene leaves it empty.
                work.parent.rmdir()
        self._report()
        if time.monotonic() - self._written > _SUMMARY_PERIOD:
            self.write()

    def _finish(self, state: SceneState, outcome: Outcome) -> None:
        state.totals = outcome.totals or {}
        count, place = state.totals.get("frame_count"), self._out / state.job.name
        if count != state.frame_count:
            what = f"{place}: has {count} frames, but the scene has {state.frame_count} by now"
            self._fail(state, "", f"{what}; remove that folder to have it estimated again")
            return
        state.state = FINISHED
        state.done.update(task.index for task in state.tasks)

    def _fail(self, state: SceneState, extent: str, error: str) -> None:
        """Notes what went wrong; the scene's other chunks go on, unless it seems hopeless."""
        state.state = FAILED
        state.errors.setdefault(error, []).append(extent)
        if not extent or sum(map(len, state.errors.values())) >= _HOPELESS:
            self._waiting = deque(one for one in self._waiting if one.job is not state.job)
        where = f", {extent}" if extent else ""
        self._report(f"scene '{state.job.name}'{where}: {error}")

    def _report(self, message: str = "") -> None:
        states = self._scenes.values()
        done = sum(one.frames_done for one in states)
        self._on_progress(done, sum(one.frame_count for one in states), message)


def _outcome(future: Future) -> Outcome:
    """What became of a worker's task."""
    from distributed import KilledWorker

    if future.status == "finished":
        outcome: Outcome = pickle.loads(future.result())
        return outcome
    error = future.exception()
    if isinstance(error, KilledWorker):
        return Outcome("given up: it has killed its worker again and again")
    if isinstance(error, ClusterError):
        return Outcome(f"given up after {TRIES} tries: {error}")
    return Outcome(describe_failure(error))
