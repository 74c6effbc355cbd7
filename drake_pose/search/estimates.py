"""What a search is given, and the poses in modes that searches and trackers answer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.errors import MaskError, SettingsError

UNEXPLAINED = 0.5
"""From this E_total on, the pose is no explanation of the silhouettes."""

TRACKED = "tracked"
"""``PoseEstimate.stopped_by`` of a pose that was tracked from the frame before."""


@dataclass(frozen=True)
class View:
    """What one calibrated camera sees of the body: the silhouette S, (height, width) bool.

    A mask of numbers with two values is true where it has the larger one.

    Raises:
        MaskError: the mask is not of the camera's size, has more than two values, or is empty.
    """

    camera: Camera
    mask: np.ndarray

    def __post_init__(self) -> None:
        expected = (self.camera.height, self.camera.width)
        object.__setattr__(self, "mask", np.asarray(self.mask))
        if self.mask.shape != expected:
            raise MaskError(
                f"mask of camera '{self.camera.name}' is {self.mask.shape[::-1]} pixels (width, "
                f"height), but the camera's picture is {expected[::-1]}; give the mask at the "
                "size the camera was calibrated for"
            )
        if self.mask.dtype != np.bool_:
            values = np.unique(self.mask)
            if len(values) > 2 or not np.isfinite(values).all():
                raise MaskError(
                    f"mask of camera '{self.camera.name}' has {len(values)} values from "
                    f"{values[0]} to {values[-1]}, but a mask has two; compare it with a threshold"
                )
            object.__setattr__(self, "mask", self.mask > (values[0] if len(values) > 1 else 0))
        if not self.mask.any():
            raise MaskError(
                f"mask of camera '{self.camera.name}' is empty; leave this view out, or give a "
                "mask that shows the body"
            )


def require_views(views: Sequence[View]) -> None:
    """Refuses, by a SettingsError, a match with no view, or with one that is in no list."""
    if isinstance(views, View):
        raise SettingsError("a match needs a list of views, as [view], not one View")
    if not views:
        raise SettingsError("a match needs at least one view, but none was given")


@dataclass(frozen=True)
class JointEstimate:
    """What the silhouettes say about one value of the pose tree.

    Args:
        name: of the position (or of the root's angle).
        determined: True: it lies between low and high; False: it is free, and low and high are
            the ends of what was seen.
        low, high: the interval or the range [rad or m]; of an angle that turns around it may go
            beyond its limits, as the same directions a full turn before or after.
    """

    name: str
    determined: bool
    low: float
    high: float
    turns_around: bool = False

    def holds(self, value: float, margin: float = 1e-9) -> bool:
        """Whether a value lies in the interval or range; full turns make no difference."""
        if self.turns_around:
            value -= 2.0 * math.pi * round((value - 0.5 * (self.low + self.high)) / (2.0 * math.pi))
        return self.low - margin <= value <= self.high + margin

    def widened(self, other: "JointEstimate", moved: float) -> "JointEstimate":
        """What both say; since the other one's instant the value has changed by ``moved``."""
        if self.turns_around:
            middle = 0.5 * (self.low + self.high - other.low - other.high) - moved
            moved += 2.0 * math.pi * round(middle / (2.0 * math.pi))
        return replace(
            self,
            determined=self.determined and other.determined,
            low=min(self.low, other.low + moved),
            high=max(self.high, other.high + moved),
        )


def joint_estimates(
    kinematics: TreeKinematics, low: np.ndarray, high: np.ndarray, determined: np.ndarray
) -> tuple[JointEstimate, ...]:
    """What is known of each of a pose tree's values: ends and whether determined (m,)."""
    return tuple(
        JointEstimate(name, bool(known), float(least), float(most), bool(around))
        for name, known, least, most, around in zip(
            kinematics.names, determined, low, high, kinematics.turns_around, strict=True
        )
    )


def following_joints(tree: PoseTree, joints: Sequence[JointEstimate]) -> tuple[JointEstimate, ...]:
    """What is known of the positions that follow a pose tree's values, of which joints tell."""
    known, names = {joint.name: joint for joint in joints}, tree.model.position_names
    found = []
    for follower, leader, multiplier, offset in tree.followers:
        one = known[names[leader]]
        low, high = sorted(multiplier * end + offset for end in (one.low, one.high))
        found.append(replace(one, name=names[follower], low=low, high=high))
    return tuple(found)


@dataclass(frozen=True)
class PoseMode:
    """Poses that differ by small steps, with one that stands for all.

    Args:
        q: (nq,) the representative's positions in the plant's order [rad, m].
        X_WB: (4, 4) pose of the plant's world frame B in the world W.
        J: its objective (1) [pixel].
        joints: each value of the pose tree, node after node, as far as this mode goes.
        size: how many poses were found in it.
    """

    q: np.ndarray
    X_WB: np.ndarray
    node_values: tuple[np.ndarray, ...]
    J: float
    joints: tuple[JointEstimate, ...]
    size: float

    @classmethod
    def of_values(
        cls,
        tree: PoseTree,
        node_values: Sequence[np.ndarray],
        J: float,
        joints: tuple[JointEstimate, ...],
        size: float = 1.0,
    ) -> "PoseMode":
        """The mode of a pose tree's values, (k_i,) of each node."""
        return cls(*tree.positions_from(node_values), tuple(node_values), J, joints, size)


@dataclass(frozen=True)
class PoseSet:
    """All poses found that are as good as the best within the noise.

    Args:
        modes: best first; of equals the larger one first.
        joints: each value of the pose tree, node after node, over all modes.
        tolerance: the greatest excess over the best pose's J, or cost of the edges [pixel].
        complete: whether no pose within the tolerance was left out (on the grid, for a search on
            a grid).
        mode_count: how many modes there are; ``modes`` may hold only the first of them.
    """

    modes: tuple[PoseMode, ...]
    joints: tuple[JointEstimate, ...]
    tolerance: float
    complete: bool
    mode_count: int

    @property
    def determined(self) -> tuple[bool, ...]:
        """For each value of the pose tree whether it is determined."""
        return tuple(joint.determined for joint in self.joints)

    def position_intervals(self, tree: PoseTree) -> np.ndarray:
        """``determined``, ``low`` and ``high``, (3, nq), of positions; NaN: not in the tree."""
        joints = (*self.joints, *following_joints(tree, self.joints))
        known = {joint.name: (joint.determined, joint.low, joint.high) for joint in joints}
        names = tree.model.position_names
        return np.array([known.get(name, (np.nan,) * 3) for name in names], dtype=float).T


@dataclass(frozen=True)
class PoseEstimate:
    """The pose that a search or a tracker found.

    Args:
        found: False if there is no pose (q is NaN then), or none that can be relied on.
        q: (nq,), the positions in the plant's order [rad, m].
        X_WB: (4, 4), pose of the plant's world frame B in the scene's world W; the identity
            unless the plant's own joints cannot place the body.
        J: area of the exclusive or of body and silhouette, summed over the views (1) [pixel].
        area: the silhouettes' area [pixel].
        stopped_by: "end" if a search ran to its end, "exact" if J = 0 ended it, or the limit that
            stopped it; TRACKED for a pose that no search found.
        root_position: (3,) the root's origin in the world [m] where it was estimated; of a parallel
            camera's single picture the part along its axis is arbitrary.
        scale: the ratio of a parallel camera's pixels a metre to those that it was given with;
            1 where the scale was known.
        pose_set: all poses found that are as good, and what is known of each joint; None if the
            search did not ask.
        lower_bound: no pose of the search's grid has a smaller J than this [pixel].
        runs: how often a node was placed (step 3 of Kameda's search), or contours were compared.
        first_J: of the first whole pose, before the re-estimation of section 5.2 [pixel]; None: of
            the answer.
        outside_limit: the paper's threshold r in each view [pixel].
        interval_seconds: wall time of the intervals alone, which is part of ``seconds``.
        budget_spent: whether a limit on poses, time or memory ended the proof, or the search for
            poses as good, before all was settled.
    """

    found: bool
    q: np.ndarray
    X_WB: np.ndarray
    node_values: tuple[np.ndarray, ...]
    J: float
    area: float
    stopped_by: str
    seconds: float = 0.0
    root_position: np.ndarray | None = None
    scale: float = 1.0
    pose_set: PoseSet | None = None
    lower_bound: float = 0.0
    budget_spent: bool = False
    runs: int = 0
    first_J: float | None = None
    outside_limit: tuple[float, ...] = ()
    interval_seconds: float = 0.0

    @classmethod
    def of_values(
        cls, tree: PoseTree, node_values: Sequence[np.ndarray], J: float, area: float, **more: Any
    ) -> "PoseEstimate":
        """The estimate with a pose tree's values, (k_i,) of each node; ``more``: other fields."""
        q, X_WB = tree.positions_from(node_values)
        return cls(True, q, X_WB, tuple(node_values), J, area, **more)

    @classmethod
    def nothing(cls, tree: PoseTree, **more: Any) -> "PoseEstimate":
        """The answer where no pose was found; ``more``: other fields."""
        missing = np.full(len(tree.model.position_names), np.nan)
        return cls(False, missing, np.eye(4), (), math.nan, math.nan, **more)

    @property
    def E_total(self) -> float:
        """J over the silhouettes' area (9)."""
        return self.J / self.area

    @property
    def first_E_total(self) -> float:
        """E_total of the first whole pose, before any re-estimation; E_total where it is that."""
        return (self.J if self.first_J is None else self.first_J) / self.area

    @property
    def explained(self) -> bool:
        """Whether the pose explains the silhouettes at least roughly (UNEXPLAINED)."""
        return bool(self.found and self.E_total < UNEXPLAINED)

    @property
    def proved_optimal(self) -> bool:
        """Whether it is proved that no pose of the search's grid has a smaller J."""
        return bool(self.found and self.lower_bound >= self.J)

    def widened(self, begun: "PoseEstimate | None") -> "PoseEstimate":
        """A tracked pose whose joints are as open as the modes that its track began with."""
        before = None if begun is None else begun.pose_set
        if begun is None or before is None or self.pose_set is None or before.mode_count < 2:
            return self
        values = np.concatenate(self.node_values) - np.concatenate(begun.node_values)
        joints = tuple(
            now.widened(then, float(moved))
            for now, then, moved in zip(self.pose_set.joints, before.joints, values, strict=True)
        )
        known = replace(self.pose_set, joints=joints, mode_count=before.mode_count)
        return replace(self, pose_set=known)

    def turned(self, tree: PoseTree, turns: Sequence[np.ndarray]) -> "PoseEstimate":
        """The same pose with full turns (k_i,) [rad] added to each node's values."""

        def pose(one: PoseMode | PoseEstimate) -> dict[str, Any]:
            q = np.array(one.q)
            for node, added in zip(tree.nodes, turns, strict=True):
                # The values of a root that is turned by a RootRotation are no positions.
                if node.positions:
                    q[list(node.positions)] += added
            values = tuple(np.add(*both) for both in zip(one.node_values, turns, strict=True))
            return {"q": q, "node_values": values}

        def joints(one: PoseMode | PoseSet) -> tuple[JointEstimate, ...]:
            return tuple(
                replace(joint, low=joint.low + turn, high=joint.high + turn)
                for joint, turn in zip(one.joints, np.concatenate(turns).tolist(), strict=True)
            )

        known = self.pose_set
        if known is not None:
            modes = [replace(one, joints=joints(one), **pose(one)) for one in known.modes]
            known = replace(known, modes=tuple(modes), joints=joints(known))
        return replace(self, pose_set=known, **pose(self))
