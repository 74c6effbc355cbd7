"""Experiment A as a table: the paper's figures, its method here, and others beside it."""

from collections.abc import Mapping, Sequence

from rich.table import Table

from drake_pose.apps.experiments.kameda.experiment import PAPER, ExperimentResult

_ROWS = {
    "images": ("silhouettes", "{}"),
    "mean_e_total": ("mean E_total", "{:.2%}"),
    "exact": ("matched exactly (J = 0)", "{}"),
    "pose_equal": ("of these, every joint angle right", "{}"),
    "improved": ("improved by re-estimation", "{}"),
    "mean_runs": ("runs of step 3, mean", "{:.1f}"),
    "mean_runs_without_worst_seven": ("  mean without the worst seven", "{:.1f}"),
    "min_runs": ("  minimum", "{}"),
    "median_seconds": ("processor seconds an image, median", "{:.3f}"),
    "p95_seconds": ("  95th percentile", "{:.3f}"),
    "not_found": ("no pose found (counted as E_total = 1)", "{}"),
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
_METHODS = {"paper": "the paper's method", "beam": "beam search"}


def experiment_table(results: Sequence[ExperimentResult]) -> Table:
    """The paper's figures and those of some runs, side by side.

    Args:
        results: the runs, one a column.
    """
    columns: list[Mapping[str, float | int | str]] = [PAPER]
    table = Table(title="Kameda, experiment A: one silhouette of a female body")
    table.add_column("figure")
    table.add_column("paper", justify="right")
    for result in results:
        figures = dict(result.as_json())
        if figures["method"] == "beam":
            # Its runs are other steps than the paper's.
            figures = {key: value for key, value in figures.items() if key not in _OF_RUNS}
        table.add_column(_METHODS[str(result.as_json()["method"])], justify="right")
        columns.append(figures)
    for key, (label, form) in _ROWS.items():
        if any(key in column for column in columns):
            cells = [form.format(column[key]) if key in column else "-" for column in columns]
            table.add_row(label, *cells)
    return table
