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
from pathlib import Path
from typing import Literal, NamedTuple, cast

import numpy as np

from drake_pose.arrays import Array
from drake_pose.errors import SceneError
from drake_pose.input_files import read_regular

Encoding = Literal["rad", "deg", "normalised", "steps"]
"""What readings are: angles, LeRobot's -100 ... 100 (a gripper's 0 ... 100), or encoder steps."""


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
            names, homing, modes = (list(content[key]) for key in lists)
            none = [math.nan] * len(names)
            ends = [content.get(key) or none for key in ("start_pos", "end_pos")]
            kinds = content.get("calib_mode") or none
            rows = zip(names, homing, modes, kinds, *ends, strict=True)
            for name, home, mode, kind, *own in rows:
                low, high = own if kind == "LINEAR" else (math.nan, math.nan)
                found[str(name)] = Motor(float(low), float(high), int(home), bool(mode))
            return Servos(robot, path, found, has_lists)
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
    return Servos(robot, path, found)


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
class ServoJoint:
    """A joint whose column holds the readings of a servo."""

    name: str  # Name of the joint.
    column: str  # Name of the column.
    # (n,) readings [degrees, radians, LeRobot's -100 ... 100, or steps]; nan: missing.
    readings: Array
    # lower, upper: limits of the joint, infinite if there are none [rad or m].
    lower: float
    upper: float
    is_angle: bool  # Whether the joint is revolute.
    is_gripper: bool  # Whether the joint opens a gripper.
    motor: Motor | None  # The motor's calibration; None: unknown.

    def is_called(self, names: tuple[str, ...]) -> bool:
        """Return whether the column's or the joint's name ends with one of the names."""
        return self.column.removesuffix(".pos").endswith(names) or self.name.endswith(names)


def servo_encoding(
    joints: Sequence[ServoJoint], servos: Servos | None, units: str | None, slack: float
) -> tuple[Encoding | None, list[str]]:
    """Return the encoding of columns that LeRobot recorded from servos, and warnings.

    None: the columns are radians or degrees that follow the model, or lengths.

    Args:
        joints: joints with their columns and motors.
        servos: the robot's motors; None: LeRobot did not record the log.
        units: the encoding as the user says; None: it is inferred.
        slack: tolerance of the limits [rad].

    Raises SceneError: the readings seem to be normalised, and their ranges are not known.
    """
    known, is_named = servos or Servos(), any(joint.column.endswith(".pos") for joint in joints)
    is_arm = known.is_so or known.is_dynamixel or any(joint.motor is not None for joint in joints)
    bodies = [joint for joint in joints if joint.is_angle and not joint.is_gripper]
    is_radians, is_degrees = (
        all(
            np.nanmin(scale * joint.readings, initial=np.inf) >= joint.lower - slack
            and np.nanmax(scale * joint.readings, initial=-np.inf) <= joint.upper + slack
            for joint in bodies
        )
        for scale in (1.0, math.radians(1.0))
    )
    is_plain = is_radians if servos is not None else not is_arm
    if units == "rad" or not bodies or (is_plain and not is_named and not units):
        return None, []
    encoding, why = (units, "") if units else (_find_encoding(joints, known.turn) or (None, ""))
    is_told = {
        "deg": is_arm or (is_named and is_degrees),
        "normalised": is_arm or is_named or units is not None,
        "steps": servos is not None or units is not None,
    }
    if encoding is None or not is_told[encoding]:
        return None, []
    if encoding == "normalised" and not units:
        unknown = [joint.column for joint in bodies if range_in_steps(joint, known.turn) is None]
        if unknown and not (known.is_so or known.is_dynamixel):
            raise SceneError(
                f"the readings of the joint log ({', '.join(unknown)}) seem to be normalised to "
                "-100 ... 100, as in LeRobot, and their ranges are not known: put the robot's "
                "calibration file into the data set or name it (--joint-map FILE), or give units: "
                "rad, deg, or normalised for the joints' limits, or a joint map with the range of "
                "each: JOINT: {column: COLUMN, from: [-100, 100], to: [LOWEST, HIGHEST]} in radians"
            )
        if is_radians and why.startswith("but"):
            raise SceneError(
                f"the readings of the joint log ({', '.join(one.column for one in bodies)}) could "
                "be radians, degrees, or normalised to -100 ... 100: give units: rad, deg or "
                "normalised"
            )
    source = "no calibration file of the robot is in or beside the data set"
    source += f", so {known.turn // 2} is taken for zero" if encoding == "steps" else ""
    source = f"their ranges are those of {known.path}" if known.path else source
    what = {
        "normalised": "LeRobot's -100 ... 100 of the motors' ranges",
        "deg": "LeRobot's degrees",
        "steps": f"encoder steps, {known.turn} a turn",
    }[str(encoding)]
    texts = [
        f"readings of the joint log are taken to be {what}{': ' if why else ''}{why}; {source}; "
        "zeros set by hand are off by several degrees: estimate them (--zeros all)"
    ]
    return cast(Encoding, encoding), texts


def _find_encoding(
    joints: Sequence[ServoJoint], turn: int, full: float = 100.001, most: float = 720.0
) -> tuple[Encoding, str] | None:
    """Infer the encoding of servos' readings; return it, and the reason for messages, or None.

    Encoders count in whole steps: an encoding is right if readings are whole steps in it alone.
    None: there are no readings, or they are too large for steps.

    ``joints``: the joints; a gripper's readings are not regarded. ``turn``: steps of a full turn.
    ``full``: maximum magnitude of normalised readings, with the rounding of stored numbers.
    ``most``: maximum magnitude of degrees, two turns [deg]; larger readings are steps.
    """
    body = [joint for joint in joints if joint.is_angle and not joint.is_gripper]
    known_readings = [(joint, joint.readings[np.isfinite(joint.readings)]) for joint in body]
    known = [replace(joint, readings=own) for joint, own in known_readings if own.size]
    if not known:
        return None
    largest = max(float(np.nanmax(np.abs(joint.readings))) for joint in known)
    if largest > most:
        # Only homed motors count below 0, or beyond a turn.
        low, high = (-turn, 2 * turn) if all(joint.motor for joint in known) else (0, turn)
        is_count = all(((one.readings >= low) & (one.readings <= high)).all() for one in known)
        return ("steps", f"they are up to {largest:.0f}") if is_count else None
    # The middle of a range may be half a step.
    degrees = _are_whole([2.0 * (turn - 1) / 360.0 * joint.readings for joint in known])
    if largest > full:
        return "deg", f"the largest is {largest:.4g}, not within -100 ... 100"
    counts = [(joint, range_in_steps(joint, turn)) for joint in known]
    normalised = _are_whole([(joint.readings + 100.0) * n / 200.0 for joint, n in counts if n])
    if degrees:
        return "deg", "only as degrees they are whole steps of an encoder"
    if normalised:
        return "normalised", "only as -100 ... 100 of its range they are whole steps of an encoder"
    for joint in known:
        if joint.motor is not None and math.isfinite(joint.motor.high):
            half = 180.0 * (joint.motor.high - joint.motor.low) / turn
            if np.nanmax(np.abs(joint.readings)) > half + 2.0:
                return "normalised", f"as degrees '{joint.column}' would leave its range"
    if any((np.abs(joint.readings) == 100.0).any() for joint in known):
        return "normalised", "some are -100 or 100 exactly"
    return "normalised", "but they could be degrees, too"


def _are_whole(columns: Sequence[Array], near: float = 0.03, least: int = 8) -> bool | None:
    """Return whether the numbers of all columns are whole; None: there are too few to tell.

    ``columns``: numbers (n,) of each column; nan: missing. ``near``: tolerance; numbers stored in
    32 bits are exact to a thousandth. ``least``: minimum number of different numbers of a column; a
    column with fewer is ignored.
    """
    different = [np.unique(column[np.isfinite(column)]) for column in columns]
    told = [one for one in different if len(one) >= least]
    return all(bool((np.abs(one - np.round(one)) < near).all()) for one in told) if told else None


def range_in_steps(
    joint: ServoJoint, turn: int, least: int = 300, different: int = 24
) -> int | None:
    """Return the length of a motor's range [steps], from calibration or normalised readings.

    Without a calibration it is the smallest length with which all readings are whole steps. None:
    it is not known.

    Args:
        joint: the joint.
        turn: steps of a full turn.
        least: minimum length of a range [steps].
        different: minimum number of different readings; with fewer a length may fit by chance.
    """
    if joint.motor is not None:
        length = joint.motor.high - joint.motor.low
        return round(length) if math.isfinite(length) else None
    full = 100.0 if joint.is_gripper else 200.0
    shifted = np.unique(joint.readings[np.isfinite(joint.readings)]) + (full - 100.0)
    found = (n for n in range(least, turn) if _are_whole([shifted * n / full], least=different))
    return next(found, None)


def servo_columns(
    joints: Sequence[ServoJoint], servos: Servos, encoding: Encoding
) -> tuple[dict[str, Column], list[str]]:
    """Return by joint name the linear map from its column, and warnings.

    If a motor's range is about as long as the joint's limits, their middles are the same position.
    If not, or if the range is a full turn, the middle of the range is the joint's zero, as in
    LeRobot. The low end of a gripper's range is its joint's lower limit. Steps without a range have
    their zero at half a turn. A joint whose position does not follow has no map.

    ``joints``: the joints, each with a column. ``servos``: the robot's motors. ``encoding``: of the
    readings.
    """
    columns, warnings, assumed = dict[str, Column](), list[str](), list[str]()
    inner = {joint.name: _as_counted(joint, servos, encoding) for joint in joints}
    is_degrees = {
        joint.name: encoding == "deg" or (servos.has_lists and joint.motor is not None)
        for joint in joints
    }
    shown = [
        replace(joint, readings=inner[joint.name].scale * joint.readings + inner[joint.name].offset)
        for joint in joints
        if is_degrees[joint.name]
    ]
    degrees = _so_degrees(shown, servos)
    for joint in joints:
        if joint.is_gripper:
            column = _gripper_column(joint, servos, encoding)
            if column is None:
                warnings.append(
                    f"joint '{joint.name}': column '{joint.column}' does not tell its position, as "
                    "the gripper's range is not known; if it must be known, give a joint map"
                )
        elif is_degrees[joint.name]:
            scale, offset = inner[joint.name][1:3]
            outer = degrees.get(joint.name) or _plain_column(joint, servos, "deg")
            column = Column(joint.column, outer.scale * scale, outer.scale * offset + outer.offset)
        elif encoding == "steps":
            column = _plain_column(joint, servos, encoding)
        else:
            length = range_in_steps(joint, servos.turn)
            if length is None and joint.is_called(servos.full_turns):
                length = servos.turn - 1
            if length is None:
                assumed.append(joint.name)
                column = _between(joint, -100.0, 100.0)
            else:
                half = math.pi * length / servos.turn
                ends = None if length >= servos.turn - 1 else (-100.0, 100.0)
                column = Column(joint.column, 0.01 * half, _zero(joint, length, servos.turn), ends)
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


def _spans_limits(joint: ServoJoint, length: float, turn: int, alike: float = 0.25) -> bool:
    """Return whether the range of a joint's motor is about as long as the joint's limits.

    ``length``: of the range [steps]. ``turn``: steps of a full turn. ``alike``: maximum difference
    [the limits' length].
    """
    span = joint.upper - joint.lower
    return abs(2.0 * math.pi * length / turn - span) <= alike * span < math.inf


def _zero(joint: ServoJoint, length: float, turn: int) -> float:
    """Return a joint's position [rad] in the middle of its motor's range, of a ``length`` [steps].

    It is 0 if the range tells nothing of the joint's limits.
    """
    told = length < turn - 1 and _spans_limits(joint, length, turn)
    return 0.5 * (joint.lower + joint.upper) if told else 0.0


def _between(joint: ServoJoint, low: float, high: float) -> Column | None:
    """Return the map that takes readings low and high to the joint's limits; None: no limits."""
    span = joint.upper - joint.lower
    if not math.isfinite(span):
        return None
    scale = span / (high - low)
    ends = None if joint.is_gripper else (low, high)
    return Column(joint.column, scale, joint.lower - scale * low, ends)


def _as_counted(joint: ServoJoint, servos: Servos, encoding: Encoding) -> Column:
    """Return the map from a joint's steps to degrees, if its motor is calibrated by lists.

    Lists, the calibration of LeRobot before June 2025, home and invert what the motor counts. All
    other readings are mapped to themselves.
    """
    if encoding != "steps" or not servos.has_lists or joint.motor is None:
        return Column(joint.column)
    scale = 360.0 / servos.turn
    sign = -1.0 if joint.motor.is_inverted else 1.0
    return Column(joint.column, sign * scale, scale * joint.motor.homing)


def _plain_column(joint: ServoJoint, servos: Servos, encoding: Encoding) -> Column:
    """Return a joint's map from encoder steps, or from degrees of which LeRobot counts 360 to 4095.

    Without a calibration the zero of steps is half a turn.
    """
    motor, turn = joint.motor, servos.turn
    step = 2.0 * math.pi / turn if encoding == "steps" else math.radians(1.0)
    if motor is None or not (encoding == "steps" or math.isfinite(motor.high)):
        return Column(joint.column, step, -step * (turn // 2) if encoding == "steps" else 0.0)
    zero = _zero(joint, motor.high - motor.low, turn)
    if encoding == "deg":
        return Column(joint.column, step * (turn - 1) / turn, zero)
    step = -step if motor.is_inverted and not servos.is_dynamixel else step
    return Column(joint.column, step, zero - step * (0.5 * (motor.low + motor.high)))


def _so_degrees(joints: Sequence[ServoJoint], servos: Servos) -> dict[str, Column]:
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


def _gripper_column(joint: ServoJoint, servos: Servos, encoding: Encoding) -> Column | None:
    """Return a gripper's map; None: its readings do not determine its position.

    If the motor's range is not about as long as the joint's limits, a gear is between them, and the
    range's ends are the limits. ``encoding``: of the other joints.
    """
    motor, turn = joint.motor, servos.turn
    length = math.nan if motor is None else motor.high - motor.low
    if encoding == "steps":
        if motor is None or not math.isfinite(length):
            return None
        is_reversed = motor.is_inverted and not servos.is_dynamixel
        low, high = (motor.high, motor.low) if is_reversed else (motor.low, motor.high)
    else:
        low, high = 0.0, 100.0
        if not (np.nanmin(joint.readings) >= -0.5 and np.nanmax(joint.readings) <= 100.5):
            return None
    if joint.is_angle and _spans_limits(joint, length, turn):
        scale = 2.0 * math.pi * length / turn / (high - low)
        return Column(joint.column, scale, joint.lower - scale * low)
    return _between(joint, low, high)


def is_gripper_name(words: Sequence[str]) -> bool:
    """Return whether a name, given as its words in lower case, is of a gripper's joint."""
    return not {*words}.isdisjoint({"gripper", "finger", "fingers", "jaw", "claw", "knuckle"})


@dataclass(frozen=True)
class HomingCorrection:
    """A motor's corrected homing offset."""

    motor: str  # Name of the motor.
    # before, after: homing offset in the file, and corrected [steps].
    before: int
    after: int
    shift: int  # Increase of the motor's positions by the correction [steps].
    reason: str = ""  # Why the offset is not corrected; "": it is.


def correct_homing(
    joint: ServoJoint,
    motor_name: str,
    column: Column,
    offset: float,
    servos: Servos,
    encoding: Encoding,
    *,
    most_lost: float = 0.5,
) -> HomingCorrection:
    """Return the homing offset with which LeRobot reads the model's angle of a joint.

    The middle of the motor's range, where LeRobot reads 0, becomes the model's zero. The range's
    numbers stay, so that its ends are the same angles on both sides of the zero.

    Args:
        joint: the joint; its readings are not used.
        motor_name: name of the motor in the calibration file.
        column: the joint's column, as recorded.
        offset: the joint's offset, to be added to the recorded positions [rad].
        servos: the robot's motors.
        encoding: of the column's readings.
        most_lost: maximum correction [half the range]; beyond it the model's zero is not meant to
            be the motor's, as in a model whose limits are all on one side of 0.
    """
    motor, step = servos.motors[motor_name], 2.0 * math.pi / servos.turn
    before = motor.homing
    if joint.is_gripper:
        reason = "its readings are an opening of 0 to 100, not an angle"
        return HomingCorrection(motor_name, before, before, 0, reason)
    sign = -1.0 if motor.is_inverted and not servos.is_dynamixel and encoding != "deg" else 1.0
    if servos.has_lists:
        # Calibrations by lists invert what the motor counts, then add the offset.
        counted = sign if encoding == "steps" else 1.0
        shift = round(math.copysign(offset / step, counted * column.scale * offset))
        return HomingCorrection(motor_name, before, before + shift, shift)
    middle = 0.5 * (motor.low + motor.high) if encoding == "steps" else 0.0
    zero = column.scale * middle + column.offset + offset
    shift, half = round(sign * zero / step), 0.5 * (motor.high - motor.low)
    if abs(shift) > most_lost * half:
        reason = (
            f"the middle of its range is {math.degrees(zero):.0f} degrees in the model, too far "
            "from its zero: calibrate it again with the arm in the middle of its range"
        )
        return HomingCorrection(motor_name, before, before, 0, reason)
    # Feetech: position = counted - homing offset; Dynamixel: plus.
    after = before + shift if servos.is_dynamixel else before - shift
    if not servos.is_dynamixel and abs(after) >= servos.turn // 2:
        # The register has a sign and 11 bits; positions are modulo a turn.
        after = max(after - int(math.copysign(servos.turn, after)), 1 - servos.turn // 2)
    return HomingCorrection(motor_name, before, after, shift)


def dump_column(joint: str, column: Column, offset: float) -> str:
    """Return a joint's line of a joint map, ``offset`` added to its positions [rad or m]."""
    scale, constant = float(column.scale), float(column.offset + offset)
    name = json.dumps(column.name)
    if column.ends is None:
        return f"{joint}: {{column: {name}, scale: {scale!r}, offset: {constant!r}}}\n"
    ends = [float(end) for end in column.ends]
    values = [scale * end + constant for end in ends]
    return f"{joint}: {{column: {name}, from: {ends}, to: {values}}}\n"
