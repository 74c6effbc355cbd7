"""Reading files that others named: never a pipe, a socket or a device, whose opening may wait."""

from __future__ import annotations

import errno
import hashlib
import stat
from pathlib import Path

_END = 1 << 20
_KINDS = (
    (stat.S_ISDIR, "it is a folder, not a file"),
    (stat.S_ISFIFO, "it is a named pipe, not a file"),
    (stat.S_ISSOCK, "it is a socket, not a file"),
    (stat.S_ISCHR, "it is a device, not a file"),
    (stat.S_ISBLK, "it is a device, not a file"),
)


def read_regular(path: Path, limit: int = -1) -> bytes:
    """A file's content.

    Args:
        path: the file; a link to one is as good.
        limit: at most this many bytes of it are read; all where negative.

    Raises:
        OSError: it cannot be read, or is no regular file; strerror says which.
    """
    require_regular(path)
    with path.open("rb") as file:
        return file.read(limit)


def digest(path: Path) -> str:
    """What tells a file's content from another's: SHA-256 of its size and its ends, 1 MiB each.

    A PNG picture ends with a checksum of all of it, so one that is larger is told apart, too.

    Raises:
        OSError: it cannot be read, or is no regular file.
    """
    size = require_regular(path)
    found = hashlib.sha256(str(size).encode())
    with path.open("rb") as file:
        found.update(file.read(_END))
        file.seek(max(file.tell(), size - _END))
        found.update(file.read(_END))
    return found.hexdigest()


def require_regular(path: Path) -> int:
    """Refuses what is no regular file without opening it: a pipe would wait for its writer.

    Returns:
        The file's size [byte].

    Raises:
        OSError: strerror says what it is.
    """
    status = path.stat()
    for is_kind, text in _KINDS:
        if is_kind(status.st_mode):
            raise OSError(errno.EINVAL, text, str(path))
    return status.st_size
