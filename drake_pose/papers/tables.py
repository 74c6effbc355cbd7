"""Progress counts and tables shared by all experiments."""

from collections.abc import Callable, Mapping
from typing import Any

from rich.markup import escape
from rich.table import Table

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
        columns: figures by heading. A figure that is missing, None or nan is shown as "-".
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
