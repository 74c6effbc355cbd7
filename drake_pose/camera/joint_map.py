"""Map the columns of a joint log to the joints of a model, and convert their units."""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any, get_args

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.camera.episode import JointLog
from drake_pose.camera.models import check_number
from drake_pose.camera.servo_readings import (
    Column,
    Encoding,
    ServoJoint,
    Servos,
    is_gripper_name,
    servo_columns,
    servo_encoding,
)
from drake_pose.errors import CameraError, SceneError, SettingsError, require_known
from drake_pose.input_files import read_yaml

UNITS = {"rad": 1.0, "deg": math.pi / 180.0}
"""Units of angles [rad]."""


@dataclass(frozen=True, eq=False)
class MappedJoints:
    """A joint log in the names, order and units of a model."""

    # Positions by the model's names and order [rad or m]; nan for joints that are not logged.
    log: JointLog
    # (n, m) whether a reading is at an end of its range, so that the joint is there or beyond.
    clipped: Mask
    not_logged: tuple[str, ...]  # Names of the model's joints without a column.
    warnings: tuple[str, ...]  # Assumptions that were made, and anomalies.
    columns: Mapping[str, Column]  # By name of each logged joint, the linear map from its column.
    # Of columns that LeRobot recorded from servos; None: they are angles or lengths.
    encoding: Encoding | None = None
    joints: tuple[ServoJoint, ...] = ()  # The joints with such columns; empty for None.


def map_joints(
    log: JointLog,
    names: Sequence[str],
    lower: Array,
    upper: Array,
    is_angle: Mask,
    *,
    units: str | None = None,
    table: Mapping[str, Column] | None = None,
    slack: float = 0.1,
) -> MappedJoints:
    """Convert a joint log to a model's names, order and units.

    Args:
        log: the joint log, in its own names and units.
        names: (m,) joints of the model.
        lower, upper: (m,) their limits, infinite if there are none [rad or m].
        is_angle: (m,) whether a joint is revolute.
        units: of angles that are not in ``table``: "rad", "deg", or LeRobot's "normalised" or
            "steps"; None: inferred from readings and limits.
        table: linear maps of some joints by name, as from `read_joint_map`; the columns of other
            joints are found by `match_names`. None: no maps are given.
        slack: tolerance of the limits of angles [rad], and of lengths [the limits' length].

    Returns the mapped log. Readings outside the joints' limits are kept, with a warning.

    Raises:
        SceneError: no column is a joint, or the readings fit neither radians nor degrees.
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
    others = {name: column for name, column in readings_of.items() if name not in used}
    matched, warnings = _match(others, [name for name in names if name not in columns])
    if not (matched or columns):
        raise SceneError(
            f"no column of the joint log is a joint of the model: its columns are "
            f"{', '.join(log.names)}, the joints {', '.join(names)}; give a joint map "
            "(JOINT: {column: COLUMN})"
        )
    limits = {name: (low, high) for name, low, high in zip(names, lower, upper, strict=True)}
    angular = {name for name, turns in zip(names, is_angle, strict=True) if turns}
    servos = log.servos or Servos()
    joints = _servo_joints(matched, others, limits, angular, servos)
    encoding, texts = servo_encoding(joints, log.servos, units, slack)
    warnings += texts
    if encoding is not None:
        servo_maps, texts = servo_columns(joints, servos, encoding)
        columns, warnings = columns | servo_maps, warnings + texts
        taken = {joint.column for joint in joints}
        matched = {column: joint for column, joint in matched.items() if column not in taken}
    else:
        unit, is_mapped = UNITS.get(units or "rad", 1.0), bool(table)
        matched, texts = _without_openings(matched, others, limits, unit, slack, is_mapped)
        warnings += texts
    revolute = {column: joint for column, joint in matched.items() if joint in angular}
    if revolute and units is None:
        angles = {column: readings_of[column] for column in revolute}
        low, high = np.array([limits[joint] for joint in revolute.values()]).T
        units, why = _find_unit(angles, np.array([*others.values()]), low, high, slack)
        if why:
            warnings.append(
                f"angles of the joint log are assumed to be in {units}: {why}; if they are not, "
                "give the unit (units)"
            )
    scale = UNITS.get(units or "rad", 1.0)
    columns |= {j: Column(c, scale if c in revolute else 1.0) for c, j in matched.items()}
    positions = np.full((len(log.positions), len(names)), np.nan)
    clipped = np.zeros(positions.shape, dtype=np.bool_)
    for k, joint in enumerate(names):
        if joint in columns:
            column = columns[joint]
            positions[:, k], clipped[:, k], anomalies = _positions(
                column, readings_of[column.name], limits[joint], is_angle[k], slack
            )
            warnings += [f"joint '{joint}': column '{column.name}' {text}" for text in anomalies]
    missing = tuple(name for name in names if name not in columns)
    used_columns = {column.name for column in columns.values()}
    unused = [name for name in log.names if name not in used_columns]
    if missing:
        warnings.append(
            f"joints that are not logged: {', '.join(missing)}; hold them (--hold) or map columns "
            "to them (joint map)"
        )
    if unused:
        warnings.append(f"columns of the joint log that are not joints: {', '.join(unused)}")
    mapped = JointLog(tuple(names), log.times, positions, log.frames, log.servos)
    return MappedJoints(mapped, clipped, missing, tuple(warnings), columns, encoding, tuple(joints))


def without_followers(
    log: JointLog, followers: Mapping[str, Column], mapped: Collection[str] = ()
) -> JointLog:
    """Return a joint log without columns of followers of joints that have a column, too.

    followers: see `follower_warnings`. mapped: columns that a joint map names; they stay.
    """
    gone = {name for name, one in followers.items() if one.name in log.names}.difference(mapped)
    kept = [k for k, name in enumerate(log.names) if name not in gone]
    names = tuple(log.names[k] for k in kept)
    return replace(log, names=names, positions=log.positions[:, kept])


def follower_warnings(
    log: JointLog,
    columns: Mapping[str, Column],
    followers: Mapping[str, Column],
    ranges: Mapping[str, float],
    *,
    slack: float = 0.1,
) -> list[str]:
    """Return a warning of columns that contradict those of the joints that they follow.

    Args:
        log: the joint log.
        columns: by joint the linear map from its column. A column with the joint's own name, and
            without offset, is in the unit of its followers' columns; with others nothing is
            compared.
        followers: by a follower's name the linear map from its joint's position.
        ranges: upper minus lower limit of each joint [rad or m].
        slack: tolerance, the smaller of this [rad or m] and this fraction of the joint's range.
    """
    readings_of, off = dict(zip(log.names, log.positions.T, strict=True)), dict[str, float]()
    for name, one in followers.items():
        column = columns.get(one.name, Column(""))
        if name not in readings_of or (column.name, column.offset) != (one.name, 0.0):
            continue
        implied = one.scale * column.scale * readings_of[one.name] + one.offset
        differences = np.abs(column.scale * readings_of[name] - implied)
        worst = float(np.fmax.reduce(differences, initial=0.0))
        if worst > abs(one.scale) * min(slack, slack * ranges[one.name]):
            off[name] = worst
    if not off:
        return []
    name = max(off, key=lambda name: off[name])
    one, more = followers[name], [other for other in off if other != name]
    beside = f" (so do: {', '.join(more)})" if more else ""
    return [
        f"column '{name}' differs by up to {off[name]:.3g} [rad or m] from {one.scale:g} x "
        f"'{one.name}' {one.offset:+g}, which it follows in the model (<mimic>){beside}: parts are "
        "posed by the <mimic>, not by this column; if the column is right, poses and joint offsets "
        "are wrong: correct the model"
    ]


def motors_of(mapped: MappedJoints) -> list[tuple[ServoJoint, str]]:
    """Return the mapped joints that have a motor in the calibration, each with the motor's name."""
    servos = mapped.log.servos or Servos()
    pairs = match_names([joint.column for joint in mapped.joints], [*servos.motors])[0]
    used = [one for one in mapped.joints if one.column in pairs and one.name in mapped.columns]
    return [(one, pairs[one.column]) for one in used]


def _match(
    readings: Mapping[str, Array], wanted: Sequence[str]
) -> tuple[dict[str, str], list[str]]:
    """Match columns to joints by `match_names`, or by the order of LeRobot's arms.

    If no column matches, a last column that can be a gripper's opening is left out. ``readings``:
    (n,) by column. Returns the joint of each matched column, and warnings.
    """
    matched, warnings = match_names([*readings], wanted)
    *series, last = readings or ("",)
    if not matched and _is_opening(readings.get(last, np.zeros(0))):
        matched, warnings = match_names(series, wanted)
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
    matches = [[column for column in columns if _words(column)[-len(end) :] == end] for end in ends]
    if len(joints) not in (5, 6) or any(len(own) != 1 for own in matches):
        return {}
    return dict(zip((own[0] for own in matches), joints, strict=False))


def _servo_joints(
    matched: Mapping[str, str],
    readings: Mapping[str, Array],
    limits: Mapping[str, tuple[float, float]],
    angular: Collection[str],
    servos: Servos,
) -> list[ServoJoint]:
    """Return the matched joints that servos may move: revolute joints, and joints of grippers.

    ``matched``: joint by column. ``readings``: (n,) by column. ``limits``: lower and upper limit by
    joint [rad or m]. ``angular``: names of the revolute joints.
    """
    motors = match_names([*readings], [*servos.motors])[0] if servos.motors else {}
    return [
        ServoJoint(
            joint, column, readings[column], *limits[joint], joint in angular,
            is_gripper_name(_words(joint)), servos.motors.get(motors.get(column, "")),
        )
        for column, joint in matched.items()
        if joint in angular or is_gripper_name(_words(joint))
    ]  # fmt: skip


def _is_opening(readings: Array) -> bool:
    """Return whether readings (n,) can be a gripper's opening, 0 to 1."""
    known = readings[np.isfinite(readings)]
    return bool(known.size) and known.min() >= -0.001 and known.max() <= 1.001


def _without_openings(
    matched: Mapping[str, str],
    readings: Mapping[str, Array],
    limits: Mapping[str, tuple[float, float]],
    unit: float,
    slack: float,
    is_mapped: bool,
) -> tuple[dict[str, str], list[str]]:
    """Return the matched columns without a gripper's openings, which are not joint positions.

    Readings in 0 ... 1 may be an opening. A column of a gripper's joint is left out if:
    - its name is not a gripper's, and readings are in 0 ... 1 or beyond the joint's limits; or
    - its name is a gripper's, and readings are in 0 ... 1 and beyond the limits.

    ``matched``: joint by column. ``readings``: (n,) readings by column. ``limits``: lower and upper
    limit by joint [rad or m]. ``unit``: unit of the readings [rad]. ``slack``: tolerance of the
    limits, the smaller of this [rad or m] and this fraction of their range. ``is_mapped``: whether
    a joint map has other joints; then any gripper's column beyond the limits is left out.

    Returns the joint of each column that is kept, and warnings about the other columns.
    """
    kept, warnings = dict(matched), list[str]()
    for column, joint in matched.items():
        is_named = column == joint or is_gripper_name(_words(column))
        known = readings[column][np.isfinite(readings[column])]
        least, most = known.min(initial=0.0), known.max(initial=0.0)
        low, high = limits[joint]
        room = min(slack, slack * (high - low))
        is_within = low - room <= unit * least <= unit * most <= high + room
        is_wrong = not is_within and (_is_opening(known) or is_mapped or not is_named)
        is_guess = _is_opening(known) and not is_named
        if is_gripper_name(_words(joint)) and (is_wrong or is_guess):
            del kept[column]
            warnings.append(
                f"column '{column}' of the joint log, {least:.3g} to {most:.3g}, is not taken for "
                f"joint '{joint}' ({low:.3g} to {high:.3g}): it seems to be a gripper's opening; "
                f"map it if it is known ({joint}: {{column: {column}, from: [0, 1], to: [OPEN, "
                "CLOSED]})"
            )
    return kept, warnings


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
        pairs = [(a, b) for a in unmatched for b in free if is_match(_words(a), _words(b))]
        for a, b in pairs:
            if sum(a == c for c, _ in pairs) == 1 and sum(b == d for _, d in pairs) == 1:
                matched[a] = b
                guesses |= {a: b} if is_match is _is_suffix else {}
    starts_of = {
        name: found[1]
        for name in (*logged, *wanted)
        if (found := re.fullmatch(r"(.*?)[_\-. ]?(\d+)", name))
    }
    series = [name for name in logged if name in starts_of]
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
            inorder = sorted(series, key=lambda name: int(_words(name)[-1]))
            guesses |= dict(zip(inorder, free, strict=True))
            matched |= guesses
    if not guesses:
        return matched, []
    pairings = ", ".join(f"{a} for {b}" for a, b in guesses.items())
    return matched, [f"columns of the joint log are matched by similar names: {pairings}"]


def _words(name: str) -> list[str]:
    """Return the words in lower case and the numbers of a name, without affixes.

    Affixes are a k before a capital letter, and the last words "joint" and "pos".
    """
    words = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)]
    if len(words) > 1 and re.match("k[A-Z]", name):
        words = words[1:]
    while len(words) > 1 and words[-1] in ("joint", "pos"):
        words = words[:-1]
    return words


def _is_suffix(a: Sequence[str], b: Sequence[str]) -> bool:
    """Return whether one of two names a, b, given by `_words`, ends with all words of the other.

    If the shorter name has numbers only, the result is False.
    """
    short, long = sorted((a, b), key=len)
    return any(word.isalpha() for word in short) and long[-len(short) :] == short


def _find_unit(
    readings: Mapping[str, Array],
    others: Array,
    lower: Array,
    upper: Array,
    slack: float,
    *,
    full_turn: float = 2.0 * math.pi,
    normalised: tuple[float, float] = (99.0, 100.001),
    moves: float = 0.5,
) -> tuple[str, str]:
    """Return the unit of columns of angles, "rad" or "deg", and the reason if it may be wrong.

    Readings within the limits as radians are radians. Otherwise they are degrees if they are within
    the limits as degrees, and as radians exceed them by more than a full turn.

    ``readings``: readings (rows,) of the n columns of revolute joints, by name. ``others``: (k,
    rows) readings of all columns whose units are unknown, including these. ``lower``, ``upper``:
    (n,) limits of each column's joint [rad]. ``slack``: tolerance of the limits [rad].
    ``full_turn``: maximum excess over the limits of readings in radians [rad]. A joint without
    limits is assumed to stay within plus and minus twice this. ``normalised``: if the largest
    magnitude of ``others`` is in this range, or a column's name ends in ".pos", LeRobot may have
    normalised the readings to -100 ... 100. ``moves``: range of a column's readings above which
    readings that may be radians are radians: as degrees the robot would stand still.

    Raises SceneError: the readings fit neither radians nor degrees, or seem to be normalised.
    """
    low, high = np.maximum(lower, -2.0 * full_turn), np.minimum(upper, 2.0 * full_turn)
    # fmin and fmax ignore missing readings (nan).
    minima, maxima = (f.reduce(list(readings.values()), axis=1) for f in (np.fmin, np.fmax))
    excess = {k: np.fmax(low - one * minima, one * maxima - high) for k, one in UNITS.items()}
    worst = {unit: float(np.fmax.reduce(column)) for unit, column in excess.items()}
    largest = np.fmax.reduce(np.abs(others), axis=None)
    k = int(np.argmax(np.nan_to_num(excess["rad"])))
    column = list(readings)[k]
    reason = (
        f"are not all within the joints' limits as radians ('{column}' is {minima[k]:.4g} to "
        f"{maxima[k]:.4g}, its joint's limits are {lower[k]:.4g} to {upper[k]:.4g}), and not "
        "clearly degrees"
    )
    is_named = any(name.endswith(".pos") for name in readings)
    if is_named or normalised[0] <= largest <= normalised[1]:
        reason = "seem to be normalised to -100 ... 100, as in LeRobot"
    elif worst["rad"] <= slack:
        doubtful = worst["deg"] <= 0.0 and np.fmax.reduce(maxima - minima) <= moves
        return "rad", "but as degrees they would be within the limits, too" if doubtful else ""
    elif worst["deg"] <= slack and worst["rad"] > full_turn:
        in_degrees = excess["rad"] > slack
        in_radians = ~in_degrees & (maxima - minima > moves)
        if 2 * np.count_nonzero(in_radians) > len(readings):
            # Most joints would move by a few degrees about 0.
            one = next(iter(compress(readings, in_degrees)))
            raise SceneError(
                f"the joint log's columns {', '.join(compress(readings, in_degrees))} are in "
                f"degrees, but {', '.join(compress(readings, in_radians))} seem to be in radians: "
                f"give units: deg if all are in degrees, or a joint map: JOINT: {{column: {one}, "
                "unit: deg}"
            )
        return "deg", "only as degrees all are within the limits"
    raise SceneError(
        f"the readings of the joint log ({', '.join(readings)}) {reason}: give units: rad or deg, "
        "or a joint map with the range of each: JOINT: {column: COLUMN, from: [-100, 100], "
        "to: [LOWEST, HIGHEST]} in radians"
    )


def _positions(
    column: Column,
    readings: Array,
    limits: tuple[float, float],
    is_angle: bool,
    slack: float,
    at_end: float = 1e-6,
) -> tuple[Array, Mask, list[str]]:
    """Return a joint's positions (rows,), whether readings are clipped (rows,), and anomalies.

    Anomalies are the ends of warnings. Positions of a revolute joint without limits are unwrapped.

    ``column``: the column's linear map and range. ``readings``: (rows,) readings [unit of the log].
    ``limits``: lower and upper limit of the joint [rad or m]; infinite: none. ``is_angle``: whether
    the joint is revolute. ``slack``: tolerance of the limits [rad; for lengths the range of the
    limits]. ``at_end``: maximum distance of a clipped reading from an end of its range [the range].
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
    if not math.isfinite(upper - lower):
        # Unwrap: interpolation between readings at +-180 degrees must not pass through 0.
        is_known = np.isfinite(positions)
        positions[is_known] = np.unwrap(positions[is_known]) if is_angle else positions[is_known]
        return positions, clipped, anomalies
    excess = np.nan_to_num(np.maximum(lower - positions, positions - upper), nan=-np.inf)
    row = int(np.argmax(excess))
    if excess[row] > (slack if is_angle else slack * (upper - lower)):
        anomalies.append(
            f"gives {positions[row]:.4g} in row {row}, outside the joint's limits {lower:.4g} to "
            f"{upper:.4g}: is it the wrong column, offset, sign or unit?"
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
