"""Small tables of comma-separated values: those that others wrote, and our own."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from drake_pose.errors import DrakePoseError
from drake_pose.regular_files import read_regular


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """The text of a table."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def read_number(cell: str) -> float:
    """The number that a cell holds; nan where it is empty.

    Raises ValueError: it holds none. Python reads 1_8 as 18; tables mean no such thing.
    """
    if "_" in cell:
        raise ValueError(f"'{cell[:40]}' is no number")
    return float(cell or "nan")


def read_csv(
    path: Path, error_type: type[DrakePoseError], *, whole_lines: bool = False
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Returns the first line's columns, and each other line's number and cells, without spaces.

    whole_lines: what follows the last line break is a row that an interruption cut off.

    Raises:
        error_type: names the file; it cannot be read, its columns are separated otherwise, or a
            line has more or fewer cells.
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
    named = {";": "semicolons", "\t": "tabs"}
    others = [name for sign, name in named.items() if any(sign in cell for cell in header)]
    if others:
        raise error_type(
            f"{path}: its first line has {others[0]}; columns are separated by commas, and "
            "decimals begin with a point: save it as CSV with commas"
        )
    for line, row in rows:
        if len(row) != len(header):
            raise error_type(
                f"{path}: line {line} has {len(row)} columns, but the first has {len(header)}"
            )
    return header, rows
