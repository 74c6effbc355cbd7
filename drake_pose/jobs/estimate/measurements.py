"""Files of measured values: joint centres, angles to compare with or to start from, by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.models import Camera
from drake_pose.csv_files import read_csv
from drake_pose.errors import SceneError, SettingsError, UnknownNameError
from drake_pose.results.folder import BASE_COLUMNS, FIT_COLUMNS
from drake_pose.results.options import frame_number
from drake_pose.results.settings import EstimateSettings
from drake_pose.silhouette.pictures.scenes import Scene

_CENTRE_COLUMNS = ("frame", "joint", "x", "y", "z")


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
        number = frame_number(frame)
        return self.values.get(frame if number is None else number)


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


def _numbers(cells: Sequence[str], path: Path, line: int) -> np.ndarray:
    try:
        numbers = np.array([float(cell) for cell in cells])
    except ValueError:
        raise SceneError(f"{path}: line {line} holds something that is not a number") from None
    if not np.isfinite(numbers).all():
        raise SceneError(f"{path}: line {line} holds a number that is not finite")
    return numbers


def read_starts(
    scene: Scene,
    cameras: Sequence[Camera],
    frames: Sequence[str],
    model: ArticulatedModel,
    settings: EstimateSettings,
) -> dict[str, np.ndarray]:
    """The plant's positions (nq,) by frame, of ``settings.start``; all pictures are read once.

    Raises:
        SceneError: nothing says where the body is in the first frame, or a picture cannot be read.
        SettingsError: a start is given, or pictures without masks, where nothing is tracked.
    """
    starts = _read_start_rows(frames, model, settings)
    if starts and not (scene.sequence and settings.track):
        raise SettingsError(
            f"{scene.path}: --start is where a track begins, but the frames are not tracked: "
            "scene.yaml needs sequence: true"
        )
    names = [camera.name for camera in cameras]
    bare = [
        frame
        for frame in frames
        if scene.images and not any((name, frame) in scene.masks for name in names)
    ]
    if not bare:
        return starts
    if not settings.track:
        raise SettingsError(
            f"{scene.path}: frame '{bare[0]}' has pictures but no mask, which can only be tracked "
            "by colour: leave --no-track out, or make masks (drake-pose masks)"
        )
    first = frames[0]
    if first in bare and first not in starts:
        where = f"masks/{names[0]}/{first}.png"
        raise SceneError(
            f"{scene.path}: nothing says where the body is in the first frame, '{first}': add its "
            f"mask {where} (drake-pose masks makes one), or its joint positions (--start FILE.csv)"
        )
    for name, frame in scene.images:
        if name in names and frame in frames:
            scene.read_image(name, frame)
    return starts


def _read_start_rows(
    frames: Sequence[str], model: ArticulatedModel, settings: EstimateSettings
) -> dict[str, np.ndarray]:
    if settings.start is None:
        return {}
    known = read_true_angles(settings.start, model.position_names)
    places = [model.position_index(name) for name in known.names]
    starts = {}
    for frame in frames:
        values = known.of(frame)
        if values is not None:
            starts[frame] = model.default_positions.copy()
            starts[frame][places] = values
    if frames[0] not in starts:
        raise SceneError(
            f"{settings.start}: has no row of the first frame, '{frames[0]}', in which the track "
            "is to begin"
        )
    return starts
