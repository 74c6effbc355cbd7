"""The result folder of a live capture, frame by frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import Context, Diagram, OutputPort

from drake_pose.arrays import Array, Mask
from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.source_files import TIME_STAMPS
from drake_pose.csv_files import csv_text
from drake_pose.files.records import FrameRecord, PoseRow, SceneEstimate, record_deviations
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.summary import describe_job
from drake_pose.files.writer import ResultWriter
from drake_pose.jobs.estimate.person import FOLLOWED
from drake_pose.jobs.live.scene import LiveScene, run_live
from drake_pose.jobs.live.settings import LiveSettings
from drake_pose.person.date.skeleton import FEATURES
from drake_pose.person.persons_in_view import keep_person
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.views import SilhouetteView
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.silhouette.pictures.masks import compare_masks
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.date import PersonView
from drake_pose.systems.person.live_capture import LiveSensors
from drake_pose.systems.pictures.picture_capture import CameraCount

# A choice: of simulated persons who are followed the mean IoU is about 0.8 and more.
_LEAST_IOU = 0.6


class LiveResult(NamedTuple):
    """What came out of a live capture; troubles: what the user was not told while it ran."""

    estimate: SceneEstimate
    interrupted: bool
    troubles: tuple[str, ...]


class LiveWriter:
    """The result of a capture under way; arguments and errors are those of capture_live.

    Args:
        tracker: made for the person's pose tree; gives its surfaces.
        diagram: of build_live_capture, or of build_paper_capture.
        views: by camera, the diagram's port of what its picture says, None where there is none.
        period: time between two frames [s].
        more: the method, and what it adds to summary.json.
    """

    def __init__(
        self,
        scene: LiveScene,
        model: ArticulatedModel,
        tracker: PersonPoseTracker,
        diagram: Diagram,
        views: Mapping[str, OutputPort],
        out: Path,
        period: float,
        more: Mapping[str, Any],
        settings: LiveSettings,
        on_report: Callable[[str], None],
        on_frame: Callable[[int, bool], None],
    ) -> None:
        self._scene, self._tracker, self._diagram, self._views = scene, tracker, diagram, views
        self._period, self._settings = period, settings
        self._on_report, self._on_frame = on_report, on_frame
        self._times: dict[str, float] = {}
        self._seen: dict[tuple[str, str], Path] = {}
        self._doubts: dict[str, list[str]] = {}
        self._told: list[str] = []
        self._index, self._moment, self._begin = -1, float("nan"), time.perf_counter()
        recorded = Scene(scene.path, scene.cameras, (), {}, True, 1.0 / period)
        described = EstimateSettings(method="person", packages=settings.packages)
        job = describe_job(scene.path, model.path, described)
        self._writer = ResultWriter(recorded, model, job, out)
        self._writer.more |= more

    def run(self, sensors: LiveSensors) -> LiveResult:
        """Writes frames as they come, and what is made of all of them."""
        self._writer.begin()
        try:
            seconds, monitor = self._settings.seconds, self._watch
            interrupted = run_live(self._diagram, sensors, seconds, self._tell, monitor=monitor)
            self._finish(sensors)
        finally:
            self._writer.write_summary()
        estimate = self._writer.result()
        troubles = tuple(text for text in estimate.warnings if text not in self._told)
        return LiveResult(estimate, interrupted, troubles)

    def _tell(self, text: str) -> None:
        """Tells the user while the capture runs, and notes it."""
        self._told.append(text)
        self._writer.warnings.append(text)
        self._on_report(text)

    def _watch(self, context: Context) -> None:
        """Writes a frame where there is a new moment; its name counts periods from the first."""
        moment = float(self._value(context, "time")[0])
        if np.isnan(moment) or moment == self._moment:
            return
        self._moment, self._index = moment, max(self._index + 1, round(moment / self._period))
        name, q = f"{self._index:06d}", self._value(context, "estimated_positions")
        seen = {camera: port.Eval(context) for camera, port in self._views.items()}
        views = {camera: view for camera, view in seen.items() if view is not None}
        for camera in views:
            self._seen[camera, name] = Path(self._scene.specifications[camera].location)
        share, others = (float(self._value(context, what)[0]) for what in ("share", "others"))
        seconds = time.perf_counter() - self._begin
        error, ious = self._agreement(q, views, others > 0.0)
        row = PoseRow(name, q, None, error, seconds)
        record = FrameRecord.of(
            row,
            stopped_by=FOLLOWED,
            joints=record_deviations(
                self._writer.model, q, self._value(context, "deviations", len(q))
            ),
            ious=ious,
            share=share if np.isfinite(share) else None,
        )
        self._writer.add(row, record)
        self._times[name] = moment
        of_person = self._writer.more["method"] == "person"
        for text in () if of_person else self._doubts_of(context, ious):
            self._doubts.setdefault(text, []).append(name)
        self._on_frame(len(self._times), row.found)
        self._begin = time.perf_counter()

    def _finish(self, sensors: LiveSensors) -> None:
        """Writes what is made of all frames."""
        writer = self._writer
        writer.warnings += [
            f"frame {frame_ranges(frames, list(self._times))}: {text}"
            for text, frames in self._doubts.items()
        ]
        # A moment that no camera saw, or nobody had time for, is a frame without a pose.
        names = tuple(f"{k:06d}" for k in range(self._index + 1))
        writer.scene = replace(writer.scene, frames=names, masks=self._seen)
        counts, sources = sensors.counts(), {}
        for name, count in counts.items():
            given = self._scene.specifications[name]
            changes = [
                {"time": one.time, "what": "stopped" if one.stopped else "returned"}
                for one in count.changes
            ]
            known = {"kind": given.kind, "location": given.location, **asdict(count)}
            sources[name] = known | {"changes": changes}
        writer.more |= {"sources": sources, "skipped_moments": sensors.skipped}
        writer.warnings += camera_troubles(counts, sensors.skipped)
        if writer.rows:
            writer.finish(self._settings.replay)
            times = [(frame, f"{time:.6f}") for frame, time in self._times.items()]
            writer.write(TIME_STAMPS, csv_text([("frame", "time"), *times]))

    def _value(self, context: Context, name: str, size: int = 1) -> Array:
        """An output's value; nan where the diagram has no such output."""
        if not self._diagram.HasOutputPort(name):
            return np.full(size, np.nan)
        return np.array(self._diagram.GetOutputPort(name).Eval(context))

    def _agreement(
        self, q: Array, views: Mapping[str, SilhouetteView | PersonView], has_others: bool
    ) -> tuple[float, Mapping[str, float]]:
        """E_total over all views, nan where nobody was found, and each one's IoU."""
        if not np.isfinite(q).all():
            return float("nan"), {}
        fit, cameras = self._tracker.fit, self._scene.cameras
        values = self._tracker.values(q)
        X_WN = fit.kinematics.poses(values)
        masks: Mapping[str, Mask] = {name: view.region for name, view in views.items()}
        if has_others:
            masks = keep_person(cameras, masks, self._tracker.place(values)).masks
        bodies = {
            name: draw_mask(fit.outlines, cameras[name].X_CW @ X_WN, cameras[name])
            for name in masks
        }
        agreement = compare_masks(masks, bodies)
        return agreement.E_total, agreement.ious

    def _doubts_of(self, context: Context, ious: Mapping[str, float]) -> Iterator[str]:
        """Why one should not trust the paper's stages in a frame."""
        if not np.isfinite(self._value(context, "estimated_positions")).all():
            yield "before the registered pose"
            return
        # Where a pose was recognised no feature need be measured.
        if np.isfinite(self._value(context, "limb_points")).all():
            support = self._value(context, "last_support")
            for name in np.array(FEATURES)[support == 0]:
                yield f"{name.replace('_', ' ')} not seen; held where it was last"
        if np.mean(list(ious.values()) or [0.0]) < _LEAST_IOU:
            yield (
                f"the body and the silhouettes hardly agree (mean IoU below {_LEAST_IOU}); the "
                "paper's stages do not notice when they have lost the person, until the registered "
                "pose is shown again"
            )


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
