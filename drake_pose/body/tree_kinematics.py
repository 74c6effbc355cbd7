"""Compiled forward kinematics of a pose tree, with derivatives by its values.

The values of a tree are one flat array here, node after node. A value moves everything behind its
joint by a twist (omega, v) in the world: dp/dvalue = omega x p + v for a point p.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from pydrake.multibody.tree import Joint, RigidBody

from drake_pose.arrays import Array
from drake_pose.body.joint_kernel import PackedSteps, evaluate_joint, pack_steps
from drake_pose.body.link_graph import JointMap, PlantKinematics, chain_transforms
from drake_pose.body.parsed_model import nearest_turn
from drake_pose.body.pose_tree import PoseTree, require_tree
from drake_pose.compiled import compiled, multiply
from drake_pose.errors import SettingsError


class PackedTree(NamedTuple):
    """A pose tree in the arrays that the kernel takes."""

    parents: np.ndarray  # (n,) index of each node's parent; -1: the world.
    X_PA: np.ndarray  # (n, 4, 4) constant transforms, with R_W0 of rotated roots included.
    # (n + 1,) index of each node's first value. The kernel's values are those of the tree, followed
    # by those of joints that follow others.
    value_starts: np.ndarray
    free: np.ndarray  # (n,) bool, whether the node's values begin with a rotation vector.
    step_starts: np.ndarray  # (n + 1,) index of each node's first joint in ``steps``.
    steps: PackedSteps  # All joints.


@dataclass(frozen=True, eq=False)
class Motions:
    """Poses of all nodes and the motions that parameters cause.

    The parameters are the tree's values, then those that ``TreeKinematics.motions`` adds. A point
    p_W of node i moves with motion j by omega x p_W + v + sigma p_W if ``moves[i, j]``, else not at
    all. Motions are in the order of ``TreeKinematics.motion_values``, then the added parameters.
    """

    X_WN: np.ndarray  # (nodes, 4, 4) poses of the nodes.
    twists: np.ndarray  # (k, 7) omega, v, sigma of each motion, in the world and about its origin.
    moves: np.ndarray  # (nodes, k) bool, whether the motion moves the node.


class TreeKinematics:
    """Compiled kinematics of a pose tree; arrays (m,) are in the order of the nodes' values.

    Attributes:
        value_nodes: (m,) index of each value's node.
        lower, upper: (m,) limits [rad or m]; equal where a value is held, infinite where an angle
            can take every direction.
        is_angle: (m,) whether the value is an angle [rad]; else a length [m].
        covers_full_turn: (m,) whether the value is an angle that can take every direction.
        motion_values: (e,) index of the value that causes each motion: first each value's own
            motion, then those of joints that follow a value.
        packed: the tree as ``find_motions`` takes it.
    """

    def __init__(self, tree: PoseTree) -> None:
        require_tree(tree)
        self.tree = tree
        self.names = tuple(name for node in tree.nodes for name in node.value_names)
        counts = [len(node.value_names) for node in tree.nodes]
        self.value_nodes = np.repeat(np.arange(len(counts)), counts)
        firsts = np.cumsum([0, *counts])
        self._splits = firsts.tolist()
        followers = [
            (firsts[tree.nodes[i].parent] + leader, i, multiplier, offset)
            for i, placement in enumerate(tree.placements)
            for _, leader, multiplier, offset in placement.follows
        ]
        values, nodes, scale, offset = np.array(followers, dtype=np.float64).reshape(-1, 4).T
        self.motion_values = np.append(np.arange(firsts[-1]), values.astype(np.int64))
        motion_nodes = np.append(self.value_nodes, nodes.astype(np.int64))
        self._scale, self._offset = scale, offset
        bounds = [tree.value_bounds(i) for i in range(len(counts))]
        lower, upper = np.hstack([np.zeros((2, 0)), *bounds])
        self._middle = 0.5 * (lower + upper)
        self.covers_full_turn = np.concatenate(
            [tree.covers_full_turn(i) for i in range(len(counts))]
        )
        self.lower = np.where(self.covers_full_turn, -np.inf, lower)
        self.upper = np.where(self.covers_full_turn, np.inf, upper)
        self.is_angle = np.concatenate([placement.is_angle for placement in tree.placements])
        self.packed = _pack_tree(tree, firsts)
        # (nodes, e + 4) which nodes each motion moves; last the root's translation and scale.
        moves = np.zeros((len(counts), len(self.motion_values) + 4), dtype=np.bool_)
        for i, node in enumerate(tree.nodes):
            if node.parent >= 0:
                moves[i] = moves[node.parent]
            moves[i, :-4] |= motion_nodes == i
            moves[i, -4:] = i == 0 or (node.parent >= 0 and moves[node.parent, -1])
        self._moves = moves

    def flatten(self, node_values: Sequence[np.ndarray]) -> np.ndarray:
        """Return all values (m,) from each node's (k_i,) values; SettingsError for wrong sizes."""
        parts = [np.asarray(values, dtype=np.float64).reshape(-1) for values in node_values]
        sizes = [len(node.value_names) for node in self.tree.nodes]
        if [len(part) for part in parts] != sizes:
            raise SettingsError(f"{sizes} values of the nodes expected")
        return np.concatenate(parts) if parts else np.zeros(0)

    def split(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return each node's values (k_i,), given all values (m,)."""
        return tuple(np.asarray(values)[a:b] for a, b in pairwise(self._splits))

    def nearest_turns(self, values: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return values (m,) [rad or m] of the same pose, angles in the turn nearest to ``near``.

        Only angles that can take every direction are moved. ``near``: (m,) [rad or m]; None: the
        middle of the turn that is searched, which is the turn about the default positions.
        """
        return nearest_turn(values, self._middle if near is None else near, self.covers_full_turn)

    def within_limits(self, values: np.ndarray) -> np.ndarray:
        """Return values (m,) [rad or m] of the same pose, angles moved by turns into their limits.

        Only angles that can take every direction are moved.
        """
        limits = [self.tree.value_limits(i) for i in range(len(self.tree.nodes))]
        lower, upper = np.hstack([np.zeros((2, 0)), *limits])
        full = 2.0 * math.pi
        above = np.maximum(np.ceil((values - upper) / full), 0.0)
        below = np.maximum(np.ceil((lower - values) / full), 0.0)
        return np.where(self.covers_full_turn, values - full * (above - below), values)

    def local_limits(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper limits (m,), (m,) [rad or m] around a pose's values (m,).

        An angle that can take every direction has half a turn either side of its value.
        """
        lower = np.where(self.covers_full_turn, values - math.pi, self.lower)
        return lower, np.where(self.covers_full_turn, values + math.pi, self.upper)

    def poses(self, values: np.ndarray) -> np.ndarray:
        """Return X_WN (nodes, 4, 4) at values (m,) [rad or m]."""
        return self._compute(values)[0]

    def _compute(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return X_WN (nodes, 4, 4) and twists (omega, v) (e, 6) of all motions at values (m,).

        The motions are in the order of ``motion_values``.
        """
        values = np.ascontiguousarray(values, dtype=np.float64)
        if values.shape != (len(self.names),):
            raise SettingsError(f"{len(self.names)} values expected, got shape {values.shape}")
        if len(self.motion_values) == len(values):
            return find_motions(self.packed, values)
        followers = self._scale * values[self.motion_values[len(values) :]] + self._offset
        X_WN, twists = find_motions(self.packed, np.append(values, followers))
        twists[len(values) :] *= self._scale[:, None]
        return X_WN, twists

    def motions(
        self, values: np.ndarray, *, translation: bool = False, scale: bool = False
    ) -> Motions:
        """Return poses and motions at values (m,) [rad or m].

        Args:
            values: (m,) values of the tree.
            translation: add translations of the first root's tree along the world's x, y and z [m].
            scale: add a uniform scaling of the first root's tree about the root's origin; the
                parameter is the log scale.

        Raises SettingsError: the number of values is wrong.
        """
        X_WN, value_twists = self._compute(values)
        count = len(self.motion_values)
        extra_count = 3 * translation + scale
        twists = np.zeros((count + extra_count, 7))
        twists[:count, :6] = value_twists
        if translation:
            twists[count : count + 3, 3:6] = np.eye(3)
        if scale:
            twists[-1, 3:6], twists[-1, 6] = -X_WN[0, :3, 3], 1.0
        # Translation and scale move the same nodes.
        return Motions(X_WN, twists, self._moves[:, : count + extra_count])


def _pack_tree(tree: PoseTree, firsts: np.ndarray) -> PackedTree:
    """Return the tree in arrays; the axis rotations of a limited root become joints.

    ``firsts``: (nodes + 1,) index of each node's first value in the tree's values.
    """
    starts, end = firsts.copy(), firsts[-1]
    for i, placement in enumerate(tree.placements):
        if placement.follows:
            starts[i], end = end, end + len(placement.follows)
    starts[-1] = end
    X_PA, free, chains = [], [], []
    for placement in tree.placements:
        X, rotation = np.array(placement.X_PA), placement.rotation
        rotations: tuple[JointMap, ...] = ()
        if rotation is not None:
            X[:3, :3] = X[:3, :3] @ rotation.R_W0
            for axis in rotation.axes:
                e, rows = np.eye(3)["xyz".index(axis)], np.zeros((4, 4, 4))
                rows[0, :3, :3], rows[0, 3, 3] = np.outer(e, e), 1.0
                rows[1, :3, :3] = np.eye(3) - np.outer(e, e)
                rows[2, :3, :3] = np.cross(e, -np.eye(3))
                rotations += (JointMap(rows.reshape(4, 16), 1),)
        X_PA.append(X)
        free.append(rotation is not None and rotation.kind == "free")
        chains.append(rotations + placement.steps)
    return PackedTree(
        parents=np.array([node.parent for node in tree.nodes], dtype=np.int64),
        X_PA=np.array(X_PA),
        value_starts=starts,
        free=np.array(free, dtype=np.bool_),
        step_starts=np.cumsum([0, *(len(chain) for chain in chains)]),
        steps=pack_steps([step for chain in chains for step in chain]),
    )


@compiled
def find_motions(packed: PackedTree, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses X_WN (n, 4, 4) of all nodes, and the twist (omega, v) (m, 6) of each value.

    ``values``: (m,) values [rad or m] in the order of ``packed``.
    """
    count, steps = packed.parents.shape[0], packed.steps
    X_WN, twists = np.zeros((count, 4, 4)), np.zeros((values.shape[0], 6))
    basis, Y, dT = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    M, product, J = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 3))
    world = np.eye(4)
    for node in range(count):
        parent, X, value = packed.parents[node], X_WN[node], packed.value_starts[node]
        multiply(X_WN[parent] if parent >= 0 else world, packed.X_PA[node], X)
        X[3, 3] = 1.0
        first, end = packed.step_starts[node], packed.step_starts[node + 1]
        if packed.free[node]:
            first -= 1  # The free rotation precedes the joints.
        for step in range(first, end):
            is_free = step < packed.step_starts[node]
            if is_free:
                # A rotation vector r: Rodrigues's formula R = I + a K + b K^2, and the left
                # Jacobian of SO(3), J = I + b K + c K^2, with K the cross product matrix of r.
                r = values[value:]
                angle = math.sqrt(r[0] ** 2 + r[1] ** 2 + r[2] ** 2)
                if angle > 1e-4:
                    a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
                    c = (1.0 - a) / angle**2
                else:
                    a, b = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0
                    c = 1.0 / 6.0 - angle**2 / 120.0
                for i in range(3):
                    for j in range(3):
                        K = 0.0 if i == j else (r[3 - i - j] if (i - j) % 3 == 1 else -r[3 - i - j])
                        KK = r[i] * r[j] - (angle**2 if i == j else 0.0)
                        Y[i, j] = (1.0 if i == j else 0.0) + a * K + b * KK
                        J[i, j] = (1.0 if i == j else 0.0) + b * K + c * KK
                    Y[i, 3] = 0.0
            else:
                evaluate_joint(steps, step, values[value:], 1.0, -1, basis, Y)
            size = 3 if is_free else steps.sizes[step]
            for k in range(size):
                if is_free:
                    M[:] = 0.0
                    M[2, 1], M[0, 2], M[1, 0] = J[0, k], J[1, k], J[2, k]
                else:
                    evaluate_joint(steps, step, values[value:], 1.0, k, basis, dT)
                    # Twist matrix: dT T^-1 with T = Y, or inverted -T^-1 dT with T^-1 = Y.
                    for i in range(3):
                        for j in range(4):
                            M[i, j] = dT[i, 3] if j == 3 and not steps.inverted[step] else 0.0
                            for n in range(3):
                                if steps.inverted[step]:
                                    M[i, j] -= Y[i, n] * dT[n, j]
                                elif j < 3:
                                    M[i, j] += dT[i, n] * Y[j, n]
                        if not steps.inverted[step]:
                            M[i, 3] -= M[i, 0] * Y[0, 3] + M[i, 1] * Y[1, 3] + M[i, 2] * Y[2, 3]
                # The twist in the world of M = ([omega]x, v).
                twist, p0, p1, p2 = twists[value + k], X[0, 3], X[1, 3], X[2, 3]
                for i in range(3):
                    twist[i] = X[i, 0] * M[2, 1] + X[i, 1] * M[0, 2] + X[i, 2] * M[1, 0]
                    twist[3 + i] = X[i, 0] * M[0, 3] + X[i, 1] * M[1, 3] + X[i, 2] * M[2, 3]
                twist[3] += p1 * twist[2] - p2 * twist[1]
                twist[4] += p2 * twist[0] - p0 * twist[2]
                twist[5] += p0 * twist[1] - p1 * twist[0]
            value += size
            multiply(X, Y, product)
            for i in range(3):
                for j in range(4):
                    X[i, j] = product[i, j]
    return X_WN, twists


class LinkVector(NamedTuple):
    """The vector from the previous joint's origin (or the world's) to a joint's origin."""

    joint: str  # Name of the joint.
    link: str  # Name of the joint's parent link.
    node: int  # Index of the node that the joint moves.
    step: int  # Index of the joint among the node's joints.
    # Whether the tree traverses the joint inwards, from its child link to its parent.
    inverted: bool
    # (3,) displacement [m] of the tree behind the joint when the vector is added, in frame A. A is
    # the parent link's frame, which is the parent node's if ``step`` is 0 and the joint is not
    # inverted. The displacement is the vector, or its negative if inverted.
    p_A: Array
    p_L: Array  # (3,) the vector in the parent link's frame [m].


def link_vectors(tree: PoseTree, min_length: float = 1e-3) -> tuple[LinkVector, ...]:
    """Return the vector to each joint of a tree from the joint that places its parent link.

    A joint on a link that no joint moves has the vector from the world. Vectors of at most
    ``min_length`` [m] are left out.
    """
    model, plant, kinematics = tree.model, tree.model.plant, PlantKinematics(tree.model)

    def pose(link: RigidBody) -> Array:
        """Return a link's pose (4, 4) in the plant's world at the held positions."""
        return kinematics.pose(int(link.index()), tree.held)

    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    moving = {joint.position_start(): joint for joint in joints if joint.num_positions() > 0}
    inboard = {int(joint.child_body().index()): joint for joint in joints}
    found = []
    for i, (node, placement) in enumerate(zip(tree.nodes, tree.placements, strict=True)):
        X_BA, offset = np.eye(4), 0
        follows = placement.follows
        positions = [coupling.follower for coupling in follows] if follows else list(node.positions)
        values = model.default_positions[positions] if follows else placement.defaults
        if node.parent >= 0:
            parent = model.link_index(tree.nodes[node.parent].name)
            X_BA = kinematics.pose(parent, tree.held)
        for k, step in enumerate(placement.steps):
            joint = moving[positions[offset]]
            p_B = _offset(joint, inboard, pose)
            end = offset + step.position_count
            X_BC = X_BA @ chain_transforms([step], values[None, offset:end])[0]
            if np.linalg.norm(p_B) > min_length:
                link = joint.parent_body()
                p_A = -X_BC[:3, :3].T @ p_B if step.inverted else X_BA[:3, :3].T @ p_B
                p_L = pose(link)[:3, :3].T @ p_B
                found.append(
                    LinkVector(joint.name(), link.name(), i, k, bool(step.inverted), p_A, p_L)
                )
            X_BA = X_BC
            offset = end
    return tuple(found)


def _offset(
    joint: Joint, inboard: Mapping[int, Joint], pose: Callable[[RigidBody], Array]
) -> Array:
    """Return the vector (3,) [m], in the plant's world, to a joint from its part's origin.

    ``inboard``: the joint that carries each body, by the body's index. ``pose``: returns a body's
    pose (4, 4) in the plant's world.
    """
    link = first = joint.parent_body()
    while (joint_before := inboard.get(int(first.index()))) and joint_before.num_positions() == 0:
        first = joint_before.parent_body()
    X_LJ = joint.frame_on_parent().GetFixedPoseInBodyFrame().GetAsMatrix4()
    return np.asarray((pose(link) @ X_LJ - pose(first))[:3, 3])
