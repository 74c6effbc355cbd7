"""Input and output types of searches and trackers: views, pose estimates and pose sets.

A ``PoseEstimate`` is one pose. Its ``PoseSet`` holds all poses that explain the silhouettes equally
well, grouped into modes (``PoseMode``), with an interval for each joint (``JointEstimate``).
"""

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
"""A pose with E_total at or above this does not explain the silhouettes."""

TRACKED = "tracked"
"""``PoseEstimate.stopped_by`` of a pose that was tracked from the previous frame."""


@dataclass(frozen=True)
class View:
    """A calibrated camera and the body's silhouette in its image.

    ``camera``: the camera. ``mask``: (height, width) the silhouette S. An array of numbers with at
    most two values is converted to bool, true where it has the larger value.

    Raises MaskError: if the mask has not the camera's size, has more than two values, or is empty.
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

    def cut(self, straight: float = 0.8, shortest: int = 8) -> "View":
        """Return the view without the empty parts of its picture beyond straight cuts of its mask.

        Where a mask ends at a line along the picture's rows or columns, it may be cut by a crop, or
        by what stands before the body; behind the line the picture then tells nothing. Without a
        cut this view itself is returned.

        ``straight``: a mask's last row or column is a cut if it has at least this fraction of the
        pixels of the next one; between that of a round end, .71, and that of two edges across the
        line, 1. ``shortest``: least number of its pixels.
        """
        kept, first = [], []
        for lines in (self.mask, self.mask.T):
            sums = np.count_nonzero(lines, axis=1)
            filled = np.flatnonzero(sums)
            ends = [0, len(sums)]
            for k, (end, inward) in enumerate(((filled[0], 1), (filled[-1], -1))):
                inner = sums[end + inward] if len(filled) > 1 else np.inf
                if sums[end] >= max(shortest, straight * inner):
                    ends[k] = int(end) + k
            kept.append(slice(*ends))
            first.append(ends[0])
        mask = np.ascontiguousarray(self.mask[tuple(kept)])
        if mask.shape == self.mask.shape:
            return self
        height, width = mask.shape
        x, y = self.camera.center_x - first[1], self.camera.center_y - first[0]
        camera = replace(self.camera, width=width, height=height, center_x=x, center_y=y)
        return View(camera, mask)


def require_views(views: Sequence[View]) -> None:
    """Raise a SettingsError if there are no views, or a single View in place of a sequence."""
    if isinstance(views, View):
        raise SettingsError("a match needs a list of views, as [view], not one View")
    if not views:
        raise SettingsError("a match needs at least one view, but none was given")


@dataclass(frozen=True)
class JointEstimate:
    """Interval of one value of the pose tree, as determined by the silhouettes."""

    name: str  # Name of the position (or of the root's angle).
    # True: the value lies between ``low`` and ``high``; False: the silhouettes do not determine the
    # value, and ``low`` and ``high`` are the extremes that were found.
    determined: bool
    # low, high: ends of the interval [rad or m]. For an angle that turns around they may lie beyond
    # the limits by full turns.
    low: float
    high: float
    covers_full_turn: bool = False  # Whether the value is an angle that can make a full turn.

    def holds(self, value: float, margin: float = 1e-9) -> bool:
        """Return whether a value is in the interval and ``margin`` [rad or m], up to full turns."""
        if self.covers_full_turn:
            value -= 2.0 * math.pi * round((value - 0.5 * (self.low + self.high)) / (2.0 * math.pi))
        return self.low - margin <= value <= self.high + margin

    def widened(self, other: "JointEstimate", moved: float) -> "JointEstimate":
        """Return the smallest interval that contains this one and another, shifted by ``moved``.

        The value is determined only if it is so in both. ``moved``: change since then [rad or m].
        """
        if self.covers_full_turn:
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
    """Return JointEstimates of m values: ends (m,) [rad or m] and ``determined`` (m,) bool."""
    return tuple(
        JointEstimate(name, bool(known), float(least), float(most), bool(around))
        for name, known, least, most, around in zip(
            kinematics.names, determined, low, high, kinematics.covers_full_turn, strict=True
        )
    )


def mimic_joints(tree: PoseTree, joints: Sequence[JointEstimate]) -> tuple[JointEstimate, ...]:
    """Return the estimates of mimic joints, from ``joints``, those of the pose tree's values."""
    known, names = {joint.name: joint for joint in joints}, tree.model.position_names
    found = []
    for follower, leader, multiplier, offset in tree.followers:
        one = known[names[leader]]
        low, high = sorted(multiplier * end + offset for end in (one.low, one.high))
        found.append(replace(one, name=names[follower], low=low, high=high))
    return tuple(found)


@dataclass(frozen=True)
class PoseMode:
    """One mode of the solution: a connected set of poses, and a representative."""

    q: np.ndarray  # (nq,) the representative's positions in the plant's order [rad, m].
    X_WB: np.ndarray  # (4, 4) pose of the plant's world frame B in the world W.
    # For each node (k_i,) the representative's values in the pose tree [rad or m].
    node_values: tuple[np.ndarray, ...]
    J: float  # The representative's objective, as in ``PoseEstimate`` [pixel].
    # The mode's interval of each value of the pose tree, in the order of the nodes.
    joints: tuple[JointEstimate, ...]
    size: float  # Number of poses found in the mode.

    @classmethod
    def of_values(
        cls,
        tree: PoseTree,
        node_values: Sequence[np.ndarray],
        J: float,
        joints: tuple[JointEstimate, ...],
        size: float,
    ) -> "PoseMode":
        """Make a mode of its representative's values (k_i,) of each node, with J [pixel].

        ``joints``: the mode's interval of each value. ``size``: number of poses in the mode.
        """
        return cls(*tree.positions_from(node_values), tuple(node_values), J, joints, size)


@dataclass(frozen=True)
class PoseSet:
    """All poses found whose objective exceeds the best one by no more than the noise."""

    modes: tuple[PoseMode, ...]  # Modes, sorted by objective; of equal ones the larger first.
    # Interval of each value of the pose tree over all modes, in the order of the nodes.
    joints: tuple[JointEstimate, ...]
    # Greatest excess over the best pose's objective J, or over its edge cost [pixel].
    tolerance: float
    # Whether every pose within the tolerance (of the grid, for a search on a grid) is in the set.
    complete: bool
    mode_count: int  # Number of modes; ``modes`` may hold only the first of them.

    @property
    def determined(self) -> tuple[bool, ...]:
        """Whether each value of the pose tree is determined."""
        return tuple(joint.determined for joint in self.joints)

    def position_intervals(self, tree: PoseTree) -> np.ndarray:
        """Return (3, nq) ``determined``, ``low``, ``high`` of q; NaN: it is not searched."""
        joints = (*self.joints, *mimic_joints(tree, self.joints))
        known = {joint.name: (joint.determined, joint.low, joint.high) for joint in joints}
        for name in tree.assumed:
            known.pop(name, None)
        names = tree.model.position_names
        return np.array([known.get(name, (np.nan,) * 3) for name in names], dtype=float).T


@dataclass(frozen=True)
class PoseEstimate:
    """The pose found by a search or a tracker. Equation numbers are those of Kameda's paper.

    Args:
        found: False if there is no pose (``q`` is NaN then), or no reliable one.
        q: (nq,) positions in the plant's order [rad, m].
        X_WB: (4, 4) pose of the plant's world frame B in the scene's world W; the identity
            unless the plant's own joints cannot place the body.
        node_values: for each node (k_i,) its values in the pose tree [rad or m].
        J: area of the exclusive or of body and silhouette, summed over the views (1) [pixel].
        area: total area of the silhouettes [pixel].
        stopped_by: "end" if the search ran to its end, "exact" if an exact pose ended it, the name
            of the limit that stopped it, or TRACKED for a tracked pose.
        seconds: wall time of the search [s].
        root_position: (3,) the root's origin in the world [m], if it was estimated. Of a single
            parallel view the component along the camera's axis is arbitrary.
        scale: ratio of a parallel camera's estimated to its given ``pixels_per_metre``; 1 where the
            scale was known.
        pose_set: all poses found that are as good, with the intervals of joints; None if these
            were not computed.
        lower_bound: lower bound of J over the search's grid [pixel].
        budget_spent: whether a limit on poses, time or memory ended the proof of optimality, or
            the search for poses as good, before it was complete.
        runs: number of times a node was placed (step 3 of Kameda's search), or of comparisons of
            contours.
        first_J: J of the first whole pose, before the re-estimation of section 5.2 [pixel]; None
            if that pose is the answer.
        outside_limit: the paper's threshold r in each view [pixel].
        interval_seconds: part of ``seconds`` in which intervals were computed [s].
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
        """Make the estimate of a pose found, from its values (k_i,) of each node [rad or m].

        ``J``, ``area``: objective, and total area of the silhouettes [pixel]. ``more``: other
        fields of the class; ``stopped_by`` is required.
        """
        q, X_WB = tree.positions_from(node_values)
        return cls(True, q, X_WB, tuple(node_values), J, area, **more)

    @classmethod
    def nothing(cls, tree: PoseTree, **more: Any) -> "PoseEstimate":
        """Make the estimate that reports that no pose was found: ``q``, J and area are NaN.

        ``more``: other fields of the class; ``stopped_by`` is required.
        """
        missing = np.full(len(tree.model.position_names), np.nan)
        return cls(False, missing, np.eye(4), (), math.nan, math.nan, **more)

    @property
    def E_total(self) -> float:
        """J divided by the silhouettes' area (9)."""
        return self.J / self.area

    @property
    def first_E_total(self) -> float:
        """E_total of the first whole pose, before any re-estimation."""
        return (self.J if self.first_J is None else self.first_J) / self.area

    @property
    def explained(self) -> bool:
        """Whether E_total is below UNEXPLAINED: the pose explains the silhouettes roughly."""
        return bool(self.found and self.E_total < UNEXPLAINED)

    @property
    def proved_optimal(self) -> bool:
        """Whether no pose of the search's grid has a smaller J, by the lower bound."""
        return bool(self.found and self.lower_bound >= self.J)

    def widened(self, first: "PoseEstimate | None") -> "PoseEstimate":
        """Return this tracked pose with joint intervals that include all modes of the first pose.

        A joint that was ambiguous where the track began stays ambiguous: each interval is united
        with that of ``first``, shifted by the change of the value since. If ``first`` is None or
        has fewer than two modes, this estimate is returned unchanged.
        """
        before = None if first is None else first.pose_set
        if first is None or before is None or self.pose_set is None or before.mode_count < 2:
            return self
        values = np.concatenate(self.node_values) - np.concatenate(first.node_values)
        found = self.united(first, values)
        assert found.pose_set is not None
        return replace(found, pose_set=replace(found.pose_set, mode_count=before.mode_count))

    def united(self, other: "PoseEstimate", moved: np.ndarray | float = 0.0) -> "PoseEstimate":
        """Return this pose with joint intervals that hold another's, shifted by ``moved`` (m,)."""
        if self.pose_set is None or other.pose_set is None:
            return self
        pairs = zip(self.pose_set.joints, other.pose_set.joints, strict=True)
        changes = np.broadcast_to(moved, len(self.pose_set.joints))
        joints = tuple(
            now.widened(then, float(change))
            for (now, then), change in zip(pairs, changes, strict=True)
        )
        return replace(self, pose_set=replace(self.pose_set, joints=joints))

    def turned(self, tree: PoseTree, turns: Sequence[np.ndarray]) -> "PoseEstimate":
        """Return the same pose with full turns added to its angles, their intervals and modes.

        ``tree``: the pose tree. ``turns``: for each node (k_i,) what is added: multiples of 2 pi
        [rad], 0 for lengths.
        """

        def pose(one: PoseMode | PoseEstimate) -> dict[str, Any]:
            q = np.array(one.q)
            for node, added in zip(tree.nodes, turns, strict=True):
                # A root turned by a RootRotation has values, but no positions.
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
