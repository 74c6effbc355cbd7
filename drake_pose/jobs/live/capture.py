"""Capture frame by frame, as the pictures come from live cameras, videos or folders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from drake_pose.body.model import load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import OutputError, SettingsError
from drake_pose.files.folder import read_summary, require_empty
from drake_pose.jobs.estimate.inputs import bundled_person
from drake_pose.jobs.live.frame_results import LiveResult, LiveWriter
from drake_pose.jobs.live.run import FrameWatch, Mask, look_until, run_live
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.jobs.live.settings import LiveSettings
from drake_pose.person.recordings.person_capture import capture_person
from drake_pose.person.recordings.persons_in_view import PersonRecording
from drake_pose.person.shape import KnownShape, shape_values, tracker_of_person
from drake_pose.person.views import shows_somebody
from drake_pose.systems.person.live_capture import LiveSensors, build_live_capture
from drake_pose.systems.ports import evaluate

# How many frames give a person's shape.
_FRAMES = 40


def capture_live(
    scene: LiveScene,
    out: Path,
    model_path: Path | None = None,
    settings: LiveSettings | None = None,
    open_sensors: Callable[[], LiveSensors] | None = None,
    on_report: Callable[[str], None] = lambda _: None,
    on_frame: Callable[[int, bool], None] = lambda _, __: None,
) -> LiveResult:
    """Captures a person as the pictures come, and writes the result's folder.

    Ctrl-C ends the capture, and keeps everything.

    Args:
        out: the result's folder, empty or not there.
        model_path: a person with landmarks.yaml beside it; the bundled one with shape joints where
            not given.
        open_sensors: opens the sensors; where not given the scene's, in this process. Called once
            more for the frames that give the person's shape.
        on_report: called at once when cameras stop and return, and with bad pictures.
        on_frame: called with each frame: how many there are, and whether a person was found.

    Raises:
        SceneError, ModelError, SettingsError: what was given cannot be captured.
        OutputError: the result cannot be written.
    """
    settings, opener = settings or LiveSettings(), open_sensors or scene.open_sensors
    model = load_model(model_path or bundled_person(), package_paths=settings.packages)
    # A folder that cannot be written is refused before a camera is opened.
    require_empty(out)
    shape = None
    if settings.shape is not None:
        shape = shape_of_result(settings.shape)
    elif settings.fit_shape:
        shape = _fit_first_frames(scene, opener(), model.pose_tree(), on_report)
    tracker = tracker_of_person(model.pose_tree(), shape)
    sensors = opener()
    try:
        writer = LiveWriter(
            scene, model, tracker, out, sensors.period, settings.packages, on_report, on_frame
        )
        if shape is not None:
            writer.writer.more |= {"lengths_m": shape.lengths, "girths": shape.girths}
        diagram = build_live_capture(tracker, scene.cameras, sensors, with_deviations=True)
        watch = FrameWatch(diagram, scene.cameras, writer.add)
        return record_frames("person", diagram, sensors, watch, writer, settings)
    finally:
        sensors.close()


def record_frames(
    method: str,
    diagram: Diagram,
    sensors: LiveSensors,
    watch: FrameWatch,
    result: LiveWriter,
    settings: LiveSettings,
) -> LiveResult:
    """Runs the diagram of a capture, ``method`` in summary.json, and writes what comes out."""
    result.writer.more["method"] = method
    result.writer.begin()
    try:
        interrupted = run_live(diagram, sensors, settings.seconds, result.tell, monitor=watch)
        result.writer.warnings += watch.doubts()
        result.finish(sensors, settings.replay)
    finally:
        result.writer.write_summary()
    return result.result(interrupted)


def shape_of_result(result: Path) -> KnownShape:
    """The lengths and girths that an earlier capture found.

    Raises:
        OutputError: there is no such result, or it has none.
    """
    summary = read_summary(result)
    found = []
    for name in ("lengths_m", "girths"):
        numbers = summary.get(name)
        if not isinstance(numbers, dict) or not all(
            isinstance(number, int | float) for number in numbers.values()
        ):
            raise OutputError(f"{result}: its summary has no {name}; name a result of capture")
        found.append(numbers)
    return KnownShape(*found)


def _fit_first_frames(
    scene: LiveScene,
    sensors: LiveSensors,
    tree: PoseTree,
    on_report: Callable[[str], None],
) -> KnownShape | None:
    """Lengths and girths by the first frames that two cameras see; None without shape joints."""
    if not shape_values(tree).any():
        sensors.close()
        return None
    frames: list[dict[str, Mask]] = []
    builder = DiagramBuilder()
    ports, time, last = sensors.add(builder), sensors.GetOutputPort("time"), np.nan

    def look(context: Context) -> bool:
        nonlocal last
        before, last = last, float(evaluate(time, context)[0])
        if last != before and not np.isnan(last):
            views = {name: evaluate(port, context) for name, port in ports.items()}
            seen = {name: view.region for name, view in views.items() if shows_somebody(view)}
            if len(seen) >= 2:
                frames.append(seen)
        return len(frames) >= _FRAMES

    look_until(builder.Build(), sensors, look, on_report)
    # Whoever else is in view is cut out.
    alone = PersonRecording(scene.cameras, lambda k: frames[k], len(frames), True)
    seen = alone.seen
    if not seen:
        raise SettingsError(
            f"{scene.path}: two cameras never saw a person at the same time: stand before them, "
            "and compare the pictures with their backgrounds"
        )
    found = capture_person(tree, scene.cameras, alone.read, seen)
    return None if found.shape is None else found.shape.known
