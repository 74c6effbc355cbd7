"""The poses of nodes for a branch and bound, drawn in full detail and within its limits."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.camera.models import Camera
from drake_pose.search.estimates import View
from drake_pose.search.grid.node_poses import Pictures, PoseStore
from drake_pose.search.grid.sampled_body import SampledBody
from drake_pose.silhouette.contours.direction_cells import CelledOutline

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
        deadline: the value of time.perf_counter() at which it stops [s].
    """

    states: int = 20_000
    pairs: int = 1_000_000
    poses: int = 1_000_000
    memory: int = 400_000_000
    deadline: float = np.inf


class DetailedBody(SampledBody):
    """A body whose surfaces are never simplified, so that areas are those of the definition."""

    def __init__(self, body: SampledBody) -> None:
        self.__dict__.update(body.__dict__)

    def celled_outline(self, node: int, camera: Camera, coarse: bool) -> CelledOutline:
        """As SampledBody's, never coarse."""
        return super().celled_outline(node, camera, False)


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

    def _limit(self, node: int) -> float:
        return self._outside_limit

    def reserve(self, size: int = 0) -> None:
        """Notes memory that what belongs to the poses takes [byte].

        Raises:
            LimitReached: with it, there is too much, or the time is over.
        """
        self._reserved += size
        used = self._reserved + self.reach_runs.nbytes + self.reach_words.nbytes
        used += sum(stored.nbytes for stored in self.nodes)
        if used > self._limits.memory or time.perf_counter() >= self._limits.deadline:
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


def make_pictures(body: SampledBody, views: Sequence[View], J_limit: float) -> Pictures:
    """The silhouettes with bands so wide that nothing within the limit lies beyond, if possible."""
    if J_limit < 1.0:
        return Pictures(body, views, 0)
    band = int(min(J_limit, max(view.mask.shape[i] for view in views for i in (0, 1))))
    while True:
        pictures = Pictures(body, views, max(1, band))
        if band <= _LEAST_BAND or pictures.part_starts[-1] <= _WORDS:
            return pictures
        band //= 2
