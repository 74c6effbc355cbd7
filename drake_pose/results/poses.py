"""poses.csv: one row a frame, of which the finished ones survive whatever ends the job."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from drake_pose.csv_files import csv_text, read_csv
from drake_pose.errors import OutputError
from drake_pose.results.folder import POSES, cannot_write, write_file

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


class PoseTable:
    """The table of a result's folder, with or without the base's pose."""

    def __init__(self, folder: Path, position_names: Sequence[str], with_base: bool) -> None:
        self._folder, self._count, self._with_base = folder, len(position_names), with_base
        base = BASE_COLUMNS if with_base else ()
        self.header = ["frame", *position_names, *base, *FIT_COLUMNS]

    def write(self, rows: Iterable[PoseRow]) -> None:
        """Write all rows, at once."""
        cells = [self._cells(row) for row in rows]
        write_file(self._folder, POSES, csv_text([self.header, *cells]))

    def append(self, row: PoseRow) -> None:
        """Write one more row; it is on the disk when this returns."""
        path = self._folder / POSES
        try:
            with path.open("a", newline="", encoding="utf-8") as file:
                file.write(csv_text([self._cells(row)]))
        except OSError as error:
            raise cannot_write(path, error) from error

    def read(self) -> list[PoseRow]:
        """The rows of an interrupted job; none where there is no table.

        Raises:
            OutputError: it cannot be read, or is another model's.
        """
        path = self._folder / POSES
        if not path.is_file():
            return []
        header, lines = read_csv(path, OutputError, whole_lines=True)
        if header != self.header:
            raise OutputError(f"{path}: was written for another model; name another folder")
        rows = []
        for line, (frame, *cells) in lines:
            try:
                numbers = np.array([float(cell or "nan") for cell in cells])
            except ValueError:
                raise OutputError(
                    f"{path}: line {line} is damaged, so it cannot be resumed"
                ) from None
            error, seconds = numbers[-2:].tolist()
            base = numbers[self._count : -2] if self._with_base and np.isfinite(error) else None
            rows.append(PoseRow(frame, numbers[: self._count], base, error, seconds))
        return rows

    def _cells(self, row: PoseRow) -> list[str]:
        base = np.full(len(BASE_COLUMNS), np.nan) if row.base is None else row.base
        numbers = [*row.q, *(base if self._with_base else ()), row.error]
        cells = [f"{number:.9g}" if np.isfinite(number) else "" for number in numbers]
        return [row.frame, *cells, f"{row.seconds:.4f}"]
