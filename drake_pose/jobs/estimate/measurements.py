"""Files of measured values: joint centres by frame, and joint angles to compare with."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drake_pose.errors import SceneError, UnknownNameError
from drake_pose.regular_files import read_regular
from drake_pose.results.folder import BASE_COLUMNS, FIT_COLUMNS
from drake_pose.results.options import frame_number

_CENTRE_COLUMNS = ("frame", "joint", "x", "y", "z")


@dataclass(frozen=True)
class TrueAngles:
    """Joint positions that were measured by other means.

    Args:
        path: the file they are from.
        names: the positions that were measured.
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
        number = frame_number(frame)
        return self.values.get(frame if number is None else number)


def read_joint_centres(path: Path, joint: str, frames: Sequence[str]) -> dict[str, np.ndarray]:
    """Reads where a joint is in each frame from a file of `frame,joint,x,y,z` rows.

    Frames are compared as numbers: the row of frame 3 is that of ``0003.png``.

    Args:
        path: the file.
        joint: the joint.
        frames: the frames that are needed.

    Returns:
        (3,) position in the world by frame [m].

    Raises:
        SceneError: if the file cannot be read, or a frame has no row.
        UnknownNameError: if no row is of that joint.
    """
    header, rows = _read_csv(path)
    if header != list(_CENTRE_COLUMNS):
        raise SceneError(f"{path}: the first line must be {','.join(_CENTRE_COLUMNS)}")
    by_number: dict[int, np.ndarray] = {}
    joints = sorted({row[1] for _, row in rows})
    if joint not in joints:
        raise UnknownNameError("joint", joint, joints, str(path))
    for line, row in rows:
        if row[1] == joint:
            numbers = _numbers([row[0], *row[2:]], path, line)
            by_number[int(numbers[0])] = numbers[1:]
    positions = {}
    for frame in frames:
        number = frame_number(frame)
        if number is None or number not in by_number:
            raise SceneError(
                f"{path}: has no row of joint '{joint}' in frame '{frame}'; leave that frame out "
                "(--frame), or take another joint that is known there"
            )
        positions[frame] = by_number[number]
    return positions


def read_true_angles(path: Path, position_names: Sequence[str]) -> TrueAngles:
    """Reads measured joint positions from a file with the columns `frame` and positions' names.

    Frames are compared as numbers where they are numbers: the row of frame 3 is that of
    ``0003.png``. The file may be the poses.csv of an estimate, of which rows without a pose are
    left out.

    Args:
        path: the file, values in rad or m.
        position_names: the model's positions.

    Raises:
        SceneError: if the file cannot be read, or gives a column or a frame twice.
        UnknownNameError: if the model has no position of a column's name.
    """
    header, rows = _read_csv(path)
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
        frame = _frame_key(row[0])
        if frame in values:
            raise SceneError(f"{path}: line {line}: frame '{row[0]}' is given twice")
        if is_estimate and row[last] in ("", "nan"):
            continue
        values[frame] = _numbers(row[1:end], path, line)
        if with_base:
            bases[frame] = _numbers(row[end:last], path, line)
    return TrueAngles(path, tuple(header[1:end]), values, bases, is_estimate)


def _frame_key(cell: str) -> int | str:
    """A frame's number, which a table may have written as 3.0, or its name."""
    number = frame_number(cell.removesuffix(".0"))
    return cell if number is None else number


def angle_difference(a: float, b: float) -> float:
    """Returns a - b, turned by full turns into -pi..pi [rad]."""
    return math.remainder(a - b, 2.0 * math.pi)


def _read_csv(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Returns the first line's columns, and each other line with its number."""
    try:
        text = read_regular(path).decode("utf-8-sig")
        reader = csv.reader(io.StringIO(text, newline=""))
        lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a CSV file"
        raise SceneError(f"{path}: cannot read it: {reason}") from error
    if not lines:
        raise SceneError(f"{path}: is empty")
    header = lines[0][1]
    for line, row in lines[1:]:
        if len(row) != len(header):
            raise SceneError(
                f"{path}: line {line} has {len(row)} columns, but the first has {len(header)}"
            )
    return header, lines[1:]


def _numbers(cells: Sequence[str], path: Path, line: int) -> np.ndarray:
    try:
        numbers = np.array([float(cell) for cell in cells])
    except ValueError:
        raise SceneError(f"{path}: line {line} holds something that is not a number") from None
    if not np.isfinite(numbers).all():
        raise SceneError(f"{path}: line {line} holds a number that is not finite")
    return numbers
