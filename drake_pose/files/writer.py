"""A result under way: each frame is written as it comes, what is made of all of them at the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drake_pose.body import ArticulatedModel
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import OutputError
from drake_pose.files.folder import (
    FAMILIES,
    JOINTS,
    OVERLAY,
    REPLAY,
    REPORT,
    without_nan,
    write_file,
    write_summary,
)
from drake_pose.files.motion_files import write_motion
from drake_pose.files.overlay import draw_overlay, encode_png
from drake_pose.files.records import (
    FrameRecord,
    PoseRow,
    PoseTable,
    SceneEstimate,
    base_pose,
    family_table,
    joint_table,
    measured_positions,
)
from drake_pose.files.replay import make_replay
from drake_pose.files.report_page import make_report
from drake_pose.files.summary import (
    camera_warnings,
    frame_warnings,
    mask_digests,
    next_summary,
    poor_fit_warnings,
    summarize,
)
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import USUAL_RATE_HZ, Scene

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


class ResultWriter:
    """A result under way.

    Attributes:
        rows, records: of the finished frames, by name, those of an earlier job among them.
        more: what the method adds to summary.json.
        warnings: what the user should know.

    Args:
        scene: what the cameras see that are used.
        job: from describe_job.
        folder: the result's; None writes nothing.
        earlier: the summary of the job that is resumed, if one is.
        with_base: whether the base's pose is written too.
        frames: those that are asked for.

    Raises:
        OutputError: the folder cannot be written or resumed.
    """

    def __init__(
        self,
        scene: Scene,
        model: ArticulatedModel,
        job: Mapping[str, Any],
        folder: Path | None,
        *,
        earlier: Mapping[str, Any] | None = None,
        with_base: bool = False,
        frames: Iterable[str] = (),
        warnings: Iterable[str] = (),
    ) -> None:
        self.scene, self.model, self.folder = scene, model, folder
        self.rows: dict[str, PoseRow] = {}
        self.records: dict[str, FrameRecord] = {}
        self.warnings = list(warnings)
        self._job, self._complete, self._next_summary = job, False, 0.0
        self._table = None
        if folder is not None:
            self._table = PoseTable(folder, model.position_names, with_base)
        earlier = earlier or {}
        self.more = {name: earlier[name] for name in _OF_THE_METHOD if name in earlier}
        if earlier and self._table is not None:
            self.rows = {row.frame: row for row in self._table.read()}
        known = earlier.get("frames", {})
        for frame, row in self.rows.items():
            plain = FrameRecord.of(row).as_json()
            self.records[frame] = FrameRecord.from_json(known.get(frame, plain))
        self._drop_replaced(set(frames))

    def _drop_replaced(self, asked: set[str]) -> None:
        """Forget finished frames whose masks are not known to be those they were made from."""
        gone = [f for f, record in self.records.items() if self._digests(f) != record.masks]
        if not gone:
            return
        if others := set(gone) - asked:
            raise OutputError(
                f"frame {frame_ranges(others, self.scene.frames)}: the masks were replaced since "
                "it was finished; have it estimated again, too, or name another folder"
            )
        for frame in gone:
            del self.rows[frame], self.records[frame]
        listed = frame_ranges(gone, self.scene.frames)
        self.warnings.append(
            f"frame {listed}: estimated again, as the masks were replaced or not recorded"
        )

    def _digests(self, frame: str) -> dict[str, str]:
        return mask_digests(self.scene, self.scene.cameras, frame)

    def begin(self) -> None:
        """Begin the folder, which is not complete until all is written."""
        if self._table is not None:
            self._table.write(self.rows.values())
        self.write_summary()

    def add_all(
        self, frames: Iterable[FinishedFrame], asked: Collection[str], on_frame: OnFrame | None
    ) -> None:
        """Write frames as they come, each at once, of those that are asked for."""
        finished = sum(frame in self.rows for frame in asked)
        if on_frame is not None:
            on_frame(finished, len(asked), "", None)
        for count, (row, record, drawn) in enumerate(frames, finished + 1):
            for camera, one in drawn.items():
                self._write_overlay(camera, row, one)
            self.add(row, record)
            if on_frame is not None:
                on_frame(count, len(asked), row.frame, self.records[row.frame])

    def add(self, row: PoseRow, record: FrameRecord) -> None:
        """Write a frame. Finished is what has its row in poses.csv; all else comes before."""
        if self._table is not None:
            self._table.append(row)
        self.rows[row.frame] = row
        self.records[row.frame] = replace(record, masks=self._digests(row.frame))
        if time.monotonic() > self._next_summary:
            self.write_summary()

    def _write_overlay(self, camera: str, row: PoseRow, drawn: Drawn) -> None:
        error = f"E_total {100.0 * row.error:.1f} %" if row.found else "no pose found"
        picture = draw_overlay(*drawn, f"{camera}  frame {row.frame}  {error}")
        self.write(f"{OVERLAY}/{camera}/{row.frame}.png", encode_png(picture))

    def write(self, name: str, content: bytes | str) -> None:
        """Write another file of the result."""
        if self.folder is not None:
            write_file(self.folder, name, content)

    def finish(self, replay: bool) -> None:
        """Write what is made of all frames; then the result is complete."""
        done = self.result()
        self.warnings += frame_warnings(done.records)
        self.warnings += camera_warnings(done.records, self.warnings)
        held = self._job.get("settings", {}).get("hold", {})
        self.warnings += poor_fit_warnings(done.rows, done.records, self.model, held)
        if self._table is not None and self.folder is not None:
            self._table.write(done.rows)
            rate_hz = self.scene.frame_rate_hz or USUAL_RATE_HZ
            rate = rate_hz if self.scene.sequence else None
            frames = self.scene.frames
            self.warnings += write_motion(self.folder, self.model, frames, done.rows, rate)
            found = [row for row in done.rows if row.found]
            if replay and found:
                self.write(REPLAY, self._replay(found, 1.0 / (rate or 1.0)))
            page = make_report(self.folder, self.model, self.scene, self.result())
            self.write(REPORT, page)
        self._complete = True

    def _replay(self, found: Sequence[PoseRow], period: float) -> str:
        """The replay of the frames with a pose; positions that were measured stand as a ghost."""
        q = np.array([row.q for row in found])
        records = [self.records[row.frame] for row in found]
        measured = measured_positions(self.model, q, records)
        ghost = None if np.isnan(measured).all() else np.where(np.isnan(measured), q, measured)
        scales = {
            name: one.camera_scale
            for one in reversed(records)
            for name in one.ious
            if one.camera_scale
        }
        cameras = [
            replace(one, pixels_per_metre=scales.get(one.name, one.pixels_per_metre))
            if isinstance(one, ParallelCamera)
            else one
            for one in self.scene.cameras.values()
        ]
        X_WB = np.array([base_pose(row.base) for row in found])
        return make_replay(self.model, q, X_WB, cameras, period, ghost)

    def result(self) -> SceneEstimate:
        """What came out, in the scene's order, the frames of an earlier job among it."""
        frames = [frame for frame in self.scene.frames if frame in self.rows]
        records = {frame: self.records[frame] for frame in frames}
        more = {**self.more, "warnings": self.warnings}
        if self.scene.frame_rate_hz is not None:
            more["frame_rate_hz"] = self.scene.frame_rate_hz
        return SceneEstimate(
            position_names=self.model.position_names,
            position_kinds=self.model.position_kinds,
            rows=tuple(self.rows[frame] for frame in frames),
            records=records,
            summary=without_nan(summarize(self._job, records, self._complete, more)),
            folder=self.folder,
            warnings=tuple(self.warnings),
        )

    def write_summary(self) -> None:
        """Write summary.json and the tables of joints, whatever there is by now."""
        if self.folder is None:
            return
        begin = time.monotonic()
        done = self.result()
        write_summary(self.folder, done.summary)
        if any(record.joints for record in done.records.values()):
            write_file(self.folder, JOINTS, joint_table(done.records))
        if any(record.family_count is not None for record in done.records.values()):
            write_file(self.folder, FAMILIES, family_table(done.records))
        self._next_summary = next_summary(begin)
