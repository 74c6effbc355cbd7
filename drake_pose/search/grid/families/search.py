"""All poses of the grid as good as the best within the noise, in families."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.search.estimates import PoseFamily, PoseSet, View
from drake_pose.search.grid.branch_and_bound.bounded_poses import BoundLimits
from drake_pose.search.grid.branch_and_bound.partial_pose_graph import (
    PartialPoseGraph,
    single_pose,
)
from drake_pose.search.grid.branch_and_bound.search import branch_and_bound
from drake_pose.search.grid.families.joint_estimates import estimate_joints
from drake_pose.search.grid.families.split import (
    GraphFamily,
    cluster_samples,
    split_into_families,
)
from drake_pose.search.grid.sampled_body import SampledBody
from drake_pose.search.scoring import SampledTree

# The share of the contours' pixels that noise may turn.
_CONTOUR_SHARE = 0.05


@dataclass(frozen=True)
class GridPoseSet(PoseSet):
    """A set of poses of the grid that tells of any pose whether it is in it.

    Args:
        budget_spent: whether a limit on time or room left poses out.
    """

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

    def draw(self, count: int, generator: np.random.Generator) -> list[list[np.ndarray]]:
        """Draw members at random, each as likely as any other: for each the nodes' values."""
        drawn = self.graph.draw(count, generator)
        return [self.sampled.values_at(samples) for samples in drawn]


def find_families(
    body: SampledBody,
    views: Sequence[View],
    samples: np.ndarray,
    J: float,
    tolerance: float | None = None,
    most: int = 32,
    limits: BoundLimits | None = None,
) -> GridPoseSet:
    """Find all poses of the grid as good as the best.

    Args:
        samples: (nodes,) the samples of the best pose known.
        J: its objective [pixel].
        tolerance: a pose counts as good as the best if its objective is greater by no more than
            this [pixel]; None: not at all where the best is exact, else 5 % of the length of the
            silhouettes' contours.
        most: how many families are described at most.
        limits: how much may be looked at; a limit leaves those found.

    Returns:
        The set. It holds the best pose known, and if a better one turns up, that one and those
        within the tolerance of it.
    """
    if tolerance is None:
        tolerance = 0.0 if J == 0.0 else _CONTOUR_SHARE * contour_length(views)
    found = branch_and_bound(body, views, J + tolerance, limits, samples)
    graph = found.graph
    if graph.best_J < J:
        graph = graph.up_to(graph.best_J + tolerance)
    complete = found.complete
    if graph.size == 0.0:
        graph, complete = single_pose(samples, J), False
    described = _describe(body.sampled, graph, samples, tolerance, complete, most)
    return replace(described, budget_spent=found.limited)


def samples_at(sampled: SampledTree, node_values: Sequence[np.ndarray]) -> np.ndarray | None:
    """The samples (nodes,) of a pose of the grid; None if it is not on the grid."""
    samples = np.zeros(len(sampled.values), dtype=np.int64)
    for i, (grid, values) in enumerate(zip(sampled.values, node_values, strict=True)):
        if grid.shape[1] == 0:
            continue
        gaps = np.abs(grid - np.asarray(values)).max(axis=1)
        samples[i] = int(np.argmin(gaps))
        if gaps[samples[i]] > 1e-6:
            return None
    return samples


def contour_length(views: Sequence[View]) -> int:
    """How many pixels of the silhouettes have a neighbour in the picture that is in none."""
    total = 0
    for view in views:
        padded = np.pad(view.mask, 1, mode="edge")
        inner = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
        total += int((view.mask & ~inner).sum())
    return total


def _describe(
    sampled: SampledTree,
    graph: PartialPoseGraph,
    samples: np.ndarray,
    tolerance: float,
    complete: bool,
    most: int,
) -> GridPoseSet:
    """The set that a graph holds; ``samples`` stands for its own family if it is a best one."""
    labels = [
        cluster_samples(sampled, node, seen) for node, seen in enumerate(graph.samples_seen())
    ]
    families = split_into_families(graph, labels)
    described = []
    for family in families[:most]:
        own = graph.restricted(
            [label == cluster for label, cluster in zip(labels, family.clusters, strict=True)]
        )
        described.append(_describe_family(sampled, own, family, samples, complete))
    return GridPoseSet(
        families=tuple(described),
        joints=estimate_joints(
            sampled, graph.samples_seen(), described[0].node_values, complete=complete
        ),
        tolerance=tolerance,
        complete=complete,
        family_count=len(families),
        graph=graph,
        sampled=sampled,
        budget_spent=False,
    )


def _describe_family(
    sampled: SampledTree,
    graph: PartialPoseGraph,
    family: GraphFamily,
    samples: np.ndarray,
    complete: bool,
) -> PoseFamily:
    central = samples if graph.objective(samples) == family.J else graph.central()
    values = sampled.values_at(central)
    q, X_WB = sampled.tree.positions_from(values)
    return PoseFamily(
        q=q,
        X_WB=X_WB,
        node_values=tuple(values),
        J=family.J,
        joints=estimate_joints(sampled, graph.samples_seen(), values, complete=complete),
        size=family.size,
    )
