"""The lengths and girths of a person who is captured live."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pydrake.systems.framework import Context, DiagramBuilder

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import OutputError, SettingsError
from drake_pose.jobs.live.run import Mask, run_live
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.person.recordings.person_capture import capture_person
from drake_pose.person.recordings.persons_in_view import PersonRecording
from drake_pose.person.shape import KnownShape, shape_values
from drake_pose.person.views import shows_somebody
from drake_pose.results.folder import read_summary
from drake_pose.systems.person.live_capture import LiveSensors

_FRAMES = 40
# How long it is waited for a person to come into view [s].
_PATIENCE = 60.0


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


def fit_first_frames(
    scene: LiveScene,
    sensors: LiveSensors,
    tree: PoseTree,
    on_report: Callable[[str], None],
    count: int = _FRAMES,
) -> KnownShape | None:
    """A person's lengths and girths by the first frames in which two cameras see the person.

    Args:
        scene: the cameras.
        sensors: are used up.
        tree: of a model with the landmarks of a person.
        on_report: hears of cameras that stop, and of bad pictures.
        count: by how many frames at most.

    Returns:
        None where the model has no shape joints.

    Raises:
        SettingsError: two cameras never saw a person.
    """
    if not shape_values(tree).any():
        return None
    frames: list[dict[str, Mask]] = []
    builder = DiagramBuilder()
    ports = sensors.add(builder)
    for name, port in ports.silhouettes.items():
        builder.ExportOutput(port, name)
    builder.ExportOutput(ports.time, "time")
    diagram = builder.Build()
    times: list[float] = []

    def look(context: Context) -> None:
        time = float(diagram.GetOutputPort("time").Eval(context)[0])
        if time in times or time != time:
            return
        times[:] = [time]
        views = {name: diagram.GetOutputPort(name).Eval(context) for name in ports.silhouettes}
        seen = {name: view.region for name, view in views.items() if shows_somebody(view)}
        if len(seen) >= 2:
            frames.append(seen)

    waited = _PATIENCE if sensors.live else None
    if run_live(diagram, sensors, waited, on_report, lambda: len(frames) >= count, look):
        raise KeyboardInterrupt
    # Whoever else is in view is cut out.
    alone = PersonRecording(scene.cameras, lambda k: frames[k], len(frames), True)
    seen = alone.seen
    if not seen:
        raise SettingsError(
            f"{scene.path}: two cameras never saw a person at the same time: stand before them, "
            "and compare the pictures with their backgrounds"
        )
    found = capture_person(tree, scene.cameras, lambda k: alone.read(seen[k]), len(seen))
    return None if found.shape is None else found.shape.known
