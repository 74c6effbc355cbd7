"""Read regular files only: opening a pipe, socket or device given by a user may block."""

import errno
import hashlib
import stat
from pathlib import Path


def read_regular(path: Path, limit: int = -1) -> bytes:
    """Return the content of a file; links are followed.

    ``limit``: maximum number of bytes that are read; negative: the whole file. Raises OSError: the
    file is unreadable, not a regular file, or, without limit, larger than 2 GiB; its strerror gives
    the reason.
    """
    if require_regular(path) > 1 << 31 and limit < 0:
        raise OSError(errno.EFBIG, "it is larger than 2 GiB", str(path))
    with path.open("rb") as file:
        return file.read(limit)


def digest(path: Path) -> str:
    """Return the SHA-256 of a file's size and its first and last MiB, which identifies its content.

    Large PNG files are identified too, because their last bytes are a checksum of the whole file.

    Raises OSError: the file is unreadable or not a regular file.
    """
    size, end = require_regular(path), 1 << 20
    found = hashlib.sha256(str(size).encode())
    with path.open("rb") as file:
        found.update(file.read(end))
        file.seek(max(file.tell(), size - end))
        found.update(file.read(end))
    return found.hexdigest()


def pointer_hint(path: Path) -> str:
    """Return how to fetch a file of which there is only Git LFS's pointer; "" for other files."""
    try:
        is_pointer = read_regular(path, 40).startswith(b"version https://git-lfs")
    except OSError:
        return ""
    return "; it is a pointer of Git LFS: git lfs pull fetches the file" if is_pointer else ""


def require_regular(path: Path) -> int:
    """Return a file's size [byte] without opening the file, since opening a pipe blocks.

    Raises OSError: it is not a regular file; strerror names its kind.
    """
    kinds = {stat.S_IFDIR: "folder", stat.S_IFIFO: "named pipe", stat.S_IFSOCK: "socket"}
    kinds |= dict.fromkeys((stat.S_IFCHR, stat.S_IFBLK), "device")
    status = path.stat()
    kind = kinds.get(stat.S_IFMT(status.st_mode))
    if kind is not None:
        raise OSError(errno.EINVAL, f"it is a {kind}, not a file", str(path))
    return status.st_size
