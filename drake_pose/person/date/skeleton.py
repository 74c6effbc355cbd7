"""The person of figure 5 as a skeleton: joint offsets, axes and limits, read from a model once.

Head - neck base - trunk, and two arms and legs of 3 + 1 rotations: 23 degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from drake_pose.arrays import Array, Integers
from drake_pose.body.model import ArticulatedModel
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import ModelError

LIMBS = ("left_arm", "right_arm", "left_leg", "right_leg")
"""The limbs' names."""

FEATURES = ("head", "left_hand", "right_hand", "left_foot", "right_foot")
"""The skin-coloured parts that are measured, head and the limbs' ends, in the limbs' order."""

_SEGMENTS = {"arm": ("upper_arm", "forearm", "hand"), "leg": ("thigh", "shin", "foot")}
_FARTHEST_FEATURE = 0.05
_POINTS_ON_SURFACE = 60
_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True, eq=False)
class Limb:
    """An arm or a leg, named as one of LIMBS.

    Args:
        root_T: (3,) shoulder or hip in the trunk's frame [m].
        middle_U: (3,) elbow or knee in the upper segment's frame [m].
        end_L: (3,) the hand's or foot's middle in the lower segment's frame [m].
        axes: (4,) 0, 1, 2 for x, y, z: three at the root in the order of rotation, then the middle.
        positions, lower, upper: (4,) where their angles stand in q, and their limits [rad].
        half_widths: (2,) mean distance of either segment's surface from its joints' line [m].
        surfaces: (m, 3) points all over either segment's surface, in its frame [m].
    """

    name: str
    root_T: Array
    middle_U: Array
    end_L: Array
    axes: Integers
    positions: Integers
    lower: Array
    upper: Array
    half_widths: Array
    surfaces: tuple[Array, Array]

    @property
    def lengths(self) -> tuple[float, float]:
        """From root to middle joint, and from there to the end [m]."""
        return float(np.linalg.norm(self.middle_U)), float(np.linalg.norm(self.end_L))

    @property
    def side(self) -> float:
        """1 on the left, -1 on the right."""
        return 1.0 if self.name.startswith("left") else -1.0


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joint offsets, axes and limits of the person.

    Args:
        R_WA: (3, 3) the head's axes when its angles are 0.
        face_H, neck_H: (3,) middle of the head's skin, and neck's base, in the head's frame [m].
        head_positions: (3,) where the head's place stands in q.
        head_axes, neck_axes: (2,) axes 0, 1, 2 in the order of rotation.
        head_angles, neck_angles: (2,) where they stand in q.
        lower, upper: (nq,) limits [rad or m].
    """

    model: ArticulatedModel
    R_WA: Array
    face_H: Array
    neck_H: Array
    head_positions: Integers
    head_axes: Integers
    head_angles: Integers
    neck_axes: Integers
    neck_angles: Integers
    limbs: Mapping[str, Limb]
    lower: Array
    upper: Array

    def head_rotation(self, q: Array) -> Array:
        """(3, 3) the head's axes in the world at q (nq,)."""
        return self.R_WA @ rotation(self.head_axes, q[self.head_angles])

    def trunk_pose(self, q: Array) -> tuple[Array, Array]:
        """The trunk's axes (3, 3) and origin, the neck's base (3,), in the world at q (nq,)."""
        R_WH = self.head_rotation(q)
        R_WT = R_WH @ rotation(self.neck_axes, q[self.neck_angles])
        return R_WT, q[self.head_positions] + R_WH @ self.neck_H

    def limb_points(self, q: Array, name: str) -> Array:
        """(3, 3) root, middle joint and end of a limb in the world at q (nq,) [m]."""
        limb = self.limbs[name]
        R_WT, p_W = self.trunk_pose(q)
        root = p_W + R_WT @ limb.root_T
        R_WU = R_WT @ rotation(limb.axes[:3], q[limb.positions[:3]])
        middle = root + R_WU @ limb.middle_U
        R_WL = R_WU @ rotation(limb.axes[3:], q[limb.positions[3:]])
        return np.array([root, middle, middle + R_WL @ limb.end_L])

    def features(self, q: Array) -> Array:
        """(5, 3) where FEATURES are in the world at q (nq,) [m]."""
        face = q[self.head_positions] + self.head_rotation(q) @ self.face_H
        return np.array([face, *(self.limb_points(q, name)[2] for name in LIMBS)])

    @property
    def waist_T(self) -> Array:
        """(3,) half-way between the hips, in the trunk's frame [m]."""
        return 0.5 * (self.limbs["left_leg"].root_T + self.limbs["right_leg"].root_T)

    def with_features(self, q: Array, places: Array) -> Skeleton:
        """The same person whose features are at places (5, 3) measured in a known pose q (nq,) [m].

        Features of seen skin move by five centimetres at most; nan: not measured.
        """
        off = np.nan_to_num(np.asarray(places) - self.features(q))
        length = np.linalg.norm(off, axis=1, keepdims=True)
        off *= np.minimum(1.0, _FARTHEST_FEATURE / np.maximum(length, 1e-12))
        limbs = {}
        R_WT = self.trunk_pose(q)[0]
        for name, step in zip(LIMBS, off[1:], strict=True):
            limb = self.limbs[name]
            R_WL = R_WT @ rotation(limb.axes, q[limb.positions])
            limbs[name] = replace(limb, end_L=limb.end_L + R_WL.T @ step)
        face_H = self.face_H + self.head_rotation(q).T @ off[0]
        return replace(self, face_H=face_H, limbs=MappingProxyType(limbs))

    def clip(self, q: Array) -> Array:
        """The positions q (nq,) moved inside their limits."""
        return np.clip(q, self.lower, self.upper)


def load_skeleton(model: ArticulatedModel) -> Skeleton:
    """Reads the skeleton of a model made like the bundled person.

    Raises ModelError where its segments do not hang together so, naming the segment.
    """
    tree = model.pose_tree()
    nodes = {node.name: index for index, node in enumerate(tree.nodes)}
    X_WN = tree.node_poses(tree.values_from_positions(np.zeros(len(model.position_names))))
    for name, parent in [("trunk", "head"), *_expected_parents()]:
        if name not in nodes or tree.nodes[tree.nodes[nodes[name]].parent].name != parent:
            raise ModelError(
                f"{model.path}: Date's capture needs a body like urdf/person: '{name}' must hang "
                f"on '{parent}'; it has {', '.join(nodes)}"
            )
    head, trunk = tree.nodes[nodes["head"]], tree.nodes[nodes["trunk"]]
    limbs = {name: _limb(tree, nodes, X_WN, name) for name in LIMBS}
    head_angles = [i for i in head.positions if model.position_kinds[i] == "angle"]
    return Skeleton(
        model=model,
        R_WA=X_WN[nodes["head"], :3, :3],
        face_H=_middle(head.mesh),
        neck_H=_offset(X_WN[nodes["head"]], X_WN[nodes["trunk"]]),
        head_positions=np.array([i for i in head.positions if model.position_kinds[i] == "length"]),
        head_axes=_axes(model, head_angles, "head"),
        head_angles=np.array(head_angles),
        neck_axes=_axes(model, trunk.positions, "trunk"),
        neck_angles=np.array(trunk.positions),
        limbs=MappingProxyType(limbs),
        lower=model.lower,
        upper=model.upper,
    )


def rotation(axes: Integers, angles: Array) -> Array:
    """(3, 3) the product of rotations about coordinate axes (n,) by angles (n,) [rad], in order."""
    R = np.eye(3)
    for axis, angle in zip(axes, angles, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        step = np.eye(3)
        step[i, i], step[i, j], step[j, i], step[j, j] = c, -s, s, c
        R = R @ step
    return R


def _expected_parents() -> list[tuple[str, str]]:
    found = []
    for name in LIMBS:
        side, kind = name.split("_")
        upper, lower, _ = (f"{side}_{part}" for part in _SEGMENTS[kind])
        found += [(upper, "trunk"), (lower, upper)]
    return found


def _limb(tree: PoseTree, nodes: Mapping[str, int], X_WN: Array, name: str) -> Limb:
    side, kind = name.split("_")
    upper, lower, end = (f"{side}_{part}" for part in _SEGMENTS[kind])
    positions = (*tree.nodes[nodes[upper]].positions, *tree.nodes[nodes[lower]].positions)
    if len(positions) != 4:
        raise ModelError(f"{tree.model.path}: '{upper}' and '{lower}' must have 3 + 1 positions")
    X_UL = np.linalg.inv(X_WN[nodes[upper]]) @ X_WN[nodes[lower]]
    end_L = _end_middle(tree.model, lower, end)
    meshes = [tree.model.link_meshes[segment] for segment in (upper, lower)]
    return Limb(
        name=name,
        root_T=_offset(X_WN[nodes["trunk"]], X_WN[nodes[upper]]),
        middle_U=X_UL[:3, 3],
        end_L=end_L,
        axes=_axes(tree.model, positions, upper),
        positions=np.array(positions),
        lower=tree.model.lower[list(positions)],
        upper=tree.model.upper[list(positions)],
        half_widths=np.array(
            [
                _half_width(mesh.vertices, along)
                for mesh, along in zip(meshes, (X_UL[:3, 3], end_L), strict=True)
            ]
        ),
        surfaces=(_surface_points(meshes[0]), _surface_points(meshes[1])),
    )


def _axes(model: ParsedModel, positions: list[int] | tuple[int, ...], name: str) -> Integers:
    """The axes 0, 1, 2 that the positions' names end with."""
    letters = [model.position_names[i].rsplit("_", 1)[-1] for i in positions]
    if any(letter not in _AXES for letter in letters):
        raise ModelError(
            f"{model.path}: '{name}' must turn about joints whose names end with _x, _y or _z, not "
            f"{', '.join(model.position_names[i] for i in positions)}"
        )
    return np.array([_AXES[letter] for letter in letters])


def _offset(X_WA: Array, X_WB: Array) -> Array:
    """(3,) the origin of B in A."""
    return np.asarray(X_WA[:3, :3].T @ (X_WB[:3, 3] - X_WA[:3, 3]))


def _end_middle(model: ParsedModel, lower: str, end: str) -> Array:
    """(3,) the middle of a hand or foot in the frame of the segment before it."""
    if end not in model.link_meshes:
        raise ModelError(f"{model.path}: there must be a link '{end}' with visual geometry")
    plant = model.plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.zeros(len(model.position_names)))
    frame = plant.GetBodyByName(lower).body_frame()
    X_LE = plant.GetBodyByName(end).body_frame().CalcPose(context, frame).GetAsMatrix4()
    return np.asarray(X_LE[:3, :3] @ _middle(model.link_meshes[end]) + X_LE[:3, 3])


def _half_width(vertices: Array, along: Array) -> float:
    """Mean distance of vertices (n, 3) from the line through the origin along a vector (3,)."""
    direction = along / np.linalg.norm(along)
    return float(np.linalg.norm(np.cross(vertices, direction), axis=1).mean())


def _surface_points(mesh: TriangleMesh) -> Array:
    """(m, 3) middles of triangles, one for each of m equal parts of the surface's area."""
    middles, area = _triangle_middles(mesh)
    parts = (np.arange(_POINTS_ON_SURFACE) + 0.5) / _POINTS_ON_SURFACE * area.sum()
    return middles[np.minimum(np.searchsorted(np.cumsum(area), parts), len(area) - 1)]


def _middle(mesh: TriangleMesh) -> Array:
    """(3,) the middle of a surface, weighed by area."""
    middles, area = _triangle_middles(mesh)
    return np.asarray((area[:, None] * middles).sum(axis=0) / area.sum())


def _triangle_middles(mesh: TriangleMesh) -> tuple[Array, Array]:
    """(n, 3) middles of triangles, and what is proportional to their areas (n,)."""
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return (a + b + c) / 3.0, np.linalg.norm(np.cross(b - a, c - a), axis=1)
