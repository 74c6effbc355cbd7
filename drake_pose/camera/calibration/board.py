"""Calibration boards: checkerboards and ChArUco boards, and where their corners are in a picture.

The board's frame B: origin at the lower left corner of the squares of the upright board, x to the
right, y up, z out of the printed side. A board that lies on the floor has z up. A checkerboard is
upright when its top left square is black; a ChArUco board when marker 0 is in its first row.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.checks import check_number
from drake_pose.errors import CameraError
from drake_pose.yaml_files import read_yaml

Array = NDArray[np.float64]

KINDS = ("checkerboard", "charuco")
_FIELDS = {
    "checkerboard": ("kind", "squares", "square_length"),
    "charuco": (
        *("kind", "squares", "square_length", "marker_length", "dictionary"),
        "legacy_pattern",
    ),
}
_MOST_SQUARES = 100
_FEWEST_CORNERS = 8


@dataclass(frozen=True, eq=False)
class Detection:
    """The corners of a board that were found in a picture.

    Args:
        corners: (n,) which corners of the board, increasing.
        uv: (n, 2) where they are [pixel], pixel centres at integers.
    """

    corners: NDArray[np.int64]
    uv: Array


@dataclass(frozen=True)
class Board:
    """A flat calibration board.

    Args:
        kind: checkerboard or charuco.
        columns, rows: number of squares across and down the upright board.
        square_length: a square's side [m].
        marker_length: a ChArUco marker's side [m].
        dictionary: a ChArUco board's dictionary, for example 4X4_50.
        legacy_pattern: whether the ChArUco board was drawn by OpenCV before 4.6, which began boards
            of an even number of rows with a white square.

    Raises:
        CameraError: when a value is out of its range.
    """

    kind: str
    columns: int
    rows: int
    square_length: float
    marker_length: float | None = None
    dictionary: str | None = None
    legacy_pattern: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise CameraError(f"board: kind must be one of {', '.join(KINDS)}, not '{self.kind}'")
        for field in ("columns", "rows"):
            count = getattr(self, field)
            if not isinstance(count, int) or not 3 <= count <= _MOST_SQUARES:
                raise CameraError(
                    f"board: squares must be two whole numbers from 3 to {_MOST_SQUARES} (across "
                    f"and down), not {count!r}"
                )
        check_number(self.square_length, "square_length", "board", positive=True)
        if self.kind == "charuco":
            length = check_number(self.marker_length, "marker_length", "board", positive=True)
            if length >= self.square_length:
                raise CameraError("board: marker_length must be less than square_length")
            _dictionary(self.dictionary)

    @property
    def points(self) -> Array:
        """(n, 3) the inner corners in the board's frame [m], row after row from the top left."""
        column, row = np.meshgrid(np.arange(1, self.columns), np.arange(self.rows - 1, 0, -1))
        flat = np.column_stack([column.ravel(), row.ravel(), np.zeros(column.size)])
        return np.asarray(self.square_length * flat, dtype=np.float64)

    @property
    def looks_the_same_turned(self) -> bool:
        """Whether the board turned by 180 degrees looks like the board."""
        return self.kind == "checkerboard" and (self.columns + self.rows) % 2 == 0

    def find(self, picture: NDArray[np.uint8]) -> Detection | None:
        """Finds the board in a picture.

        Args:
            picture: (H, W) grey or (H, W, 3) blue, green, red.

        Returns:
            The corners; None where the board is not found (a checkerboard must be seen whole, of a
            ChArUco board enough corners in more than one row and column).
        """
        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        grey = np.ascontiguousarray(grey, dtype=np.uint8)
        if self.kind == "charuco":
            return self._find_charuco(grey)
        return self._find_checkerboard(grey)

    def _find_checkerboard(self, grey: NDArray[np.uint8]) -> Detection | None:
        size = (self.columns - 1, self.rows - 1)
        found, pixels = cv2.findChessboardCorners(
            grey, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if found:
            pixels = _refined(grey, np.asarray(pixels), size)
        else:
            # Slower by a factor of forty, but it bears blur and uneven light.
            found, pixels = cv2.findChessboardCornersSB(
                grey, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE
            )
        if not found:
            return None
        grid = np.asarray(pixels, dtype=np.float64).reshape(self.rows - 1, self.columns - 1, 2)
        across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
        if across[0] * down[1] - across[1] * down[0] < 0.0:
            grid = grid[:, ::-1]
        if not self.looks_the_same_turned and _top_left_is_white(grey, grid):
            grid = grid[::-1, ::-1]
        uv = np.ascontiguousarray(grid.reshape(-1, 2))
        return Detection(np.arange(len(uv)), uv)

    def _find_charuco(self, grey: NDArray[np.uint8]) -> Detection | None:
        detector = cv2.aruco.CharucoDetector(self.opencv_charuco_board())
        pixels, identities, _, _ = detector.detectBoard(grey)
        if identities is None or len(identities) < _FEWEST_CORNERS:
            return None
        corners = np.asarray(identities, dtype=np.int64).ravel()
        order = np.argsort(corners)
        corners = corners[order]
        uv = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)[order]
        row, column = np.divmod(corners, self.columns - 1)
        if min(len(np.unique(row)), len(np.unique(column))) < 2:
            return None
        return Detection(corners, uv)

    def opencv_charuco_board(self) -> Any:
        """OpenCV's object of a ChArUco board, with which it can be drawn and printed."""
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows),
            self.square_length,
            float(self.marker_length or 0.0),
            _dictionary(self.dictionary),
        )
        board.setLegacyPattern(self.legacy_pattern)
        return board


def load_board(path: str | Path) -> Board:
    """Reads a board from a YAML file.

    `kind: checkerboard|charuco`, `squares: [across, down]`, `square_length` [m]; a ChArUco board
    has `marker_length` [m] and `dictionary` (4X4_50 ...) too, and may have `legacy_pattern: true`.

    Raises:
        CameraError: names the file and the field.
    """
    path = Path(path)
    content = read_yaml(path, CameraError)
    if not isinstance(content, dict) or content.get("kind") not in KINDS:
        raise CameraError(f"{path}: a board needs kind: {' or '.join(KINDS)}")
    known = _FIELDS[content["kind"]]
    unknown = [str(field)[:40] for field in content if field not in known]
    missing = [field for field in known if field not in content and field != "legacy_pattern"]
    if unknown or missing:
        wrong = f"unknown field {', '.join(unknown)}" if unknown else f"lacks {', '.join(missing)}"
        raise CameraError(f"{path}: {wrong}; a {content['kind']} has: {', '.join(known)}")
    squares = content["squares"]
    if not isinstance(squares, list) or len(squares) != 2:
        raise CameraError(f"{path}: squares must be two whole numbers, across and down")
    legacy = content.get("legacy_pattern", False)
    if not isinstance(legacy, bool):
        raise CameraError(f"{path}: legacy_pattern must be true or false")
    where = str(path)
    marker_length = None
    if content["kind"] == "charuco":
        marker_length = check_number(content["marker_length"], "marker_length", where)
    try:
        return Board(
            kind=content["kind"],
            columns=squares[0],
            rows=squares[1],
            square_length=check_number(content["square_length"], "square_length", where),
            marker_length=marker_length,
            dictionary=content.get("dictionary"),
            legacy_pattern=legacy,
        )
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from error


def _dictionary(name: str | None) -> Any:
    """Returns OpenCV's marker dictionary of a name."""
    known = sorted(key[len("DICT_") :] for key in vars(cv2.aruco) if key.startswith("DICT_"))
    plain = str(name).removeprefix("DICT_").upper()
    by_upper = {key.upper(): key for key in known}
    if plain not in by_upper:
        raise CameraError(f"board: dictionary must be one of {', '.join(known)}, not '{name}'")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{by_upper[plain]}"))


def _refined(
    grey: NDArray[np.uint8], pixels: NDArray[np.float32], size: tuple[int, int]
) -> NDArray[np.float32]:
    """The corners to a fraction of a pixel, from a window well inside their neighbours."""
    grid = np.reshape(pixels, (size[1], size[0], 2))
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    half = int(np.clip(0.3 * min(steps), 2, 15))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    refined = cv2.cornerSubPix(grey, pixels, (half, half), (-1, -1), stop)
    return np.asarray(refined, dtype=np.float32)


def _top_left_is_white(grey: NDArray[np.uint8], grid: Array) -> bool:
    """Whether the square outside the first corner is white, judged by all inner squares."""
    middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    height, width = grey.shape
    u = np.clip(np.rint(middles[..., 0]).astype(int), 0, width - 1)
    v = np.clip(np.rint(middles[..., 1]).astype(int), 0, height - 1)
    brightness = cv2.blur(grey, (3, 3))[v, u].astype(np.float64)
    row, column = np.indices(brightness.shape)
    like_top_left = (row + column) % 2 == 0
    return bool(brightness[like_top_left].mean() > brightness[~like_top_left].mean())
