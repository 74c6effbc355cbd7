"""Poses of a tree's nodes and how they change with its values, fast enough for optimisation.

A tree's values are taken as one flat array here, node after node. The motion that a value gives to
everything behind it is a twist in the world: dp/dvalue = omega x p + v for a point at p.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_pose.body.limits import nearest_turn
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.compiled import compiled, copy_into
from drake_pose.errors import SettingsError

_BY_JOINTS, _FREE, _LIMITED = 0, 1, 2


class PackedTree(NamedTuple):
    """A pose tree in the arrays that the kernel walks.

    parents: (n,); X_PA: (n, 4, 4) constant parts, R_W0 of turned roots included; value_starts:
    (n + 1,); kinds: (n,) how a node's first values turn it; axes: (n, 3) axes of limited roots,
    -1 where there are fewer; step_starts: (n + 1,); inverted: (s,); sizes: (s,) the positions of
    each joint; coefficient_starts: (s,); coefficients: (r, 16) those of JointMap.
    """

    parents: np.ndarray
    X_PA: np.ndarray
    value_starts: np.ndarray
    kinds: np.ndarray
    axes: np.ndarray
    step_starts: np.ndarray
    inverted: np.ndarray
    sizes: np.ndarray
    coefficient_starts: np.ndarray
    coefficients: np.ndarray


@dataclass(frozen=True, eq=False)
class Motions:
    """The poses of all nodes and the motions that the parameters give them.

    The parameters are the tree's values and, after them, what ``TreeKinematics.motions`` was asked
    to add. A point of node i at p_W moves with parameter j by ``omega x p_W + v + sigma p_W`` where
    ``moves[i, j]``, else not at all.

    Attributes:
        X_WN: (nodes, 4, 4).
        twists: (m, 7) omega, v, sigma, in the world and about its origin.
        moves: (nodes, m) bool.
    """

    X_WN: np.ndarray
    twists: np.ndarray
    moves: np.ndarray


class TreeKinematics:
    """A pose tree's kinematics, compiled.

    Attributes:
        tree: the pose tree.
        names: the names of the m values, node after node.
        value_nodes: (m,) the node of each value.
        lower, upper: (m,) limits [rad or m]; equal where a value is held, infinite where it is an
            angle that can take every direction.
        is_angle: (m,) whether a value is an angle [rad], else a length [m].
        turns_around: (m,) whether it is an angle that can take every direction.
        packed: the tree as ``find_motions`` takes it.

    Args:
        tree: the pose tree.
    """

    def __init__(self, tree: PoseTree) -> None:
        self.tree = tree
        self.names = tuple(name for node in tree.nodes for name in node.value_names)
        counts = [len(node.value_names) for node in tree.nodes]
        self.value_nodes = np.repeat(np.arange(len(counts)), counts)
        bounds = [tree.value_bounds(i) for i in range(len(counts))]
        lower, upper = np.hstack([np.zeros((2, 0)), *bounds])
        self._middle = 0.5 * (lower + upper)
        self.turns_around = np.concatenate([tree.turns_around(i) for i in range(len(counts))])
        self.lower = np.where(self.turns_around, -np.inf, lower)
        self.upper = np.where(self.turns_around, np.inf, upper)
        kinds = [
            [tree.model.position_kinds[position] != "length" for position in node.positions]
            if node.positions
            else [True] * len(node.value_names)
            for node in tree.nodes
        ]
        self.is_angle = np.array([kind for group in kinds for kind in group], dtype=np.bool_)
        self.packed = _pack_tree(tree)
        self._moves = self._find_moves()

    def _find_moves(self) -> np.ndarray:
        """(nodes, m + 4) which nodes each value moves, and the root's shift and growth."""
        nodes = self.tree.nodes
        moves = np.zeros((len(nodes), len(self.names) + 4), dtype=np.bool_)
        for i, node in enumerate(nodes):
            if node.parent >= 0:
                moves[i] = moves[node.parent]
            moves[i, :-4] |= self.value_nodes == i
            moves[i, -4:] = i == 0 or (node.parent >= 0 and moves[node.parent, -1])
        return moves

    def flatten(self, node_values: Sequence[np.ndarray]) -> np.ndarray:
        """All values (m,) of each node's values (k_i,).

        Raises:
            SettingsError: values of the wrong number.
        """
        parts = [np.asarray(values, dtype=np.float64).reshape(-1) for values in node_values]
        wanted = [len(node.value_names) for node in self.tree.nodes]
        if [len(part) for part in parts] != wanted:
            raise SettingsError(f"values of {wanted} numbers a node expected")
        return np.concatenate(parts) if parts else np.zeros(0)

    def split(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Each node's values (k_i,) of all values (m,)."""
        return tuple(np.split(np.asarray(values), self.packed.value_starts[1:-1]))

    def nearest_turns(self, values: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """The same pose's values (m,), angles that turn around in the turn nearest to others.

        Args:
            values: all values [rad or m].
            near: (m,); None: where answers are given, about the default positions.
        """
        return nearest_turn(values, self._middle if near is None else near, self.turns_around)

    def within_limits(self, values: np.ndarray) -> np.ndarray:
        """The same pose's values (m,), angles that turn around less the turns beyond their limits.

        One that turns freely stays what it is.
        """
        limits = [self.tree.value_limits(i) for i in range(len(self.tree.nodes))]
        lower, upper = np.hstack([np.zeros((2, 0)), *limits])
        full = 2.0 * math.pi
        above = np.maximum(np.ceil((values - upper) / full), 0.0)
        below = np.maximum(np.ceil((lower - values) / full), 0.0)
        return np.where(self.turns_around, values - full * (above - below), values)

    def reach(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper ends (m,) of what values may be about those of a pose (m,).

        The limits, or half a turn either side of an angle that turns around.
        """
        lower = np.where(self.turns_around, values - math.pi, self.lower)
        return lower, np.where(self.turns_around, values + math.pi, self.upper)

    def poses(self, values: np.ndarray) -> np.ndarray:
        """X_WN (nodes, 4, 4) at values (m,)."""
        return self.motions(values).X_WN

    def motions(
        self, values: np.ndarray, *, translation: bool = False, scale: bool = False
    ) -> Motions:
        """Poses and motions at values (m,).

        Args:
            values: all values [rad or m].
            translation: add a shift of the first root and all behind it along the world's x, y, z.
            scale: add a uniform growth of these about the first root's origin (per unit).
        """
        values = np.ascontiguousarray(values, dtype=np.float64)
        if values.shape != (len(self.names),):
            raise SettingsError(f"{len(self.names)} values expected, got shape {values.shape}")
        X_WN, turns = find_motions(self.packed, values)
        count = len(values)
        added = 3 * translation + scale
        twists = np.zeros((count + added, 7))
        twists[:count, :6] = turns
        if translation:
            twists[count : count + 3, 3:6] = np.eye(3)
        if scale:
            twists[-1, 3:6], twists[-1, 6] = -X_WN[0, :3, 3], 1.0
        # A shift and growth move the same nodes.
        return Motions(X_WN, twists, self._moves[:, : count + added])


def _pack_tree(tree: PoseTree) -> PackedTree:
    """The tree in arrays."""
    X_PA, kinds, axes = [], [], []
    steps = [step for placement in tree.placements for step in placement.steps]
    for placement in tree.placements:
        X, kind, letters = np.array(placement.X_PA), _BY_JOINTS, [-1, -1, -1]
        rotation = placement.rotation
        if rotation is not None:
            X[:3, :3] = X[:3, :3] @ rotation.R_W0
            if rotation.kind == "free":
                kind = _FREE
            elif rotation.kind == "limited":
                kind = _LIMITED
                letters[: len(rotation.axes)] = ["xyz".index(axis) for axis in rotation.axes]
        X_PA.append(X)
        kinds.append(kind)
        axes.append(letters)
    rows = [len(step.joint_map.coefficients) for step in steps]
    counts = [len(node.value_names) for node in tree.nodes]
    return PackedTree(
        parents=np.array([node.parent for node in tree.nodes], dtype=np.int64),
        X_PA=np.array(X_PA),
        value_starts=np.cumsum([0, *counts]),
        kinds=np.array(kinds, dtype=np.int64),
        axes=np.array(axes, dtype=np.int64),
        step_starts=np.cumsum([0, *(len(one.steps) for one in tree.placements)]),
        inverted=np.array([step.inverted for step in steps], dtype=np.bool_),
        sizes=np.array([step.joint_map.position_count for step in steps], dtype=np.int64),
        coefficient_starts=np.cumsum([0, *rows])[:-1].astype(np.int64),
        coefficients=np.vstack(
            [np.zeros((0, 16)), *(step.joint_map.coefficients for step in steps)]
        ),
    )


@compiled
def _joint_transform(
    packed: PackedTree, step: int, values: np.ndarray, first: int, changed: int
) -> np.ndarray:
    """A joint's transform (4, 4), or its derivative by its position ``changed`` (-1: none)."""
    size = packed.sizes[step]
    begin = packed.coefficient_starts[step]
    X = np.zeros((4, 4))
    for row in range(4**size):
        product, rest = 1.0, row
        for k in range(size - 1, -1, -1):
            basis, rest = rest % 4, rest // 4
            q = values[first + k]
            if k == changed:
                if basis == 0:
                    product = 0.0
                elif basis == 1:
                    product *= -math.sin(q)
                elif basis == 2:
                    product *= math.cos(q)
            elif basis == 1:
                product *= math.cos(q)
            elif basis == 2:
                product *= math.sin(q)
            elif basis == 3:
                product *= q
        if product != 0.0:
            for i in range(3):
                for j in range(4):
                    X[i, j] += product * packed.coefficients[begin + row, 4 * i + j]
    if changed < 0:
        X[3, 3] = 1.0
    return X


@compiled
def _multiply(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """The product of two (4, 4)."""
    C = np.zeros((4, 4))
    for i in range(4):
        for j in range(4):
            for k in range(4):
                C[i, j] += A[i, k] * B[k, j]
    return C


@compiled
def _inverse(X: np.ndarray) -> np.ndarray:
    """The inverse of a rigid transform (4, 4)."""
    Y = np.zeros((4, 4))
    for i in range(3):
        for j in range(3):
            Y[i, j] = X[j, i]
            Y[i, 3] -= X[j, i] * X[j, 3]
    Y[3, 3] = 1.0
    return Y


@compiled
def _write_twist(X_WA: np.ndarray, M: np.ndarray, twist: np.ndarray) -> None:
    """Writes the world's twist (6,) of a twist matrix M (4, 4) in frame A."""
    w0, w1, w2 = M[2, 1], M[0, 2], M[1, 0]
    for i in range(3):
        twist[i] = X_WA[i, 0] * w0 + X_WA[i, 1] * w1 + X_WA[i, 2] * w2
        twist[3 + i] = X_WA[i, 0] * M[0, 3] + X_WA[i, 1] * M[1, 3] + X_WA[i, 2] * M[2, 3]
    p0, p1, p2 = X_WA[0, 3], X_WA[1, 3], X_WA[2, 3]
    twist[3] += p1 * twist[2] - p2 * twist[1]
    twist[4] += p2 * twist[0] - p0 * twist[2]
    twist[5] += p0 * twist[1] - p1 * twist[0]


@compiled
def _cross_matrix(x: float, y: float, z: float) -> np.ndarray:
    """The twist matrix (4, 4) of a turn about the origin."""
    M = np.zeros((4, 4))
    M[0, 1], M[0, 2], M[1, 2] = -z, y, -x
    M[1, 0], M[2, 0], M[2, 1] = z, -y, x
    return M


@compiled
def _turn_freely(X_WA: np.ndarray, r: np.ndarray, twists: np.ndarray) -> np.ndarray:
    """X_WA times the rotation of a vector (3,), and the twists (3, 6) of its components.

    The rotation is Rodrigues's formula, its derivative the left Jacobian of SO(3).
    """
    angle = math.sqrt(r[0] ** 2 + r[1] ** 2 + r[2] ** 2)
    if angle > 1e-4:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
        c = (1.0 - a) / angle**2
    else:
        a, b, c = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0
    K = _cross_matrix(r[0], r[1], r[2])
    KK = _multiply(K, K)
    X = np.eye(4)
    for i in range(3):
        for j in range(3):
            X[i, j] += a * K[i, j] + b * KK[i, j]
    for k in range(3):
        omega = np.zeros(3)
        omega[k] = 1.0
        for i in range(3):
            omega[i] += b * K[i, k] + c * KK[i, k]
        _write_twist(X_WA, _cross_matrix(omega[0], omega[1], omega[2]), twists[k])
    return _multiply(X_WA, X)


@compiled
def _turn_about_axis(X_WA: np.ndarray, axis: int, angle: float, twist: np.ndarray) -> np.ndarray:
    """X_WA times the rotation about one of its axes, and its twist (6,)."""
    e = np.zeros(3)
    e[axis] = 1.0
    _write_twist(X_WA, _cross_matrix(e[0], e[1], e[2]), twist)
    X = np.eye(4)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    X[i, i] = X[j, j] = math.cos(angle)
    X[j, i] = math.sin(angle)
    X[i, j] = -X[j, i]
    return _multiply(X_WA, X)


@compiled
def find_motions(packed: PackedTree, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns X_WN (n, 4, 4) and the twists (m, 6) of all values."""
    count = packed.parents.shape[0]
    X_WN = np.empty((count, 4, 4))
    twists = np.zeros((values.shape[0], 6))
    for node in range(count):
        X = packed.X_PA[node]
        if packed.parents[node] >= 0:
            X = _multiply(X_WN[packed.parents[node]], X)
        value = packed.value_starts[node]
        if packed.kinds[node] == _FREE:
            X = _turn_freely(X, values[value : value + 3], twists[value : value + 3])
            value += 3
        elif packed.kinds[node] == _LIMITED:
            for k in range(3):
                if packed.axes[node, k] >= 0:
                    X = _turn_about_axis(X, packed.axes[node, k], values[value], twists[value])
                    value += 1
        for step in range(packed.step_starts[node], packed.step_starts[node + 1]):
            T = _joint_transform(packed, step, values, value, -1)
            inverse = _inverse(T)
            for k in range(packed.sizes[step]):
                dT = _joint_transform(packed, step, values, value, k)
                M = -_multiply(inverse, dT) if packed.inverted[step] else _multiply(dT, inverse)
                _write_twist(X, M, twists[value + k])
            X = _multiply(X, inverse if packed.inverted[step] else T)
            value += packed.sizes[step]
        copy_into(X_WN[node], X)
    return X_WN, twists
