"""The pose tree: the rigid parts of an object, each placed by its own few joint values.

After Kameda, Minoh, Ikeda (section 2), with any number of positions of any joints to a node; the
tree may start at any link, and its nodes' transforms come from Drake's plant.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array
from drake_pose.body.link_graph import JointMap, PlantKinematics, chain_transforms
from drake_pose.body.meshes import TriangleMesh
from drake_pose.body.node_skin import NodeSkin
from drake_pose.body.parsed_model import ParsedModel, one_turn, turns_around
from drake_pose.body.plant_source import Coupling
from drake_pose.body.root import BasePose, RootRotation, even_rotations
from drake_pose.errors import SettingsError, UnknownNameError


@dataclass(frozen=True, eq=False)
class PoseTreeNode:
    """One part of the object: a rigid surface, and a band that bends with its values.

    Attributes:
        name: the link that carries the geometry; its frame is the node's frame N.
        parent, children: indices in ``PoseTree.nodes``; a parent of -1 is the world.
        depth: steps to the root; a root has 0.
        positions: indices into the plant's q, in order of rotation from the parent to the node; ()
            for a fixed node and for a root that is turned by a RootRotation.
        value_names: the names of the node's values: its position names, or those of the
            RootRotation.
        mesh: the rigid part in frame N, welded links included; empty where several parts hang on
            a link that is not seen.
        skin: the band between the parent and the node; None where the model declares none.
    """

    name: str
    parent: int
    depth: int
    children: tuple[int, ...]
    positions: tuple[int, ...]
    position_names: tuple[str, ...]
    value_names: tuple[str, ...]
    mesh: TriangleMesh
    skin: NodeSkin | None = None

    def surface(self, values: Array) -> TriangleMesh:
        """The node's whole surface in frame N at its values (k,): the rigid part, then the band."""
        if self.skin is None:
            return self.mesh
        bent = self.skin.vertices(np.asarray(values)[None])[0]
        return TriangleMesh(
            np.concatenate([self.mesh.vertices, bent]),
            np.concatenate([self.mesh.triangles, self.skin.triangles + len(self.mesh.vertices)]),
        )


@dataclass(frozen=True, eq=False)
class NodePlacement:
    """How a node's values place it: X_PN = X_PA R(rotation values) step(values) step(values) ...

    A node whose joints follow its parent's has no values of its own.

    Attributes:
        X_PA: (4, 4), the identity but for roots.
        rotation: turns a root that has a RootRotation.
        lower, upper: (k,) limits of the values [rad or m], equal where held, one turn where free.
        defaults: (k,) [rad or m].
        is_angle: (k,) bool, angles, else lengths.
        periodic: (k,) bool, angles that look the same after a full turn.
        turns_freely: (k,) bool, angles without limits that are searched.
        follows: for each value of the steps its position in q, which of the parent's values it
            follows, and how; (): the node has values of its own.
    """

    X_PA: Array
    rotation: RootRotation | None
    steps: tuple[JointMap, ...]
    lower: Array
    upper: Array
    defaults: Array
    is_angle: NDArray[np.bool_]
    periodic: NDArray[np.bool_]
    turns_freely: NDArray[np.bool_]
    follows: tuple[Coupling, ...] = ()


def place_node(
    model: ParsedModel,
    positions: Sequence[int],
    held: Mapping[int, float],
    X_PA: Array,
    rotation: RootRotation | None,
    steps: tuple[JointMap, ...],
    follows: tuple[Coupling, ...] = (),
) -> NodePlacement:
    """The placement of a node with these positions in q, or of a root that a rotation turns."""
    if rotation is not None:
        lower, upper = rotation.lower, rotation.upper
        every, none = np.full(len(lower), True), np.full(len(lower), False)
        limited = every if rotation.kind == "limited" else none
        middle = 0.5 * (lower + upper)
        return NodePlacement(X_PA, rotation, steps, lower, upper, middle, every, limited, none)
    index = list(positions)
    known = np.array([position in held for position in index], dtype=np.bool_)
    values = np.array([held.get(position, 0.0) for position in index])
    lower = np.where(known, values, model.lower[index])
    upper = np.where(known, values, model.upper[index])
    defaults = np.where(known, values, model.default_positions[index])
    is_angle = np.array([model.position_kinds[i] != "length" for i in index], dtype=np.bool_)
    free = model.turns_freely[index] & (lower < upper)
    periodic = model.periodic[index]
    told = (lower, upper, defaults, is_angle, periodic, free)
    return NodePlacement(X_PA, None, steps, *told, follows)


@dataclass(frozen=True, eq=False, repr=False)
class PoseTree:
    """All nodes of an object, parents before children. Never changes.

    Attributes:
        nodes: the nodes; the order depends on the model and the root alone.
        leaves: indices of the nodes without children.
        held: values of positions that are not searched, by index into q.
        unobserved_positions: names of positions that move nothing that is seen, or that the root's
            pose replaces; they keep their default values.
        followers: the positions that follow those that are searched.
        root: name of the root node; "world" where the plant's own roots are kept.
    """

    model: ParsedModel
    nodes: tuple[PoseTreeNode, ...]
    leaves: tuple[int, ...]
    held: Mapping[int, float]
    unobserved_positions: tuple[str, ...]
    followers: tuple[Coupling, ...]
    root: str
    placements: tuple[NodePlacement, ...] = field(repr=False)
    _base: BasePose = field(repr=False)
    _rebuild: "Callable[[Array], PoseTree] | None" = field(default=None, repr=False)

    def __repr__(self) -> str:
        """One line: whose it is, and how large."""
        values = sum(len(node.value_names) for node in self.nodes)
        return f"<PoseTree of {self.model!r}: {len(self.nodes)} nodes, {values} values>"

    def __post_init__(self) -> None:
        """Freeze the mapping."""
        object.__setattr__(self, "held", MappingProxyType(dict(self.held)))

    @property
    def turns_root_freely(self) -> bool:
        """Whether the first root is turned by a rotation vector, in all ways."""
        rotation = self.placements[0].rotation
        return rotation is not None and rotation.kind == "free"

    @cached_property
    def subtrees(self) -> tuple[tuple[int, ...], ...]:
        """For each node itself and all that hang on it, rising."""
        below = [[i] for i in range(len(self.nodes))]
        for i in reversed(range(len(self.nodes))):
            below[i] += [j for child in self.nodes[i].children for j in below[child]]
        return tuple(tuple(sorted(nodes)) for nodes in below)

    def with_root_position(self, root_position: Array) -> "PoseTree":
        """The same tree with the root's origin at another known position (3,) [m].

        Raises SettingsError where there is no single root, ModelError where base joints forbid it.
        """
        if self._rebuild is None:
            raise SettingsError("only a tree made by ArticulatedModel.pose_tree can be moved")
        return self._rebuild(root_position)

    def source(self, node: int) -> int:
        """The node whose values place a node: itself, or its parent where its joints follow."""
        return self.nodes[node].parent if self.placements[node].follows else node

    def node_index(self, name: str) -> int:
        """The node of a link; UnknownNameError where no node has that name."""
        names = [node.name for node in self.nodes]
        if name not in names:
            raise UnknownNameError("node", name, names, str(self.model.path))
        return names.index(name)

    def grid(
        self,
        node: int,
        interval: float,
        intervals: Mapping[str, float] | None = None,
        length_interval: float = 0.05,
    ) -> Array:
        """The node's sampling grid (n, k): every combination of its positions' samples.

        A position is sampled as in ``axis_samples``, at its one value where it is held; the last
        position changes fastest.

        Args:
            interval: for angles [rad].
            intervals: intervals of single positions or root values, by name [rad or m].
            length_interval: for lengths [m].

        Raises:
            SettingsError: an interval that is not positive, or a grid that is too large.
            UnknownNameError: ``intervals`` names something that does not exist.
        """
        intervals = intervals or {}
        known = [name for node in self.nodes for name in node.value_names]
        known += [name for name in self.model.position_names if name not in known]
        for name in intervals:
            if name not in known:
                raise UnknownNameError("joint", name, known, str(self.model.path))
        named = {"interval": interval, "length_interval": length_interval, **intervals}
        for name, value in named.items():
            if not (np.isfinite(value) and value > 0.0):
                raise SettingsError(
                    f"sampling interval '{name}' is {value}: give a positive number"
                )
        placement, names = self.placements[node], self.nodes[node].value_names
        rotation = placement.rotation
        if rotation is not None:
            interval = rotation.interval or interval
            if rotation.kind == "free":
                return even_rotations(interval)
        lower, upper = self.value_bounds(node)
        axes = []
        for k, name in enumerate(names):
            spacing = intervals.get(name, interval if placement.is_angle[k] else length_interval)
            is_angle = bool(placement.periodic[k])
            if lower[k] == upper[k]:
                axes.append([float(lower[k])])
            else:
                axes.append(axis_samples(lower[k], upper[k], spacing, is_angle=is_angle))
        return product_grid(axes, self.nodes[node].name)

    def value_bounds(self, node: int) -> tuple[Array, Array]:
        """Limits (k,) for the search [rad or m], or one turn about the default position."""
        given, around = self.placements[node], self.turns_around(node)
        low, high = one_turn(given.lower, given.upper, given.defaults)
        return np.where(around, low, given.lower), np.where(around, high, given.upper)

    def value_limits(self, node: int) -> tuple[Array, Array]:
        """Limits (k,) of a node's values [rad or m]; equal where held, infinite where free."""
        given = self.placements[node]
        lower = np.where(given.turns_freely, -np.inf, given.lower)
        return lower, np.where(given.turns_freely, np.inf, given.upper)

    def turns_around(self, node: int) -> NDArray[np.bool_]:
        """Which of a node's values (k,) are periodic angles whose limits leave every direction."""
        given = self.placements[node]
        return turns_around(given.lower, given.upper, given.periodic)

    def relative_transforms(self, node: int, values: Array) -> Array:
        """X_PN (n, 4, 4) in the parent (or W) at values (n, k) of the node that is its source.

        Raises SettingsError for a wrong width.
        """
        values = np.asarray(values, dtype=np.float64)
        names = self.nodes[self.source(node)].value_names
        if values.ndim != 2 or values.shape[1] != len(names):
            raise SettingsError(
                f"node '{self.nodes[node].name}': values of shape (n, {len(names)}) expected for "
                f"{names}, got {values.shape}"
            )
        placement = self.placements[node]
        X = np.broadcast_to(placement.X_PA, (len(values), 4, 4)).copy()
        if placement.rotation is not None:
            X[:, :3, :3] = X[:, :3, :3] @ placement.rotation.rotations(values)
        if placement.steps:
            X = X @ chain_transforms(placement.steps, self.step_values(node, values))
        return X

    def step_values(self, node: int, values: Array) -> Array:
        """Of a node's joints (n, j), at values (n, k) of the node that is its source."""
        if not self.placements[node].follows:
            return values
        _, columns, multipliers, offsets = zip(*self.placements[node].follows, strict=True)
        return np.asarray(values[:, list(columns)] * multipliers + offsets)

    def node_poses(self, values: Sequence[Array]) -> Array:
        """X_WN (n_nodes, 4, 4), given each node's values (k_i,)."""
        return self.node_poses_batch([np.asarray(v, dtype=np.float64)[None] for v in values])[0]

    def node_poses_batch(self, values: Sequence[Array]) -> Array:
        """X_WN (n, n_nodes, 4, 4) at each node's (n, k_i); SettingsError for a wrong width."""
        if len(values) != len(self.nodes):
            raise SettingsError(f"{len(self.nodes)} arrays of values expected, got {len(values)}")
        X_WN = np.empty((len(values[0]), len(self.nodes), 4, 4))
        for index, node in enumerate(self.nodes):
            X_PN = self.relative_transforms(index, values[self.source(index)])
            X_WN[:, index] = X_PN if node.parent < 0 else X_WN[:, node.parent] @ X_PN
        return X_WN

    def default_values(self) -> list[Array]:
        """Each node's values (k_i,) at the model's default positions and the root as given."""
        return [np.array(placement.defaults) for placement in self.placements]

    def positions_from(self, values: Sequence[Array]) -> tuple[Array, Array]:
        """The plant's own positions that put every link where the tree does at each node's (k_i,).

        Returns:
            q (nq,) and X_WB (4, 4), the pose of the plant's world frame B in the world W; X_WB is
            the identity where the plant's base joint can take up the root's pose.

        Raises ModelError: the base joints cannot be solved for.
        """
        return self._base.solve(self.model, self._completed(values), self.node_poses(values))

    def positions_with_root_at(
        self, values: Sequence[Array], root_position: Array
    ) -> tuple[Array, Array]:
        """As with_root_position at (3,) [m] and positions_from, but no tree is built."""
        if self._base.kind == "constant":
            return self.with_root_position(root_position).positions_from(values)
        X_WN = self.node_poses(values)
        shift = root_position - X_WN[0, :3, 3]
        for index in range(len(self.nodes)):
            top = index
            while self.nodes[top].parent >= 0:
                top = self.nodes[top].parent
            if top == 0:
                X_WN[index, :3, 3] += shift
        return self._base.solve(self.model, self._completed(values), X_WN)

    def _completed(self, values: Sequence[Array]) -> Array:
        """The plant's positions (nq,) as far as the values and what is held tell them."""
        q = np.array(self.model.default_positions)
        for index, value in self.held.items():
            q[index] = value
        for node, node_values in zip(self.nodes, values, strict=True):
            if node.positions:
                q[list(node.positions)] = node_values
        for follower, leader, multiplier, offset in self.followers:
            q[follower] = multiplier * q[leader] + offset
        return q

    def values_from_positions(self, q: Array, X_WB: Array | None = None) -> list[Array]:
        """Each node's values (k_i,) at the plant's q (nq,): the inverse of positions_from.

        X_WB (4, 4), the pose of the plant's world frame, moves a root with a RootRotation alone.
        """
        q = np.asarray(q, dtype=np.float64)
        values = []
        for node, placement in zip(self.nodes, self.placements, strict=True):
            if placement.rotation is None:
                values.append(q[list(node.positions)])
                continue
            body = self.model.link_index(node.name)
            R_BN = PlantKinematics(self.model).pose_at(body, q)[:3, :3]
            R_WN = R_BN if X_WB is None else X_WB[:3, :3] @ R_BN
            values.append(placement.rotation.values_from(R_WN))
        return values


def axis_samples(
    lower: float, upper: float, interval: float, *, is_angle: bool, most: int = 5_000_000
) -> list[float]:
    """The multiples of the interval inside the limits, by size, the negative of two equals first.

    The middle of the finite limits [rad or m] where no multiple lies inside. A full turn of an
    angle gives each direction once. Raises SettingsError for more samples than ``most``.
    """
    # A multiple that misses a limit by rounding alone still counts as inside.
    rounding = 1e-9
    first = math.ceil(lower / interval - rounding)
    last = math.floor(upper / interval + rounding)
    if is_angle and (last - first) * interval >= 2.0 * math.pi - rounding:
        first = last - math.ceil(2.0 * math.pi / interval - rounding) + 1
    if last < first:
        return [0.5 * (lower + upper)]
    if last - first >= most:
        raise SettingsError(
            f"a sampling interval of {interval:g} makes {last - first + 1} samples of one joint, "
            f"at most {most} are allowed: use a larger interval"
        )
    multiples = sorted(range(first, last + 1), key=lambda multiple: (abs(multiple), multiple))
    return [min(max(multiple * interval, lower), upper) for multiple in multiples]


def product_grid(axes: Sequence[Sequence[float]], node: str, most: int = 5_000_000) -> Array:
    """All combinations (n, k) of the axes' samples, the last axis changing fastest.

    Raises SettingsError, which names the node, for more of them than ``most``.
    """
    size = math.prod(len(axis) for axis in axes)
    if size > most:
        raise SettingsError(
            f"node '{node}' would have {size} samples, at most {most} are allowed: "
            "use a larger sampling interval or hold some of its joints"
        )
    return np.array(list(itertools.product(*axes)), dtype=np.float64).reshape(size, len(axes))


def require_tree(tree: object) -> None:
    """Refuses, by a SettingsError, what is no pose tree: most often the model that has one."""
    if not isinstance(tree, PoseTree):
        what = f"a {type(tree).__name__}" + (f", '{tree.name}'" if hasattr(tree, "name") else "")
        raise SettingsError(f"a pose tree is needed, as model.pose_tree() gives it, not {what}")
