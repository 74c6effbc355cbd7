"""Estimates and audits of many scenes, long ones in chunks, on any number of workers.

The result does not depend on the number of workers. Each task writes to a temporary folder on the
shared disk and renames it when it is complete, so that tasks may run twice, and finished ones are
skipped. The state of a batch is in batch.json, from which an interrupted batch is resumed.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import shutil
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drake_pose.body import landmarks_file, load_model
from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.episode_files import open_episode
from drake_pose.csv_files import csv_text
from drake_pose.errors import ClusterError, DrakePoseError, OutputError
from drake_pose.files.folder import (
    OVERLAY,
    POSES,
    read_summary,
    without_nan,
    write_file,
    write_summary,
    writes_folder,
)
from drake_pose.files.records import (
    FrameRecord,
    describe_job,
    mask_digests,
    next_summary,
    summarize,
)
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.batch_file import SceneJob
from drake_pose.jobs.cluster import address_of, call_in_child
from drake_pose.jobs.episodes_table import episodes_table
from drake_pose.jobs.estimate.inputs import follows_person
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.jobs.registration.audit import audit_scene
from drake_pose.jobs.registration.inputs import uses_pictures
from drake_pose.jobs.registration.settings import AuditSettings
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import Scene, load_scene
from drake_pose.version import VERSION

if TYPE_CHECKING:
    from distributed import Client

OnProgress = Callable[[int, int, str], None]
"""Called with the number of finished frames, that of all frames, and an error message or ""."""


@dataclass(frozen=True)
class Task:
    """A chunk of a scene, or a whole scene.

    Args:
        job: the scene's job.
        out: folder of the batch.
        index: index of the chunk; None: the whole scene, joined from its chunks if it has any.
        frames: names of the frames of the chunk or of the whole scene.
        chunks: result folders of the chunks to be joined; () if there are none.
    """

    job: SceneJob
    out: Path
    index: int | None
    frames: tuple[str, ...]
    chunks: tuple[Path, ...] = ()

    @property
    def extent(self) -> str:
        """The range of frames, for messages; "" for the whole scene."""
        return "" if self.index is None else f"frames {self.frames[0]} to {self.frames[-1]}"

    @property
    def work(self) -> Path:
        """Folder of the scene's finished chunks, removed when the scene is finished."""
        return self.out / ".chunks" / self.job.name

    @property
    def place(self) -> Path:
        """The task's result folder."""
        if self.index is None:
            return self.out / self.job.name
        # The digest distinguishes the chunks of a scene to which frames were added.
        frames = hashlib.sha256("\n".join(self.frames).encode()).hexdigest()
        return self.work / f"{self.index:06d}-{frames[:8]}"


class Outcome(NamedTuple):
    """Result of a task.

    Args:
        error: message of the error; None if the task succeeded.
        seconds: wall time [s]; 0 if the result existed already.
        totals: of a whole scene that succeeded, the result of `_totals`; else None.
    """

    error: str | None
    seconds: float = 0.0
    totals: Mapping[str, Any] | None = None


@dataclass
class SceneState:
    """Progress of a scene.

    Args:
        job: the scene's job.
        described: ``SceneJob.describe()`` at the start.
        tasks: its chunks, or the single task of a scene that is not cut; () before planning.
        done: indices (``Task.index``) of the finished tasks.
        errors: by message, the ranges of frames that failed ("": the whole scene).
        totals: as in Outcome; empty until the scene is finished.
        seconds: time spent on the scene in this run, summed over all workers [s].
    """

    job: SceneJob
    described: Mapping[str, Any]
    tasks: tuple[Task, ...] = ()
    done: set[int | None] = field(default_factory=set)
    errors: dict[str, list[str]] = field(default_factory=dict)
    totals: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def state(self) -> str:
        """The state of the scene: waiting, finished or failed."""
        return "failed" if self.errors else "finished" if self.totals else "waiting"

    @property
    def frame_count(self) -> int:
        """Number of all frames."""
        return sum(len(task.frames) for task in self.tasks)

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


def plan_scene(job: SceneJob, out: Path) -> tuple[Task, ...]:
    """Return the tasks of a scene: its chunks in order; one task for a person or an audit.

    Args:
        job: the scene's job.
        out: folder of the batch.

    Raises:
        DrakePoseError: the scene cannot be read.
    """
    settings = job.settings
    if isinstance(settings, AuditSettings) and uses_pictures(job.scene, settings):
        episode = open_episode(job.scene, joints=_joints(job), episode=settings.episode)
        most = max(len(one.times) for one in episode.cameras.values())
        return (Task(job, out, None, tuple(map(str, range(0, most, settings.every)))),)
    scene = _load(job).of_cameras(settings.cameras)
    scene, asked = scene.every(settings.every, settings.frames)
    frames = scene.frames_with_files(asked)
    is_whole = job.audit is not None
    # Reading a model takes seconds: only models that may be a person are read.
    if isinstance(settings, EstimateSettings) and (
        landmarks_file(job.model).is_file() or settings.method == "person"
    ):
        model = load_model(job.model, package_paths=settings.packages)
        is_whole = is_whole or follows_person(scene, model, settings)
    if is_whole:
        return (Task(job, out, None, frames),)
    cuts = enumerate(range(0, len(frames), job.chunk))
    return tuple(Task(job, out, index, frames[cut : cut + job.chunk]) for index, cut in cuts)


def perform(task: Task) -> Outcome:
    """Run a task, unless its result folder exists; an error becomes part of the outcome."""
    begin = time.perf_counter()
    seconds = 0.0
    try:
        if task.place.is_dir():
            _require_same_masks(task)
        else:
            _make(task)
            seconds = time.perf_counter() - begin
        return Outcome(None, seconds, _totals(task))
    except (Exception, SystemExit) as error:  # noqa: BLE001
        # A failed DRAKE_DEMAND raises SystemExit, which would end the worker.
        return Outcome(_describe_failure(error), time.perf_counter() - begin)


def _describe_failure(error: BaseException) -> str:
    """Return the message of a task's error; that of unexpected ones begins with their type."""
    if isinstance(error, DrakePoseError):
        return str(error)
    if isinstance(error, SystemExit):
        return f"a DRAKE_DEMAND failed in Drake: {error}"
    return f"{type(error).__name__}: {error}"


def _load(job: SceneJob) -> Scene:
    """Return the scene of a job, with all cameras and frames."""
    cameras = None if job.camera_file is None else load_cameras(job.camera_file)
    settings = job.settings
    is_person = isinstance(settings, EstimateSettings) and settings.method == "person"
    return load_scene(job.scene, cameras, sequence=is_person)


def _joints(job: SceneJob) -> Path | None:
    """Return an audit's table of joint positions; None for the episode's own log."""
    return job.audit if isinstance(job.audit, Path) else None


def _require_same_masks(task: Task) -> None:
    """Raise an OutputError if masks of a finished whole scene have changed since.

    Chunks are checked when they are joined, and episodes have no masks.
    """
    settings = task.job.settings
    is_episode = isinstance(settings, AuditSettings) and uses_pictures(task.job.scene, settings)
    if task.index is not None or is_episode:
        return
    scene = _load(task.job)
    gone = []
    for frame, record in read_summary(task.place)["frames"].items():
        known = record.get("masks", {})
        if frame in task.frames and mask_digests(scene, known, frame) != known:
            gone.append(frame)
    if gone:
        raise OutputError(
            f"{task.place}: the masks of frame {frame_ranges(gone, scene.frames)} were replaced "
            "since; remove that folder to run the scene again"
        )


def _make(task: Task) -> None:
    """Write a task's result to a temporary folder, then rename it to ``task.place``."""
    job, settings = task.job, task.job.settings
    task.work.mkdir(parents=True, exist_ok=True)
    part = task.work / f"{task.place.name}.part-{uuid.uuid4().hex[:12]}"
    try:
        if isinstance(settings, AuditSettings):
            audit_scene(
                job.scene, job.model, _joints(job), part, settings, cameras=job.camera_file,
                overlay=job.overlay,
            )  # fmt: skip
        else:
            is_chunk = task.index is not None
            if task.chunks:
                _join_chunks(task, settings, part)
            estimate_scene(
                job.scene, job.model, part,
                replace(settings, frames=task.frames) if is_chunk else settings,
                truth=job.truth, resume=bool(task.chunks), replay=job.replay and not is_chunk,
                overlay=job.overlay,
            )  # fmt: skip
        try:
            os.replace(part, task.place)
        except OSError as error:
            # A worker that was presumed dead may have finished the same task.
            if not task.place.is_dir():
                raise OutputError(f"{task.place}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _join_chunks(task: Task, settings: EstimateSettings, part: Path) -> None:
    """Join a task's chunks to an unfinished result with all frames in the new folder ``part``.

    Resuming the estimate with these ``settings`` in ``part`` writes the other files.
    """

    def link(source: str, target: str) -> None:
        try:
            os.link(source, target)
        except OSError:  # The file system has no hard links.
            shutil.copyfile(source, target)

    header, rows, records = "", [], {}
    for chunk in task.chunks:
        header, *lines = (chunk / POSES).read_text(encoding="utf-8").splitlines(keepends=True)
        rows += lines
        records.update(read_summary(chunk)["frames"])
        if (chunk / OVERLAY).is_dir():
            shutil.copytree(chunk / OVERLAY, part / OVERLAY, copy_function=link, dirs_exist_ok=True)
    write_file(part, POSES, "".join([header, *rows]))
    described = describe_job(task.job.scene, task.job.model, settings)
    known = {
        one: FrameRecord.from_json(one, values, np.empty(0)) for one, values in records.items()
    }
    write_summary(part, summarize(described, known, False))


def _totals(task: Task) -> Mapping[str, Any] | None:
    """Return entries of a finished whole scene's summary.json; None for a chunk.

    Estimate: ``frame_count``, ``found_count``, ``mean_E_total``. Audit: ``frame_count``,
    ``agreeing_count``, ``findings``, and ``cameras``: entries of the cameras found, by name, with
    ``off_mm`` and ``off_deg``, the distance from the given pose (None if that is no error).
    """
    if task.index is not None:
        return None
    summary = read_summary(task.place)
    if task.job.audit is None:
        return {name: summary.get(name) for name in ("frame_count", "found_count", "mean_E_total")}
    found = summary["findings"]
    off = {one["name"]: one for one in found if one["what"] == "camera"}
    cameras = {
        name: one
        | {"off_mm": off.get(name, {}).get("shift_mm")}
        | {"off_deg": off.get(name, {}).get("angle_deg")}
        for name, one in summary["found_cameras"].items()
    }
    return {
        "cameras": cameras,
        "frame_count": summary["frame_count"] + len(summary["unseen"]),
        "agreeing_count": summary["agreeing_count"],
        "findings": [{name: one[name] for name in ("what", "name", "text")} for one in found],
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

    Returns:
        The batch, in which scenes may have failed.

    Raises:
        OutputError: the folder cannot be used, or holds another batch.
        ClusterError: the connection to the workers is lost.
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

    Args:
        jobs, out, on_progress: as in `run_batch`.
    """

    def __init__(self, jobs: Sequence[SceneJob], out: Path, on_progress: OnProgress) -> None:
        self.out, self._on_progress = out, on_progress
        self.scenes = {job.name: SceneState(job, job.describe()) for job in jobs}
        self.seconds, self._begin = 0.0, time.monotonic()
        self._next_summary = next_summary(self._begin)
        self.waiting: deque[Task] = deque()

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
            "scenes": {name: one.as_json() for name, one in self.scenes.items()},
        }

    def write(self) -> None:
        """Write batch.json; for audits also findings.csv, episodes.csv and camera files.

        Raises:
            OutputError: a file cannot be written.
        """
        self.seconds = time.monotonic() - self._begin
        text = json.dumps(without_nan(self.as_json()), indent=2, ensure_ascii=False)
        write_file(self.out, "batch.json", text + "\n")
        if any(state.job.audit is not None for state in self.scenes.values()):
            rows = [
                (name, one["what"], one["name"], one["text"])
                for name, state in self.scenes.items()
                for one in state.totals.get("findings", ())
            ]
            table = csv_text([("scene", "what", "name", "text"), *rows])
            write_file(self.out, "findings.csv", table)
        table, files = episodes_table({name: one.totals for name, one in self.scenes.items()})
        if files:
            write_file(self.out, "episodes.csv", table)
            for name, text in files.items():
                write_file(self.out, name, text)
            for path in self.out.glob("cameras_*.yaml"):
                if path.name not in files:
                    path.unlink()

    def plan(self) -> None:
        """Queue all scenes' tasks that have no result yet; scenes that cannot be read fail."""
        for folder in (self.out / ".chunks").glob("*/*.part-*"):
            shutil.rmtree(folder, ignore_errors=True)
        for state in self.scenes.values():
            try:
                state.tasks = plan_scene(state.job, self.out)
            except (DrakePoseError, OSError) as error:
                self._fail(state, "", _describe_failure(error))
                continue
            whole = state.whole
            is_whole = whole.place.is_dir()
            missing = [task for task in state.tasks if not (is_whole or task.place.is_dir())]
            state.done.update({task.index for task in state.tasks if task not in missing})
            self.waiting.extend(missing or [whole])
        self._report()

    def run_on(self, client: Client, work: Callable[[Task], Outcome], tries: int) -> None:
        """Run all waiting tasks on a client's workers, one at a time on each thread.

        No task waits at a worker, where it would be blamed for the worker's death. ``work`` and
        ``tries`` are as in `run_batch`.

        Raises:
            ClusterError: the connection to the scheduler is lost.
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
                text = _describe_failure(error)
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
        if outcome.error is not None:
            self._fail(state, task.extent, outcome.error)
        elif task.index is not None:
            state.done.add(task.index)
            if len(state.done) == len(state.tasks):
                self.waiting.appendleft(state.whole)
        else:
            state.totals = outcome.totals or {}
            count = state.totals.get("frame_count")
            if count == state.frame_count:
                state.done.update(one.index for one in state.tasks)
                shutil.rmtree(task.work, ignore_errors=True)
                with suppress(OSError):
                    # Empty after the last scene.
                    task.work.parent.rmdir()
            else:
                self._fail(
                    state,
                    "",
                    f"{task.place}: has {count} frames, but the scene has {state.frame_count} now; "
                    "remove that folder to run the scene again",
                )
        self._report()
        if (begin := time.monotonic()) > self._next_summary:
            self.write()
            self._next_summary = next_summary(begin)

    def _fail(self, state: SceneState, extent: str, error: str, most: int = 3) -> None:
        """Record an error of a task of a scene.

        The scene's other tasks are dropped if the whole scene or ``most`` of its chunks failed.
        ``extent`` is the task's `Task.extent`.
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
