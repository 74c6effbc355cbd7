"""Enumerate all poses of a grid whose objective J is at most a limit, by branch and bound.

Nodes are placed one after another. The area outside the silhouette stays outside, and silhouette
that no later node can reach stays uncovered, so the sum of these two areas is a lower bound of J of
all completions of a partial pose. A partial pose is dropped only if this bound exceeds the limit,
or if there are too many, which is reported. The result may hold very many poses and is stored as a
layered graph of partial poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.search.estimates import View
from drake_pose.search.pair_kernel import NO_CHILDREN, prune_pairs, unite
from drake_pose.search.partial_poses import (
    BoundLimits,
    LimitReached,
    PartialPoses,
    PoseStore,
    RowTable,
    SilhouetteBits,
    expand_groups,
)
from drake_pose.search.sampled_body import SampledBody


@dataclass(frozen=True)
class Layer:
    """The edges of the graph that place one node, sorted by origin and sample.

    A state is a partial pose; states of a layer are numbered from 0.
    """

    node: int  # Index of the node.
    origins: np.ndarray  # (m,) int64 states of this layer from which the edges start.
    samples: np.ndarray  # (m,) int64 the node's samples: indices in its grid.
    ends: np.ndarray  # (m,) int64 states of the next layer at which the edges end.

    def chosen(self, edges: np.ndarray) -> "Layer":
        """Return the layer with a subset of its edges, (m,) bool."""
        return Layer(self.node, self.origins[edges], self.samples[edges], self.ends[edges])


class PartialPoseGraph:
    """A set of poses of a grid, stored as the paths of a layered graph.

    A path from state 0 of the first layer to a last state is a pose. States that are on no path are
    removed.

    Attributes:
        layers: one layer for each node, in the order in which the nodes are placed.
        Js: (last states,) the objective of the poses that end in each last state [pixel].
        ways: for each layer, and for the last states, (states,) number of paths to each state.
    """

    def __init__(self, layers: Sequence[Layer], Js: np.ndarray) -> None:
        """Make the graph from layers and Js as in the class, with states on no path removed."""
        # Remove states that are on no complete path, and number the others consecutively.
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
        """Make the set of one pose, of samples (nodes,) in the grids, with objective J [pixel]."""
        zero = np.zeros(1, dtype=np.int64)
        layers = [Layer(node, zero, np.array([t]), zero) for node, t in enumerate(samples)]
        return cls(layers, np.array([J]))

    @property
    def size(self) -> float:
        """Number of poses; a float, since it may exceed the range of int64."""
        return float(self.ways[-1].sum()) if len(self.Js) else 0.0

    @property
    def best_J(self) -> float:
        """Smallest objective [pixel]; infinite if the set is empty."""
        return float(self.Js.min(initial=np.inf))

    def objective(self, samples: np.ndarray) -> float | None:
        """Return J [pixel] of a pose with samples (nodes,); None if the pose is not in the set."""
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
        """Return whether a pose is in the set, given by samples as for ``objective``."""
        return self.objective(samples) is not None

    def samples_used(self) -> list[np.ndarray]:
        """Return for each node the samples that occur in any pose, in increasing order."""
        used: list[np.ndarray] = [np.zeros(0, dtype=np.int64)] * len(self.layers)
        for layer in self.layers:
            used[layer.node] = np.unique(layer.samples)
        return used

    def restricted(self, allowed: Sequence[np.ndarray]) -> "PartialPoseGraph":
        """Return the poses all of whose samples are allowed, by (samples,) bool for each node."""
        layers = [layer.chosen(allowed[layer.node][layer.samples]) for layer in self.layers]
        return PartialPoseGraph(layers, self.Js)

    def up_to(self, J: float) -> "PartialPoseGraph":
        """Return the poses whose objective is at most J [pixel]."""
        kept = self.Js <= J
        last = self.layers[-1].chosen(kept[self.layers[-1].ends])
        last = replace(last, ends=(np.cumsum(kept) - 1)[last.ends])
        return PartialPoseGraph([*self.layers[:-1], last], self.Js[kept])

    def central(self) -> np.ndarray:
        """Return samples (nodes,) of a pose of least J, going back along the states of most paths.

        Raises ValueError: if the set is empty.
        """
        if not self.size:
            raise ValueError("an empty set has no central pose")
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
    """Result of a branch and bound."""

    J_limit: float  # The limit of the objective [pixel].
    graph: PartialPoseGraph  # Poses of the grid with J up to the limit.
    complete: bool  # Whether the graph certainly holds all of them.
    limited: bool  # Whether poses may be missing because a limit of the search was reached.
    # Lower bound of J of all poses of the grid that are not in the graph [pixel].
    lower_bound: float


def branch_and_bound(
    body: SampledBody,
    views: Sequence[View],
    J_limit: float,
    limits: BoundLimits | None = None,
    kept_samples: np.ndarray | None = None,
) -> PosesWithin:
    """Find all poses of the grid whose objective is at most a limit.

    Poses are missing if a limit of the search was reached, or if areas of several nodes overlap
    beyond the bands around the silhouettes, where they are added.

    Args:
        body: the sampled body, whose grid is searched.
        views: the silhouettes, one per camera.
        J_limit: the greatest objective [pixel].
        limits: limits of time, memory and size; None: the defaults.
        kept_samples: (nodes,) samples (indices in the nodes' grids) of a pose that is kept even if
            there are too many; None: no pose is preferred.
    """
    return _BranchAndBound(body, views, J_limit, limits or BoundLimits(), kept_samples).run()


class _BranchAndBound:
    """One run of ``branch_and_bound``, which has the same arguments."""

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
        # Bands as wide as the limit, so that no pose within the limit has area beyond them. They
        # are narrowed, but not below 8 pixels, if masks would have more words than this.
        most_words, least_band = 2000, 8
        sides = (view.mask.shape[i] for view in views for i in (0, 1))
        band = max(1, int(min(J_limit, max(sides)))) if J_limit >= 1.0 else 0
        self.bits = SilhouetteBits(body, views, band, in_full=True)
        while band > least_band and self.bits.part_starts[-1] > most_words:
            band //= 2
            self.bits = SilhouetteBits(body, views, band, in_full=True)
        self.store = PoseStore(body, self.bits, outside_limit=J_limit, limits=limits)
        self.nodes = self.store.tree_nodes
        self.reaches = _SubtreeReaches(self.store)
        self._layers: list[Layer] = []
        self._complete = True
        self._limited = False
        self._lower_bound = np.inf
        # Index of the partial pose that the pose to be kept extends; -1: none.
        self._kept = -1 if kept_samples is None else 0
        self._kept_samples = np.zeros(0) if kept_samples is None else kept_samples

    def run(self) -> PosesWithin:
        """Place all nodes and return the poses found."""
        partial = self.store.start()
        while len(self._layers) < len(self.nodes):
            try:
                self.store.reserve(0)
                partial, node, pairs = self._choose(partial)
                partial = self._place(partial, node, pairs)
            except LimitReached:
                left = float(partial.bounds.min()) if len(partial) else np.inf
                bound = min(self._lower_bound, left)
                nothing = np.zeros(0, dtype=np.int64)
                layers = [Layer(i, nothing, nothing, nothing) for i in range(len(self.nodes))]
                graph = PartialPoseGraph(layers, np.zeros(0))
                return PosesWithin(self.J_limit, graph, False, True, bound)
        # All nodes are placed: the bounds are the objectives, except for areas beyond the bands.
        # There the bound contains only the largest area of a node, and ``highs`` their sum.
        highs = partial.bounds + partial.beyond[:, 1] - partial.beyond[:, 0]
        graph = PartialPoseGraph(self._layers, highs).up_to(self.J_limit)
        self._drop(partial.bounds[highs > self.J_limit])
        bound = min(self._lower_bound, float(np.floor(self.J_limit)) + 1.0)
        return PosesWithin(self.J_limit, graph, self._complete, self._limited, bound)

    def _drop(self, bounds: np.ndarray, limited: bool = False) -> None:
        """Record bounds (n,) of dropped partial poses; ``limited``: for a limit of the search."""
        if len(bounds):
            self._complete = False
            self._limited = self._limited or limited
            self._lower_bound = min(self._lower_bound, float(bounds.min()))

    def _choose(self, partial: PartialPoses) -> tuple[PartialPoses, int, np.ndarray]:
        """Choose the node to place next.

        Returns the partial poses, perhaps fewer; the node; and (p, 2) int32 pairs of a partial pose
        and a pose of the node that are to be evaluated.
        """
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
        # With more pairs than this it is faster to prune them by what later nodes can cover.
        if min(totals) > 300:
            for other in waiting:
                if np.diff(self.store.groups(partial, other)).sum() <= self.limits.pairs:
                    pruned = self._pruned_pairs(partial, other, waiting)
                    if len(pruned) < len(pairs):
                        node, pairs = other, pruned
        return partial, node, pairs

    def _pruned_pairs(self, partial: PartialPoses, node: int, waiting: Sequence[int]) -> np.ndarray:
        """Return the pairs of partial pose and node's pose that can still lead to the limit of J.

        Unlike the bound of a partial pose, this uses the poses that the waiting nodes can take: all
        that can be placed next. The pairs are (p, 2) int32, as of ``PoseStore.pairs``.
        """
        pairs = self.store.pairs(partial, node)
        below = self.reaches.child_rows(node, pairs[:, 1])
        reaches, parents = self.reaches, self.store.parents
        others = [reaches.rows(k, parents(partial.poses, k)) for k in waiting if k != node]
        table, all_pixels = self.reaches.table, self.bits.all_pixels
        uncovered = all_pixels & ~partial.masks[:, : len(all_pixels)]
        for rows in others:
            uncovered &= ~table[rows]
        room = np.floor(self.J_limit - partial.least_outside).astype(np.int64)
        stored, views = self.store.nodes[node], len(self.bits.views)
        good = prune_pairs(uncovered, room, pairs, stored.runs, stored.words, views, below, table)
        return pairs[good]

    def _place(self, partial: PartialPoses, node: int, pairs: np.ndarray) -> PartialPoses:
        """Place a node at the pairs (p, 2) of partial pose and node's pose, and add the layer.

        Returns the distinct partial poses, with masks, which are the states after the layer.
        """
        store = self.store
        made = store.make(partial, node, pairs, store.score(partial, node, pairs))
        firsts, made, numbers = store.choose(
            partial, made, node, pairs, len(pairs), keep_beyond=True
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
        """Return the best partial poses, whose pairs with the node are within ``limits.pairs``.

        The last layer's edges to the other partial poses are removed.
        """
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
        """Return which partial poses are kept, (B,) bool.

        Those whose bound exceeds the limit of J are dropped. If the others' sum of ``counts``
        exceeds ``limit``, only the best are kept, up to this sum but at least one.

        ``partial``: the B partial poses. ``counts``: (B,) number of pairs, or 1, that each needs.
        ``limit``: greatest sum of the counts.
        """
        alive = partial.bounds <= self.J_limit
        if counts[alive].sum() <= limit:
            return np.asarray(alive)
        # The area outside has weight 2, since it stays outside, while uncovered silhouette may be
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
    """The silhouette that a node and its descendants can cover, for each pose of its parent.

    Attributes:
        table: (r, w) uint64 bit masks, unions over all poses; rows that are not in use are zero.
    """

    def __init__(self, store: PoseStore) -> None:
        self._store = store
        self.table = np.zeros((256, len(store.bits.all_pixels)), dtype=np.uint64)
        self._used = 0
        self._rows = [RowTable(1) for _ in store.tree_nodes]

    def rows(self, node: int, parents: np.ndarray, tries: int = 5000) -> np.ndarray:
        """Return the rows (n,) of ``table`` of a node, for poses ``parents`` (n,) of its parent.

        ``tries``: if more poses of the node would have to be drawn, the disc that contains the
        projections of all of them is used instead.
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
        unite(self.table, made, groups, runs, words, len(store.bits.views), below)
        known.make(missing, made[:, None])
        return known.rows[parents, 0]

    def child_rows(self, node: int, poses: np.ndarray) -> np.ndarray:
        """Return (children, all poses) int64 rows of ``table`` of a node's children.

        Columns are the node's poses in the store. Only those of ``poses`` (n,) are set; the others
        are 0.
        """
        children = self._store.tree_nodes[node].children
        rows = np.zeros((len(children), len(self._store.nodes[node].samples)), dtype=np.int64)
        for row, child in zip(rows, children, strict=True):
            row[poses] = self.rows(child, poses)
        return rows
