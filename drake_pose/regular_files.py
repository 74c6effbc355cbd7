"""Reading files that others named: never a pipe, a socket or a device, whose opening may wait."""

from __future__ import annotations

import errno
import hashlib
import stat
from pathlib import Path

_END = 1 << 20
# What is read whole is no larger [byte].
_LARGEST = 1 << 31
_KINDS = {
    stat.S_IFDIR: "folder",
    stat.S_IFIFO: "named pipe",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
}


def read_regular(path: Path, limit: int = -1) -> bytes:
    """A file's content, or that of what a link leads to; at most ``limit`` bytes, if not negative.

    Raises:
        OSError: it cannot be read, is no regular file, or too large; strerror says which.
    """
    if require_regular(path) > _LARGEST and limit < 0:
        raise OSError(errno.EFBIG, f"it is larger than {_LARGEST >> 30} GiB", str(path))
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
    """A file's size [byte], without opening it: a pipe would wait for its writer.

    Raises:
        OSError: it is no regular file; strerror says what it is.
    """
    status = path.stat()
    kind = _KINDS.get(stat.S_IFMT(status.st_mode))
    if kind is not None:
        raise OSError(errno.EINVAL, f"it is a {kind}, not a file", str(path))
    return status.st_size
