"""All poses of the grid whose objective is no greater than a limit, found layer by layer.

A partial pose is dropped only if no completion can be within the limit: what lies outside the
silhouette stays outside, and what no later node can reach stays uncovered. The sum of the two
bounds the objective of all completions from below. Nothing else is dropped unless there is too
much of it, and the search then says so. The poses found, which may be very many, are kept as a
graph of partial poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.search.estimates import View
from drake_pose.search.pair_kernel import NO_CHILDREN, prune_pairs, unite
from drake_pose.search.partial_poses import (
    LimitReached,
    PartialPoses,
    Pictures,
    PoseStore,
    RowTable,
    expand_groups,
)
from drake_pose.search.sampled_body import SampledBody
from drake_pose.search.settings import BoundLimits


@dataclass(frozen=True)
class Layer:
    """The edges that place one node, by origin and sample.

    ``origins``: (m,) int64 states they start from; ``samples``: (m,) int64; ``ends``: (m,) int64
    states of the next layer.
    """

    node: int
    origins: np.ndarray
    samples: np.ndarray
    ends: np.ndarray

    def chosen(self, edges: np.ndarray) -> "Layer":
        """Some of the edges, (m,) bool."""
        return Layer(self.node, self.origins[edges], self.samples[edges], self.ends[edges])


class PartialPoseGraph:
    """A set of poses of the grid; states not between the first (0) and a last are left out.

    Attributes:
        layers: one for each node.
        Js: (last states,) the objective of the poses that end in each [pixel].
        ways: for each layer, and for the last states, (states,) how many partial poses lead there.
    """

    def __init__(self, layers: Sequence[Layer], Js: np.ndarray) -> None:
        # Leave out states that lead nowhere or are led to from nowhere, and number the rest anew.
        origins = [layer.origins for layer in layers[1:]] + [np.arange(len(Js))]
        reached = [np.array([True])]
        for layer, following in zip(layers, origins, strict=True):
            size = int(max(layer.ends.max(initial=0), following.max(initial=-1))) + 1
            there = np.zeros(size, dtype=np.bool_)
            there[layer.ends[reached[-1][layer.origins]]] = True
            reached.append(there)
        useful = reached[-1][: len(Js)]
        self.Js = np.asarray(Js, dtype=np.float64)[useful]
        self.layers: list[Layer] = []
        for layer, there in zip(layers[::-1], reached[-2::-1], strict=True):
            kept = layer.chosen(useful[layer.ends] & there[layer.origins])
            ends = (np.cumsum(useful) - 1)[kept.ends]
            useful = np.zeros(len(there), dtype=np.bool_)
            useful[kept.origins] = True
            places = np.cumsum(useful) - 1
            self.layers.insert(0, Layer(kept.node, places[kept.origins], kept.samples, ends))
        counts = [int(layer.origins.max(initial=-1)) + 1 for layer in self.layers]
        self.ways: list[np.ndarray] = [np.ones(1)]
        for layer, states in zip(self.layers, [*counts[1:], len(self.Js)], strict=True):
            weights = self.ways[-1][layer.origins]
            self.ways.append(np.bincount(layer.ends, weights, minlength=states))

    @classmethod
    def of_pose(cls, samples: np.ndarray, J: float) -> "PartialPoseGraph":
        """The set of one pose, samples (nodes,), with objective J."""
        zero = np.zeros(1, dtype=np.int64)
        layers = [Layer(node, zero, np.array([t]), zero) for node, t in enumerate(samples)]
        return cls(layers, np.array([J]))

    @property
    def size(self) -> float:
        """How many poses there are; a float because they may be very many."""
        return float(self.ways[-1].sum()) if len(self.Js) else 0.0

    @property
    def best_J(self) -> float:
        """The smallest objective; infinite where there is no pose."""
        return float(self.Js.min(initial=np.inf))

    def objective(self, samples: np.ndarray) -> float | None:
        """The objective of a pose, samples (nodes,), or None if it is not in the set."""
        state = 0
        for layer in self.layers:
            begin, end = np.searchsorted(layer.origins, [state, state + 1])
            wanted = samples[layer.node]
            edge = begin + int(np.searchsorted(layer.samples[begin:end], wanted))
            if edge >= end or layer.samples[edge] != wanted:
                return None
            state = int(layer.ends[edge])
        return float(self.Js[state])

    def contains(self, samples: np.ndarray) -> bool:
        """Whether a pose, samples (nodes,), is in the set."""
        return self.objective(samples) is not None

    def samples_seen(self) -> list[np.ndarray]:
        """For each node the samples that occur in any pose, smallest first."""
        seen: list[np.ndarray] = [np.zeros(0, dtype=np.int64)] * len(self.layers)
        for layer in self.layers:
            seen[layer.node] = np.unique(layer.samples)
        return seen

    def restricted(self, allowed: Sequence[np.ndarray]) -> "PartialPoseGraph":
        """The poses that take allowed samples alone, (samples,) bool of each node."""
        layers = [layer.chosen(allowed[layer.node][layer.samples]) for layer in self.layers]
        return PartialPoseGraph(layers, self.Js)

    def up_to(self, J: float) -> "PartialPoseGraph":
        """Those poses whose objective is no greater."""
        kept = self.Js <= J
        last = self.layers[-1].chosen(kept[self.layers[-1].ends])
        last = replace(last, ends=(np.cumsum(kept) - 1)[last.ends])
        return PartialPoseGraph([*self.layers[:-1], last], self.Js[kept])

    def central(self) -> np.ndarray:
        """Samples (nodes,) of a best pose, where most ways lead; ValueError if there is none."""
        if not self.size:
            raise ValueError("a pose was asked of an empty set")
        samples = np.empty(len(self.layers), dtype=np.int64)
        best = self.Js == self.Js.min()
        state = int(np.argmax(np.where(best, self.ways[-1], -1.0)))
        for layer, ways in zip(self.layers[::-1], self.ways[-2::-1], strict=True):
            edges = np.flatnonzero(layer.ends == state)
            edge = edges[int(np.argmax(ways[layer.origins[edges]]))]
            samples[layer.node], state = layer.samples[edge], int(layer.origins[edge])
        return samples


@dataclass(frozen=True)
class PosesWithin:
    """What a branch and bound found.

    Attributes:
        J_limit: the limit [pixel].
        graph: the poses; every one is within the limit.
        complete: whether it holds all poses within the limit.
        limited: whether a limit of the search left some out.
        lower_bound: no pose of the grid that is not in the graph has a smaller objective [pixel].
    """

    J_limit: float
    graph: PartialPoseGraph
    complete: bool
    limited: bool
    lower_bound: float


def branch_and_bound(
    body: SampledBody,
    views: Sequence[View],
    J_limit: float,
    limits: BoundLimits | None = None,
    kept_samples: np.ndarray | None = None,
) -> PosesWithin:
    """Find all poses of the grid whose objective is no greater than a limit.

    ``kept_samples``: (nodes,) of a pose that is never dropped for want of room. Some are missing if
    a limit was reached, or an area beyond the bands around the silhouettes is counted twice.
    """
    return _BranchAndBound(body, views, J_limit, limits or BoundLimits(), kept_samples).run()


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
        self.order = body.limb_order
        self.J_limit, self.limits = J_limit, limits
        # Bands so wide that nothing within the limit lies beyond, if masks get no more words than
        # this; bands are no narrower than 8 pixels.
        most_words, least_band = 2000, 8
        sides = (view.mask.shape[i] for view in views for i in (0, 1))
        band = max(1, int(min(J_limit, max(sides)))) if J_limit >= 1.0 else 0
        self.pictures = Pictures(body, views, band, in_full=True)
        while band > least_band and self.pictures.part_starts[-1] > most_words:
            band //= 2
            self.pictures = Pictures(body, views, band, in_full=True)
        self.store = PoseStore(body, self.pictures, outside_limit=J_limit, limits=limits)
        self.nodes = self.store.tree_nodes
        self.reaches = _SubtreeReaches(self.store)
        self._layers: list[Layer] = []
        self._complete = True
        self._limited = False
        self._lower_bound = np.inf
        # The partial pose that the pose to be kept is in; -1: none.
        self._kept = -1 if kept_samples is None else 0
        self._kept_samples = np.zeros(0) if kept_samples is None else kept_samples

    def run(self) -> PosesWithin:
        """Place all nodes."""
        partial = self.store.start()
        while len(self._layers) < len(self.nodes):
            try:
                self.store.reserve()
                partial, node, pairs = self._choose(partial)
                partial = self._place(partial, node, pairs)
            except LimitReached:
                left = float(partial.bounds.min()) if len(partial) else np.inf
                bound = min(self._lower_bound, left)
                nothing = np.zeros(0, dtype=np.int64)
                layers = [Layer(i, nothing, nothing, nothing) for i in range(len(self.nodes))]
                graph = PartialPoseGraph(layers, np.zeros(0))
                return PosesWithin(self.J_limit, graph, False, True, bound)
        # All nodes are placed: the bounds are the objectives, but for what is beyond the bands.
        highs = partial.bounds + partial.far[:, 1] - partial.far[:, 0]
        graph = PartialPoseGraph(self._layers, highs).up_to(self.J_limit)
        self._drop(partial.bounds[highs > self.J_limit])
        bound = min(self._lower_bound, float(np.floor(self.J_limit)) + 1.0)
        return PosesWithin(self.J_limit, graph, self._complete, self._limited, bound)

    def _drop(self, bounds: np.ndarray, limited: bool = False) -> None:
        """Note that partial poses with these bounds are dropped though they might lead to poses."""
        if len(bounds):
            self._complete = False
            self._limited = self._limited or limited
            self._lower_bound = min(self._lower_bound, float(bounds.min()))

    def _choose(self, partial: PartialPoses) -> tuple[PartialPoses, int, np.ndarray]:
        """The node to place next, and the pairs (p, 2) int32 to look at."""
        placed = {layer.node for layer in self._layers}
        waiting = [
            i for i in self.order if i not in placed and self.nodes[i].parent in (-1, *placed)
        ]
        forks = [i for i in waiting if self.store.body.forked[i]]
        if forks or len(partial) == 0:
            node = (forks or waiting)[0]
            partial = self._fit_pairs(partial, node)
            return partial, node, self.store.pairs(partial, node)
        totals = [int(np.diff(self.store.groups(partial, node)).sum()) for node in waiting]
        node = waiting[int(np.argmin(totals))]
        partial = self._fit_pairs(partial, node)
        pairs = self.store.pairs(partial, node)
        # More pairs than these are worth a look at what later nodes can really cover.
        if min(totals) > 300:
            for other in waiting:
                if np.diff(self.store.groups(partial, other)).sum() <= self.limits.pairs:
                    pruned = self._pruned_pairs(partial, other, waiting)
                    if len(pruned) < len(pairs):
                        node, pairs = other, pruned
        return partial, node, pairs

    def _pruned_pairs(self, partial: PartialPoses, node: int, waiting: Sequence[int]) -> np.ndarray:
        """Those pairs that leave no more than what the waiting nodes can really cover."""
        pairs = self.store.pairs(partial, node)
        below = self.reaches.child_rows(node, pairs[:, 1])
        others = [
            self.reaches.rows(other, self.store.parents(partial.poses, other))
            for other in waiting
            if other != node
        ]
        table, everything = self.reaches.table, self.pictures.everything
        uncovered = everything & ~partial.masks[:, : len(everything)]
        for rows in others:
            uncovered &= ~table[rows]
        room = np.floor(self.J_limit - partial.least_outside).astype(np.int64)
        stored, views = self.store.nodes[node], len(self.pictures.views)
        good = prune_pairs(uncovered, room, pairs, stored.runs, stored.words, views, below, table)
        return pairs[good]

    def _place(self, partial: PartialPoses, node: int, pairs: np.ndarray) -> PartialPoses:
        """Place a node as pairs (p, 2) say, and note the edges."""
        store = self.store
        made = store.make(partial, node, pairs, store.score(partial, node, pairs))
        firsts, made, numbers = store.choose(
            partial, made, node, pairs, len(pairs), far_matters=True
        )
        samples = store.nodes[node].samples[pairs[:, 1]].astype(np.int64)
        if self._kept >= 0:
            own = np.flatnonzero(
                (pairs[:, 0] == self._kept) & (samples == self._kept_samples[node])
            )
            self._kept = int(numbers[own[0]]) if len(own) else -1
        room = min(self.limits.states, self.limits.memory // (4 * 8 * store.words))
        kept = self._keep(made, np.ones(len(made)), max(1, room))
        places = np.cumsum(kept) - 1
        edges = kept[numbers]
        origins = pairs[edges, 0].astype(np.int64)
        layer = Layer(node, origins, samples[edges], places[numbers[edges]])
        self._layers.append(layer.chosen(np.lexsort((layer.samples, layer.origins))))
        if self._kept >= 0:
            self._kept = int(places[self._kept]) if kept[self._kept] else -1
        return store.with_masks(partial, made.chosen(kept), node, pairs[firsts[kept]])

    def _fit_pairs(self, partial: PartialPoses, node: int) -> PartialPoses:
        """Keep as many of the best as make no more pairs than allowed."""
        counts = np.diff(self.store.groups(partial, node)).ravel()
        kept = self._keep(partial, counts, self.limits.pairs)
        if kept.all():
            return partial
        places = np.cumsum(kept) - 1
        if self._layers:
            last = self._layers[-1].chosen(kept[self._layers[-1].ends])
            self._layers[-1] = replace(last, ends=places[last.ends])
        if self._kept >= 0:
            self._kept = int(places[self._kept])
        return partial.chosen(kept)

    def _keep(self, partial: PartialPoses, counts: np.ndarray, limit: float) -> np.ndarray:
        """Which (B,) bool of those that may lead to poses: the best, by counts (B,) to a limit."""
        alive = partial.bounds <= self.J_limit
        if counts[alive].sum() <= limit:
            return np.asarray(alive)
        # What lies outside counts twice: it stays outside, while what is not covered yet may be
        # covered by a later node.
        costs = np.where(alive, partial.costs(2), np.iinfo(np.int64).max)
        if self._kept >= 0:
            costs[self._kept] = np.iinfo(np.int64).min
        order = np.argsort(costs, kind="stable")
        room = max(1, int(np.searchsorted(np.cumsum(counts[order]), limit, side="right")))
        kept = np.zeros(len(alive), dtype=np.bool_)
        kept[order[:room]] = True
        self._drop(partial.bounds[alive & ~kept], limited=True)
        return np.asarray(alive & kept)


class _SubtreeReaches:
    """What a node and its descendants can cover of the silhouettes, by pose of its parent.

    ``table``: (r, w) uint64 unions; the rows beyond those in use are zero.
    """

    def __init__(self, store: PoseStore) -> None:
        self._store = store
        self.table = np.zeros((256, len(store.pictures.everything)), dtype=np.uint64)
        self._used = 0
        self._rows = [RowTable(1) for _ in store.tree_nodes]

    def rows(self, node: int, parents: np.ndarray, tries: int = 5000) -> np.ndarray:
        """For poses (n,) of the node's parent the rows of ``table``, within the store's limits.

        ``tries``: where more poses of the node are to be tried, a disc that holds all will do.
        """
        known, store = self._rows[node], self._store
        missing = known.missing(parents)
        if len(missing) == 0:
            return known.rows[parents, 0]
        if len(missing) * len(store.body.sampled.values[node]) > tries:
            places = store.reach_rows(node, missing)
            groups = np.column_stack([places, places + 1])
            runs, words, below = store.reach_runs, store.reach_words, NO_CHILDREN
        else:
            groups = store.pose_groups(node, missing)
            below = self.child_rows(node, expand_groups(groups[:, 0], groups[:, 1])[1])
            runs, words = store.nodes[node].runs, store.nodes[node].words
        made = np.arange(self._used, self._used + len(missing))
        self._used += len(missing)
        if self._used > len(self.table):
            store.reserve(8 * self._used * self.table.shape[1])
            more = np.zeros((self._used, self.table.shape[1]), dtype=np.uint64)
            self.table = np.concatenate([self.table, more])
        unite(self.table, made, groups, runs, words, len(store.pictures.views), below)
        known.make(missing, made[:, None])
        return known.rows[parents, 0]

    def child_rows(self, node: int, poses: np.ndarray) -> np.ndarray:
        """(children, all poses) int64 the rows of a node's children at poses (n,) of the node."""
        children = self._store.tree_nodes[node].children
        rows = np.zeros((len(children), len(self._store.nodes[node].samples)), dtype=np.int64)
        for row, child in zip(rows, children, strict=True):
            row[poses] = self.rows(child, poses)
        return rows
