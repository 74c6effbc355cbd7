"""Estimates and audits of many scenes, long ones in chunks, on any number of workers.

The result does not depend on the number of workers. Each task writes to a temporary folder on the
shared disk and renames it when it is complete, so that tasks may run twice, and finished ones are
skipped. The state of a batch is in batch.json, from which an interrupted batch is resumed.
"""

from __future__ import annotations

import json
import pickle
import shutil
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_pose.errors import ClusterError, DrakePoseError, OutputError
from drake_pose.files.folder import without_nan, write_file, writes_folder
from drake_pose.files.records import next_summary
from drake_pose.input_files import csv_text
from drake_pose.jobs.batch_tasks import (
    Outcome,
    SceneJob,
    Task,
    camera_set,
    describe_failure,
    perform,
    plan_scene,
)
from drake_pose.jobs.cluster import address_of, call_in_child
from drake_pose.jobs.episodes_table import batch_page, episodes_table
from drake_pose.version import VERSION

if TYPE_CHECKING:
    from distributed import Client

OnProgress = Callable[[int, int, str], None]
"""Called with the number of finished frames, that of all frames, and an error message or ""."""


@dataclass
class SceneState:
    """Progress of a scene."""

    job: SceneJob  # The scene's job.
    described: Mapping[str, Any]  # ``SceneJob.describe()`` at the start.
    # Its chunks, or the single task of a scene that is not cut; () before planning.
    tasks: tuple[Task, ...] = ()
    # Indices (``Task.index``) of the finished tasks.
    done: set[int | None] = field(default_factory=set)
    # By message, the ranges of frames that failed ("": the whole scene).
    errors: dict[str, list[str]] = field(default_factory=dict)
    # As in Outcome; empty until the scene is finished.
    totals: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0  # Time spent on the scene in this run, summed over all workers [s].

    @property
    def state(self) -> str:
        """The state of the scene: waiting, finished or failed."""
        return "failed" if self.errors else "finished" if self.totals else "waiting"

    @property
    def frame_count(self) -> int:
        """Number of all frames; of an audited episode those of all cameras, once it is known."""
        planned = sum(len(task.frames) for task in self.tasks)
        return int(self.totals.get("frame_count") or planned)

    @property
    def frames_done(self) -> int:
        """Number of frames of the finished tasks."""
        return sum(len(task.frames) for task in self.tasks if task.index in self.done)

    @property
    def whole(self) -> Task:
        """The task that joins the chunks; the only task of a scene that is not cut."""
        if self.tasks[0].index is None:
            return self.tasks[0]
        frames = tuple(frame for task in self.tasks for frame in task.frames)
        chunks = tuple(task.place for task in self.tasks)
        return Task(self.job, self.tasks[0].out, None, frames, chunks)

    def as_json(self) -> dict[str, Any]:
        """Return the scene's entry of batch.json."""
        totals = ("found_count", "mean_E_total")
        if self.job.audit is not None:
            totals = ("agreeing_count", "findings")
        return {
            "state": self.state,
            "errors": [{"error": text, "frames": frames} for text, frames in self.errors.items()],
            "frame_count": self.frame_count,
            **{name: self.totals.get(name) for name in totals},
            "chunks": len(self.tasks),
            "chunks_done": len(self.done),
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
    tries: int = 3,
) -> Batch:
    """Estimate or audit many scenes, each with a result folder in ``out``.

    A scene that fails does not stop the others. If interrupted, finished chunks are kept in
    ``out``.

    Args:
        jobs: the scenes, whose names differ.
        out: folder of the batch; it must be new or empty, unless ``resume``.
        client: Dask client of the workers; None: this process does the work.
        resume: continue the batch in ``out``, and try failed scenes again.
        on_progress: called after planning, and when a task is finished or has failed.
        work: runs a task and returns its outcome; picklable if there is a client.
        tries: number of attempts for a task that kills its process; used with a client only.

    Returns the batch, in which scenes may have failed.

    Raises OutputError: the folder cannot be used, or holds another batch; ClusterError: the
    connection to the workers is lost.
    """
    out = out.absolute()
    if resume:
        _require_same_batch(jobs, out)
    batch = Batch(jobs, out, on_progress)
    try:
        batch.write()
        batch.plan()
        if client is not None:
            batch.run_on(client, work, tries)
        while batch.waiting:
            task = batch.waiting.popleft()
            batch.note(task, work(task))
    finally:
        batch.write()
    return batch


class Batch:
    """State and result of a batch.

    Attributes:
        scenes: progress by name of the scene.
        seconds: wall time of this run until the last `write` [s].
        out: folder of the batch.
        waiting: tasks still to be run, first ones first.
        moves: which episodes share a camera's pose, and since when it has moved, in words.

    Args:
        jobs, out, on_progress: as in `run_batch`.
    """

    def __init__(self, jobs: Sequence[SceneJob], out: Path, on_progress: OnProgress) -> None:
        self.out, self._on_progress = out, on_progress
        self.scenes = {job.name: SceneState(job, job.describe()) for job in jobs}
        self.seconds, self._begin = 0.0, time.monotonic()
        self._next_summary = next_summary(self._begin)
        self.waiting: deque[Task] = deque()
        self.moves: tuple[str, ...] = ()
        self._followers = dict[str, list[Task]]()

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the scenes that failed."""
        return tuple(name for name, one in self.scenes.items() if one.errors)

    def as_json(self) -> dict[str, Any]:
        """Return the content of batch.json."""
        return {
            "complete": all(one.state == "finished" for one in self.scenes.values()),
            "seconds": self.seconds,
            "version": VERSION,
            "moves": list(self.moves),
            "scenes": {name: one.as_json() for name, one in self.scenes.items()},
        }

    def write(self) -> None:
        """Write batch.json and report.html; for audits also tables and camera files.

        Raises OutputError: a file cannot be written.
        """
        self.seconds = time.monotonic() - self._begin
        if any(state.job.audit is not None for state in self.scenes.values()):
            rows = [
                (name, one["what"], one["name"], one["text"])
                for name, state in self.scenes.items()
                for one in state.totals.get("findings", ())
            ]
            write_file(
                self.out, "findings.csv", csv_text([("scene", "what", "name", "text"), *rows])
            )
        found = {name: one.totals for name, one in self.scenes.items()}
        files, self.moves = episodes_table(found)
        for name, content in files.items():
            write_file(self.out, name, content)
        for path in self.out.glob("cameras_*.yaml") if files else ():
            if path.name not in files:
                path.unlink()
        content = without_nan(self.as_json())
        text = json.dumps(content, indent=2, ensure_ascii=False)
        write_file(self.out, "batch.json", text + "\n")
        batch_page(self.out, content, found).write(self.out)

    def plan(self) -> None:
        """Queue all scenes' tasks that have no result yet; scenes that cannot be read fail.

        Of episodes with the same cameras, the first is audited before the others, which start at
        the poses that were found in it.
        """
        first = dict[tuple[Any, ...], Task]()
        for folder in (self.out / ".chunks").glob("*/*.part-*"):
            shutil.rmtree(folder, ignore_errors=True)
        for state in self.scenes.values():
            try:
                state.tasks = plan_scene(state.job, self.out)
            except (DrakePoseError, OSError) as error:
                self._fail(state, "", describe_failure(error))
                continue
            whole = state.whole
            is_whole = whole.place.is_dir()
            missing = [task for task in state.tasks if not (is_whole or task.place.is_dir())]
            state.done.update({task.index for task in state.tasks if task not in missing})
            cameras = camera_set(state.job)
            begun = None if cameras is None else first.setdefault(cameras, whole)
            if begun is not None and begun is not whole:
                task = replace(whole, near=begun.place)
                self._followers.setdefault(begun.job.name, []).append(task)
            else:
                self.waiting.extend(missing or [whole])
        self._report()

    def run_on(self, client: Client, work: Callable[[Task], Outcome], tries: int) -> None:
        """Run all waiting tasks on a client's workers, one at a time on each thread.

        No task waits at a worker, where it would be blamed for the worker's death. ``work`` and
        ``tries`` are as in `run_batch`.

        Raises ClusterError: the connection to the scheduler is lost.
        """
        from distributed import KilledWorker, as_completed

        completed, tasks = as_completed(loop=client.loop), dict[object, Task]()
        while self.waiting or tasks:
            # The number of threads may be 0 while a dead worker is restarted.
            while self.waiting and len(tasks) < max(1, sum(client.nthreads().values())):
                task = self.waiting.popleft()
                # Pickled, so that only the worker's child process imports Drake.
                payload = pickle.dumps((work, task))
                future = client.submit(call_in_child, payload, retries=tries - 1, pure=False)
                tasks[future.key] = task
                completed.add(future)
            future = next(completed)
            task = tasks.pop(future.key)
            if future.status == "finished":
                self.note(task, pickle.loads(future.result()))
            elif future.status == "error":
                error = future.exception()
                text = describe_failure(error)
                if isinstance(error, KilledWorker):
                    text = "given up: it killed its worker several times"
                elif isinstance(error, ClusterError):
                    text = f"given up after {tries} tries: {error}"
                self.note(task, Outcome(text))
            else:
                raise ClusterError(
                    f"the connection to the scheduler at {address_of(client)} is lost; finished "
                    f"chunks are in {self.out}; continue with --resume"
                )

    def note(self, task: Task, outcome: Outcome) -> None:
        """Record the outcome of a task.

        An error fails its scene. After a scene's last chunk the joining task is queued; a finished
        scene's work folder is deleted, or the scene fails if its number of frames is not planned.
        """
        state = self.scenes[task.job.name]
        state.seconds += outcome.seconds
        self.waiting.extend(self._followers.pop(task.job.name, ()))
        if outcome.error is not None:
            extent = "" if task.index is None else f"frames {task.frames[0]} to {task.frames[-1]}"
            self._fail(state, extent, outcome.error)
        elif task.index is not None:
            state.done.add(task.index)
            if len(state.done) == len(state.tasks):
                self.waiting.appendleft(state.whole)
        else:
            planned, state.totals = state.frame_count, outcome.totals or {}
            count = state.totals.get("frame_count")
            # In an episode some pictures do not show the body, and there may be several cameras.
            if count == planned or camera_set(state.job) is not None:
                state.done.update(one.index for one in state.tasks)
                shutil.rmtree(task.work, ignore_errors=True)
                with suppress(OSError):
                    # Empty after the last scene.
                    task.work.parent.rmdir()
            else:
                self._fail(
                    state,
                    "",
                    f"{task.place}: has {count} frames, but the scene has {planned} now; "
                    "remove that folder to run the scene again",
                )
        self._report()
        if (begin := time.monotonic()) > self._next_summary:
            self.write()
            self._next_summary = next_summary(begin)

    def _fail(self, state: SceneState, extent: str, error: str, most: int = 3) -> None:
        """Record an error of a task of a scene.

        The scene's other tasks are dropped if the whole scene or ``most`` of its chunks failed.
        ``extent`` is the task's range of frames in words; "" for the whole scene.
        """
        state.errors.setdefault(error, []).append(extent)
        if not extent or sum(map(len, state.errors.values())) >= most:
            self.waiting = deque(one for one in self.waiting if one.job is not state.job)
        where = f", {extent}" if extent else ""
        self._report(f"scene '{state.job.name}'{where}: {error}")

    def _report(self, message: str = "") -> None:
        """Call ``on_progress`` with the present numbers of frames, and an error message or ""."""
        states = self.scenes.values()
        done = sum(one.frames_done for one in states)
        self._on_progress(done, sum(one.frame_count for one in states), message)


def _require_same_batch(jobs: Sequence[SceneJob], out: Path) -> None:
    """Raise an OutputError if a job differs from that of the same name in batch.json in ``out``.

    Jobs of new names are allowed. There must be a readable batch.json.
    """
    path = out / "batch.json"
    try:
        recorded = json.loads(path.read_text(encoding="utf-8"))["scenes"]
        before = {name: scene["job"] for name, scene in recorded.items()}
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be read ({error.strerror}); there is no batch to resume"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise OutputError(f"{path}: is damaged, so it cannot be resumed") from error
    for job in jobs:
        described = json.loads(json.dumps(without_nan(job.describe())))
        known = before.get(job.name, described)
        for key, value in described.items():
            if known.get(key) != value:
                raise OutputError(
                    f"{out}: scene '{job.name}' was started with {key} = {known.get(key)}, not "
                    f"{value}, so it cannot be resumed; choose another folder"
                )
