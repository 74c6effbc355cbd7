"""The one expansion of all searches on the grid: one more node is placed in partial poses.

What matters of a partial pose for all that is still to come is what it covers, what it leaves
outside, and the poses of the nodes that have children to come. Partial poses equal in this are one;
those are known by sums of random numbers modulo 2^64 (``pair_kernel``).
"""

from dataclasses import dataclass, replace

import numpy as np

from drake_pose.search.grid.node_poses import PoseStore
from drake_pose.search.grid.pair_kernel import (
    choose_pairs,
    hash_mask,
    random_keys,
    score_pairs,
    unite_poses,
)
from drake_pose.search.grid.pose_graph import spread


@dataclass(frozen=True)
class PartialPoses:
    """Poses of the same nodes.

    Attributes:
        masks: (B, W) uint64 the pixels covered.
        poses: (B, nodes) int32 the pose of each node in the PoseStore; -1: not placed.
        hashes: (B,) uint64 of the masks.
        covered: (B,) int64 the silhouettes' area covered [pixel].
        outside: (B,) int64 the area outside [pixel]; beyond the bands a sum over the nodes.
        far: (B, 2) int64 the greatest and the summed area of a node beyond the bands [pixel].
        lost: (B,) int64 the silhouettes' area that no later node can reach [pixel].
    """

    masks: np.ndarray
    poses: np.ndarray
    hashes: np.ndarray
    covered: np.ndarray
    outside: np.ndarray
    far: np.ndarray
    lost: np.ndarray

    def __len__(self) -> int:
        return len(self.poses)

    def chosen(self, kept: np.ndarray) -> "PartialPoses":
        """Some of them, by their indices or by (B,) bool."""
        return PartialPoses(*[array[kept] for array in vars(self).values()])

    @property
    def least_outside(self) -> np.ndarray:
        """(B,) int64 no completion leaves a smaller area outside [pixel]."""
        return np.asarray(self.outside - self.far[:, 1] + self.far[:, 0])

    @property
    def bounds(self) -> np.ndarray:
        """(B,) int64 no completion has a smaller objective [pixel]."""
        return np.asarray(self.least_outside + self.lost)

    def costs(self, outside_weight: int) -> np.ndarray:
        """(B,) int64 to rank by: what is covered already counts one a pixel."""
        return np.asarray(outside_weight * (self.outside + self.lost) - self.covered)


class Expansion:
    """Places nodes in partial poses, from poses that a store draws."""

    def __init__(self, store: PoseStore) -> None:
        self.store = store
        self.nodes = store.body.sampled.tree.nodes
        self.words = int(store.pictures.part_starts[-1])
        keys = random_keys(2 * self.words + len(self.nodes) + 2)
        self._mask_keys = keys[: 2 * self.words]
        self._node_keys = keys[2 * self.words : -2]
        self._far_keys = keys[-2:]

    def start(self) -> PartialPoses:
        """The one that has placed nothing."""
        zero = np.zeros(1, dtype=np.int64)
        return PartialPoses(
            np.zeros((1, self.words), dtype=np.uint64),
            np.full((1, len(self.nodes)), -1, dtype=np.int32),
            np.zeros(1, dtype=np.uint64),
            zero, zero.copy(), np.zeros((1, 2), dtype=np.int64), zero.copy(),
        )  # fmt: skip

    def without(self, poses: np.ndarray, nodes: frozenset[int]) -> PartialPoses:
        """One with poses (nodes,) but of some nodes, given with all their descendants."""
        start = self.start()
        start.poses[0] = poses
        start.poses[0, list(nodes)] = -1
        for node in np.flatnonzero(start.poses[0] >= 0):
            stored, pose = self.store.nodes[node], start.poses[0, node : node + 1]
            unite_poses(start.masks, pose, stored.runs, stored.words)
            start.outside[0] += int(stored.areas[pose[0], 2])
        silhouettes = int(self.store.pictures.part_starts[len(self.store.pictures.views)])
        ones = np.bitwise_count(start.masks[0])
        start.covered[0] = ones[:silhouettes].sum()
        start.outside[0] += ones[silhouettes:].sum()
        start.hashes[0] = hash_mask(start.masks[0], self._mask_keys)
        return start

    def objectives(self, whole: PartialPoses) -> np.ndarray:
        """(B,) what the objective of whole poses is, as far as the pictures show [pixel]."""
        return np.asarray(self.store.pictures.area - whole.covered + whole.outside)

    def groups(self, partial: PartialPoses, node: int) -> np.ndarray:
        """Where the node's poses begin and end (B, 2) that each may take."""
        if len(partial) == 0:
            return np.zeros((0, 2), dtype=np.int64)
        return self.store.groups(node, self.store.parents(partial.poses, node))

    def score(
        self, partial: PartialPoses, node: int, pairs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Areas newly covered (p, 2) of silhouette and band [pixel], and what hashes gain (p,)."""
        stored, views = self.store.nodes[node], len(self.store.pictures.views)
        return score_pairs(partial.masks, pairs, stored.runs, stored.words, views, self._mask_keys)

    def make(
        self,
        partial: PartialPoses,
        node: int,
        pairs: np.ndarray,
        scores: tuple[np.ndarray, np.ndarray],
    ) -> PartialPoses:
        """What pairs (p, 2), scored, make, without their masks; ``lost`` is not known."""
        areas, added = scores
        origins, beyond = pairs[:, 0], self.store.nodes[node].areas[pairs[:, 1], 2]
        poses = partial.poses[origins]
        poses[:, node] = pairs[:, 1]
        far = partial.far[origins]
        np.maximum(far[:, 0], beyond, out=far[:, 0])
        far[:, 1] += beyond
        return PartialPoses(
            masks=np.zeros((len(pairs), 0), dtype=np.uint64),
            poses=poses,
            hashes=partial.hashes[origins] + added,
            covered=partial.covered[origins] + areas[:, 0],
            outside=partial.outside[origins] + areas[:, 1] + beyond,
            far=far,
            lost=np.zeros(len(pairs), dtype=np.int64),
        )

    def choose(
        self,
        partial: PartialPoses,
        made: PartialPoses,
        node: int,
        pairs: np.ndarray,
        width: int,
        limit: float = np.inf,
        far_matters: bool = False,
    ) -> tuple[np.ndarray, PartialPoses, np.ndarray]:
        """The first of what pairs (p, 2) made that are not equal, at most ``width``.

        Args:
            limit: where it is finite, what is outside and what no later node can reach may come to
                so much [pixel]; and where the nodes with children to come stand alike, none is
                chosen that covers less than another.
            far_matters: those are not equal that differ beyond the bands.

        Returns:
            Their indices; themselves, without masks; of each pair looked at the place among
                them, or -1.
        """
        is_open = self.store.open_nodes(made.poses, node)
        openings = made.poses[:, is_open].astype(np.uint64) @ self._node_keys[is_open]
        codes = made.hashes + openings
        if far_matters:
            codes += made.far.astype(np.uint64) @ self._far_keys
        stored = self.store.nodes[node]
        chosen, lost, places = choose_pairs(
            partial.masks, pairs, stored.runs, stored.words, self.store.pictures.everything,
            self.store.reaches(partial.poses, node, pairs), width, codes,
            openings if limit < np.inf else openings[:0], made.least_outside, limit,
        )  # fmt: skip
        return chosen, replace(made.chosen(chosen), lost=lost), places

    def with_masks(
        self, partial: PartialPoses, made: PartialPoses, node: int, pairs: np.ndarray
    ) -> PartialPoses:
        """What pairs made, with the masks."""
        masks, stored = partial.masks[pairs[:, 0]], self.store.nodes[node]
        unite_poses(masks, pairs[:, 1], stored.runs, stored.words)
        return replace(made, masks=masks)


def all_pairs(groups: np.ndarray) -> np.ndarray:
    """(p, 2) int32 each partial pose with each pose that it may take, by groups (B, 2)."""
    return np.column_stack(spread(groups[:, 0], groups[:, 1])).astype(np.int32)
