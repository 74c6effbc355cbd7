"""Tell joint angles from the readings of servos, as LeRobot records them.

LeRobot (`_normalize` in `lerobot/motors/motors_bus.py`) records a position P [steps], homed by the
motor, as 200 (P - low) / (high - low) - 100, for a gripper as 100 (P - low) / (high - low), or, if
it uses degrees, as (P - middle) 360 / 4095, with the ends of the motor's calibrated range.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, cast

import numpy as np

from drake_pose.arrays import Array
from drake_pose.camera.motor_calibration import Motor, Servos
from drake_pose.errors import SceneError

Encoding = Literal["rad", "deg", "normalised", "steps"]
"""What readings are: angles, LeRobot's -100 ... 100 (a gripper's 0 ... 100), or encoder steps."""


class Column(NamedTuple):
    """Linear map from a column to a joint: position = scale * reading + offset [rad or m].

    Attributes:
        name: name of the column.
        scale, offset: the linear map [rad or m per unit of the readings; rad or m].
        ends: range of the readings, if they are clipped to one; a reading at an end means that the
            joint is there or beyond.
    """

    name: str
    scale: float = 1.0
    offset: float = 0.0
    ends: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class ServoJoint:
    """A joint whose column holds the readings of a servo.

    Attributes:
        name: name of the joint.
        column: name of the column.
        readings: (n,) readings; nan where there is none.
        lower, upper: limits of the joint, infinite if there are none [rad or m].
        is_angle: whether it is revolute.
        is_gripper: whether it opens a gripper.
        motor: the motor's calibration; None: unknown.
    """

    name: str
    column: str
    readings: Array
    lower: float
    upper: float
    is_angle: bool
    is_gripper: bool
    motor: Motor | None

    def is_called(self, names: tuple[str, ...]) -> bool:
        """Return whether the column or the joint has one of LeRobot's names, after any prefix."""
        return self.column.removesuffix(".pos").endswith(names) or self.name.endswith(names)

    @property
    def middle(self) -> float:
        """Middle of the joint's limits [rad or m]; 0 without limits."""
        return 0.5 * (self.lower + self.upper) if math.isfinite(self.upper - self.lower) else 0.0


def servo_encoding(
    joints: Sequence[ServoJoint], servos: Servos | None, units: str | None, slack: float = 0.1
) -> tuple[Encoding | None, list[str]]:
    """Return what columns hold if LeRobot recorded them of servos, and warnings.

    None: they are plain angles, or lengths.

    Args:
        joints: joints with their columns and motors.
        servos: the robot's motors; None: LeRobot did not record the log.
        units: what the columns hold, by the user; None: not said.
        slack: tolerance of the limits [rad].

    Raises:
        SceneError: the readings seem to be normalised, and their ranges are not known.
    """
    known, is_named = servos or Servos(), any(one.column.endswith(".pos") for one in joints)
    is_arm = known.is_so or known.is_dynamixel or any(one.motor is not None for one in joints)
    bodies = [one for one in joints if one.is_angle and not one.is_gripper]
    is_radians, is_degrees = (
        all(
            np.nanmin(scale * one.readings, initial=np.inf) >= one.lower - slack
            and np.nanmax(scale * one.readings, initial=-np.inf) <= one.upper + slack
            for one in bodies
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
        _require_ranges(bodies, known)
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
    """Return what servos' readings are, and the reason, for messages; None: not angles of a joint.

    Encoders count in whole steps: readings that are so in one encoding only are decisive.

    Args:
        joints: the joints; a gripper's readings are not regarded.
        turn: steps of a full turn.
        full: largest magnitude of normalised readings, with the rounding of stored numbers.
        most: larger magnitudes are steps; two turns [deg].
    """
    body = [one for one in joints if one.is_angle and not one.is_gripper]
    told = [(one, one.readings[np.isfinite(one.readings)]) for one in body]
    known = [replace(one, readings=own) for one, own in told if own.size]
    if not known:
        return None
    largest = max(float(np.nanmax(np.abs(one.readings))) for one in known)
    if largest > most:
        # Only homed motors count below 0, or beyond a turn.
        low, high = (-turn, 2 * turn) if all(one.motor for one in known) else (0, turn)
        is_count = all(((one.readings >= low) & (one.readings <= high)).all() for one in known)
        return ("steps", f"they are up to {largest:.0f}") if is_count else None
    # The middle of a range may be half a step.
    degrees = _are_whole([2.0 * (turn - 1) / 360.0 * one.readings for one in known])
    if largest > full:
        return "deg", f"the largest is {largest:.4g}, not within -100 ... 100"
    counts = [(one, range_in_steps(one, turn)) for one in known]
    normalised = _are_whole([(one.readings + 100.0) * n / 200.0 for one, n in counts if n])
    if degrees:
        return "deg", "only as degrees they are whole steps of an encoder"
    if normalised:
        return "normalised", "only as -100 ... 100 of its range they are whole steps of an encoder"
    for one in known:
        if one.motor is not None and math.isfinite(one.motor.high):
            half = 180.0 * (one.motor.high - one.motor.low) / turn
            if np.nanmax(np.abs(one.readings)) > half + 2.0:
                return "normalised", f"as degrees '{one.column}' would leave its range"
    if any((np.abs(one.readings) == 100.0).any() for one in known):
        return "normalised", "some are -100 or 100 exactly"
    return "normalised", "but they could be degrees, too"


def _are_whole(columns: Sequence[Array], near: float = 0.03, least: int = 8) -> bool | None:
    """Return whether numbers (n,) of each column are whole; None: there are too few to tell.

    Args:
        columns: the columns.
        near: tolerance; numbers stored in 32 bits are exact to a thousandth.
        least: a column with fewer different numbers is not regarded.
    """
    different = [np.unique(one[np.isfinite(one)]) for one in columns]
    told = [one for one in different if len(one) >= least]
    return all(bool((np.abs(one - np.round(one)) < near).all()) for one in told) if told else None


def range_in_steps(
    joint: ServoJoint, turn: int, least: int = 300, different: int = 24
) -> int | None:
    """Return the length of a motor's range [steps], by its calibration or its normalised readings.

    Without a calibration it is the least number of steps for which all readings are whole steps;
    None: there is none.

    Args:
        joint: the joint.
        turn: steps of a full turn.
        least: minimum length of a range [steps].
        different: minimum number of different readings; fewer may share a divisor by chance.
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
    """Return the column of each joint by its name, and warnings; a joint may lack one.

    The middle of a motor's range is the middle of the joint's limits if the two are about as long;
    else, and if the range is a full turn, it is the joint's zero, as in LeRobot. A gripper's low
    end is its joint's lower limit. Steps without a range have their zero at half a turn.

    Args:
        joints: joints, one for each column.
        servos: the robot's motors.
        encoding: what the readings are.
    """
    columns, warnings, assumed = dict[str, Column](), list[str](), list[str]()
    inner = {one.name: _as_counted(one, servos, encoding) for one in joints}
    is_degrees = {
        one.name: encoding == "deg" or (servos.has_lists and one.motor is not None)
        for one in joints
    }
    shown = [
        replace(one, readings=inner[one.name].scale * one.readings + inner[one.name].offset)
        for one in joints
        if is_degrees[one.name]
    ]
    degrees = _so_degrees(shown, servos)
    for one in joints:
        if one.is_gripper:
            found = _gripper_column(one, servos, encoding)
            if found is None:
                warnings.append(
                    f"joint '{one.name}': column '{one.column}' does not tell its position, as the "
                    "gripper's range is not known; if it must be known, give a joint map"
                )
        elif is_degrees[one.name]:
            scale, offset = inner[one.name][1:3]
            outer = degrees.get(one.name) or _degree_column(one, servos)
            found = Column(one.column, outer.scale * scale, outer.scale * offset + outer.offset)
        elif encoding == "steps":
            found = _step_column(one, servos)
        else:
            length = range_in_steps(one, servos.turn)
            if length is None and one.is_called(servos.full_turns):
                length = servos.turn - 1
            if length is None:
                assumed.append(one.name)
                found = _between(one, -100.0, 100.0)
            else:
                half = math.pi * length / servos.turn
                ends = None if length >= servos.turn - 1 else (-100.0, 100.0)
                found = Column(one.column, 0.01 * half, _zero(one, length, servos.turn), ends)
        if found is not None:
            columns[one.name] = found
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


def _zero(joint: ServoJoint, length: float, turn: int, alike: float = 0.25) -> float:
    """Return a joint's position [rad] in the middle of its motor's range.

    Args:
        joint: the joint.
        length: length of the range [steps].
        turn: steps of a full turn.
        alike: if the range and the joint's limits differ by more than this fraction, the range is
            not that of the joint's motion.
    """
    span, travel = joint.upper - joint.lower, 2.0 * math.pi * length / turn
    return joint.middle if length < turn - 1 and abs(travel - span) <= alike * span else 0.0


def _between(joint: ServoJoint, low: float, high: float) -> Column | None:
    """Return the column whose readings low and high are the joint's limits; None without limits."""
    span = joint.upper - joint.lower
    if not math.isfinite(span):
        return None
    scale = span / (high - low)
    ends = None if joint.is_gripper else (low, high)
    return Column(joint.column, scale, joint.lower - scale * low, ends)


def _as_counted(joint: ServoJoint, servos: Servos, encoding: Encoding) -> Column:
    """Return the map from a joint's readings to degrees if they are steps homed by lists.

    Lists home and invert what the motor counts. Other readings are mapped to themselves.
    """
    if encoding != "steps" or not servos.has_lists or joint.motor is None:
        return Column(joint.column)
    scale = 360.0 / servos.turn
    sign = -1.0 if joint.motor.is_inverted else 1.0
    return Column(joint.column, sign * scale, scale * joint.motor.homing)


def _step_column(joint: ServoJoint, servos: Servos) -> Column:
    """Return a joint's column of encoder steps; without calibration half a turn is its zero."""
    motor, turn = joint.motor, servos.turn
    step = 2.0 * math.pi / turn
    sign = -1.0 if motor is not None and motor.is_inverted and not servos.is_dynamixel else 1.0
    if motor is None:
        return Column(joint.column, step, -step * (turn // 2))
    middle, length = 0.5 * (motor.low + motor.high), motor.high - motor.low
    return Column(joint.column, sign * step, _zero(joint, length, turn) - sign * step * middle)


def _degree_column(joint: ServoJoint, servos: Servos) -> Column:
    """Return a joint's column of degrees; LeRobot counts 4095 steps in 360 degrees."""
    motor, scale = joint.motor, math.radians(1.0)
    if motor is None or not math.isfinite(motor.high):
        return Column(joint.column, scale)
    zero = _zero(joint, motor.high - motor.low, servos.turn)
    return Column(joint.column, scale * (servos.turn - 1) / servos.turn, zero)


def _so_degrees(joints: Sequence[ServoJoint], servos: Servos) -> dict[str, Column]:
    """Return the columns of SO arms' joints whose zero and sign changed in LeRobot's #777.

    Before, the zero of shoulder_lift and elbow_flex was the arm stretched out. They are returned if
    the readings then leave the joints' limits less, or as much and the columns have the names of
    that time, without ".pos".
    """
    changed = {"shoulder_lift": (-1.0, 90.0), "elbow_flex": (1.0, -90.0)}
    found, excess = dict[str, Column](), np.zeros(2)
    for one in joints if servos.is_so else ():
        for name, (sign, offset) in changed.items():
            if one.is_called((name,)):
                old = Column(one.column, math.radians(sign), math.radians(offset))
                found[one.name] = old
                for k, way in enumerate((Column("", math.radians(1.0)), old)):
                    angles = way.scale * one.readings + way.offset
                    beyond = np.maximum(one.lower - angles, angles - one.upper)
                    excess[k] += max(0.0, float(np.nanmax(beyond, initial=0.0)))
    is_new = all(one.column.endswith(".pos") for one in joints)
    return found if excess[1] < excess[0] or (excess[1] == excess[0] and not is_new) else {}


def _gripper_column(
    joint: ServoJoint, servos: Servos, encoding: Encoding, alike: float = 0.25
) -> Column | None:
    """Return a gripper's column; None: its readings do not tell its position.

    Args:
        joint: the gripper's joint.
        servos: the robot's motors.
        encoding: of the other joints.
        alike: if the motor's range and the joint's differ by more than this fraction, a gear is
            between them, and the range is the joint's limits.
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
    travel, span = 2.0 * math.pi * length / turn, joint.upper - joint.lower
    if joint.is_angle and abs(travel - span) <= alike * span:
        scale = travel / (high - low)
        return Column(joint.column, scale, joint.lower - scale * low)
    return _between(joint, low, high)


def _require_ranges(joints: Sequence[ServoJoint], servos: Servos) -> None:
    """Raise SceneError if nothing tells the ranges of normalised readings."""
    unknown = [one.column for one in joints if range_in_steps(one, servos.turn) is None]
    if unknown and not (servos.is_so or servos.is_dynamixel):
        raise SceneError(
            f"the readings of the joint log ({', '.join(unknown)}) seem to be normalised to -100 "
            "... 100, as in LeRobot, and their ranges are not known: put the robot's calibration "
            "file into the data set or name it (--joint-map FILE), or give units: rad, deg, or "
            "normalised for the joints' limits, or a joint map with the range of each: JOINT: "
            "{column: COLUMN, from: [-100, 100], to: [LOWEST, HIGHEST]} in radians"
        )


def is_gripper_name(words: Sequence[str]) -> bool:
    """Return whether a name, given by its words, is of a gripper's joint or opening."""
    return not {*words}.isdisjoint({"gripper", "finger", "fingers", "jaw", "claw", "knuckle"})


@dataclass(frozen=True)
class HomingCorrection:
    """A motor's corrected homing offset.

    Attributes:
        motor: name of the motor.
        before, after: homing offset in the file, and corrected [steps].
        shift: by how much its positions become larger [steps].
        reason: why it is not corrected; "": it is.
    """

    motor: str
    before: int
    after: int
    shift: int
    reason: str = ""


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

    The middle of the motor's range, where LeRobot reads 0, becomes the model's zero. The range
    stays: its ends are the same angles to both sides of the zero.

    Args:
        joint: the joint; its readings are not used.
        motor_name: name of the motor in the calibration file.
        column: the joint's column, as recorded.
        offset: the joint's offset, to be added to the recorded positions [rad].
        servos: the robot's motors.
        encoding: what the column holds.
        most_lost: largest correction [half the range]; beyond it the model's zero is another one
            than the motor's, as in a model whose limits are all on one side of 0.
    """
    motor, step = servos.motors[motor_name], 2.0 * math.pi / servos.turn
    before = motor.homing
    if joint.is_gripper:
        reason = "its readings are an opening of 0 to 100, not an angle"
        return HomingCorrection(motor_name, before, before, 0, reason)
    sign = -1.0 if motor.is_inverted and not servos.is_dynamixel and encoding != "deg" else 1.0
    if servos.has_lists:
        # Lists add their offset to what the motor counts, after inverting it.
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
    """Return a joint's line of a joint map [rad or m].

    Args:
        joint: name of the joint.
        column: its column.
        offset: added to its positions [rad or m].
    """
    scale, constant = float(column.scale), float(column.offset + offset)
    name = json.dumps(column.name)
    if column.ends is None:
        return f"{joint}: {{column: {name}, scale: {scale!r}, offset: {constant!r}}}\n"
    ends = [float(one) for one in column.ends]
    values = [scale * one + constant for one in ends]
    return f"{joint}: {{column: {name}, from: {ends}, to: {values}}}\n"
