"""What edges inside the silhouette settle of experiment A's ambiguous silhouettes.

The paper names the edges as its future work. Here they are those of Drake's label image: where one
segment lies before another.
"""

from collections.abc import Callable

from drake_pose.apps.experiments.kameda.experiment import ExperimentResult, Trial
from drake_pose.matching.grid.families.inner_edges import choose_by_edges, edges_of_labels
from drake_pose.matching.grid.families.search import GridPoseSet, samples_at
from drake_pose.silhouette import LabelRenderer


def settle_by_edges(
    result: ExperimentResult, progress: Callable[[int], None] | None = None
) -> dict[str, int]:
    """Choose among the poses that look the same by their inner edges.

    Args:
        result: an experiment whose answers are sets.
        progress: called with the number of images done after each.

    Returns:
        How many silhouettes are ``ambiguous``: more than one pose is as good; in how many of them
        the edges leave fewer poses (``edges_narrow``) and one (``edges_settle``), in how many that
        one is the true pose (``edges_settle_rightly``), and in how many the true pose is among
        those left (``edges_keep_truth``).
    """
    renderer = LabelRenderer(result.search.tree.model, result.camera)
    counts = dict.fromkeys(
        (
            "ambiguous",
            "edges_narrow",
            "edges_settle",
            "edges_settle_rightly",
            "edges_keep_truth",
        ),
        0,
    )
    for done, trial in enumerate(result.trials, start=1):
        answer = trial.result.pose_set
        if isinstance(answer, GridPoseSet) and answer.size > 1.0:
            for name, holds in _judge(trial, answer, renderer).items():
                counts[name] += holds
        if progress is not None:
            progress(done)
    return counts


def _judge(trial: Trial, answer: GridPoseSet, renderer: LabelRenderer) -> dict[str, bool]:
    """What the edges of one silhouette's true pose settle."""
    q_true, X_WB = answer.sampled.tree.positions_from(trial.true_values)
    seen = renderer.segments(q_true, X_WB)
    choice = choose_by_edges(answer, [edges_of_labels(seen, seen >= 0)], [renderer.segments])
    true = samples_at(answer.sampled, trial.true_values)
    kept = bool((choice.samples[: choice.left] == true).all(axis=1).any())
    return {
        "ambiguous": True,
        "edges_narrow": choice.left < answer.size,
        "edges_settle": choice.settled,
        "edges_settle_rightly": choice.settled and kept,
        "edges_keep_truth": kept,
    }


def edge_lines(counts: dict[str, int]) -> str:
    """The counts as a sentence."""
    return (
        f"Of {counts['ambiguous']} ambiguous silhouettes, edges inside them narrow the poses in "
        f"{counts['edges_narrow']}, leave one in {counts['edges_settle']} (the true one in "
        f"{counts['edges_settle_rightly']}), and keep the true one in {counts['edges_keep_truth']}."
    )
