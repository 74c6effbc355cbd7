"""Map the columns of a joint log to the joints of a model, and convert their units."""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.camera.episode import JointLog
from drake_pose.camera.models import check_number
from drake_pose.camera.servo_readings import (
    TURN,
    UNITS,
    Column,
    Encoding,
    JointReadings,
    Servos,
    are_whole,
    is_gripper_name,
    is_of_arm,
    is_of_servos,
    is_share,
    name_words,
    unit_columns,
)
from drake_pose.errors import CameraError, SceneError, SettingsError, require_known
from drake_pose.input_files import read_yaml


def map_joints(
    log: JointLog,
    names: Sequence[str],
    lower: Array,
    upper: Array,
    is_angle: Mask,
    *,
    followers: Collection[str] = (),
    units: str | None = None,
    table: Mapping[str, Column] | None = None,
    path: Path | None = None,
    slack: float = 0.1,
) -> JointLog:
    """Return a joint log in a model's names, order and units [rad or m].

    Args:
        log: the joint log, in its own names and units.
        names: (m,) joints of the model.
        lower, upper: (m,) their limits, infinite if there are none [rad or m].
        is_angle: (m,) whether a joint is revolute.
        followers: those of the joints that follow others; their columns are called like them.
        units: of angles that are not in ``table``; None: inferred, see `find_unit`.
        table: linear maps of some joints by name, as from `read_joint_map`; the columns of other
            joints are found by `match_names`. None: no maps are given.
        path: a table of positions: all its columns are joints, in radians and metres unless
            their readings tell other units; None: it is a robot's log.
        slack: tolerance of the limits of angles [rad], and of lengths [the limits' length].

    Returns the log; positions of joints that are not logged are nan. Readings outside the joints'
    limits are kept, with a warning.

    Raises:
        SceneError: no column is a joint, or the readings fit no unit.
        UnknownNameError: the table has an unknown joint or column.
        SettingsError: unknown units.
    """
    if units not in (None, *get_args(Encoding)):
        raise SettingsError(f"units must be {' or '.join(get_args(Encoding))}, not {units!r}")
    columns = dict(table or {})
    require_known("joint", columns, names, "the model, which the joint map is for,")
    used = {column.name: None for column in columns.values()}
    require_known("column", used, log.names, "the joint log")
    readings_of = dict(zip(log.names, log.positions.T, strict=True))
    free = {name: column for name, column in readings_of.items() if name not in used}
    wanted = [name for name in names if name not in columns]
    matched, warnings = _match(free, wanted, followers)
    if path is not None:
        unknown = [name for name in free if name not in matched]
        require_known("position", unknown, names, f"{path} has an unknown column; the model")
    if not (matched or columns):
        raise SceneError(
            f"no column of the joint log is a joint of the model: its columns are "
            f"{', '.join(log.names)}, the joints {', '.join(names)}; give a joint map "
            "(JOINT: {column: COLUMN})"
        )
    limits = {name: (low, high) for name, low, high in zip(names, lower, upper, strict=True)}
    angular = {name for name, turns in zip(names, is_angle, strict=True) if turns}
    servos = log.servos or Servos()
    motors = match_names([*free], [*servos.motors])[0] if servos.motors else {}
    joints = tuple(
        JointReadings(
            joint, column, free[column], *limits[joint], joint in angular,
            path is None and is_gripper_name(joint), servos.motors.get(motors.get(column, "")),
        )
        for column, joint in matched.items()
    )  # fmt: skip
    largest = float(np.fmax.reduce(np.abs([*free.values()]), axis=None, initial=0.0))
    usual: Encoding | None = None if path is None else "rad"
    found = None if units else find_unit(joints, log.servos, largest, usual, slack)
    unit, why = found or (cast(Encoding, units), "")
    own, texts = unit_columns(joints, log.servos, unit, slack)
    if is_of_servos(joints, log.servos, unit):
        warnings.append(_servo_warning(servos, unit, why))
    elif why:
        warnings.append(
            f"angles of the joint log are assumed to be in {unit}: {why}; if they are not, give "
            "the unit (--units)"
        )
    columns, warnings = columns | own, warnings + texts
    positions = np.full((len(log.positions), len(names)), np.nan)
    clipped = np.zeros(positions.shape, dtype=np.bool_)
    for k, joint in enumerate(names):
        if joint in columns:
            column = columns[joint]
            positions[:, k], clipped[:, k], anomalies = _positions(
                log, column, readings_of[column.name], limits[joint], is_angle[k], slack
            )
            warnings += [f"joint '{joint}': column '{column.name}' {text}" for text in anomalies]
    used |= {column.name: None for column in columns.values()}
    unused = [name for name in log.names if name not in used]
    if unused:
        warnings.append(f"columns of the joint log that are not joints: {', '.join(unused)}")
    return JointLog(
        tuple(names), log.times, positions, log.frames, log.servos, columns, joints,
        unit, clipped, tuple(warnings),
    )  # fmt: skip


def find_unit(
    joints: Sequence[JointReadings],
    servos: Servos | None,
    largest: float,
    usual: Encoding | None,
    slack: float,
    *,
    full_turn: float = 2.0 * math.pi,
    normalised: tuple[float, float] = (99.0, 100.001),
    most: float = 720.0,
    moves: float = 0.5,
) -> tuple[Encoding, str]:
    """Return the unit of all columns of angles, and the reason if it may be wrong.

    The joints' limits and what moves decide; names of columns are a hint. Readings within the
    limits as radians are radians if as degrees, or as LeRobot's -100 ... 100, the robot would
    hardly move. Readings are degrees if they are within the limits as degrees, and as radians
    exceed them by more than a full turn.

    Args:
        joints: the joints with their columns and motors. A gripper's readings are not regarded.
        servos: the robot's motors; None: LeRobot did not record the log.
        largest: largest magnitude of the readings of all columns whose unit is unknown.
        usual: the unit if readings do not tell it; None: there is none.
        slack: tolerance of the limits [rad].
        full_turn: minimum excess of degrees over the limits as radians [rad]. A joint without
            limits is assumed to stay within plus and minus twice this; with a usual unit it is
            ignored.
        normalised: a largest magnitude in this range, with the rounding of stored numbers, may be
            that of normalised readings.
        most: maximum magnitude of degrees, two turns [deg]; larger readings are steps.
        moves: minimum range of a column's readings [rad] of a robot that moves.

    Raises SceneError: the readings fit no unit, or several equally well.
    """
    angles = [one for one in joints if one.is_angle]
    body = [
        one
        for one in [one for one in angles if not one.is_gripper] or angles
        if np.isfinite(one.readings).any() and (usual is None or one.upper - one.lower < math.inf)
    ]
    if not body:
        return usual or "rad", ""
    known, is_named = servos or Servos(), any(one.column.endswith(".pos") for one in body)
    is_arm, (least, full) = is_of_arm(body, known), normalised
    excess = {unit: [one.excess(UNITS[unit], 2.0 * full_turn) for one in body] for unit in UNITS}
    in_rad, in_deg = (max(excess[unit]) <= slack for unit in ("rad", "deg"))
    is_moved = max(high - low for low, high in (one.ends for one in body)) > moves
    size = max(abs(end) for one in body for end in one.ends)
    if in_rad and not (is_named or is_arm):
        is_doubtful = usual is None and max(excess["deg"]) <= 0.0 and not is_moved
        return "rad", "but as degrees they would be within the limits, too" * is_doubtful
    if size > most and servos is not None:
        # Only homed motors count below 0, or beyond a turn.
        first, last = (-1, 2) if all(one.motor for one in body) else (0, 1)
        if all(first * TURN <= end <= last * TURN for one in body for end in one.ends):
            return "steps", f"they are up to {size:.0f}"
    if size <= full and (is_named or is_arm):
        unit, why = _servo_unit(body)
        if in_rad and is_moved and why.startswith("but") and not (is_named and is_arm):
            return "rad", "as degrees or -100 ... 100 the robot would hardly move"
        lacking = [one for one in body if one.steps is None]
        is_known = not lacking or known.is_so or known.is_dynamixel
        if unit == "normalised" and not (is_known and not (in_rad and why.startswith("but"))):
            fitting = ["radians"] * in_rad + ["degrees"] * in_deg
            what = "seem to be normalised to -100 ... 100, as in LeRobot"
            what += f" (or could be {' or '.join(fitting)})" if fitting else ""
            raise _refusal(
                lacking or body, what + ", and their ranges are not known" * (not is_known)
            )
        if unit == "normalised" or is_arm or in_deg:
            return unit, why
    elif size > full and is_arm:
        return "deg", f"the largest is {size:.4g}, not within -100 ... 100"
    elif in_deg and max(excess["rad"]) > full_turn:
        _refuse_mixed([one for one in body if one.excess(1.0) > slack], body, moves)
        if not least <= largest <= full:
            return "deg", "only as degrees all are within the limits"
    if usual is not None:
        return usual, ""
    if least <= largest <= full:
        raise _refusal(body, "seem to be normalised to -100 ... 100, as in LeRobot")
    worst = body[int(np.argmax(excess["rad"]))]
    raise _refusal(
        body,
        "are not all within the joints' limits as radians ('{}' is {:.4g} to {:.4g}, its joint's "
        "limits are {:.4g} to {:.4g}), and not clearly degrees".format(
            worst.column, *worst.ends, worst.lower, worst.upper
        ),
    )


def _refusal(body: Iterable[JointReadings], what: str) -> SceneError:
    """Return the error that readings of these joints have no clear unit."""
    return SceneError(
        f"the readings of the joint log ({', '.join(one.column for one in body)}) {what}: give "
        "units (--units rad, deg, normalised for the joints' limits, or steps), put the robot's "
        "calibration file into the data set or name it (--joint-map FILE), or give a joint map "
        "with the range of each: JOINT: {column: COLUMN, from: [-100, 100], to: [LOWEST, HIGHEST]} "
        "in radians"
    )


def _refuse_mixed(
    in_degrees: Sequence[JointReadings], body: Sequence[JointReadings], moves: float
) -> None:
    """Raise SceneError if most joints would move by a few degrees about 0, unlike others.

    ``in_degrees``: joints whose readings are not radians. ``moves``: see `find_unit`.
    """
    spans = [(one, one.ends[1] - one.ends[0]) for one in body if one not in in_degrees]
    others = ", ".join(one.column for one, span in spans if span > moves)
    if 2 * sum(span > moves for _, span in spans) > len(body):
        raise SceneError(
            f"the joint log's columns {', '.join(one.column for one in in_degrees)} are in "
            f"degrees, but {others} seem to be in radians: give units: deg if all are in degrees, "
            f"or a joint map: JOINT: {{column: {in_degrees[0].column}, unit: deg}}"
        )


def _servo_unit(body: Sequence[JointReadings]) -> tuple[Encoding, str]:
    """Return the unit of servos' readings of at most 100, "deg" or "normalised", and the reason.

    Encoders count in whole steps: a unit is right if readings are whole steps in it alone.

    ``body``: joints with readings.
    """
    # The middle of a range may be half a step.
    if are_whole([2.0 * (TURN - 1) / 360.0 * one.readings for one in body]):
        return "deg", "only as degrees they are whole steps of an encoder"
    if are_whole([(one.readings + 100.0) * one.steps / 200.0 for one in body if one.steps]):
        return "normalised", "only as -100 ... 100 of its range they are whole steps of an encoder"
    for one in body:
        if one.motor is not None and math.isfinite(one.motor.high):
            half = 180.0 * (one.motor.high - one.motor.low) / TURN
            if max(-one.ends[0], one.ends[1]) > half + 2.0:
                return "normalised", f"as degrees '{one.column}' would leave its range"
    if any((np.abs(one.readings) == 100.0).any() for one in body):
        return "normalised", "some are -100 or 100 exactly"
    return "normalised", "but they could be degrees, too"


def _servo_warning(servos: Servos, unit: Encoding, why: str) -> str:
    """Return the warning that readings are taken for those of LeRobot's motors in a unit."""
    source = "no calibration file of the robot is in or beside the data set"
    source += f", so {TURN // 2} is taken for zero" if unit == "steps" else ""
    source = f"their ranges are those of {servos.path}" if servos.path else source
    what = {
        "normalised": "LeRobot's -100 ... 100 of the motors' ranges",
        "deg": "LeRobot's degrees",
        "steps": f"encoder steps, {TURN} a turn",
    }[unit]
    return (
        f"readings of the joint log are taken to be {what}{': ' if why else ''}{why}; {source}; "
        "zeros set by hand are off by several degrees: estimate them (--zeros all)"
    )


def motors_of(log: JointLog) -> list[tuple[JointReadings, str]]:
    """Return the joints of a log that have a motor in the calibration, each with its name."""
    servos = log.servos or Servos()
    pairs = match_names([joint.column for joint in log.readings], [*servos.motors])[0]
    used = [one for one in log.readings if one.column in pairs and one.name in log.columns]
    return [(one, pairs[one.column]) for one in used]


def _match(
    readings: Mapping[str, Array], names: Sequence[str], followers: Collection[str]
) -> tuple[dict[str, str], list[str]]:
    """Match columns to joints by `match_names`, or by the order of LeRobot's arms.

    If no column matches, a last column that can be a gripper's opening is left out. ``readings``:
    (n,) by column. ``followers``: those of ``names`` whose columns have the same words. Returns the
    joint of each matched column, and warnings.
    """
    wanted = [name for name in names if name not in followers]
    following = {
        column: name
        for name in names
        for column in readings
        if name in followers and column not in wanted
        if column == name or (name not in readings and name_words(column) == name_words(name))
    }
    readings = {column: own for column, own in readings.items() if column not in following}
    matched, warnings = match_names([*readings], wanted)
    *series, last = readings or ("",)
    if not matched and is_share(readings.get(last, np.zeros(0))):
        matched, warnings = match_names(series, wanted)
    matched |= following
    ordered = _in_order(readings, wanted)
    if len(ordered) > len(matched) and matched.items() <= ordered.items():
        pairings = ", ".join(f"{a} for {b}" for a, b in ordered.items())
        return ordered, [
            "the columns have the names of LeRobot's arms, the joints others: they are matched in "
            f"order ({pairings}); the model's zeros and signs must be LeRobot's"
        ]
    return matched, warnings


def _in_order(columns: Iterable[str], joints: Sequence[str]) -> dict[str, str]:
    """Return the joint of each column of an SO-100, SO-101 or Koch arm, by their order.

    The mapping is empty unless the columns have the names of a single arm, and there are as many
    joints, with or without the gripper.
    """
    names = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    ends = [name.split("_") for name in names]
    matches = [
        [column for column in columns if name_words(column)[-len(end) :] == end] for end in ends
    ]
    if len(joints) not in (5, 6) or any(len(own) != 1 for own in matches):
        return {}
    return dict(zip((own[0] for own in matches), joints, strict=False))


def match_names(logged: Sequence[str], wanted: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Match logged names to the wanted ones, and return warnings about guesses.

    Names match if they differ only in case, separators, a leading k or a final "joint"; then if one
    name ends with the other. If a log has numbered names that are not the model's, they are matched
    to the model's free joints in order, if there are as many of these, or as many with numbered
    names that begin alike.

    ``logged``: names of the log's columns. ``wanted``: names of the model's joints. Returns the
    wanted name of each matched logged name, and the warnings.
    """
    matched = {name: name for name in logged if name in wanted}
    guesses: dict[str, str] = {}
    for is_match in (lambda a, b: a == b, _is_suffix):
        unmatched = [name for name in logged if name not in matched]
        free = [name for name in wanted if name not in matched.values()]
        pairs = [(a, b) for a in unmatched for b in free if is_match(name_words(a), name_words(b))]
        for a, b in pairs:
            if sum(a == c for c, _ in pairs) == 1 and sum(b == d for _, d in pairs) == 1:
                matched[a] = b
                guesses |= {a: b} if is_match is _is_suffix else {}
    starts_of = {
        name: found[1]
        for name in (*logged, *wanted)
        if (found := re.fullmatch(r"(.*?)[_\-. ]?(\d+)", name.removesuffix(".pos")))
    }
    series = [name for name in logged if name in starts_of and not {*wanted} <= {*logged}]
    starts = {starts_of[name] for name in series}
    if len(series) > 1 and len(starts) == 1 and any(name not in matched for name in series):
        # Names of a series count from 0 or 1: joint_1 of joint_0 to joint_6 is the model's joint2.
        matched = {a: b for a, b in matched.items() if a not in series}
        guesses = {a: b for a, b in guesses.items() if a not in series}
        free = [name for name in wanted if name not in matched.values()]
        if len(free) != len(series):
            # The model's own numbered names, such as panda_joint1 to panda_joint7 beside a gripper.
            begin = [starts_of.get(name) for name in free]
            fitting = [one for one in {*begin} - {None} if begin.count(one) == len(series)]
            free = [a for a, b in zip(free, begin, strict=True) if fitting == [b]]
        if len(free) == len(series):
            inorder = sorted(series, key=lambda name: int(name_words(name)[-1]))
            guesses |= dict(zip(inorder, free, strict=True))
            matched |= guesses
    if not guesses:
        return matched, []
    pairings = ", ".join(f"{a} for {b}" for a, b in guesses.items())
    return matched, [f"columns of the joint log are matched by similar names: {pairings}"]


def _is_suffix(a: Sequence[str], b: Sequence[str]) -> bool:
    """Return whether one of two names, as words, ends with all words of the other.

    If the shorter name has numbers only, the result is False.
    """
    short, long = sorted((a, b), key=len)
    return any(word.isalpha() for word in short) and long[-len(short) :] == short


def _positions(
    log: JointLog,
    column: Column,
    readings: Array,
    limits: tuple[float, float],
    is_angle: bool,
    slack: float,
    at_end: float = 1e-6,
) -> tuple[Array, Mask, list[str]]:
    """Return a joint's positions (rows,), whether readings are clipped (rows,), and anomalies.

    Anomalies are the ends of warnings. Positions of a revolute joint without limits are unwrapped
    in a log with times.

    ``log``: the log. ``column``: the column's linear map and range. ``readings``: (rows,) its
    readings. ``limits``: lower and upper limit of the joint [rad or m]; infinite: none.
    ``is_angle``: whether the joint is revolute. ``slack``: tolerance of the limits [rad; for
    lengths the range of the limits]. ``at_end``: maximum distance of a clipped reading from an end
    of its range [the range].
    """
    positions, anomalies = column.scale * readings + column.offset, list[str]()
    clipped = np.zeros(len(readings), dtype=np.bool_)
    if column.ends is not None:
        low, high = sorted(column.ends)
        near = at_end * (high - low)
        clipped = (np.abs(readings - low) <= near) | (np.abs(readings - high) <= near)
        if beyond := int(((readings < low - near) | (readings > high + near)).sum()):
            anomalies.append(
                f"has {beyond} of {len(readings)} readings outside the joint map's range {low:g} "
                f"... {high:g}"
            )
    lower, upper = limits
    if not math.isfinite(upper - lower) or not len(positions):
        if is_angle and log.times is not None:
            # Unwrap: interpolation between readings at +-180 degrees must not pass through 0.
            is_known = np.isfinite(positions)
            positions[is_known] = np.unwrap(positions[is_known])
        return positions, clipped, anomalies
    room = slack if is_angle else slack * (upper - lower)
    excess = np.nan_to_num(np.maximum(lower - positions, positions - upper), nan=-np.inf)
    row = int(np.argmax(excess))
    if excess[row] > room:
        where, value = f"frame {log.frames[row]}" if log.frames else f"row {row}", positions[row]
        turned = value - math.copysign(2.0 * math.pi, value)
        why = "is it the wrong column, offset, sign or unit?"
        if is_angle and lower - room <= turned <= upper + room:
            why = (
                f"a full turn off, {turned:.4g}, it would not: does the encoder count a turn too "
                "many, or are angles in degrees?"
            )
        anomalies.append(
            f"gives {value:.4g} {'rad' if is_angle else 'm'} in {where}, outside the joint's "
            f"limits {lower:.4g} to {upper:.4g}: {why}"
        )
    return positions, clipped, anomalies


def read_joint_map(path: Path) -> dict[str, Column]:
    """Return the linear map of each joint in a joint map, a YAML file, by the joint's name.

    An entry has `column` (default: the joint's name) and either `from` and `to` (two readings and
    the positions there [rad or m]), or `scale` and `offset` (position = scale * reading + offset),
    or `unit` (rad, deg, m, mm).

    Raises SceneError: names the file, the joint and the field at fault.
    """
    content = read_yaml(path, SceneError)
    if not isinstance(content, dict) or not content:
        raise SceneError(f"{path}: expected a mapping from joints to their columns")
    units, columns = {**UNITS, "m": 1.0, "mm": 1e-3}, dict[str, Column]()
    ways = [{"from", "to"}, {"scale", "offset"}, {"scale"}, {"offset"}, {"unit"}, set[str]()]
    for joint, entry in content.items():
        where = f"{path}: joint '{joint}'"
        given = set(entry) - {"column"} if isinstance(entry, dict) else {None}
        if given not in ways:
            known = " or ".join("{" + ", ".join(sorted(map(str, way))) + "}" for way in ways if way)
            raise SceneError(f"{where}: expected {{column: NAME}} and one of {known}")
        name, unit = str(entry.get("column", joint)), entry.get("unit", "rad")
        if unit not in units:
            raise SceneError(f"{where}: unit must be one of {', '.join(units)}")
        try:
            if "from" in given:
                (a, b), (c, d) = (_pair(entry[end], end, where) for end in ("from", "to"))
                scale = (d - c) / (b - a)
                columns[str(joint)] = Column(name, scale, c - scale * a, (a, b))
                continue
            scale = check_number(entry.get("scale", units[unit]), "scale", where)
            offset = check_number(entry.get("offset", 0.0), "offset", where)
            columns[str(joint)] = Column(name, scale, offset)
        except CameraError as error:
            raise SceneError(str(error)) from None
    return columns


def _pair(value: Any, field: str, where: str) -> tuple[float, float]:
    """Return a file's list of two different numbers; CameraError (``where``): it is none."""
    low, high = value if isinstance(value, list) and len(value) == 2 else (0.0, 0.0)
    low, high = (check_number(one, field, where) for one in (low, high))
    if low == high:
        raise CameraError(f"{where}: {field} must be two different numbers, [LOWEST, HIGHEST]")
    return low, high
