"""The result folder of a live capture, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.sources.source_files import TIME_STAMPS
from drake_pose.csv_files import csv_text
from drake_pose.files.records import FrameRecord, PoseRow, SceneEstimate, record_deviations
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.summary import describe_job
from drake_pose.files.writer import ResultWriter
from drake_pose.jobs.estimate.person import FOLLOWED
from drake_pose.jobs.live.run import LiveFrame, Mask
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.recordings.persons_in_view import keep_person
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.silhouette.pictures.masks import compare_masks
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.person.live_capture import LiveSensors
from drake_pose.systems.pictures.picture_capture import CameraCount


@dataclass(frozen=True, eq=False)
class LiveResult:
    """What came out of a live capture; troubles: what the user was not told while it ran."""

    estimate: SceneEstimate
    interrupted: bool
    troubles: tuple[str, ...]


class LiveWriter:
    """The result of a capture under way; arguments and errors are those of capture_live.

    Args:
        tracker: made for the person's pose tree; gives its surfaces.
        period: time between two frames [s].
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
        self._scene, self._tracker, self._period = scene, tracker, period
        self._model = model
        self._on_report, self._on_frame = on_report, on_frame
        self._times: dict[str, float] = {}
        self._seen: dict[tuple[str, str], Path] = {}
        self._told: list[str] = []
        self._last = -1
        recorded = Scene(scene.path, scene.cameras, (), {}, True, 1.0 / period)
        settings = EstimateSettings(method="person", packages=packages)
        job = describe_job(scene.path, model.path, settings)
        self.writer = ResultWriter(recorded, model, job, out)

    def tell(self, text: str) -> None:
        """Tells the user while the capture runs, and notes it."""
        self._told.append(text)
        self.writer.warnings.append(text)
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
        record = FrameRecord.of(
            row,
            stopped_by=FOLLOWED,
            joints=record_deviations(self._model, frame.q, frame.deviations),
            ious=ious,
            share=frame.share if np.isfinite(frame.share) else None,
        )
        self.writer.add(row, record)
        self._on_frame(len(self._times), row.found)

    def finish(self, sensors: LiveSensors, replay: bool) -> None:
        """Writes what is made of all frames."""
        writer = self.writer
        # A moment that no camera saw, or nobody had time for, is a frame without a pose.
        frames = tuple(f"{k:06d}" for k in range(self._last + 1))
        writer.scene = replace(writer.scene, frames=frames, masks=self._seen)
        counts, sources = sensors.counts(), {}
        for name, count in counts.items():
            given = self._scene.specifications[name]
            changes = [
                {"time": one.time, "what": "stopped" if one.stopped else "returned"}
                for one in count.changes
            ]
            sources[name] = {"kind": given.kind, "location": given.location, **asdict(count)}
            sources[name]["changes"] = changes
        writer.more |= {"sources": sources, "skipped_moments": sensors.skipped}
        writer.warnings += camera_troubles(counts, sensors.skipped)
        if writer.rows:
            writer.finish(replay)
            times = [(frame, f"{time:.6f}") for frame, time in self._times.items()]
            writer.write(TIME_STAMPS, csv_text([("frame", "time"), *times]))

    def _agreement(self, frame: LiveFrame) -> tuple[float, Mapping[str, float]]:
        """E_total over all views, and each one's IoU."""
        fit, cameras = self._tracker.fit, self._scene.cameras
        values = self._tracker.values(frame.q)
        X_WN = fit.kinematics.poses(values)
        masks: Mapping[str, Mask] = {name: view.region for name, view in frame.views.items()}
        if frame.has_others:
            masks = keep_person(cameras, masks, self._tracker.place(values)).masks
        bodies = {
            name: draw_mask(fit.outlines, cameras[name].X_CW @ X_WN, cameras[name])
            for name in masks
        }
        agreement = compare_masks(masks, bodies)
        return agreement.E_total, agreement.ious


def camera_troubles(counts: Mapping[str, CameraCount], skipped: int) -> list[str]:
    """What the user should know at the end of a capture: pictures lost, by camera."""
    troubles = []
    for name, count in counts.items():
        numbers = {"could not be used": count.dropped, "came after their moment": count.late}
        lost = [f"{number} {what}" for what, number in numbers.items() if number]
        if lost:
            troubles.append(f"camera '{name}': of its pictures {' and '.join(lost)}")
        if count.changes and count.changes[-1].stopped:
            troubles.append(f"camera '{name}' had stopped by the end")
    if skipped:
        troubles.append(
            f"{skipped} moments were skipped: this computer could not follow the cameras"
        )
    return troubles
