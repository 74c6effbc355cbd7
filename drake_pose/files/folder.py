"""The result folder: tables of poses and joints, files of motion, pages, overlays, a summary.

Files are moved into place: none is ever half there.
"""

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
TRC, MOT, BVH = "joint_centres.trc", "positions.mot", "motion.bvh"
OVERLAY, SHAPES = "overlay", "shapes.png"

_Job = TypeVar("_Job", bound=Callable[..., Any])

RESULT_FILES = (
    POSES, JOINTS, MODES, SUMMARY, REPLAY, REPORT, JOINT_CENTRES, TRC, MOT, BVH, SHAPES
)  # fmt: skip
"""Every file that a result may have beside its overlays."""


def write_file(folder: Path, name: str, content: bytes | str) -> None:
    """Write a file, by its path within the folder, all at once, making the folders it needs.

    Raises:
        OutputError: it cannot be written.
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
    """Write summary.json; numbers that are not finite become null."""
    text = json.dumps(without_nan(summary), indent=2, allow_nan=False, ensure_ascii=False)
    write_file(folder, SUMMARY, text + "\n")


@contextmanager
def claimed(path: Path, resume: bool = False) -> Iterator[None]:
    """Keeps other runs out of a result's folder, which is made; only to resume may it hold files.

    The lock is the system's, on the folder itself: it ends with the process, whatever ends that.

    Raises:
        OutputError: another run is writing there, it is not empty, or there cannot be a folder.
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
            f"{path}: another run is writing its result there; wait for it, or name another folder "
            "with --out"
        ) from None
    except OSError:
        pass  # Some disks that computers share know no locks.
    try:
        if not resume and any(path.iterdir()):
            raise OutputError(
                f"{path}: the output folder exists and is not empty; name another one with --out, "
                "or go on with an interrupted result in it with --resume"
            )
        yield
    finally:
        with suppress(OSError):
            for place in made:
                place.rmdir()  # Where nothing was written nothing is left.
        os.close(folder)


def writes_folder(job: _Job) -> _Job:
    """A job whose argument ``out`` names a folder, if any, that is claimed while it runs.

    Where it is called from Python its errors name arguments, not options.
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
    """Refuses a folder that cannot be, since it or what it would lie in is a file."""
    existing = next((place for place in (path, *path.parents) if os.path.lexists(place)), None)
    if existing is not None and not existing.is_dir():
        what = "a file" if existing.exists() else "a link that leads nowhere"
        raise OutputError(f"{existing}: is {what}, but the result is a folder; name another one")


def read_summary(path: Path) -> dict[str, Any]:
    """Reads the summary.json of a result folder; OutputError: there is none, or it is damaged."""
    require_no_file(path)
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
    # Most values are numbers and texts.
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
    """The error of a file that cannot be written."""
    return OutputError(f"{path}: cannot be written: {error.strerror}")
