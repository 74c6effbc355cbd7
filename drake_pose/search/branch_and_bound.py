"""Enumerate all poses of a grid whose objective J is at most a limit, by branch and bound.

Nodes are placed in the order of the beam search. The area outside the silhouette stays outside, and
silhouette that no later node can reach stays uncovered, so the sum of these two areas is a lower
bound of J of all completions of a partial pose. A partial pose is dropped only if this bound
exceeds the limit, or if there are too many, which is reported. The result may hold very many poses
and is stored as a layered graph of partial poses.
"""

import itertools
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
    body: SampledBody, views: Sequence[View], J_limit: float, limits: BoundLimits | None = None
) -> PosesWithin:
    """Find all poses of the grid whose objective is at most a limit.

    Poses are missing if a limit of the search was reached, or if areas of several nodes overlap
    beyond the bands around the silhouettes, where they are added.

    Args:
        body: the sampled body, whose grid is searched.
        views: the silhouettes, one per camera.
        J_limit: the greatest objective [pixel].
        limits: limits of time, memory and size; None: the defaults.
    """
    limits, order = limits or BoundLimits(), body.order
    # Bands as wide as the limit, so that no pose within the limit has area beyond them. They are
    # narrowed, but not below 8 pixels, if masks would have more words than this.
    most_words, least_band = 2000, 8
    sides = (view.mask.shape[i] for view in views for i in (0, 1))
    band = max(1, int(min(J_limit, max(sides)))) if J_limit >= 1.0 else 0
    bits = SilhouetteBits(body, views, band, in_full=True)
    while band > least_band and bits.part_starts[-1] > most_words:
        band //= 2
        bits = SilhouetteBits(body, views, band, in_full=True)
    store = PoseStore(body, bits, outside_limit=J_limit, limits=limits)
    reaches, partial, layers = _SubtreeReaches(store), store.start(), list[Layer]()
    room = max(1, min(limits.states, limits.memory // (4 * 8 * store.words)))
    # Least bound of the partial poses that were left out.
    least, limited = np.inf, False
    try:
        for node, following in itertools.zip_longest(order, order[1:]):
            store.reserve(0)
            pairs = reaches.pairs(partial, node, J_limit)
            scores = store.score(partial, node, pairs)
            firsts, made, numbers = store.place(
                partial, node, pairs, scores, len(pairs), keep_beyond=True
            )
            # The area outside has weight 2, since it stays outside, while uncovered silhouette may
            # be covered by a later node.
            alive = np.flatnonzero(made.bounds <= J_limit)
            best = alive[np.argsort(made.costs(2)[alive], kind="stable")][:room]
            if following is not None:
                counts = np.diff(store.groups(made.chosen(best), following)).ravel()
                fitting = np.searchsorted(np.cumsum(counts), limits.pairs, side="right")
                best = best[: max(1, int(fitting))]
            kept = np.zeros(len(made), dtype=np.bool_)
            kept[best] = True
            least = min(least, made.bounds[alive[~kept[alive]]].min(initial=np.inf))
            limited = bool(least < np.inf)
            edges, places = kept[numbers], np.cumsum(kept) - 1
            samples = store.nodes[node].samples[pairs[edges, 1]].astype(np.int64)
            origins = pairs[edges, 0].astype(np.int64)
            layer = Layer(node, origins, samples, places[numbers[edges]])
            layers.append(layer.chosen(np.lexsort((samples, origins))))
            partial = store.with_masks(partial, made.chosen(kept), node, pairs[firsts[kept]])
    except LimitReached:
        least = float(min(least, partial.bounds.min(initial=np.inf)))
        nothing = np.zeros(0, dtype=np.int64)
        layers = [Layer(i, nothing, nothing, nothing) for i in order]
        return PosesWithin(J_limit, PartialPoseGraph(layers, np.zeros(0)), False, True, least)
    # All nodes are placed: the bounds are the objectives, except for areas beyond the bands. There
    # the bound contains only the largest area of a node, and ``highs`` their sum.
    highs = partial.bounds + partial.beyond[:, 1] - partial.beyond[:, 0]
    graph = PartialPoseGraph(layers, highs).up_to(J_limit)
    least = min(least, partial.bounds[highs > J_limit].min(initial=np.inf))
    bound = float(min(least, np.floor(J_limit) + 1.0))
    return PosesWithin(J_limit, graph, bool(np.isinf(least)), limited, bound)


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

    def pairs(
        self, partial: PartialPoses, node: int, J_limit: float, many: int = 5000
    ) -> np.ndarray:
        """Return the pairs of partial pose and node's pose that can lead to J up to a limit.

        More pairs than ``many`` are pruned; unlike the bound of a partial pose, this uses the poses
        that the other nodes can take that can be placed next. They are (p, 2) int32, as of
        ``PoseStore.pairs``.
        """
        store, bits = self._store, self._store.bits
        pairs = store.pairs(partial, node)
        if len(pairs) <= many:
            return pairs
        placed = frozenset(np.flatnonzero(partial.poses[0] >= 0).tolist())
        below, uncovered = self.child_rows(node, pairs[:, 1]), bits.all_pixels
        uncovered = uncovered & ~partial.masks[:, : len(uncovered)]
        waiting = (one for one in store.body.frontier(placed)[1] if one != node)
        others = [self.rows(one, store.parents(partial.poses, one)) for one in waiting]
        for rows in others:
            uncovered &= ~self.table[rows]
        room, own = np.floor(J_limit - partial.least_outside).astype(np.int64), store.nodes[node]
        return pairs[
            prune_pairs(
                uncovered, room, pairs, own.runs, own.words, len(bits.views), below, self.table
            )
        ]

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
