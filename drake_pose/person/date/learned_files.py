"""What was learned of a camera's background and of a face, kept in files (.npz, plain arrays)."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.errors import OutputError, SceneError
from drake_pose.person.date.faces import FACE_HEIGHT, FACE_WIDTH, FaceTemplates
from drake_pose.silhouette.segmentation.background import Background

_LARGEST_FILE = 1 << 30
_PIXELS = 3 * FACE_WIDTH * FACE_HEIGHT


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


_FACES: Mapping[str, type[np.generic]] = {
    "mean": np.float32,
    "basis": np.float32,
    "coordinates": np.float32,
    "directions": np.float64,
}


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
