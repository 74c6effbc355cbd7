"""Parameters of a frame, and the motion of a body's nodes caused by each.

The motion of a node caused by a parameter is affine, dp_W = M p_W + v; the 12 numbers are the rows
of (M v). A camera's motion or a change of its focal length moves all nodes the opposite way, in its
own image only.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Indices
from drake_pose.body import TARGET_POSITIONS, PoseTree, chain_transforms
from drake_pose.body.tree_kinematics import LinkVector, TreeKinematics, link_vectors
from drake_pose.camera.models import Camera
from drake_pose.silhouette.outline import (
    Outline,
    PackedOutlines,
    PackedSurfaces,
    TreeSurfaces,
    pack,
)

ROOT_NAMES = ("root_shift_x", "root_shift_y", "root_shift_z", "log_scale")
"""Translation of the first root along the world's axes [m], and the log scale of the root and all
nodes behind it about the root's origin."""

RADIUS_SCALE_PREFIX = "log_radius_scale_"
"""Prefix of the names of log radius scales, which scale parts across their y axes."""

POSE_NAMES = ("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z")
"""Rotation vector [rad] about the pivot and translation [m] of the scene, in the camera's frame."""

CAMERA_NAMES = (*POSE_NAMES, "log_focal", "center_x", "center_y")
"""A camera's parameters: POSE_NAMES, the log scale of its focal length (or of a parallel camera's
pixels per metre), and the shift of its principal point [pixel]."""


class Placement(NamedTuple):
    """A body at given parameters, in the form that kernels take.

    A node's motion caused by a parameter is the sum of the affine motions that ``owners`` and
    ``parameters`` list for both.
    """

    packed: PackedOutlines  # Surfaces of the nodes.
    X_WN: Array  # (nodes, 4, 4) poses of the nodes.
    motions: Array  # (k, 12) affine motions per unit of their parameters.
    starts: Indices  # (nodes + 1,) index of each node's first entry in owners; the last one is s.
    owners: Indices  # (s,) indices of motions that move a node, ordered by node.
    parameters: Indices  # (s,) index of the parameter that causes each of these motions.

    def dense(self, size: int) -> Array:
        """Return affine motions (nodes, size, 12) of nodes by all parameters, 0 if not moved."""
        motions = np.zeros((len(self.X_WN), size, 12))
        nodes = np.repeat(np.arange(len(self.X_WN)), np.diff(self.starts))
        # np.add.at is slow; only mimic joints and scales have several motions per parameter.
        is_shared = self.owners != self.parameters
        own = nodes[~is_shared], self.parameters[~is_shared]
        motions[own] = self.motions[self.owners[~is_shared]]
        np.add.at(
            motions,
            (nodes[is_shared], self.parameters[is_shared]),
            self.motions[self.owners[is_shared]],
        )
        return motions


class BodyParameters:
    """Parameters of a body.

    They are the tree's values, ROOT_NAMES, log radius scales, and log link scales. A link scale
    stretches the offsets from the link's joint to the joints that it carries; the link's surface
    does not change, and everything behind those joints is translated.

    Attributes:
        kinematics: kinematics of the pose tree.
        outlines: surface of each node.
        groups: (nodes,) index of each node's radius scale, or -1.
        links: links with a scale, in the order of their parameters.
        names: (n,) names of the parameters.

    Args:
        kinematics: kinematics of the pose tree.
        outlines: surface of each node.
        groups: (nodes,) index of each node's radius scale, which stretches it across its y axis, or
            -1; None: there are no radius scales.
        radius_scale_names: names of the radius scales.
        surfaces: surfaces of the pose tree, if skin is to bend with the values. The outlines are
            then these at rest, and there are no radius scales. None: all parts are rigid.
        offsets: vectors that link scales stretch, see ``carried_joints``; empty: no link scales.
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
        caused_by = kinematics.motion_values
        self.groups = np.full(nodes, -1) if groups is None else np.array(groups)
        radius_scales = tuple(f"{RADIUS_SCALE_PREFIX}{name}" for name in radius_scale_names)
        link_scale_names = tuple(link_scale_name(link) for link in self.links)
        self.names = (*kinematics.names, *ROOT_NAMES, *radius_scales, *link_scale_names)
        self._packed = pack(self.outlines)
        values = kinematics.flatten(kinematics.tree.default_values())
        moves = kinematics.motions(values, translation=True, scale=True).moves
        self._rooted = moves[:, -1]
        self._values_only = owners_of(moves[:, :-4], caused_by)
        self._with_radius = np.flatnonzero(self.groups >= 0)
        self._offsets, self._first_link_scale = tuple(offsets), count + len(radius_scales)
        self._scaled = np.array([self.links.index(one.link) for one in offsets], dtype=np.intp)
        # The nodes behind each joint whose origin moves, and the joints whose axes move.
        self._behind = np.zeros((nodes, len(offsets)), dtype=np.bool_)
        self._shifted = np.zeros((len(caused_by), len(offsets)), dtype=np.bool_)
        for i, node in enumerate(kinematics.tree.nodes if offsets else ()):
            if node.parent >= 0:
                self._behind[i] = self._behind[node.parent]
            self._behind[i] |= [one.node == i for one in offsets]
            first = kinematics.packed.value_starts[i]
            for k, step in enumerate(kinematics.tree.placements[i].steps):
                last = first + step.position_count
                # In an inverted step the joint precedes its offset.
                before = [one.node != i or one.step + one.inverted <= k for one in offsets]
                self._shifted[first:last] = self._behind[i] & before
                first = last
        # Values that move the root also move the centre of the root's scaling.
        of_root = np.arange(len(caused_by)) < np.count_nonzero(kinematics.value_nodes == 0)
        self._moves_root = np.concatenate([of_root, self._behind[0]])
        self._all = owners_of(
            np.hstack(
                [
                    moves[:, :-4], self._behind, moves[:, -4:],
                    np.eye(nodes, dtype=np.bool_)[:, self._with_radius],
                ]
            ),
            np.concatenate(
                [
                    caused_by, self._first_link_scale + self._scaled, np.arange(count - 4, count),
                    count + self.groups[self._with_radius],
                ]
            ),
        )  # fmt: skip

    def place(self, theta: Array) -> Placement:
        """Return the body at parameters theta: the tree's values (m,), or all parameters (n,).

        With the m values only, the placement has no motions by the other parameters, which are 0.
        """
        count = len(self.kinematics.names)
        at = self.kinematics.motions(theta[:count])
        if len(theta) == count:
            affine = affine_motions(at.twists)
            return Placement(self._at(theta), at.X_WN, affine, *self._values_only)
        X_WN, twists = at.X_WN.copy(), at.twists
        if self._offsets:
            offsets = self._offsets_in_world(theta[:count], at.X_WN)
            scale = np.exp(theta[self._first_link_scale :])[self._scaled][:, None]
            shifts = (scale - 1.0) * offsets
            X_WN[:, :3, 3] += self._behind @ shifts
            twists = twists.copy()
            # The axis of a joint moves with its origin.
            twists[:, 3:6] -= np.cross(twists[:, :3], self._shifted @ shifts)
            moved = np.zeros((len(offsets), 7))
            moved[:, 3:6] = scale * offsets
            twists = np.vstack([twists, moved])
        affine = affine_motions(twists)
        root, root_scale = X_WN[0, :3, 3].copy(), float(np.exp(theta[count + 3]))
        moved = theta[count : count + 3] + (1.0 - root_scale) * root
        X_WN[self._rooted, :3, 3] = moved + root_scale * X_WN[self._rooted, :3, 3]
        X_WN[self._rooted, :3, :3] *= root_scale
        M, v = affine.reshape(-1, 3, 4)[:, :, :3], affine.reshape(-1, 3, 4)[:, :, 3]
        root_terms = (1.0 - root_scale) * (M @ root + v) * self._moves_root[:, None]
        twists = np.zeros((4, 7))
        twists[:3, 3:6] = np.eye(3)
        twists[3, 3:6], twists[3, 6] = -root - theta[count : count + 3], 1.0
        motions = [affine_of(M, root_scale * v - M @ moved + root_terms), affine_motions(twists)]
        packed = self._at(theta[:count])
        if len(self._with_radius):
            scale = np.ones((len(X_WN), 3))
            radius_scales = np.exp(theta[count + 4 : self._first_link_scale])[
                self.groups[self._with_radius]
            ]
            scale[self._with_radius, 0] = scale[self._with_radius, 2] = radius_scales
            packed = scale_surfaces(packed, scale)
            radius_motions = np.zeros((len(self._with_radius), 3, 4))
            for own, X in zip(radius_motions, X_WN[self._with_radius], strict=True):
                across = X[:3, [0, 2]]
                own[:, :3] = across @ across.T / (across[:, 0] @ across[:, 0])
                own[:, 3] = -own[:, :3] @ X[:3, 3]
            motions.append(radius_motions.reshape(-1, 12))
        return Placement(packed, X_WN, np.vstack(motions), *self._all)

    def _at(self, values: Array) -> PackedOutlines:
        """Return the surfaces at the tree's values (m,)."""
        return self._packed if self._bending is None else self._bending.at(values)

    def _offsets_in_world(self, values: Array, X_WN: Array) -> Array:
        """Return the unscaled offsets (offsets, 3) in the world [m].

        Args:
            values: (m,) the tree's values.
            X_WN: (nodes, 4, 4) poses of the nodes at these values.
        """
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
    """Return the name of the parameter that is the logarithm of a link's scale."""
    return f"length of {link}"


def carried_joints(tree: PoseTree, links: Collection[str] | None = None) -> list[LinkVector]:
    """Return the vectors from links' joints to the robot's joints that they carry at a distance.

    Vectors of at most a millimetre, and joints that position a target (TARGET_POSITIONS), are left
    out.

    ``tree``: the pose tree. ``links``: names of the carrying links; None: all.
    """
    return [
        one
        for one in link_vectors(tree)
        if (links is None or one.link in links) and one.joint not in TARGET_POSITIONS
    ]


class CameraParameters:
    """Parameters of several cameras: CAMERA_NAMES of each in turn.

    Attributes:
        names: names of all parameters.

    Args:
        cameras: the cameras when all parameters are 0.
        pivot: (3,) or (cameras, 3) point in the world about which they rotate [m].
    """

    def __init__(self, cameras: Sequence[Camera], pivot: Array) -> None:
        self.names = tuple(f"{camera.name}.{name}" for camera in cameras for name in CAMERA_NAMES)
        self._X_CW = np.array([camera.X_CW for camera in cameras])
        self._kernel = np.array([camera.kernel_parameters() for camera in cameras])
        pivots = np.broadcast_to(pivot, (len(cameras), 3))
        turned = np.einsum("cij,cj->ci", self._X_CW[:, :3, :3], pivots)
        self._pivots = turned + self._X_CW[:, :3, 3]

    def place(self, theta: Array) -> tuple[Array, Array, Array]:
        """Return the cameras at their parameters.

        Args:
            theta: (9 c,) CAMERA_NAMES of each camera in turn.

        Returns:
            X_CW (c, 4, 4), kernel parameters (c, 8), and the affine motions (c, 9, 12) of all nodes
            that are equivalent to each parameter.
        """
        parts = theta.reshape(-1, len(CAMERA_NAMES))
        X_CW, kernel = self._X_CW.copy(), self._kernel.copy()
        motions = np.zeros((len(parts), len(CAMERA_NAMES), 12))
        for c, part in enumerate(parts):
            R, omegas = _rotation(part[:3])
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
            # One pixel corresponds to this distance at unit depth (parallel camera: at any depth).
            depth = 3 if kernel[c, 0] == 1.0 else 2
            in_camera[7, 0, depth], in_camera[8, 1, depth] = 1.0 / kernel[c, 1:3]
            # Transform the affine motions from the camera's frame to the world's.
            motions[c] = (R_CW.T @ in_camera @ X_CW[c]).reshape(-1, 12)
        return X_CW, kernel, motions


def affine_motions(twists: Array) -> Array:
    """Return affine motions (m, 12), the rows of (M v), of twists.

    Args:
        twists: (m, 7) angular velocity w, velocity v of the world's origin, and scale rate s of
            each: dp = w x p + s p + v.
    """
    affine = np.zeros((len(twists), 12))
    affine[:, [9, 2, 4]], affine[:, [6, 8, 1]] = twists[:, :3], -twists[:, :3]
    affine[:, 3::4], affine[:, ::5] = twists[:, 3:6], twists[:, 6:]
    return affine


def affine_of(M: Array, v: Array) -> Array:
    """Return the affine motions dp = M p + v, (m, 12), of M (m, 3, 3) and v (m, 3)."""
    return np.concatenate([M, v[:, :, None]], axis=2).reshape(-1, 12)


def owners_of(moves: NDArray[np.bool_], parameters: Indices) -> tuple[Indices, Indices, Indices]:
    """Return ``starts``, ``owners`` and ``parameters`` of a Placement.

    Args:
        moves: (nodes, k) whether each motion moves a node.
        parameters: (k,) index of the parameter that causes each motion.
    """
    owners = np.nonzero(moves)[1].astype(np.int64)
    return np.cumsum([0, *moves.sum(axis=1)]), owners, parameters[owners]


def scale_surfaces(packed: PackedOutlines, scale: Array) -> PackedOutlines:
    """Return packed surfaces scaled by (nodes, 3) along the axes of their nodes' frames."""
    points, planes = packed.points.copy(), packed.planes.copy()
    for node, (s, volume) in enumerate(zip(scale, scale.prod(axis=1), strict=True)):
        points[:, slice(*packed.starts[node : node + 2, 0])] *= s[:, None]
        factors = np.array([*volume / s, volume])
        planes[:, slice(*packed.starts[node : node + 2, 1])] *= factors[:, None]
    balls = packed.balls * np.column_stack([scale, scale.max(axis=1)])
    return packed._replace(points=points, planes=planes, balls=balls)


def _rotation(r: Array) -> tuple[Array, Array]:
    """Return the rotation (3, 3) of a rotation vector (3,) [rad], and the left Jacobian (3, 3)."""
    angle = float(np.linalg.norm(r))
    a, b = np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    c = (1.0 - a) / max(angle**2, 1e-18)  # Where rounding counts, K is small.
    K = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
    return np.eye(3) + a * K + b * K @ K, np.eye(3) + b * K + c * K @ K
