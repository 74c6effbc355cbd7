"""The inner loops of the branch and bound: partial poses told apart, and bounds on their objective.

What matters of a partial pose for all that is still to come is what it covers, what it leaves
outside, and the poses of the nodes that have children to come. Partial poses equal in this are one
state, known by a hash of 64 bits.
"""

from __future__ import annotations

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.search.grid.pair_kernel import Reaches, count_bits, count_unreachable, mix_bits

_LOW_HALF = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)


@compiled
def tell_apart(
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
        runs, words: as in pair_kernel.score_pairs.
        pose_far: (n,) int32 area of each pose beyond the bands.
        node: the node that the poses are of.
        open_nodes: nodes that have children to come, this one perhaps among them.
        keys: (2 W,) uint64 random odd numbers.

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
        code = hashes[h]
        for part in range(runs.shape[1]):
            begin, place = runs[c, part, 0], runs[c, part, 2]
            for k in range(runs[c, part, 1]):
                added = words[place + k] & ~masks[h, begin + k]
                if added != np.uint64(0):
                    code += (added & _LOW_HALF) * keys[2 * (begin + k)]
                    code += (added >> _HALF) * keys[2 * (begin + k) + 1]
        likeness = mix_bits(code)
        for j in range(open_nodes.shape[0]):
            k = open_nodes[j]
            p = c if k == node else poses[h, k]
            likeness = mix_bits(likeness ^ np.uint64(p * poses.shape[1] + k))
        greatest, total = max(far[h, 0], pose_far[c]), far[h, 1] + pose_far[c]
        if total > 0:
            likeness = mix_bits(likeness ^ np.uint64(greatest)) + mix_bits(np.uint64(total))
        likeness |= np.uint64(1)
        slot = np.int64(mix_bits(likeness) & np.uint64(size - 1))
        while table[slot] != np.uint64(0) and table[slot] != likeness:
            slot = (slot + 1) & (size - 1)
        if table[slot] == np.uint64(0):
            table[slot], places[slot] = likeness, count
            firsts[count], codes[count] = i, code
            count += 1
        numbers[i] = places[slot]
    return numbers, firsts[:count].copy(), codes[:count].copy()


@compiled
def _write_union(
    mask: np.ndarray, runs: np.ndarray, words: np.ndarray, pose: int, union: np.ndarray
) -> None:
    """Writes a mask (W,) and the pixels of a pose to union (W,)."""
    for k in range(mask.shape[0]):
        union[k] = mask[k]
    for part in range(runs.shape[1]):
        begin, place = runs[pose, part, 0], runs[pose, part, 2]
        for k in range(runs[pose, part, 1]):
            union[begin + k] |= words[place + k]


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
        masks, poses, runs, words, node: as in tell_apart.
        pairs: (p, 2) int32 state and pose.
        everything: (w,) uint64 all pixels of the silhouettes.
        reaches: of the nodes that come after.

    Returns:
        (p, 3) int64 pixels of the silhouettes covered, pixels of the bands covered, and pixels of
        the silhouettes that no later node can reach.
    """
    areas = np.empty((pairs.shape[0], 3), dtype=np.int64)
    union = np.empty(masks.shape[1], dtype=np.uint64)
    rest = np.empty_like(everything)
    taken = np.empty(poses.shape[1], dtype=np.int32)
    for i in range(pairs.shape[0]):
        h, c = pairs[i, 0], pairs[i, 1]
        _write_union(masks[h], runs, words, c, union)
        covered, outside = np.uint64(0), np.uint64(0)
        for k in range(everything.shape[0]):
            covered += count_bits(union[k])
        for k in range(everything.shape[0], union.shape[0]):
            outside += count_bits(union[k])
        for k in range(taken.shape[0]):
            taken[k] = poses[h, k]
        taken[node] = c
        areas[i, 0], areas[i, 1] = np.int64(covered), np.int64(outside)
        areas[i, 2] = count_unreachable(union, taken, everything, reaches, rest)
    return areas


@compiled
def unite_pairs(
    masks: np.ndarray, pairs: np.ndarray, runs: np.ndarray, words: np.ndarray
) -> np.ndarray:
    """The masks (p, W) of pairs (p, 2) of a state and a pose; the others as in tell_apart."""
    united = np.empty((pairs.shape[0], masks.shape[1]), dtype=np.uint64)
    for i in range(pairs.shape[0]):
        _write_union(masks[pairs[i, 0]], runs, words, pairs[i, 1], united[i])
    return united


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
        runs, words: as in pair_kernel.score_pairs; this many parts come first that are silhouettes.
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
def sift_pairs(
    rests: np.ndarray,
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
        rests: (B, w) uint64 what no other node can cover, for each state.
        room: (B,) int64 this many pixels of it may stay uncovered.
        pairs: (p, 2) int32 state and pose.
        runs, words, silhouettes, child_rows, table: as in unite_groups.

    Returns:
        (p,) bool.
    """
    good = np.ones(pairs.shape[0], dtype=np.bool_)
    places = np.empty(rests.shape[1], dtype=np.int64)
    below = np.empty(rests.shape[1], dtype=np.uint64)
    count, state = 0, -1
    for i in range(pairs.shape[0]):
        h, c = pairs[i, 0], pairs[i, 1]
        if h != state:
            state, count = h, 0
            for k in range(rests.shape[1]):
                if rests[h, k] != np.uint64(0):
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
            rest = rests[h, k] & ~below[k]
            if rest != np.uint64(0):
                for child in range(child_rows.shape[0]):
                    rest &= ~table[child_rows[child, c], k]
                left -= np.int64(count_bits(rest))
                if left < 0:
                    good[i] = False
                    break
    return good


@compiled
def find_rests(
    masks: np.ndarray, everything: np.ndarray, rows: np.ndarray, table: np.ndarray
) -> np.ndarray:
    """What states leave uncovered that some nodes cannot cover.

    Args:
        masks: (B, W) uint64 what the states cover.
        everything: (w,) uint64 all pixels of the silhouettes.
        rows: (nodes, B) int64 rows of the table for each node and state.
        table: (r, w) uint64 what a node and its descendants can cover.

    Returns:
        (B, w) uint64.
    """
    rests = np.empty((masks.shape[0], everything.shape[0]), dtype=np.uint64)
    for h in range(masks.shape[0]):
        for k in range(everything.shape[0]):
            rest = everything[k] & ~masks[h, k]
            if rest != np.uint64(0):
                for i in range(rows.shape[0]):
                    rest &= ~table[rows[i, h], k]
            rests[h, k] = rest
    return rests
