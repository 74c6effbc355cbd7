"""Kernels of the searches on grids: evaluate pairs of a partial pose and a pose of the next node.

The pixels covered by a partial pose are a bit mask, (W,) uint64. Its hash is

    h = sum_i (low half of word i) k_2i + (high half of word i) k_2i+1   modulo 2^64

with random odd keys k. New pixels only add to h, so the hash of a pair needs the new pixels alone,
and equal masks have equal hashes.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import intrinsic

from drake_pose.compiled import compiled, copy_into

_LOW_HALF = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_MIX = np.uint64(0x9E3779B97F4A7C15)


def _count_bits(typing_context: Any, word: types.Type) -> Any:
    """Numba intrinsic: return the number of ones of a uint64, by one processor instruction.

    The arguments, and the returned signature and code generator, are those of
    ``numba.extending.intrinsic``.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


count_bits: Any = intrinsic(_count_bits)


class ReachablePixels(NamedTuple):
    """Pixels of the silhouettes that nodes still to be placed can cover at most.

    Attributes:
        runs: (r, V, 3) int64 for each of r sets of pixels and each of V views: index of the set's
            first word in a mask, number of its words, and index of the first in ``words``.
        words: (n,) uint64 the words of all sets.
        rows: (m, p) int64 the row of ``runs`` for each of m nodes that can be placed next, and each
            of p pairs.
    """

    runs: np.ndarray
    words: np.ndarray
    rows: np.ndarray


def random_keys(count: int) -> np.ndarray:
    """Return (count,) uint64 odd keys for hashes; the seed is fixed, so results are repeatable."""
    generator = np.random.default_rng(2718)
    return generator.integers(0, 2**64, count, dtype=np.uint64) | np.uint64(1)


def hash_mask(mask: np.ndarray, keys: np.ndarray) -> np.uint64:
    """Return the hash h of a bit mask (W,) uint64 with keys (2 W,) uint64."""
    halves = np.column_stack([mask & _LOW_HALF, mask >> _HALF]).ravel()
    return np.uint64((halves * keys).sum(dtype=np.uint64))


@compiled
def score_pairs(
    masks: np.ndarray,
    pairs: np.ndarray,
    runs: np.ndarray,
    words: np.ndarray,
    silhouettes: int,
    keys: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the areas that poses of the next node add to partial poses.

    Args:
        masks: (B, W) uint64 bit masks of the partial poses.
        pairs: (p, 2) int32 indices of partial pose and pose of the next node.
        runs: (n, K, 3) int64 for each of the next node's n poses and each of the K parts of a mask
            (silhouettes and bands of the views): index of the pose's first word in the mask, number
            of its words, and index of the first in ``words``.
        words: (m,) uint64 the words of all poses' bit masks.
        silhouettes: number of parts that are silhouettes, which come first; the others are bands.
        keys: (2 W,) uint64 keys of the hashes.

    Returns (p, 2) int64 newly covered area of silhouettes and of bands [pixel], and (p,) uint64 the
    increase of the hash.
    """
    areas = np.zeros((pairs.shape[0], 2), dtype=np.int64)
    codes = np.zeros(pairs.shape[0], dtype=np.uint64)
    for i in range(pairs.shape[0]):
        h, c = pairs[i, 0], pairs[i, 1]
        code = np.uint64(0)
        for part in range(runs.shape[1]):
            begin, place = runs[c, part, 0], runs[c, part, 2]
            ones = np.uint64(0)
            for k in range(runs[c, part, 1]):
                added = words[place + k] & ~masks[h, begin + k]
                if added != np.uint64(0):
                    ones += count_bits(added)
                    code += (added & _LOW_HALF) * keys[2 * (begin + k)]
                    code += (added >> _HALF) * keys[2 * (begin + k) + 1]
            areas[i, 0 if part < silhouettes else 1] += np.int64(ones)
        codes[i] = code
    return areas, codes


@compiled
def choose_pairs(
    masks: np.ndarray,
    pairs: np.ndarray,
    runs: np.ndarray,
    words: np.ndarray,
    all_pixels: np.ndarray,
    reachable: ReachablePixels,
    width: int,
    states: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose the first distinct pairs, and compute the area that no later node can cover.

    Args:
        masks: (B, W) uint64 bit masks of the partial poses.
        pairs: (p, 2) int32 indices of partial pose and pose of the next node, best first.
        runs, words: bit masks of the next node's poses, as in ``score_pairs``.
        all_pixels: (w,) uint64 bit mask of all pixels of the silhouettes, which are the first w of
            a mask's W words.
        reachable: the pixels that the nodes still to be placed can cover.
        width: greatest number of pairs that are chosen.
        states: (p,) uint64 hashes, equal for pairs after which the search goes on alike.

    Returns:
        chosen: (n,) int64 indices of the chosen pairs.
        unreachable: (n,) int64 silhouette area that no later node can cover after each [pixel].
        places: (e,) int64 for each of the first e pairs, which were examined, the index in
            ``chosen`` of the pair with its state (itself or an earlier one).
    """
    made = min(width, pairs.shape[0])
    chosen, unreachable = np.empty(made, dtype=np.int64), np.empty(made, dtype=np.int64)
    own, rest = np.empty(masks.shape[1], dtype=np.uint64), np.empty_like(all_pixels)
    bits = 4
    while 1 << bits < 2 * pairs.shape[0]:
        bits += 1
    last = (1 << bits) - 1
    slots = np.full(last + 1, -1, dtype=np.int64)
    places = np.empty(pairs.shape[0], dtype=np.int64)
    count, examined = 0, 0
    while examined < pairs.shape[0] and count < made:
        i = examined
        examined += 1
        slot = np.int64((states[i] * _MIX) >> np.uint64(64 - bits))
        while slots[slot] >= 0 and states[slots[slot]] != states[i]:
            slot = (slot + 1) & last
        if slots[slot] >= 0:
            places[i] = places[slots[slot]]
            continue
        slots[slot] = i
        h, c = pairs[i, 0], pairs[i, 1]
        copy_into(own, masks[h])
        for part in range(runs.shape[1]):
            begin, place = runs[c, part, 0], runs[c, part, 2]
            for k in range(runs[c, part, 1]):
                own[begin + k] |= words[place + k]
        for k in range(all_pixels.shape[0]):
            rest[k] = all_pixels[k] & ~own[k]
        for m in range(reachable.rows.shape[0]):
            row = reachable.rows[m, i]
            for part in range(reachable.runs.shape[1]):
                begin, place = reachable.runs[row, part, 0], reachable.runs[row, part, 2]
                for k in range(reachable.runs[row, part, 1]):
                    rest[begin + k] &= ~reachable.words[place + k]
        unreached = np.uint64(0)
        for k in range(all_pixels.shape[0]):
            unreached += count_bits(rest[k])
        chosen[count], unreachable[count], places[i] = i, np.int64(unreached), count
        count += 1
    return chosen[:count], unreachable[:count], places[:examined]


@compiled
def unite(
    table: np.ndarray,
    rows: np.ndarray,
    groups: np.ndarray,
    runs: np.ndarray,
    words: np.ndarray,
    parts: int,
    child_rows: np.ndarray,
) -> None:
    """Add the pixels covered by groups of poses of a node, and by its descendants, to table rows.

    Args:
        table: (r, w) uint64 bit masks, changed in place.
        rows: (n,) int64 the rows that are changed.
        groups: (n, 2) int64 the range [first, end) of the node's poses that are added to each row.
        runs, words: bit masks of the node's poses, as in ``score_pairs``.
        parts: number of parts of a mask that are used, from the first.
        child_rows: (children, poses) int64 the row of the table with the pixels of each child and
            its descendants, for each pose of the node.
    """
    for g in range(groups.shape[0]):
        union = table[rows[g]]
        for c in range(groups[g, 0], groups[g, 1]):
            for part in range(parts):
                begin, place = runs[c, part, 0], runs[c, part, 2]
                for k in range(runs[c, part, 1]):
                    union[begin + k] |= words[place + k]
            for child in range(child_rows.shape[0]):
                below = table[child_rows[child, c]]
                for k in range(union.shape[0]):
                    union[k] |= below[k]


NO_CHILDREN = np.zeros((0, 0), dtype=np.int64)
"""``child_rows`` if only the node's own pixels are wanted."""


def unite_poses(masks: np.ndarray, poses: np.ndarray, runs: np.ndarray, words: np.ndarray) -> None:
    """Add the pixels of poses (n,) to masks (n, W), in place; the rest as in ``score_pairs``."""
    groups = np.column_stack([poses, poses + 1]).astype(np.int64)
    unite(masks, np.arange(len(masks)), groups, runs, words, runs.shape[1], NO_CHILDREN)


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
    """Return (p,) bool whether each pair leaves few enough pixels uncovered.

    A pair covers what its pose of the node, and at most the node's descendants then, can cover.

    Args:
        uncovered: (B, w) uint64 pixels of the silhouettes that no other node can cover, for each
            partial pose.
        room: (B,) int64 greatest number of these that may stay uncovered.
        pairs: (p, 2) int32 indices of partial pose and pose of the node; fastest if sorted.
        runs, words: bit masks of the node's poses, as in ``score_pairs``.
        silhouettes: number of parts of a mask that are silhouettes, which come first.
        child_rows: (children, poses) int64 row of ``table`` for each child and pose of the node.
        table: (r, w) uint64 bit masks of what the children and their descendants can cover.
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
