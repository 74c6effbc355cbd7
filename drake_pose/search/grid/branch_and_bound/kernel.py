"""Kernels of the branch and bound: equal partial poses made one, and bounds on their objective.

What matters of a partial pose for all that is still to come is what it covers, what it leaves
outside, and the poses of the nodes that have children to come. Partial poses equal in this are one
state, known by a hash of 64 bits.
"""

from __future__ import annotations

import numpy as np

from drake_pose.compiled import compiled, copy_into
from drake_pose.search.grid.pair_kernel import (
    Reaches,
    add_hash,
    count_bits,
    count_unreachable,
    find_slot,
    hash_state,
    unite_masks,
)


@compiled
def deduplicate(
    masks: np.ndarray,
    poses: np.ndarray,
    hashes: np.ndarray,
    far: np.ndarray,
    pairs: np.ndarray,
    runs: np.ndarray,
    words: np.ndarray,
    pose_far: np.ndarray,
    node: int,
    open_nodes: np.ndarray,
    keys: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find which pairs of a state and a pose of the next node make equal states.

    Args:
        masks: (B, W) uint64 the pixels that the states cover; poses: (B, nodes) int32 of the
            nodes, -1 where not placed; hashes: (B,) uint64 of the masks.
        far: (B, 2) int64 greatest and summed area beyond the bands of any node [pixel].
        pairs: (p, 2) int32 state and pose.
        runs, words: as in score_pairs.
        pose_far: (n,) int32 area of each pose beyond the bands.
        node, open_nodes, keys: as in grow_hypotheses.

    Returns:
        (p,) int64 the number of each pair's new state; (u,) int64 the first pair of each new
        state; (u,) uint64 hashes of their masks.
    """
    size = 64
    while size < 2 * pairs.shape[0]:
        size *= 2
    table, places = np.zeros(size, dtype=np.uint64), np.empty(size, dtype=np.int64)
    numbers = np.empty(pairs.shape[0], dtype=np.int64)
    firsts = np.empty(pairs.shape[0], dtype=np.int64)
    codes = np.empty(pairs.shape[0], dtype=np.uint64)
    count = 0
    for i in range(pairs.shape[0]):
        h, c = pairs[i, 0], pairs[i, 1]
        code = hashes[h] + add_hash(masks[h], runs[c], words, keys)
        greatest, total = max(far[h, 0], pose_far[c]), far[h, 1] + pose_far[c]
        beyond = np.uint64(greatest) * keys[0] + (np.uint64(total) << np.uint64(32)) * keys[1]
        state = hash_state(poses[h], code ^ beyond, node, c, open_nodes)
        slot = find_slot(table, state)
        if table[slot] == np.uint64(0):
            table[slot], places[slot] = state, count
            firsts[count], codes[count] = i, code
            count += 1
        numbers[i] = places[slot]
    return numbers, firsts[:count].copy(), codes[:count].copy()


@compiled
def bound_pairs(
    masks: np.ndarray,
    poses: np.ndarray,
    pairs: np.ndarray,
    runs: np.ndarray,
    words: np.ndarray,
    node: int,
    everything: np.ndarray,
    reaches: Reaches,
) -> np.ndarray:
    """Areas of what pairs of a state and a pose cover and leave, before any later node.

    Args:
        masks, poses, pairs, runs, words, node: as in deduplicate.
        everything, reaches: as in count_unreachable.

    Returns:
        (p, 3) int64 pixels of the silhouettes covered, pixels of the bands covered, and pixels of
        the silhouettes that no later node can reach.
    """
    areas = np.empty((pairs.shape[0], 3), dtype=np.int64)
    union = np.empty((1, masks.shape[1]), dtype=np.uint64)
    rest = np.empty_like(everything)
    taken = np.empty(poses.shape[1], dtype=np.int32)
    for i in range(pairs.shape[0]):
        h, c = pairs[i, 0], pairs[i, 1]
        copy_into(union[0], masks[h])
        unite_masks(union, runs[c : c + 1], words)
        covered, outside = np.uint64(0), np.uint64(0)
        for k in range(everything.shape[0]):
            covered += count_bits(union[0, k])
        for k in range(everything.shape[0], union.shape[1]):
            outside += count_bits(union[0, k])
        copy_into(taken, poses[h])
        taken[node] = c
        areas[i, 0], areas[i, 1] = np.int64(covered), np.int64(outside)
        areas[i, 2] = count_unreachable(union[0], taken, everything, reaches, rest)
    return areas


@compiled
def unite_groups(
    groups: np.ndarray,
    runs: np.ndarray,
    words: np.ndarray,
    silhouettes: int,
    child_rows: np.ndarray,
    table: np.ndarray,
    rows: np.ndarray,
) -> None:
    """Write what the poses of a node, and its descendants at these, cover together.

    Args:
        groups: (n, 2) int64 where the poses of each union begin and end.
        runs, words, silhouettes: as in score_pairs.
        child_rows: (children, poses) int64 the row of the table for each child and pose.
        table: (r, w) uint64 unions; rows: (n,) int64 the rows to write, which are zero.
    """
    for g in range(groups.shape[0]):
        union = table[rows[g]]
        for c in range(groups[g, 0], groups[g, 1]):
            for part in range(silhouettes):
                begin, place = runs[c, part, 0], runs[c, part, 2]
                for k in range(runs[c, part, 1]):
                    union[begin + k] |= words[place + k]
            for child in range(child_rows.shape[0]):
                below = table[child_rows[child, c]]
                for k in range(union.shape[0]):
                    union[k] |= below[k]


@compiled
def prune_pairs(
    uncovered: np.ndarray,
    room: np.ndarray,
    pairs: np.ndarray,
    runs: np.ndarray,
    words: np.ndarray,
    silhouettes: int,
    child_rows: np.ndarray,
    table: np.ndarray,
) -> np.ndarray:
    """Find the pairs of a state and a pose that can still cover enough.

    Args:
        uncovered: (B, w) uint64 what no other node can cover, for each state.
        room: (B,) int64 this many pixels of it may stay uncovered.
        pairs: (p, 2) int32 state and pose.
        runs, words, silhouettes, child_rows, table: as in unite_groups.

    Returns:
        (p,) bool.
    """
    good = np.ones(pairs.shape[0], dtype=np.bool_)
    places = np.empty(uncovered.shape[1], dtype=np.int64)
    below = np.empty(uncovered.shape[1], dtype=np.uint64)
    count, state = 0, -1
    for i in range(pairs.shape[0]):
        h, c = pairs[i, 0], pairs[i, 1]
        if h != state:
            state, count = h, 0
            for k in range(uncovered.shape[1]):
                if uncovered[h, k] != np.uint64(0):
                    places[count] = k
                    count += 1
        for j in range(count):
            below[places[j]] = np.uint64(0)
        for part in range(silhouettes):
            begin, place = runs[c, part, 0], runs[c, part, 2]
            for k in range(runs[c, part, 1]):
                below[begin + k] = words[place + k]
        left = room[h]
        for j in range(count):
            k = places[j]
            rest = uncovered[h, k] & ~below[k]
            if rest != np.uint64(0):
                for child in range(child_rows.shape[0]):
                    rest &= ~table[child_rows[child, c], k]
                left -= np.int64(count_bits(rest))
                if left < 0:
                    good[i] = False
                    break
    return good
