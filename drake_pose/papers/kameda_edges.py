"""What edges inside the silhouette, the paper's future work, settle of A's ambiguous silhouettes.

They are those of Drake's label image: where one segment lies before another.
"""

from dataclasses import replace

import cv2
import numpy as np

from drake_pose.papers.kameda import ExperimentResult, Trial
from drake_pose.papers.tables import Count, uncounted
from drake_pose.search.grid.inner_edges import (
    EdgeErrors,
    InnerEdges,
    choose_by_edges,
    edges_of_labels,
    find_borders,
)
from drake_pose.search.grid.pose_families import GridPoseSet, samples_at
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

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
