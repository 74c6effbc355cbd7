"""A walk through the garden with live cameras: the person before them is the avatar."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from drake_pose.body.model import load_model
from drake_pose.errors import SettingsError
from drake_pose.jobs.estimate.capture import bundled_person
from drake_pose.jobs.live.frame_results import camera_troubles
from drake_pose.jobs.live.run import run_live
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.jobs.live.shape import shape_of_result
from drake_pose.jobs.live.walk import CommandLog, stride_positions
from drake_pose.person.date.walk_commands import WalkSettings
from drake_pose.person.shape import tracker_of_person
from drake_pose.systems.person.live_capture import LiveSensors, add_person_tracker
from drake_pose.systems.walk.walk import build_walk

SETTLE = 1.0
"""Whoever comes before the cameras commands after standing still for this long [s]."""


def walk_live(
    scene: LiveScene,
    meshcat: Meshcat,
    model_path: Path | None = None,
    shape: Path | None = None,
    seconds: float | None = None,
    open_sensors: Callable[[], LiveSensors] | None = None,
    on_command: Callable[[str], None] = lambda _: None,
    on_report: Callable[[str], None] = lambda _: None,
    packages: Mapping[str, Path] | None = None,
    settings: WalkSettings | None = None,
) -> dict[str, Any]:
    """Lets the avatar walk as the person before the cameras commands, until Ctrl-C.

    Recorded sources are played as if they were live.

    Args:
        scene: the cameras and where their pictures come from.
        meshcat: the page.
        model_path: a person with landmarks.yaml beside it; the bundled one where not given.
        shape: a result of capture with the same person, whose lengths and girths are taken; the
            model's where not given.
        seconds: how long; without end, or until the recordings end, where not given.
        open_sensors: opens the sensors; those of the scene in this process where not given.
        on_command: called when the command changes, with its words, "" for none.
        on_report: told of cameras that stop and return, bad pictures, a person found or lost.
        packages: folders of packages that the model's ``package://`` names mean, by name.
        settings: what is a command.

    Returns:
        As walk in drake_pose.jobs.live.walk; found_share of the periods in which the person was
        known; and warnings.

    Raises:
        SceneError, ModelError, SettingsError: what was given cannot be walked with.
        OutputError: the shape's result is none.
    """
    if seconds is not None and not 0.0 < seconds < math.inf:
        raise SettingsError(f"the walk's length must be a positive number, not {seconds} s")
    model = load_model(model_path or bundled_person(), package_paths=packages)
    known = None if shape is None else shape_of_result(shape)
    tracker = tracker_of_person(model.pose_tree(), known)
    opened: LiveSensors = scene.open_sensors(live=True) if open_sensors is None else open_sensors()
    try:

        def add(builder: DiagramBuilder) -> OutputPort:
            seen, time = opened.add(builder)
            system = add_person_tracker(builder, tracker, scene.cameras, seen, opened.period, time)
            return system.GetOutputPort("estimated_positions")

        stride = stride_positions(model)
        diagram = build_walk(model, meshcat, add, stride, opened.period, settings, SETTLE)
        walked = _Walked(diagram, on_command, on_report)
        run_live(diagram, opened, seconds, on_report, monitor=walked.watch, is_shown=True)
        warnings = camera_troubles(opened.counts(), 0)
    finally:
        opened.close()
    return {**walked.as_json(), "warnings": warnings}


class _Walked:
    """What is noted of a walk, period by period."""

    def __init__(
        self,
        diagram: Diagram,
        on_command: Callable[[str], None],
        on_report: Callable[[str], None],
    ) -> None:
        self._command = diagram.GetOutputPort("command")
        self._pose = diagram.GetOutputPort("walker_pose")
        self._person = diagram.GetSubsystemByName("person_tracker")
        self._positions = self._person.GetOutputPort("estimated_positions")
        self._log = CommandLog(on_command)
        self._presence = _Presence(on_report)
        self._last = [0.0, *self._pose.Eval(diagram.CreateDefaultContext())]

    def watch(self, context: Context) -> None:
        """Notes a period."""
        self._log.add(context.get_time(), self._command.Eval(context))
        found = self._positions.Eval(self._person.GetMyContextFromRoot(context))
        self._presence.add(math.isfinite(found[0]))
        self._last = [context.get_time(), *self._pose.Eval(context)]

    def as_json(self) -> dict[str, Any]:
        """How long the walk was, where it ended, and what was commanded."""
        time, x, y, heading = (float(value) for value in self._last)
        return {
            "seconds": time,
            "x": x,
            "y": y,
            "heading_deg": math.degrees(heading),
            "commands": self._log.seconds,
            "found_share": self._presence.share,
        }


class _Presence:
    """Whether a person is known, period by period."""

    def __init__(self, on_report: Callable[[str], None]) -> None:
        self._on_report = on_report
        self._count, self._found, self._known = 0, 0, False

    @property
    def share(self) -> float:
        """In which share of the periods the person was known."""
        return self._found / max(self._count, 1)

    def add(self, known: bool) -> None:
        """Takes whether the person is known in a period."""
        self._count += 1
        self._found += known
        if known != self._known:
            self._on_report("the person is found" if known else "the person is lost")
            self._known = known
