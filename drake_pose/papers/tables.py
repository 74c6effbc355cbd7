"""Progress counts, tables and pictures shared by all experiments."""

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
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


def spread_over_seeds(
    runs: Sequence[Figures], without: Sequence[str] = ()
) -> dict[str, dict[str, float]]:
    """Return "mean", "min" and "max" of each figure by key, over runs that differ in the seed only.

    `runs` are the figures of each run. Figures that are no numbers, and the keys of `without`, are
    left out.
    """
    spread = {}
    for key, first in runs[0].items():
        if key not in without and isinstance(first, int | float):
            values = np.array([float(run[key]) for run in runs])
            spread[key] = {
                "mean": float(values.mean()),
                "min": float(values.min()),
                "max": float(values.max()),
            }
    return spread


def figure_table(
    title: str,
    rows: Mapping[str, tuple[str, str]],
    columns: Mapping[str, Figures | Sequence[Figures]],
    heading: str = "figure",
) -> Table:
    """Tabulate figures side by side, one row per figure; figures that no column has are omitted.

    Args:
        title: of the table.
        rows: label and format of each figure, by key.
        columns: figures of one run, or of several runs, by heading; of several runs mean, minimum
            and maximum are shown. A figure that is missing, None or nan is shown as "-".
        heading: of the labels' column.
    """
    table = Table(title=title)
    table.add_column(heading)
    for name in columns:
        table.add_column(escape(name), justify="right")
    runs = [[one] if isinstance(one, Mapping) else one for one in columns.values()]
    for key, (label, form) in rows.items():
        if any(key in one[0] for one in runs):
            table.add_row(
                escape(label), *(_cell([run.get(key) for run in one], form) for one in runs)
            )
    return table


def _cell(values: Sequence[Any], form: str) -> str:
    """Format a figure; different values by mean, minimum, maximum; "-" if any is None or nan."""
    if any(value is None or (isinstance(value, float) and math.isnan(value)) for value in values):
        return "-"
    if len(set(values)) == 1:
        return form.format(values[0])
    mean = (form if "." in form else "{:.1f}").format(float(np.mean(values)))
    return f"{mean} ({form.format(min(values))} to {form.format(max(values))})"


def draw_panels(
    columns: Sequence[Sequence[NDArray[Any]]],
    titles: Sequence[str],
    labels: Sequence[str] = (),
    below: Sequence[str] = (),
    title: str = "",
) -> Figure:
    """Draw columns of pictures (H, W, 3).

    Args:
        columns: pictures of each column, from top to bottom; all have the same number.
        titles: above each column.
        labels: beside the rows, from the top.
        below: below the columns, from the left.
        title: above all.
    """
    figure = Figure(figsize=(3.1 * len(columns), 3.1 * len(columns[0])))
    axes = figure.subplots(len(columns[0]), len(columns), squeeze=False)
    for line, pictures in zip(axes.T, columns, strict=True):
        for axis, picture in zip(line, pictures, strict=True):
            axis.imshow(picture)
            axis.set(xticks=[], yticks=[])
    for axis, text in zip(axes[0], titles, strict=True):
        axis.set_title(text, fontsize=9)
    for axis, text in zip(axes[-1], below, strict=False):
        axis.set_xlabel(text, fontsize=8)
    for axis, text in zip(axes[:, 0], labels, strict=False):
        axis.set_ylabel(text)
    if title:
        lines = [textwrap.fill(line, 40 * len(columns)) for line in title.split("\n")]
        figure.suptitle("\n".join(lines), fontsize=10)
    return figure


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure as a PNG file; its folder is made if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.set_layout_engine("tight")
    figure.savefig(path, dpi=90)
    return path


def save_picture(picture: NDArray[np.uint8], path: Path) -> Path:
    """Write a picture (H, W, 3) as a PNG file; its folder is made if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.ascontiguousarray(picture[:, :, ::-1]))
    return path
