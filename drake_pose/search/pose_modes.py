"""All poses of the grid as good as the best within the noise, in modes; is the best proved?

Two samples of a node are neighbours if no value differs by more than a step of the grid, or if they
place the node alike. The samples of a node that occur fall into clusters of neighbours of
neighbours; a mode is a choice of one cluster for each node.

A complete branch and bound without a find proves that J is greater than its limit everywhere: just
below the best J known. An incomplete one gives a smaller bound.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drake_pose.errors import SettingsError
from drake_pose.search.branch_and_bound import (
    PartialPoseGraph,
    PosesWithin,
    branch_and_bound,
)
from drake_pose.search.estimates import JointEstimate, PoseEstimate, PoseMode, PoseSet, View
from drake_pose.search.partial_poses import expand_groups
from drake_pose.search.sampled_body import SampledBody, SampledTree
from drake_pose.search.settings import BoundLimits


def grid_steps(grid: np.ndarray) -> np.ndarray:
    """The spacing of each column (k,) of a node's grid (n, k); infinite where it has one value.

    A grid that is no product of its columns has the spacing of its nearest neighbours.
    """
    columns = [np.unique(np.round(column, 9)) for column in grid.T]
    if np.prod([len(column) for column in columns], initial=1.0) == len(grid):
        return np.array([np.diff(column).min(initial=np.inf) for column in columns])
    gaps = np.linalg.norm(grid[:, None] - grid[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    return np.full(grid.shape[1], float(np.median(gaps.min(axis=1))))


def estimate_joints(
    sampled: SampledTree,
    samples: Sequence[np.ndarray],
    about: Sequence[np.ndarray],
    *,
    complete: bool = True,
) -> tuple[JointEstimate, ...]:
    """Report each value of a tree, node after node.

    A value is determined if it spans no more than one step of its grid; half a step is added on
    both sides, because the truth may lie between the grid's values.

    Args:
        samples: for each node (n,) those of its samples that occur.
        about: for each node (k,) the answer, near whose turn angles are given that turn around.
        complete: whether these are all; else nothing is determined but what cannot move.
    """
    reports = []
    for i, node in enumerate(sampled.tree.nodes):
        lower, upper = sampled.tree.value_bounds(i)
        around = sampled.tree.turns_around(i)
        steps = grid_steps(sampled.values[i])
        for k, name in enumerate(node.value_names):
            values = np.unique(np.round(sampled.values[i][samples[i], k], 12))
            if around[k]:
                # Angles of one turn, rising from the widest gap between them.
                full = 2.0 * np.pi
                gaps = np.diff(values, append=values[0] + full)
                first = (int(np.argmax(gaps)) + 1) % len(values)
                if len(values) > 1 and gaps.max() > steps[k] * (1.0 + 1e-6):
                    values = np.concatenate([values[first:], values[:first] + full])
                    middle = 0.5 * (values[0] + values[-1])
                    values = values + full * np.round((about[i][k] - middle) / full)
            known = complete or np.isinf(steps[k])
            determined = bool(known and np.ptp(values) <= steps[k] * (1.0 + 1e-6))
            margin = 0.5 * steps[k] if determined else 0.0
            low, high = float(values[0] - margin), float(values[-1] + margin)
            if not around[k]:
                low, high = max(low, float(lower[k])), min(high, float(upper[k]))
            reports.append(JointEstimate(name, determined, low, high, bool(around[k])))
    return tuple(reports)


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
    near = tree.query_pairs(1.01, p=np.inf, output_type="ndarray")
    # With two axes in line, other values place the node alike.
    X_PN = sampled.X_PN[node][samples, :3].reshape(len(samples), -1)
    alike = cKDTree(X_PN).query_pairs(1e-6, output_type="ndarray")
    links = np.vstack([near, alike])
    ones = np.ones(len(links))
    graph = coo_array((ones, (links[:, 0], links[:, 1])), shape=(len(samples), len(samples)))
    labels[samples] = connected_components(graph, directed=False)[1]
    return labels


def split_into_modes(
    graph: PartialPoseGraph, labels: list[np.ndarray], most_pairs: int = 200_000
) -> list[tuple[float, float, np.ndarray]]:
    """The modes of a graph by clusters of samples: J [pixel], poses, clusters (nodes,).

    Best first, of equals the larger first. ``most_pairs``: beyond this number of pairs of a state
    and a mode, later nodes are not told apart any more.
    """
    states, modes = np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
    sizes: np.ndarray = np.ones(1)
    clusters = np.zeros((1, len(labels)), dtype=np.int64)
    for layer in graph.layers:
        found = labels[layer.node][layer.samples]
        several = found.max(initial=0) > 0 and len(states) < most_pairs
        # Edges alike in origin, cluster and end are one.
        keys = np.column_stack([layer.origins, found if several else 0 * found, layer.ends])
        bundles, weights = np.unique(keys, axis=0, return_counts=True)
        begins = np.searchsorted(bundles[:, 0], states)
        after = np.searchsorted(bundles[:, 0], states, side="right")
        source, edge = expand_groups(begins, after)
        pairs = np.column_stack([modes[source], bundles[edge, 1]])
        known, modes = np.unique(pairs, axis=0, return_inverse=True)
        clusters = clusters[known[:, 0]]
        clusters[:, layer.node] = known[:, 1]
        keys = np.column_stack([bundles[edge, 2], modes.ravel()])
        merged, places = np.unique(keys, axis=0, return_inverse=True)
        sizes = np.bincount(places.ravel(), sizes[source] * weights[edge], minlength=len(merged))
        states, modes = merged[:, 0], merged[:, 1]
    split = []
    for mode in np.unique(modes):
        own = modes == mode
        J = float(graph.Js[states[own]].min())
        split.append((J, float(sizes[own].sum()), clusters[mode]))
    return sorted(split, key=lambda one: (one[0], -one[1]))


@dataclass(frozen=True)
class GridPoseSet(PoseSet):
    """A set of poses of the grid that tells of any pose whether it is in it."""

    graph: PartialPoseGraph
    sampled: SampledTree
    budget_spent: bool

    @property
    def size(self) -> float:
        """How many poses there are."""
        return self.graph.size

    def contains(self, node_values: Sequence[np.ndarray]) -> bool:
        """Whether a pose of the grid, the values of each node, is in the set."""
        samples = samples_at(self.sampled, node_values)
        return samples is not None and self.graph.contains(samples)


def find_modes(
    body: SampledBody,
    views: Sequence[View],
    samples: np.ndarray,
    J: float,
    tolerance: float | None = None,
    most: int = 32,
    limits: BoundLimits | None = None,
    within: PosesWithin | None = None,
) -> GridPoseSet:
    """Find all poses of the grid as good as the best, of samples (nodes,) with objective J [pixel].

    Args:
        tolerance: a pose counts as good as the best if its objective is greater by no more than
            this [pixel]; None: up to what two renderers differ by where the best is within that
            (``renderer_tolerance``), else 5 % of the contours' length.
        most: how many modes are described at most.
        within: all poses within a tolerance of exactness, where they are known: the tolerance is
            that then.

    Returns:
        The set. It holds the best pose known, and if a better one turns up, that one and those
            within the tolerance of it.
    """
    if within is not None:
        tolerance = within.J_limit - J
    elif tolerance is None:
        exact = renderer_tolerance(views)
        tolerance = exact - J if J <= exact else 0.05 * contour_length(views)
    found = within or branch_and_bound(body, views, J + tolerance, limits, samples)
    graph = found.graph
    if graph.best_J < J:
        graph = graph.up_to(graph.best_J + tolerance)
    complete = found.complete
    if graph.size == 0.0:
        graph, complete = PartialPoseGraph.of_pose(samples, J), False
    sampled, described = body.sampled, []
    seen = graph.samples_seen()
    labels = [cluster_samples(sampled, node, own) for node, own in enumerate(seen)]
    modes = split_into_modes(graph, labels)
    for mode_J, size, clusters in modes[:most]:
        own = graph.restricted(
            [label == cluster for label, cluster in zip(labels, clusters, strict=True)]
        )
        # The pose given stands for its own mode if it is a best one.
        first = samples if own.objective(samples) == mode_J else own.central()
        values = sampled.values_at(first)
        joints = estimate_joints(sampled, own.samples_seen(), values, complete=complete)
        described.append(PoseMode.of_values(sampled.tree, values, mode_J, joints, size))
    return GridPoseSet(
        modes=tuple(described),
        joints=estimate_joints(sampled, seen, described[0].node_values, complete=complete),
        tolerance=tolerance,
        complete=complete,
        mode_count=len(modes),
        graph=graph,
        sampled=sampled,
        budget_spent=found.limited,
    )


def samples_at(sampled: SampledTree, node_values: Sequence[np.ndarray]) -> np.ndarray | None:
    """The samples (nodes,) of a pose of the grid; None if it is not on the grid."""
    samples = np.zeros(len(sampled.values), dtype=np.int64)
    for i, (grid, values) in enumerate(zip(sampled.values, node_values, strict=True)):
        if grid.shape[1] == 0:
            # Where its joints follow its parent's it takes the parent's sample.
            samples[i] = samples[sampled.tree.source(i)]
            continue
        gaps = np.abs(grid - np.asarray(values)).max(axis=1)
        samples[i] = int(np.argmin(gaps))
        if gaps[samples[i]] > 1e-6:
            return None
    return samples


def contour_length(views: Sequence[View]) -> int:
    """How many pixels of the silhouettes have a neighbour in the picture that is in none."""
    return sum(
        int((view.mask & ~binary_erosion(view.mask, border_value=1)).sum()) for view in views
    )


def renderer_tolerance(views: Sequence[View]) -> float:
    """By how much two renderers' silhouettes of one pose may differ [pixel].

    Measured between Drake's VTK renderer, which snaps vertices to 1/256 pixel in float32, and the
    areas that are scored: .1 % of the contour's pixels on average for pictures of 80 to 1280
    pixels, one independently of the other. This is five standard deviations above that.
    """
    expected = 0.001 * contour_length(views)
    return math.floor(expected + 5.0 * math.sqrt(expected) + 1.0)


@dataclass(frozen=True)
class ExaminationSettings:
    """Parameters of an examination.

    Args:
        proof_time_limit: the proof ends after this time [s], proved or not; None: no limit, 0: it
            is not tried. An answer with J = 0 needs none.
        mode_time_limit: the same of the search for all poses as good; it then answers with those
            it has, and no joint is called determined.
        proof_poses: the proof ends after this number of poses of nodes is drawn: unlike a
            limit on time, with the same result on every machine.
        mode_poses: the same of the search for all poses as good: about two seconds.
        memory: of each of the two, for what it keeps; it ends as if its time were over [byte].
        modes: how many modes are described at most.
        tolerance: as in ``find_modes`` [pixel].

    Raises:
        SettingsError: if a value is out of its range.
    """

    proof_time_limit: float | None = None
    mode_time_limit: float | None = None
    proof_poses: int = 25_000
    mode_poses: int = 50_000
    memory: int = BoundLimits.memory
    modes: int = 32
    tolerance: float | None = None

    def __post_init__(self) -> None:
        if self.tolerance is not None and not self.tolerance >= 0.0:
            raise SettingsError(f"tolerance must be 0 pixels or more, not {self.tolerance}")
        if self.modes < 1:
            raise SettingsError(f"modes must be 1 or more, not {self.modes}")
        self.limits("mode"), self.limits("proof")

    def limits(self, step: str) -> BoundLimits:
        """Those of the "proof", or of the search for all poses as good, of a "mode"."""
        poses, seconds = getattr(self, f"{step}_poses"), getattr(self, f"{step}_time_limit")
        return BoundLimits(poses=poses, memory=self.memory, time_limit=seconds)


def examine(
    body: SampledBody,
    views: Sequence[View],
    result: PoseEstimate,
    settings: ExaminationSettings,
    root_position: np.ndarray | None = None,
    within: PosesWithin | None = None,
) -> PoseEstimate:
    """The result, or a better pose, with ``lower_bound``, ``budget_spent`` and ``pose_set``.

    ``within``: all poses within a tolerance of exactness, where the search has found them.

    Raises:
        SettingsError: if the result is not of the body's grid.
    """
    if not result.found:
        return result
    if root_position is not None:
        body = body.with_root_position(root_position)
    samples = samples_at(body.sampled, result.node_values)
    if samples is None:
        raise SettingsError("the pose to be examined is not on the body's sampling grid")
    J, lower_bound, spent = result.J, 0.0, result.J > 0.0
    if within is None and J > 0.0 and settings.proof_time_limit != 0.0:
        better = branch_and_bound(body, views, J - 1.0, settings.limits("proof"))
        if better.graph.best_J < J:
            J, samples = better.graph.best_J, better.graph.central()
        lower_bound, spent = J if better.complete else better.lower_bound, better.limited
    answer = find_modes(
        body, views, samples, J, settings.tolerance, settings.modes, settings.limits("mode"),
        within if settings.tolerance is None else None,
    )  # fmt: skip
    best = answer.modes[0]
    J = min(J, best.J)
    if J < result.J:
        q, X_WB, values = best.q, best.X_WB, best.node_values
        result = replace(result, q=q, X_WB=X_WB, node_values=values, J=J)
    # A complete set has all that is as good or better.
    lower_bound = J if answer.complete else min(lower_bound, J)
    return replace(
        result,
        lower_bound=lower_bound,
        budget_spent=answer.budget_spent or (spent and lower_bound < J),
        pose_set=answer,
    )
