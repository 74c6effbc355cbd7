"""Experiment A as a table: the paper's figures, its method here, and others beside it."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.table import Table

from drake_pose.papers.kameda.experiment import PAPER, ExperimentResult

_ROWS = {
    "images": ("silhouettes", "{}"),
    "not_found": ("  no pose found", "{}"),
    "mean_e_total": ("mean E_total of the others", "{:.2%}"),
    "exact": ("matched exactly (J = 0)", "{}"),
    "pose_equal": ("of these, every joint angle right", "{}"),
    "wrong_hidden": ("  else: a wrong segment is hidden", "{}"),
    "wrong_inner_edges": ("  else: edges inside differ", "{}"),
    "wrong_alike": ("  else: neither", "{}"),
    "improved": ("improved by re-estimation", "{}"),
    "mean_runs": ("runs of step 3, mean", "{:.1f}"),
    "mean_runs_without_worst_seven": ("  mean without the worst seven", "{:.1f}"),
    "min_runs": ("  minimum", "{}"),
    "median_seconds": ("processor seconds an image, median", "{:.3f}"),
    "p95_seconds": ("  95th percentile", "{:.3f}"),
    "leaving_the_picture": ("bodies that leave the picture", "{}"),
    "exact_inside": ("matched exactly, of those that do not", "{}"),
    "proved": ("proved the best of the grid", "{}"),
    "budget_spent": ("proof or set ended by its time or memory", "{}"),
    "truth_in_set": ("true pose in the set of poses as good", "{}"),
    "complete_sets": ("sets that are complete", "{}"),
    "several_families": ("silhouettes with several families of poses", "{}"),
    "free_joints": ("silhouettes that leave a joint free", "{}"),
    "examination_median_seconds": ("seconds for proof and set, median", "{:.3f}"),
}
_OF_RUNS = ("improved", "mean_runs", "mean_runs_without_worst_seven", "min_runs")
_NOT_SPREAD = ("images", "seed", "outside_weight", "total_seconds")


def spread_over_seeds(results: Sequence[ExperimentResult]) -> dict[str, dict[str, float]]:
    """Mean, smallest and largest of every figure over runs that differ in the seed alone.

    Args:
        results: the runs of one search.
    """
    runs = [result.as_json() for result in results]
    spread = {}
    for key, first in runs[0].items():
        if key not in _NOT_SPREAD and not isinstance(first, str):
            values = np.array([float(run[key]) for run in runs])
            spread[key] = {
                "mean": float(values.mean()),
                "min": float(values.min()),
                "max": float(values.max()),
            }
    return spread


def experiment_table(columns: Sequence[Sequence[ExperimentResult]]) -> Table:
    """The paper's figures and those of some searches, side by side.

    Args:
        columns: for each search its runs, one for each seed; of several the mean is shown, and
            the smallest and largest.
    """
    table = Table(title="Kameda, experiment A: one silhouette of a female body")
    table.add_column("figure")
    table.add_column("paper", justify="right")
    cells: list[Mapping[str, str]] = [
        {key: _ROWS[key][1].format(value) for key, value in PAPER.items()}
    ]
    for runs in columns:
        table.add_column(_heading(runs[0]), justify="right")
        cells.append(_cells(runs))
    for key, (label, _) in _ROWS.items():
        if any(key in column for column in cells):
            table.add_row(label, *(column.get(key, "-") for column in cells))
    return table


def _heading(result: ExperimentResult) -> str:
    figures = result.as_json()
    if figures["method"] == "beam":
        return "beam search"
    if figures["outside_weight"]:
        return f"the same, ordered by e - {figures['outside_weight']:g} outside"
    return "the paper's method"


def _cells(runs: Sequence[ExperimentResult]) -> Mapping[str, str]:
    """The figures of a column, as they are printed."""
    figures, spread = runs[0].as_json(), spread_over_seeds(runs)
    cells = {}
    for key, (_, form) in _ROWS.items():
        # The runs of the beam search are other steps than the paper's.
        if key not in figures or (figures["method"] == "beam" and key in _OF_RUNS):
            continue
        if len(runs) == 1 or key not in spread:
            cells[key] = form.format(figures[key])
        else:
            several = form if "." in form else "{:.1f}"
            low, high = (
                form.format(type(figures[key])(spread[key][end])) for end in ("min", "max")
            )
            cells[key] = f"{several.format(spread[key]['mean'])} ({low} to {high})"
    return cells
