"""Combinations of the leaf nodes' candidates (Kameda, section 5.2.1)."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from drake_pose.search.scoring import Scoring

# Combinations times pixel patterns that are looked at in one piece of arrays.
_BLOCK = 4_000_000

Placed = tuple[np.ndarray, np.ndarray]
"""Samples of nodes, and the poses there."""


def best_leaf_combination(
    scoring: Scoring,
    inner: Sequence[int],
    inner_poses: Placed,
    leaves: Sequence[int],
    candidates: Sequence[Placed],
    adopted: Sequence[int],
    limit: int,
) -> tuple[tuple[int, ...], float]:
    """Find the combination of the leaves' candidates with the smallest J.

    Pixels that no inner node covers are counted by their pattern: which candidates cover them.

    Args:
        inner_poses: their samples (len(inner),) and poses (len(inner), 4, 4).
        candidates: for each leaf the samples (n,) and poses (n, 4, 4).
        limit: up to so many combinations are all tried; beyond, one leaf after another.

    Returns:
        The candidate of each leaf, and by how much J is below that of ``adopted`` [pixel].
    """
    counts = [len(samples) for samples, _ in candidates]
    patterns, gains = _patterns(scoring, inner, inner_poses, leaves, candidates)
    first_columns = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)

    def worth(choices: np.ndarray) -> np.ndarray:
        """Silhouette covered less outside covered [pixel], (n,), of choices (n, leaves)."""
        total = np.empty(len(choices))
        block = max(1, _BLOCK // max(1, len(patterns)))
        for begin in range(0, len(choices), block):
            part = choices[begin : begin + block]
            covered = np.zeros((len(part), len(patterns)), dtype=bool)
            for leaf, column in enumerate(first_columns):
                covered |= patterns[:, column + part[:, leaf]].T
            total[begin : begin + block] = covered @ gains
        return total

    start = np.array([adopted])
    start_worth = worth(start)[0]
    if np.prod(np.array(counts, dtype=float)) <= limit:
        choices = np.array(list(itertools.product(*(range(count) for count in counts))))
        worths = worth(choices)
        best = int(np.argmax(worths))
        if worths[best] > start_worth:
            return tuple(int(t) for t in choices[best]), float(worths[best] - start_worth)
        return tuple(adopted), 0.0
    return _one_leaf_at_a_time(worth, start, start_worth, counts)


def _one_leaf_at_a_time(
    worth: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    start_worth: float,
    counts: Sequence[int],
) -> tuple[tuple[int, ...], float]:
    """Change one leaf after another while that is an improvement; ``start`` is (1, leaves)."""
    current, current_worth = start.copy(), start_worth
    improved = True
    while improved:
        improved = False
        for leaf, count in enumerate(counts):
            choices = np.repeat(current, count, axis=0)
            choices[:, leaf] = np.arange(count)
            worths = worth(choices)
            best = int(np.argmax(worths))
            if worths[best] > current_worth:
                current, current_worth = choices[best : best + 1], worths[best]
                improved = True
    return tuple(int(t) for t in current[0]), float(current_worth - start_worth)


def _patterns(
    scoring: Scoring,
    inner: Sequence[int],
    inner_poses: Placed,
    leaves: Sequence[int],
    candidates: Sequence[Placed],
) -> tuple[np.ndarray, np.ndarray]:
    """The distinct patterns (n, candidates of all leaves) bool, and what covering each is worth."""
    all_patterns, all_gains = [], []
    for v, view in enumerate(scoring.views):
        base = scoring.draw(inner, *inner_poses, v)
        masks = [
            scoring.draw([leaf], samples[t : t + 1], poses[t : t + 1], v)
            for leaf, (samples, poses) in zip(leaves, candidates, strict=True)
            for t in range(len(poses))
        ]
        open_pixels = np.logical_or.reduce(masks) & ~base
        rows, columns = np.nonzero(open_pixels)
        membership = np.array([mask[rows, columns] for mask in masks]).T
        packed = np.packbits(membership, axis=1)
        _, first, inverse = np.unique(packed, axis=0, return_index=True, return_inverse=True)
        sign = np.where(view.mask[rows, columns], 1.0, -1.0)
        all_patterns.append(membership[first])
        all_gains.append(np.bincount(inverse.ravel(), weights=sign, minlength=len(first)))
    return np.concatenate(all_patterns), np.concatenate(all_gains)
