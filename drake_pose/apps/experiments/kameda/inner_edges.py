"""What edges inside the silhouette settle of experiment A's ambiguous silhouettes.

The paper names the edges as its future work. Here they are those of Drake's label image: where one
segment lies before another.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from drake_pose.apps.experiments.kameda.experiment import ExperimentResult, Trial
from drake_pose.matching.grid.families.inner_edges import (
    EdgeChoice,
    InnerEdges,
    choose_by_edges,
    edges_of_labels,
)
from drake_pose.matching.grid.families.search import GridPoseSet, samples_at
from drake_pose.silhouette import LabelRenderer

COUNTS = (
    "ambiguous",
    "edges_narrow",
    "edges_settle",
    "edges_settle_rightly",
    "edges_keep_truth",
)

# Edges are lost in squares of so many pixels, as they are where colours are alike, not singly.
_SQUARE = 5
_STROKE = 5


def settle_by_edges(
    result: ExperimentResult,
    progress: Callable[[int], None] | None = None,
    noise: float = 0.0,
) -> dict[str, int]:
    """Choose among the poses that look the same by their inner edges.

    Args:
        result: an experiment whose answers are sets.
        progress: called with the number of images done after each.
        noise: see noisy_edges; 0: the edges of the label image as they are.

    Returns:
        How many silhouettes are ``ambiguous``: more than one pose is as good; in how many of them
        the edges leave fewer poses (``edges_narrow``) and one (``edges_settle``), in how many that
        one is the true pose (``edges_settle_rightly``), and in how many the true pose is not ruled
        out (``edges_keep_truth``).
    """
    renderer = LabelRenderer(result.search.tree.model, result.camera)
    counts = dict.fromkeys(COUNTS, 0)
    generator = np.random.default_rng([result.seed, 1])
    for done, trial in enumerate(result.trials, start=1):
        answer = trial.result.pose_set
        if isinstance(answer, GridPoseSet) and answer.size > 1.0:
            for name, holds in _judge(trial, answer, renderer, noise, generator).items():
                counts[name] += holds
        if progress is not None:
            progress(done)
    return counts


def noisy_edges(edges: InnerEdges, share: float, generator: np.random.Generator) -> InnerEdges:
    """Edges as a picture's may be: this share is missing, the others are a pixel off, some wrong.

    Wrong ones are short strokes anywhere inside the silhouette, a quarter as long as what is lost.

    Args:
        edges: the true ones.
        share: 0 to 1.
        generator: the source of chance.
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
    count = round(0.25 * share * float(edges.edges.sum()) / _STROKE)
    for row, column in inside[generator.integers(len(inside), size=count)]:
        angle = generator.uniform(0.0, 2.0 * np.pi)
        end = np.rint([column + _STROKE * np.cos(angle), row + _STROKE * np.sin(angle)])
        cv2.line(drawn, (int(column), int(row)), (int(end[0]), int(end[1])), 1)
    return replace(edges, edges=(drawn > 0) & edges.mask)


def _judge(
    trial: Trial,
    answer: GridPoseSet,
    renderer: LabelRenderer,
    noise: float,
    generator: np.random.Generator,
) -> dict[str, bool]:
    """What the edges of one silhouette's true pose settle."""
    q_true, X_WB = answer.sampled.tree.positions_from(trial.true_values)
    seen = renderer.segments(q_true, X_WB)
    edges = edges_of_labels(seen, seen >= 0)
    if noise:
        edges = noisy_edges(edges, noise, generator)
    choice = choose_by_edges(answer, [edges], [renderer.segments])
    true = samples_at(answer.sampled, trial.true_values)
    assert true is not None, "drawn from the grid"
    return {
        "ambiguous": True,
        "edges_narrow": choice.left < len(choice.samples),
        "edges_settle": choice.settled,
        "edges_settle_rightly": choice.settled and _is_only(choice, true),
        "edges_keep_truth": not choice.rules_out(true),
    }


def _is_only(choice: EdgeChoice, samples: np.ndarray) -> bool:
    """Whether the one pose left is this one (nodes,)."""
    return bool((choice.samples[0] == samples).all())


def edge_lines(counts: dict[str, int]) -> str:
    """The counts as a sentence."""
    return (
        f"Of {counts['ambiguous']} ambiguous silhouettes, edges inside them narrow the poses in "
        f"{counts['edges_narrow']}, leave one in {counts['edges_settle']} (the true one in "
        f"{counts['edges_settle_rightly']}), and do not rule out the true one in "
        f"{counts['edges_keep_truth']}."
    )
