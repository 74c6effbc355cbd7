"""What a node and all that hangs on it can cover at most, from the poses that stay inside."""

import numpy as np

from drake_pose.search.grid.branch_and_bound.full_detail import BoundedPoses
from drake_pose.search.grid.branch_and_bound.kernel import unite_groups


class SubtreeReaches:
    """The silhouette pixels that a node and its descendants can cover, for poses of its parent.

    Attributes:
        table: (r, w) uint64 unions; the rows beyond those in use are zero.

    Args:
        store: the poses; what is missing is drawn within its limits, in which the table counts.
        tries: how many poses of a node are tried at a time; where there are more, a disc that holds
            all that they can cover will do.
    """

    def __init__(self, store: BoundedPoses, tries: int) -> None:
        self.store = store
        self._tries = tries
        self._nodes = store.body.sampled.tree.nodes
        self._silhouettes = len(store.pictures.views)
        words = len(store.pictures.everything)
        self.table = np.zeros((256, words), dtype=np.uint64)
        self._used = 0
        self._rows = [np.full(0, -1, dtype=np.int64) for _ in self._nodes]

    def rows(self, node: int, parents: np.ndarray) -> np.ndarray:
        """For all poses of the node's parent the row of ``table``; -1 where not asked for yet.

        Args:
            node: the node.
            parents: (n,) the poses asked for; 0 for a root.
        """
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
        children = self._nodes[node].children
        rows = np.zeros((len(children), len(self.store.nodes[node].samples)), dtype=np.int64)
        for i, child in enumerate(children):
            known = self.rows(child, poses)
            size = min(rows.shape[1], len(known))
            rows[i, :size] = known[:size]
        return rows

    def _unite(self, node: int, parents: np.ndarray) -> np.ndarray:
        """New rows for poses (n,) of a node's parent."""
        if len(parents) * len(self.store.body.sampled.values[node]) > self._tries:
            return self._discs(node, parents)
        nothing_hidden = np.zeros(len(parents), dtype=np.bool_)
        groups = self.store.groups(node, parents, nothing_hidden)
        counts = groups[:, 1] - groups[:, 0]
        offsets = np.repeat(groups[:, 0] - np.cumsum(counts) + counts, counts)
        below = self.child_rows(node, offsets + np.arange(len(offsets)))
        rows = self._new_rows(len(parents))
        stored = self.store.nodes[node]
        unite_groups(groups, stored.runs, stored.words, self._silhouettes, below, self.table, rows)
        return rows

    def _discs(self, node: int, parents: np.ndarray) -> np.ndarray:
        """New rows of the discs that hold all that the node and its descendants can cover."""
        chosen = self.store.reach_rows(node, parents)[parents]
        rows = self._new_rows(len(parents))
        places = np.column_stack([chosen, chosen + 1])
        unite_groups(
            places, self.store.reach_runs, self.store.reach_words, self._silhouettes,
            np.zeros((0, 0), dtype=np.int64), self.table, rows,
        )  # fmt: skip
        return rows

    def _new_rows(self, count: int) -> np.ndarray:
        """This many rows of zeros."""
        rows = np.arange(self._used, self._used + count)
        self._used += count
        if self._used > len(self.table):
            shape = self._used, self.table.shape[1]
            self.store.reserve(8 * shape[0] * shape[1])
            more = np.zeros(shape, dtype=np.uint64)
            self.table = np.concatenate([self.table, more])
        return rows
