"""What becomes of a scene's frames: rows and records, written at once; files of all of them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydrake.math import RigidTransform

from drake_pose.errors import OutputError
from drake_pose.jobs.estimate.fit_checks import poor_fit_warnings
from drake_pose.jobs.estimate.inputs import Inputs
from drake_pose.jobs.estimate.measurements import angle_difference
from drake_pose.jobs.estimate.scene_checks import frame_ranges
from drake_pose.results.folder import (
    FAMILIES,
    JOINTS,
    OVERLAY,
    REPLAY,
    REPORT,
    PoseRow,
    ResultFolder,
    base_pose,
    without_nan,
)
from drake_pose.results.joint_tables import family_table, joint_table
from drake_pose.results.motion_files import write_motion
from drake_pose.results.overlay import draw_over_picture, draw_overlay, encode_png
from drake_pose.results.replay import make_replay
from drake_pose.results.report_page import ReportContent, make_report
from drake_pose.results.summary import FrameRecord, camera_warnings, mask_digests, summarize

# Whatever ends the job writes the summary; this is for a job that is killed [s]. It takes a while
# where the recording is long: this many times as long is spent on frames.
_SUMMARY_PERIOD = 2.0
_SUMMARY_SHARE = 20.0
USUAL_RATE_HZ = 30.0
"""Frames a second of a sequence that does not say."""

# What a method says of a whole recording, in summary.json.
_OF_THE_METHOD = ("lengths_m", "girths", "unseen", "proportions", "body_fit_seconds")

OnFrame = Callable[[int, int, str, "FrameRecord | None"], None]
"""Called with the number of finished frames, that of all frames, and a finished frame's name and
record; once with "" and None before the first frame."""

OnStage = Callable[[str, int, int | None], None]
"""Called with what is done, and how much of how much (None: nobody knows) is done of it."""


class Drawn(NamedTuple):
    """A camera's frame: a mask (H, W) or picture (H, W, 3), where the body is, and its segments."""

    seen: np.ndarray
    body: np.ndarray
    segments: np.ndarray | None


class FinishedFrame(NamedTuple):
    """A frame as it is written; drawn: by camera, what an overlay is made of."""

    row: PoseRow
    record: FrameRecord
    drawn: Mapping[str, Drawn]


@dataclass(frozen=True)
class SceneEstimate:
    """The estimate of a scene: poses, the search's records, summary.json, folder and warnings.

    Position kinds are "angle" [rad], "length" [m] or "quaternion", in the plant's order.
    """

    position_names: tuple[str, ...]
    position_kinds: tuple[str, ...]
    rows: tuple[PoseRow, ...]
    records: Mapping[str, FrameRecord]
    summary: Mapping[str, Any]
    folder: Path | None
    warnings: tuple[str, ...] = ()

    @property
    def found_count(self) -> int:
        """In how many frames a pose was found."""
        return sum(record.found for record in self.records.values())


class ResultWriter:
    """A result under way.

    Attributes:
        rows, records: of the finished frames, by name, those of an earlier job among them.
        more: what the method adds to summary.json.

    Args:
        job: from describe_job.
        path: the result's folder; None writes nothing.
        recorded: the summary of the job that is resumed, if one is.
        with_base: whether the base's pose is written too.

    Raises:
        OutputError: the folder is not empty, or cannot be written or resumed.
    """

    def __init__(
        self,
        inputs: Inputs,
        job: Mapping[str, Any],
        path: Path | None,
        recorded: Mapping[str, Any] | None,
        with_base: bool,
    ) -> None:
        self.inputs = inputs
        self.with_base = with_base
        self.rows: dict[str, PoseRow] = {}
        self.records: dict[str, FrameRecord] = {}
        self.more: dict[str, Any] = {}
        self._job = job
        self._rate_hz = inputs.scene.frame_rate_hz or USUAL_RATE_HZ
        self._complete = False
        self._next_summary = 0.0
        self._folder = None
        self._warnings = list(inputs.warnings)
        if path is not None:
            names = inputs.model.position_names
            self._folder = ResultFolder(path, names, with_base, recorded is not None)
            self.rows = {row.frame: row for row in self._folder.rows}
        earlier = recorded or {}
        self.more |= {name: earlier[name] for name in _OF_THE_METHOD if name in earlier}
        known = earlier.get("frames", {})
        for frame, row in self.rows.items():
            error = row.error if row.found else None
            plain = {"found": row.found, "E_total": error, "seconds": row.seconds}
            self.records[frame] = FrameRecord.from_json(known.get(frame, plain))
        self._drop_replaced()

    @property
    def missing(self) -> list[str]:
        """The frames that are not finished."""
        return [frame for frame in self.inputs.frames if frame not in self.rows]

    def _drop_replaced(self) -> None:
        """Forget finished frames whose masks are not known to be those they were made from."""
        gone = [f for f, record in self.records.items() if self._digests(f) != record.masks]
        if not gone:
            return
        known = self.inputs.scene.frames
        if others := set(gone).difference(self.inputs.frames):
            raise OutputError(
                f"frame {frame_ranges(others, known)}: the masks were replaced since it was "
                "finished; have it estimated again, too, or name another folder"
            )
        for frame in gone:
            del self.rows[frame], self.records[frame]
        if self._folder is not None:
            self._folder.forget(gone)
        listed = frame_ranges(gone, known)
        self.warn([f"frame {listed}: estimated again, as the masks were replaced or not recorded"])

    def _digests(self, frame: str) -> dict[str, str]:
        names = [camera.name for camera in self.inputs.cameras]
        return mask_digests(self.inputs.scene, names, frame)

    def inputs_of_all(self) -> Inputs:
        """The inputs, the frames that are finished already among them."""
        frames = [f for f in self.inputs.scene.frames if f in self.rows or f in self.inputs.frames]
        return replace(self.inputs, frames=tuple(frames))

    def begin_again(self, inputs: Inputs) -> None:
        """Drop the finished frames, as new ones for all the frames of the inputs are at hand."""
        self.inputs = inputs
        self.rows, self.records = {}, {}
        if self._folder is not None:
            self._folder.close()
            self._folder.clear()
        self.open()

    def warn(self, warnings: Iterable[str]) -> None:
        """Add what the user should know."""
        self._warnings.extend(warnings)

    def open(self) -> None:
        """Begin the folder, which is not complete until close."""
        if self._folder is not None:
            self._folder.open()
        self.write_summary()

    def add_all(self, frames: Iterable[FinishedFrame], on_frame: OnFrame | None) -> None:
        """Write frames as they come, each at once."""
        total = len(self.inputs.frames)
        finished = total - len(self.missing)
        if on_frame is not None:
            on_frame(finished, total, "", None)
        for count, (row, record, drawn) in enumerate(frames, finished + 1):
            for camera, one in drawn.items():
                self._write_overlay(camera, row, one)
            self.finish_frame(row, record)
            if on_frame is not None:
                on_frame(count, total, row.frame, self.records[row.frame])

    def finish_frame(self, row: PoseRow, record: FrameRecord) -> None:
        """Write a frame. Finished is what has its row in poses.csv; all else comes before."""
        if self._folder is not None:
            self._folder.add(row)
        record = replace(record, masks=self._digests(row.frame))
        self.rows[row.frame], self.records[row.frame] = row, record
        if time.monotonic() > self._next_summary:
            self.write_summary()

    def _write_overlay(self, camera: str, row: PoseRow, drawn: Drawn) -> None:
        if self._folder is None:
            return
        error = f"E_total {100.0 * row.error:.1f} %" if row.found else "no pose found"
        draw = draw_overlay if drawn.seen.ndim == 2 else draw_over_picture
        picture = draw(*drawn, [f"{camera}  frame {row.frame}  {error}"])
        self._folder.write(f"{OVERLAY}/{camera}/{row.frame}.png", encode_png(picture))

    def write(self, name: str, data: bytes) -> None:
        """Write another file of the result."""
        if self._folder is not None:
            self._folder.write(name, data)

    def joint_errors(self, frame: str, q: np.ndarray, found: bool) -> dict[str, float]:
        """Estimate minus truth by position [deg or m], where the truth is known."""
        truth = self.inputs.truth
        true_values = None if truth is None else truth.of(frame)
        if truth is None or true_values is None or not found:
            return {}
        model = self.inputs.model
        errors = {}
        for name, true_value in zip(truth.names, true_values, strict=True):
            index = model.position_index(name)
            error = float(q[index] - true_value)
            if model.periodic[index]:
                error = angle_difference(q[index], true_value)
            is_angle = model.position_kinds[index] == "angle"
            errors[name] = math.degrees(error) if is_angle else error
        return errors

    def finish(self, replay: bool) -> None:
        """Write what is made of all frames; then the result is complete."""
        rows = self.ordered_rows()
        self.warn(camera_warnings(self.records, self._warnings))
        held = self._job.get("settings", {}).get("hold", {})
        self.warn(poor_fit_warnings(rows, self._ordered_records(), self.inputs.model, held))
        if self._folder is not None:
            self._folder.sort(self.inputs.scene.frames)
            self.warn(
                write_motion(
                    self._folder, self.inputs.model, self.inputs.scene, rows, self._rate_hz
                )
            )
            if replay:
                self._write_replay(self._folder)
            self._folder.write(REPORT, make_report(self._report(self._folder.path)).encode())
        self._complete = True

    def close(self) -> None:
        """Write the summary and close the folder, however it ended."""
        self.write_summary()
        if self._folder is not None:
            self._folder.close()

    def result(self) -> SceneEstimate:
        """What came out."""
        model = self.inputs.model
        return SceneEstimate(
            position_names=model.position_names,
            position_kinds=model.position_kinds,
            rows=self.ordered_rows(),
            records=self._ordered_records(),
            summary=self._summary(),
            folder=None if self._folder is None else self._folder.path,
            warnings=tuple(self._warnings),
        )

    def ordered_rows(self) -> tuple[PoseRow, ...]:
        """The rows in the scene's order, those of an earlier job among them."""
        return tuple(self.rows[frame] for frame in self.inputs.scene.frames if frame in self.rows)

    def write_summary(self) -> None:
        """Write summary.json and the tables of joints."""
        if self._folder is None:
            return
        begin = time.monotonic()
        self._folder.write_summary(self._summary())
        records = self._ordered_records()
        if any(record.joints for record in records.values()):
            self._folder.write(JOINTS, joint_table(records).encode())
        if any(record.family_count is not None for record in records.values()):
            self._folder.write(FAMILIES, family_table(records).encode())
        now = time.monotonic()
        self._next_summary = now + max(_SUMMARY_PERIOD, _SUMMARY_SHARE * (now - begin))

    def _ordered_records(self) -> dict[str, FrameRecord]:
        return {row.frame: self.records[row.frame] for row in self.ordered_rows()}

    def _summary(self) -> dict[str, Any]:
        more = {**self.more, "warnings": self._warnings}
        if self.inputs.scene.frame_rate_hz is not None:
            more["frame_rate_hz"] = self.inputs.scene.frame_rate_hz
        return without_nan(summarize(self._job, self._ordered_records(), self._complete, more))

    def _write_replay(self, folder: ResultFolder) -> None:
        """Write replay.html of the frames in which a pose was found."""
        rows = [row for row in self.ordered_rows() if row.found]
        if not rows:
            return
        inputs = self.inputs
        page = make_replay(
            inputs.model,
            np.array([row.q for row in rows]),
            [RigidTransform(base_pose(row.base)) for row in rows],
            inputs.cameras,
            1.0 / self._rate_hz if inputs.scene.sequence else 1.0,
        )
        folder.write(REPLAY, page.encode())

    def _report(self, path: Path) -> ReportContent:
        inputs = self.inputs
        return ReportContent(
            folder=path,
            model=inputs.model,
            cameras=tuple(camera.name for camera in inputs.cameras),
            seen=frozenset(inputs.scene.masks),
            rows=self.ordered_rows(),
            records=self._ordered_records(),
            summary=self._summary(),
            joined=inputs.scene.sequence,
        )
