"""What was learned of a camera's background and of a face: its files, and pictures of a face.

Files are .npz, plain arrays. Pictures of a face have known directions (Date et al., 3.2.2).
"""

from __future__ import annotations

import csv
import io
import math
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.picture_files import SUFFIXES, read_picture
from drake_pose.errors import OutputError, SceneError
from drake_pose.person.date.faces import (
    FACE_HEIGHT,
    FACE_WIDTH,
    FaceTemplates,
    cut_face,
    learn_faces,
)
from drake_pose.person.date.skin_blobs import SkinColour, skin_blobs
from drake_pose.regular_files import read_regular
from drake_pose.silhouette.segmentation.background import (
    Background,
    learn_background,
    person_region,
)

Picture = NDArray[np.uint8]

DIRECTIONS = "directions.csv"
"""The file that says where each picture's face looks."""

_COLUMNS = ["picture", "turn", "nod"]
_EMPTY = "empty"
_LARGEST_FILE = 1 << 30
_PIXELS = 3 * FACE_WIDTH * FACE_HEIGHT
_FACES: Mapping[str, type[np.generic]] = {
    "mean": np.float32,
    "basis": np.float32,
    "coordinates": np.float32,
    "directions": np.float64,
}


def save_background(path: Path, background: Background) -> None:
    """Writes a camera's background: the arrays `mean` and `deviation` of Background.

    Raises:
        OutputError: it cannot be written.
    """
    _write(path, {"mean": background.mean, "deviation": background.deviation})


def load_background(path: Path) -> Background:
    """Reads what save_background wrote.

    Raises:
        SceneError: names the file; it cannot be read, or holds no background.
    """
    arrays = _read(path, {"mean": np.uint8, "deviation": np.float32}, "a background")
    mean, deviation = arrays["mean"], arrays["deviation"]
    fits = mean.ndim == 3 and mean.shape[2:] == (3,) and mean.shape[:2] == deviation.shape
    if not fits or not mean.size or not (deviation > 0).all():
        raise SceneError(
            f"{path}: a background's mean is (H, W, 3) and its deviation (H, W), positive; here "
            f"they are {mean.shape} and {deviation.shape}"
        )
    return Background(mean, deviation)


def save_faces(path: Path, faces: FaceTemplates) -> None:
    """Writes templates of a face: the arrays of FaceTemplates by their names.

    Raises:
        OutputError: it cannot be written.
    """
    _write(path, {name: getattr(faces, name) for name in _FACES})


def load_faces(path: Path) -> FaceTemplates:
    """Reads what save_faces wrote.

    Raises:
        SceneError: names the file; it cannot be read, or holds no templates.
    """
    arrays = _read(path, _FACES, "templates of a face")
    count, dimensions = len(arrays["directions"]), len(arrays["basis"])
    shapes = {
        "mean": (_PIXELS,),
        "basis": (dimensions, _PIXELS),
        "coordinates": (count, dimensions),
        "directions": (count, 2),
    }
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not count:
            raise SceneError(
                f"{path}: {name} of {count} templates in {dimensions} dimensions must be {shape}, "
                f"not {arrays[name].shape}; make the file anew with save_faces"
            )
    return FaceTemplates(**arrays)


def _write(path: Path, arrays: Mapping[str, Any]) -> None:
    """Writes arrays by name, all at once."""
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _read(path: Path, kinds: Mapping[str, type[np.generic]], what: str) -> dict[str, Any]:
    """Reads arrays by name, each of its kind and finite."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _LARGEST_FILE:
            raise SceneError(f"{path}: {size} bytes are too many for {what}")
        with np.load(path, allow_pickle=False) as content:
            missing = [name for name in kinds if name not in content]
            if missing:
                raise SceneError(f"{path}: is not {what}: it has no array '{missing[0]}'")
            arrays = {name: content[name] for name in kinds}
    except OSError as error:
        raise SceneError(f"{path}: cannot read {what}: {error.strerror}") from error
    except (ValueError, zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise SceneError(f"{path}: is not {what}, or is damaged: {error}") from error
    for name, kind in kinds.items():
        if arrays[name].dtype != kind or not np.isfinite(arrays[name]).all():
            raise SceneError(
                f"{path}: '{name}' must be finite numbers of type {np.dtype(kind).name}, not "
                f"{arrays[name].dtype}"
            )
    return arrays


def learn_recorded_faces(folder: Path, skin: SkinColour | None = None) -> FaceTemplates:
    """The eigenspace of faces that a camera recorded.

    The folder holds `directions.csv`, whose first line is `picture,turn,nod`: a picture's file
    beside it (.png or .jpg), and where the face looks in it, away from facing the camera [deg]:
    the turn to the person's left and the nod downwards. Pictures are whole ones as the face camera
    takes them, from any distance. Of each the largest skin-coloured patch is the face. A
    folder `empty` of pictures without the person is needed where other things have skin's colour.

    Raises:
        SceneError: names the file, line or picture at fault.
        SettingsError: fewer than three pictures.
    """
    table = _read_directions(folder / DIRECTIONS)
    background = _read_background(folder / _EMPTY)
    faces = [_read_face(folder / name, background, skin or SkinColour()) for name, _, _ in table]
    directions = np.radians([[turn, nod] for _, turn, nod in table]).reshape(-1, 2)
    return learn_faces(faces, directions)


def _read_directions(path: Path) -> list[tuple[str, float, float]]:
    """Picture, turn and nod [deg] of each line."""
    try:
        text = read_regular(path).decode("utf-8-sig")
        rows = list(csv.reader(io.StringIO(text, newline="")))
    except OSError as error:
        raise SceneError(f"{path}: cannot read the directions: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise SceneError(f"{path}: is no table of comma-separated values: {error}") from error
    if not rows or [cell.strip() for cell in rows[0]] != _COLUMNS:
        raise SceneError(f"{path}: the first line must be {','.join(_COLUMNS)}")
    table: dict[str, tuple[str, float, float]] = {}
    for number, row in enumerate(rows[1:], 2):
        if not row:
            continue
        line = _read_line(row, f"{path}, line {number}")
        if line[0] in table:
            raise SceneError(f"{path}, line {number}: '{line[0]}' has a line already")
        table[line[0]] = line
    return list(table.values())


def _read_line(row: list[str], where: str) -> tuple[str, float, float]:
    cells = [cell.strip() for cell in row]
    try:
        name, turn, nod = cells[0], *(float(cell) for cell in cells[1:])
    except ValueError as error:
        raise SceneError(f"{where}: expected a picture and two angles [deg]: {error}") from error
    if Path(name).name != name or Path(name).suffix.lower() not in SUFFIXES:
        raise SceneError(f"{where}: '{name}' is no picture {' or '.join(SUFFIXES)} in the folder")
    if not (math.isfinite(turn) and math.isfinite(nod) and max(abs(turn), abs(nod)) <= 180.0):
        raise SceneError(f"{where}: turn and nod must be -180 to 180 degrees, not {turn} and {nod}")
    return name, turn, nod


def _read_background(folder: Path) -> Background | None:
    """What is behind the face; None: nothing that matters."""
    if not folder.is_dir():
        return None
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if not files:
        raise SceneError(f"{folder}: holds no picture; remove the folder, or fill it")
    pictures = [read_picture(file, SceneError) for file in files]
    for file, picture in zip(files, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            raise SceneError(f"{file}: is not as large as {files[0].name}")
    return learn_background(pictures)


def _read_face(path: Path, background: Background | None, skin: SkinColour) -> Picture:
    """The face (130, 80, 3) in a picture."""
    picture = read_picture(path, SceneError)
    region = np.ones(picture.shape[:2], dtype=np.bool_)
    if background is not None:
        if background.mean.shape != picture.shape:
            raise SceneError(f"{path}: is not as large as the pictures in '{_EMPTY}'")
        region = person_region(picture, background)
    face = cut_face(picture, skin_blobs(picture, region, skin))
    if face is None:
        raise SceneError(
            f"{path}: no face: nothing in it has the colour of skin, or the largest patch touches "
            f"the picture's edge; take the picture out of {DIRECTIONS}, or learn the skin's colour"
        )
    return face
