"""The figures of Kameda's experiment A, their tables, and what inner edges settle of it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from rich.table import Table

from drake_pose.papers.kameda import PAPER_IMAGES, ExperimentResult, Trial
from drake_pose.papers.tables import Count, figure_table, spread_over_seeds, uncounted
from drake_pose.search import CONFIDENCE, ContinuousSearch, GridPoseSet, PaperSearch, samples_at
from drake_pose.search.inner_edges import (
    EdgeErrors,
    InnerEdges,
    choose_by_edges,
    edges_of_labels,
    find_borders,
)
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

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


_COUNTS = (
    "ambiguous",
    "edges_narrow",
    "edges_settle",
    "edges_settle_rightly",
    "edges_keep_truth",
    "edges_undecidable",
)
# Edges are lost in squares of so many pixels, as they are where colours are alike, not singly.
_SQUARE = 5
# So long are the wrong ones of what is lost.
_WRONG = 0.25


def settle_by_edges(
    result: ExperimentResult, count: Count = uncounted, noise: float = 0.0
) -> dict[str, int]:
    """Choose among the poses that look the same by their inner edges, noisy or as they are.

    Returns:
        How many silhouettes are ``ambiguous``: more than one pose is as good; in how many of them
        the edges leave fewer poses (``edges_narrow``) and one (``edges_settle``), in how many that
        one is the true pose (``edges_settle_rightly``), in how many the true pose is not ruled out
        (``edges_keep_truth``), and in how many another pose has the true one's edges to the pixel
        (``edges_undecidable``): these cannot be settled.
    """
    renderer = LabelRenderer(result.search.tree.model, result.cameras[0])
    counts = dict.fromkeys(_COUNTS, 0)
    generator = np.random.default_rng([result.seed, 1])
    advance = count("silhouettes, edges", len(result.trials))
    for done, trial in enumerate(result.trials, start=1):
        answer = trial.result.pose_set
        if isinstance(answer, GridPoseSet) and answer.size > 1.0:
            judged = _judge(trial, answer, renderer, noise, generator)
            for name, holds in zip(_COUNTS, judged, strict=True):
                counts[name] += holds
        advance(done)
    return counts


def noisy_edges(edges: InnerEdges, share: float, generator: np.random.Generator) -> InnerEdges:
    """Edges as a picture's may be: this share is missing, the others are a pixel off, some wrong.

    Wrong ones are short strokes inside the silhouette, a quarter as long as what is lost; the
    edges that are returned are judged by the rates of these errors.
    """
    shape = edges.edges.shape
    squares = tuple(-(-side // _SQUARE) for side in shape)
    lost = generator.random(squares) < share
    lost = np.kron(lost, np.ones((_SQUARE, _SQUARE), dtype=np.bool_))[: shape[0], : shape[1]]
    places = np.argwhere(edges.edges & ~lost)
    places = np.clip(places + generator.integers(-1, 2, places.shape), 0, np.array(shape) - 1)
    drawn = np.zeros(shape, dtype=np.uint8)
    drawn[tuple(places.T)] = 1
    inside = np.argwhere(edges.mask)
    count = round(_WRONG * share * float(edges.edges.sum()) / _SQUARE)
    for row, column in inside[generator.integers(len(inside), size=count)]:
        angle = generator.uniform(0.0, 2.0 * np.pi)
        end = np.rint([column + _SQUARE * np.cos(angle), row + _SQUARE * np.sin(angle)])
        cv2.line(drawn, (int(column), int(row)), (int(end[0]), int(end[1])), 1)
    errors = EdgeErrors(share, _WRONG * share, _SQUARE)
    return replace(edges, edges=(drawn > 0) & edges.mask, errors=errors)


def _judge(
    trial: Trial,
    answer: GridPoseSet,
    renderer: LabelRenderer,
    noise: float,
    generator: np.random.Generator,
) -> tuple[bool, ...]:
    """What the edges of one silhouette's true pose settle, in the order of _COUNTS."""
    q_true, X_WB_true = answer.sampled.tree.positions_from(trial.true_values)
    seen = renderer.segments(q_true, X_WB_true)
    exact = edges_of_labels(seen, seen >= 0)
    edges = noisy_edges(exact, noise, generator) if noise else exact
    alike = 0

    def render(q: np.ndarray, X_WB: np.ndarray) -> np.ndarray:
        nonlocal alike
        segments = renderer.segments(q, X_WB)
        if not (np.array_equal(q, q_true) and np.array_equal(X_WB, X_WB_true)):
            borders = find_borders(np.where(exact.mask, segments, -1))
            alike += np.array_equal(borders, exact.edges)
        return segments

    choice = choose_by_edges(answer, [edges], [render])
    true = samples_at(answer.sampled, trial.true_values)
    assert true is not None, "drawn from the grid"
    rightly = choice.settled and bool((choice.samples[0] == true).all())
    narrow = choice.left < len(choice.samples)
    return True, narrow, choice.settled, rightly, not choice.rules_out(true), alike > 0


def edge_lines(counts: dict[str, int]) -> str:
    """The counts as a sentence."""
    return (
        f"Of {counts['ambiguous']} ambiguous silhouettes, edges inside them narrow the poses in "
        f"{counts['edges_narrow']}, leave one in {counts['edges_settle']} (the true one in "
        f"{counts['edges_settle_rightly']}), and do not rule out the true one in "
        f"{counts['edges_keep_truth']}. In {counts['edges_undecidable']} another pose has the true "
        "one's edges to the pixel: no edges can settle these."
    )
