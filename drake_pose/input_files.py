"""Read small files of users: CSV tables, YAML, and bytes.

Only regular files are read: opening a pipe, socket or device may block.
"""

import csv
import errno
import hashlib
import io
import stat
from collections.abc import Collection, Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydrake.common.yaml import yaml_load_typed

from drake_pose.errors import DrakePoseError


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


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return the CSV text of a table's rows, each a sequence of cells; lines end with LF."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def read_number(cell: str) -> float:
    """Return the number in a cell; nan if the cell is empty.

    Raises ValueError: the cell is not a number. Digit separators (1_8), which Python accepts, are
    refused.
    """
    if "_" in cell:
        raise ValueError(f"'{cell[:40]}' is not a number")
    return float(cell or "nan")


def read_csv(
    path: Path, error_type: type[DrakePoseError], *, whole_lines: bool = False
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header of a CSV file, and the line number and cells of each further line.

    Cells are stripped of surrounding spaces.

    ``error_type``: class of the exceptions. ``whole_lines``: ignore text after the last line break,
    which an interrupted writer left.

    Raises error_type: the file is unreadable or empty, its columns are not separated by commas, or
    a line has a different number of cells than the header. The message names the file.
    """
    try:
        text = read_regular(path).decode("utf-8-sig")
        text = text[: text.rfind("\n") + 1] if whole_lines else text
        reader = csv.reader(io.StringIO(text, newline=""))
        lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else f"not a CSV file: {error}"
        raise error_type(f"{path}: cannot read it: {reason}") from error
    if not lines:
        raise error_type(f"{path}: is empty")
    (_, header), *rows = lines
    separators = {";": "semicolons", "\t": "tabs"}
    found = [name for sign, name in separators.items() if any(sign in cell for cell in header)]
    if found:
        raise error_type(
            f"{path}: its first line contains {found[0]}; save the table with commas between "
            "columns and points as decimal separators"
        )
    for line, row in rows:
        if len(row) != len(header):
            raise error_type(
                f"{path}: line {line} has {len(row)} columns, but the first has {len(header)}"
            )
    return header, rows


_Schema = TypeVar("_Schema")


class _UniqueKeyLoader(yaml.SafeLoader):
    """Safe loader that refuses NUL characters and duplicate keys (PyYAML keeps the last one)."""

    def construct_scalar(self, node: yaml.ScalarNode) -> Any:
        value = super().construct_scalar(node)
        if "\0" in str(value):
            raise yaml.constructor.ConstructorError(
                None, None, "a text contains NUL", node.start_mark
            )
        return value

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        mapping = super().construct_mapping(node, deep=deep)
        if len(mapping) != len(node.value):
            raise yaml.constructor.ConstructorError(
                None, None, "a key is given twice (or merged with <<)", node.start_mark
            )
        return mapping


def _construct_tagged(loader: _UniqueKeyLoader, suffix: str, node: yaml.Node) -> Any:
    """Return a node with a tag ``!suffix``, the key ``_tag`` of a mapping; others lose it.

    pydrake.common.yaml does the same.
    """
    if isinstance(node, yaml.MappingNode):
        return {"_tag": f"!{suffix}", **loader.construct_mapping(node, deep=True)}
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


_UniqueKeyLoader.add_multi_constructor("!", _construct_tagged)


def read_yaml(path: Path, error_type: type[DrakePoseError], largest: int = 1 << 20) -> Any:
    """Return the content of a YAML file as plain values.

    Local tags of mappings, as Drake's files have them, are stored under the key ``_tag``. Aliases
    stay references, so a small file cannot exhaust the memory unless the caller walks through every
    copy.

    ``largest``: maximum size of the file [byte].

    Raises error_type: the file is unreadable, too large or invalid. The message names the file.
    """
    try:
        data = read_regular(path, largest + 1)
    except OSError as error:
        raise error_type(f"{path}: cannot read it: {error.strerror}") from error
    if len(data) > largest:
        raise error_type(f"{path}: larger than the maximum of {largest} bytes")
    try:
        # The loader derives from yaml.SafeLoader.
        return yaml.load(data, Loader=_UniqueKeyLoader)
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise error_type(f"{path}: not a YAML file: {' '.join(str(error).split())}") from error
    except RecursionError:
        raise error_type(f"{path}: nested too deeply") from None


def named_fields(
    value: Any, known: Collection[str], where: str, error_type: type[DrakePoseError]
) -> dict[str, Any]:
    """Return a value of a YAML file, checked to be a mapping with no other keys than ``known``.

    Raises error_type, begun by ``where``: it is no mapping, or has other keys.
    """
    if not isinstance(value, dict):
        raise error_type(f"{where}: expected a mapping of {', '.join(known)}")
    unknown = [str(key)[:40] for key in value if key not in known]
    if unknown:
        raise error_type(
            f"{where}: unknown field {', '.join(unknown)}; there are: {', '.join(known)}"
        )
    return value


def typed_entry(
    entry: Any, schema: type[_Schema], where: str, error_type: type[DrakePoseError]
) -> _Schema:
    """Return an entry of a YAML file as an instance of a dataclass, by ``yaml_load_typed``.

    Args:
        entry: plain values as from ``read_yaml``, with the dataclass's fields as keys.
        schema: the dataclass.
        where: start of the error message.
        error_type: class of the exception.

    Raises error_type: a field is unknown or has the wrong type.
    """
    try:
        return yaml_load_typed(schema=schema, data=yaml.safe_dump(entry))
    # Drake's reader raises any of these for values of the wrong type.
    except (RuntimeError, ValueError, TypeError, AttributeError, AssertionError) as error:
        names = ", ".join(one.name for one in fields(schema))  # type: ignore[arg-type]
        raise error_type(f"{where}: expected a mapping of {names}: {error}") from error
