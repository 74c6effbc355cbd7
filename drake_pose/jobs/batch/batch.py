"""Many scenes, long ones in chunks, on any number of workers; the result does not depend on it."""

from __future__ import annotations

import shutil
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from drake_pose.errors import DrakePoseError
from drake_pose.jobs.batch.job import SceneJob
from drake_pose.jobs.batch.state import (
    FAILED,
    FINISHED,
    BatchResult,
    SceneState,
    check_same_batch,
    write_batch,
)
from drake_pose.jobs.batch.tasks import (
    Outcome,
    Task,
    count_attempts,
    finishing_task,
    perform,
    plan_scene,
    remove_parts,
    work_folder,
)
from drake_pose.results.folder import require_empty

# A scene of which this many chunks have failed is given up.
_HOPELESS = 3
# Whatever ends the batch writes its summary; this is for one that is killed [s].
_SUMMARY_PERIOD = 2.0

OnProgress = Callable[[int, int, str], None]
"""Called with the number of frames done, that of all frames, and what went wrong just now or ""."""


class WorkerPool(Protocol):
    """Who does the tasks."""

    @property
    def size(self) -> int:
        """How many tasks can be under way at once."""

    def start(self, task: Task) -> None:
        """Begins a task."""

    def next(self) -> tuple[Task, Outcome]:
        """Waits for a task that was begun.

        Raises:
            ClusterError: the workers are gone.
        """


class OwnProcess:
    """A pool of one worker: this process, which does a task when it is waited for."""

    size = 1

    def __init__(self) -> None:
        self._tasks: deque[Task] = deque()

    def start(self, task: Task) -> None:
        """Begins a task."""
        self._tasks.append(task)

    def next(self) -> tuple[Task, Outcome]:
        """Does the task that was begun first."""
        task = self._tasks.popleft()
        return task, perform(task)


def run_batch(
    jobs: Sequence[SceneJob],
    out: Path,
    pool: WorkerPool | None = None,
    resume: bool = False,
    on_progress: OnProgress | None = None,
) -> BatchResult:
    """Estimates many scenes; each gets a result folder in ``out``.

    A scene that fails does not stop the others. Interrupted, finished chunks are in ``out``.

    Args:
        jobs: the scenes.
        out: the batch's folder, empty or not there.
        pool: who works; this process where None.
        resume: go on with what is in ``out``, and try failed scenes again.
        on_progress: hears how far it is.

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
        batch.run(OwnProcess() if pool is None else pool)
    finally:
        batch.write()
    return batch.result()


class _Batch:
    """A batch under way."""

    def __init__(self, jobs: Sequence[SceneJob], out: Path, on_progress: OnProgress | None) -> None:
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
                self._fail(state, None, str(error))
                continue
            whole = finishing_task(state.tasks)
            missing = [] if whole.place.is_dir() else list(state.tasks)
            for task in state.tasks:
                if task not in missing or task.place.is_dir():
                    state.done.add(task.index)
            self._waiting.extend(task for task in missing if task.index not in state.done)
            if len(state.done) == len(state.tasks):
                self._waiting.append(whole)
        self._report("")

    def run(self, pool: WorkerPool) -> None:
        """Does what is missing."""
        running = 0
        while self._waiting or running:
            while self._waiting and running < pool.size:
                pool.start(self._waiting.popleft())
                running += 1
            self._note(*pool.next())
            running -= 1
            if time.monotonic() - self._written > _SUMMARY_PERIOD:
                self.write()

    def result(self) -> BatchResult:
        """What became of it."""
        return BatchResult(self._scenes, time.monotonic() - self._begin, self._out)

    def write(self) -> None:
        """Writes batch.json."""
        write_batch(self.result())
        self._written = time.monotonic()

    def _note(self, task: Task, outcome: Outcome) -> None:
        state = self._scenes[task.job.name]
        state.seconds += outcome.seconds
        if outcome.error is not None:
            self._fail(state, task, outcome.error)
        elif task.index is None:
            self._finish(state, outcome)
        else:
            state.done.add(task.index)
            if len(state.done) == len(state.tasks):
                self._waiting.appendleft(finishing_task(state.tasks))
        state.attempts = max(state.attempts, count_attempts(work_folder(self._out, state.job)))
        if state.state == FINISHED:
            shutil.rmtree(work_folder(self._out, state.job), ignore_errors=True)
            with suppress(OSError):
                # The last scene leaves it empty.
                work_folder(self._out, state.job).parent.rmdir()
        self._report("")

    def _finish(self, state: SceneState, outcome: Outcome) -> None:
        state.totals = outcome.totals or {}
        count, place = state.totals.get("frame_count"), self._out / state.job.name
        if count != state.frame_count:
            what = f"{place}: has {count} frames, but the scene has {state.frame_count} by now"
            self._fail(state, None, f"{what}; remove that folder to have it estimated again")
            return
        state.state = FINISHED
        state.done.update(task.index for task in state.tasks)

    def _fail(self, state: SceneState, task: Task | None, error: str) -> None:
        """Notes what went wrong; the scene's other chunks go on, unless it seems hopeless."""
        state.state = FAILED
        extent = "" if task is None else task.extent
        state.errors.setdefault(error, []).append(extent)
        if not extent or sum(map(len, state.errors.values())) >= _HOPELESS:
            self._waiting = deque(one for one in self._waiting if one.job is not state.job)
        where = f", {extent}" if extent else ""
        self._report(f"scene '{state.job.name}'{where}: {error}")

    def _report(self, message: str) -> None:
        if self._on_progress is not None:
            states = self._scenes.values()
            done, total = (
                sum(one.frames_done for one in states),
                sum(one.frame_count for one in states),
            )
            self._on_progress(done, total, message)
