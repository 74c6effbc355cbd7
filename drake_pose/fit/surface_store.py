"""Cache of simplified surfaces on disk, beside the compiled kernels, for later processes.

A file's name is a digest of everything the surface depends on. The file starts with a digest of its
content; a truncated or modified file is replaced. If no folder is writable, nothing is stored.
"""

import hashlib
import io
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from drake_pose.compiled import kernel_folder
from drake_pose.silhouette.outline import Outline, outline_of_triangles


def load_or_make(
    made_of: tuple[bytes, ...],
    make: Callable[[], Outline],
    least_time: float = 0.004,
    most_files: int = 500,
) -> Outline:
    """Return a surface from its file, or make and store it.

    Args:
        made_of: everything the surface depends on, including versions of the code that makes it;
            its digest is the file's name.
        make: makes the surface; it is called if there is no valid file.
        least_time: minimum time [s] of making a surface for it to be stored; reading a file takes
            about a millisecond.
        most_files: maximum number of files (60 kB for 2500 triangles); the least recently used ones
            are removed.
    """
    kernels = kernel_folder()
    if kernels is None:
        return make()
    digest = hashlib.sha256()
    for part in made_of:
        digest.update(len(part).to_bytes(8, "little") + part)
    path = kernels / "surfaces" / f"{digest.hexdigest()}.surface"
    outline = _read(path)
    if outline is None:
        start = time.perf_counter()
        outline = make()
        if time.perf_counter() - start >= least_time:
            with suppress(OSError):  # The disk is full or the folder is not writable.
                _write(path, outline)
                ages = sorted(
                    (one.stat().st_mtime, one) for one in path.parent.iterdir() if one.is_file()
                )
                for _, one in ages[: max(0, len(ages) - most_files)]:
                    with suppress(OSError):
                        one.unlink()
    return outline


def _read(path: Path) -> Outline | None:
    """Return a stored surface; None if there is no file, or its content was altered."""
    try:
        content = path.read_bytes()
        if hashlib.sha256(content[32:]).digest() != content[:32]:
            return None
        with np.load(io.BytesIO(content[32:]), allow_pickle=False) as arrays:
            outline = outline_of_triangles(arrays["vertices"], arrays["triangles"])
    except (OSError, ValueError, KeyError):
        return None
    with suppress(OSError):
        os.utime(path)
    return outline


def _write(path: Path, outline: Outline) -> None:
    """Store a surface atomically, so that processes storing the same one do not interfere.

    Raises OSError: the file cannot be written.
    """
    buffer = io.BytesIO()
    np.savez(buffer, vertices=outline.vertices, triangles=outline.triangles)
    payload = buffer.getvalue()
    path.parent.mkdir(exist_ok=True)
    part = path.with_suffix(f".{os.getpid()}.{time.monotonic_ns()}.part")
    try:
        part.write_bytes(hashlib.sha256(payload).digest() + payload)
        part.replace(path)
    except OSError:
        with suppress(OSError):
            part.unlink()
        raise
