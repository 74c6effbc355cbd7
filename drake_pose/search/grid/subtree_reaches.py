"""What a node and its descendants can cover of the silhouettes, for poses of its parent."""

import numpy as np

from drake_pose.search.grid.node_poses import PoseStore
from drake_pose.search.grid.pair_kernel import NO_CHILDREN, unite
from drake_pose.search.grid.pose_graph import spread


class SubtreeReaches:
    """The silhouettes' pixels that a node and its descendants can cover, by pose of its parent.

    Attributes:
        table: (r, w) uint64 unions; the rows beyond those in use are zero.

    Args:
        store: the poses; what is missing is drawn within its limits, in which the table counts.
        tries: how many poses of a node are tried at a time; where there are more, a disc that holds
            all that they can cover will do.
    """

    def __init__(self, store: PoseStore, tries: int) -> None:
        self.store = store
        self._tries = tries
        self.table = np.zeros((256, len(store.pictures.everything)), dtype=np.uint64)
        self._used = 0
        self._rows = [np.full(0, -1, dtype=np.int64) for _ in store.tree_nodes]

    def rows(self, node: int, parents: np.ndarray) -> np.ndarray:
        """For all poses of the node's parent the row of ``table``; -1 where never asked for."""
        size = int(parents.max(initial=0)) + 1
        known = self._rows[node]
        if len(known) < size:
            known = np.concatenate([known, np.full(size - len(known) + 64, -1, dtype=np.int64)])
            self._rows[node] = known
        wanted = np.zeros(len(known), dtype=np.bool_)
        wanted[parents] = True
        missing = np.flatnonzero(wanted & (known < 0))
        if len(missing):
            known[missing] = self._unite(node, missing)
        return known

    def child_rows(self, node: int, poses: np.ndarray) -> np.ndarray:
        """(children, all poses) int64 the rows of a node's children at poses (n,) of the node."""
        children = self.store.tree_nodes[node].children
        rows = np.zeros((len(children), len(self.store.nodes[node].samples)), dtype=np.int64)
        for i, child in enumerate(children):
            known = self.rows(child, poses)
            size = min(rows.shape[1], len(known))
            rows[i, :size] = known[:size]
        return rows

    def _unite(self, node: int, parents: np.ndarray) -> np.ndarray:
        """New rows for poses (n,) of a node's parent."""
        store = self.store
        if len(parents) * len(store.body.sampled.values[node]) > self._tries:
            places = store.reach_rows(node, parents)[parents]
            groups = np.column_stack([places, places + 1])
            runs, words, below = store.reach_runs, store.reach_words, NO_CHILDREN
        else:
            groups = store.groups(node, parents)
            below = self.child_rows(node, spread(groups[:, 0], groups[:, 1])[1])
            runs, words = store.nodes[node].runs, store.nodes[node].words
        rows = np.arange(self._used, self._used + len(parents))
        self._used += len(parents)
        if self._used > len(self.table):
            store.reserve(8 * self._used * self.table.shape[1])
            more = np.zeros((self._used, self.table.shape[1]), dtype=np.uint64)
            self.table = np.concatenate([self.table, more])
        unite(self.table, rows, groups, runs, words, len(store.pictures.views), below)
        return rows
