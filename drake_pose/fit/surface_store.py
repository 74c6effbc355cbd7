"""Simplified surfaces on disk, beside the compiled kernels: the next process loads them.

A file's name is a digest of all that it was made of. It begins with a digest of what follows, so a
file that was cut or changed is made again. Where no folder can be written nothing is stored.
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


def stored(
    made_of: tuple[bytes, ...],
    make: Callable[[], Outline],
    least_time: float = 0.1,
    most_files: int = 500,
) -> Outline:
    """A surface from its file, or made and stored.

    Args:
        made_of: what tells this surface from all others, with what may change how it is made.
        make: makes it.
        least_time: what is made in less [s] is not stored: such surfaces are many, of persons
            whose shape is fitted, and a file saves little.
        most_files: those that were not used for longest are removed beyond so many (a surface of
            2500 triangles takes 60 kB).
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
            with suppress(OSError):  # A full disk, or a folder of somebody else's.
                _write(path, outline)
                _remove_oldest(path.parent, most_files)
    return outline


def _read(path: Path) -> Outline | None:
    """A stored surface; None where there is none, or the file is not what was written."""
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
    """Stores a surface all at once: processes that store the same one do not meet."""
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


def _remove_oldest(folder: Path, most: int) -> None:
    """Removes the files that were not used for longest, and what stopped processes left."""
    ages = sorted((one.stat().st_mtime, one) for one in folder.iterdir() if one.is_file())
    for _, one in ages[: max(0, len(ages) - most)]:
        with suppress(OSError):
            one.unlink()
