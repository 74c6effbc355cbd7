"""Capture frame by frame, as the pictures come from live cameras, videos or folders."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder

from drake_pose.arrays import Mask
from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import OutputError, SettingsError
from drake_pose.files.folder import read_summary, require_empty
from drake_pose.jobs.estimate.inputs import bundled_person
from drake_pose.jobs.live.frame_results import PAPER, PERSON, LiveResult, LiveWriter
from drake_pose.jobs.live.paper_capture import find_registered_pose
from drake_pose.jobs.live.run import look_until
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.jobs.live.settings import LiveSettings
from drake_pose.person.recordings.person_capture import capture_person
from drake_pose.person.recordings.persons_in_view import PersonRecording
from drake_pose.person.shape import KnownShape, shape_values, tracker_of_person
from drake_pose.person.views import shows_somebody
from drake_pose.systems.date.capture import build_paper_capture
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
    by_stages: bool = False,
) -> LiveResult:
    """Captures a person as the pictures come, and writes the result's folder.

    Ctrl-C ends the capture, and keeps everything.

    Args:
        out: the result's folder, empty or not there.
        model_path: a person with landmarks.yaml beside it; the bundled one, with shape joints
            unless ``by_stages``, where not given.
        open_sensors: opens the sensors; where not given the scene's, in this process. Called once
            more for the frames that give the person's shape, or show the registered pose.
        on_report: called at once when cameras stop and return, and with bad pictures.
        on_frame: called with each frame: how many there are, and whether a person was found.
        by_stages: captures by the stages of Date et al.: skin, rays, inverse kinematics, search;
            see find_registered_pose.

    Raises:
        SceneError, CameraError, ModelError, SettingsError, UnknownNameError: what was given cannot
            be captured so.
        OutputError: the result cannot be written.
    """
    settings, opener = settings or LiveSettings(), open_sensors or scene.open_sensors
    usual = bundled_model("person") if by_stages else bundled_person()
    model = load_model(model_path or usual, package_paths=settings.packages)
    # A folder that cannot be written is refused before a camera is opened.
    require_empty(out)
    setup = shape = None
    if by_stages:
        setup = find_registered_pose(scene, model, settings, opener, on_report)
    elif settings.shape is not None:
        shape = shape_of_result(settings.shape)
    elif settings.fit_shape:
        shape = _fit_first_frames(scene, opener(), model.pose_tree(), on_report)
    tracker = tracker_of_person(model.pose_tree(), shape)
    found = {} if shape is None else {"lengths_m": shape.lengths, "girths": shape.girths}
    more = {"method": PAPER if by_stages else PERSON, **found}
    with closing(opener()) as sensors:
        if setup is None:
            kind, cameras = "silhouette", scene.cameras
            diagram = build_live_capture(tracker, cameras, sensors, with_deviations=True)
        else:
            kind, cameras = "person_view", setup.cameras
            diagram = build_paper_capture(setup, sensors, sensors.period).diagram
        views = {name: diagram.GetOutputPort(f"{kind}_{name}") for name in cameras}
        result = LiveWriter(
            scene, model, tracker, diagram, views, out, sensors.period, more, settings, on_report,
            on_frame,
        )  # fmt: skip
        return result.run(sensors)


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
