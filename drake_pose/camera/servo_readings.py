"""Read the calibration of LeRobot's motors, and convert their readings to joint angles.

Since June 2025 a calibration file is one entry of ``MotorCalibration`` by motor
(`lerobot/motors/motors_bus.py` of huggingface/lerobot); before it was lists, one entry a motor.

A motor with a calibrated range from low to high [steps] has a position P [steps], to which its
homing offset is applied. LeRobot (`_normalize` in `lerobot/motors/motors_bus.py`) records it as
200 (P - low) / (high - low) - 100, for a gripper as 100 (P - low) / (high - low), or, if it uses
degrees, as (P - (low + high) / 2) 360 / 4095.
"""

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from drake_pose.arrays import Array
from drake_pose.errors import SceneError
from drake_pose.input_files import read_regular

Encoding = Literal["rad", "deg", "normalised", "steps"]
"""What readings are: angles, LeRobot's -100 ... 100 (a gripper's 0 ... 100), or encoder steps."""

UNITS = {"rad": 1.0, "deg": math.pi / 180.0}
"""Units of angles [rad]."""

TURN = 4096
"""Steps of an encoder in a full turn, the same in all motors of LeRobot's arms."""

LEAST_RANGE, LEAST_READINGS = 300, 24
"""Minimum of a range [steps], and of different readings, fewer of which fit a range by chance."""


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


def read_motors(path: Path, robot: str = "", largest: int = 1 << 20) -> Servos | None:
    """Return a calibration file's motors; None: the file is not one.

    ``path``: a JSON file. ``robot``: type of the robot, if it is known. ``largest``: maximum size
    of the file [byte]; larger files are none. Raises SceneError: the file cannot be read, or an
    entry is damaged.
    """
    lists = ("motor_names", "homing_offset", "drive_mode")
    keys, found = {"homing_offset", "range_min", "range_max"}, dict[str, Motor]()
    try:
        data = read_regular(path, largest + 1)
        content = json.loads(data) if len(data) <= largest else None
    except OSError as error:
        raise SceneError(f"{path}: cannot read it: {error.strerror}") from error
    except ValueError:
        return None
    if not isinstance(content, dict) or not content:
        return None
    has_lists = {*lists} <= {*content}
    if not has_lists and not all(
        isinstance(one, dict) and keys <= {*one} for one in content.values()
    ):
        return None
    try:
        if has_lists:
            none = [math.nan] * len(content["motor_names"])
            kinds = (content.get(key) or none for key in ("calib_mode", "start_pos", "end_pos"))
            rows = [*zip(*(content[key] for key in lists), *kinds, strict=True)]
        else:
            rows = [
                (name, one["homing_offset"], one.get("drive_mode", 0), "LINEAR", *ends)
                for name, one in content.items()
                for ends in [(one["range_min"], one["range_max"])]
            ]
        for name, home, mode, kind, *own in rows:
            low, high = own if kind == "LINEAR" else (math.nan, math.nan)
            found[str(name)] = Motor(float(low), float(high), int(home), bool(mode))
    except (TypeError, ValueError) as error:
        raise SceneError(f"{path}: a calibration of motors is damaged: {error}") from error
    for name, one in found.items():
        if not (has_lists or one.low < one.high):
            raise SceneError(
                f"{path}: motor '{name}': range_min {one.low:g} must be less than range_max "
                f"{one.high:g}: calibrate the robot again (lerobot-calibrate)"
            )
    return Servos(robot, path, found, has_lists)


def find_motors(folder: Path, robot: str, columns: Iterable[str]) -> tuple[Servos, list[str]]:
    """Return the motors of the calibration file in or beside a data set, and warnings.

    Files are searched in the data set, its folders `meta` and `calibration`, and then in the folder
    that holds the data set. A leader's file is used only if there is no other.

    ``folder``: the data set. ``robot``: type of the robot. ``columns``: names of the recorded
    columns. A file must have a motor of one of them, or as many motors as there are columns if
    these are only numbered.

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


class Column(NamedTuple):
    """Linear map from a column to a joint: position = scale * reading + offset [rad or m].

    Attributes:
        name: name of the column.
        scale, offset: the linear map [rad or m per unit of the readings; rad or m].
        ends: range to which readings are clipped: at an end of it the joint is there or beyond;
            None: they are not clipped.
    """

    name: str
    scale: float = 1.0
    offset: float = 0.0
    ends: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class JointReadings:
    """A joint and the readings of its column."""

    name: str  # Name of the joint.
    column: str  # Name of the column.
    readings: Array  # (n,) readings in the log's unit; nan: missing.
    # lower, upper: limits of the joint, infinite if there are none [rad or m].
    lower: float
    upper: float
    is_angle: bool  # Whether the joint is revolute.
    is_gripper: bool  # Whether the joint opens a gripper.
    motor: Motor | None = None  # The motor's calibration; None: unknown.

    def is_called(self, names: tuple[str, ...]) -> bool:
        """Return whether the column's or the joint's name ends with one of the names."""
        return self.column.removesuffix(".pos").endswith(names) or self.name.endswith(names)

    @cached_property
    def ends(self) -> tuple[float, float]:
        """The smallest and the largest reading; 0 and 0 without readings."""
        known = self.readings[np.isfinite(self.readings)]
        return (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)

    @cached_property
    def steps(self) -> int | None:
        """Length of its motor's range [steps], from calibration or normalised readings.

        Without a calibration it is the smallest length with which all readings are whole steps.
        None: it is not known.
        """
        if self.motor is not None:
            length = self.motor.high - self.motor.low
            return round(length) if math.isfinite(length) else None
        full = 100.0 if self.is_gripper else 200.0
        shifted = np.unique(self.readings[np.isfinite(self.readings)]) + (full - 100.0)
        for length in range(LEAST_RANGE, TURN):
            if are_whole([shifted * length / full], least=LEAST_READINGS):
                return length
        return None

    def excess(self, scale: float, most: float = np.inf) -> float:
        """Return by how much readings times a scale exceed the limits, or plus and minus most."""
        (low, high), least, last = self.ends, max(self.lower, -most), min(self.upper, most)
        return float(max(least - scale * low, scale * high - last))


def are_whole(columns: Sequence[Array], near: float = 0.03, least: int = 8) -> bool | None:
    """Return whether the numbers of all columns are whole; None: there are too few to tell.

    ``columns``: numbers (n,) of each column; nan: missing. ``near``: tolerance; numbers stored in
    32 bits are exact to a thousandth. ``least``: minimum number of different numbers of a column; a
    column with fewer is ignored.
    """
    different = [np.unique(column[np.isfinite(column)]) for column in columns]
    told = [one for one in different if len(one) >= least]
    return all(bool((np.abs(one - np.round(one)) < near).all()) for one in told) if told else None


def unit_columns(
    joints: Sequence[JointReadings], servos: Servos | None, unit: Encoding, slack: float
) -> tuple[dict[str, Column], list[str]]:
    """Return by joint name the linear map from its column, and warnings.

    If a motor's range is about as long as the joint's limits, their middles are the same position.
    If not, or if the range is a full turn, the middle of the range is the joint's zero, as in
    LeRobot. The low end of a gripper's range is its joint's lower limit. Steps without a range have
    their zero at half a turn. A joint whose position does not follow has no map.

    ``joints``: the joints, each with a column. ``servos``: the robot's motors; None: LeRobot did
    not record the log. ``unit``: of the angles. ``slack``: tolerance of the limits, the smaller of
    this [rad or m] and this fraction of their range.
    """
    columns, warnings, assumed = dict[str, Column](), list[str](), list[str]()
    known, is_servo = servos or Servos(), is_of_servos(joints, servos, unit)
    inner = {joint.name: _as_counted(joint, known, unit) for joint in joints}
    shown = [
        replace(joint, readings=inner[joint.name].scale * joint.readings + inner[joint.name].offset)
        for joint in joints
        if is_servo and (unit == "deg" or (known.has_lists and joint.motor is not None))
    ]
    degrees, is_shown = _so_degrees(shown, known), {joint.name for joint in shown}
    for joint in joints:
        plain = Column(joint.column, UNITS.get(unit, 1.0) if joint.is_angle else 1.0)
        column: Column | None = plain
        if joint.is_gripper and is_servo:
            column = _gripper_column(joint, known, unit)
            if column is None:
                warnings.append(
                    f"joint '{joint.name}': column '{joint.column}' does not tell its position, as "
                    "the gripper's range is not known; if it must be known, give a joint map"
                )
        elif joint.is_gripper or not joint.is_angle:
            column, texts = _opening_column(joint, plain, servos is not None, slack)
            warnings += texts
        elif joint.name in is_shown:
            _, scale, offset, _ = inner[joint.name]
            outer = degrees.get(joint.name) or _plain_column(joint, known, "deg")
            column = Column(joint.column, outer.scale * scale, outer.scale * offset + outer.offset)
        elif unit == "steps":
            column = _plain_column(joint, known, unit)
        elif unit == "normalised":
            length = joint.steps
            if length is None and joint.is_called(known.full_turns):
                length = TURN - 1
            if length is None:
                assumed.append(joint.name)
                column = _between(joint, -100.0, 100.0)
            else:
                half = math.pi * length / TURN
                ends = None if length >= TURN - 1 else (-100.0, 100.0)
                column = Column(joint.column, 0.01 * half, _zero(joint, length), ends)
        if column is not None:
            columns[joint.name] = column
    if degrees:
        warnings.append(
            f"the degrees of {', '.join(degrees)} are taken to be of LeRobot before June 2025, "
            "whose zero is the arm stretched out: other degrees would leave the joints' limits more"
        )
    if assumed:
        warnings.append(
            f"the ranges of the motors of {', '.join(assumed)} are not known: the joints' limits "
            "are taken for them; give the robot's calibration file"
        )
    return columns, warnings


def is_of_arm(joints: Iterable[JointReadings], servos: Servos) -> bool:
    """Return whether joints are moved by motors that LeRobot calibrates."""
    return servos.is_so or servos.is_dynamixel or any(joint.motor for joint in joints)


def is_of_servos(joints: Sequence[JointReadings], servos: Servos | None, unit: Encoding) -> bool:
    """Return whether readings in a unit are those of LeRobot's motors, and not the model's."""
    is_named = any(joint.column.endswith(".pos") for joint in joints)
    is_hinted = is_named or is_of_arm(joints, servos or Servos())
    return unit in ("normalised", "steps") or (unit == "deg" and is_hinted)


def _opening_column(
    joint: JointReadings,
    plain: Column,
    is_lerobot: bool,
    slack: float,
    millimetres_from: float = 20.0,
) -> tuple[Column | None, list[str]]:
    """Return the map of a length or of a gripper beside radians or degrees, and warnings.

    Readings that are not within the limits may be millimetres, or a gripper's opening: LeRobot's 0
    to 100 of its limits, or another one, which tells no position. A column that is not called a
    gripper is no angle of one if it may be an opening, 0 to 1.

    ``plain``: the map of angles and metres. ``millimetres_from``: multiple of its limits beyond
    which a length may be in millimetres.
    """
    (low, high), span = joint.ends, joint.upper - joint.lower
    room, size = min(slack, slack * span), max(abs(joint.lower), abs(joint.upper))
    what = f"column '{joint.column}' of the joint log, {low:.3g} to {high:.3g},"
    is_named = joint.column == joint.name or is_gripper_name(joint.column)
    is_opening = joint.is_gripper and is_share(joint.readings)
    excess = joint.excess(plain.scale)
    if excess <= room and (is_named or not is_opening or not joint.is_angle):
        return plain, []
    if joint.is_gripper and is_lerobot and not is_opening and is_share(joint.readings, 100.0):
        text = f"{what} is taken for LeRobot's opening, 0 to 100 of the joint's limits"
        return _between(joint, 0.0, 100.0), [f"{text}; give a joint map if it is another"]
    is_large = not joint.is_angle and max(-low, high) > millimetres_from * size
    if is_large and joint.excess(1e-3) <= room:
        text = f"{what} is assumed to be in mm: only so it is within the joint's limits"
        return plain._replace(scale=1e-3), [f"{text}; if it is not, give a joint map"]
    if joint.is_gripper and (is_opening or not is_named or excess > room + span):
        return None, [
            f"{what} is not taken for joint '{joint.name}' ({joint.lower:.3g} to "
            f"{joint.upper:.3g}): it seems to be a gripper's opening; map it if it is known "
            f"({joint.name}: {{column: {joint.column}, from: [0, 1], to: [OPEN, CLOSED]}})"
        ]
    return plain, []


def _spans_limits(joint: JointReadings, length: float, alike: float = 0.25) -> bool:
    """Return whether the range of a joint's motor is about as long as the joint's limits.

    ``length``: of the range [steps]. ``alike``: maximum difference [the limits' length].
    """
    span = joint.upper - joint.lower
    return abs(2.0 * math.pi * length / TURN - span) <= alike * span < math.inf


def _zero(joint: JointReadings, length: float) -> float:
    """Return a joint's position [rad] in the middle of its motor's range, of a ``length`` [steps].

    It is 0 if the range tells nothing of the joint's limits.
    """
    told = length < TURN - 1 and _spans_limits(joint, length)
    return 0.5 * (joint.lower + joint.upper) if told else 0.0


def _between(joint: JointReadings, low: float, high: float) -> Column | None:
    """Return the map that takes readings low and high to the joint's limits; None: no limits."""
    span = joint.upper - joint.lower
    if not math.isfinite(span):
        return None
    scale = span / (high - low)
    ends = None if joint.is_gripper else (low, high)
    return Column(joint.column, scale, joint.lower - scale * low, ends)


def _as_counted(joint: JointReadings, servos: Servos, encoding: Encoding) -> Column:
    """Return the map from a joint's steps to degrees, if its motor is calibrated by lists.

    Lists, the calibration of LeRobot before June 2025, home and invert what the motor counts. All
    other readings are mapped to themselves.
    """
    if encoding != "steps" or not servos.has_lists or joint.motor is None:
        return Column(joint.column)
    scale, motor = 360.0 / TURN, joint.motor
    return Column(joint.column, -scale if motor.is_inverted else scale, scale * motor.homing)


def _plain_column(joint: JointReadings, servos: Servos, encoding: Encoding) -> Column:
    """Return a joint's map from encoder steps, or from degrees of which LeRobot counts 360 to 4095.

    Without a calibration the zero of steps is half a turn.
    """
    motor = joint.motor
    step = 2.0 * math.pi / TURN if encoding == "steps" else math.radians(1.0)
    if motor is None or not (encoding == "steps" or math.isfinite(motor.high)):
        return Column(joint.column, step, -step * (TURN // 2) if encoding == "steps" else 0.0)
    zero = _zero(joint, motor.high - motor.low)
    if encoding == "deg":
        return Column(joint.column, step * (TURN - 1) / TURN, zero)
    step = -step if motor.is_inverted and not servos.is_dynamixel else step
    return Column(joint.column, step, zero - step * (0.5 * (motor.low + motor.high)))


def _so_degrees(joints: Sequence[JointReadings], servos: Servos) -> dict[str, Column]:
    """Return the maps of SO arms' joints whose zero and sign changed in LeRobot's #777, June 2025.

    Before, the zero of shoulder_lift and elbow_flex was the arm stretched out. The old maps are
    returned if readings leave the joints' limits less with them than with the new maps; or as much,
    if the columns have old names, without ".pos". Otherwise the result is empty.

    joints: with readings in degrees. servos: the robot's motors.
    """
    changed = {"shoulder_lift": (-1.0, 90.0), "elbow_flex": (1.0, -90.0)}
    old_columns, excess = dict[str, Column](), np.zeros(2)
    for joint in joints if servos.is_so else ():
        for name, (sign, offset) in changed.items():
            if joint.is_called((name,)):
                old = Column(joint.column, math.radians(sign), math.radians(offset))
                old_columns[joint.name] = old
                for k, way in enumerate((Column("", math.radians(1.0)), old)):
                    angles = way.scale * joint.readings + way.offset
                    beyond = np.maximum(joint.lower - angles, angles - joint.upper)
                    excess[k] += max(0.0, float(np.nanmax(beyond, initial=0.0)))
    is_new = all(joint.column.endswith(".pos") for joint in joints)
    return old_columns if excess[1] < excess[0] or (excess[1] == excess[0] and not is_new) else {}


def _gripper_column(joint: JointReadings, servos: Servos, encoding: Encoding) -> Column | None:
    """Return a gripper's map; None: its readings do not determine its position.

    If the motor's range is not about as long as the joint's limits, a gear is between them, and the
    range's ends are the limits. ``encoding``: of the other joints.
    """
    motor, low, high = joint.motor, 0.0, 100.0
    length = math.nan if motor is None else motor.high - motor.low
    if encoding == "steps":
        if motor is None or not math.isfinite(length):
            return None
        is_reversed = motor.is_inverted and not servos.is_dynamixel
        low, high = (motor.high, motor.low) if is_reversed else (motor.low, motor.high)
    elif not is_share(joint.readings, high):
        return None
    if joint.is_angle and _spans_limits(joint, length):
        scale = 2.0 * math.pi * length / TURN / (high - low)
        return Column(joint.column, scale, joint.lower - scale * low)
    return _between(joint, low, high)


def is_share(readings: Array, full: float = 1.0, tolerance: float = 0.005) -> bool:
    """Return whether readings (n,) can be a gripper's opening, 0 to full.

    ``tolerance``: maximum distance outside [full]. nan: missing.
    """
    known = readings[np.isfinite(readings)] / full
    return bool(known.size and -tolerance <= known.min() and known.max() <= 1.0 + tolerance)


def is_gripper_name(name: str) -> bool:
    """Return whether a name is of a gripper's joint."""
    grippers = {"gripper", "finger", "fingers", "jaw", "claw", "knuckle"}
    return not grippers.isdisjoint(name_words(name))


def name_words(name: str) -> list[str]:
    """Return the words in lower case and the numbers of a name, without affixes.

    Affixes are a k before a capital letter, and the last words "joint" and "pos".
    """
    words = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)]
    if len(words) > 1 and re.match("k[A-Z]", name):
        words = words[1:]
    while len(words) > 1 and words[-1] in ("joint", "pos"):
        words = words[:-1]
    return words
