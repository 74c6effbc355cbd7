"""The answer as a set: poses as good as the best, in families, and what they say of each joint.

A silhouette seldom has one explanation: a forearm may point towards the camera or away from it, a
hand may be anywhere behind the trunk. A family is what can be told apart by looking: its members
differ by small steps, those of two families do not.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class JointEstimate:
    """What the silhouettes say about one value of the pose tree.

    Args:
        name: of the position (or of the root's angle).
        node: the node that the value belongs to.
        determined: True: it lies between low and high; False: it is free, and low and high are
            the ends of what was seen.
        low, high: the interval or the range [rad or m]; of an angle that turns around it may go
            beyond its limits, as the same directions a full turn before or after.
        values: (n,) the different values seen, smallest first [rad or m].
        turns_around: whether it is an angle that can take every direction.
    """

    name: str
    node: int
    determined: bool
    low: float
    high: float
    values: np.ndarray
    turns_around: bool = False

    def holds(self, value: float, margin: float = 1e-9) -> bool:
        """Whether a value lies in the interval or range; full turns make no difference."""
        if self.turns_around:
            value -= 2.0 * math.pi * round((value - 0.5 * (self.low + self.high)) / (2.0 * math.pi))
        return self.low - margin <= value <= self.high + margin


@dataclass(frozen=True)
class PoseFamily:
    """Poses that differ by small steps, with one that stands for all.

    Args:
        q: (nq,) the representative's positions in the plant's order [rad, m].
        X_WB: (4, 4) pose of the plant's world frame B in the world W.
        node_values: its values for each node of the pose tree.
        J: its objective (1) [pixel].
        joints: each value of the pose tree, node after node, as far as this family goes.
        size: how many poses were found in it.
    """

    q: np.ndarray
    X_WB: np.ndarray
    node_values: tuple[np.ndarray, ...]
    J: float
    joints: tuple[JointEstimate, ...]
    size: float


@dataclass(frozen=True, eq=False)
class PositionEstimates:
    """What the silhouettes say about each of a plant's positions.

    Args:
        determined: (nq,) 1: it lies between low and high; 0: it is free, and low and high are the
            ends of what was seen; NaN: the pose tree has no such value.
        low, high: (nq,) [rad or m]; NaN likewise.
    """

    determined: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class PoseSet:
    """All poses found that are as good as the best within the noise.

    Args:
        families: best first; of equals the larger one first.
        joints: each value of the pose tree, node after node, over all families.
        tolerance: what the search ranks poses by, J or a cost of the edges, may be so much above
            the best pose's [pixel].
        complete: whether no pose within the tolerance was left out (on the grid, for a search on
            a grid).
        family_count: how many families there are; ``families`` may hold only the first of them.
    """

    families: tuple[PoseFamily, ...]
    joints: tuple[JointEstimate, ...]
    tolerance: float
    complete: bool
    family_count: int

    @property
    def determined(self) -> tuple[bool, ...]:
        """For each value of the pose tree whether it is determined."""
        return tuple(joint.determined for joint in self.joints)

    def within_intervals(self, node_values: Sequence[np.ndarray]) -> bool:
        """Whether every value of a pose lies in some one family's intervals and ranges.

        Necessary for a member, not sufficient: values of a family may depend on each other.
        """
        values = np.concatenate([np.ravel(value) for value in node_values])
        return any(
            all(joint.holds(float(v)) for joint, v in zip(family.joints, values, strict=True))
            for family in self.families
        )

    def positions(self, names: Sequence[str]) -> PositionEstimates:
        """What is known of a plant's positions.

        Args:
            names: (nq,) of the positions, in the plant's order.
        """
        known = {joint.name: joint for joint in self.joints}
        missing = JointEstimate("", 0, False, np.nan, np.nan, np.zeros(0))
        joints = [known.get(name, missing) for name in names]
        return PositionEstimates(
            determined=np.array([float(one.determined) if one.name else np.nan for one in joints]),
            low=np.array([one.low for one in joints]),
            high=np.array([one.high for one in joints]),
        )
