"""A walk through a garden in the browser: sources of the avatar's motion, and the simulation."""

import math
import time
from collections.abc import Callable, Mapping
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.trajectories import PiecewisePolynomial, Trajectory

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.errors import OutputError, SettingsError, require_positive
from drake_pose.files.folder import read_summary
from drake_pose.files.records import PoseTable
from drake_pose.files.replay import open_meshcat
from drake_pose.jobs.estimate.inputs import bundled_person
from drake_pose.jobs.live.capture import capture_warnings, shape_of_result
from drake_pose.jobs.live.scene import LiveScene, run_live
from drake_pose.jobs.live.settings import LiveSettings
from drake_pose.person.date.skeleton import load_skeleton
from drake_pose.person.date.walking import COMMANDS, make_motion
from drake_pose.person.pose_tracker import tracker_of_person
from drake_pose.systems.person import add_person_tracker
from drake_pose.systems.picture_capture import PictureCapture
from drake_pose.systems.ports import evaluate
from drake_pose.systems.walk import KEYS, AddPositions, build_walk

# Interval at which browser and button are polled [s].
_POLL_PAUSE = 0.05

RATE_HZ = 30.0
"""Frame rate [Hz] of recordings without one."""


@dataclass(frozen=True, eq=False)
class Player:
    """Source of the avatar's motion: recorded positions, cameras, or the arrow keys if neither.

    Args:
        model: model of the avatar; default: the bundled person.
        q: (n, nq) recorded positions [rad or m], nan where the person was not found; None: no
            recording.
        period: time between two positions, or sampling period of keys or cameras [s].
        sensors: sensor system of the cameras; None: no cameras.
        add: adds the sensors and a tracker of the person to a diagram builder; None: no cameras.
    """

    model: ArticulatedModel = field(
        default_factory=lambda: load_model(bundled_model("person"), check=False)
    )
    q: Array | None = None
    period: float = 1.0 / RATE_HZ
    sensors: PictureCapture | None = None
    add: AddPositions | None = None


def recorded_player(
    result: Path,
    model_path: Path | None,
    rate_hz: float | None,
    packages: Mapping[str, Path] | None = None,
) -> Player:
    """Return a player of the poses of a result folder, as `drake-pose capture` writes it.

    Args:
        result: the result folder.
        model_path: model of the capture; None: the bundled model named in its summary.
        rate_hz: frame rate [Hz]; None: that of its summary.
        packages: folders of the packages in the model's ``package://`` addresses, by name.

    Raises OutputError: the result does not exist, or belongs to another model; SettingsError: the
    rate is not positive.
    """
    summary = read_summary(result)
    rate_hz = float(summary.get("frame_rate_hz") or RATE_HZ) if rate_hz is None else rate_hz
    require_positive(rate_hz=rate_hz)
    if model_path is None:
        name = str(summary.get("model", ""))
        model_path = bundled_model("person").with_name(Path(name).name)
        if not model_path.is_file():
            raise OutputError(f"{result}: its model '{name}' is not a bundled one; give --model")
    model = load_model(model_path, package_paths=packages)
    rows = PoseTable(result, model.position_names, with_base=False).read()
    if not any(row.found for row in rows):
        raise OutputError(f"{result}: no person was found in any frame, so the avatar cannot walk")
    return Player(model, np.array([row.q for row in rows]), 1.0 / rate_hz)


def simulated_player() -> Player:
    """Return a player of the simulated motion in the experiment of Date et al."""
    model = load_model(bundled_model("person"), check=False)
    return Player(model, make_motion(load_skeleton(model), 1200, seed=0).q)


def live_player(
    scene: LiveScene,
    model_path: Path | None = None,
    settings: LiveSettings | None = None,
    open_sensors: Callable[[], PictureCapture] | None = None,
) -> Player:
    """Return a player that follows the person before the cameras; recordings play as if live.

    Args:
        scene: cameras, sources and backgrounds.
        model_path: model of a person with landmarks.yaml beside it; None: the bundled person.
        settings: shape and packages; None: the model's shape.
        open_sensors: opens the sensor system; None: the scene's, in this process.

    Raises SceneError, ModelError, SettingsError: the inputs do not allow a walk; OutputError: the
    result of the shape does not exist or has none.
    """
    settings = settings or LiveSettings()
    model = load_model(model_path or bundled_person(), package_paths=settings.packages)
    known = None if settings.shape is None else shape_of_result(settings.shape)
    tracker = tracker_of_person(model.pose_tree(), known)
    sensors = scene.open_sensors(live=True) if open_sensors is None else open_sensors()

    def add(builder: DiagramBuilder) -> OutputPort:
        """Add sensors and tracker; return the port of the person's positions (nq,)."""
        person, _ = add_person_tracker(
            builder, tracker, scene.cameras, scene.backgrounds, sensors.period, source=sensors
        )
        return person.GetOutputPort("estimated_positions")

    return Player(model, None, sensors.period, sensors, add)


def stride_positions(model: ArticulatedModel) -> Array:
    """Return positions (n, nq) of one stride on the spot, at RATE_HZ; unknown joints rest."""
    person = load_model(bundled_model("person"), check=False)
    motion = make_motion(load_skeleton(person), 5 * int(RATE_HZ), 0)
    walking = motion.q[[name == "walk" for name in motion.names]]
    walking[:, [person.position_index(f"position_{axis}") for axis in "xy"]] = 0.0
    stride = np.tile(model.default_positions, (len(walking), 1))
    for index, name in enumerate(person.position_names):
        if name in model.position_names:
            stride[:, model.position_index(name)] = walking[:, index]
    return stride


def walk(
    player: Player,
    meshcat: Meshcat,
    seconds: float | None = None,
    speed: float = 1.0,
    on_command: Callable[[str], None] = lambda _: None,
    again: Callable[[], bool] = lambda: False,
    on_spot: bool = False,
    on_report: Callable[[str], None] = lambda _: None,
    settle: float = 1.0,
) -> dict[str, Any]:
    """Simulate the walk until the recording or the given time ends, or Ctrl-C.

    Args:
        player: source of the motion; its sensors are closed at the end.
        meshcat: the page.
        seconds: duration [s]; None: the length of the recording, or unlimited.
        speed: simulated time per real time; 0: as fast as possible; always 1 with cameras.
        on_command: called with the words of the command whenever it changes, "" for none.
        again: called at the end of a walk without cameras; True starts it again.
        on_spot: whether standing ahead or behind is a command only while the person also walks on
            the spot, as in the paper.
        on_report: called with messages about cameras, pictures, and a person found or lost.
        settle: time for which a person must stand still before commands count [s].

    Returns:
        Of the last walk: ``seconds``; the final ``x``, ``y`` [m] and ``heading_deg``; ``commands``,
        the time [s] of each command. With cameras also ``found_share``, the fraction of periods in
        which the person was found, and ``warnings``.

    Raises SettingsError: time or speed is out of range.
    """
    require_positive(seconds=seconds)
    if not (math.isfinite(speed) and speed >= 0):
        raise SettingsError(f"the speed must be 0 or a positive number, not {speed}")
    period, sensors = player.period, player.sensors
    positions: Trajectory | AddPositions | None = player.add
    if player.q is not None:
        times = period * np.arange(len(player.q) + 1)
        q = player.q[[*range(len(player.q)), -1]]
        positions = PiecewisePolynomial.ZeroOrderHold(times, q.T)
        seconds = min(seconds or times[-1], times[-1])
    settle, speed = (0.0, speed) if sensors is None else (settle, 1.0)
    stride = stride_positions(player.model)
    with nullcontext() if sensors is None else closing(sensors):
        diagram = build_walk(player.model, meshcat, positions, stride, period, on_spot, settle)
        while True:
            log = _WalkLog(diagram, on_command, on_report)
            interrupted = run_live(
                diagram, sensors, seconds, on_report, monitor=log.watch, speed=speed
            )
            if sensors is not None:
                return log.as_json() | {"warnings": capture_warnings(sensors.counts(), 0)}
            if interrupted or not again():
                return log.as_json()
            # Adding the buttons again resets their clicks.
            for name, key in KEYS.items():
                meshcat.AddButton(name, key)


class _WalkLog:
    """Logs each command's duration and the final pose of a build_walk diagram, as in `walk`."""

    def __init__(
        self, diagram: Diagram, on_command: Callable[[str], None], on_report: Callable[[str], None]
    ) -> None:
        self._command, self._pose = map(diagram.GetOutputPort, ("command", "walker_pose"))
        self._seconds = dict.fromkeys(COMMANDS, 0.0)
        self._on_command, self._on_report = on_command, on_report
        self._person: OutputPort | None = None
        if diagram.HasSubsystemNamed("person_tracker"):
            tracker = diagram.GetSubsystemByName("person_tracker")
            self._person = tracker.GetOutputPort("estimated_positions")
        self._words: tuple[str, ...] = ()
        self._time, self._last = 0.0, self._pose.Eval(diagram.CreateDefaultContext())
        # Whether the person was found in each period.
        self._known = [False]

    def watch(self, context: Context) -> None:
        """Log the command, and whether the person is found, at the time of a context."""
        elapsed, self._time = context.get_time() - self._time, context.get_time()
        for word in self._words:
            self._seconds[word] += elapsed
        turn, ahead = self._command.Eval(context)
        holds = (turn > 0, turn < 0, ahead > 0, ahead < 0)
        words = tuple(word for word, now in zip(COMMANDS, holds, strict=True) if now)
        if words != self._words:
            self._on_command(" and ".join(words))
        self._words, self._last = words, self._pose.Eval(context)
        if self._person is not None:
            self._known.append(math.isfinite(evaluate(self._person, context)[0]))
            if self._known[-1] != self._known[-2]:
                self._on_report(f"the person is {'found' if self._known[-1] else 'lost'}")

    def as_json(self) -> dict[str, Any]:
        """Return the entries of the result of `walk`, without warnings."""
        x, y, heading = (float(value) for value in self._last)
        place = {"x": x, "y": y, "heading_deg": math.degrees(heading)}
        fraction = sum(self._known) / max(len(self._known) - 1, 1)
        found = {} if self._person is None else {"found_share": fraction}
        return {"seconds": self._time, **place, "commands": self._seconds, **found}


def open_page(port: int | None = None) -> Meshcat:
    """Return a Meshcat server, see `open_meshcat`, at ``port``; None: any free one.

    Raises SettingsError: the port cannot be used.
    """
    try:
        return open_meshcat(port=port, show_stats_plot=False)
    except RuntimeError as error:
        where = "any port" if port is None else f"port {port}"
        raise SettingsError(f"no page can be opened at {where}: {error}") from error


def wait_for_browser(page: Meshcat, patience: float = math.inf) -> bool:
    """Wait until a browser shows a page, at most ``patience`` [s]; return whether one does."""
    end = time.monotonic() + patience
    while page.GetNumActiveConnections() == 0 and time.monotonic() < end:
        time.sleep(_POLL_PAUSE)
    return page.GetNumActiveConnections() > 0


def wait_for_replay(page: Meshcat) -> bool:
    """Wait for a click on the page's button to play again; return False for Ctrl-C."""
    name = "play again"
    page.AddButton(name, "Space")
    try:
        while page.GetButtonClicks(name) == 0:
            time.sleep(_POLL_PAUSE)
    except KeyboardInterrupt:
        return False
    finally:
        page.DeleteButton(name)
    return True
