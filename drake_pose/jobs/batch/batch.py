"""Many scenes, long ones in chunks, on any number of workers; the result does not depend on it.

How far a batch is stands in batch.json, by which an interrupted one goes on.
"""

from __future__ import annotations

import json
import pickle
import shutil
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_pose.csv_files import csv_text
from drake_pose.errors import ClusterError, DrakePoseError, OutputError
from drake_pose.files.folder import without_nan, write_file, writes_folder
from drake_pose.files.summary import next_summary
from drake_pose.jobs.batch.episodes_table import episodes_table
from drake_pose.jobs.batch.job import SceneJob
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
from drake_pose.version import VERSION

if TYPE_CHECKING:
    from distributed import Client, Future

BATCH, CONTRADICTIONS, EPISODES = "batch.json", "contradictions.csv", "episodes.csv"
WAITING, FINISHED, FAILED = "waiting", "finished", "failed"

# A scene of which this many chunks have failed is given up.
_HOPELESS = 3

OnProgress = Callable[[int, int, str], None]
"""Called with the number of frames done, that of all frames, and what went wrong just now or ""."""


@dataclass
class SceneState:
    """How far a scene is.

    Args:
        described: the job and its files as they were at the start.
        tasks: its chunks, or the one task of a scene that is not cut.
        done: the indices of the tasks that are finished.
        errors: what went wrong, and in which frames ("": the whole scene).
        totals: what the result says in short, as of Outcome; of a scene that is finished.
        seconds: of the work on it in this run, over all workers [s].
        attempts: how often a worker began one of its tasks.
    """

    job: SceneJob
    described: Mapping[str, Any]
    tasks: tuple[Task, ...] = ()
    done: set[int | None] = field(default_factory=set)
    errors: dict[str, list[str]] = field(default_factory=dict)
    totals: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    attempts: int = 0

    @property
    def state(self) -> str:
        """WAITING, FINISHED or FAILED."""
        return FAILED if self.errors else FINISHED if self.totals else WAITING

    @property
    def frame_count(self) -> int:
        """All frames."""
        return sum(len(task.frames) for task in self.tasks)

    @property
    def frames_done(self) -> int:
        """The frames of finished tasks."""
        return sum(len(task.frames) for task in self.tasks if task.index in self.done)

    def as_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        of_estimates, of_audits = (
            ("found_count", "mean_E_total"),
            ("agreeing_count", "contradictions"),
        )
        names = of_estimates if self.job.audit is None else of_audits
        return {
            "state": self.state,
            "errors": [{"error": text, "frames": frames} for text, frames in self.errors.items()],
            "frame_count": self.frame_count,
            **{name: self.totals.get(name) for name in names},
            "chunks": len(self.tasks),
            "chunks_done": len(self.done),
            "attempts": self.attempts,
            "worker_seconds": self.seconds,
            "job": self.described,
        }


@writes_folder
def run_batch(
    jobs: Sequence[SceneJob],
    out: Path,
    client: Client | None = None,
    resume: bool = False,
    on_progress: OnProgress = lambda *_: None,
    work: Callable[[Task], Outcome] = perform,
) -> Batch:
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
        _check_same_batch(jobs, out)
    batch = Batch(jobs, out, on_progress)
    try:
        batch.write()
        batch.plan()
        batch.run(client, work)
    finally:
        batch.write()
    return batch


class Batch:
    """A batch under way, and what became of it.

    Attributes:
        scenes: by name.
        seconds: of this run [s].
        out: the folder.
    """

    def __init__(self, jobs: Sequence[SceneJob], out: Path, on_progress: OnProgress) -> None:
        self.out, self._on_progress = out, on_progress
        self.scenes = {job.name: SceneState(job, job.describe()) for job in jobs}
        self.seconds, self._begin = 0.0, time.monotonic()
        self._next_summary = next_summary(self._begin)
        self._waiting: deque[Task] = deque()

    @property
    def failed(self) -> tuple[str, ...]:
        """The scenes that have no result."""
        return tuple(name for name, one in self.scenes.items() if one.state == FAILED)

    def as_json(self) -> dict[str, Any]:
        """The content of batch.json."""
        return {
            "complete": all(one.state == FINISHED for one in self.scenes.values()),
            "seconds": self.seconds,
            "version": VERSION,
            "scenes": {name: one.as_json() for name, one in self.scenes.items()},
        }

    def write(self) -> None:
        """Writes batch.json at once, and of audits contradictions.csv; or raises OutputError."""
        self.seconds = time.monotonic() - self._begin
        text = json.dumps(without_nan(self.as_json()), indent=2, ensure_ascii=False)
        write_file(self.out, BATCH, text + "\n")
        if any(state.job.audit is not None for state in self.scenes.values()):
            rows = [
                (name, one["what"], one["name"], one["text"])
                for name, state in self.scenes.items()
                for one in state.totals.get("contradictions", ())
            ]
            table = csv_text([("scene", "what", "name", "text"), *rows])
            write_file(self.out, CONTRADICTIONS, table)
        episodes = episodes_table({name: state.totals for name, state in self.scenes.items()})
        if episodes is not None:
            write_file(self.out, EPISODES, episodes.text)
            for name, text in episodes.camera_files.items():
                write_file(self.out, name, text)
            for path in self.out.glob("cameras_*.yaml"):
                if path.name not in episodes.camera_files:
                    path.unlink()

    def plan(self) -> None:
        """Lists what is missing; what lies there is not done again."""
        remove_parts(self.out)
        for state in self.scenes.values():
            try:
                state.tasks = plan_scene(state.job, self.out)
            except (DrakePoseError, OSError) as error:
                self._fail(state, "", describe_failure(error))
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
                    f"{self.out}; go on with --resume"
                )
            self._note(task, _outcome(future))

    def _note(self, task: Task, outcome: Outcome) -> None:
        state, work = self.scenes[task.job.name], work_folder(self.out, task.job)
        state.seconds += outcome.seconds
        state.attempts = max(state.attempts, count_attempts(work))
        if outcome.error is not None:
            self._fail(state, task.extent, outcome.error)
        elif task.index is not None:
            state.done.add(task.index)
            if len(state.done) == len(state.tasks):
                self._waiting.appendleft(finishing_task(state.tasks))
        else:
            state.totals = outcome.totals or {}
            count = state.totals.get("frame_count")
            if count == state.frame_count:
                state.done.update(one.index for one in state.tasks)
                shutil.rmtree(work, ignore_errors=True)
                with suppress(OSError):
                    # The last scene leaves it empty.
                    work.parent.rmdir()
            else:
                self._fail(
                    state,
                    "",
                    f"{task.place}: has {count} frames, but the scene has {state.frame_count} by "
                    "now; remove that folder to have it estimated again",
                )
        self._report()
        if (begin := time.monotonic()) > self._next_summary:
            self.write()
            self._next_summary = next_summary(begin)

    def _fail(self, state: SceneState, extent: str, error: str) -> None:
        """Notes what went wrong; the scene's other chunks go on, unless it seems hopeless."""
        state.errors.setdefault(error, []).append(extent)
        if not extent or sum(map(len, state.errors.values())) >= _HOPELESS:
            self._waiting = deque(one for one in self._waiting if one.job is not state.job)
        where = f", {extent}" if extent else ""
        self._report(f"scene '{state.job.name}'{where}: {error}")

    def _report(self, message: str = "") -> None:
        states = self.scenes.values()
        done = sum(one.frames_done for one in states)
        self._on_progress(done, sum(one.frame_count for one in states), message)


def _check_same_batch(jobs: Sequence[SceneJob], out: Path) -> None:
    """Refuses to resume a batch whose scenes were described otherwise; more are allowed."""
    path = out / BATCH
    try:
        recorded = json.loads(path.read_text(encoding="utf-8"))["scenes"]
        before = {name: scene["job"] for name, scene in recorded.items()}
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be read ({error.strerror}): no batch to resume"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise OutputError(f"{path}: is damaged, so it cannot be resumed") from error
    for job in jobs:
        described = json.loads(json.dumps(without_nan(job.describe())))
        known = before.get(job.name, described)
        for key, value in described.items():
            if known.get(key) != value:
                raise OutputError(
                    f"{out}: scene '{job.name}' was begun with {key} = {known.get(key)}, not "
                    f"{value}, so it cannot be resumed; name another folder"
                )


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
