"""Capture frame by frame, as the pictures come from live cameras, videos or folders."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.errors import SettingsError
from drake_pose.jobs.estimate.capture import bundled_person
from drake_pose.jobs.live.frame_results import LiveResult, LiveWriter
from drake_pose.jobs.live.run import FrameWatch, run_live
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.jobs.live.shape import fit_first_frames, shape_of_result
from drake_pose.person.shape import KnownShape, tracker_of_person
from drake_pose.results.folder import require_empty
from drake_pose.systems.person.live_capture import LiveSensors, build_live_capture

OpenSensors = Callable[[], LiveSensors]


@dataclass(frozen=True)
class LiveSettings:
    """How a live capture is made.

    Args:
        seconds: how long; None: until the recordings end, or Ctrl-C.
        shape: a result of capture with the same person, whose lengths and girths are taken.
        fit_shape: whether otherwise the first frames give them; else they are the model's.
        replay: whether replay.html is written.
        packages: folders of packages that the model's ``package://`` names mean, by name.

    Raises:
        SettingsError: a time that cannot be.
    """

    seconds: float | None = None
    shape: Path | None = None
    fit_shape: bool = True
    replay: bool = True
    packages: Mapping[str, Path] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.seconds is not None and not 0.0 < self.seconds < np.inf:
            raise SettingsError(f"the capture's length must be positive, not {self.seconds} s")


def capture_live(
    scene: LiveScene,
    out: Path,
    model_path: Path | None = None,
    settings: LiveSettings | None = None,
    open_sensors: OpenSensors | None = None,
    on_report: Callable[[str], None] = lambda _: None,
    on_frame: Callable[[int, bool], None] = lambda _, __: None,
) -> LiveResult:
    """Captures a person as the pictures come, and writes the result's folder.

    Ctrl-C ends the capture, and keeps everything.

    Args:
        scene: the cameras and where their pictures come from.
        out: the result's folder, empty or not there.
        model_path: a person with landmarks.yaml beside it; the bundled one with shape joints where
            not given.
        settings: how.
        open_sensors: opens the sensors; where not given the scene's, in this process. Called once
            more for the frames that give the person's shape.
        on_report: hears at once of cameras that stop and return, and of bad pictures.
        on_frame: hears of each frame: how many there are, and whether a person was found.

    Raises:
        SceneError, ModelError, SettingsError: what was given cannot be captured.
        OutputError: the result cannot be written.
    """
    settings, opener = settings or LiveSettings(), open_sensors or (lambda: scene.open_sensors())
    model = load_model(model_path or bundled_person(), package_paths=settings.packages)
    # A folder that cannot be written is refused before a camera is opened.
    require_empty(out)
    shape = _shape(scene, model, settings, opener, on_report)
    tracker = tracker_of_person(model.pose_tree(), shape)
    sensors = opener()
    try:
        diagram = build_live_capture(tracker, scene.cameras, sensors, with_deviations=True)
        period, packages = sensors.period, settings.packages
        result = LiveWriter(scene, model, tracker, out, period, packages, on_report, on_frame)
        result.open("person", shape)
        try:
            watch = FrameWatch(diagram, scene.cameras, result.add)
            interrupted = run_live(diagram, sensors, settings.seconds, result.tell, monitor=watch)
            result.finish(sensors, settings.replay)
        finally:
            result.writer.close()
    finally:
        sensors.close()
    return result.result(interrupted)


def _shape(
    scene: LiveScene,
    model: ArticulatedModel,
    settings: LiveSettings,
    open_sensors: OpenSensors,
    on_report: Callable[[str], None],
) -> KnownShape | None:
    """The person's lengths and girths; None: the model's."""
    if settings.shape is not None:
        return shape_of_result(settings.shape)
    if not settings.fit_shape:
        return None
    sensors = open_sensors()
    try:
        # What is wrong with recorded pictures is said when they are captured.
        report = on_report if sensors.live else lambda _: None
        return fit_first_frames(scene, sensors, model.pose_tree(), report)
    finally:
        sensors.close()
