"""All that may be unknown of a frame, and how each parameter moves the nodes of a body.

The motion that a parameter gives to a node is affine: dp_W = M p_W + v, 12 numbers, the rows of
(M v) one after another. A camera that moves, or whose focal length changes, moves all nodes the
other way, in its own picture alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.silhouette.areas.bending import PackedSurfaces, TreeSurfaces
from drake_pose.silhouette.areas.outline import Outline, PackedOutlines, pack

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ROOT_NAMES = ("root_shift_x", "root_shift_y", "root_shift_z", "log_growth")
"""The shift of the first root along the world's axes [m], and the logarithm of the growth of it and
all behind it about its origin."""

GIRTH_PREFIX = "log_girth_"
"""Begins the names of girths: the logarithm of how wide a part is across its y axis."""

CAMERA_NAMES = ("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z", "log_focal")
"""A camera's parameters: the rotation vector [rad] by which, and the shift [m] along its axes by
which it sees everything moved about its pivot; and the logarithm of its focal length's growth, or
of a parallel camera's scale."""


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
        np.add.at(motions, (nodes, self.parameters), self.motions[self.owners])
        return motions


class BodyParameters:
    """A body's parameters: its tree's values, then ROOT_NAMES, then the logarithms of its girths.

    Attributes:
        kinematics: the pose tree's.
        outlines: a surface for each node.
        groups: (nodes,) which girth each node has, or -1.
        names: of the n parameters.

    Args:
        kinematics: the pose tree's.
        outlines: a surface for each node.
        groups: (nodes,) which girth each node has, or -1: how wide it is across its y axis. None:
            there are no girths.
        girth_names: of the girths.
        surfaces: the pose tree's, where bands of skin shall bend with the values; the outlines are
            these at rest then, and there are no girths.
    """

    def __init__(
        self,
        kinematics: TreeKinematics,
        outlines: Sequence[Outline],
        groups: Sequence[int] | None = None,
        girth_names: Sequence[str] = (),
        surfaces: TreeSurfaces | None = None,
    ) -> None:
        bends = surfaces is not None and surfaces.bends
        self._bending = PackedSurfaces(surfaces) if surfaces is not None and bends else None
        self.kinematics, self.outlines = kinematics, tuple(outlines)
        self.groups = np.full(len(self.outlines), -1) if groups is None else np.array(groups)
        self.names = (
            *kinematics.names,
            *ROOT_NAMES,
            *(f"{GIRTH_PREFIX}{name}" for name in girth_names),
        )
        self._has_girths = bool(np.any(self.groups >= 0))
        self._packed = pack(self.outlines)
        tree = kinematics.tree
        values = kinematics.flatten(tree.default_values())
        moves = kinematics.motions(values, translation=True, scale=True).moves
        self._rooted = moves[:, -1]
        self._of_root = kinematics.value_nodes == 0
        count = len(kinematics.names)
        self._values_only = _owned([np.flatnonzero(row) for row in moves[:, :count]])
        girths = [[] if group < 0 else [group] for group in self.groups]
        first = count + len(ROOT_NAMES)
        starts, owners, _ = _owned(
            [
                [*np.flatnonzero(row), *(first + node for _ in girth)]
                for node, (row, girth) in enumerate(zip(moves, girths, strict=True))
            ]
        )
        of = np.concatenate([np.arange(first), first + self.groups])
        self._all = starts, owners, of[owners]

    def place(self, theta: Array) -> Placement:
        """The body at its tree's values (m,), or at all parameters (n,)."""
        kinematics = self.kinematics
        count = len(kinematics.names)
        motions = kinematics.motions(theta[:count])
        if len(theta) == count:
            affine = affine_motions(motions.twists)
            return Placement(self._at(theta), motions.X_WN, affine, *self._values_only)
        shift, growth = theta[count : count + 3], float(np.exp(theta[count + 3]))
        X_WN, twists = motions.X_WN.copy(), np.zeros((count + 4, 7))
        twists[:count] = motions.twists
        root = X_WN[0, :3, 3].copy()
        X_WN[self._rooted, :3, :3] *= growth
        X_WN[self._rooted, :3, 3] = root + shift + growth * (X_WN[self._rooted, :3, 3] - root)
        omega, v = motions.twists[:, :3], motions.twists[:, 3:6]
        turned = omega @ _cross_matrix((1.0 - growth) * root + shift).T
        twists[:count, 3:6] = growth * v + turned
        # What moves the root moves the point about which the body has grown.
        held = (1.0 - growth) * (omega @ _cross_matrix(root) + v)
        twists[:count, 3:6] += held * self._of_root[:, None]
        twists[count : count + 3, 3:6] = np.eye(3)
        twists[-1, 3:6], twists[-1, 6] = -root - shift, 1.0
        packed = self._at(theta[:count])
        if self._has_girths:
            girths = np.append(theta[count + 4 :], 0.0)
            wide = np.where(self.groups >= 0, np.exp(girths[self.groups]), 1.0)
            packed = _widened(packed, wide)
        affine = affine_motions(twists)
        if self._has_girths:
            affine = np.vstack([affine, [_widening(X) for X in X_WN]])
        return Placement(packed, X_WN, affine, *self._all)

    def _at(self, values: Array) -> PackedOutlines:
        """The surfaces at the tree's values (m,)."""
        if self._bending is None:
            return self._packed
        return self._bending.at(self.kinematics.split(values))


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
        """The cameras at all parameters (7 c,).

        Returns:
            X_CW (c, 4, 4), kernel parameters (c, 8), and the affine motions (c, 7, 12) of all nodes
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
            M, v = np.zeros((7, 3, 3)), np.zeros((7, 3))
            for k in range(3):
                M[k] = _cross_matrix(omegas[:, k])
                v[k] = -M[k] @ pivot
            v[3:6] = np.eye(3)
            M[6, 0, 0] = M[6, 1, 1] = 1.0
            # What is affine in the camera's frame is so in the world's.
            affine = np.zeros((7, 3, 4))
            affine[:, :, :3] = R_CW.T @ M @ R_CW
            affine[:, :, 3] = (M @ p_CW + v) @ R_CW
            motions[c] = affine.reshape(7, 12)
        return X_CW, kernel, motions


def affine_motions(twists: Array) -> Array:
    """Twists (m, 7) as affine motions (m, 12)."""
    affine = np.zeros((len(twists), 3, 4))
    affine[:, 2, 1], affine[:, 0, 2], affine[:, 1, 0] = twists[:, :3].T
    affine[:, 1, 2], affine[:, 2, 0], affine[:, 0, 1] = -twists[:, :3].T
    affine[:, :, 3] = twists[:, 3:6]
    for k in range(3):
        affine[:, k, k] = twists[:, 6]
    return affine.reshape(-1, 12)


def _owned(motions: Sequence[Sequence[int] | NDArray[np.intp]]) -> tuple[Indices, Indices, Indices]:
    """starts, owners and parameters of a Placement whose motions are its parameters."""
    owners = np.array([one for group in motions for one in group], dtype=np.int64)
    return np.cumsum([0, *(len(group) for group in motions)]), owners, owners


def _widening(X_WN: Array) -> Array:
    """The affine motion (12,) of a part that grows across its y axis, per relative growth."""
    M = np.zeros((3, 4))
    across = X_WN[:3, [0, 2]]
    M[:, :3] = across @ across.T / (across[:, 0] @ across[:, 0])
    M[:, 3] = -M[:, :3] @ X_WN[:3, 3]
    return M.reshape(-1)


def _widened(packed: PackedOutlines, girths: Array) -> PackedOutlines:
    """Surfaces, each node's as wide across its y axis as girths (nodes,) say."""
    points, planes = packed.points.copy(), packed.planes.copy()
    for node, girth in enumerate(girths):
        vertices = slice(packed.starts[node, 0], packed.starts[node + 1, 0])
        triangles = slice(packed.starts[node, 1], packed.starts[node + 1, 1])
        points[0, vertices] *= girth
        points[2, vertices] *= girth
        planes[0, triangles] *= girth
        planes[1:4, triangles] *= np.array([girth**2, girth, girth**2])[:, None]
    balls = packed.balls.copy()
    balls[:, [0, 2]] *= girths[:, None]
    balls[:, 3] *= np.maximum(girths, 1.0)
    return packed._replace(points=points, planes=planes, balls=balls)


def _cross_matrix(r: Array) -> Array:
    """The matrix (3, 3) of the cross product with a vector (3,)."""
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


def _turn(r: Array) -> tuple[Array, Array]:
    """The rotation (3, 3) of a vector (3,), and the left Jacobian of SO(3) (3, 3)."""
    angle = float(np.linalg.norm(r))
    if angle > 1e-4:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
        c = (1.0 - a) / angle**2
    else:
        a, b, c = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0
    K = _cross_matrix(r)
    return np.eye(3) + a * K + b * K @ K, np.eye(3) + b * K + c * K @ K
