"""Files of measured values: joint centres, angles to compare with or to start from, by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drake_pose.body import ParsedModel
from drake_pose.camera.picture_files import frame_key
from drake_pose.csv_files import read_csv
from drake_pose.errors import SceneError, UnknownNameError
from drake_pose.files.records import BASE_COLUMNS, FIT_COLUMNS

_CENTRE_COLUMNS = ("frame", "joint", "x", "y", "z")

# A value is outside its limits from so much on [rad], or from this share of a length's range.
_OUTSIDE, _OUTSIDE_SHARE = 0.1, 0.1
# An angle of more than a full turn beyond its limits is one in degrees; a length of so many times
# what its limits allow is one in millimetres.
_FULL_TURN, _MANY = 2.0 * math.pi, 20.0
# And none is larger than this [rad or m].
_MOST = 1e6


@dataclass(frozen=True)
class TrueAngles:
    """Joint positions of a file that were measured by other means.

    Args:
        values: (len(names),) [rad or m] by frame: its number, or its name if that is none.
        bases: (7,) BASE_COLUMNS by frame, of an estimate whose base moved.
        is_estimate: whether they are the poses.csv of an estimate.
    """

    path: Path
    names: tuple[str, ...]
    values: Mapping[int | str, np.ndarray]
    bases: Mapping[int | str, np.ndarray] = field(default_factory=dict)
    is_estimate: bool = False

    def of(self, frame: str) -> np.ndarray | None:
        """Returns the values of a frame, or None where nothing was measured."""
        return self.values.get(frame_key(frame))


def read_joint_centres(path: Path, joint: str, frames: Sequence[str]) -> dict[str, np.ndarray]:
    """Where a joint is in each frame (3,) [m], from a file of `frame,joint,x,y,z` rows.

    Frames are compared as numbers: the row of frame 3 is that of ``0003.png``.

    Raises:
        SceneError: if the file cannot be read, or a frame has no row.
        UnknownNameError: if no row is of that joint.
    """
    header, rows = read_csv(path, SceneError)
    if header != list(_CENTRE_COLUMNS):
        raise SceneError(f"{path}: the first line must be {','.join(_CENTRE_COLUMNS)}")
    joints = sorted({row[1] for _, row in rows})
    if joint not in joints:
        raise UnknownNameError("joint", joint, joints, str(path))
    known: dict[int | str, np.ndarray] = {}
    for line, row in rows:
        if row[1] == joint:
            if frame_key(row[0]) in known:
                raise SceneError(f"{path}: line {line}: frame '{row[0]}' is given twice")
            known[frame_key(row[0])] = _numbers(row[2:], path, line)
    for frame in frames:
        if frame_key(frame) not in known:
            raise SceneError(
                f"{path}: has no row of joint '{joint}' in frame '{frame}'; leave that frame out "
                "(--frame), or take another joint that is known there"
            )
    return {frame: known[frame_key(frame)] for frame in frames}


def read_true_angles(path: Path, position_names: Sequence[str]) -> TrueAngles:
    """Measured joint positions [rad or m] of a file with columns `frame` and positions' names.

    Frames are compared as numbers where they are numbers: the row of frame 3 is that of
    ``0003.png``. Of an estimate's poses.csv rows without a pose are left out.

    Raises:
        SceneError: if the file cannot be read, or gives a column or a frame twice.
        UnknownNameError: if the model has no position of a column's name.
    """
    header, rows = read_csv(path, SceneError)
    if len(header) < 2 or header[0] != "frame":
        raise SceneError(f"{path}: the first line must be frame, then names of positions")
    is_estimate = tuple(header[-2:]) == FIT_COLUMNS
    last = len(header) - len(FIT_COLUMNS) if is_estimate else len(header)
    with_base = is_estimate and tuple(header[last - len(BASE_COLUMNS) : last]) == BASE_COLUMNS
    end = last - len(BASE_COLUMNS) if with_base else last
    for name in header[1:end]:
        if name not in position_names:
            raise UnknownNameError(
                "position", name, position_names, f"{path} has a column that the model lacks; it"
            )
        if header.count(name) > 1:
            raise SceneError(f"{path}: has the column '{name}' twice")
    values: dict[int | str, np.ndarray] = {}
    bases: dict[int | str, np.ndarray] = {}
    for line, row in rows:
        frame = frame_key(row[0])
        if frame in values:
            raise SceneError(f"{path}: line {line}: frame '{row[0]}' is given twice")
        if is_estimate and row[last] in ("", "nan"):
            continue
        values[frame] = _numbers(row[1:end], path, line)
        if with_base:
            bases[frame] = _numbers(row[end:last], path, line)
    return TrueAngles(path, tuple(header[1:end]), values, bases, is_estimate)


def check_units(
    path: Path,
    model: ParsedModel,
    names: Sequence[str],
    known: Mapping[int | str, np.ndarray],
) -> tuple[str, ...]:
    """Warnings of measured positions outside their limits.

    Args:
        path: of the table.
        names: of the model's positions.
        known: (len(names),) values by frame [rad or m].

    Raises:
        SceneError: values are in degrees or millimetres, or no joint's positions at all.
    """
    warnings = []
    for frame, row in known.items():
        for name, value in zip(names, row, strict=True):
            if abs(value) > _MOST:
                raise SceneError(
                    f"{path}: column '{name}', frame {frame}: {value:g} is no joint's position; "
                    "give it in rad or m"
                )
    for k, name in enumerate(names if known else ()):
        place = model.position_index(name)
        lower, upper = model.lower[place], model.upper[place]
        if not np.isfinite([lower, upper]).all():
            continue
        values = np.array([row[k] for row in known.values()])
        what, unit, other, scale = "length", "m", "metres", 1e-3
        slack, most = _OUTSIDE_SHARE * (upper - lower), _MANY * max(abs(lower), abs(upper))
        if is_angle := model.position_kinds[place] == "angle":
            what, unit, other, scale = "angle", "rad", "radians", math.pi / 180.0
            slack, most = _OUTSIDE, max(abs(lower), abs(upper)) + _FULL_TURN + _OUTSIDE
        off = np.maximum(lower - values, values - upper)
        worst = int(np.argmax(off))
        if off[worst] <= slack:
            continue
        text = (
            f"{path}: column '{name}', frame {list(known)[worst]}: {values[worst]:g} {unit} "
            f"lies outside the joint's limits, {lower:.4g} to {upper:.4g} {unit}"
        )
        scaled = scale * values
        inside = (lower - slack <= scaled) & (scaled <= upper + slack)
        if np.abs(values).max() > most and inside.all():
            wrong = "degrees" if unit == "rad" else "millimetres"
            raise SceneError(
                f"{text}, but not in {wrong}: the file seems to be in {wrong}; write every {what} "
                f"in {other}"
            )
        why = ": is its column another joint's, its zero or sign another, its unit another?"
        turn = math.copysign(_FULL_TURN, values[worst])
        if is_angle and lower - slack <= values[worst] - turn <= upper + slack:
            why = (
                f"; a full turn off, {values[worst] - turn:.4g} rad, it would not: did the encoder "
                "count a turn too many, or are the column's angles in degrees?"
            )
        warnings.append(f"{text}{why}")
    return tuple(warnings)


def _numbers(cells: Sequence[str], path: Path, line: int) -> np.ndarray:
    try:
        numbers = np.array([float(cell) for cell in cells])
    except ValueError:
        raise SceneError(f"{path}: line {line} holds something that is not a number") from None
    if not np.isfinite(numbers).all():
        raise SceneError(f"{path}: line {line} holds a number that is not finite")
    return numbers
