"""The result folder: tables of poses and joints, files of motion, pages, overlays, a summary.

Frames are written one by one, other files moved into place: none is ever half there.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from drake_pose.errors import OutputError

POSES = "poses.csv"
JOINTS = "joints.csv"
FAMILIES = "families.csv"
SUMMARY = "summary.json"
REPLAY, REPORT = "replay.html", "report.html"
JOINT_CENTRES = "joint_centres.csv"
TRC, MOT, BVH = "joint_centres.trc", "positions.mot", "motion.bvh"
OVERLAY, SHAPES = "overlay", "shapes.png"

RESULT_FILES = (
    POSES, JOINTS, FAMILIES, SUMMARY, REPLAY, REPORT, JOINT_CENTRES, TRC, MOT, BVH, SHAPES
)  # fmt: skip
"""Every file that a result may have beside its overlays."""

BASE_COLUMNS = ("base_x", "base_y", "base_z", "base_qw", "base_qx", "base_qy", "base_qz")
"""Columns of the plant's world in the scene's world: position [m] and unit quaternion."""

FIT_COLUMNS = ("error", "seconds")
"""The last columns: E_total and the search's wall time [s]."""


@dataclass(frozen=True, eq=False)
class PoseRow:
    """One row of poses.csv.

    Args:
        q: (nq,) positions [rad or m]; NaN where no pose was found.
        base: (7,) BASE_COLUMNS; None where the model's own joints place it in the world.
        error: E_total; NaN where no pose was found.
        seconds: the search's wall time [s].
    """

    frame: str
    q: np.ndarray
    base: np.ndarray | None
    error: float
    seconds: float

    @property
    def found(self) -> bool:
        """Whether a pose was found."""
        return bool(np.isfinite(self.error))


def base_cells(X_WB: np.ndarray) -> np.ndarray:
    """BASE_COLUMNS (7,) of a pose (4, 4): position [m] and unit quaternion."""
    rotation = RotationMatrix.ProjectToRotationMatrix(X_WB[:3, :3])
    return np.concatenate([X_WB[:3, 3], rotation.ToQuaternion().wxyz()])


def base_pose(base: np.ndarray | None) -> np.ndarray:
    """The pose (4, 4) that BASE_COLUMNS (7,) describe; the identity where there are none."""
    if base is None:
        return np.eye(4)
    # The quaternion was rounded when it was written.
    rotation = RotationMatrix(Quaternion(base[3:] / np.linalg.norm(base[3:])))
    return np.asarray(RigidTransform(rotation, base[:3]).GetAsMatrix4())


class ResultFolder:
    """Writes a result, frame by frame.

    Args:
        position_names: the plant's positions, in its order.
        with_base: whether the base's pose is written too.
        resume: go on with a folder that holds a part of the result.

    Raises:
        OutputError: here and in all methods: if the folder is not empty and ``resume`` is not
            given, or cannot be written, or what it holds cannot be resumed.
    """

    def __init__(
        self, path: Path, position_names: Sequence[str], with_base: bool, resume: bool = False
    ) -> None:
        self.path = path
        self.position_names = tuple(position_names)
        self.with_base = with_base
        self.rows: list[PoseRow] = []
        self._file: TextIO | None = None
        if resume:
            _require_no_file(path)
        else:
            require_empty(path)
        if resume and (path / POSES).is_file():
            self.rows = self._read_rows()

    @property
    def header(self) -> list[str]:
        """The columns of poses.csv."""
        base = BASE_COLUMNS if self.with_base else ()
        return ["frame", *self.position_names, *base, *FIT_COLUMNS]

    def open(self) -> None:
        """Begin poses.csv, with the rows that were read for a resumption."""
        self._write_rows()
        try:
            self._file = (self.path / POSES).open("a", newline="", encoding="utf-8")
        except OSError as error:
            raise _cannot_write(self.path / POSES, error) from error

    def sort(self, frames: Sequence[str]) -> None:
        """Close poses.csv and put its rows, also of a resumed job, in the order of ``frames``."""
        self.close()
        place = {frame: index for index, frame in enumerate(frames)}
        in_order = sorted(self.rows, key=lambda row: place[row.frame])
        if in_order != self.rows:
            self.rows = in_order
            self._write_rows()

    def close(self) -> None:
        """Close poses.csv."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def add(self, row: PoseRow) -> None:
        """Write the row of a finished frame."""
        if self._file is None:
            raise OutputError(f"{self.path / POSES}: is not open")
        try:
            self._file.write(csv_text(self._cells(row)))
            self._file.flush()
        except OSError as error:
            raise _cannot_write(self.path / POSES, error) from error
        self.rows.append(row)

    def clear(self) -> None:
        """Forget the rows that were read for a resumption."""
        self.rows = []

    def forget(self, frames: Collection[str]) -> None:
        """Forget some of the rows that were read for a resumption."""
        self.rows = [row for row in self.rows if row.frame not in frames]

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write summary.json; numbers that are not finite become null."""
        text = json.dumps(without_nan(summary), indent=2, allow_nan=False, ensure_ascii=False)
        self.write(SUMMARY, (text + "\n").encode())

    def write(self, name: str, data: bytes) -> Path:
        """Write a file, by its path within the folder, all at once, making the folders it needs."""
        path = self.path / name
        temporary = path.with_name(path.name + ".part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(data)
            os.replace(temporary, path)
        except OSError as error:
            raise _cannot_write(path, error) from error
        return path

    def _write_rows(self) -> None:
        text = csv_text(self.header, [self._cells(row) for row in self.rows])
        self.write(POSES, text.encode())

    def _cells(self, row: PoseRow) -> list[str]:
        base: Sequence[float] | np.ndarray = ()
        if self.with_base:
            base = np.full(len(BASE_COLUMNS), np.nan) if row.base is None else row.base
        numbers = [*row.q, *base, row.error]
        cells = [f"{number:.9g}" if np.isfinite(number) else "" for number in numbers]
        return [row.frame, *cells, f"{row.seconds:.4f}"]

    def _read_rows(self) -> list[PoseRow]:
        path = self.path / POSES
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise OutputError(f"{path}: cannot be read, so not be resumed") from error
        # What follows the last line break is a row that an interruption cut off.
        lines = list(csv.reader(text[: text.rfind("\n") + 1].splitlines()))
        if lines and lines[0] != self.header:
            raise OutputError(f"{path}: was written for another model; name another folder")
        try:
            return [self._row(cells) for cells in lines[1:]]
        except ValueError:
            raise OutputError(f"{path}: is damaged, so it cannot be resumed") from None

    def _row(self, cells: Sequence[str]) -> PoseRow:
        if len(cells) != len(self.header):
            raise ValueError(len(cells))
        numbers = np.array([float(cell) if cell else np.nan for cell in cells[1:]])
        count = len(self.position_names)
        base = numbers[count:-2] if self.with_base and np.isfinite(numbers[-2]) else None
        return PoseRow(cells[0], numbers[:count], base, float(numbers[-2]), float(numbers[-1]))


def csv_text(header: Sequence[object], rows: Iterable[Sequence[object]] = ()) -> str:
    """The text of a table of comma-separated values."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue()


def require_empty(path: Path) -> None:
    """Refuses (OutputError) a folder that holds something, and a place where none can be."""
    _require_no_file(path)
    if path.is_dir() and any(path.iterdir()):
        raise OutputError(
            f"{path}: the output folder exists and is not empty; name another one with --out, or "
            "go on with an interrupted result in it with --resume"
        )


def _require_no_file(path: Path) -> None:
    """Refuses a folder that cannot be, since it or what it would lie in is a file."""
    try:
        existing = next((place for place in (path, *path.parents) if place.exists()), None)
    except OSError as error:
        raise _cannot_write(path, error) from error
    if existing is not None and not existing.is_dir():
        raise OutputError(f"{existing}: is a file, but the result is a folder; name another one")


def read_summary(path: Path) -> dict[str, Any]:
    """Reads the summary.json of a result folder; OutputError: there is none, or it is damaged."""
    file = path / SUMMARY
    try:
        summary = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise OutputError(f"{file}: cannot be read ({error.strerror}): no result folder") from error
    except ValueError as error:
        raise OutputError(f"{file}: is damaged; it is not JSON") from error
    if not isinstance(summary, dict):
        raise OutputError(f"{file}: is damaged; it is not a JSON object")
    return summary


def without_nan(value: Any) -> Any:
    """Returns plain JSON values: arrays become lists, numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(key): without_nan(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return without_nan(value.tolist())
    if isinstance(value, list | tuple):
        return [without_nan(entry) for entry in value]
    if isinstance(value, np.generic):
        return without_nan(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return value


def _cannot_write(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path}: cannot be written: {error.strerror}")
