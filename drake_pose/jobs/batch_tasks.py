"""The job file of `drake-pose batch`: its scenes, and their tasks.

A task is a chunk of a scene, or a whole scene, with a result folder.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import time
import uuid
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np
from cyclopts import Parameter

from drake_pose.body import landmarks_file, load_model
from drake_pose.camera.camera_files import intrinsics_of, load_cameras
from drake_pose.camera.episode_files import open_episode
from drake_pose.errors import DrakePoseError, OutputError, SettingsError, for_caller, messages_for
from drake_pose.files.folder import (
    OVERLAY,
    OVERLAY_MODES,
    POSES,
    read_summary,
    write_file,
    write_summary,
)
from drake_pose.files.records import FrameRecord, describe_job, file_digest, mask_digests, summarize
from drake_pose.files.settings import (
    AuditSettings,
    EpisodeSettings,
    EstimateSettings,
    FromText,
    plain,
    say_gone,
)
from drake_pose.input_files import named_fields, read_yaml
from drake_pose.jobs.estimate.inputs import bundled_person, follows_person
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.jobs.registration.audit import audit_scene
from drake_pose.jobs.registration.inputs import uses_pictures
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE, Scene, load_scene


@dataclass(frozen=True)
class SceneJob:
    """One scene of a batch."""

    name: str  # Name of the scene and its result folder.
    scene: Path  # The scene's folder; of an audit also an episode, a folder or file.
    model: Path  # The model file.
    settings: EstimateSettings | AuditSettings  # Settings of the estimate or audit.
    # Measured joint positions to compare an estimate with; None: the scene's own, if any.
    truth: Path | None = None
    # overlay, replay: whether overlays and replay.html are written.
    overlay: bool = True
    replay: bool = True
    chunk: int = 100  # Number of frames in a chunk; recordings of a person and audits are not cut.
    # Table of joint positions to be audited; True: the episode's own joint log; None: the scene is
    # estimated.
    audit: Path | bool | None = None
    camera_file: Path | None = None  # Camera file of an audit; None: the scene's cameras.yaml.

    def describe(self) -> dict[str, Any]:
        """Return plain JSON values, equal only if a resumed job is unchanged."""
        described = describe_job(self.scene, self.model, self.settings)
        described |= {"chunk": self.chunk, "truth": plain(self.truth)}
        if self.audit is not None:
            for name, file in (("audit", self.audit), ("camera_file", self.camera_file)):
                described[name] = file
                if isinstance(file, Path):
                    described[name] = {"file": str(file), "sha256": file_digest(file)}
        return described


def read_job(path: Path) -> tuple[SceneJob, ...]:
    """Return the scenes of a job file, in order. Its paths are relative to its folder.

    ``path``: YAML file with ``scenes`` (settings by name) and optionally ``defaults`` (settings of
    all scenes) and ``chunk``. A scene with ``episodes: "0:99"`` becomes one scene for each episode,
    NAME_000000 and so on.

    Raises SettingsError: the message names the file, scene and setting at fault.
    """
    known = ("chunk", "defaults", "scenes")
    content = named_fields(read_yaml(path, SettingsError), known, str(path), SettingsError)
    scenes = content.get("scenes")
    if not isinstance(scenes, dict) or not scenes:
        raise SettingsError(f"{path}: has no scenes; expected 'scenes:' with NAME: settings")
    length = content.get("chunk", SceneJob.chunk)
    if not isinstance(length, int) or isinstance(length, bool) or length < 1:
        raise SettingsError(f"{path}: chunk: must be a whole number, 1 or more, not {length!r:.60}")
    own = ("scene", "model", "truth", "overlay", "replay", "audit", "camera_file")
    # A batch can audit episodes, but not estimate them.
    of_estimates = [one.name for one in fields(EstimateSettings)]
    of_estimates = [key for key in of_estimates if key not in EpisodeSettings.__annotations__]
    of_audits = [one.name for one in fields(AuditSettings)]
    keys = tuple(dict.fromkeys((*own, *of_estimates, *of_audits, "episodes")))
    given = content.get("defaults") or {}
    defaults = _named_settings(given, keys, f"{path}: defaults")
    jobs = []
    for name, entry in scenes.items():
        where = f"{path}: scene '{str(name)[:60]}'"
        if not isinstance(name, str) or not name or name[0] == "." or {"/", "\\"} & set(name):
            raise SettingsError(
                f"{where}: its name becomes a folder's: a text without slashes that does not "
                "begin with a dot; put numbers in quotes"
            )
        values = {**defaults, **_named_settings(entry or {}, keys, where)}
        named = [(name, values)]
        if (numbers := values.pop("episodes", None)) is not None:
            first, _, last = str(numbers).partition(":")
            if not (first.isdecimal() and last.isdecimal() and int(first) <= int(last)):
                raise SettingsError(
                    f'{where}: episodes: a range like "0:99", with both ends, not {numbers!r:.60}'
                )
            numbered = range(int(first), int(last) + 1)
            named = [(f"{name}_{k:06d}", values | {"episode": k}) for k in numbered]
        for one, given in named:
            jobs.append(_scene_job(one, given, own, length, where, path.parent.absolute()))
    return tuple(jobs)


def _named_settings(value: Any, known: Collection[str], where: str) -> dict[str, Any]:
    """Return settings by name, as `named_fields`; the message names what replaces gone ones."""
    keys = value if isinstance(value, dict) else ()
    if gone := say_gone(f"--{key}".replace("_", "-") for key in keys):
        raise SettingsError(f"{where}: {gone}")
    return named_fields(value, known, where, SettingsError)


def _scene_job(
    name: str, values: Mapping[str, Any], own: tuple[str, ...], chunk: int, where: str, base: Path
) -> SceneJob:
    """Return the job of a scene from its entry, the defaults included.

    ``name``: name of the scene. ``values``: the entry, whose keys are known; None means that the
    key is not given. ``own``: keys that are fields of SceneJob. ``chunk``: number of frames in a
    chunk. ``where``: file and scene, for messages. ``base``: folder of relative paths.

    Raises SettingsError: a key is missing or belongs to the other job, or a value cannot be used.
    """
    values = {key: value for key, value in values.items() if value is not None}
    is_audit = "audit" in values
    kind = AuditSettings if is_audit else EstimateSettings
    names = [one.name for one in fields(kind)]
    if not is_audit:
        names = [key for key in names if key not in EpisodeSettings.__annotations__]
    own = tuple(k for k in own if k not in (("truth",) if is_audit else ("audit", "camera_file")))
    if others := [key for key in values if key not in (*own, *names)]:
        raise SettingsError(
            f"{where}: an {'audit' if is_audit else 'estimate'} has no setting "
            f"{', '.join(others)}; it has: {', '.join((*own, *names))}"
        )
    if "scene" not in values:
        raise SettingsError(f"{where}: 'scene' is missing, the scene's folder")
    given, settings = (
        {
            key: _convert(values[key], hint, f"{where}: {key}", base)
            for key, hint in get_type_hints(known, include_extras=True).items()
            if key in keys and key in values
        }
        for known, keys in ((SceneJob, own), (kind, names))
    )
    try:
        checked = kind(**settings)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error
    return SceneJob(
        name=name, settings=checked, chunk=chunk, **{"model": bundled_person(), **given}
    )


def _convert(value: Any, hint: Any, where: str, base: Path) -> Any:
    """Return a YAML value converted to the type of a settings field.

    ``value``: the value as read. ``hint``: the field's type hint, with its cyclopts parameters.
    ``where``: file, scene and field, for messages. ``base``: folder of relative paths.

    Raises SettingsError: the value cannot be converted.
    """
    reader = None
    while get_origin(hint) is Annotated:
        hint, *more = get_args(hint)
        found = [one.converter for one in more if isinstance(one, Parameter)]
        reader = next((one for one in found if isinstance(one, FromText)), reader)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType) and reader is not None:
        # Parse the text as the option does; a list of numbers is joined to such a text.
        text = ",".join(map(str, value)) if isinstance(value, list) else value
        if not isinstance(text, str):
            raise SettingsError(f"{where}: must be a text, not {value!r:.60}")
        try:
            parsed = reader.parse(text)
        except SettingsError as error:
            raise SettingsError(f"{where}: {error}") from None
        if isinstance(parsed, tuple) and isinstance(parsed[0], Path):
            return (base / parsed[0], *parsed[1:])
        return parsed
    if origin in (Union, UnionType):
        if value is True and bool in arguments:
            return value
        return _convert(value, next(one for one in arguments if one is not type(None)), where, base)
    if origin is tuple:
        texts = value if isinstance(value, list) else [value]
        return tuple(_convert(one, arguments[0], where, base) for one in texts)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        if not isinstance(value, dict):
            raise SettingsError(f"{where}: expected NAME: VALUE lines")
        return {
            str(name): _convert(one, arguments[1], f"{where}: {name}", base)
            for name, one in value.items()
        }
    kinds: dict[Any, tuple[Any, str]] = {
        bool: (bool, "true or false"),
        int: (int, "a whole number"),
        float: ((int, float), "a number"),
    }
    kind, expected = kinds.get(hint, (str, "a text (put numbers in quotes)"))
    if not isinstance(value, kind) or (isinstance(value, bool) and hint is not bool):
        raise SettingsError(f"{where}: must be {expected}, not {value!r:.60}")
    if hint is Path:
        return base / value
    return float(value) if hint is float else value


@dataclass(frozen=True)
class Task:
    """A chunk of a scene, or a whole scene."""

    job: SceneJob  # The scene's job.
    out: Path  # Folder of the batch.
    # Index of the chunk; None: the whole scene, joined from its chunks if it has any.
    index: int | None
    frames: tuple[str, ...]  # Names of the frames of the chunk or of the whole scene.
    # Result folders of the chunks to be joined; () if there are none.
    chunks: tuple[Path, ...] = ()
    # Result folder of an earlier episode, near whose poses cameras are expected; None: they are
    # searched.
    near: Path | None = None

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
    """Result of a task."""

    error: str | None  # Message of the error; None if the task succeeded.
    seconds: float = 0.0  # Wall time [s]; 0 if the result existed already.
    # Of a whole scene that succeeded, the result of `_totals`; else None.
    totals: Mapping[str, Any] | None = None


def plan_scene(job: SceneJob, out: Path) -> tuple[Task, ...]:
    """Return the tasks of a scene: its chunks in order; one task for a person or an audit.

    ``job``: the scene's job. ``out``: folder of the batch. Raises DrakePoseError: the scene cannot
    be read.
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


def camera_set(job: SceneJob) -> tuple[Any, ...] | None:
    """Return what audited episodes with the same cameras have in common; None: no such episode.

    These are the data set, or the folder of the episodes, with model and camera file.
    """
    settings = job.settings
    if not isinstance(settings, AuditSettings) or not uses_pictures(job.scene, settings):
        return None
    folder = job.scene.parent if settings.episode is None else job.scene
    return folder, job.model, job.camera_file, settings.cameras


@messages_for("job file")
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
        return Outcome(describe_failure(error), time.perf_counter() - begin)


@messages_for("job file")
def describe_failure(error: BaseException) -> str:
    """Return the message of a task's error; that of unexpected ones begins with their type."""
    if isinstance(error, DrakePoseError):
        notes = getattr(error, "__notes__", ())
        return for_caller("; ".join((str(error), *notes)))
    if isinstance(error, SystemExit):
        return f"a DRAKE_DEMAND failed in Drake: {error}"
    return f"{type(error).__name__}: {error}"


def _load(job: SceneJob) -> Scene:
    """Return the scene of a job, with all cameras and frames."""
    settings, cameras = job.settings, None
    if job.camera_file is not None:
        known = intrinsics_of(job.scene / CAMERA_FILE, settings.intrinsics, settings.cameras)
        cameras = load_cameras(job.camera_file, known, job.scene)
    is_person = isinstance(settings, EstimateSettings) and settings.method == "person"
    return load_scene(job.scene, cameras, sequence=is_person)


def _joints(job: SceneJob) -> Path | None:
    """Return an audit's table of joint positions; None for the episode's own log."""
    return job.audit if isinstance(job.audit, Path) else None


def _require_same_masks(task: Task) -> None:
    """Raise OutputError if the masks of a finished whole scene changed; episodes have none."""
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
                overlay=job.overlay, near=task.near,
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
    """Join a task's chunks in the new folder ``part``, and resume there with ``settings``."""

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
        for name in (OVERLAY, OVERLAY_MODES):
            if (chunk / name).is_dir():
                shutil.copytree(chunk / name, part / name, copy_function=link, dirs_exist_ok=True)
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
    ``off_mm`` and ``off_deg``, the distance from the given pose (None if that is no error); and
    ``joint_offsets``, unit, value and standard deviation of the joints with errors, by name.
    """
    if task.index is not None:
        return None
    summary = read_summary(task.place)
    if task.job.audit is None:
        return {name: summary.get(name) for name in ("frame_count", "found_count", "mean_E_total")}
    found = summary["findings"]
    off = {one["name"]: one for one in found if one["what"] == "camera"}
    cameras = {
        name: {"X_WC": one.get("X_LC")}
        | one
        | {"off_mm": off.get(name, {}).get("shift_mm")}
        | {"off_deg": off.get(name, {}).get("angle_deg")}
        for name, one in summary["found_cameras"].items()
    }
    units = (("deg", "angle_deg", "angle_sd_deg"), ("mm", "shift_mm", "shift_sd_mm"))
    offsets = {
        one["name"]: next((unit, one[key], one[sd]) for unit, key, sd in units if one[sd])
        for one in found
        if one["what"] == "joint" and (one["angle_sd_deg"] or one["shift_sd_mm"])
    }
    return {
        "joint_offsets": offsets,
        "cameras": cameras,
        "frame_count": summary["frame_count"] + len(summary["unseen"]),
        "agreeing_count": summary["agreeing_count"],
        "findings": [{name: one[name] for name in ("what", "name", "text")} for one in found],
    }
