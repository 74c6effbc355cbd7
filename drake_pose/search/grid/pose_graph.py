"""Very many poses in little room: a graph of partial poses.

A state stands for all partial poses that are equal in all that matters later; an edge places the
next node at one of its samples. Every path from the first state to a last one is a pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


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


def spread(begins: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The places of groups, given by where they begin and end (n,), and before them the groups."""
    counts = ends - begins
    groups = np.repeat(np.arange(len(counts)), counts)
    return groups, np.arange(len(groups)) + (begins - np.cumsum(counts) + counts)[groups]


def make_layer(node: int, origins: np.ndarray, samples: np.ndarray, ends: np.ndarray) -> Layer:
    """A layer of edges in any order."""
    order = np.lexsort((samples, origins))
    return Layer(node, origins[order], samples[order], ends[order])


class PartialPoseGraph:
    """A set of poses of the grid; states not between the first (0) and a last are left out.

    Attributes:
        layers: one for each node.
        Js: (last states,) the objective of the poses that end in each [pixel].
        ways, rests: for each layer, and for the last states, (states,) how many partial poses
            lead there, and how many ways lead on to the end.
    """

    def __init__(self, layers: Sequence[Layer], Js: np.ndarray) -> None:
        self.layers, self.Js = _prune(list(layers), np.asarray(Js, dtype=np.float64))
        counts = [int(layer.origins.max(initial=-1)) + 1 for layer in self.layers]
        self.ways: list[np.ndarray] = [np.ones(1)]
        self.rests: list[np.ndarray] = [np.ones(len(self.Js))]
        for layer, states in zip(self.layers, [*counts[1:], len(self.Js)], strict=True):
            weights = self.ways[-1][layer.origins]
            self.ways.append(np.bincount(layer.ends, weights, minlength=states))
        for layer, states in zip(self.layers[::-1], counts[::-1], strict=True):
            weights = self.rests[0][layer.ends]
            self.rests.insert(0, np.bincount(layer.origins, weights, minlength=states))

    @property
    def size(self) -> float:
        """How many poses there are; a float because they may be very many."""
        return float(self.rests[0].sum()) if len(self.Js) else 0.0

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

    def restricted(self, allowed: Sequence[np.ndarray | None]) -> "PartialPoseGraph":
        """The poses that take allowed samples alone, (samples,) bool of each node; None: all."""
        rules = [allowed[layer.node] for layer in self.layers]
        layers = [
            layer if rule is None else layer.chosen(rule[layer.samples])
            for layer, rule in zip(self.layers, rules, strict=True)
        ]
        return PartialPoseGraph(layers, self.Js)

    def up_to(self, J: float) -> "PartialPoseGraph":
        """Those poses whose objective is no greater."""
        kept = self.Js <= J
        last = self.layers[-1].chosen(kept[self.layers[-1].ends])
        last = replace(last, ends=(np.cumsum(kept) - 1)[last.ends])
        return PartialPoseGraph([*self.layers[:-1], last], self.Js[kept])

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Poses drawn at random, samples (count, nodes); ValueError if there is none to draw."""
        if not self.size:
            raise ValueError("a pose was to be drawn from an empty set")
        drawn = np.empty((count, len(self.layers)), dtype=np.int64)
        for row in drawn:
            state = 0
            for layer, rests in zip(self.layers, self.rests[1:], strict=True):
                begin, end = np.searchsorted(layer.origins, [state, state + 1])
                weights = rests[layer.ends[begin:end]]
                edge = begin + generator.choice(end - begin, p=weights / weights.sum())
                row[layer.node], state = layer.samples[edge], layer.ends[edge]
        return drawn

    def members(self) -> np.ndarray:
        """All poses, samples (size, nodes); mind the size."""
        partial, states = np.zeros((1, len(self.layers)), dtype=np.int64), np.zeros(1, dtype=int)
        for layer in self.layers:
            begins = np.searchsorted(layer.origins, states)
            source, edges = spread(begins, np.searchsorted(layer.origins, states, side="right"))
            partial, states = partial[source], layer.ends[edges]
            partial[:, layer.node] = layer.samples[edges]
        return partial

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


def _prune(layers: list[Layer], Js: np.ndarray) -> tuple[list[Layer], np.ndarray]:
    """The layers without states that lead nowhere or are led to from nowhere, numbered anew."""
    origins = [layer.origins for layer in layers[1:]] + [np.arange(len(Js))]
    reached = [np.array([True])]
    for layer, following in zip(layers, origins, strict=True):
        size = int(max(layer.ends.max(initial=0), following.max(initial=-1))) + 1
        there = np.zeros(size, dtype=np.bool_)
        there[layer.ends[reached[-1][layer.origins]]] = True
        reached.append(there)
    useful = reached[-1][: len(Js)]
    Js = Js[useful]
    pruned: list[Layer] = []
    for layer, there in zip(layers[::-1], reached[-2::-1], strict=True):
        kept = layer.chosen(useful[layer.ends] & there[layer.origins])
        ends = (np.cumsum(useful) - 1)[kept.ends]
        useful = np.zeros(len(there), dtype=np.bool_)
        useful[kept.origins] = True
        places = np.cumsum(useful) - 1
        pruned.insert(0, Layer(kept.node, places[kept.origins], kept.samples, ends))
    return pruned, Js


def single_pose(samples: np.ndarray, J: float) -> PartialPoseGraph:
    """The set of one pose, samples (nodes,), with objective J."""
    zero = np.zeros(1, dtype=np.int64)
    layers = [Layer(node, zero, np.array([t]), zero) for node, t in enumerate(samples)]
    return PartialPoseGraph(layers, np.array([J]))
