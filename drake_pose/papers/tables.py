"""Progress counts, tables and the page report.html of all experiments."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape, render
from rich.table import Table

from drake_pose.files.page import Page, picture_files
from drake_pose.files.page import Table as PageTable
from drake_pose.files.records import describe_warnings

Figures = Mapping[str, Any]
"""Results of an experiment by key."""

Advance = Callable[[int], None]
"""Called with the number that is done."""

Count = Callable[[str, int], Advance]
"""Starts a progress count: called with what is counted, and the total number."""


def uncounted(_what: str, _total: int) -> Advance:
    """Start a count that reports nothing; a ``Count``."""
    return lambda _done: None


def figure_table(
    title: str,
    rows: Mapping[str, tuple[str, str]],
    columns: Mapping[str, Figures],
    heading: str = "figure",
) -> Table:
    """Tabulate figures side by side, one row per figure; figures that no column has are omitted.

    Args:
        title: of the table.
        rows: label and format of each figure, by key.
        columns: figures by heading. A figure that is missing, None or nan is "-".
        heading: of the labels' column.
    """
    table = Table(title=title)
    table.add_column(heading)
    for name in columns:
        table.add_column(escape(name), justify="right")
    for key, (label, form) in rows.items():
        if any(key in one for one in columns.values()):
            values = [one.get(key) for one in columns.values()]
            # Only nan differs from itself.
            cells = ("-" if one is None or one != one else form.format(one) for one in values)
            table.add_row(escape(label), *cells)
    return table


def save_page(folder: Path, shown: Sequence[Table | str], warnings: Sequence[str]) -> None:
    """Write report.html of an experiment: tables and sentences, and the pictures in the folder."""
    sections, answers = dict[str, list[Any]](), list[str]()
    for table in (one for one in shown if isinstance(one, Table)):
        head = [render(str(column.header)).plain for column in table.columns]
        columns = ([render(str(cell)).plain for cell in column.cells] for column in table.columns)
        rows, title = [list(row) for row in zip(*columns, strict=True)], str(table.title)
        sections[title] = [PageTable(head, rows)]
        for label, *cells in (row for row in rows if "-" not in row):
            values = (f"{cell} ({name})" for name, cell in zip(head[1:], cells, strict=True))
            answers.append(f"{label.strip()}: {', '.join(values)}")
    drawn = {one.name: one.stem.replace("_", " ") for one in sorted(folder.glob("*.png"))}
    name = next(iter(sections))
    sections["Pictures"] = [[one] for one in picture_files(folder, drawn, 1100)]
    answer = f"{name}. {'; '.join(answers[:3])}."
    about = ["Our figures beside the published ones.", *(k for k in shown if isinstance(k, str))]
    Page(name, " ".join(about), answer, describe_warnings(warnings),
         sections).write(folder)  # fmt: skip
