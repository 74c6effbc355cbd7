"""Calibration pictures: a folder `images/<camera>/<frame>.png`, searched for the board."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.calibration.board import Board, Detection
from drake_pose.camera.checks import LARGEST_SIDE
from drake_pose.errors import CameraError
from drake_pose.regular_files import read_regular

_SUFFIXES = (".png", ".jpg", ".jpeg")

Picture = tuple[str, str]
"""A camera's name and a frame's name; pictures of the same frame were taken at the same instant."""


@dataclass(frozen=True, eq=False)
class BoardDetections:
    """What a set of calibration pictures shows.

    Args:
        board: the board.
        sizes: width and height of each camera's pictures [pixel].
        detections: by camera, then by frame: where the board's corners are.
        not_found: pictures in which the board was not found.
        unreadable: pictures that could not be read, with the reason.
        mirrored: cameras in whose pictures the board is found when they are turned left to right.
    """

    board: Board
    sizes: Mapping[str, tuple[int, int]]
    detections: Mapping[str, Mapping[str, Detection]]
    not_found: tuple[Picture, ...] = ()
    unreadable: Mapping[Picture, str] | None = None
    mirrored: tuple[str, ...] = ()


def find_pictures(folder: str | Path) -> dict[str, dict[str, Path]]:
    """The picture files of a folder, by camera, then by frame.

    Args:
        folder: holds `images/<camera>/<frame>.png` (or .jpg); or is that `images` folder itself.

    Raises:
        CameraError: when there are none, or a camera has two files of one frame.
    """
    root = Path(folder)
    root = root / "images" if (root / "images").is_dir() else root
    if not root.is_dir():
        raise CameraError(f"{folder}: no such folder; it needs images/<camera>/<frame>.png")
    found: dict[str, dict[str, Path]] = {}
    for camera in sorted(path for path in root.iterdir() if path.is_dir()):
        files: dict[str, Path] = {}
        for file in sorted(camera.iterdir()):
            if file.suffix.lower() not in _SUFFIXES:
                continue
            if file.stem in files:
                raise CameraError(f"{file}: camera '{camera.name}' has this frame twice")
            files[file.stem] = file
        if files:
            found[camera.name] = files
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
        board: what to look for.
        on_picture: called with camera and frame before each picture.

    Raises:
        CameraError: when a camera's pictures differ in size, or none of them can be read.
    """
    sizes: dict[str, tuple[int, int]] = {}
    detections: dict[str, dict[str, Detection]] = {}
    not_found: list[Picture] = []
    unreadable: dict[Picture, str] = {}
    mirrored = []
    for camera, frames in files.items():
        seen: dict[str, Detection] = {}
        turned_around = 0
        for frame, path in frames.items():
            if on_picture is not None:
                on_picture(camera, frame)
            try:
                grey = read_picture(path, grey=True)
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
                seen[frame] = detection
                continue
            not_found.append((camera, frame))
            if not seen and board.kind == "charuco":
                turned_around += board.find(np.ascontiguousarray(grey[:, ::-1])) is not None
        if camera not in sizes:
            raise CameraError(f"camera '{camera}': none of its pictures can be read")
        if not seen and turned_around:
            mirrored.append(camera)
        detections[camera] = seen
    return BoardDetections(board, sizes, detections, tuple(not_found), unreadable, tuple(mirrored))


def read_picture(path: Path, *, grey: bool = False) -> NDArray[np.uint8]:
    """Reads a picture file: (H, W, 3) blue, green, red, or (H, W) grey.

    Raises:
        CameraError: names the file; when it cannot be read or is no picture.
    """
    try:
        data = np.frombuffer(read_regular(path), np.uint8)
    except OSError as error:
        raise CameraError(f"{path}: cannot read the picture: {error.strerror}") from error
    how = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
    try:
        picture = cv2.imdecode(data, how) if len(data) else None
    except cv2.error:
        picture = None
    if picture is None or max(picture.shape[:2]) > LARGEST_SIDE:
        raise CameraError(f"{path}: not a whole picture that OpenCV can read")
    return np.asarray(picture, dtype=np.uint8)
