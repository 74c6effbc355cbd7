"""Capture by the stages of Date et al., as pictures come: skin, rays, inverse kinematics, search.

The registered pose, upright with both arms spread, begins it and sets it right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Context, Diagram

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.errors import SettingsError
from drake_pose.jobs.estimate.scene_checks import frame_ranges
from drake_pose.jobs.live.capture import LiveSettings, record_frames
from drake_pose.jobs.live.frame_results import LiveResult, LiveWriter
from drake_pose.jobs.live.registered_pose import RegisteredPoseSearch
from drake_pose.jobs.live.run import FrameWatch, LiveFrame
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.person.date.faces import learn_recorded_faces
from drake_pose.person.date.skeleton import FEATURES
from drake_pose.person.shape import tracker_of_person
from drake_pose.results.folder import require_empty
from drake_pose.systems.date.capture import build_paper_capture
from drake_pose.systems.person.live_capture import LocalSensors

METHOD = "paper_capture"
"""What summary.json calls it."""

# A choice: of simulated persons who are followed the mean IoU is about 0.8 and more.
_LEAST_IOU = 0.6


@dataclass(frozen=True)
class FaceFolder:
    """The camera before the face, and a folder of templates as of learn_recorded_faces."""

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
        out: the result's folder, empty or not there.
        model_path: a person of the same build as the bundled one, which is taken where not given;
            its measures are taken as they are.
        settings: no shape can be given or fitted.
        face: how the face's direction is found; None: by inverse kinematics alone.
        open_sensors: opens the sensors; where not given the scene's. Called twice.
        on_report: called at once when cameras stop and return, and with bad pictures.
        on_frame: called with each frame: how many there are, and whether a person was found.

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
    setup = search.run(opener(), on_report)
    sensors = opener()
    try:
        tracker = tracker_of_person(model.pose_tree(), None)
        writer = LiveWriter(
            scene, model, tracker, out, sensors.period, settings.packages, on_report, on_frame
        )
        diagram = build_paper_capture(setup, sensors.capture, sensors.period).diagram
        watch = _PaperWatch(diagram, setup.cameras, writer)
        return record_frames(METHOD, diagram, sensors, watch, writer, settings)
    finally:
        sensors.close()


class _PaperWatch(FrameWatch):
    """Also notes frames whose pose the paper's method gives, but that one should not trust."""

    def __init__(self, diagram: Diagram, cameras: Iterable[str], result: LiveWriter) -> None:
        super().__init__(diagram, cameras, self._note, "person_view")
        self._result = result
        self._unmeasured: Sequence[str] = ()
        self._nobody: list[str] = []
        self._differs: list[str] = []
        self._held: dict[str, list[str]] = {name: [] for name in FEATURES}

    def __call__(self, context: Context) -> None:
        """Notes which features were not measured; where a pose was recognised none need be."""
        support = self._value(context, "last_support")
        is_followed = np.isfinite(self._value(context, "limb_points")).all()
        pairs = zip(FEATURES, support, strict=True)
        self._unmeasured = [name for name, count in pairs if is_followed and not count]
        super().__call__(context)

    def _note(self, frame: LiveFrame) -> None:
        self._result.add(frame)
        name, record = next(reversed(self._result.writer.records.items()))
        if not record.found:
            self._nobody.append(name)
            return
        for feature in self._unmeasured:
            self._held[feature].append(name)
        if np.mean(list(record.ious.values()) or [0.0]) < _LEAST_IOU:
            self._differs.append(name)

    def doubts(self) -> list[str]:
        """What the user should know."""
        said = {"before the registered pose; no pose": self._nobody}
        for name, frames in self._held.items():
            said[f"{name.replace('_', ' ')} not seen; held where it was last"] = frames
        said[
            f"the body and the silhouettes hardly agree (mean IoU below {_LEAST_IOU}); the paper's "
            "method does not notice when it has lost the person, until the registered pose is "
            "shown again"
        ] = self._differs
        known = list(self._result.writer.records)
        return [
            f"frame {frame_ranges(frames, known)}: {text}"
            for text, frames in said.items()
            if frames
        ]
