"""Very many poses in little room: a graph of partial poses.

A state stands for all partial poses that are equal in all that matters later; an edge places the
next node at one of its samples. Every path from the first state to a last one is a pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Layer:
    """The edges that place one node, ordered by origin and sample.

    Attributes:
        origins: (m,) int64 the states they start from.
        samples: (m,) int64 the node's samples.
        ends: (m,) int64 the states of the next layer that they lead to.
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
    """A set of poses of the grid.

    Attributes:
        layers: one for each node.
        Js: (last states,) the objective of the poses that end in each [pixel].
        ways: for each layer, and for the last states, (states,) how many partial poses lead there.
        rests: the same, how many ways lead on to the end.

    Args:
        layers: one for each node; states that do not lie between the first state (0) and a last
            one may be among them: they are taken out.
        Js: (last states,).
    """

    def __init__(self, layers: Sequence[Layer], Js: np.ndarray) -> None:
        self.layers, self.Js = _prune(list(layers), np.asarray(Js, dtype=np.float64))
        self.ways: list[np.ndarray] = [np.ones(1)]
        for layer, states in zip(self.layers, self._state_counts()[1:], strict=True):
            weights = self.ways[-1][layer.origins]
            self.ways.append(np.bincount(layer.ends, weights, minlength=states))
        self.rests: list[np.ndarray] = [np.ones(len(self.Js))]
        for layer, states in zip(self.layers[::-1], self._state_counts()[-2::-1], strict=True):
            weights = self.rests[0][layer.ends]
            self.rests.insert(0, np.bincount(layer.origins, weights, minlength=states))

    def _state_counts(self) -> list[int]:
        """How many states each layer starts from, and the last states' number."""
        return [int(layer.origins.max(initial=-1)) + 1 for layer in self.layers] + [len(self.Js)]

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
        layers = []
        for layer in self.layers:
            rule = allowed[layer.node]
            layers.append(layer if rule is None else layer.chosen(rule[layer.samples]))
        return PartialPoseGraph(layers, self.Js)

    def up_to(self, J: float) -> "PartialPoseGraph":
        """Those poses whose objective is no greater."""
        kept = self.Js <= J
        numbers = np.cumsum(kept) - 1
        last = self.layers[-1].chosen(kept[self.layers[-1].ends])
        last = Layer(last.node, last.origins, last.samples, numbers[last.ends])
        return PartialPoseGraph([*self.layers[:-1], last], self.Js[kept])

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Draw poses at random, each as likely as any other: samples (count, nodes).

        Raises:
            ValueError: if there is none to draw.
        """
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
        """A pose with the smallest objective, samples (nodes,): where most ways lead, step by step.

        Raises:
            ValueError: if there is none.
        """
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
    reached = [np.array([True])]
    for index, layer in enumerate(layers):
        following = layers[index + 1].origins if index + 1 < len(layers) else np.zeros(0, int)
        size = max(
            int(layer.ends.max(initial=-1)) + 1,
            int(following.max(initial=-1)) + 1,
            len(Js) if index + 1 == len(layers) else 1,
        )
        there = np.zeros(size, dtype=np.bool_)
        there[layer.ends[reached[-1][layer.origins]]] = True
        reached.append(there)
    useful = reached[-1]
    numbers = np.cumsum(useful) - 1
    Js = Js[useful]
    pruned: list[Layer] = []
    for layer, there in zip(layers[::-1], reached[-2::-1], strict=True):
        kept = layer.chosen(useful[layer.ends] & there[layer.origins])
        ends = numbers[kept.ends]
        useful = np.zeros(len(there), dtype=np.bool_)
        useful[kept.origins] = True
        numbers = np.cumsum(useful) - 1
        pruned.insert(0, Layer(kept.node, numbers[kept.origins], kept.samples, ends))
    return pruned, Js


def single_pose(samples: np.ndarray, J: float) -> PartialPoseGraph:
    """The set of one pose, samples (nodes,), with objective J."""
    zero = np.zeros(1, dtype=np.int64)
    layers = [Layer(node, zero, np.array([t]), zero) for node, t in enumerate(samples)]
    return PartialPoseGraph(layers, np.array([J]))
