"""Calibration boards: checkerboards and ChArUco boards, and where their corners are in pictures.

The board's frame B: origin at the lower left corner of the squares of the upright board, x to the
right, y up, z out of the printed side. A board that lies on the floor has z up. A checkerboard is
upright when its top left square is black; a ChArUco board when marker 0 is in its first row.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Indices
from drake_pose.camera.models import check_number
from drake_pose.camera.picture_files import decode_picture, list_pictures, read_picture_file
from drake_pose.errors import CameraError
from drake_pose.yaml_files import read_yaml

Picture = tuple[str, str]
"""A camera's name and a frame's name; pictures of the same frame were taken at the same instant."""

_FIELDS = {
    "checkerboard": ("kind", "squares", "square_length"),
    "charuco": ("kind", "squares", "square_length", "marker_length", "dictionary"),
}
_MOST_SQUARES = 100
_FEWEST_CORNERS = 8


@dataclass(frozen=True, eq=False)
class Detection:
    """Which corners of a board (n,), increasing, were found in a picture, and where (n, 2)."""

    corners: Indices
    uv: Array


@dataclass(frozen=True)
class Board:
    """A flat calibration board.

    Args:
        columns, rows: number of squares across and down the upright board.
        square_length, marker_length: sides of a square, and of a ChArUco marker [m].
        dictionary: a ChArUco board's dictionary, for example 4X4_50.
        legacy_pattern: drawn by OpenCV before 4.6: an even number of rows begins with a white
            square.

    Raises CameraError when a value is out of its range.
    """

    kind: str
    columns: int
    rows: int
    square_length: float
    marker_length: float | None = None
    dictionary: str | None = None
    legacy_pattern: bool = False

    def __post_init__(self) -> None:
        if self.kind not in _FIELDS:
            raise CameraError(f"board: kind must be one of {', '.join(_FIELDS)}, not '{self.kind}'")
        for count in (self.columns, self.rows):
            if not isinstance(count, int) or not 3 <= count <= _MOST_SQUARES:
                raise CameraError(
                    f"board: squares must be two whole numbers from 3 to {_MOST_SQUARES} (across "
                    f"and down), not {count!r}"
                )
        if not isinstance(self.legacy_pattern, bool):
            raise CameraError("board: legacy_pattern must be true or false")
        for name in ("square_length", "marker_length")[: 1 + (self.kind == "charuco")]:
            length = check_number(getattr(self, name), name, "board", positive=True)
            object.__setattr__(self, name, length)
        if self.kind == "charuco":
            if length >= self.square_length:
                raise CameraError("board: marker_length must be less than square_length")
            self.opencv_charuco_board()

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
        """Finds the board in a picture: grey (H, W), or (H, W, 3) blue, green, red.

        Returns:
            None where too little of it is seen: a checkerboard must be seen whole, of a ChArUco
                board enough corners in more than one row and column.
        """
        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        grey = np.ascontiguousarray(grey, dtype=np.uint8)
        if self.kind == "charuco":
            return self._find_charuco(grey)
        return self._find_checkerboard(grey)

    def _find_checkerboard(self, grey: NDArray[np.uint8]) -> Detection | None:
        size = (self.columns - 1, self.rows - 1)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, pixels = cv2.findChessboardCorners(grey, size, flags=flags)
        if found:
            # To a fraction of a pixel, from a window well inside each corner's neighbours.
            grid = np.reshape(pixels, (size[1], size[0], 2))
            steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
            half = int(np.clip(0.3 * min(steps), 2, 15))
            stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
            pixels = cv2.cornerSubPix(grey, np.asarray(pixels), (half, half), (-1, -1), stop)
        else:
            # Slower by a factor of forty, but it bears blur and uneven light.
            flags = cv2.CALIB_CB_NORMALIZE_IMAGE
            found, pixels = cv2.findChessboardCornersSB(grey, size, flags=flags)
        if not found:
            return None
        grid = np.asarray(pixels, dtype=np.float64).reshape(size[1], size[0], 2)
        if np.linalg.det([grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]]) < 0.0:
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
        row, column = np.divmod(corners, self.columns - 1)
        if min(len(np.unique(row)), len(np.unique(column))) < 2:
            return None
        uv = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        return Detection(corners[order], uv[order])

    def opencv_charuco_board(self) -> Any:
        """OpenCV's object of a ChArUco board, with which it can be drawn and printed."""
        known = {k[len("DICT_") :].upper(): k for k in vars(cv2.aruco) if k.startswith("DICT_")}
        plain = str(self.dictionary).upper().removeprefix("DICT_")
        if plain not in known:
            listed = ", ".join(sorted(known))
            raise CameraError(f"board: dictionary must be one of {listed}, not '{self.dictionary}'")
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, known[plain]))
        size, marker_length = (self.columns, self.rows), float(self.marker_length or 0.0)
        board = cv2.aruco.CharucoBoard(size, self.square_length, marker_length, dictionary)
        board.setLegacyPattern(self.legacy_pattern)
        return board


def _top_left_is_white(grey: NDArray[np.uint8], grid: Array) -> bool:
    """Whether the square outside the first corner is white, judged by all inner squares."""
    middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    u, v = np.rint(middles).astype(int).transpose(2, 0, 1)
    brightness = cv2.blur(grey, (3, 3))[v, u].astype(np.float64)
    like_top_left = np.indices(brightness.shape).sum(axis=0) % 2 == 0
    return bool(brightness[like_top_left].mean() > brightness[~like_top_left].mean())


def load_board(path: str | Path) -> Board:
    """Reads a board from a YAML file; CameraError names the file and the field.

    `kind: checkerboard|charuco`, `squares: [across, down]`, `square_length` [m]; a ChArUco board
    has `marker_length` [m] and `dictionary` (4X4_50 ...) too, and may have `legacy_pattern: true`.
    """
    path = Path(path)
    content = read_yaml(path, CameraError)
    if not isinstance(content, dict) or content.get("kind") not in _FIELDS:
        raise CameraError(f"{path}: a board needs kind: {' or '.join(_FIELDS)}")
    kind = content["kind"]
    known = (*_FIELDS[kind], *(["legacy_pattern"] if kind == "charuco" else []))
    unknown = [str(name)[:40] for name in content if name not in known]
    missing = [name for name in _FIELDS[kind] if name not in content]
    if unknown or missing:
        wrong = f"unknown field {', '.join(unknown)}" if unknown else f"lacks {', '.join(missing)}"
        raise CameraError(f"{path}: {wrong}; a {kind} has: {', '.join(known)}")
    squares = content.pop("squares")
    if not isinstance(squares, list) or len(squares) != 2:
        raise CameraError(f"{path}: squares must be two whole numbers, across and down")
    try:
        return Board(columns=squares[0], rows=squares[1], **content)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from error


@dataclass(frozen=True, eq=False)
class BoardDetections:
    """What a set of calibration pictures shows.

    Args:
        sizes: width and height of each camera's pictures [pixel].
        detections: by camera, then by frame: where the board's corners are.
        not_found, unreadable: pictures without the board; pictures that could not be read, and why.
        mirrored: cameras in whose pictures the board is found when they are turned left to right.
    """

    board: Board
    sizes: Mapping[str, tuple[int, int]]
    detections: Mapping[str, Mapping[str, Detection]]
    not_found: tuple[Picture, ...] = ()
    unreadable: Mapping[Picture, str] = field(default_factory=dict)
    mirrored: tuple[str, ...] = ()


def find_pictures(folder: str | Path) -> dict[str, dict[str, Path]]:
    """The picture files of a folder's `images/<camera>/<frame>.png` or .jpg, or of its own.

    Raises CameraError when there are none, or a camera has two files of one frame.
    """
    root = Path(folder)
    root = root / "images" if (root / "images").is_dir() else root
    if not root.is_dir():
        raise CameraError(f"{folder}: no such folder; it needs images/<camera>/<frame>.png")
    cameras = sorted(path for path in root.iterdir() if path.is_dir())
    found = {camera.name: list_pictures(camera, CameraError) for camera in cameras}
    found = {camera: files for camera, files in found.items() if files}
    if not found:
        raise CameraError(f"{root}: holds no picture <camera>/<frame>.png or .jpg")
    return found


def find_boards(
    files: Mapping[str, Mapping[str, Path]],
    board: Board,
    on_picture: Callable[[str, str], None] | None = None,
) -> BoardDetections:
    """Searches pictures for the board; a bad picture is noted and harms no other.

    Args:
        files: by camera, then by frame.
        on_picture: called with camera and frame before each picture.

    Raises CameraError when a camera's pictures differ in size, or none of them can be read.
    """
    sizes: dict[str, tuple[int, int]] = {}
    detections: dict[str, dict[str, Detection]] = {camera: {} for camera in files}
    not_found: list[Picture] = []
    unreadable: dict[Picture, str] = {}
    mirrored: dict[str, bool] = {}
    for camera, frame, path in ((c, f, path) for c in files for f, path in files[c].items()):
        if on_picture is not None:
            on_picture(camera, frame)
        try:
            grey = read_board_picture(path, cv2.IMREAD_GRAYSCALE)
        except CameraError as error:
            unreadable[camera, frame] = str(error)
            continue
        size = (grey.shape[1], grey.shape[0])
        if sizes.setdefault(camera, size) != size:
            raise CameraError(
                f"{path}: {size[0]} x {size[1]} pixels (width x height), but camera "
                f"'{camera}' began with {sizes[camera][0]} x {sizes[camera][1]}"
            )
        detection = board.find(grey)
        if detection is not None:
            detections[camera][frame] = detection
            continue
        not_found.append((camera, frame))
        if board.kind == "charuco" and not detections[camera] and not mirrored.get(camera):
            mirrored[camera] = board.find(grey[:, ::-1]) is not None
    for camera in files:
        if camera not in sizes:
            raise CameraError(f"camera '{camera}': none of its pictures can be read")
    turned = tuple(name for name, is_so in mirrored.items() if is_so and not detections[name])
    return BoardDetections(board, sizes, detections, tuple(not_found), unreadable, turned)


def read_board_picture(path: Path, how: int = cv2.IMREAD_COLOR) -> NDArray[np.uint8]:
    """A picture (H, W, 3) blue, green, red, or as a flag of OpenCV says; CameraError names it."""
    return decode_picture(read_picture_file(path, CameraError), how, path, CameraError)
