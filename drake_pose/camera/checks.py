"""Checks of camera parameters; every message names the camera and the field."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.errors import CameraError

LARGEST_SIDE = 16384
"""The largest supported width or height [pixel]."""

_ROTATION_TOLERANCE = 1e-4
_EXACT_ROTATION = 1e-13


def check_side(value: Any, field: str, where: str) -> int:
    """A width or height [pixel], a whole number from 1 to LARGEST_SIDE, or CameraError."""
    number = check_number(value, field, where)
    if number != math.floor(number) or not 1 <= number <= LARGEST_SIDE:
        raise CameraError(
            f"{where}: {field} must be a whole number of pixels from 1 to {LARGEST_SIDE}, "
            f"not {value!r}"
        )
    return int(number)


def check_number(value: Any, field: str, where: str, *, positive: bool = False) -> float:
    """A finite (and on request positive) number as a float, or CameraError.

    YAML 1.1 reads ``1e-3`` as text, so text that spells a number is accepted.
    """
    try:
        if isinstance(value, bool) or not isinstance(
            value, int | float | str | np.integer | np.floating
        ):
            raise ValueError
        number = float(value)
        if not math.isfinite(number) or (positive and number <= 0.0):
            raise ValueError
    except (ValueError, OverflowError):
        kind = "a finite positive number" if positive else "a finite number"
        raise CameraError(f"{where}: {field} must be {kind}, not {_short(value)}") from None
    return number


def check_pose(value: Any, field: str, where: str) -> np.ndarray:
    """A rigid transform as a read-only (4, 4) float64 array.

    A rounded rotation is replaced by the nearest exact one, on which Drake insists.

    Raises CameraError: not a finite 4 x 4 matrix, a last row that is not 0 0 0 1, or no rotation.
    """
    rows = value.tolist() if isinstance(value, np.ndarray) else value
    if not (
        isinstance(rows, list | tuple)
        and [len(row) if isinstance(row, list | tuple) else 0 for row in rows] == [4] * 4
    ):
        raise CameraError(
            f"{where}: {field} must be a 4 x 4 matrix of numbers, not {_short(value)}"
        )
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
        matrix = np.array(value, dtype=np.float64)
    else:
        matrix = np.array([[check_number(entry, field, where) for entry in row] for row in rows])
    if not np.all(np.isfinite(matrix)):
        raise CameraError(f"{where}: {field} has entries that are not finite")
    if not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-12):
        raise CameraError(f"{where}: the last row of {field} must be 0 0 0 1")
    R = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(R @ R.T - np.eye(3)).max()
    if not deviation <= _ROTATION_TOLERANCE:
        raise CameraError(
            f"{where}: the upper left 3 x 3 block of {field} is not a rotation (R R^T differs from "
            f"the identity by {deviation:.3g}); its columns must be the camera's axes in the world"
        )
    if np.linalg.det(R) < 0.0:
        raise CameraError(
            f"{where}: the upper left 3 x 3 block of {field} is a reflection, not a rotation; "
            "a camera's axes are x right, y down, z forward"
        )
    if deviation > _EXACT_ROTATION:
        U, _, Vt = np.linalg.svd(R)
        matrix[:3, :3] = U @ Vt
    matrix[3] = [0.0, 0.0, 0.0, 1.0]
    matrix.flags.writeable = False
    return matrix


def write_file(path: str | Path, text: str, what: str) -> None:
    """Writes a text; CameraError, which says what it holds, where that cannot be."""
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise CameraError(f"{path}: cannot write {what}: {error.strerror}") from error


def _short(value: Any) -> str:
    """A value as text that cannot flood a message."""
    if isinstance(value, dict | list | tuple | set):
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
