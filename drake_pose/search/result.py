"""What a search is given and what it answers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.errors import MaskError
from drake_pose.search.pose_families import JointEstimate, PoseSet

UNEXPLAINED = 0.5
"""From this E_total on, the pose is no explanation of the silhouettes."""


@dataclass(frozen=True)
class View:
    """What one calibrated camera sees of the body.

    Args:
        camera: the camera.
        mask: the silhouette S, (height, width) bool.

    Raises:
        MaskError: if the mask is not of the camera's size, or is empty.
    """

    camera: Camera
    mask: np.ndarray

    def __post_init__(self) -> None:
        expected = (self.camera.height, self.camera.width)
        if self.mask.shape != expected:
            raise MaskError(
                f"mask of camera '{self.camera.name}' is {self.mask.shape[::-1]} pixels (width, "
                f"height), but the camera's picture is {expected[::-1]}; give the mask at the "
                "size the camera was calibrated for"
            )
        if not self.mask.any():
            raise MaskError(
                f"mask of camera '{self.camera.name}' is empty; leave this view out, or give a "
                "mask that shows the body"
            )


@dataclass(frozen=True)
class Candidates:
    """Joint angle candidates JAC_i(t) of one node that were not adopted.

    Args:
        value_names: the k positions that the values are of (or a root's angles).
        values: (n, k), the candidates in the order of the list [rad or m].
        scores: (n,), their scores e_i(t) [pixel] when the list was made (5).
    """

    value_names: tuple[str, ...]
    values: np.ndarray
    scores: np.ndarray


@dataclass(frozen=True)
class MatchResult:
    """The pose that a search found.

    Args:
        found: False if the search ended without any whole pose; q is NaN then.
        q: (nq,), the positions in the plant's order [rad, m].
        X_WB: (4, 4), pose of the plant's world frame B in the scene's world W; the identity
            unless the plant's own joints cannot place the body.
        node_values: the values of each node of the pose tree.
        J: area of the exclusive or of body and silhouette, summed over the views (1) [pixel].
        E_total: J over the silhouette's area (9).
        first_E_total: E_total of the first whole pose, before the re-estimation of section 5.2.
        runs: how often step 3 was run.
        outside_limit: the threshold r that was used in each view [pixel]; () where the search
            has none.
        untried: the candidates not adopted in the answer, by node name.
        stopped_by: "end" if the search ran to its end, "exact" if J = 0 ended it, "run_limit" or
            "time_limit" if a limit stopped it; "tracked" for a pose that was tracked from the frame
            before, which no search found.
        seconds: wall time of the search [s].
        proved_optimal: whether it is proved that no pose of the search's grid has a smaller J.
        lower_bound: no pose of the grid has a smaller J than this [pixel]; 0 says nothing.
        budget_spent: whether a limit on poses, time or memory ended the proof, or the search for
            poses as good, before all was settled.
        pose_set: all poses found that are as good, and what is known of each joint; None if the
            search did not ask.
    """

    found: bool
    q: np.ndarray
    X_WB: np.ndarray
    node_values: tuple[np.ndarray, ...]
    J: float
    E_total: float
    first_E_total: float
    runs: int
    outside_limit: tuple[float, ...]
    untried: Mapping[str, Candidates]
    stopped_by: str
    seconds: float
    proved_optimal: bool = False
    lower_bound: float = 0.0
    budget_spent: bool = False
    pose_set: PoseSet | None = None

    def turned(self, tree: PoseTree, turns: Sequence[np.ndarray]) -> "MatchResult":
        """The same pose with angles in other turns.

        Args:
            tree: the pose tree that was searched.
            turns: (k_i,) for each node what is added to its values, full turns [rad].
        """
        pose_set = self.pose_set
        if pose_set is not None:
            joint_turns = np.concatenate(turns)
            families = [
                replace(
                    family,
                    q=_turned_positions(family.q, tree, turns),
                    node_values=_add(family.node_values, turns),
                    joints=_turned_joints(family.joints, joint_turns),
                )
                for family in pose_set.families
            ]
            joints = _turned_joints(pose_set.joints, joint_turns)
            pose_set = replace(pose_set, families=tuple(families), joints=joints)
        return replace(
            self,
            q=_turned_positions(self.q, tree, turns),
            node_values=_add(self.node_values, turns),
            pose_set=pose_set,
        )

    @property
    def explained(self) -> bool:
        """Whether the pose explains the silhouettes at least roughly (UNEXPLAINED)."""
        return bool(self.found and self.E_total < UNEXPLAINED)


@dataclass(frozen=True)
class PlacedMatch(MatchResult):
    """The pose that a search found with a root position or a scale that was not known.

    Args:
        root_position: (3,) the root's origin in the world [m]; of a parallel camera's single
            picture the part along its axis is arbitrary.
        scale: a parallel camera has so many times the pixels a metre that it was given with, and
            the body its own size; 1 where the scale was known.
    """

    root_position: np.ndarray | None = None
    scale: float = 1.0


def _turned_positions(q: np.ndarray, tree: PoseTree, turns: Sequence[np.ndarray]) -> np.ndarray:
    turned = np.array(q)
    for node, added in zip(tree.nodes, turns, strict=True):
        # The values of a root that is turned by a RootRotation are no positions.
        if node.positions:
            turned[list(node.positions)] += added
    return turned


def _turned_joints(joints: Sequence[JointEstimate], turns: np.ndarray) -> tuple[JointEstimate, ...]:
    return tuple(
        replace(joint, low=joint.low + turn, high=joint.high + turn, values=joint.values + turn)
        for joint, turn in zip(joints, turns.tolist(), strict=True)
    )


def _add(node_values: Sequence[np.ndarray], turns: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    return tuple(values + added for values, added in zip(node_values, turns, strict=True))
