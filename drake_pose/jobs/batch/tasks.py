"""What the workers of `drake-pose batch` do: a chunk of frames, a capture, a scene put together.

A result is made beside its place on the shared disk and moved there in one step when it is whole: a
task done twice does no harm, and one that was done is not done again.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drake_pose.body.landmarks import landmarks_file
from drake_pose.body.model import load_model
from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.episodes.open import open_episode
from drake_pose.errors import DrakePoseError, OutputError
from drake_pose.files.folder import OVERLAY, POSES, read_summary, write_file, write_summary
from drake_pose.files.records import FrameRecord
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.summary import describe_job, mask_digests, summarize
from drake_pose.jobs.batch.job import SceneJob
from drake_pose.jobs.estimate.inputs import follows_person
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.jobs.registration.audit import audit_scene
from drake_pose.jobs.registration.inputs import looks_at_pictures
from drake_pose.jobs.registration.settings import AuditSettings
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import Scene, load_scene

WORK = ".chunks"
_ATTEMPTS = "attempts.txt"
_PART = ".part-"


@dataclass(frozen=True)
class Task:
    """A piece of work.

    Args:
        index: of the chunk; None: the whole scene, put together from its chunks if it has any.
        frames: the chunk's frames; all of the scene's where index is None.
        chunks: where the chunks lie of which a scene is put together.
    """

    job: SceneJob
    out: Path
    index: int | None
    frames: tuple[str, ...]
    chunks: tuple[Path, ...] = ()

    @property
    def extent(self) -> str:
        """Which frames, for messages; "" where it is the whole scene."""
        return "" if self.index is None else f"frames {self.frames[0]} to {self.frames[-1]}"

    @property
    def place(self) -> Path:
        """Where the result will lie."""
        if self.index is None:
            return self.out / self.job.name
        # A scene to which frames were added has other chunks.
        frames = hashlib.sha256("\n".join(self.frames).encode()).hexdigest()
        return work_folder(self.out, self.job) / f"{self.index:06d}-{frames[:8]}"


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Args:
        error: why it failed; None where it did not.
        seconds: how long it took [s]; 0 where its result lay there already.
        totals: of a whole scene, numbers of its summary.
    """

    error: str | None
    seconds: float = 0.0
    totals: Mapping[str, Any] | None = None


def work_folder(out: Path, job: SceneJob) -> Path:
    """Where a scene's finished chunks lie until all are there."""
    return out / WORK / job.name


def plan_scene(job: SceneJob, out: Path) -> tuple[Task, ...]:
    """Cuts a scene into tasks: chunks in order, or one where a person is followed or it is audited.

    Raises:
        DrakePoseError: the scene cannot be read.
    """
    if (own := _of_episode(job)) is not None:
        episode = open_episode(job.scene, joints=_joints(job), episode=own.episode)
        most = max(len(one.times) for one in episode.cameras.values())
        return (Task(job, out, None, tuple(map(str, range(0, most, own.every)))),)
    scene = _load(job).of_cameras(job.settings.cameras)
    scene, asked = scene.every(job.settings.every, job.settings.frames)
    frames = scene.seen_frames(asked)
    settings, is_whole = job.settings, job.audit is not None
    # A model is read only where it may be a person's: that takes seconds.
    if isinstance(settings, EstimateSettings) and (
        landmarks_file(job.model).is_file() or settings.method == "person"
    ):
        model = load_model(job.model, package_paths=settings.packages)
        is_whole = is_whole or follows_person(scene, model, settings)
    if is_whole:
        return (Task(job, out, None, frames),)
    cuts = range(0, len(frames), job.chunk)
    return tuple(
        Task(job, out, index, frames[cut : cut + job.chunk]) for index, cut in enumerate(cuts)
    )


def finishing_task(tasks: Sequence[Task]) -> Task:
    """The task that puts a scene together from its chunks; a scene that is not cut has one task."""
    if tasks[0].index is None:
        return tasks[0]
    frames = tuple(frame for task in tasks for frame in task.frames)
    return Task(tasks[0].job, tasks[0].out, None, frames, tuple(task.place for task in tasks))


def perform(task: Task) -> Outcome:
    """Does a task; a failure is part of the outcome."""
    begin = time.perf_counter()
    try:
        if task.place.is_dir():
            _require_same_masks(task)
            return Outcome(None, 0.0, _totals(task))
        _note_attempt(task)
        _make(task)
        return Outcome(None, time.perf_counter() - begin, _totals(task))
    except (Exception, SystemExit) as error:  # noqa: BLE001
        # Drake's failed demands raise SystemExit, which would end a worker.
        return Outcome(describe_failure(error), time.perf_counter() - begin)


def describe_failure(error: BaseException) -> str:
    """A failure in words: our own errors speak for themselves."""
    if isinstance(error, DrakePoseError):
        return str(error)
    if isinstance(error, SystemExit):
        return f"Drake stopped with a failed demand: {error}"
    return f"{type(error).__name__}: {error}"


def count_attempts(folder: Path) -> int:
    """How often tasks were begun whose scene's work folder this is."""
    try:
        return len((folder / _ATTEMPTS).read_text(encoding="utf-8").splitlines())
    except FileNotFoundError:
        return 0


def remove_parts(out: Path) -> None:
    """Removes what interrupted tasks have left."""
    for folder in (out / WORK).glob(f"*/*{_PART}*"):
        shutil.rmtree(folder, ignore_errors=True)


def _require_same_masks(task: Task) -> None:
    """Refuses a finished scene whose masks were replaced; joining chunks sees to theirs."""
    if task.index is not None or _of_episode(task.job) is not None:
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
            "since; remove that folder to have it done again"
        )


def _load(job: SceneJob) -> Scene:
    """A job's scene."""
    cameras = None if job.camera_file is None else load_cameras(job.camera_file)
    settings = job.settings
    is_person = isinstance(settings, EstimateSettings) and settings.method == "person"
    return load_scene(job.scene, cameras, sequence=is_person)


def _of_episode(job: SceneJob) -> AuditSettings | None:
    """The settings of a job that audits an episode; None: it is of a scene of masks."""
    settings = job.settings
    if isinstance(settings, AuditSettings) and looks_at_pictures(job.scene, settings):
        return settings
    return None


def _joints(job: SceneJob) -> Path | None:
    """The table of joint positions of an audit; None: the episode's own."""
    return job.audit if isinstance(job.audit, Path) else None


def _note_attempt(task: Task) -> None:
    """A line that is appended at once, so that workers do not disturb each other."""
    folder = work_folder(task.out, task.job)
    folder.mkdir(parents=True, exist_ok=True)
    index = "" if task.index is None else str(task.index)
    with (folder / _ATTEMPTS).open("a", encoding="utf-8") as file:
        file.write(f"{index}\t{platform.node()}\t{os.getpid()}\n")


def _make(task: Task) -> None:
    """Makes a task's result beside its place and moves it there."""
    job = task.job
    part = work_folder(task.out, job) / f"{task.place.name}{_PART}{uuid.uuid4().hex[:12]}"
    try:
        settings = job.settings
        if isinstance(settings, AuditSettings):
            audit_scene(
                job.scene, job.model, _joints(job), part, settings, cameras=job.camera_file,
                overlay=job.overlay,
            )  # fmt: skip
        elif task.chunks:
            _join_chunks(task, settings, part)
        else:
            of_chunk = task.index is not None
            own = replace(settings, frames=task.frames) if of_chunk else settings
            _estimate(job, part, own, job.replay and not of_chunk)
        try:
            os.replace(part, task.place)
        except OSError as error:
            # Another worker, taken for dead, may have finished the same task.
            if not task.place.is_dir():
                raise OutputError(f"{task.place}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _estimate(
    job: SceneJob, part: Path, settings: EstimateSettings, replay: bool, resume: bool = False
) -> None:
    estimate_scene(
        job.scene, job.model, part, settings, truth=job.truth, resume=resume, replay=replay,
        overlay=job.overlay,
    )  # fmt: skip


def _join_chunks(task: Task, settings: EstimateSettings, part: Path) -> None:
    """Puts a scene together as a result that lacks no frame; resuming it makes the rest."""
    job = task.job
    header, rows, records = "", [], {}
    for chunk in task.chunks:
        header, *lines = (chunk / POSES).read_text(encoding="utf-8").splitlines(keepends=True)
        rows += lines
        records.update(read_summary(chunk)["frames"])
        if (chunk / OVERLAY).is_dir():
            shutil.copytree(
                chunk / OVERLAY, part / OVERLAY, copy_function=_link, dirs_exist_ok=True
            )
    write_file(part, POSES, "".join([header, *rows]))
    described = describe_job(job.scene, job.model, settings)
    known = {name: FrameRecord.from_json(record) for name, record in records.items()}
    write_summary(part, summarize(described, known, False))
    _estimate(job, part, settings, job.replay, resume=True)


def _link(source: str, target: str) -> None:
    """A second name for a file, or a copy where the disk knows no such thing."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _totals(task: Task) -> Mapping[str, Any] | None:
    """What a whole scene's summary says."""
    if task.index is not None:
        return None
    summary = read_summary(task.place)
    if task.job.audit is not None:
        names, told = ("what", "name", "text"), summary["contradictions"]
        found = [{name: one[name] for name in names} for one in told]
        off = {one["name"]: one for one in told if one["what"] == "camera"}
        return {
            "cameras": {
                name: one
                | {"off_mm": off.get(name, {}).get("shift_mm")}
                | {"off_deg": off.get(name, {}).get("angle_deg")}
                for name, one in summary["found_cameras"].items()
            },
            "frame_count": summary["frame_count"] + len(summary["unseen"]),
            "agreeing_count": summary["agreeing_count"],
            "contradictions": found,
        }
    return {name: summary.get(name) for name in ("frame_count", "found_count", "mean_E_total")}
