"""Capture by the stages of Date et al., as pictures come: skin, rays, inverse kinematics, search.

The registered pose, upright with both arms spread, begins it and sets it right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Context, Diagram

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.errors import SettingsError
from drake_pose.jobs.estimate.scene_checks import frame_ranges
from drake_pose.jobs.live.capture import LiveSettings
from drake_pose.jobs.live.frame_results import LiveResult, LiveWriter
from drake_pose.jobs.live.registered_pose import RegisteredPoseSearch
from drake_pose.jobs.live.run import FrameWatch, LiveFrame, run_live
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.person.date.capture import CaptureSetup
from drake_pose.person.date.faces import learn_recorded_faces
from drake_pose.person.date.skeleton import FEATURES
from drake_pose.person.shape import tracker_of_person
from drake_pose.results.folder import require_empty
from drake_pose.results.summary import FrameRecord
from drake_pose.systems.date.capture import build_paper_capture
from drake_pose.systems.person.live_capture import LocalSensors

METHOD = "paper_capture"
"""What summary.json calls it."""

# A choice: of simulated persons who are followed the mean IoU is about 0.8 and more.
_LEAST_IOU = 0.6


@dataclass(frozen=True)
class FaceFolder:
    """What the face's direction is found with.

    Args:
        camera: the camera before the face.
        templates: a folder as of learn_recorded_faces.
    """

    camera: str
    templates: Path


def capture_paper(
    scene: LiveScene,
    out: Path,
    model_path: Path | None = None,
    settings: LiveSettings | None = None,
    face: FaceFolder | None = None,
    open_sensors: Callable[[], LocalSensors] | None = None,
    on_report: Callable[[str], None] = lambda _: None,
    on_frame: Callable[[int, bool], None] = lambda _, __: None,
) -> LiveResult:
    """Captures a person the paper's way, and writes the result's folder.

    Recorded pictures are read twice: for the registered pose, and then to follow the person. Ctrl-C
    ends the capture, and keeps everything.

    Args:
        scene: the cameras and where their colour pictures come from.
        out: the result's folder, empty or not there.
        model_path: a person of the same build as the bundled one, which is taken where not given;
            its measures are taken as they are.
        settings: how; no shape can be given or fitted.
        face: how the face's direction is found; None: by inverse kinematics alone.
        open_sensors: opens the sensors; where not given the scene's. Called twice.
        on_report: hears at once of cameras that stop and return, and of bad pictures.
        on_frame: hears of each frame: how many there are, and whether a person was found.

    Raises:
        SceneError, CameraError, ModelError, SettingsError, UnknownNameError: what was given cannot
            be captured so, or nobody showed the registered pose.
        OutputError: the result cannot be written.
    """
    settings, opener = settings or LiveSettings(), open_sensors or scene.open_sensors
    if settings.shape is not None:
        raise SettingsError("the paper's method takes the model's measures: give no shape")
    model = load_model(model_path or bundled_model("person"), package_paths=settings.packages)
    require_empty(out)
    templates = None if face is None else learn_recorded_faces(face.templates)
    search = RegisteredPoseSearch(scene, model, None if face is None else face.camera, templates)
    sensors = opener()
    try:
        setup = search.run(sensors, on_report)
    finally:
        sensors.close()
    sensors = opener()
    try:
        tracker = tracker_of_person(model.pose_tree(), None)
        period, packages = sensors.period, settings.packages
        result = LiveWriter(scene, model, tracker, out, period, packages, on_report, on_frame)
        result.open(METHOD)
        try:
            interrupted = _follow(setup, sensors, result, settings.seconds)
            result.finish(sensors, settings.replay)
        finally:
            result.writer.close()
    finally:
        sensors.close()
    return result.result(interrupted)


def _follow(
    setup: CaptureSetup,
    sensors: LocalSensors,
    result: LiveWriter,
    seconds: float | None,
) -> bool:
    """Follows the person and writes all frames; whether Ctrl-C ended it."""
    diagram = build_paper_capture(setup, sensors.capture, sensors.period).diagram
    doubts = _Doubts(diagram)

    def note(frame: LiveFrame) -> None:
        result.add(frame)
        doubts.add(*next(reversed(result.writer.records.items())))

    frames = FrameWatch(diagram, setup.cameras, note, "person_view")

    def watch(context: Context) -> None:
        doubts.look(context)
        frames(context)

    interrupted = run_live(diagram, sensors, seconds, result.tell, monitor=watch)
    result.writer.warn(doubts.texts())
    return interrupted


class _Doubts:
    """Frames whose pose the paper's method gives, but that one should not trust."""

    def __init__(self, diagram: Diagram) -> None:
        self._support, self._limbs = (
            diagram.GetOutputPort(name) for name in ("last_support", "limb_points")
        )
        self._unmeasured: Sequence[str] = ()
        self._frames: list[str] = []
        self._nobody: list[str] = []
        self._differs: list[str] = []
        self._held: dict[str, list[str]] = {name: [] for name in FEATURES}

    def look(self, context: Context) -> None:
        """Notes which features were not measured; where a pose was recognised none need be."""
        support = self._support.Eval(context)
        is_followed = np.isfinite(self._limbs.Eval(context)).all()
        pairs = zip(FEATURES, support, strict=True)
        self._unmeasured = [name for name, count in pairs if is_followed and not count]

    def add(self, frame: str, record: FrameRecord) -> None:
        """Takes the frame that was looked at."""
        self._frames.append(frame)
        if not record.found:
            self._nobody.append(frame)
            return
        for name in self._unmeasured:
            self._held[name].append(frame)
        if np.mean(list(record.ious.values()) or [0.0]) < _LEAST_IOU:
            self._differs.append(frame)

    def texts(self) -> list[str]:
        """What the user should know."""
        texts = []
        if self._nobody:
            texts.append(f"{self._listed(self._nobody)}: before the registered pose; no pose")
        for name, frames in self._held.items():
            if frames:
                what = name.replace("_", " ")
                texts.append(f"{self._listed(frames)}: {what} not seen; held where it was last")
        if self._differs:
            texts.append(
                f"{self._listed(self._differs)}: the body and the silhouettes hardly agree (mean "
                f"IoU below {_LEAST_IOU}); the paper's method does not notice when it has lost the "
                "person, until the registered pose is shown again"
            )
        return texts

    def _listed(self, frames: list[str]) -> str:
        return f"frame {frame_ranges(frames, self._frames)}"
