"""All poses of the grid whose objective is no greater than a limit, found layer by layer.

A partial pose is dropped only if no completion can be within the limit: what lies outside the
silhouette stays outside, and what no later node can reach stays uncovered. The sum of the two
bounds the objective of all completions from below. Nothing else is dropped unless there is too
much of it, and the search then says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.search.estimates import View
from drake_pose.search.grid.branch_and_bound.bounded_poses import (
    BoundedPoses,
    BoundLimits,
    LimitReached,
    SubtreeReaches,
    make_pictures,
)
from drake_pose.search.grid.branch_and_bound.kernel import (
    bound_pairs,
    deduplicate,
    prune_pairs,
)
from drake_pose.search.grid.branch_and_bound.partial_pose_graph import (
    Layer,
    PartialPoseGraph,
    make_layer,
)
from drake_pose.search.grid.pair_kernel import random_keys, unite_masks
from drake_pose.search.grid.sampled_body import SampledBody

# What lies outside counts so much where partial poses must be ranked: it stays outside, while what
# is not covered yet may be covered by a later node.
_OUTSIDE_WEIGHT = 2
# More pairs than these are worth a look at what later nodes can really cover: quickly, or closely.
_FEW_PAIRS, _MANY_PAIRS = 300, 2000
# How many poses of a node are tried for a quick and for a close look.
_QUICK_TRIES, _CLOSE_TRIES = 5000, 100_000


@dataclass(frozen=True)
class PosesWithin:
    """What a branch and bound found.

    Attributes:
        graph: the poses; every one is within the limit.
        complete: whether it holds all poses within the limit.
        limited: whether a limit of the search left some out.
        lower_bound: no pose of the grid that is not in the graph has a smaller objective [pixel].
    """

    graph: PartialPoseGraph
    complete: bool
    limited: bool
    lower_bound: float
    states: int


@dataclass(frozen=True)
class _States:
    """Partial poses that have placed the same nodes.

    masks (B, W) uint64; poses (B, nodes) int32; hashes (B,) uint64; far (B, 2) int64 greatest and
    summed area of a node beyond the bands; outside, lows (B,) int64 bounds on the area outside and
    on the objective [pixel]; costs (B,) int64 to rank by.
    """

    masks: np.ndarray
    poses: np.ndarray
    hashes: np.ndarray
    far: np.ndarray
    outside: np.ndarray
    lows: np.ndarray
    costs: np.ndarray

    def __len__(self) -> int:
        return len(self.poses)

    def chosen(self, kept: np.ndarray) -> "_States":
        return _States(*(array[kept] for array in vars(self).values()))


def branch_and_bound(
    body: SampledBody,
    views: Sequence[View],
    J_limit: float,
    limits: BoundLimits | None = None,
    kept_samples: np.ndarray | None = None,
    deadline: float | None = None,
) -> PosesWithin:
    """Find all poses of the grid whose objective is no greater than a limit.

    Args:
        kept_samples: (nodes,) of a pose that is never dropped for want of room.
        deadline: the value of time.perf_counter() at which it stops [s].

    Returns:
        The poses; not all if a limit was reached, or if an area beyond the bands around the
        silhouettes is counted twice.
    """
    search = _BranchAndBound(body, views, J_limit, limits or BoundLimits(), kept_samples)
    if deadline is not None:
        search.store.deadline = deadline
    return search.run()


class _BranchAndBound:
    """One search; arguments as branch_and_bound."""

    def __init__(
        self,
        body: SampledBody,
        views: Sequence[View],
        J_limit: float,
        limits: BoundLimits,
        kept_samples: np.ndarray | None,
    ) -> None:
        self.body = body
        self.nodes = body.sampled.tree.nodes
        self.J_limit = J_limit
        self.limits = limits
        self.kept_samples = kept_samples
        self.pictures = make_pictures(body, views, J_limit)
        self.store = BoundedPoses(body, self.pictures, J_limit, limits)
        self.quick = SubtreeReaches(self.store, _QUICK_TRIES)
        self.close = SubtreeReaches(self.store, _CLOSE_TRIES)
        self._keys = random_keys(int(self.pictures.part_starts[-1]))
        self._layers: list[Layer] = []
        self._complete = True
        self._limited = False
        self._lower_bound = np.inf
        self._visited = 0
        # The state that the pose to be kept is in; -1: none.
        self._kept_state = -1 if kept_samples is None else 0

    def run(self) -> PosesWithin:
        """Place all nodes."""
        words = int(self.pictures.part_starts[-1])
        zero = np.zeros(1, dtype=np.int64)
        states = _States(
            np.zeros((1, words), dtype=np.uint64),
            np.full((1, len(self.nodes)), -1, dtype=np.int32),
            np.zeros(1, dtype=np.uint64),
            np.zeros((1, 2), dtype=np.int64),
            zero,
            zero,
            zero,
        )
        while len(self._layers) < len(self.nodes):
            try:
                self.store.reserve()
                states, node, pairs = self._choose(states)
                states = self._place(states, node, pairs)
            except LimitReached:
                return self._stop(states)
        return self._finish(states)

    def _stop(self, states: _States) -> PosesWithin:
        """The answer when a limit ends the search."""
        bound = min(self._lower_bound, float(states.lows.min()) if len(states) else np.inf)
        nothing = np.zeros(0, dtype=np.int64)
        layers = [Layer(i, nothing, nothing, nothing) for i in range(len(self.nodes))]
        return PosesWithin(PartialPoseGraph(layers, np.zeros(0)), False, True, bound, self._visited)

    def _finish(self, states: _States) -> PosesWithin:
        """The answer when all nodes are placed: lows are then the objectives."""
        highs = states.lows + states.far[:, 1] - states.far[:, 0]
        graph = PartialPoseGraph(self._layers, highs).up_to(self.J_limit)
        sure = bool(np.all(highs <= self.J_limit))
        if not sure:
            self._drop(states.lows[highs > self.J_limit])
        bound = min(self._lower_bound, float(np.floor(self.J_limit)) + 1.0)
        return PosesWithin(graph, self._complete, self._limited, bound, self._visited)

    def _drop(self, lows: np.ndarray) -> None:
        """Note that states with these bounds were dropped though they might lead to poses."""
        self._complete = False
        self._lower_bound = min(self._lower_bound, float(lows.min()))

    def _choose(self, states: _States) -> tuple[_States, int, np.ndarray]:
        """The node to place next, and the pairs (p, 2) int32 of a state and a pose to look at."""
        placed = {layer.node for layer in self._layers}
        order = [node for node in self.body.limb_order if node not in placed]
        waiting = [i for i in order if self.nodes[i].parent in (-1, *placed)]
        forks = [i for i in waiting if self._is_forked(i)]
        if forks or len(states) == 0:
            node = (forks or waiting)[0]
            states = self._fit_pairs(states, node)
            return states, node, self._pairs(states, node)
        totals = [int(np.diff(self._groups(states, node)).sum()) for node in waiting]
        node = waiting[int(np.argmin(totals))]
        states = self._fit_pairs(states, node)
        if min(totals) <= _FEW_PAIRS:
            return states, node, self._pairs(states, node)
        best = self._prune(states, waiting, self.quick)
        if best is not None and len(best[1]) > _MANY_PAIRS:
            best = self._prune(states, waiting, self.close)
        if best is None:
            return states, node, self._pairs(states, node)
        return states, *best

    def _prune(
        self, states: _States, waiting: Sequence[int], reaches: SubtreeReaches
    ) -> tuple[int, np.ndarray] | None:
        """The waiting node that leaves the fewest pairs, and these; None: all have too many."""
        best: tuple[int, np.ndarray] | None = None
        for node in waiting:
            pairs = self._pruned_pairs(states, node, waiting, reaches)
            if pairs is not None and (best is None or len(pairs) < len(best[1])):
                best = node, pairs
        return best

    def _pairs(self, states: _States, node: int) -> np.ndarray:
        """All pairs (p, 2) int32 of a state and a pose of the node."""
        groups = self._groups(states, node)
        counts = groups[:, 1] - groups[:, 0]
        pairs = np.empty((int(counts.sum()), 2), dtype=np.int32)
        pairs[:, 0] = np.repeat(np.arange(len(states)), counts)
        offsets = np.repeat(groups[:, 0] - np.cumsum(counts) + counts, counts)
        pairs[:, 1] = np.arange(len(pairs)) + offsets
        return pairs

    def _pruned_pairs(
        self, states: _States, node: int, waiting: Sequence[int], reaches: SubtreeReaches
    ) -> np.ndarray | None:
        """Those pairs that leave no more than what the waiting nodes can really cover."""
        groups = self._groups(states, node)
        if np.diff(groups).sum() > self.limits.pairs:
            return None
        pairs = self._pairs(states, node)
        below = reaches.child_rows(node, pairs[:, 1])
        others = [i for i in waiting if i != node]
        rows = np.zeros((len(others), len(states)), dtype=np.int64)
        for k, other in enumerate(others):
            parents = self.store.parents(states.poses, other)
            rows[k] = reaches.rows(other, parents)[parents]
        everything = self.pictures.everything
        uncovered = everything & ~states.masks[:, : len(everything)]
        for other_rows in rows:
            uncovered &= ~reaches.table[other_rows]
        room = np.floor(self.J_limit - states.outside).astype(np.int64)
        stored = self.store.nodes[node]
        good = prune_pairs(
            uncovered, room, pairs, stored.runs, stored.words, len(self.pictures.views), below,
            reaches.table,
        )  # fmt: skip
        return pairs[good]

    def _is_forked(self, node: int) -> bool:
        """Whether the node or one of its descendants has several children."""
        children = self.nodes[node].children
        return len(children) > 1 or any(self._is_forked(child) for child in children)

    def _groups(self, states: _States, node: int) -> np.ndarray:
        """Where the node's poses begin and end (B, 2) for each state."""
        if len(states) == 0:
            return np.zeros((0, 2), dtype=np.int64)
        nothing_hidden = np.zeros(len(states), dtype=np.bool_)
        return self.store.groups(node, self.store.parents(states.poses, node), nothing_hidden)

    def _place(self, states: _States, node: int, pairs: np.ndarray) -> _States:
        """Place a node as pairs (p, 2) of a state and a pose say, and note the edges."""
        stored = self.store.nodes[node]
        numbers, firsts, hashes = deduplicate(
            states.masks, states.poses, states.hashes, states.far, pairs, stored.runs,
            stored.words, stored.areas[:, 2], node,
            self.store.open_nodes(states.poses, node), self._keys,
        )  # fmt: skip
        made = self._make(states, node, pairs[firsts], hashes)
        alive = made.lows <= self.J_limit
        self._visited += len(alive)
        samples = stored.samples[pairs[:, 1]].astype(np.int64)
        self._follow_kept(pairs[:, 0], samples, numbers, node)
        kept = self._fit_states(made, alive)
        places = np.cumsum(kept) - 1
        edges = kept[numbers]
        origins = pairs[edges, 0].astype(np.int64)
        self._layers.append(make_layer(node, origins, samples[edges], places[numbers[edges]]))
        if self._kept_state >= 0:
            self._kept_state = int(places[self._kept_state]) if kept[self._kept_state] else -1
        made = made.chosen(kept)
        pairs = pairs[firsts[kept]]
        masks = states.masks[pairs[:, 0]]
        unite_masks(masks, stored.runs[pairs[:, 1]], stored.words)
        return replace(made, masks=masks)

    def _make(self, states: _States, node: int, pairs: np.ndarray, hashes: np.ndarray) -> _States:
        """The states that pairs make, without their masks."""
        stored = self.store.nodes[node]
        far = np.empty((len(pairs), 2), dtype=np.int64)
        beyond = stored.areas[pairs[:, 1], 2]
        far[:, 0] = np.maximum(states.far[pairs[:, 0], 0], beyond)
        far[:, 1] = states.far[pairs[:, 0], 1] + beyond
        areas = bound_pairs(
            states.masks, states.poses, pairs, stored.runs, stored.words, node,
            self.pictures.everything, self.store.reaches(states.poses, node, pairs[:, 1]),
        )  # fmt: skip
        lost = areas[:, 1] + areas[:, 2]
        poses = states.poses[pairs[:, 0]]
        poses[:, node] = pairs[:, 1]
        return _States(
            masks=np.zeros((len(pairs), 0), dtype=np.uint64),
            poses=poses,
            hashes=hashes,
            far=far,
            outside=areas[:, 1] + far[:, 0],
            lows=lost + far[:, 0],
            costs=_OUTSIDE_WEIGHT * (lost + far[:, 1]) - areas[:, 0],
        )

    def _fit_pairs(self, states: _States, node: int) -> _States:
        """Keep as many of the best states as make no more pairs than allowed."""
        groups = self._groups(states, node)
        counts = groups[:, 1] - groups[:, 0]
        if counts.sum() <= self.limits.pairs or len(states) == 1:
            return states
        order = self._ranked(states)
        count = max(1, int(np.searchsorted(np.cumsum(counts[order]), self.limits.pairs)))
        kept = np.zeros(len(states), dtype=np.bool_)
        kept[order[:count]] = True
        self._drop(states.lows[~kept])
        self._limited = True
        places = np.cumsum(kept) - 1
        if self._layers:
            last = self._layers[-1].chosen(kept[self._layers[-1].ends])
            self._layers[-1] = replace(last, ends=places[last.ends])
        if self._kept_state >= 0:
            self._kept_state = int(places[self._kept_state])
        return states.chosen(kept)

    def _fit_states(self, made: _States, alive: np.ndarray) -> np.ndarray:
        """Which (B,) bool of the states that are alive may be kept."""
        words = int(self.pictures.part_starts[-1])
        room = max(1, min(self.limits.states, self.limits.memory // (4 * 8 * words)))
        if alive.sum() <= room:
            return alive
        costs = np.where(alive, made.costs, np.iinfo(np.int64).max)
        order = self._ranked(replace(made, costs=costs))
        kept = np.zeros(len(alive), dtype=np.bool_)
        kept[order[:room]] = True
        self._drop(made.lows[alive & ~kept])
        self._limited = True
        return kept

    def _ranked(self, states: _States) -> np.ndarray:
        """The states' numbers, best first; that of the pose to be kept before all."""
        costs = states.costs.copy()
        if self._kept_state >= 0:
            costs[self._kept_state] = np.iinfo(np.int64).min
        return np.argsort(costs, kind="stable")

    def _follow_kept(
        self, origins: np.ndarray, samples: np.ndarray, numbers: np.ndarray, node: int
    ) -> None:
        """Find the state that the pose to be kept comes to."""
        if self._kept_state < 0 or self.kept_samples is None:
            return
        found = (origins == self._kept_state) & (samples == self.kept_samples[node])
        edges = np.flatnonzero(found)
        self._kept_state = int(numbers[edges[0]]) if len(edges) else -1
