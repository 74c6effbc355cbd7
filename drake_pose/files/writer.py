"""Writing of a result folder: each frame as it is finished, files about all frames at the end."""

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body import (
    ArticulatedModel,
    Landmark,
    landmark_positions,
    landmarks_file,
    load_landmarks,
)
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import OutputError
from drake_pose.files.folder import (
    JOINT_CENTRES,
    JOINTS,
    MODES,
    MOT,
    REPLAY,
    TRC,
    without_nan,
    write_file,
    write_summary,
)
from drake_pose.files.overlay import encode_png
from drake_pose.files.page import estimate_page
from drake_pose.files.records import (
    BASE_COLUMNS,
    FrameRecord,
    PoseTable,
    SceneEstimate,
    base_cells,
    base_pose,
    camera_warnings,
    frame_warnings,
    joint_table,
    mask_digests,
    measured_positions,
    mode_table,
    next_summary,
    poor_fit_warnings,
    summarize,
    user_units,
)
from drake_pose.files.replay import make_replay
from drake_pose.input_files import csv_text
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import USUAL_RATE_HZ, Scene

OnFrame = Callable[[int, int, str, "FrameRecord | None"], None]
"""Called with the number of finished frames, the number of all frames, and the finished frame's
name and record; once before the first frame, with "" and None."""

OnStage = Callable[[str, int, int | None], None]
"""Called with the name of a stage, the work done, and all its work (None if unknown)."""

Drawn = Mapping[str, np.ndarray]
"""Pictures of a frame, as `encode_png` takes them, by their paths in the result folder."""


class ResultWriter:
    """Writes the result of an estimate.

    Attributes:
        records: finished frames by name, including those of an earlier job.
        more: entries of the method for summary.json, by name.
        warnings: messages for the user.

    Args:
        scene: the scene, with the cameras that are used.
        model: the model of the positions.
        job: from describe_job.
        folder: the result folder; None writes nothing.
        earlier: summary of the job to be resumed; None for a new job.
        with_base: whether poses.csv has BASE_COLUMNS.
        frames: names of the frames that this job estimates.
        warnings: messages so far.

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
        self.records: dict[str, FrameRecord] = {}
        self.warnings = list(warnings)
        self._job, self._complete, self._next_summary = job, False, 0.0
        self._table = None
        if folder is not None:
            self._table = PoseTable(folder, model.position_names, with_base)
        earlier = earlier or {}
        # Estimates for the whole recording, which frames of a resumed job do not repeat.
        kept = ("lengths_m", "radius_scales", "unseen", "proportions", "body_fit_seconds")
        self.more = {name: earlier[name] for name in kept if name in earlier}
        if not earlier or self._table is None:
            return
        self.records = {one.frame: one for one in self._table.read(earlier.get("frames"))}
        # Frames whose mask files have changed, or have no digest, are estimated again.
        known = {frame: mask_digests(scene, scene.cameras, frame) for frame in self.records}
        gone = [frame for frame, digests in known.items() if digests != self.records[frame].masks]
        if others := set(gone) - set(frames):
            raise OutputError(
                f"frame {frame_ranges(others, scene.frames)}: the masks were replaced since "
                "it was finished; estimate it again as well, or choose another folder"
            )
        for frame in gone:
            del self.records[frame]
        if gone:
            self.warnings.append(
                f"frame {frame_ranges(gone, scene.frames)}: estimated again, as the masks were "
                "replaced or not recorded"
            )

    def begin(self) -> None:
        """Write poses.csv and an incomplete summary.json before the first frame."""
        if self._table is not None:
            self._table.write(self.records.values())
        self.write_summary()

    def add_all(
        self, frames: Iterable[tuple[FrameRecord, Drawn]], asked: Collection[str], on_frame: OnFrame
    ) -> None:
        """Write each frame, with its overlays, as soon as it is estimated.

        ``frames``: records and pictures, in order. ``asked``: names of all frames to be
        estimated, those that are finished included. ``on_frame``: called before the first and after
        each frame.
        """
        finished = sum(frame in self.records for frame in asked)
        on_frame(finished, len(asked), "", None)
        for count, (record, drawn) in enumerate(frames, finished + 1):
            for name, picture in drawn.items() if self.folder is not None else ():
                self.write(name, encode_png(picture))
            self.add(record)
            on_frame(count, len(asked), record.frame, self.records[record.frame])

    def add(self, record: FrameRecord) -> None:
        """Append a frame's row to poses.csv, which marks it as finished; renew an old summary."""
        digests = mask_digests(self.scene, self.scene.cameras, record.frame)
        self.records[record.frame] = replace(record, masks=digests)
        if self._table is not None:
            self._table.append(record)
        if time.monotonic() > self._next_summary:
            self.write_summary()

    def end(self) -> None:
        """Write poses.csv and the summary of the finished frames, also after an interruption.

        Ctrl-C may come while a row is appended. The table is therefore written again, so that both
        files have the same frames.
        """
        if self._table is not None:
            self._table.write(self._in_order().values())
        self.write_summary()

    def write(self, name: str, content: bytes | str) -> None:
        """Write another file, ``name`` relative to the result folder; nothing without a folder."""
        if self.folder is not None:
            write_file(self.folder, name, content)

    def finish(self, replay: bool) -> None:
        """Write files about all frames, replay.html if ``replay``; `end` marks them as complete."""
        records = self._in_order()
        self.warnings += frame_warnings(records)
        self.warnings += camera_warnings(records, self.warnings)
        held = self._job.get("settings", {}).get("hold", {})
        self.warnings += poor_fit_warnings(records, self.model, held)
        if self.folder is not None:
            rate_hz = self.scene.frame_rate_hz or USUAL_RATE_HZ
            rate = rate_hz if self.scene.sequence else None
            write_motion(self.folder, self.model, self.scene.frames, list(records.values()), rate)
            found = [record for record in records.values() if record.found]
            if replay and found:
                self.write(REPLAY, self._replay(found, 1.0 / (rate or 1.0)))
            self.write_summary()
            page = estimate_page(self.folder, self.model, self.scene, self.result())
            page.write(self.folder)
        self._complete = True

    def _replay(self, found: Sequence[FrameRecord], period: float) -> str:
        """Return the page replay.html of the frames with a pose; a ghost shows measured positions.

        ``found``: records with a pose. ``period``: time between two frames [s].
        """
        q, measured = np.array([one.q for one in found]), measured_positions(self.model, found)
        ghost = None if np.isnan(measured).all() else np.where(np.isnan(measured), q, measured)
        scales = {k: one.camera_scale for one in found[::-1] for k in one.ious if one.camera_scale}
        cameras = [
            replace(one, pixels_per_metre=scales.get(one.name, one.pixels_per_metre))
            if isinstance(one, ParallelCamera)
            else one
            for one in self.scene.cameras.values()
        ]
        X_WB = np.array([base_pose(one.base) for one in found])
        return make_replay(self.model, q, X_WB, cameras, period, ghost)

    def _in_order(self) -> dict[str, FrameRecord]:
        """Return the finished frames by name, in the scene's order.

        Frames that the scene does not name yet, as in a running capture, come last.
        """
        order = {frame: index for index, frame in enumerate(self.scene.frames)}
        names = sorted(self.records, key=lambda frame: order.get(frame, len(order)))
        return {frame: self.records[frame] for frame in names}

    def result(self) -> SceneEstimate:
        """Return the estimate so far, in the scene's order, including frames of an earlier job."""
        records = self._in_order()
        more = dict(self.more)
        if self.scene.frame_rate_hz is not None:
            more["frame_rate_hz"] = self.scene.frame_rate_hz
        return SceneEstimate(
            self.model.position_names, self.model.position_kinds, records,
            without_nan(summarize(self._job, records, self._complete, more, self.warnings)),
            self.folder, tuple(self.warnings),
        )  # fmt: skip

    def write_summary(self) -> None:
        """Write summary.json, joints.csv and modes.csv (if known) of the frames finished so far."""
        if self.folder is None:
            return
        begin = time.monotonic()
        done = self.result()
        records = done.records.values()
        write_summary(self.folder, done.summary)
        if any(record.joints for record in records):
            write_file(self.folder, JOINTS, joint_table(records))
        if any(record.mode_count is not None for record in records):
            write_file(self.folder, MODES, mode_table(records))
        self._next_summary = next_summary(begin)


def write_motion(
    folder: Path,
    model: ArticulatedModel,
    frames: Sequence[str],
    records: Sequence[FrameRecord],
    rate_hz: float | None,
) -> None:
    """Write joint_centres.csv, and for a sequence TRC and MOT files.

    Joint centres (also in TRC) need a landmarks.yaml beside the model. Files of a sequence hold all
    frames from the first to the last record; frames without a record count as frames without a
    pose. If no record has a pose, no file is written.

    Args:
        folder: the result folder.
        model: the model of the positions.
        frames: names of the scene's frames, in order.
        records: estimates of some or all of the frames, in order.
        rate_hz: frame rate [Hz]; None if the frames are not a sequence: only joint_centres.csv is
            written.

    Raises ModelError: the landmarks cannot be read; OutputError: a file cannot be written.
    """
    has_landmarks = landmarks_file(model.path).is_file()
    landmarks = load_landmarks(model.path) if has_landmarks else {}
    if not any(record.found for record in records):
        return
    known = {record.frame: record for record in records}
    frames = frames[frames.index(records[0].frame) : frames.index(records[-1].frame) + 1]
    lost = FrameRecord("", np.full(len(model.position_names), np.nan), None, None, np.nan)
    own = [known.get(frame, lost) for frame in frames]
    q, X_WB = np.array([record.q for record in own]), None
    if any(record.base is not None for record in records):
        X_WB = np.array([base_pose(record.base) for record in own])
    if landmarks:
        names, centres = list(landmarks), joint_centres(model, landmarks, q, X_WB)
        write_file(folder, JOINT_CENTRES, centres_as_csv(frames, names, centres))
        if rate_hz is not None:
            write_file(folder, TRC, centres_as_trc(names, centres, rate_hz))
    if rate_hz is not None:
        write_file(folder, MOT, positions_as_mot(model, q, rate_hz, X_WB))


def joint_centres(
    model: ArticulatedModel, landmarks: Mapping[str, Landmark], q: Array, X_WB: Array | None = None
) -> Array:
    """Return landmark positions (frames, n, 3) in the scene's world [m]; nan where q is.

    ``landmarks``: n by name. ``q``: (frames, nq) [rad or m]. ``X_WB``: (frames, 4, 4) poses of the
    plant's world in the scene's; None: identity.
    """
    places = np.full((len(q), len(landmarks), 3), np.nan)
    for k in np.flatnonzero(np.isfinite(q).all(axis=1)):
        base = None if X_WB is None else X_WB[k]
        places[k] = landmark_positions(model, landmarks, q[k], base)
    return places


def centres_as_csv(frames: Sequence[str], names: Sequence[str], places: Array) -> str:
    """Return the text of joint_centres.csv: a row for each frame and joint, in the order given.

    ``places``: (frames, joints, 3) [m]; frames with a nan are left out.
    """
    cells = [
        [frame, name, *(f"{number:.4f}" for number in place)]
        for frame, row in zip(frames, places, strict=True)
        if np.isfinite(row).all()
        for name, place in zip(names, row, strict=True)
    ]
    return csv_text([["frame", "joint", "x", "y", "z"], *cells])


def centres_as_trc(names: Sequence[str], places: Array, rate_hz: float) -> str:
    """Return the text of a TRC file of joint centres: millimetres, y up, frames counted from 1.

    ``names``: (joints,) names of the markers. ``places``: (frames, joints, 3) positions in the
    world, z up [m]; nan becomes an empty field. ``rate_hz``: frame rate [Hz].
    """
    count = len(places)
    head = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate",
            "OrigDataStartFrame", "OrigNumFrames"]  # fmt: skip
    values = [f"{rate_hz:g}", f"{rate_hz:g}", count, len(names), "mm", f"{rate_hz:g}", 1, count]
    axes = [f"{axis}{k}" for k in range(1, len(names) + 1) for axis in "XYZ"]
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{TRC}",
        "\t".join(head),
        "\t".join(str(value) for value in values),
        "\t".join(["Frame#", "Time", *(cell for joint in names for cell in (joint, "", ""))]),
        "\t".join(["", "", *axes]),
        "",
    ]
    # A rotation: x forward, y left, z up becomes x forward, y up, z right.
    turned = 1e3 * np.stack([places[..., 0], places[..., 2], -places[..., 1]], axis=-1)
    for k, row in enumerate(turned.reshape(count, -1)):
        cells = ["" if np.isnan(number) else f"{number:.3f}" for number in row]
        lines.append("\t".join([str(k + 1), f"{k / rate_hz:.6f}", *cells]))
    return "\n".join(lines) + "\n"


def positions_as_mot(
    model: ArticulatedModel, q: Array, rate_hz: float, X_WB: Array | None = None
) -> str:
    """Return the text of a MOT file of positions in degrees and metres, with columns by name.

    Args:
        model: the model of the positions.
        q: (frames, nq) positions [rad or m]; frames with a nan have no row.
        rate_hz: frame rate [Hz].
        X_WB: (frames, 4, 4) poses of the plant's world in the scene's world, for BASE_COLUMNS
            [m and unit quaternion]; None: no such columns.
    """
    known = np.flatnonzero(np.isfinite(q).all(axis=1))
    names, columns = list(model.position_names), [known / rate_hz, q[known] * user_units(model)]
    if X_WB is not None:
        names += BASE_COLUMNS
        columns.append(np.array([base_cells(X) for X in X_WB[known]]))
    head = [
        "positions", "version=1", f"nRows={len(known)}", f"nColumns={1 + len(names)}",
        "inDegrees=yes", "endheader", "\t".join(["time", *names]),
    ]  # fmt: skip
    text = StringIO()
    np.savetxt(text, np.column_stack(columns), "%.6f", "\t", header="\n".join(head), comments="")
    return text.getvalue()
