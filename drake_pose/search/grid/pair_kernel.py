"""Kernels of the searches on the grid: pairs of a partial pose and a pose of the next node.

A partial pose is a row of words, the pixels that its nodes cover. Its hash is the sum of half-word
values times random numbers, modulo 2^64: because new pixels only add to it, the hash of a pair
costs a look at the new pixels alone, and equal masks have equal hashes however they came about.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import intrinsic

from drake_pose.compiled import compiled, copy_into

_LOW_HALF = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)


def _count_bits(typing_context: Any, word: types.Type) -> Any:
    """The number of ones of a uint64: one instruction of the processor."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


count_bits: Any = intrinsic(_count_bits)


class Reaches(NamedTuple):
    """What the nodes that are still to come can cover at most.

    runs: (r, V, 3) int64 and words: (n,) uint64 pixels of the silhouettes in their reach;
    parents: (m,) int64 the parents of the nodes to come whose parent is placed; rows:
    (m, poses) int64 the row of runs for each pose of the parent.
    """

    runs: np.ndarray
    words: np.ndarray
    parents: np.ndarray
    rows: np.ndarray


@compiled
def score_pairs(
    masks: np.ndarray,
    first: np.ndarray,
    end: np.ndarray,
    runs: np.ndarray,
    words: np.ndarray,
    silhouettes: int,
    drop_hidden: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Areas that poses of the next node would add to hypotheses.

    Args:
        masks: (B, W) uint64 what the hypotheses cover.
        first, end: (B,) int64 the poses that each hypothesis may take.
        runs: (n, K, 3) int64 of each pose, for each part of a mask, the first word, the number of
            words and where they begin in words.
        words: (m,) uint64.
        silhouettes: how many parts come first that are silhouettes; the others are bands.
        drop_hidden: keep only the first pose of a hypothesis that adds nothing at all.

    Returns:
        pairs (p, 2) int32 hypothesis and pose, and (p,) int32 the silhouette and the band newly
        covered [pixel].
    """
    total = 0
    for h in range(masks.shape[0]):
        total += end[h] - first[h]
    pairs = np.empty((total, 2), dtype=np.int32)
    gains, losses = np.empty(total, dtype=np.int32), np.empty(total, dtype=np.int32)
    count = 0
    for h in range(masks.shape[0]):
        hidden = False
        for c in range(first[h], end[h]):
            gain, loss = 0, 0
            for part in range(runs.shape[1]):
                begin, length, place = runs[c, part, 0], runs[c, part, 1], runs[c, part, 2]
                added = np.uint64(0)
                for k in range(length):
                    added += count_bits(words[place + k] & ~masks[h, begin + k])
                if part < silhouettes:
                    gain += int(added)
                else:
                    loss += int(added)
            if drop_hidden and gain == 0 and loss == 0:
                if hidden:
                    continue
                hidden = True
            pairs[count, 0], pairs[count, 1] = h, c
            gains[count], losses[count] = gain, loss
            count += 1
    return pairs[:count], gains[:count], losses[:count]


def order_best(costs: np.ndarray, count: int) -> np.ndarray:
    """The indices of the ``count`` smallest costs (n,), smallest first, equals in their order."""
    if len(costs) <= count:
        return np.argsort(costs, kind="stable")
    near = np.flatnonzero(costs <= np.partition(costs, count - 1)[count - 1])
    return np.asarray(near[np.argsort(costs[near], kind="stable")[:count]])


def random_keys(words: int) -> np.ndarray:
    """(2 words,) uint64 odd numbers for hashes; always the same, so that answers are."""
    generator = np.random.default_rng(2718)
    return generator.integers(0, 2**64, 2 * words, dtype=np.uint64) | np.uint64(1)


def hash_mask(mask: np.ndarray, keys: np.ndarray) -> np.uint64:
    """The hash of a mask (W,)."""
    halves = np.column_stack([mask & _LOW_HALF, mask >> _HALF]).ravel()
    return np.uint64((halves * keys).sum(dtype=np.uint64))


@compiled
def add_hash(mask: np.ndarray, runs: np.ndarray, words: np.ndarray, keys: np.ndarray) -> np.uint64:
    """What the pixels of a pose (runs (K, 3)) that are not in a mask (W,) add to its hash."""
    code = np.uint64(0)
    for part in range(runs.shape[0]):
        begin, place = runs[part, 0], runs[part, 2]
        for k in range(runs[part, 1]):
            added = words[place + k] & ~mask[begin + k]
            if added != np.uint64(0):
                code += (added & _LOW_HALF) * keys[2 * (begin + k)]
                code += (added >> _HALF) * keys[2 * (begin + k) + 1]
    return code


@compiled
def hash_state(
    poses: np.ndarray, code: np.uint64, node: int, pose: int, open_nodes: np.ndarray
) -> np.uint64:
    """An odd number that tells by a code and by the poses of the nodes with children to come."""
    for j in range(-1, open_nodes.shape[0]):
        if j >= 0:
            i = open_nodes[j]
            p = pose if i == node else poses[i]
            code ^= np.uint64(p * poses.shape[0] + i)
        # splitmix64
        code += np.uint64(0x9E3779B97F4A7C15)
        code = (code ^ (code >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        code = (code ^ (code >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        code ^= code >> np.uint64(31)
    return code | np.uint64(1)


@compiled
def find_slot(table: np.ndarray, number: np.uint64) -> np.int64:
    """Where an odd number is, or belongs, in a hash table of 2^k slots (0: an empty one)."""
    last = table.shape[0] - 1
    slot = np.int64((number >> np.uint64(1)) & np.uint64(last))
    while table[slot] != np.uint64(0) and table[slot] != number:
        slot = (slot + 1) & last
    return slot


@compiled
def count_unreachable(
    mask: np.ndarray, poses: np.ndarray, everything: np.ndarray, reaches: Reaches, rest: np.ndarray
) -> np.int64:
    """The silhouettes' pixels that a hypothesis can never cover.

    Args:
        mask: (W,) uint64; poses: (nodes,) int32.
        everything: (w,) uint64 all pixels of the silhouettes.
        reaches: of the nodes to come.
        rest: (w,) uint64 written over: these pixels.
    """
    for k in range(everything.shape[0]):
        rest[k] = everything[k] & ~mask[k]
    for m in range(reaches.parents.shape[0]):
        parent = reaches.parents[m]
        row = reaches.rows[m, 0 if parent < 0 else poses[parent]]
        for part in range(reaches.runs.shape[1]):
            begin, place = reaches.runs[row, part, 0], reaches.runs[row, part, 2]
            for k in range(reaches.runs[row, part, 1]):
                rest[begin + k] &= ~reaches.words[place + k]
    count = np.uint64(0)
    for k in range(everything.shape[0]):
        count += count_bits(rest[k])
    return np.int64(count)


@compiled
def grow_hypotheses(
    masks: np.ndarray,
    poses: np.ndarray,
    hashes: np.ndarray,
    ordered: np.ndarray,
    pairs: np.ndarray,
    runs: np.ndarray,
    words: np.ndarray,
    node: int,
    open_nodes: np.ndarray,
    keys: np.ndarray,
    width: int,
    everything: np.ndarray,
    reaches: Reaches,
    exact: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
    """Make the best pairs hypotheses; of those that are alike only the first.

    Two are alike if they cover the same pixels and the nodes that still have children to come
    have the same poses: then they can be completed in the same ways. If nothing may lie outside,
    one that covers a part of what another covers is as good as alike.

    Args:
        masks: (B, W) uint64; poses: (B, nodes) int32; hashes: (B,) uint64 of the masks.
        ordered: indices of pairs, best first.
        pairs, runs, words: as in score_pairs.
        node: the node that the poses are of.
        open_nodes: nodes that have children to come, this one perhaps among them.
        width: at most this many are made.
        everything, reaches: as in count_unreachable.
        exact: nothing may lie outside, and nothing be left that is out of reach.

    Returns:
        masks, poses and hashes of the new hypotheses, the indices of their pairs, what they leave
        out of reach, and how many of ``ordered`` were looked at.
    """
    made = min(width, ordered.shape[0])
    new_masks = np.empty((made, masks.shape[1]), dtype=np.uint64)
    new_poses = np.empty((made, poses.shape[1]), dtype=np.int32)
    new_hashes = np.empty(made, dtype=np.uint64)
    chosen, left = np.empty(made, dtype=np.int64), np.empty(made, dtype=np.int64)
    openings = np.empty(made, dtype=np.uint64)
    rest = np.empty_like(everything)
    size = 16
    while size < 4 * ordered.shape[0]:
        size *= 2
    table = np.zeros(size, dtype=np.uint64)
    count, seen = 0, 0
    while seen < ordered.shape[0] and count < made:
        index = ordered[seen]
        seen += 1
        h, c = pairs[index, 0], pairs[index, 1]
        code = hashes[h] + add_hash(masks[h], runs[c], words, keys)
        state = hash_state(poses[h], code, node, c, open_nodes)
        slot = find_slot(table, state)
        if table[slot] == state:
            continue
        table[slot] = state
        copy_into(new_masks[count], masks[h])
        unite_masks(new_masks[count : count + 1], runs[c : c + 1], words)
        copy_into(new_poses[count], poses[h])
        new_poses[count, node] = c
        lost = count_unreachable(new_masks[count], new_poses[count], everything, reaches, rest)
        if exact:
            opening = hash_state(poses[h], np.uint64(0), node, c, open_nodes)
            openings[count] = opening
            useless = bool(lost > 0)
            for other in range(count):
                if useless:
                    break
                if openings[other] == opening:
                    k = 0
                    while k < masks.shape[1] and new_masks[count, k] & ~new_masks[
                        other, k
                    ] == np.uint64(0):
                        k += 1
                    useless = k == masks.shape[1]
            if useless:
                continue
        new_hashes[count], chosen[count], left[count] = code, index, lost
        count += 1
    return (
        new_masks[:count],
        new_poses[:count],
        new_hashes[:count],
        chosen[:count],
        left[:count],
        seen,
    )


@compiled
def unite_masks(masks: np.ndarray, runs: np.ndarray, words: np.ndarray) -> None:
    """Add the pixels of poses, given by their runs (n, K, 3), to masks (n, W), in place."""
    for c in range(runs.shape[0]):
        for part in range(runs.shape[1]):
            begin, length, place = runs[c, part]
            for k in range(length):
                masks[c, begin + k] |= words[place + k]
