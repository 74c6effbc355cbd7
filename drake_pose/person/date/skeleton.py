"""Skeleton of the paper's body model (Date et al., figure 5), read from an articulated model.

Head, neck base and trunk, with two arms and two legs of 3 + 1 rotations: 23 degrees of freedom.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.arrays import Array, Indices
from drake_pose.body import ArticulatedModel, TriangleMesh
from drake_pose.body.joint_kernel import PackedSteps
from drake_pose.body.tree_kinematics import PackedTree, TreeKinematics
from drake_pose.errors import ModelError

LIMBS = ("left_arm", "right_arm", "left_leg", "right_leg")
"""Names of the limbs."""

FEATURES = ("head", "left_hand", "right_hand", "left_foot", "right_foot")
"""Skin-coloured parts that are measured: the head, then the limbs' ends in the order of LIMBS."""


@dataclass(frozen=True, eq=False)
class Limb:
    """An arm or a leg."""

    name: str  # One of LIMBS.
    # upper_node, lower_node: indices of its segments' nodes in the pose tree.
    upper_node: int
    lower_node: int
    root_T: Array  # (3,) shoulder or hip in the trunk's frame [m].
    middle_U: Array  # (3,) elbow or knee in the upper segment's frame [m].
    end_L: Array  # (3,) middle of the hand or foot in the lower segment's frame [m].
    # (4,) axes of rotation, 0, 1, 2 for x, y, z: three at the root in order, one at the middle
    # joint.
    axes: Indices
    positions: Indices  # (4,) indices of their angles in q.
    # lower, upper: (4,) limits of the angles [rad].
    lower: Array
    upper: Array
    # (2,) mean distance of each segment's surface from the line of its joints [m].
    half_widths: Array

    @property
    def lengths(self) -> tuple[float, float]:
        """Distances from root to middle joint, and from middle joint to end [m]."""
        return float(np.linalg.norm(self.middle_U)), float(np.linalg.norm(self.end_L))

    @property
    def is_leg(self) -> bool:
        """Whether it is a leg."""
        return self.name.endswith("leg")

    @property
    def side(self) -> float:
        """1 on the left, -1 on the right."""
        return 1.0 if self.name.startswith("left") else -1.0


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A person's pose tree, with the quantities that the paper's method needs."""

    model: ArticulatedModel
    kinematics: TreeKinematics
    nodes: Mapping[str, int]  # Indices of the pose tree's nodes by name.
    face_H: Array  # (3,) middle of the head's surface in the head's frame [m].
    head_positions: Indices  # (3,) indices in q of the head's position.
    # head_angles, neck_angles: (2,) indices in q of the head's and of the neck base's angles.
    head_angles: Indices
    neck_angles: Indices
    order: Indices  # (m,) indices in q of the pose tree's values.
    # For each node: the chain of nodes from the root to it, packed, and the indices in q of the
    # chain's values.
    chains: Sequence[tuple[PackedTree, Indices]]
    limbs: Mapping[str, Limb]
    # lower, upper: (nq,) limits of q [rad, m].
    lower: Array
    upper: Array

    def poses(self, q: Array) -> Array:
        """Return the nodes' poses X_WN (nodes, 4, 4) at q (nq,)."""
        return self.kinematics.poses(q[self.order])

    def head_rotation(self, q: Array) -> Array:
        """Return the head's axes R_WH (3, 3) at q (nq,)."""
        return self.poses(q)[self.nodes["head"], :3, :3]

    def trunk_pose(self, q: Array) -> tuple[Array, Array]:
        """Return the trunk's axes R_WT (3, 3) and origin, the neck base (3,) [m], at q (nq,)."""
        X_WT = self.poses(q)[self.nodes["trunk"]]
        return np.ascontiguousarray(X_WT[:3, :3]), X_WT[:3, 3]

    def limb_points(self, q: Array, name: str) -> Array:
        """Return root, middle joint and end (3, 3) [m] of limb `name` in the world at q (nq,)."""
        limb, X_WN = self.limbs[name], self.poses(q)
        X_WL = X_WN[limb.lower_node]
        return np.array([X_WN[limb.upper_node, :3, 3], X_WL[:3, 3], _moved(X_WL, limb.end_L)])

    def features(self, q: Array) -> Array:
        """Return the positions (5, 3) of FEATURES in the world at q (nq,) [m]."""
        X_WN = self.poses(q)
        ends = [_moved(X_WN[limb.lower_node], limb.end_L) for limb in self.limbs.values()]
        return np.array([_moved(X_WN[self.nodes["head"]], self.face_H), *ends])

    @property
    def waist_T(self) -> Array:
        """Point half-way between the hips in the trunk's frame (3,) [m]."""
        return 0.5 * (self.limbs["left_leg"].root_T + self.limbs["right_leg"].root_T)

    def with_features(self, q: Array, places: Array, farthest: float = 0.05) -> "Skeleton":
        """Return the skeleton whose features are at places (5, 3), measured at q (nq,) [m].

        A feature moves by at most `farthest` [m]; nan: not measured, not moved.
        """
        off = np.nan_to_num(np.asarray(places) - self.features(q))
        length = np.linalg.norm(off, axis=1, keepdims=True)
        off *= np.minimum(1.0, farthest / np.maximum(length, 1e-12))
        R_WN = self.poses(q)[:, :3, :3]
        limbs = {
            name: replace(limb, end_L=limb.end_L + R_WN[limb.lower_node].T @ step)
            for (name, limb), step in zip(self.limbs.items(), off[1:], strict=True)
        }
        face_H = self.face_H + R_WN[self.nodes["head"]].T @ off[0]
        return replace(self, face_H=face_H, limbs=limbs)

    def clip(self, q: Array) -> Array:
        """Return q (nq,) clipped to the limits."""
        return np.clip(q, self.lower, self.upper)


def load_skeleton(model: ArticulatedModel) -> Skeleton:
    """Read the skeleton of a model that has the segments of the bundled person.

    Raises ModelError: a segment is missing or hangs on another one; the message names it.
    """
    kinematics = TreeKinematics(model.pose_tree())
    tree = kinematics.tree
    nodes = {node.name: index for index, node in enumerate(tree.nodes)}
    parts = {"arm": ("upper_arm", "forearm", "hand"), "leg": ("thigh", "shin", "foot")}
    segments, parents = {}, {"trunk": "head"}
    for name in LIMBS:
        side, kind = name.split("_")
        upper, lower, end = (f"{side}_{part}" for part in parts[kind])
        segments[name] = upper, lower, end
        parents |= {upper: "trunk", lower: upper}
    for name, parent in parents.items():
        if name not in nodes or tree.nodes[tree.nodes[nodes[name]].parent].name != parent:
            raise ModelError(
                f"{model.path}: Date's capture needs a body like urdf/person: '{name}' must hang "
                f"on '{parent}'; it has {', '.join(nodes)}"
            )
    head = tree.nodes[nodes["head"]]
    order = np.array([model.position_index(name) for name in kinematics.names])
    chains = [_chain(kinematics.packed, node) for node in range(len(nodes))]
    is_angle = [model.position_kinds[i] == "angle" for i in head.positions]
    return Skeleton(
        model=model,
        kinematics=kinematics,
        nodes=nodes,
        face_H=_middle(head.mesh),
        head_positions=np.array(head.positions)[np.invert(is_angle)],
        head_angles=np.array(head.positions)[is_angle],
        neck_angles=np.array(tree.nodes[nodes["trunk"]].positions),
        order=order,
        chains=[(packed, order[values]) for packed, values in chains],
        limbs={name: _limb(kinematics, nodes, name, *segments[name]) for name in LIMBS},
        lower=model.lower,
        upper=model.upper,
    )


def registered_positions(skeleton: Skeleton, spread_deg: float = 80.0) -> Array:
    """Return q (nq,) of the registered pose (3.1.1), arms spread by `spread_deg` within limits."""
    q = np.zeros(len(skeleton.lower))
    for name in LIMBS[:2]:
        limb = skeleton.limbs[name]
        q[limb.positions[1]] = limb.side * math.radians(spread_deg)
    return skeleton.clip(q)


def _chain(packed: PackedTree, node: int) -> tuple[PackedTree, Indices]:
    """Pack a node's chain from the root, and return its values' indices among the tree's, too."""
    path: list[int] = []
    while node >= 0:
        path, node = [node, *path], int(packed.parents[node])
    values, joints = (
        np.concatenate([np.arange(starts[n], starts[n + 1]) for n in path])
        for starts in (packed.value_starts, packed.step_starts)
    )
    sizes, inverted, starts, coefficients = packed.steps
    return PackedTree(
        parents=np.arange(len(path)) - 1,
        X_PA=packed.X_PA[path],
        value_starts=np.cumsum([0, *np.diff(packed.value_starts)[path]]),
        free=packed.free[path],
        step_starts=np.cumsum([0, *np.diff(packed.step_starts)[path]]),
        steps=PackedSteps(sizes[joints], inverted[joints], starts[joints], coefficients),
    ), values


def _limb(
    kinematics: TreeKinematics,
    nodes: Mapping[str, int],
    name: str,
    upper: str,
    lower: str,
    end: str,
) -> Limb:
    """Read a limb from its two segments and its end, which the lower segment carries.

    ``nodes``: indices of the tree's nodes by name. ``name``: one of LIMBS. ``upper``, ``lower``,
    ``end``: names of upper and lower segment and of the hand's or foot's link. Raises ModelError:
    positions or links are not those of a limb.
    """
    tree = kinematics.tree
    model = tree.model
    positions = [*tree.nodes[nodes[upper]].positions, *tree.nodes[nodes[lower]].positions]
    if len(positions) != 4:
        raise ModelError(f"{model.path}: '{upper}' and '{lower}' must have 3 + 1 positions")
    if end not in model.link_meshes:
        raise ModelError(f"{model.path}: there must be a link '{end}' with visual geometry")
    letters = [model.position_names[i].rsplit("_", 1)[-1] for i in positions]
    if not set(letters) <= set("xyz"):
        raise ModelError(
            f"{model.path}: '{upper}' must turn about joints whose names end with _x, _y or _z, "
            f"not {', '.join(model.position_names[i] for i in positions)}"
        )
    X_WN = kinematics.poses(np.zeros(len(kinematics.names)))
    trunk, first, second = X_WN[[nodes["trunk"], nodes[upper], nodes[lower]]]
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, np.zeros(len(model.position_names)))
    frame = model.plant.GetBodyByName(lower).body_frame()
    X_LE = model.plant.GetBodyByName(end).body_frame().CalcPose(context, frame).GetAsMatrix4()
    middle_U, end_L = _offset(first, second), _moved(X_LE, _middle(model.link_meshes[end]))
    half_widths = []
    for segment, along in ((upper, middle_U), (lower, end_L)):
        across = np.cross(model.link_meshes[segment].vertices, along / np.linalg.norm(along))
        half_widths.append(np.linalg.norm(across, axis=1).mean())
    return Limb(
        name=name,
        upper_node=nodes[upper],
        lower_node=nodes[lower],
        root_T=_offset(trunk, first),
        middle_U=middle_U,
        end_L=end_L,
        axes=np.array(["xyz".index(letter) for letter in letters]),
        positions=np.array(positions),
        lower=model.lower[positions],
        upper=model.upper[positions],
        half_widths=np.array(half_widths),
    )


def _moved(X_AB: Array, p_B: Array) -> Array:
    """Return a point p_B (3,), given in frame B, in frame A (3,)."""
    return np.asarray(X_AB[:3, :3] @ p_B + X_AB[:3, 3])


def _offset(X_WA: Array, X_WB: Array) -> Array:
    """Return the origin of frame B in frame A (3,), from the poses (4, 4) of both."""
    return np.asarray(X_WA[:3, :3].T @ (X_WB[:3, 3] - X_WA[:3, 3]))


def _middle(mesh: TriangleMesh) -> Array:
    """Return the centroid (3,) of a surface."""
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    middles, area = (a + b + c) / 3.0, np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.asarray((area[:, None] * middles).sum(axis=0) / area.sum())
