"""Result folders: names of their files, locking, atomic writing, and summary.json."""

import fcntl
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from drake_pose.errors import DrakePoseError, OutputError, for_caller

POSES = "poses.csv"
JOINTS = "joints.csv"
MODES = "modes.csv"
SUMMARY = "summary.json"
REPLAY, REPORT = "replay.html", "report.html"
JOINT_CENTRES = "joint_centres.csv"
TRC, MOT = "joint_centres.trc", "positions.mot"
OVERLAY, SHAPES = "overlay", "shapes.png"

OVERLAY_MODES, AS_GIVEN = "overlay_modes", "overlay_as_given"
"""Folders of drawn modes, and of pictures that compare what was given and what was found."""

_Job = TypeVar("_Job", bound=Callable[..., Any])

RESULT_FILES = (
    POSES, JOINTS, MODES, SUMMARY, REPLAY, REPORT, JOINT_CENTRES, TRC, MOT, SHAPES
)  # fmt: skip
"""Names of all files that a result may have, without its overlays."""


def write_file(folder: Path, name: str, content: bytes | str) -> None:
    """Write bytes or text (UTF-8) atomically to a file; missing folders are created.

    ``name``: its path relative to ``folder``. Raises OutputError: the file cannot be written.
    """
    path = folder / name
    temporary = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(temporary, path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise cannot_write(path, error) from error


def write_summary(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write a mapping to summary.json in a result folder, as `without_nan` converts it to JSON."""
    try:
        text = _json_text(summary)
    except (TypeError, ValueError):  # It has arrays, or numbers that are not finite.
        text = _json_text(without_nan(summary))
    write_file(folder, SUMMARY, text + "\n")


def _json_text(value: Any, levels: int = 2, indent: str = "\n") -> str:
    """Return a JSON value as text; mappings on the first levels have a line for each key.

    What lies deeper, such as the content of a frame, takes one line, which is written ten times as
    fast.

    ``value``: plain JSON value, as of `without_nan`. ``levels``: number of levels that are broken.
    ``indent``: end of line, and spaces of the present level.
    """
    if not (levels and isinstance(value, dict) and value):
        return json.dumps(value, allow_nan=False, ensure_ascii=False)
    inner = indent + "  "
    lines = [
        f"{inner}{_json_text(key, 0)}: {_json_text(one, levels - 1, inner)}"
        for key, one in value.items()
    ]
    return "{" + ",".join(lines) + indent + "}"


@contextmanager
def claimed(path: Path, resume: bool = False) -> Iterator[None]:
    """Create and lock a result folder; folders created here that stay empty are removed at the end.

    The lock is flock's on the folder itself, so that it ends with the process.

    ``path``: the folder. ``resume``: whether the folder may already hold files; False: it must be
    new or empty.

    Raises OutputError: another run is writing there, the folder is not empty, or it cannot be
    created.
    """
    require_no_file(path)
    made = [place for place in (path, *path.parents) if not os.path.lexists(place)]
    try:
        path.mkdir(parents=True, exist_ok=True)
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise cannot_write(path, error) from error
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(folder)
        raise OutputError(
            f"{path}: another run is writing its result there; wait for it, or choose another "
            "folder with --out"
        ) from None
    except OSError:
        pass  # Some network file systems have no locks.
    try:
        if not resume and any(path.iterdir()):
            raise OutputError(
                f"{path}: the output folder exists and is not empty; choose another one with "
                "--out, or continue an interrupted result in it with --resume"
            )
        yield
    finally:
        with suppress(OSError):
            for place in made:
                place.rmdir()
        os.close(folder)


def writes_folder(job: _Job) -> _Job:
    """Decorate a function so that the folder of its argument ``out`` is locked while it runs.

    See `claimed`; ``resume`` is an argument of the function, too (False if it has none). Nothing is
    locked if ``out`` is None. Error messages name Python arguments instead of options when the
    function is called from Python.
    """

    @wraps(job)
    def run(*args: Any, **kwargs: Any) -> Any:
        given = signature(job).bind(*args, **kwargs).arguments
        try:
            if given.get("out") is None:
                return job(*args, **kwargs)
            with claimed(Path(given["out"]), given.get("resume", False)):
                return job(*args, **kwargs)
        except DrakePoseError as error:
            error.args = (for_caller(str(error)),)
            raise

    return cast(_Job, run)


def require_no_file(path: Path) -> None:
    """Raise an OutputError if a result folder, or a folder above it, is a file."""
    existing = next((place for place in (path, *path.parents) if os.path.lexists(place)), None)
    if existing is not None and not existing.is_dir():
        what = "a file" if existing.exists() else "a broken link"
        raise OutputError(f"{existing}: is {what}, but the result is a folder; choose another one")


def read_summary(path: Path) -> dict[str, Any]:
    """Return the content of summary.json in the result folder ``path``.

    Raises OutputError: the file is missing or damaged.
    """
    require_no_file(path)
    file = path / SUMMARY
    try:
        summary = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise OutputError(
            f"{file}: cannot be read ({error.strerror}); this is not a result folder"
        ) from error
    except ValueError as error:
        raise OutputError(f"{file}: is damaged; it is not JSON") from error
    if not isinstance(summary, dict):
        raise OutputError(f"{file}: is damaged; it is not a JSON object")
    return summary


def without_nan(value: Any) -> Any:
    """Return nested values as plain JSON values: arrays and tuples become lists.

    Numbers that are not finite become None, keys of mappings strings; other values stay.
    """
    # The most frequent types come first.
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        return {str(key): without_nan(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return without_nan(value.tolist())
    if isinstance(value, list | tuple):
        return [without_nan(entry) for entry in value]
    return value


def cannot_write(path: Path, error: OSError) -> OutputError:
    """Return the exception to raise for a file that cannot be written because of ``error``."""
    return OutputError(f"{path}: cannot be written: {error.strerror}")
