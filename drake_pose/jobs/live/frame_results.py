"""The result folder of a live capture, frame by frame."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.sources.recorded import TIME_STAMPS
from drake_pose.jobs.estimate.inputs import Inputs
from drake_pose.jobs.estimate.person import FOLLOWED
from drake_pose.jobs.estimate.result import ResultWriter, SceneEstimate
from drake_pose.jobs.live.run import LiveFrame, Mask
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.recordings.persons_in_view import keep_person
from drake_pose.person.shape import KnownShape
from drake_pose.results.folder import PoseRow
from drake_pose.results.joint_tables import record_deviations
from drake_pose.results.settings import EstimateSettings
from drake_pose.results.summary import FrameRecord, describe_job
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.silhouette.pictures.mask_agreement import compare_masks
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.person.live_capture import LiveSensors
from drake_pose.systems.pictures.picture_capture import CameraCount


@dataclass(frozen=True, eq=False)
class LiveResult:
    """What came out of a live capture.

    Args:
        estimate: the estimate, as that of a recorded scene.
        interrupted: whether Ctrl-C ended it.
        troubles: what the user should know and was not told while it ran.
    """

    estimate: SceneEstimate
    interrupted: bool
    troubles: tuple[str, ...]


class LiveWriter:
    """The result of a capture under way.

    Attributes:
        writer: of the folder.

    Args:
        scene: the cameras and where their pictures come from.
        model: the person.
        tracker: made for the person's pose tree; gives its surfaces.
        out: the result's folder, empty or not there.
        period: time between two frames [s].
        packages: folders of packages that the model's ``package://`` names mean, by name.
        on_report: hears what the user is told.
        on_frame: hears of each frame: how many there are, and whether a person was found.

    Raises:
        OutputError: the folder is not empty, or cannot be written.
    """

    def __init__(
        self,
        scene: LiveScene,
        model: ArticulatedModel,
        tracker: PersonPoseTracker,
        out: Path,
        period: float,
        packages: Mapping[str, Path],
        on_report: Callable[[str], None],
        on_frame: Callable[[int, bool], None],
    ) -> None:
        self._scene, self._model, self._tracker = scene, model, tracker
        self._period = period
        self._on_report, self._on_frame = on_report, on_frame
        self._times: dict[str, float] = {}
        self._seen: dict[tuple[str, str], Path] = {}
        self._told: list[str] = []
        self._last = -1
        recorded = Scene(scene.path, scene.cameras, (), {}, True, 1.0 / period)
        inputs = Inputs(recorded, model, tuple(scene.cameras.values()), (), None, None, None)
        settings = EstimateSettings(method="person", packages=packages)
        job = describe_job(scene.path, model.path, settings)
        self.writer = ResultWriter(inputs, job, out, None, with_base=False)

    @property
    def count(self) -> int:
        """How many frames there are."""
        return len(self._times)

    def tell(self, text: str) -> None:
        """Tells the user while the capture runs, and notes it."""
        self._told.append(text)
        self.writer.warn([text])
        self._on_report(text)

    def result(self, interrupted: bool) -> LiveResult:
        """What came out, when the folder is closed."""
        estimate = self.writer.result()
        troubles = tuple(text for text in estimate.warnings if text not in self._told)
        return LiveResult(estimate, interrupted, troubles)

    def add(self, frame: LiveFrame) -> None:
        """Writes a frame, which is named after the periods since the first."""
        self._last = max(self._last + 1, round(frame.time / self._period))
        name = f"{self._last:06d}"
        self._times[name] = frame.time
        found = bool(np.isfinite(frame.q).all())
        error, ious = self._agreement(frame) if found else (float("nan"), {})
        for camera in frame.views:
            self._seen[camera, name] = Path(self._scene.specifications[camera].location)
        row = PoseRow(name, frame.q, None, error, frame.seconds)
        record = FrameRecord(
            found=row.found,
            E_total=error if row.found else None,
            seconds=frame.seconds,
            stopped_by=FOLLOWED,
            joints=record_deviations(self._model, frame.q, frame.deviations),
            ious=ious,
            share=frame.share if np.isfinite(frame.share) else None,
        )
        self.writer.finish_frame(row, record)
        self._on_frame(self.count, row.found)

    def open(self, method: str, shape: KnownShape | None = None) -> None:
        """Opens the files; shape: the person's lengths and girths, None: the model's."""
        self.writer.more["method"] = method
        if shape is not None:
            self.writer.more |= {"lengths_m": shape.lengths, "girths": shape.girths}
        self.writer.open()

    def finish(self, sensors: LiveSensors, replay: bool) -> None:
        """Writes what is made of all frames."""
        writer = self.writer
        # A moment that no camera saw, or nobody had time for, is a frame without a pose.
        frames = tuple(f"{k:06d}" for k in range(self._last + 1))
        scene = replace(writer.inputs.scene, frames=frames, masks=self._seen)
        writer.inputs = replace(writer.inputs, scene=scene, frames=tuple(self._times))
        counts = sensors.counts()
        writer.more["sources"] = {
            name: _describe_camera(self._scene, name, count) for name, count in counts.items()
        }
        writer.more["skipped_moments"] = sensors.skipped
        writer.warn(camera_troubles(counts, sensors.skipped))
        if writer.rows:
            writer.finish(replay)
            _write_times(writer, self._times)

    def _agreement(self, frame: LiveFrame) -> tuple[float, Mapping[str, float]]:
        """E_total, and by camera the intersection over union of region and body."""
        fit = self._tracker.fit
        values = self._tracker.values(frame.q)
        X_WN = fit.kinematics.poses(values)
        masks: Mapping[str, Mask] = {name: view.region for name, view in frame.views.items()}
        if frame.has_others:
            place = self._tracker.place(values)
            masks = keep_person(self._scene.cameras, masks, place).masks
        bodies = {}
        for name in masks:
            camera = self._scene.cameras[name]
            bodies[name] = draw_mask(fit.outlines, camera.X_CW @ X_WN, camera)
        agreement = compare_masks(masks, bodies)
        return agreement.E_total, agreement.ious


def camera_troubles(counts: Mapping[str, CameraCount], skipped: int) -> list[str]:
    """What the user should know at the end of a capture: pictures lost, by camera."""
    troubles = []
    for name, count in counts.items():
        lost = [
            f"{number} {what}"
            for number, what in (
                (count.dropped, "could not be used"),
                (count.late, "came after their moment"),
            )
            if number
        ]
        if lost:
            troubles.append(f"camera '{name}': of its pictures {' and '.join(lost)}")
        stops = sum(change.stopped for change in count.changes)
        if stops and count.changes[-1].stopped:
            troubles.append(f"camera '{name}' had stopped by the end")
    if skipped:
        troubles.append(
            f"{skipped} moments were skipped: this computer could not follow the cameras"
        )
    return troubles


def _describe_camera(scene: LiveScene, name: str, count: CameraCount) -> dict[str, Any]:
    """What summary.json says of a camera's source."""
    given = scene.specifications[name]
    return {
        "kind": given.kind,
        "location": given.location,
        "used": count.used,
        "dropped": count.dropped,
        "late": count.late,
        "changes": [
            {"time": change.time, "what": "stopped" if change.stopped else "returned"}
            for change in count.changes
        ],
    }


def _write_times(writer: ResultWriter, times: Mapping[str, float]) -> None:
    """Writes timestamps.csv: frame, time [s]."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["frame", "time"])
    table.writerows([frame, f"{time:.6f}"] for frame, time in times.items())
    writer.write(TIME_STAMPS, text.getvalue().encode())
