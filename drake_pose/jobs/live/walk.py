"""A walk through a garden in the browser: what moves the avatar, and the run."""

from __future__ import annotations

import math
import time
import webbrowser
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.csv_files import read_csv
from drake_pose.errors import OutputError, SettingsError
from drake_pose.files.folder import POSES, read_summary
from drake_pose.jobs.estimate.inputs import bundled_person
from drake_pose.jobs.live.capture import shape_of_result
from drake_pose.jobs.live.frame_results import camera_troubles
from drake_pose.jobs.live.run import run_live
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.jobs.live.settings import LiveSettings
from drake_pose.person.date.skeleton import load_skeleton
from drake_pose.person.date.walking_motion import make_motion
from drake_pose.person.shape import tracker_of_person
from drake_pose.systems.person.live_capture import LiveSensors, add_person_tracker
from drake_pose.systems.ports import evaluate
from drake_pose.systems.walk import KEYS, build_walk

Array = NDArray[np.float64]

RATE_HZ = 30.0
"""Frames a second where a recording does not say."""

REPLAY, _REPLAY_KEY = "play again", "Space"
"""The page's button at the end of a recording, and the key that presses it."""

COMMANDS = ("turn left", "turn right", "walk ahead", "walk behind")

SETTLE = 1.0
"""Whoever comes before the cameras commands after standing still for this long [s]."""

_SIMULATED_FRAMES = 1200
# Between two looks at browser and button [s].
_POLL_PAUSE = 0.05


@dataclass(frozen=True, eq=False)
class Player:
    """What moves the avatar.

    Args:
        q: (n, nq) positions [rad or m], nan where the person was not found; None: keys alone.
    """

    model: ArticulatedModel
    q: Array | None = None
    rate_hz: float = RATE_HZ


def recorded_player(
    result: Path,
    model_path: Path | None,
    rate_hz: float | None,
    packages: Mapping[str, Path] | None = None,
) -> Player:
    """Plays the poses of a result folder, as `drake-pose capture` writes it.

    Args:
        model_path: the model it was captured with; the bundled one of its summary where not given.
        rate_hz: its frames a second; those in its summary where not given.
        packages: folders of packages that the model's ``package://`` names mean, by name.

    Raises:
        OutputError: there is no such result, or it is one of another model.
        SettingsError: the rate is not positive.
    """
    if rate_hz is None:
        rate_hz = float(read_summary(result).get("frame_rate_hz") or RATE_HZ)
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise SettingsError(f"frames a second must be a positive number, not {rate_hz}")
    if model_path is None:
        name = str(read_summary(result).get("model", ""))
        model_path = bundled_model("person").with_name(Path(name).name)
        if not model_path.is_file():
            raise OutputError(f"{result}: its model '{name}' is not a bundled one; give --model")
    model = load_model(model_path, package_paths=packages)
    path = result / POSES
    header, rows = read_csv(path, OutputError)
    missing = [name for name in model.position_names if name not in header]
    if missing:
        raise OutputError(
            f"{path}: has no column '{missing[0]}', which {model.path.name} needs; give the model "
            "it was captured with"
        )
    columns = [header.index(name) for name in model.position_names]
    try:
        q = np.array([[float(row[k] or "nan") for k in columns] for _, row in rows])
        q = q.reshape(-1, len(columns))
    except ValueError:
        raise OutputError(f"{path}: is damaged: there is a cell that is no number") from None
    if not np.isfinite(q).all(axis=-1).any():
        raise OutputError(f"{path}: nobody was found in any frame, so nobody can walk")
    return Player(model, q, rate_hz)


def simulated_player() -> Player:
    """Plays the known motion of Date's experiment."""
    model = load_model(bundled_model("person"), check=False)
    return Player(model, make_motion(load_skeleton(model), _SIMULATED_FRAMES, seed=0).q)


def key_player() -> Player:
    """Leaves the walk to the keys."""
    return Player(load_model(bundled_model("person"), check=False))


def stride_positions(model: ArticulatedModel) -> Array:
    """(n, nq) one stride on the spot, standing at its end; joints of other names rest."""
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
) -> dict[str, Any]:
    """Lets the avatar walk until its recording, the given time, or the user (Ctrl-C) ends it.

    Args:
        seconds: how long; the recording's length where not given, without end for keys alone.
        speed: seconds walked a second; 0: as fast as the machine can.
        on_command: called when the command changes, with its words, "" for none.
        again: asked at the end whether to walk once more from the start.
        on_spot: as of Walker.

    Returns:
        Of the last walk: seconds walked; x, y [m] and heading_deg where it ended; and by command
            how many seconds it was followed.

    Raises:
        SettingsError: a time or a speed that cannot be.
    """
    if seconds is not None and not 0.0 < seconds < math.inf:
        raise SettingsError(f"the walk's length must be a positive number, not {seconds} s")
    if not (math.isfinite(speed) and speed >= 0):
        raise SettingsError(f"the speed must be 0 or a positive number, not {speed}")
    period = 1.0 / player.rate_hz
    positions = None
    if player.q is not None:
        times = period * np.arange(len(player.q) + 1)
        positions = PiecewisePolynomial.ZeroOrderHold(
            times, player.q[[*range(len(player.q)), -1]].T
        )
        seconds = min(seconds or times[-1], times[-1])
    stride = stride_positions(player.model)
    diagram = build_walk(player.model, meshcat, positions, stride, period, on_spot)
    while True:
        log = _WalkLog(diagram, on_command)
        interrupted = run_live(diagram, None, seconds, monitor=log.watch, speed=speed)
        if interrupted or not again():
            return log.as_json()
        # What was pressed before does not move the next walker.
        for name, key in KEYS.items():
            meshcat.AddButton(name, key)


def walk_live(
    scene: LiveScene,
    meshcat: Meshcat,
    model_path: Path | None = None,
    settings: LiveSettings | None = None,
    open_sensors: Callable[[], LiveSensors] | None = None,
    on_command: Callable[[str], None] = lambda _: None,
    on_report: Callable[[str], None] = lambda _: None,
    on_spot: bool = False,
) -> dict[str, Any]:
    """Lets the avatar walk as the person before the cameras commands, until Ctrl-C.

    Recorded sources are played as if they were live.

    Args:
        model_path: a person with landmarks.yaml beside it; the bundled one where not given.
        settings: how long, and whose shape; the model's where not given.
        open_sensors: opens the sensors; those of the scene in this process where not given.
        on_command: as for walk, like ``on_spot``.
        on_report: told of cameras that stop and return, bad pictures, a person found or lost.

    Returns:
        As walk; found_share of the periods in which the person was known; and warnings.

    Raises:
        SceneError, ModelError, SettingsError: what was given cannot be walked with.
        OutputError: the shape's result is none.
    """
    settings = settings or LiveSettings()
    model = load_model(model_path or bundled_person(), package_paths=settings.packages)
    known = None if settings.shape is None else shape_of_result(settings.shape)
    tracker = tracker_of_person(model.pose_tree(), known)
    opened: LiveSensors = scene.open_sensors(live=True) if open_sensors is None else open_sensors()

    def add(builder: DiagramBuilder) -> OutputPort:
        seen, period, time = opened.add(builder), opened.period, opened.GetOutputPort("time")
        system = add_person_tracker(builder, tracker, scene.cameras, seen, period, time)
        return system.GetOutputPort("estimated_positions")

    try:
        stride = stride_positions(model)
        diagram = build_walk(model, meshcat, add, stride, opened.period, on_spot, SETTLE)
        log = _WalkLog(diagram, on_command, on_report)
        run_live(diagram, opened, settings.seconds, on_report, monitor=log.watch, speed=1.0)
        warnings = camera_troubles(opened.counts(), 0)
    finally:
        opened.close()
    return {**log.as_json(), "warnings": warnings}


class _WalkLog:
    """Which commands of a diagram of build_walk were followed for how long, and where to.

    on_report: told when the person before the cameras is found or lost; None: there are none.
    """

    def __init__(
        self,
        diagram: Diagram,
        on_command: Callable[[str], None],
        on_report: Callable[[str], None] | None = None,
    ) -> None:
        self._command, self._pose = (
            diagram.GetOutputPort(name) for name in ("command", "walker_pose")
        )
        self._seconds = dict.fromkeys(COMMANDS, 0.0)
        self._on_command, self._on_report = on_command, on_report
        self._person: OutputPort | None = None
        if on_report is not None:
            tracker = diagram.GetSubsystemByName("person_tracker")
            self._person = tracker.GetOutputPort("estimated_positions")
        self._words: tuple[str, ...] = ()
        self._time, self._last = 0.0, self._pose.Eval(diagram.CreateDefaultContext())
        self._count, self._found, self._is_known = 0, 0, False

    def watch(self, context: Context) -> None:
        """Notes the command that holds from a time on, and whether the person is known."""
        elapsed, self._time = context.get_time() - self._time, context.get_time()
        for word in self._words:
            self._seconds[word] += elapsed
        turn, ahead = self._command.Eval(context)
        holds = (turn > 0, turn < 0, ahead > 0, ahead < 0)
        words = tuple(word for word, now in zip(COMMANDS, holds, strict=True) if now)
        if words != self._words:
            self._on_command(" and ".join(words))
        self._words, self._last = words, self._pose.Eval(context)
        if self._person is not None and self._on_report is not None:
            known = math.isfinite(evaluate(self._person, context)[0])
            if known != self._is_known:
                self._on_report("the person is found" if known else "the person is lost")
            self._count, self._found, self._is_known = self._count + 1, self._found + known, known

    def as_json(self) -> dict[str, Any]:
        """How long the walk was, where it ended, what was commanded, and the person's share."""
        x, y, heading = (float(value) for value in self._last)
        place = {"x": x, "y": y, "heading_deg": math.degrees(heading)}
        walked = {"seconds": self._time, **place, "commands": self._seconds}
        if self._person is not None:
            walked["found_share"] = self._found / max(self._count, 1)
        return walked


def show(page: Meshcat, patience: float = 10.0) -> bool:
    """Opens a page in the user's browser; whether one shows it in time (``patience`` [s])."""
    if webbrowser.open(page.web_url()):
        wait_for_browser(page, patience)
    return page.GetNumActiveConnections() > 0


def wait_for_browser(page: Meshcat, patience: float = math.inf) -> None:
    """Waits until a browser shows a page, for this long at most [s]."""
    end = time.monotonic() + patience
    while page.GetNumActiveConnections() == 0 and time.monotonic() < end:
        time.sleep(_POLL_PAUSE)


def wait_for_replay(page: Meshcat) -> bool:
    """Waits until the page's button to play again is pressed; False: Ctrl-C was, instead."""
    page.AddButton(REPLAY, _REPLAY_KEY)
    try:
        while page.GetButtonClicks(REPLAY) == 0:
            time.sleep(_POLL_PAUSE)
    except KeyboardInterrupt:
        return False
    finally:
        page.DeleteButton(REPLAY)
    return True


def summary_line(walked: Mapping[str, Any]) -> str:
    """A walk's result in a line."""
    followed = [f"{name} {value:.1f} s" for name, value in walked["commands"].items() if value]
    return (
        f"walked {walked['seconds']:.1f} s to x = {walked['x']:.2f} m, y = {walked['y']:.2f} m, "
        f"heading {walked['heading_deg']:.0f} degrees; commands: {', '.join(followed) or 'none'}"
    )
