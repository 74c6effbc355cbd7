"""All that may be unknown of a frame, and how each parameter moves the nodes of a body.

The motion that a parameter gives to a node is affine: dp_W = M p_W + v, 12 numbers, the rows of
(M v) one after another. A camera that moves, or whose focal length changes, moves all nodes the
other way, in its own picture alone.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Indices
from drake_pose.body import TARGET_POSITIONS, PoseTree, chain_transforms
from drake_pose.body.tree_kinematics import LinkVector, TreeKinematics, link_vectors
from drake_pose.camera.models import Camera
from drake_pose.compiled import compiled
from drake_pose.silhouette.outline import (
    Outline,
    PackedOutlines,
    PackedSurfaces,
    TreeSurfaces,
    pack,
)

ROOT_NAMES = ("root_shift_x", "root_shift_y", "root_shift_z", "log_scale")
"""The shift of the first root along the world's axes [m], and the logarithm of the growth of it and
all behind it about its origin."""

RADIUS_SCALE_PREFIX = "log_girth_"
"""Begins the names of radius_scales: the logarithm of how wide a part is across its y axis."""

POSE_NAMES = ("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z")
"""The rotation vector [rad] by which, and the shift [m] along its axes by which a camera sees
everything moved about its pivot."""

CAMERA_NAMES = (*POSE_NAMES, "log_focal", "center_x", "center_y")
"""A camera's parameters: POSE_NAMES, the logarithm of its focal length's growth, or of a parallel
camera's scale, and by how much its principal point is shifted [pixel]."""


class Placement(NamedTuple):
    """A body at some parameters, as the kernels take it.

    packed: its surfaces; X_WN: (nodes, 4, 4); motions: (k, 12) affine motions; starts: (nodes + 1,)
    which of owners are those of each node; owners: (s,) motions, node after node; parameters: (s,)
    the parameter that makes each.
    """

    packed: PackedOutlines
    X_WN: Array
    motions: Array
    starts: Indices
    owners: Indices
    parameters: Indices

    def dense(self, size: int) -> Array:
        """(nodes, size, 12) the affine motions that all parameters give to each node."""
        motions = np.zeros((len(self.X_WN), size, 12))
        nodes = np.repeat(np.arange(len(self.X_WN)), np.diff(self.starts))
        # Adding in place is slow, and only what is led by another parameter's joint needs it.
        led = self.owners != self.parameters
        own = nodes[~led], self.parameters[~led]
        motions[own] = self.motions[self.owners[~led]]
        np.add.at(motions, (nodes[led], self.parameters[led]), self.motions[self.owners[led]])
        return motions


class BodyParameters:
    """A body's parameters.

    They are its tree's values, ROOT_NAMES, the logarithms of its radius scales, and the logarithms
    of its links' scales. A scaled link carries its joints farther from its own joint, along their
    offsets; its surface stays as it is, and all behind such a joint is shifted.

    Attributes:
        kinematics: the pose tree's.
        outlines: a surface for each node.
        groups: (nodes,) which radius scale each node has, or -1.
        links: the links with a scale, in the order of their parameters.
        names: of the n parameters.

    Args:
        kinematics: the pose tree's.
        outlines: a surface for each node.
        groups: (nodes,) which radius scale each node has, or -1: how wide it is across its y axis.
            None: there are no radius_scales.
        radius_scale_names: of the radius_scales.
        surfaces: the pose tree's, where bands of skin shall bend with the values; the outlines are
            these at rest then, and there are no radius_scales.
        offsets: joints whose origins move as their links are scaled.
    """

    def __init__(
        self,
        kinematics: TreeKinematics,
        outlines: Sequence[Outline],
        groups: Sequence[int] | None = None,
        radius_scale_names: Sequence[str] = (),
        surfaces: TreeSurfaces | None = None,
        offsets: Sequence[LinkVector] = (),
    ) -> None:
        bends = surfaces is not None and surfaces.bends
        self._bending = PackedSurfaces(surfaces) if surfaces is not None and bends else None
        self.kinematics, self.outlines = kinematics, tuple(outlines)
        self.links = tuple(dict.fromkeys(one.link for one in offsets))
        nodes, count = len(self.outlines), len(kinematics.names) + len(ROOT_NAMES)
        made_by = kinematics.parameters
        self.groups = np.full(nodes, -1) if groups is None else np.array(groups)
        radius_scales = tuple(f"{RADIUS_SCALE_PREFIX}{name}" for name in radius_scale_names)
        lengths = tuple(link_scale_name(link) for link in self.links)
        self.names = (*kinematics.names, *ROOT_NAMES, *radius_scales, *lengths)
        self._packed = pack(self.outlines)
        values = kinematics.flatten(kinematics.tree.default_values())
        moves = kinematics.motions(values, translation=True, scale=True).moves
        self._rooted = moves[:, -1]
        self._values_only = owners_of(moves[:, :-4], made_by)
        self._wide = np.flatnonzero(self.groups >= 0)
        self._offsets, self._first_length = tuple(offsets), count + len(radius_scales)
        self._scaled = np.array([self.links.index(one.link) for one in offsets], dtype=np.intp)
        # Which nodes are behind each joint whose origin moves, and which joints' axes move.
        self._behind = np.zeros((nodes, len(offsets)), dtype=np.bool_)
        self._shifted = np.zeros((len(made_by), len(offsets)), dtype=np.bool_)
        for i, node in enumerate(kinematics.tree.nodes if offsets else ()):
            if node.parent >= 0:
                self._behind[i] = self._behind[node.parent]
            self._behind[i] |= [one.node == i for one in offsets]
            first = kinematics.packed.value_starts[i]
            for k, step in enumerate(kinematics.tree.placements[i].steps):
                last = first + step.position_count
                # Walked inwards, a joint comes before its offset.
                before = [one.node != i or one.step + one.inverted <= k for one in offsets]
                self._shifted[first:last] = self._behind[i] & before
                first = last
        # What moves the root moves the point about which the body grows.
        of_root = np.arange(len(made_by)) < np.count_nonzero(kinematics.value_nodes == 0)
        self._of_root = np.concatenate([of_root, self._behind[0]])
        self._all = owners_of(
            np.hstack(
                [
                    moves[:, :-4], self._behind, moves[:, -4:],
                    np.eye(nodes, dtype=np.bool_)[:, self._wide],
                ]
            ),
            np.concatenate(
                [
                    made_by, self._first_length + self._scaled, np.arange(count - 4, count),
                    count + self.groups[self._wide],
                ]
            ),
        )  # fmt: skip

    def place(self, theta: Array) -> Placement:
        """The body at its tree's values (m,), or at all parameters (n,)."""
        count = len(self.kinematics.names)
        at = self.kinematics.motions(theta[:count])
        if len(theta) == count:
            affine = affine_motions(at.twists)
            return Placement(self._at(theta), at.X_WN, affine, *self._values_only)
        X_WN, twists = at.X_WN.copy(), at.twists
        if self._offsets:
            offsets = self._offsets_in_world(theta[:count], at.X_WN)
            scale = np.exp(theta[self._first_length :])[self._scaled][:, None]
            shifts = (scale - 1.0) * offsets
            X_WN[:, :3, 3] += self._behind @ shifts
            twists = twists.copy()
            # A joint whose origin is shifted turns about another axis.
            twists[:, 3:6] -= np.cross(twists[:, :3], self._shifted @ shifts)
            moved = np.zeros((len(offsets), 7))
            moved[:, 3:6] = scale * offsets
            twists = np.vstack([twists, moved])
        affine = affine_motions(twists)
        root, growth = X_WN[0, :3, 3].copy(), float(np.exp(theta[count + 3]))
        moved = theta[count : count + 3] + (1.0 - growth) * root
        X_WN[self._rooted, :3, 3] = moved + growth * X_WN[self._rooted, :3, 3]
        X_WN[self._rooted, :3, :3] *= growth
        M, v = affine.reshape(-1, 3, 4)[:, :, :3], affine.reshape(-1, 3, 4)[:, :, 3]
        held = (1.0 - growth) * (M @ root + v) * self._of_root[:, None]
        twists = np.zeros((4, 7))
        twists[:3, 3:6] = np.eye(3)
        twists[3, 3:6], twists[3, 6] = -root - theta[count : count + 3], 1.0
        motions = [affine_of(M, growth * v - M @ moved + held), affine_motions(twists)]
        packed = self._at(theta[:count])
        if len(self._wide):
            scale = np.ones((len(X_WN), 3))
            radius_scales = np.exp(theta[count + 4 : self._first_length])[self.groups[self._wide]]
            scale[self._wide, 0] = scale[self._wide, 2] = radius_scales
            packed = stretched(packed, scale)
            widening = np.zeros((len(self._wide), 3, 4))
            for own, X in zip(widening, X_WN[self._wide], strict=True):
                across = X[:3, [0, 2]]
                own[:, :3] = across @ across.T / (across[:, 0] @ across[:, 0])
                own[:, 3] = -own[:, :3] @ X[:3, 3]
            motions.append(widening.reshape(-1, 12))
        return Placement(packed, X_WN, np.vstack(motions), *self._all)

    def _at(self, values: Array) -> PackedOutlines:
        """The surfaces at the tree's values (m,)."""
        return self._packed if self._bending is None else self._bending.at(values)

    def _offsets_in_world(self, values: Array, X_WN: Array) -> Array:
        """(offsets, 3) at the tree's values (m,), nothing scaled."""
        tree, split = self.kinematics.tree, self.kinematics.split(values)
        found = np.zeros((len(self._offsets), 3))
        for k, one in enumerate(self._offsets):
            placement, parent = tree.placements[one.node], tree.nodes[one.node].parent
            R_WA = placement.X_PA[:3, :3] if parent < 0 else X_WN[parent, :3, :3]
            if one.step + one.inverted > 0:
                steps = placement.steps[: one.step + one.inverted]
                own = tree.step_values(one.node, split[tree.source(one.node)][None])
                R_WA = R_WA @ chain_transforms(steps, own)[0, :3, :3]
            found[k] = R_WA @ one.p_A
        return found


def link_scale_name(link: str) -> str:
    """The name of the logarithm of a link's scale among the parameters."""
    return f"length of {link}"


def carried_joints(tree: PoseTree, links: Collection[str] | None = None) -> list[LinkVector]:
    """The robot's joints that links, all where None, carry at a distance from their own."""
    return [
        one
        for one in link_vectors(tree)
        if (links is None or one.link in links) and one.joint not in TARGET_POSITIONS
    ]


class CameraParameters:
    """The parameters of some cameras, CAMERA_NAMES of each in turn.

    Attributes:
        names: of all parameters.

    Args:
        cameras: the cameras where all parameters are 0.
        pivot: (3,) the point in the world about which they turn [m], or (cameras, 3).
    """

    def __init__(self, cameras: Sequence[Camera], pivot: Array) -> None:
        self.names = tuple(f"{camera.name}.{name}" for camera in cameras for name in CAMERA_NAMES)
        self._X_CW = np.array([camera.X_CW for camera in cameras])
        self._kernel = np.array([camera.kernel_parameters() for camera in cameras])
        pivots = np.broadcast_to(pivot, (len(cameras), 3))
        turned = np.einsum("cij,cj->ci", self._X_CW[:, :3, :3], pivots)
        self._pivots = turned + self._X_CW[:, :3, 3]

    def place(self, theta: Array) -> tuple[Array, Array, Array]:
        """The cameras at all parameters (9 c,).

        Returns:
            X_CW (c, 4, 4), kernel parameters (c, 8), and the affine motions (c, 9, 12) of all nodes
            that each parameter amounts to.
        """
        parts = theta.reshape(-1, len(CAMERA_NAMES))
        X_CW, kernel = self._X_CW.copy(), self._kernel.copy()
        motions = np.zeros((len(parts), len(CAMERA_NAMES), 12))
        for c, part in enumerate(parts):
            R, omegas = _turn(part[:3])
            R_CW = R @ X_CW[c, :3, :3]
            pivot = self._pivots[c] + part[3:6]
            p_CW = R @ (X_CW[c, :3, 3] - self._pivots[c]) + pivot
            X_CW[c, :3, :3], X_CW[c, :3, 3] = R_CW, p_CW
            kernel[c, 1:3] *= np.exp(part[6])
            kernel[c, 3:5] += part[7:9]
            twists = np.zeros((6, 7))
            twists[:3, :3], twists[3:, 3:6] = omegas.T, np.eye(3)
            in_camera = np.zeros((len(CAMERA_NAMES), 3, 4))
            in_camera[:6] = affine_motions(twists).reshape(6, 3, 4)
            in_camera[:3, :, 3] = -in_camera[:3, :, :3] @ pivot
            in_camera[6, 0, 0] = in_camera[6, 1, 1] = 1.0
            # A pixel is so far at the depth of a metre, or of parallel rays everywhere.
            depth = 3 if kernel[c, 0] == 1.0 else 2
            in_camera[7, 0, depth], in_camera[8, 1, depth] = 1.0 / kernel[c, 1:3]
            # What is affine in the camera's frame is so in the world's.
            motions[c] = (R_CW.T @ in_camera @ X_CW[c]).reshape(-1, 12)
        return X_CW, kernel, motions


@compiled
def affine_motions(twists: Array) -> Array:
    """Twists (m, 7) as affine motions (m, 12)."""
    affine = np.zeros((len(twists), 12))
    for k in range(len(twists)):
        own, twist = affine[k], twists[k]
        own[9], own[2], own[4] = twist[0], twist[1], twist[2]
        own[6], own[8], own[1] = -twist[0], -twist[1], -twist[2]
        own[3], own[7], own[11] = twist[3], twist[4], twist[5]
        own[0] = own[5] = own[10] = twist[6]
    return affine


def affine_of(M: Array, v: Array) -> Array:
    """Affine motions (m, 12) of M (m, 3, 3) and v (m, 3)."""
    return np.concatenate([M, v[:, :, None]], axis=2).reshape(-1, 12)


def owners_of(moves: NDArray[np.bool_], parameters: Indices) -> tuple[Indices, Indices, Indices]:
    """starts, owners and parameters of a Placement.

    Args:
        moves: (nodes, k) which motions each node has.
        parameters: (k,) which parameter makes each.
    """
    owners = np.nonzero(moves)[1].astype(np.int64)
    return np.cumsum([0, *moves.sum(axis=1)]), owners, parameters[owners]


def stretched(packed: PackedOutlines, scale: Array) -> PackedOutlines:
    """Surfaces, each node's scaled (nodes, 3) along its frame's axes."""
    points, planes = packed.points.copy(), packed.planes.copy()
    for node, (s, volume) in enumerate(zip(scale, scale.prod(axis=1), strict=True)):
        points[:, slice(*packed.starts[node : node + 2, 0])] *= s[:, None]
        factors = np.array([*volume / s, volume])
        planes[:, slice(*packed.starts[node : node + 2, 1])] *= factors[:, None]
    balls = packed.balls * np.column_stack([scale, scale.max(axis=1)])
    return packed._replace(points=points, planes=planes, balls=balls)


def _turn(r: Array) -> tuple[Array, Array]:
    """The rotation (3, 3) of a vector (3,), and the left Jacobian of SO(3) (3, 3)."""
    angle = float(np.linalg.norm(r))
    if angle > 1e-4:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
        c = (1.0 - a) / angle**2
    else:
        a, b, c = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0
    K = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
    return np.eye(3) + a * K + b * K @ K, np.eye(3) + b * K + c * K @ K
