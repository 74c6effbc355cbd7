"""Reading files that others named: never a pipe, a socket or a device, whose opening may wait."""

import errno
import hashlib
import stat
from pathlib import Path


def read_regular(path: Path, limit: int = -1) -> bytes:
    """A file's content, or that of what a link leads to; at most ``limit`` bytes, if not negative.

    Raises:
        OSError: it cannot be read, is no regular file, or larger than 2 GiB; strerror says which.
    """
    if require_regular(path) > 1 << 31 and limit < 0:
        raise OSError(errno.EFBIG, "it is larger than 2 GiB", str(path))
    with path.open("rb") as file:
        return file.read(limit)


def digest(path: Path) -> str:
    """What tells a file's content from another's: SHA-256 of its size and its ends, 1 MiB each.

    A PNG picture ends with a checksum of all of it, so one that is larger is told apart, too.

    Raises:
        OSError: it cannot be read, or is no regular file.
    """
    size, end = require_regular(path), 1 << 20
    found = hashlib.sha256(str(size).encode())
    with path.open("rb") as file:
        found.update(file.read(end))
        file.seek(max(file.tell(), size - end))
        found.update(file.read(end))
    return found.hexdigest()


def require_regular(path: Path) -> int:
    """A file's size [byte], without opening it: a pipe would wait for its writer.

    Raises:
        OSError: it is no regular file; strerror says what it is.
    """
    kinds = {stat.S_IFDIR: "folder", stat.S_IFIFO: "named pipe", stat.S_IFSOCK: "socket"}
    kinds |= dict.fromkeys((stat.S_IFCHR, stat.S_IFBLK), "device")
    status = path.stat()
    kind = kinds.get(stat.S_IFMT(status.st_mode))
    if kind is not None:
        raise OSError(errno.EINVAL, f"it is a {kind}, not a file", str(path))
    return status.st_size
