"""The poses of nodes for a branch and bound, and what can be reached from them, within limits."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.search.estimates import View
from drake_pose.search.grid.branch_and_bound.kernel import unite_groups
from drake_pose.search.grid.node_poses import Pictures, PoseStore
from drake_pose.search.grid.sampled_body import SampledBody

# Masks of more words than these get narrower bands, but none narrower than this many pixels.
_WORDS = 2000
_LEAST_BAND = 8
# How many poses of a node are tried before the limits are looked at again.
_TRIED_TOGETHER = 100_000
# The same of the discs that hold what can be reached.
_REACHES_TOGETHER = 20_000


@dataclass(frozen=True)
class BoundLimits:
    """How much a branch and bound may look at.

    Args:
        states: how many partial poses are kept after each node.
        pairs: how many pairs of a partial pose and a pose of the next node are looked at.
        poses: after this many poses of nodes are drawn it stops.
        memory: it stops before drawn poses and what they reach take more than this, and keeps fewer
            partial poses where all would take more than a quarter of it [byte]. What it needs for a
            moment comes on top, about as much again.
        time_limit: it stops after this time [s]; None: no limit.

    Raises:
        SettingsError: if a value is out of its range.
    """

    states: int = 20_000
    pairs: int = 1_000_000
    poses: int = 1_000_000
    memory: int = 400_000_000
    time_limit: float | None = None

    def __post_init__(self) -> None:
        for name in ("states", "pairs", "poses", "memory"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} must be 1 or more, not {getattr(self, name)}")
        if self.time_limit is not None and not 0.0 <= self.time_limit < np.inf:
            raise SettingsError(f"time_limit must be 0 s or more, not {self.time_limit}")

    @property
    def deadline(self) -> float:
        """The value of time.perf_counter() at which a search that begins now stops [s]."""
        return np.inf if self.time_limit is None else time.perf_counter() + self.time_limit


class LimitReached(Exception):
    """Raised to leave a search that has no time or no room left."""


class BoundedPoses(PoseStore):
    """The poses of all nodes that leave no more than a limit outside [pixel]."""

    def __init__(
        self, body: SampledBody, pictures: Pictures, outside_limit: float, limits: BoundLimits
    ) -> None:
        super().__init__(body, pictures, np.inf)
        self._outside_limit = outside_limit
        self._limits = limits
        self._reserved = 0
        self.deadline = limits.deadline

    def _limit(self, node: int) -> float:
        return self._outside_limit

    def reserve(self, size: int = 0) -> None:
        """Notes memory that what belongs to the poses takes [byte].

        Raises:
            LimitReached: with it, there is too much, or the time is over.
        """
        self._reserved += size
        if (
            self._reserved + self.nbytes > self._limits.memory
            or time.perf_counter() >= self.deadline
        ):
            raise LimitReached

    def groups(self, node: int, parents: np.ndarray, hidden: np.ndarray) -> np.ndarray:
        """As PoseStore.groups; raises LimitReached where a limit is reached."""
        # The largest first: the tables grow once.
        different = np.unique(parents)[::-1]
        together = max(1, _TRIED_TOGETHER // len(self.body.sampled.X_PN[node]))
        for begin in range(0, len(different), together):
            if sum(len(stored.samples) for stored in self.nodes) > self._limits.poses:
                raise LimitReached
            self.reserve()
            some = different[begin : begin + together]
            super().groups(node, some, np.zeros(len(some), dtype=np.bool_))
        return super().groups(node, parents, hidden)

    def reach_rows(self, node: int, parents: np.ndarray) -> np.ndarray:
        """As PoseStore.reach_rows; raises LimitReached where a limit is reached."""
        different = np.unique(parents)[::-1]
        for begin in range(0, len(different), _REACHES_TOGETHER):
            self.reserve()
            super().reach_rows(node, different[begin : begin + _REACHES_TOGETHER])
        return super().reach_rows(node, parents)


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


def make_pictures(body: SampledBody, views: Sequence[View], J_limit: float) -> Pictures:
    """The silhouettes with bands so wide that nothing within the limit lies beyond, if possible."""
    if J_limit < 1.0:
        return Pictures(body, views, 0, in_full=True)
    band = int(min(J_limit, max(view.mask.shape[i] for view in views for i in (0, 1))))
    while True:
        pictures = Pictures(body, views, max(1, band), in_full=True)
        if band <= _LEAST_BAND or pictures.part_starts[-1] <= _WORDS:
            return pictures
        band //= 2
