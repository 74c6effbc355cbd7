"""What the silhouette method knows of a body besides its surfaces: limbs, from landmarks."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array
from drake_pose.body.landmarks import landmarks_of_nodes, load_landmarks
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.errors import ModelError

_LIMBS = {
    "left_arm": ("left_shoulder", "left_elbow", "left_wrist"),
    "right_arm": ("right_shoulder", "right_elbow", "right_wrist"),
    "left_leg": ("left_hip", "left_knee", "left_ankle"),
    "right_leg": ("right_hip", "right_knee", "right_ankle"),
}
_TRUNK = ("neck", "left_hip", "right_hip")
PERSON_LANDMARKS = frozenset({*_TRUNK, *(name for limb in _LIMBS.values() for name in limb)})
"""The anatomical joint centres that a model of a person has in its landmarks.yaml."""

_POSES = 2048
# One in this many of them is stretched.
_STRETCHED = 8
# Points of a limb that are nearer to each other fill the same space [m].
_APART = 0.08
# Where points are put on a limb: so far from root to middle joint, and on to the end; a hand's or
# foot's middle lies farther.
_ALONG = np.array([0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.25])
UPPER_SAMPLES = int(np.count_nonzero(_ALONG <= 1.0))
"""How many of a limb's points are on its first half; the others follow."""


@dataclass(frozen=True, eq=False)
class PlannedLimb:
    """An arm or leg of a pose tree.

    Args:
        nodes, values: those that move it alone; k values.
        joints: (3,) its root, middle joint and end among the landmarks.
        poses: (n, k) values all over its limits; the first is at rest.
        samples_T, weights: (n, m, 3) points along it in the trunk's frame [m], and theirs (n, m).
        length: from its root to its end, stretched out [m].
    """

    nodes: NDArray[np.intp]
    values: NDArray[np.intp]
    joints: NDArray[np.intp]
    poses: Array
    samples_T: Array
    weights: Array
    length: float

    def places(self, X_WT: Array) -> Array:
        """(n, m, 3) its points in the world [m] where the trunk is at X_WT (4, 4)."""
        placed = self.samples_T.reshape(-1, 3) @ X_WT[:3, :3].T + X_WT[:3, 3]
        return np.asarray(placed.reshape(self.samples_T.shape))


class BodyPlan:
    """A person's limbs and trunk in a pose tree.

    Attributes:
        trunk: the node that the limbs hang on.
        heading: the value that turns all of the body freely, about the vertical; None: no such.

    Raises:
        ModelError: the model has no landmarks, or not those of trunk, arms and legs.
    """

    def __init__(self, kinematics: TreeKinematics) -> None:
        self.kinematics = kinematics
        tree = kinematics.tree
        known = load_landmarks(tree.model.path)
        missing = sorted(PERSON_LANDMARKS - set(known))
        if missing:
            raise ModelError(
                f"{tree.model.path}: landmarks.yaml lacks {', '.join(missing)}, which the capture "
                "of a person by its silhouettes needs"
            )
        self.landmarks = landmarks_of_nodes(tree, known)
        self.trunk = int(self._node("neck"))
        free = np.flatnonzero(kinematics.turns_around)
        self.heading = int(free[0]) if len(free) else None

    def trunk_middle(self, X_WN: Array) -> Array:
        """(3,) the trunk's middle [m], half-way between neck and hips."""
        places = dict(zip(self.landmarks.names, self.landmarks.positions(X_WN), strict=True))
        hips = 0.5 * (places["left_hip"] + places["right_hip"])
        return np.asarray(0.5 * (places["neck"] + hips))

    @cached_property
    def limbs(self) -> Mapping[str, PlannedLimb]:
        """The limbs, by name."""
        return {name: self._plan(*parts) for name, parts in _LIMBS.items()}

    def _node(self, landmark: str) -> int:
        return int(self.landmarks.nodes[self.landmarks.names.index(landmark)])

    def _plan(self, root: str, middle: str, end: str) -> PlannedLimb:
        from scipy.stats import qmc  # Slow to import, and needed for persons alone.

        kinematics, tree = self.kinematics, self.kinematics.tree
        rest = kinematics.flatten(tree.default_values())
        moves = kinematics.motions(rest).moves
        own = moves[self._node(end)] & ~moves[self._node("neck")]
        free = kinematics.is_angle & (kinematics.upper > kinematics.lower)
        values = np.flatnonzero(own & free)
        nodes = np.flatnonzero((moves & own).any(axis=1))
        share = qmc.Halton(len(values), scramble=False).random(_POSES)
        lower, upper = (ends[values] for ends in kinematics.reach(rest))
        poses = np.clip(rest[values], lower, upper) * np.ones((_POSES, 1))
        poses[1:] = lower + share[1:] * (upper - lower)
        # People stretch their limbs more often than chance would.
        stretched = np.flatnonzero(kinematics.value_nodes[values] == self._node(end))
        chosen = np.arange(_POSES // _STRETCHED)
        poses[np.ix_(chosen, stretched)] = poses[0, stretched]
        joints = np.array([self.landmarks.names.index(name) for name in (root, middle, end)])
        posed = np.tile(rest, (_POSES, 1))
        posed[:, values] = poses
        each = [own.T for own in kinematics.split(posed.T)]
        X_WN = np.tile(tree.node_poses(kinematics.split(rest)), (_POSES, 1, 1, 1))
        for node in nodes.tolist():
            X_PN = tree.relative_transforms(node, each[tree.source(node)])
            X_WN[:, node] = X_WN[:, tree.nodes[node].parent] @ X_PN
        X_WT = X_WN[0, self.trunk]
        samples_W = self._samples(joints, X_WN).reshape(-1, 3)
        samples_T = ((samples_W - X_WT[:3, 3]) @ X_WT[:3, :3]).reshape(_POSES, -1, 3)
        a, b, c = self.landmarks.positions(X_WN[0])[joints]
        length = float(np.linalg.norm(b - a) + np.linalg.norm(c - b))
        weights = crowding(samples_T)
        return PlannedLimb(nodes, values, joints, poses, samples_T, weights, length)

    def samples(self, limb: PlannedLimb, X_WN: Array) -> Array:
        """(m, 3) points along a limb in the world [m] where the nodes are at X_WN."""
        return self._samples(limb.joints, X_WN[None])[0]

    def _samples(self, joints: NDArray[np.intp], X_WN: Array) -> Array:
        """(n, m, 3) points along a limb, given its three landmarks and X_WN (n, nodes, 4, 4)."""
        a, b, c = np.moveaxis(self.landmarks.positions(X_WN)[:, joints], 1, 0)
        upper = np.minimum(_ALONG, 1.0)[:, None]
        lower = np.maximum(_ALONG - 1.0, 0.0)[:, None]
        steps = upper * (b - a)[:, None] + lower * (c - b)[:, None]
        return np.asarray(a[:, None] + steps)


def crowding(samples: Array) -> Array:
    """(n, m) weights of points (n, m, 3): one over the points about each, over m."""
    x, y, z = (own[:, :, None] - own[:, None] for own in np.moveaxis(samples, 2, 0))
    near = x * x + y * y + z * z < _APART**2
    return np.asarray(1.0 / (near.sum(axis=2) * samples.shape[1]))
