"""Which poses of a graph belong together.

Two samples of a node are neighbours if no value differs by more than a step of the grid, or if they
place the node alike. The samples of a node that occur fall into clusters of neighbours of
neighbours; a family is a choice of one cluster for each node.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drake_pose.search.grid.branch_and_bound.partial_pose_graph import Layer, PartialPoseGraph
from drake_pose.search.grid.families.joint_estimates import grid_steps
from drake_pose.search.scoring import SampledTree

_NEIGHBOUR = 1.01
_ALIKE = 1e-6
# Beyond this many pairs of a state and a family, later nodes are not told apart any more.
_MOST_PAIRS = 200_000


@dataclass(frozen=True)
class GraphFamily:
    """One family of a graph.

    Attributes:
        clusters: (nodes,) int64 the cluster of each node.
        size: how many poses it has.
        J: the smallest objective of these [pixel].
    """

    clusters: np.ndarray
    size: float
    J: float


def cluster_samples(sampled: SampledTree, node: int, samples: np.ndarray) -> np.ndarray:
    """The cluster (all samples,) int64 of each sample of a node that occurs; -1 of the others."""
    grid = sampled.values[node]
    labels = np.full(len(grid), -1, dtype=np.int64)
    if grid.shape[1] == 0 or len(samples) == 1:
        labels[samples] = 0
        return labels
    steps = grid_steps(grid)
    scaled = np.where(np.isfinite(steps), grid[samples] / steps, 0.0)
    rotation = sampled.tree.placements[node].rotation
    # A rotation vector of half a turn is the same as its opposite, or nearly so.
    around = sampled.tree.turns_around(node) | (rotation is not None and rotation.kind == "free")
    turns = np.where(around, 2.0 * np.pi / steps, 0.0)
    scaled = np.where(turns > 0.0, np.mod(scaled, np.where(turns > 0.0, turns, 1.0)), scaled)
    tree = cKDTree(scaled - np.where(turns > 0.0, 0.0, scaled.min(axis=0)), boxsize=turns)
    near = tree.query_pairs(_NEIGHBOUR, p=np.inf, output_type="ndarray")
    # With two axes in line, other values place the node alike.
    X_PN = sampled.X_PN[node][samples, :3].reshape(len(samples), -1)
    alike = cKDTree(X_PN).query_pairs(_ALIKE, output_type="ndarray")
    links = np.vstack([near, alike])
    ones = np.ones(len(links))
    graph = coo_array((ones, (links[:, 0], links[:, 1])), shape=(len(samples), len(samples)))
    labels[samples] = connected_components(graph, directed=False)[1]
    return labels


def split_into_families(graph: PartialPoseGraph, labels: list[np.ndarray]) -> list[GraphFamily]:
    """The families of a graph, best first, of equals the larger first.

    Args:
        labels: for each node the clusters of its samples, as of cluster_samples.
    """
    states, families = np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
    sizes: np.ndarray = np.ones(1)
    clusters = np.zeros((1, len(labels)), dtype=np.int64)
    for layer in graph.layers:
        found = labels[layer.node][layer.samples]
        several = found.max(initial=0) > 0 and len(states) < _MOST_PAIRS
        ends, codes, weights = _bundle(layer, found if several else np.zeros_like(found))
        origins, bundle_starts = codes
        first = np.searchsorted(origins, states, side="left")
        count = np.searchsorted(origins, states, side="right") - first
        source = np.repeat(np.arange(len(states)), count)
        edge = np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
        pairs = np.column_stack([families[source], bundle_starts[edge]])
        known, families = np.unique(pairs, axis=0, return_inverse=True)
        clusters = clusters[known[:, 0]]
        clusters[:, layer.node] = known[:, 1]
        keys = np.column_stack([ends[edge], families.ravel()])
        merged, places = np.unique(keys, axis=0, return_inverse=True)
        sizes = np.bincount(places.ravel(), sizes[source] * weights[edge], minlength=len(merged))
        states, families = merged[:, 0], merged[:, 1]
    return _collect(graph, states, families, sizes, clusters)


def _bundle(
    layer: Layer, labels: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Edges alike in origin, cluster and end as one: ends, (origins, clusters), how many each."""
    keys = np.column_stack([layer.origins, labels, layer.ends])
    bundles, counts = np.unique(keys, axis=0, return_counts=True)
    return bundles[:, 2], (bundles[:, 0], bundles[:, 1]), counts.astype(np.float64)


def _collect(
    graph: PartialPoseGraph,
    states: np.ndarray,
    families: np.ndarray,
    sizes: np.ndarray,
    clusters: np.ndarray,
) -> list[GraphFamily]:
    """The families from pairs of a last state and a family."""
    found = []
    for family in np.unique(families):
        own = families == family
        J = float(graph.Js[states[own]].min())
        found.append(GraphFamily(clusters[family], float(sizes[own].sum()), J))
    return sorted(found, key=lambda family: (family.J, -family.size))
