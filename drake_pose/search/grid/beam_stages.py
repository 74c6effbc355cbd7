"""The beam: partial poses that grow node by node, and single limbs of a pose searched again."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from drake_pose.search.grid.node_poses import Pictures
from drake_pose.search.grid.partial_poses import Expansion, PartialPoses, all_pairs
from drake_pose.search.scoring import Scoring

# How many times the width are looked at until enough are found that are not alike.
_SPARE = 4
# What is placed last need not spare the silhouette for what comes after it.
_OUTSIDE_WEIGHT = 2
# How many of a node's samples are judged in full.
_JUDGED = 4


def grow(
    expansion: Expansion,
    partial: PartialPoses,
    node: int,
    width: int,
    outside_weight: int,
    limit: float,
) -> tuple[PartialPoses | None, bool]:
    """Place one more node in every partial pose and keep the best.

    Args:
        outside_weight: what a pixel outside counts; one newly covered counts one.
        limit: drop what cannot come to so small an objective any more [pixel].

    Returns:
        The new ones, best first, None where none stays inside the limit; and whether some were
            lost.
    """
    pairs = all_pairs(expansion.groups(partial, node))
    areas, added = expansion.score(partial, node, pairs)
    if not expansion.nodes[node].children:
        # Of those that add nothing at all, the first of each partial pose is enough.
        nothing = np.flatnonzero(~areas.any(axis=1))
        if len(nothing) > 1:
            more = nothing[1:][np.diff(pairs[nothing, 0]) == 0]
            pairs, areas, added = (np.delete(one, more, axis=0) for one in (pairs, areas, added))
    if len(pairs) == 0:
        return None, False
    beyond = expansion.store.nodes[node].areas[pairs[:, 1], 2]
    outside = partial.outside[pairs[:, 0]] + areas[:, 1] + beyond
    covered = partial.covered[pairs[:, 0]] + areas[:, 0]
    ordered = order_best(outside_weight * outside - covered, _SPARE * width)
    made = expansion.make(partial, node, pairs[ordered], (areas[ordered], added[ordered]))
    pairs, lost = pairs[ordered], len(ordered) < len(pairs)
    # What is out of reach is known after growing only: grow more and rank again.
    grown = width if limit < np.inf else 2 * width
    chosen, made, looked_at = expansion.choose(partial, made, node, pairs, grown, limit)
    lost = lost or len(looked_at) < len(pairs)
    if limit == np.inf:
        best = np.argsort(made.costs(outside_weight), kind="stable")[:width]
        lost = lost or len(best) < len(made)
        chosen, made = chosen[best], made.chosen(best)
    if len(made) == 0:
        return None, lost
    return expansion.with_masks(partial, made, node, pairs[chosen]), lost


def order_best(costs: np.ndarray, count: int) -> np.ndarray:
    """The indices of the ``count`` smallest costs (n,), smallest first, equals in their order."""
    if len(costs) <= count:
        return np.argsort(costs, kind="stable")
    near = np.flatnonzero(costs <= np.partition(costs, count - 1)[count - 1])
    return np.asarray(near[np.argsort(costs[near], kind="stable")[:count]])


def run_stage(
    expansion: Expansion,
    start: PartialPoses,
    order: Sequence[int],
    width: int,
    outside_weight: int,
    limit: float,
    proceed: Callable[[], bool],
) -> tuple[PartialPoses | None, bool]:
    """Place nodes one after another, asking after each whether to go on.

    Returns:
        The last ones (None: none was left, or told to stop), and whether none was lost.
    """
    partial, complete = start, True
    for node in order:
        grown, lost = grow(expansion, partial, node, width, outside_weight, limit)
        complete = complete and not lost
        if grown is None:
            return None, complete
        if not proceed():
            return None, False
        partial = grown
    return partial, complete


def search_limbs_again(
    expansion: Expansion,
    order: Sequence[int],
    poses: np.ndarray,
    J: float,
    width: int,
    proceed: Callable[[], bool],
    found: Callable[[PartialPoses], np.ndarray],
) -> np.ndarray:
    """Better poses (nodes,) in the store, limbs searched again by one and two while that improves.

    ``found`` gives the objectives (n,) of the last partial poses of every search.
    """
    limbs = find_limbs(expansion)
    choices = [*((limb,) for limb in limbs), *itertools.combinations(limbs, 2)]
    unchanged = 0
    for choice in itertools.cycle(choices):
        nodes = frozenset().union(*choice)
        start = expansion.without(poses, nodes)
        part = [node for node in order if node in nodes]
        last, _ = run_stage(expansion, start, part, width, _OUTSIDE_WEIGHT, np.inf, proceed)
        if last is None:
            return poses
        Js = found(last)
        best = int(np.argmin(Js))
        unchanged += 1
        if Js[best] < J:
            J, poses, unchanged = float(Js[best]), last.poses[best], 1
        if unchanged >= len(choices):
            return poses
    return poses


def find_limbs(expansion: Expansion) -> list[frozenset[int]]:
    """The largest subtrees without a fork but the whole tree; of a chain, its outer half."""
    nodes = expansion.nodes
    body = expansion.store.body
    subtrees, forked = body.sampled.tree.subtrees, body.forked
    limbs = [
        frozenset(subtrees[i])
        for i, node in enumerate(nodes)
        if not forked[i] and node.parent >= 0 and forked[node.parent]
    ]
    return limbs or [frozenset(one) for one in subtrees if 2 * len(one) <= len(nodes)][:1]


def turn_single_nodes(
    scoring: Scoring, pictures: Pictures, samples: np.ndarray, proceed: Callable[[], bool]
) -> np.ndarray:
    """Samples (nodes,) that turning no single node, all that hangs on it moving along, improves.

    As far as pictures with bands tell, and as it got before it was told not to proceed.
    """
    current = samples.copy()
    J = float(scoring.J(current[None])[0])
    unchanged = 0
    tree = scoring.sampled.tree
    nodes = [i for i in range(len(current)) if tree.source(i) == i]
    for node in itertools.cycle(nodes):
        if not proceed():
            break
        tried = np.repeat(current[None], len(scoring.sampled.values[node]), axis=0)
        together = [i for i in range(len(current)) if tree.source(i) == node]
        tried[:, together] = np.arange(len(tried))[:, None]
        approximate = _J_by_bits(scoring, pictures, tried, node)
        tried = tried[np.argsort(approximate, kind="stable")[:_JUDGED]]
        Js = scoring.J(tried)
        best = int(np.argmin(Js))
        unchanged += 1
        if Js[best] < J:
            J, current, unchanged = float(Js[best]), tried[best], 1
        if unchanged >= len(nodes):
            break
    return current


def _J_by_bits(scoring: Scoring, pictures: Pictures, samples: np.ndarray, node: int) -> np.ndarray:
    """J (n,) as the pictures show it of samples (n, nodes) that differ in one node's alone."""
    X_WN, words = scoring.sampled.poses(samples), int(pictures.part_starts[-1])
    moving, far = scoring.sampled.tree.subtrees[node], np.zeros(len(samples), dtype=np.int64)
    still = np.zeros((1, words), dtype=np.uint64)
    for i in set(range(samples.shape[1])).difference(moving):
        far += pictures.draw_node(i, samples[:1, i], X_WN[:1, i], still)[0, 2]
    masks = np.repeat(still, len(samples), axis=0)
    for i in moving:
        far += pictures.draw_node(i, samples[:, i], X_WN[:, i], masks)[:, 2]
    ones = np.bitwise_count(masks).astype(np.int64)
    silhouettes = int(pictures.part_starts[len(pictures.views)])
    outside, covered = ones[:, silhouettes:].sum(axis=1), ones[:, :silhouettes].sum(axis=1)
    return np.asarray(pictures.area - covered + outside + far)
