"""The pose tree: the rigid parts of an object, each placed by the values of a few joints.

After Kameda, Minoh, Ikeda (section 2), with any number of joints between two nodes. The pose of
node N in its parent P is

    X_PN = X_PA R(rotation values) T_1(values) T_2(values) ...

with X_PA a constant, R the rotation of a root, and T_k the transforms of the joints, which are
fitted to Drake's plant. A tree may start at any link; joints between the root and the world are
then inverted.
"""

import itertools
import math
import warnings
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
from drake_pose.body.parsed_model import ParsedModel, covers_full_turn, mimic_warnings, one_turn
from drake_pose.body.plant_source import Coupling
from drake_pose.body.root import BasePose, RootRotation, even_rotations
from drake_pose.errors import SettingsError, require_known


@dataclass(frozen=True, eq=False)
class PoseTreeNode:
    """One part of the object: a rigid surface, and a skin band that deforms with the node's values.

    Attributes:
        name: the link whose frame is the node's frame N.
        parent: index of the parent in ``PoseTree.nodes``; -1: the world.
        children: indices of the children.
        depth: number of edges to the root.
        positions: indices of the node's positions in the plant's q, in order from the parent to the
            node; () for a fixed node and for a root with a RootRotation.
        position_names: names of these positions.
        value_names: names of the node's values: its position names, or those of the RootRotation.
        mesh: the rigid surface in frame N, welded links included; empty where the link has no
            geometry and only joins several parts.
        skin: the band between the parent and the node; None: the model declares none.
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
        """Return the surface in frame N at values (k,): the rigid part, then the band."""
        if self.skin is None:
            return self.mesh
        bent = self.skin.vertices(np.asarray(values)[None])[0]
        return TriangleMesh(
            np.concatenate([self.mesh.vertices, bent]),
            np.concatenate([self.mesh.triangles, self.skin.triangles + len(self.mesh.vertices)]),
        )


@dataclass(frozen=True, eq=False)
class NodePlacement:
    """How values place a node: X_PN = X_PA R(rotation values) T_1(values) T_2(values) ...

    A node whose joints all follow its parent's joints has no values of its own.
    """

    X_PA: Array  # (4, 4) constant transform; the identity except for roots.
    rotation: RootRotation | None  # The rotation of a root; None: the node has none.
    steps: tuple[JointMap, ...]  # The joints from the parent to the node.
    # lower, upper: (k,) limits of the values [rad or m]; equal where a value is held, one turn wide
    # for an angle without limits.
    lower: Array
    upper: Array
    defaults: Array  # (k,) default values [rad or m].
    is_angle: NDArray[np.bool_]  # (k,) bool, whether a value is an angle; else a length.
    # (k,) bool, whether the value is an angle with the same pose after a full turn.
    periodic: NDArray[np.bool_]
    # (k,) bool, whether the value is an angle without limits, and not held.
    is_unlimited_angle: NDArray[np.bool_]
    # For each position of the steps: its index in q, the index of the parent's value that it
    # follows, multiplier and offset; (): the node has values of its own.
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
    """Return the placement of a node with positions in q, or of a root with a RootRotation.

    ``positions``: indices in q of the node's own positions; ignored if ``rotation`` is given.
    ``held``: values [rad or m] of positions that are not searched, by index in q. ``X_PA``,
    ``rotation``, ``steps``, ``follows``: as in ``NodePlacement``.
    """
    if rotation is not None:
        lower, upper = rotation.lower, rotation.upper
        all_true, all_false = np.full(len(lower), True), np.full(len(lower), False)
        limited = all_true if rotation.kind == "limited" else all_false
        middle = 0.5 * (lower + upper)
        return NodePlacement(
            X_PA, rotation, steps, lower, upper, middle, all_true, limited, all_false
        )
    index = list(positions)
    is_held = np.array([position in held for position in index], dtype=np.bool_)
    values = np.array([held.get(position, 0.0) for position in index])
    lower = np.where(is_held, values, model.lower[index])
    upper = np.where(is_held, values, model.upper[index])
    defaults = np.where(is_held, values, model.default_positions[index])
    is_angle = np.array([model.position_kinds[i] != "length" for i in index], dtype=np.bool_)
    free = model.is_unlimited_angle[index] & (lower < upper)
    periodic = model.periodic[index]
    properties = (lower, upper, defaults, is_angle, periodic, free)
    return NodePlacement(X_PA, None, steps, *properties, follows)


@dataclass(frozen=True, eq=False, repr=False)
class PoseTree:
    """All nodes of an object, parents before children. Immutable.

    Attributes:
        model: the model from which the tree was built.
        nodes: the nodes; their order depends on the model and the root only.
        leaves: indices of the nodes without children.
        held: values [rad or m] of positions that are not searched, by index in q.
        unobserved_positions: names of positions that move no visual geometry or that the root's
            pose replaces; they keep their default values.
        followers: couplings of the positions that follow searched positions.
        root: name of the root node; "world" if the plant's own roots are kept.
        placements: how each node is placed in its parent.
        assumed: names of slides without limits that keep their default values.
        _base: how the plant takes up the pose of the tree's root.
        _rebuild: returns the tree with the root's origin at a position (3,) in the world [m]; None:
            the tree was not made by ``pose_tree``.
    """

    model: ParsedModel
    nodes: tuple[PoseTreeNode, ...]
    leaves: tuple[int, ...]
    held: Mapping[int, float]
    unobserved_positions: tuple[str, ...]
    followers: tuple[Coupling, ...]
    root: str
    placements: tuple[NodePlacement, ...] = field(repr=False)
    assumed: tuple[str, ...]
    _base: BasePose = field(repr=False)
    _rebuild: "Callable[[Array], PoseTree] | None" = field(default=None, repr=False)

    def __repr__(self) -> str:
        """Return one line with the model and the number of nodes and values."""
        values = sum(len(node.value_names) for node in self.nodes)
        return f"<PoseTree of {self.model!r}: {len(self.nodes)} nodes, {values} values>"

    def __post_init__(self) -> None:
        """Make ``held`` read-only."""
        object.__setattr__(self, "held", MappingProxyType(dict(self.held)))

    @property
    def warnings(self) -> list[str]:
        """Warnings of positions that have no limits, or a single value between them."""
        model = self.model
        immobile = [
            model.position_names[position]
            for node in self.nodes
            for position in node.positions
            if model.lower[position] == model.upper[position]
        ]
        texts = {
            "these joints have no limits: they place the object in the world and keep their "
            "default values; a root position moves it, and a lower and an upper limit let them be "
            "searched": self.assumed,
            "the limits of these joints leave one value (widen them if they move), so they never "
            "move": immobile,
        }
        return [f"{text}: {', '.join(names)}" for text, names in texts.items() if names]

    @property
    def turns_root_freely(self) -> bool:
        """Whether the first root rotates freely, by a rotation vector."""
        rotation = self.placements[0].rotation
        return rotation is not None and rotation.kind == "free"

    @cached_property
    def subtrees(self) -> tuple[tuple[int, ...], ...]:
        """For each node, the ascending indices of the node and all its descendants."""
        below = [[i] for i in range(len(self.nodes))]
        for i in reversed(range(len(self.nodes))):
            below[i] += [j for child in self.nodes[i].children for j in below[child]]
        return tuple(tuple(sorted(nodes)) for nodes in below)

    def with_root_position(self, root_position: Array) -> "PoseTree":
        """Return the tree with the root's origin at another position (3,) in the world [m].

        Raises SettingsError: the tree has several roots, or was not made by ``pose_tree``;
        ModelError: the base joints cannot move the root there.
        """
        if self._rebuild is None:
            raise SettingsError("only a tree made by ArticulatedModel.pose_tree can be moved")
        return self._rebuild(root_position)

    def source(self, node: int) -> int:
        """Return the index of the node whose values place a node: itself, or a followed parent."""
        return self.nodes[node].parent if self.placements[node].follows else node

    def node_index(self, name: str) -> int:
        """Return the index of the node of a link; UnknownNameError if there is none."""
        names = [node.name for node in self.nodes]
        require_known("node", (name,), names, str(self.model.path))
        return names.index(name)

    def grid(self, node: int, interval: float, length_interval: float = 0.05) -> Array:
        """Return a node's sampling grid (n, k): every combination of its values' samples.

        A value is sampled by ``axis_samples``; a held value has one sample. The last value changes
        fastest.

        ``node``: index of the node. ``interval``: sampling interval of angles [rad].
        ``length_interval``: sampling interval of lengths [m].

        Raises SettingsError: an interval is not positive, or the grid is too large.
        """
        named = {"interval": interval, "length_interval": length_interval}
        for name, value in named.items():
            if not (np.isfinite(value) and value > 0.0):
                raise SettingsError(
                    f"sampling interval '{name}' is {value}: give a positive number"
                )
        placement = self.placements[node]
        rotation = placement.rotation
        if rotation is not None:
            interval = rotation.interval or interval
            if rotation.kind == "free":
                return even_rotations(interval)
        lower, upper = self.value_bounds(node)
        axes = []
        for k in range(len(lower)):
            spacing = interval if placement.is_angle[k] else length_interval
            is_angle = bool(placement.periodic[k])
            if lower[k] == upper[k]:
                axes.append([float(lower[k])])
            else:
                axes.append(axis_samples(lower[k], upper[k], spacing, is_angle=is_angle))
        return product_grid(axes, self.nodes[node].name)

    def value_bounds(self, node: int) -> tuple[Array, Array]:
        """Return the lower and upper search limits (k,), (k,) of a node's values [rad or m].

        An angle that can take every direction is searched over the turn about its default.
        """
        placement, around = self.placements[node], self.covers_full_turn(node)
        low, high = one_turn(placement.lower, placement.upper, placement.defaults)
        return np.where(around, low, placement.lower), np.where(around, high, placement.upper)

    def value_limits(self, node: int) -> tuple[Array, Array]:
        """Return a node's limits (k,), (k,) [rad or m]; equal if held, infinite without limits."""
        placement = self.placements[node]
        lower = np.where(placement.is_unlimited_angle, -np.inf, placement.lower)
        return lower, np.where(placement.is_unlimited_angle, np.inf, placement.upper)

    def covers_full_turn(self, node: int) -> NDArray[np.bool_]:
        """Return (k,) bool, whether each value of a node is an angle with a full turn or more."""
        placement = self.placements[node]
        return covers_full_turn(placement.lower, placement.upper, placement.periodic)

    def relative_transforms(self, node: int, values: Array) -> Array:
        """Return X_PN (n, 4, 4), the poses of the node of index ``node`` in its parent.

        A root's parent is the world. ``values``: (n, k) values of the node ``source(node)`` [rad or
        m].

        Raises SettingsError: the number of columns is wrong.
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
        """Return the positions (n, j) [rad or m] of all joints of the node of index ``node``.

        ``values``: (n, k) values of the node ``source(node)`` [rad or m].
        """
        if not self.placements[node].follows:
            return values
        _, columns, multipliers, offsets = zip(*self.placements[node].follows, strict=True)
        return np.asarray(values[:, list(columns)] * multipliers + offsets)

    def node_poses(self, values: Sequence[Array]) -> Array:
        """Return X_WN (nodes, 4, 4), given each node's values (k_i,) [rad or m]."""
        return self.node_poses_batch([np.asarray(v, dtype=np.float64)[None] for v in values])[0]

    def node_poses_batch(self, values: Sequence[Array]) -> Array:
        """Return X_WN (n, nodes, 4, 4), given each node's values (n, k_i) [rad or m].

        Raises SettingsError: the number of arrays or columns is wrong.
        """
        if len(values) != len(self.nodes):
            raise SettingsError(f"{len(self.nodes)} arrays of values expected, got {len(values)}")
        X_WN = np.empty((len(values[0]), len(self.nodes), 4, 4))
        for index, node in enumerate(self.nodes):
            X_PN = self.relative_transforms(index, values[self.source(index)])
            X_WN[:, index] = X_PN if node.parent < 0 else X_WN[:, node.parent] @ X_PN
        return X_WN

    def default_values(self) -> list[Array]:
        """Return each node's values (k_i,) at the model's default positions."""
        return [np.array(placement.defaults) for placement in self.placements]

    def positions_from(self, values: Sequence[Array]) -> tuple[Array, Array]:
        """Return the plant's positions that put every link where the tree puts it.

        ``values``: each node's values (k_i,) [rad or m].

        Returns q (nq,), and X_WB (4, 4), the pose of the plant's world frame B in the world W. X_WB
        is the identity where the plant's base joints can take up the root's pose.

        Raises ModelError: the base joints cannot reach the root's pose.
        """
        return self._base.solve(self.model, self._completed(values), self.node_poses(values))

    def positions_with_root_at(
        self, values: Sequence[Array], root_position: Array
    ) -> tuple[Array, Array]:
        """Return ``positions_from`` with the root's origin at ``root_position`` (3,) [m].

        ``values``: each node's values (k_i,) [rad or m]; those of slides that place the root are
        replaced. No new tree is built unless the plant's base is fixed or has such slides.
        """
        if self._base.kind == "constant":
            moved = self.with_root_position(root_position)
            placed = [
                np.array(
                    [moved.held.get(k, one) for k, one in zip(node.positions, own, strict=True)]
                )
                for node, own in zip(self.nodes, values, strict=True)
            ]
            return moved.positions_from(placed)
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
        """Return q (nq,) from each node's values (k_i,), held positions, followers and defaults."""
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
        """Return each node's values (k_i,) at the plant's q (nq,); inverse of ``positions_from``.

        Warn (UserWarning) of positions that do not follow others as the model's mimics say.

        ``X_WB``: (4, 4) pose of the plant's world frame, used for roots with a RootRotation only;
        None: the identity.
        """
        q = np.asarray(q, dtype=np.float64)
        model = self.model
        spans = model.upper - model.lower
        broken = mimic_warnings(model.position_names, self.model.couplings, q, spans)
        if broken:
            warnings.warn(broken[0], stacklevel=2)
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
    lower: float, upper: float, interval: float, *, is_angle: bool, max_samples: int = 5_000_000
) -> list[float]:
    """Return the multiples of ``interval`` inside the limits, sorted by magnitude, negative first.

    Where no multiple lies inside, the middle of the limits is the only sample. A full turn of an
    angle has each direction once.

    Args:
        lower, upper: limits [rad or m].
        interval: sampling interval [rad or m].
        is_angle: whether values a full turn apart are the same.
        max_samples: largest number of samples.

    Raises SettingsError: there would be more samples.
    """
    # A multiple that misses a limit by rounding only counts as inside.
    rounding = 1e-9
    first = math.ceil(lower / interval - rounding)
    last = math.floor(upper / interval + rounding)
    if is_angle and (last - first) * interval >= 2.0 * math.pi - rounding:
        first = last - math.ceil(2.0 * math.pi / interval - rounding) + 1
    if last < first:
        return [0.5 * (lower + upper)]
    if last - first >= max_samples:
        raise SettingsError(
            f"a sampling interval of {interval:g} makes {last - first + 1} samples of one joint, "
            f"at most {max_samples} are allowed: use a larger interval"
        )
    multiples = sorted(range(first, last + 1), key=lambda multiple: (abs(multiple), multiple))
    return [min(max(multiple * interval, lower), upper) for multiple in multiples]


def product_grid(axes: Sequence[Sequence[float]], node: str, max_samples: int = 5_000_000) -> Array:
    """Return all combinations (n, k) of the samples of k axes; the last axis changes fastest.

    Raises SettingsError, which names ``node``: there are more than ``max_samples`` combinations.
    """
    size = math.prod(len(axis) for axis in axes)
    if size > max_samples:
        raise SettingsError(
            f"node '{node}' would have {size} samples, at most {max_samples} are allowed: "
            "use a larger sampling interval or hold some of its joints"
        )
    return np.array(list(itertools.product(*axes)), dtype=np.float64).reshape(size, len(axes))


def require_tree(tree: object) -> None:
    """Raise SettingsError for an object that is no pose tree, such as a model."""
    if not isinstance(tree, PoseTree):
        what = f"a {type(tree).__name__}" + (f", '{tree.name}'" if hasattr(tree, "name") else "")
        raise SettingsError(f"a pose tree is needed, as model.pose_tree() returns, not {what}")
