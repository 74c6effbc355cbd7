"""Hypotheses and how they grow by one node: the beam of the beam search."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.search.grid.node_poses import PoseStore
from drake_pose.search.grid.pair_kernel import (
    grow_hypotheses,
    hash_mask,
    order_best,
    random_keys,
    score_pairs,
    unite_masks,
)

# How many times the width are looked at until enough are found that are not alike.
_SPARE = 4


@dataclass(frozen=True)
class Hypotheses:
    """Partial poses, best first.

    Attributes:
        masks: (B, W) uint64 the pixels covered.
        poses: (B, nodes) int32 the pose of each node in the PoseStore; -1: not placed.
        hashes: (B,) uint64 of the masks.
        covered: (B,) int64 the silhouettes' area covered [pixel].
        outside: (B,) int64 the area outside [pixel]; beyond the bands a sum over the nodes.
    """

    masks: np.ndarray
    poses: np.ndarray
    hashes: np.ndarray
    covered: np.ndarray
    outside: np.ndarray

    def __len__(self) -> int:
        return len(self.poses)

    def chosen(self, kept: np.ndarray) -> "Hypotheses":
        """Some of them, by their indices."""
        return Hypotheses(*(array[kept] for array in vars(self).values()))


class Beam:
    """Grows hypotheses node by node."""

    def __init__(self, store: PoseStore) -> None:
        self.store = store
        self.nodes = store.body.sampled.tree.nodes
        self._keys = random_keys(int(store.pictures.part_starts[-1]))

    def start(self) -> Hypotheses:
        """The one hypothesis that has placed nothing."""
        words = int(self.store.pictures.part_starts[-1])
        return Hypotheses(
            np.zeros((1, words), dtype=np.uint64),
            np.full((1, len(self.nodes)), -1, dtype=np.int32),
            np.zeros(1, dtype=np.uint64),
            np.zeros(1, dtype=np.int64),
            np.zeros(1, dtype=np.int64),
        )

    def without(self, poses: np.ndarray, nodes: Sequence[int]) -> Hypotheses:
        """One hypothesis that has poses (nodes,) but for some nodes.

        Args:
            poses: in the PoseStore, of all nodes.
            nodes: those taken out; with a node all its descendants must be.
        """
        start = self.start()
        far = 0
        start.poses[0] = poses
        start.poses[0, list(nodes)] = -1
        for node in np.flatnonzero(start.poses[0] >= 0):
            stored, pose = self.store.nodes[node], int(start.poses[0, node])
            unite_masks(start.masks, stored.runs[pose : pose + 1], stored.words)
            far += int(stored.areas[pose, 2])
        silhouettes = int(self.store.pictures.part_starts[len(self.store.pictures.views)])
        ones = np.bitwise_count(start.masks[0])
        start.covered[0] = ones[:silhouettes].sum()
        start.outside[0] = ones[silhouettes:].sum() + far
        start.hashes[0] = hash_mask(start.masks[0], self._keys)
        return start

    def grow(
        self, hypotheses: Hypotheses, node: int, width: int, outside_weight: int, exact: bool
    ) -> tuple[Hypotheses | None, bool]:
        """Place one more node in every hypothesis and keep the best.

        Args:
            hypotheses: they have placed the node's parent.
            outside_weight: what a pixel outside counts; one newly covered counts one.
            exact: drop what cannot cover the whole silhouettes any more.

        Returns:
            The new hypotheses, None where no pose stays inside the limit; and whether some were
            lost because there were too many.
        """
        store, pictures = self.store, self.store.pictures
        groups = self._groups(hypotheses, node)
        stored = store.nodes[node]
        pairs, gains, losses = score_pairs(
            hypotheses.masks,
            groups[:, 0],
            groups[:, 1],
            stored.runs,
            stored.words,
            len(pictures.views),
            not self.nodes[node].children,
        )
        if len(pairs) == 0:
            return None, False
        covered = hypotheses.covered[pairs[:, 0]] + gains
        outside = hypotheses.outside[pairs[:, 0]] + losses + stored.areas[pairs[:, 1], 2]
        ordered = order_best(outside_weight * outside - covered, _SPARE * width)
        # What is out of reach is known after growing only: grow more and rank again.
        grown = width if exact else 2 * width
        masks, poses, hashes, chosen, left, seen = grow_hypotheses(
            hypotheses.masks,
            hypotheses.poses,
            hypotheses.hashes,
            ordered,
            pairs,
            stored.runs,
            stored.words,
            node,
            store.open_nodes(hypotheses.poses, node),
            self._keys,
            grown,
            pictures.everything,
            store.reaches(hypotheses.poses, node, pairs[ordered, 1]),
            exact,
        )
        lost = seen < len(pairs)
        if len(poses) == 0:
            return None, lost
        made = Hypotheses(masks, poses, hashes, covered[chosen], outside[chosen])
        if exact:
            return made, lost
        costs = outside_weight * (made.outside + left) - made.covered
        kept = np.argsort(costs, kind="stable")[:width]
        return made.chosen(kept), lost or len(kept) < len(poses)

    def _groups(self, hypotheses: Hypotheses, node: int) -> np.ndarray:
        """Where the poses of a node begin and end (B, 2) that each hypothesis may take."""
        store = self.store
        parents = store.parents(hypotheses.poses, node)
        hidden = np.zeros(len(hypotheses), dtype=np.bool_)
        if not self.nodes[node].children and not store.pictures.has_bands:
            rows = store.reach_rows(node, parents)[parents]
            runs, words = store.reach_runs, store.reach_words
            hidden = score_pairs(
                hypotheses.masks, rows, rows + 1, runs, words, runs.shape[1], False
            )[1] == 0  # fmt: skip
        return store.groups(node, parents, hidden)

    def run(
        self,
        start: Hypotheses,
        order: Sequence[int],
        width: int,
        outside_weight: int,
        exact: bool,
        proceed: Callable[[int], bool],
    ) -> tuple[Hypotheses | None, bool]:
        """Place nodes one after another.

        Args:
            start: the hypotheses to begin with.
            width: how many are kept after each.
            outside_weight, exact: as in grow.
            proceed: asked after each node, with the number of hypotheses made, whether to go on.

        Returns:
            The last hypotheses (None: none was left, or told to stop), and whether all possible
            ones were kept throughout.
        """
        hypotheses: Hypotheses | None = start
        complete = True
        for node in order:
            if hypotheses is None:
                break
            hypotheses, lost = self.grow(hypotheses, node, width, outside_weight, exact)
            complete = complete and not lost
            if hypotheses is not None and not proceed(len(hypotheses)):
                return None, False
        return hypotheses, complete
