"""Reading small tables of comma-separated values that others wrote."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from drake_pose.errors import DrakePoseError
from drake_pose.regular_files import read_regular


def read_csv(
    path: Path, error_type: type[DrakePoseError]
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Returns the first line's columns, and each other line's number and cells, without spaces.

    Raises:
        error_type: names the file; it cannot be read, or a line has more or fewer cells.
    """
    try:
        text = read_regular(path).decode("utf-8-sig")
        reader = csv.reader(io.StringIO(text, newline=""))
        lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else f"not a CSV file: {error}"
        raise error_type(f"{path}: cannot read it: {reason}") from error
    if not lines:
        raise error_type(f"{path}: is empty")
    (_, header), *rows = lines
    for line, row in rows:
        if len(row) != len(header):
            raise error_type(
                f"{path}: line {line} has {len(row)} columns, but the first has {len(header)}"
            )
    return header, rows
