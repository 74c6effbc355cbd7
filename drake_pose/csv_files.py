"""Read and write small CSV tables."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from drake_pose.errors import DrakePoseError
from drake_pose.regular_files import read_regular


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

    Args:
        error_type: class of the exceptions.
        whole_lines: ignore text after the last line break, which an interrupted writer left.

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
