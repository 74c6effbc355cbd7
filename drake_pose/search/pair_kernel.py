"""Kernels of the searches on the grid: pairs of a partial pose and a pose of the next node.

A partial pose is a row of words, the pixels that its nodes cover. Its hash is the sum of half-word
values times random numbers, modulo 2^64: because new pixels only add to it, the hash of a pair
costs a look at the new pixels alone, and equal masks have equal hashes however they came about.
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
    """The number of ones of a uint64: one instruction of the processor."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


count_bits: Any = intrinsic(_count_bits)


class Reaches(NamedTuple):
    """What the nodes that are still to come can cover at most.

    runs: (r, V, 3) int64 and words: (n,) uint64 pixels of the silhouettes in their reach; rows:
    (m, p) int64 the row of runs, for each node to come whose parent is placed and each pair.
    """

    runs: np.ndarray
    words: np.ndarray
    rows: np.ndarray


def random_keys(count: int) -> np.ndarray:
    """(count,) uint64 odd numbers for hashes; always the same, so that answers are."""
    generator = np.random.default_rng(2718)
    return generator.integers(0, 2**64, count, dtype=np.uint64) | np.uint64(1)


def hash_mask(mask: np.ndarray, keys: np.ndarray) -> np.uint64:
    """The hash of a mask (W,), with keys (2 W,)."""
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
    """What poses of the next node would add to partial poses.

    Args:
        masks: (B, W) uint64 what these cover.
        pairs: (p, 2) int32 partial pose and pose.
        runs: (n, K, 3) int64 of each pose, for each part of a mask, the first word, the number
            of words and where they begin in words (m,) uint64.
        silhouettes: how many parts come first that are silhouettes; the others are bands.
        keys: (2 W,) uint64 of the hashes.

    Returns:
        (p, 2) int64 silhouette and band newly covered [pixel]; (p,) uint64 what hashes gain.
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
    everything: np.ndarray,
    reaches: Reaches,
    width: int,
    codes: np.ndarray,
    openings: np.ndarray,
    outside: np.ndarray,
    limit: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The first pairs that are not equal, and what no later node can cover after each.

    Args:
        masks, pairs, runs, words: as in score_pairs.
        everything: (w,) uint64 all pixels of the silhouettes.
        reaches: of the nodes to come.
        width: the greatest number that is chosen.
        codes: (p,) uint64 the same where pairs are equal in what matters later.
        openings: (p,) uint64 equal where the nodes with children to come stand alike; then only
            pairs within the limit are chosen, and of those alike none that covers a part of what
            another before it covers, which has no more outside. Or (0,): all are chosen.
        outside: (p,) int64 the area outside [pixel].
        limit: of what is outside and what no later node can cover together [pixel].

    Returns:
        (n,) int64 the pairs chosen; (n,) int64 pixels of the silhouettes that each leaves; and of
        each pair that was looked at the place among those chosen, -1 for none.
    """
    made = min(width, pairs.shape[0])
    chosen, left = np.empty(made, dtype=np.int64), np.empty(made, dtype=np.int64)
    exact = openings.shape[0] > 0
    covered = np.empty((made if exact else 1, masks.shape[1]), dtype=np.uint64)
    rest = np.empty_like(everything)
    bits = 4
    while 1 << bits < 2 * pairs.shape[0]:
        bits += 1
    last = (1 << bits) - 1
    slots = np.full(last + 1, -1, dtype=np.int64)
    numbers = np.empty(pairs.shape[0], dtype=np.int64)
    count, seen = 0, 0
    while seen < pairs.shape[0] and count < made:
        i = seen
        seen += 1
        slot = np.int64((codes[i] * _MIX) >> np.uint64(64 - bits))
        while slots[slot] >= 0 and codes[slots[slot]] != codes[i]:
            slot = (slot + 1) & last
        if slots[slot] >= 0:
            numbers[i] = numbers[slots[slot]]
            continue
        slots[slot] = i
        numbers[i] = -1
        h, c = pairs[i, 0], pairs[i, 1]
        own = covered[count if exact else 0]
        copy_into(own, masks[h])
        for part in range(runs.shape[1]):
            begin, place = runs[c, part, 0], runs[c, part, 2]
            for k in range(runs[c, part, 1]):
                own[begin + k] |= words[place + k]
        for k in range(everything.shape[0]):
            rest[k] = everything[k] & ~own[k]
        for m in range(reaches.rows.shape[0]):
            row = reaches.rows[m, i]
            for part in range(reaches.runs.shape[1]):
                begin, place = reaches.runs[row, part, 0], reaches.runs[row, part, 2]
                for k in range(reaches.runs[row, part, 1]):
                    rest[begin + k] &= ~reaches.words[place + k]
        lost = np.uint64(0)
        for k in range(everything.shape[0]):
            lost += count_bits(rest[k])
        useless = exact and outside[i] + np.int64(lost) > limit
        for other in range(count if exact else 0):
            if useless:
                break
            if openings[chosen[other]] == openings[i] and outside[chosen[other]] <= outside[i]:
                k = 0
                while k < everything.shape[0] and own[k] & ~covered[other, k] == np.uint64(0):
                    k += 1
                useless = k == everything.shape[0]
        if not useless:
            chosen[count], left[count], numbers[i] = i, np.int64(lost), count
            count += 1
    return chosen[:count], left[:count], numbers[:seen]


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
    """Add what poses of a node, and its descendants at these, cover to rows of a table.

    Args:
        table: (r, w) uint64 masks; rows: (n,) int64 those to write.
        groups: (n, 2) int64 where the poses of each begin and end.
        runs, words: as in score_pairs; the first ``parts`` of each pose are looked at.
        child_rows: (children, poses) int64 the row of the table for each child and pose.
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
"""The ``child_rows`` of who asks for the poses alone."""


def unite_poses(masks: np.ndarray, poses: np.ndarray, runs: np.ndarray, words: np.ndarray) -> None:
    """Add the pixels of one pose (n,) each to masks (n, W), in place."""
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
    """Which pairs (p,) bool of a partial pose and a pose can still cover enough.

    Args:
        uncovered: (B, w) uint64 what no other node can cover, for each partial pose.
        room: (B,) int64 this many pixels of it may stay uncovered.
        pairs, runs, words, silhouettes: as in score_pairs.
        child_rows, table: as in unite.
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
