"""Print the tables of benchmarks."""

import os
from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table


def print_table(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table with its first column left-aligned and the others right-aligned."""
    table = Table(title=title)
    for k, heading in enumerate(headings):
        table.add_column(heading, justify="right" if k else "left")
    for row in rows:
        table.add_row(*row)
    Console(width=int(os.environ.get("COLUMNS", "150")), markup=False).print(table)
