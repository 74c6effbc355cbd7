"""What every search offers, so that systems and programs need not know which one they run."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.search.result import MatchResult, View
from drake_pose.search.scoring import SampledTree


class PoseSearch(Protocol):
    """A search for the pose that silhouettes show."""

    @property
    def tree(self) -> PoseTree:
        """The pose tree that is searched."""

    @property
    def sampled(self) -> SampledTree:
        """The pose tree with its sampling grids."""

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> MatchResult:
        """Estimate the pose that the views of one instant show.

        Args:
            views: one or several silhouettes of the same instant.
            root_position: (3,), the root's known position in the world [m], where it is not the
                pose tree's own.
        """
