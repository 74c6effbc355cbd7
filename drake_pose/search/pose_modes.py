"""Find all poses of a grid that are as good as the best, group them into modes, and prove the best.

Two samples of a node are neighbours if no value differs by more than a step of the grid, or if they
give the node the same pose. The samples that occur in the set form clusters: connected components
of neighbours. A mode is a choice of one cluster for each node.

A complete branch and bound with the limit just below the best known J that finds no pose proves
that the best pose is optimal. An incomplete one gives a smaller lower bound.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drake_pose.errors import SettingsError, require_at_least
from drake_pose.search.branch_and_bound import PartialPoseGraph, PosesWithin, branch_and_bound
from drake_pose.search.estimates import JointEstimate, PoseEstimate, PoseMode, PoseSet, View
from drake_pose.search.partial_poses import BoundLimits, expand_groups
from drake_pose.search.sampled_body import SampledBody, SampledTree
from drake_pose.silhouette.pictures.masks import count_edge_pixels


def grid_steps(grid: np.ndarray) -> np.ndarray:
    """Return the spacing of each column of a node's grid: (k,) [rad or m].

    It is infinite for a column with a single value. If the grid (n, k) is not the product of its
    columns, all columns get the median distance between nearest neighbours.
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
    """Return the interval of each value of a tree over a set of poses, in the order of the nodes.

    A value is determined if it spans at most one step of its grid. Half a step is then added on
    both sides, because the true value may lie between the grid's values.

    Args:
        sampled: the tree and its grids.
        samples: for each node (n,) its samples (indices in its grid) that occur in the set.
        about: for each node (k,) the values of the answer; intervals of angles that turn around are
            given in the turn nearest to these [rad or m].
        complete: whether the set is complete; if not, only values that cannot move are determined.
    """
    reports = []
    for i, node in enumerate(sampled.tree.nodes):
        lower, upper = sampled.tree.value_bounds(i)
        around = sampled.tree.covers_full_turn(i)
        steps = grid_steps(sampled.values[i])
        for k, name in enumerate(node.value_names):
            values = np.unique(np.round(sampled.values[i][samples[i], k], 12))
            if around[k]:
                # Order the angles within one turn, starting after the widest gap.
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
    """Return the cluster of each sample of a node, (all samples,) int64; -1 if it does not occur.

    ``sampled``: the tree and its grids. ``node``: index of the node. ``samples``: (n,) the node's
    samples that occur in a set of poses.
    """
    grid = sampled.values[node]
    labels = np.full(len(grid), -1, dtype=np.int64)
    if grid.shape[1] == 0 or len(samples) == 1:
        labels[samples] = 0
        return labels
    steps = grid_steps(grid)
    scaled = np.where(np.isfinite(steps), grid[samples] / steps, 0.0)
    rotation = sampled.tree.placements[node].rotation
    # Opposite rotation vectors of half a turn are the same rotation.
    around = sampled.tree.covers_full_turn(node) | (
        rotation is not None and rotation.kind == "free"
    )
    turns = np.where(around, 2.0 * np.pi / steps, 0.0)
    scaled = np.where(turns > 0.0, np.mod(scaled, np.where(turns > 0.0, turns, 1.0)), scaled)
    tree = cKDTree(scaled, boxsize=turns)
    near = tree.query_pairs(1.01, p=np.inf, output_type="ndarray")
    # Different values give the same pose where two axes coincide.
    X_PN = sampled.X_PN[node][samples, :3].reshape(len(samples), -1)
    same_pose = cKDTree(X_PN).query_pairs(1e-6, output_type="ndarray")
    links = np.vstack([near, same_pose])
    ones = np.ones(len(links))
    graph = coo_array((ones, (links[:, 0], links[:, 1])), shape=(len(samples), len(samples)))
    labels[samples] = connected_components(graph, directed=False)[1]
    return labels


def split_into_modes(
    graph: PartialPoseGraph, labels: list[np.ndarray], most_pairs: int = 200_000
) -> list[tuple[float, float, np.ndarray]]:
    """Return the modes of a set of poses, sorted by J and, if equal, by size, largest first.

    ``graph``: the set of poses. ``labels``: for each node (all samples,) the cluster of each
    sample. ``most_pairs``: above this number of pairs of a state and a mode, the clusters of later
    nodes are ignored.

    Returns for each mode its least J [pixel], its number of poses, and (nodes,) its clusters.
    """
    states, modes = np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
    sizes: np.ndarray = np.ones(1)
    clusters = np.zeros((1, len(labels)), dtype=np.int64)
    for layer in graph.layers:
        found = labels[layer.node][layer.samples]
        several = found.max(initial=0) > 0 and len(states) < most_pairs
        # Merge edges with the same origin, cluster and end.
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
    """A set of poses of a grid, with a test of membership."""

    graph: PartialPoseGraph  # The poses.
    sampled: SampledTree  # The tree and its grids.
    budget_spent: bool  # Whether a limit of the search may have left out poses.

    @property
    def size(self) -> float:
        """Number of poses."""
        return self.graph.size

    def contains(self, node_values: Sequence[np.ndarray]) -> bool:
        """Return whether a pose, given by the values (k,) of each node, is in the set."""
        samples = samples_at(self.sampled, node_values)
        return samples is not None and self.graph.contains(samples)


def find_modes(
    body: SampledBody,
    views: Sequence[View],
    samples: np.ndarray,
    J: float,
    tolerance: float | None = None,
    limits: BoundLimits | None = None,
    within: PosesWithin | None = None,
    most: int = 32,
) -> GridPoseSet:
    """Find all poses of the grid that are as good as the best, and group them into modes.

    Args:
        body: the sampled body.
        views: the silhouettes, one per camera.
        samples: (nodes,) samples (indices in the nodes' grids) of the best known pose.
        J: its objective [pixel].
        tolerance: greatest excess of the objective of a pose that is as good [pixel]. None: if the
            best pose is within ``renderer_tolerance``, all poses within that; else 5 % of the
            contours' length.
        limits: limits of the search; None: the defaults.
        within: all exact poses, if they are known; they are then the set, up to their limit of J,
            and ``tolerance`` is ignored. None: the set is searched.
        most: greatest number of modes that are described.

    Returns the set. If a better pose than the known one is found, the set holds the poses within
    the tolerance of the better one.
    """
    if within is not None:
        tolerance = within.J_limit - J
    elif tolerance is None:
        exact = renderer_tolerance(views)
        tolerance = exact - J if J <= exact else 0.05 * contour_length(views)
    found = within or branch_and_bound(body, views, J + tolerance, limits)
    graph = found.graph
    if graph.best_J < J:
        graph = graph.up_to(graph.best_J + tolerance)
    complete = found.complete
    if graph.best_J > J:
        graph, complete = PartialPoseGraph.of_pose(samples, J), False
    sampled, described = body.sampled, []
    used = graph.samples_used()
    labels = [cluster_samples(sampled, node, own) for node, own in enumerate(used)]
    modes = split_into_modes(graph, labels)
    for mode_J, size, clusters in modes[:most]:
        own = graph.restricted(
            [label == cluster for label, cluster in zip(labels, clusters, strict=True)]
        )
        # The given pose represents its mode if it is one of the best in it.
        first = samples if own.objective(samples) == mode_J else own.central()
        values = sampled.values_at(first)
        joints = estimate_joints(sampled, own.samples_used(), values, complete=complete)
        described.append(PoseMode.of_values(sampled.tree, values, mode_J, joints, size))
    return GridPoseSet(
        modes=tuple(described),
        joints=estimate_joints(sampled, used, described[0].node_values, complete=complete),
        tolerance=tolerance,
        complete=complete,
        mode_count=len(modes),
        graph=graph,
        sampled=sampled,
        budget_spent=found.limited,
    )


def samples_at(sampled: SampledTree, node_values: Sequence[np.ndarray]) -> np.ndarray | None:
    """Return the index (nodes,) of each node's sample in its grid; None for a pose not on the grid.

    ``sampled``: the tree and its grids. ``node_values``: for each node (k,) the pose's values [rad
    or m]. They may differ from the grid's by 1e-6.
    """
    samples = np.zeros(len(sampled.values), dtype=np.int64)
    for i, (grid, values) in enumerate(zip(sampled.values, node_values, strict=True)):
        if grid.shape[1] == 0:
            # A node whose joints mimic its parent's has the parent's sample.
            samples[i] = samples[sampled.tree.source(i)]
            continue
        gaps = np.abs(grid - np.asarray(values)).max(axis=1)
        samples[i] = int(np.argmin(gaps))
        if gaps[samples[i]] > 1e-6:
            return None
    return samples


def contour_length(views: Sequence[View]) -> int:
    """Return the number of silhouette pixels with a 4-neighbour in the image outside [pixel]."""
    return sum(count_edge_pixels(view.mask) for view in views)


def renderer_tolerance(views: Sequence[View]) -> float:
    """Return the greatest expected difference of two renderers' silhouettes of one pose [pixel].

    Drake's VTK renderer, which snaps vertices to 1/256 pixel in float32, and the scored areas were
    compared on images of 80 to 1280 pixels: on average .1 % of the contour's pixels differ, each
    independently of the others. The result is five standard deviations above that mean.
    """
    expected = 0.001 * contour_length(views)
    return math.floor(expected + 5.0 * math.sqrt(expected) + 1.0)


@dataclass(frozen=True)
class ExaminationSettings:
    """Parameters of the proof of optimality and of the search for all poses as good.

    Args:
        proof_poses: number of drawn poses of nodes after which the proof is given up. A pose with
            J = 0 needs no proof.
        mode_poses: the same limit for the search for all poses as good; the default takes about two
            seconds. When it is reached the set is incomplete and no joint is determined.
        time_limit: time after which each of the two is given up [s]; None: no limit. Unlike the
            limits above its effect depends on the machine.
        tolerance: greatest excess of J of a pose that is as good [pixel]; None: chosen by
            ``find_modes``.

    Raises:
        SettingsError: if a value is out of its range.
    """

    proof_poses: int = 25_000
    mode_poses: int = 50_000
    time_limit: float | None = None
    tolerance: float | None = None

    def __post_init__(self) -> None:
        require_at_least(0, tolerance=self.tolerance)
        self.limits(self.proof_poses), self.limits(self.mode_poses)

    def limits(self, poses: int) -> BoundLimits:
        """Return the limits of a step with this limit of drawn poses."""
        return BoundLimits(poses=poses, time_limit=self.time_limit)


def examine(
    body: SampledBody,
    views: Sequence[View],
    result: PoseEstimate,
    settings: ExaminationSettings,
    root_position: np.ndarray | None = None,
    within: PosesWithin | None = None,
) -> PoseEstimate:
    """Prove that a pose of the grid is optimal, and find all poses that are as good.

    Args:
        body: the sampled body.
        views: the silhouettes, one per camera.
        result: the pose that is examined.
        settings: parameters of the proof and of the search.
        root_position: (3,) the root's position [m]; None: that of the tree.
        within: all exact poses, if they are known; no proof is then tried, and they are the pose
            set unless the settings have a tolerance.

    Returns the result with ``lower_bound``, ``budget_spent`` and ``pose_set``; with a better pose,
    if one was found. A result without a pose is returned unchanged.

    Raises SettingsError: if the result is not on the body's grid.
    """
    if not result.found:
        return result
    if root_position is not None:
        body = body.with_root_position(root_position)
    samples = samples_at(body.sampled, result.node_values)
    if samples is None:
        raise SettingsError("the pose to be examined is not on the body's sampling grid")
    J, lower_bound, spent = result.J, 0.0, result.J > 0.0
    if within is None and J > 0.0:
        better = branch_and_bound(body, views, J - 1.0, settings.limits(settings.proof_poses))
        if better.graph.best_J < J:
            J, samples = better.graph.best_J, better.graph.central()
        lower_bound, spent = J if better.complete else better.lower_bound, better.limited
    answer = find_modes(
        body, views, samples, J, settings.tolerance, settings.limits(settings.mode_poses),
        within if settings.tolerance is None else None,
    )  # fmt: skip
    best = answer.modes[0]
    J = min(J, best.J)
    if J < result.J:
        q, X_WB, values = best.q, best.X_WB, best.node_values
        result = replace(result, q=q, X_WB=X_WB, node_values=values, J=J)
    # A complete set contains every pose with a smaller J.
    lower_bound = J if answer.complete else min(lower_bound, J)
    return replace(
        result,
        lower_bound=lower_bound,
        budget_spent=answer.budget_spent or (spent and lower_bound < J),
        pose_set=answer,
    )
