"""The figures of Kameda's experiment A, on the grid and between, and their tables."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from drake_pose.papers.kameda import PAPER_IMAGES, ExperimentResult
from drake_pose.papers.tables import figure_table, spread_over_seeds
from drake_pose.search.continuous.families import CONFIDENCE
from drake_pose.search.continuous.search import ContinuousSearch
from drake_pose.search.grid.pose_families import GridPoseSet
from drake_pose.search.kameda import PaperSearch

PAPER = {
    "images": PAPER_IMAGES,
    "mean_e_total": 0.0227,
    "exact": 135,
    "pose_equal": 101,
    "wrong_hidden": 14,
    "wrong_inner_edges": 22,
    "improved": 75,
    "mean_runs": 26.2,
    "mean_runs_without_worst_seven": 20.1,
    "min_runs": 15,
}
"""The figures of section 6.1. The paper states no seconds."""

# Positions that the experiment holds have a span of this or less [rad or m].
_HELD = 1e-9
# The runs of the beam search are other steps than the paper's.
_OF_RUNS = ("improved", "mean_runs", "mean_runs_without_worst_seven", "min_runs")
_NO_OUTCOME = ("images", "seed", "outside_weight", "total_seconds", "tolerance")
_GRID_ROWS = {
    "images": ("silhouettes", "{}"),
    "renderer": ("  drawn by", "{}"),
    "tolerance": ("  equal within [pixel]", "{:.0f}"),
    "not_found": ("  no pose found", "{}"),
    "mean_e_total": ("mean E_total of the others", "{:.2%}"),
    "exact": ("matched exactly, or within that", "{}"),
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
    "proved": ("proved: so matched, or the best of the grid", "{}"),
    "budget_spent": ("proof or set ended by its time or memory", "{}"),
    "truth_in_set": ("true pose in the set of poses as good", "{}"),
    "complete_sets": ("sets that are complete", "{}"),
    "several_families": ("silhouettes with several families of poses", "{}"),
    "free_joints": ("silhouettes that leave a joint free", "{}"),
    "examination_median_seconds": ("seconds for proof and set, median", "{:.3f}"),
}
_CONTINUOUS_ROWS = {
    "images": ("poses", "{}"),
    "renderer": ("  drawn by", "{}"),
    "views": ("cameras", "{}"),
    "median_e_total": ("E_total, median", "{:.2%}"),
    "mean_e_total": ("  mean", "{:.2%}"),
    "median_determined_error_deg": ("error of determined joints, median [deg]", "{:.2f}"),
    "median_error_deg": ("  of all joints", "{:.2f}"),
    "determined": ("joints that are determined", "{:.0%}"),
    "interval_coverage": ("truth inside their intervals", "{:.1%}"),
    "interval_confidence": ("  as the intervals claim", "{:.1%}"),
    "median_seconds": ("processor seconds a pose, median", "{:.2f}"),
    "mean_interval_seconds": ("  for its intervals", "{:.2f}"),
}


def grid_figures(*runs: ExperimentResult) -> dict[str, Any]:
    """The figures under the names of ``PAPER``; of runs with several seeds, the spread, too.

    E_total is over the silhouettes for which a pose was found; ``not_found`` counts the others.
    """
    every = [_grid_figures(run) for run in runs]
    if len(runs) == 1:
        return every[0]
    return {**every[0], "spread": spread_over_seeds(every, _NO_OUTCOME)}


def _grid_figures(result: ExperimentResult) -> dict[str, Any]:
    trials = result.trials
    found = [trial.result for trial in trials]
    E_total = [one.E_total for one in found if one.found]
    runs = np.sort([one.statistics.runs for one in found])
    seconds = [trial.seconds for trial in trials]
    causes = [trial.causes for trial in trials if trial.causes is not None]
    figures = {
        "images": len(trials),
        "mean_e_total": float(np.mean(E_total)) if E_total else math.nan,
        "exact": sum(trial.exact for trial in trials),
        "pose_equal": sum(trial.pose_equal for trial in trials),
        "wrong_hidden": sum(one.hidden for one in causes),
        "wrong_inner_edges": sum(one.inner_edges for one in causes),
        "wrong_alike": sum(not any(one) for one in causes),
        "improved": sum(trial.improved for trial in trials),
        "mean_runs": float(np.mean(runs)),
        "mean_runs_without_worst_seven": float(np.mean(runs[:-7] if len(runs) > 7 else runs)),
        "min_runs": int(runs[0]),
        "median_seconds": float(np.median(seconds)),
        "p95_seconds": float(np.quantile(seconds, 0.95)),
        "total_seconds": float(np.sum(seconds)),
        "not_found": len(trials) - len(E_total),
        "stopped_by_run_limit": sum(one.stopped_by == "run_limit" for one in found),
        "leaving_the_picture": sum(not trial.inside for trial in trials),
        "seed": result.seed,
        "angles": "grid",
        "renderer": result.renderer,
        "tolerance": max(trial.tolerance for trial in trials),
    }
    if isinstance(result.search, PaperSearch):
        weight = result.search.settings.outside_weight
        return {**figures, "method": "paper", "outside_weight": weight}
    sets = [(trial, trial.result.pose_set) for trial in trials]
    known = [one for _, one in sets if one is not None]
    named = [one.contains(trial.true_values) for trial, one in sets if isinstance(one, GridPoseSet)]
    return {
        **figures,
        "method": "beam",
        # None can be told from one that is matched within what renderers differ by.
        "proved": sum(trial.exact or trial.result.proved_optimal for trial in trials),
        "exact_inside": sum(trial.exact for trial in trials if trial.inside),
        "truth_in_set": sum(named),
        "budget_spent": sum(one.budget_spent for one in found),
        "complete_sets": sum(one.complete for one in known),
        "several_families": sum(one.family_count > 1 for one in known),
        "free_joints": sum(not all(one.determined) for one in known),
        "examination_median_seconds": float(np.median([trial.more_seconds for trial in trials])),
    }


def grid_table(columns: Sequence[Sequence[ExperimentResult]]) -> Table:
    """The paper's figures and those of some searches, for each its runs, one for each seed."""
    shown: dict[str, Any] = {"paper": PAPER}
    for runs in columns:
        figures = [_grid_figures(run) for run in runs]
        if figures[0]["method"] == "beam":
            own = figures[0]["renderer"] == "own"
            shown["beam search" + (", own drawing" if own else "")] = [
                {key: value for key, value in one.items() if key not in _OF_RUNS} for one in figures
            ]
        elif weight := figures[0]["outside_weight"]:
            shown[f"the same, ordered by e - {weight:g} outside"] = figures
        else:
            shown["the paper's method"] = figures
    return figure_table("Kameda, experiment A: one silhouette of a female body", _GRID_ROWS, shown)


def continuous_figures(result: ExperimentResult) -> dict[str, Any]:
    """The figures: ratios as fractions, errors in degrees, seconds of the processor."""
    search = result.search
    assert isinstance(search, ContinuousSearch)
    searched = np.concatenate([np.ptp(grid, axis=0) > _HELD for grid in search.sampled.values])
    errors, known, held = [], [], []
    for trial in result.trials:
        true, pose_set = np.concatenate(trial.true_values), trial.result.pose_set
        off = np.abs(np.degrees(np.concatenate(trial.result.node_values) - true))
        errors += off[searched].tolist()
        joints = () if pose_set is None else pose_set.joints
        for joint, value, error, asked in zip(joints, true, off, searched, strict=bool(joints)):
            if asked and joint.determined:
                known.append(error)
                held.append(joint.holds(float(value)))
    E_total = [trial.result.E_total for trial in result.trials]
    return {
        "images": len(result.trials),
        "views": len(result.cameras),
        "median_e_total": float(np.median(E_total)),
        "mean_e_total": float(np.mean(E_total)),
        "median_error_deg": float(np.median(errors)),
        "determined": len(known) / len(errors),
        "median_determined_error_deg": float(np.median(known)) if known else None,
        "interval_coverage": float(np.mean(held)) if held else None,
        "interval_confidence": CONFIDENCE,
        "median_seconds": float(np.median([trial.seconds for trial in result.trials])),
        "mean_seconds": float(np.mean([trial.seconds for trial in result.trials])),
        "mean_interval_seconds": float(np.mean([trial.more_seconds for trial in result.trials])),
        "seed": result.seed,
        "angles": "continuous",
        "renderer": result.renderer,
        "mismatch": result.mismatch,
    }


def continuous_table(results: Mapping[str, ExperimentResult]) -> Table:
    """The figures, one run a column, by what the column is called."""
    columns = {heading: continuous_figures(result) for heading, result in results.items()}
    return figure_table("Kameda, experiment A with continuous angles", _CONTINUOUS_ROWS, columns)
