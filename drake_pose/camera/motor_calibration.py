"""Read and correct the calibration files of LeRobot's motors.

Since June 2025 a file is one entry of ``MotorCalibration`` by motor
(`lerobot/motors/motors_bus.py` of huggingface/lerobot); before it was lists, one entry a motor.
"""

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from drake_pose.errors import SceneError
from drake_pose.input_files import read_regular


class Motor(NamedTuple):
    """A motor's entry in a calibration file."""

    # low, high: ends of its range in homed positions [steps]; nan in lists, which have none, unless
    # the motor's readings are 0 to 100.
    low: float
    high: float
    homing: int  # Homing offset [steps].
    is_inverted: bool  # Its drive mode.


@dataclass(frozen=True)
class Servos:
    """What a LeRobot data set tells of its robot's motors."""

    robot: str = ""  # Type of the robot, `robot_type` in the data set; "": unknown.
    path: Path | None = None  # The calibration file; None: there is none.
    # By name of the motor; empty without a file.
    motors: Mapping[str, Motor] = field(default_factory=dict)
    has_lists: bool = False  # Whether the file is of the older kind.
    # Steps of an encoder in a full turn, the same in all motors of LeRobot's arms.
    turn: int = 4096

    @property
    def is_so(self) -> bool:
        """Whether the robot is an SO-100, an SO-101, or an arm with the same joints."""
        return re.match(r"(bi_)?(so_|so\d|moss|lekiwi)", self.robot.lower()) is not None

    @property
    def is_dynamixel(self) -> bool:
        """Whether the motors are known to be Dynamixel's, which invert and home by themselves."""
        return re.match(r"(bi_)?(koch|omx|aloha|viperx|widowx)", self.robot.lower()) is not None

    @property
    def full_turns(self) -> tuple[str, ...]:
        """Motors whose range LeRobot takes to be a full turn, without asking the user."""
        known = (self.is_so, ("wrist_roll",)), (self.is_dynamixel, ("shoulder_pan", "wrist_roll"))
        return next((names for is_robot, names in known if is_robot), ())


def parse_motors(content: Any, path: Path) -> dict[str, Motor] | None:
    """Return the motors in a calibration file's content; None: it is no such file.

    Raises SceneError: an entry is damaged.
    """
    lists = ("motor_names", "homing_offset", "drive_mode")
    keys, found = {"homing_offset", "range_min", "range_max"}, dict[str, Motor]()
    try:
        if not isinstance(content, dict) or not content:
            return None
        if {*lists} <= {*content}:
            names, homing, modes = (list(content[key]) for key in lists)
            none = [math.nan] * len(names)
            ends = [content.get(key) or none for key in ("start_pos", "end_pos")]
            kinds = content.get("calib_mode") or none
            rows = zip(names, homing, modes, kinds, *ends, strict=True)
            for name, home, mode, kind, *own in rows:
                low, high = own if kind == "LINEAR" else (math.nan, math.nan)
                found[str(name)] = Motor(float(low), float(high), int(home), bool(mode))
            return found
        if not all(isinstance(one, dict) and keys <= {*one} for one in content.values()):
            return None
        for name, one in content.items():
            low, high = float(one["range_min"]), float(one["range_max"])
            mode = bool(one.get("drive_mode", 0))
            found[str(name)] = Motor(low, high, int(one["homing_offset"]), mode)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{path}: a calibration of motors is damaged: {error}") from error
    for name, one in found.items():
        if not one.low < one.high:
            raise SceneError(
                f"{path}: motor '{name}': range_min {one.low:g} must be less than range_max "
                f"{one.high:g}: calibrate the robot again (lerobot-calibrate)"
            )
    return found


def read_motors(path: Path, robot: str = "", largest: int = 1 << 20) -> Servos | None:
    """Return a calibration file's motors; None: the file is not one.

    ``path``: a JSON file. ``robot``: type of the robot, if it is known. ``largest``: maximum size
    of the file [byte]; larger files are none. Raises SceneError: the file cannot be read, or an
    entry is damaged.
    """
    try:
        data = read_regular(path, largest + 1)
        content = json.loads(data) if len(data) <= largest else None
    except OSError as error:
        raise SceneError(f"{path}: cannot read it: {error.strerror}") from error
    except ValueError:
        return None
    motors = parse_motors(content, path)
    has_lists = isinstance(content, dict) and "motor_names" in content
    return None if motors is None else Servos(robot, path, motors, has_lists)


def find_motors(folder: Path, robot: str, columns: Iterable[str]) -> tuple[Servos, list[str]]:
    """Return the motors of the calibration file in or beside a data set, and warnings.

    Files are searched in the data set, its folders `meta` and `calibration`, and then in the folder
    that holds the data set. A leader's file is used only if there is no other.

    Args:
        folder: the data set.
        robot: type of the robot.
        columns: names of the recorded columns. A file must have a motor of one of them, or as many
            motors as there are columns if these are only numbered.

    Raises SceneError: there are several files, and none is clearly the robot's.
    """
    columns, warnings = [*columns], list[str]()
    names = {name.removesuffix(".pos").removeprefix("main_") for name in columns} | {*columns}
    is_numbered = all(name[-1:].isdigit() for name in columns)
    inside = ("*.json", "meta/*.json", "calibration/**/*.json")
    for place, patterns in ((folder, inside), (folder.resolve().parent, (inside[0], inside[2]))):
        files = sorted({one for pattern in patterns for one in place.glob(pattern)})
        found = [one for file in files if (one := read_motors(file, robot)) is not None]
        own = [
            one
            for one in found
            if names & {*one.motors} or (is_numbered and len(one.motors) == len(columns))
        ]
        warnings += [
            f"{one.path}: its motors are not those of the data set: {', '.join(one.motors)}"
            for one in found
            if place == folder and one not in own
        ]
        follower = [one for one in own if "leader" not in str(one.path).lower()] or own
        if len(follower) > 1:
            listed = ", ".join(str(one.path) for one in follower)
            raise SceneError(
                f"{folder}: has several calibrations of its motors: {listed}; name the follower's: "
                "--joint-map FILE"
            )
        if follower:
            return follower[0], warnings
    return Servos(robot), warnings
