"""How far a batch is: batch.json, and whether an interrupted one can go on."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drake_pose.csv_files import csv_text
from drake_pose.errors import OutputError
from drake_pose.files.folder import without_nan, write_file
from drake_pose.jobs.batch.job import SceneJob
from drake_pose.jobs.batch.tasks import Task
from drake_pose.version import VERSION

BATCH, CONTRADICTIONS = "batch.json", "contradictions.csv"
WAITING, FINISHED, FAILED = "waiting", "finished", "failed"


@dataclass
class SceneState:
    """How far a scene is.

    Args:
        described: the job and its files as they were at the start.
        state: WAITING, FINISHED or FAILED.
        tasks: its chunks, or the one task of a scene that is not cut.
        done: the indices of the tasks that are finished.
        errors: what went wrong, and in which frames ("": the whole scene).
        totals: what the result says in short, as of Outcome.
        seconds: of the work on it in this run, over all workers [s].
        attempts: how often a worker began one of its tasks.
    """

    job: SceneJob
    described: Mapping[str, Any]
    state: str = WAITING
    tasks: tuple[Task, ...] = ()
    done: set[int | None] = field(default_factory=set)
    errors: dict[str, list[str]] = field(default_factory=dict)
    totals: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    attempts: int = 0

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
        is_audit = self.job.audit is not None
        names = (
            ("agreeing_count", "contradictions") if is_audit else ("found_count", "mean_E_total")
        )
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


@dataclass(frozen=True, eq=False)
class BatchResult:
    """What became of a batch. scenes: by name; seconds: of this run [s]; out: the folder."""

    scenes: Mapping[str, SceneState]
    seconds: float
    out: Path

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


def check_same_batch(jobs: Sequence[SceneJob], out: Path) -> None:
    """Refuses to resume a batch whose scenes were described otherwise; further scenes are allowed.

    Raises:
        OutputError: names the folder, the scene and what differs.
    """
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
