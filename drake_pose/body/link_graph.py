"""The graph of welded link groups and joints, from which trees with any root are built.

Each entry of the transform X_AC of a supported joint is a multilinear function of the basis (1, cos
q, sin q, q) of each of its positions q. Poses of the plant at four values of each position
therefore determine the transform for all values.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.tree import BodyIndex, Joint, RigidBody

from drake_pose.arrays import Array
from drake_pose.body.meshes import TriangleMesh, join_meshes
from drake_pose.body.parsed_model import FLOATING_TYPES, ParsedModel
from drake_pose.errors import ModelError


def inverse_transforms(X: Array) -> Array:
    """Return the inverses of rigid transforms (..., 4, 4)."""
    inverse = np.zeros_like(X)
    R_transposed = np.swapaxes(X[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = R_transposed
    inverse[..., :3, 3] = -(R_transposed @ X[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


@dataclass(frozen=True)
class JointMap:
    """The pose X_AC(q) of a joint's outer link frame C in its inner link frame A."""

    # (4^k, 16), one row of X_AC's entries for each product of basis functions of the k positions;
    # the last position's function changes fastest.
    coefficients: Array
    position_count: int  # Number of positions k.
    inverted: bool = False  # Whether a chain traverses the joint inwards, from C to A.

    @staticmethod
    def measure(pose: Callable[[Array], Array], position_count: int, name: str) -> "JointMap":
        """Fit the map to poses of the plant.

        ``pose``: returns X_AC (4, 4) of the plant at values (k,) [rad or m]. ``position_count``:
        number of positions k, at most three. ``name``: the joint's name, for messages. Raises
        ModelError: the joint does not move as a combination of the basis functions.
        """
        nodes = np.array([0.0, np.pi / 2.0, np.pi, -np.pi / 2.0])
        samples = np.array(list(itertools.product(nodes, repeat=position_count)))
        samples = samples.reshape(-1, position_count)
        measured = np.array([pose(values).reshape(16) for values in samples])
        inverse = np.linalg.inv(_basis(nodes))
        kronecker: NDArray[Any] = np.eye(1)
        for _ in range(position_count):
            kronecker = np.kron(kronecker, inverse)
        joint_map = JointMap(kronecker @ measured, position_count)
        probe = np.array([0.7, -1.1, 2.3])[:position_count]
        error = np.abs(joint_map.transforms(probe[None])[0] - pose(probe)).max()
        if error > 1e-9:
            raise ModelError(f"joint '{name}' moves in a way that is not supported")
        return joint_map

    def transforms(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return X_AC (n, 4, 4) at values (n, k) [rad or m], which may be complex.

        The result is not inverted, whether or not ``inverted`` is set.
        """
        products = np.ones((len(values), 1))
        for column in range(self.position_count):
            basis = _basis(values[:, column])
            products = (products[:, :, None] * basis[:, None, :]).reshape(len(values), -1)
        X = (products @ self.coefficients).reshape(-1, 4, 4)
        X[:, 3] = (0.0, 0.0, 0.0, 1.0)
        return X


def chain_transforms(steps: Sequence[JointMap], values: NDArray[Any]) -> NDArray[Any]:
    """Return the transforms (n, 4, 4) along a chain of joints, from its first frame to its last.

    ``values``: (n, k) positions [rad or m] of all joints, one joint after another. They may be
    complex, for derivatives by complex steps.
    """
    X: NDArray[Any] = np.broadcast_to(np.eye(4), (len(values), 4, 4))
    start = 0
    for step in steps:
        stop = start + step.position_count
        X_step = step.transforms(values[:, start:stop])
        X = X @ (inverse_transforms(X_step) if step.inverted else X_step)
        start = stop
    return X


def _basis(values: NDArray[Any]) -> NDArray[Any]:
    """Return the basis functions (n, 4) of values (n,): 1, cos q, sin q, q."""
    return np.stack([np.ones_like(values), np.cos(values), np.sin(values), values], axis=-1)


@dataclass(frozen=True)
class LinkGroup:
    """Links welded to each other, the one nearest to the world first."""

    name: str  # The link whose frame is the group's frame.
    links: tuple[str, ...]  # Names of all links of the group.
    body: int  # Index of the named link among the plant's bodies.
    mesh: TriangleMesh  # The visual geometry of all links in the group's frame.


@dataclass(frozen=True)
class JointEdge:
    """A joint between two groups."""

    joint: int  # Index of the joint in the plant.
    inner: int  # Index of the group nearer to the world.
    outer: int  # Index of the group farther from the world.
    positions: tuple[int, ...]  # Indices of the joint's positions in q.
    # The pose of the outer group in the inner one; None for a floating joint.
    joint_map: JointMap | None

    def other(self, group: int) -> int:
        """Return the index of the group at the other end than the group of index ``group``."""
        return self.inner if group == self.outer else self.outer


@dataclass(frozen=True)
class LinkGraph:
    """All link groups and the joints between them, which form a tree."""

    groups: tuple[LinkGroup, ...]  # The groups; group 0 holds the world.
    edges: tuple[JointEdge, ...]  # The joints that are not welds, outwards from the world.

    def group_of(self, link: str) -> int:
        """Return the index of the group that a link belongs to; the link must exist."""
        return next(index for index, group in enumerate(self.groups) if link in group.links)

    def has_geometry(self, group: int) -> bool:
        """Whether a group has visual geometry."""
        return not self.groups[group].mesh.is_empty

    def edges_at(self, group: int) -> list[JointEdge]:
        """Return the edges that touch a group."""
        return [edge for edge in self.edges if group in (edge.inner, edge.outer)]


class PlantKinematics:
    """Forward kinematics of a model's plant, in its own context; ``body`` is a body's index."""

    def __init__(self, model: ParsedModel) -> None:
        """Start at the model's default positions."""
        self.plant = model.plant
        self.context = model.plant.CreateDefaultContext()
        self._defaults = model.default_positions

    def pose(self, body: int, positions: Mapping[int, float] | None = None) -> Array:
        """Return the pose (4, 4) of a body in the plant's world frame at the default positions.

        ``positions``: values [rad or m] by index in q that replace defaults; None: none.
        """
        q = np.array(self._defaults)
        for index, value in (positions or {}).items():
            q[index] = value
        return self.pose_at(body, q)

    def pose_at(self, body: int, q: Array) -> Array:
        """Return the pose (4, 4) of a body in the plant's world frame at q (nq,)."""
        positions: Any = q  # Drake's type stubs do not accept numpy's array type.
        self.plant.SetPositions(self.context, positions)
        X = self.plant.EvalBodyPoseInWorld(self.context, self.plant.get_body(BodyIndex(body)))
        return np.asarray(X.GetAsMatrix4())


def build_link_graph(model: ParsedModel, preferred_frame: str | None) -> LinkGraph:
    """Build the graph by traversing the plant outwards from the world.

    ``model``: the model whose plant is traversed. ``preferred_frame``: a link whose frame its group
    takes; None: each group takes the frame of its first link with geometry. Raises ModelError: the
    joints form a loop.
    """
    plant = model.plant
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    touching: dict[int, list[tuple[Joint, RigidBody]]] = {}
    for joint in joints:
        parent, child = joint.parent_body(), joint.child_body()
        touching.setdefault(int(parent.index()), []).append((joint, child))
        touching.setdefault(int(child.index()), []).append((joint, parent))
    group_of_body = {0: 0}
    members: list[list[int]] = [[0]]
    found: list[tuple[Joint, int, int]] = []
    used: set[int] = set()
    queue = [0]
    for body in queue:
        for joint, other in touching.get(body, []):
            if int(joint.index()) in used:
                continue
            used.add(int(joint.index()))
            far = int(other.index())
            if far in group_of_body:
                raise ModelError(f"{model.path}: joint '{joint.name()}' closes a loop of links")
            if joint.num_positions() == 0:
                group_of_body[far] = group_of_body[body]
                members[group_of_body[body]].append(far)
            else:
                group_of_body[far] = len(members)
                members.append([far])
                found.append((joint, group_of_body[body], group_of_body[far]))
            queue.append(far)
    kinematics, groups = PlantKinematics(model), list[LinkGroup]()
    for bodies in members:
        # The meshes of welded bodies are joined in one frame.
        links = tuple(model.link_names[body] for body in bodies)
        with_geometry = [name for name in links if name in model.link_meshes]
        frame = (with_geometry or links)[0]
        if preferred_frame is not None and preferred_frame in links:
            frame = preferred_frame
        body = bodies[links.index(frame)]
        X_NB = inverse_transforms(kinematics.pose(body))
        meshes = [
            model.link_meshes[name]
            if own == body
            else model.link_meshes[name].transformed(X_NB @ kinematics.pose(own))
            for name, own in zip(links, bodies, strict=True)
            if name in model.link_meshes
        ]
        groups.append(LinkGroup(frame, links, body, join_meshes(meshes)))
    edges = tuple(
        _make_edge(kinematics, groups, joint, inner, outer) for joint, inner, outer in found
    )
    return LinkGraph(tuple(groups), edges)


def _make_edge(
    kinematics: PlantKinematics, groups: Sequence[LinkGroup], joint: Joint, inner: int, outer: int
) -> JointEdge:
    """Return the edge of one joint, with its map fitted to the plant.

    ``inner`` and ``outer`` are the indices in ``groups``, all groups of the graph, of the joint's
    two groups. A floating joint has no map.
    """
    start, count = joint.position_start(), joint.num_positions()
    positions = tuple(range(start, start + count))
    if joint.type_name() in FLOATING_TYPES:
        return JointEdge(int(joint.index()), inner, outer, positions, None)

    def pose(values: Array) -> Array:
        """Return the outer group's pose (4, 4) in the inner group at the joint's values."""
        given = dict(zip(positions, values, strict=True))
        X_BA = kinematics.pose(groups[inner].body, given)
        return inverse_transforms(X_BA) @ kinematics.pose(groups[outer].body, given)

    joint_map = JointMap.measure(pose, count, joint.name())
    return JointEdge(int(joint.index()), inner, outer, positions, joint_map)
