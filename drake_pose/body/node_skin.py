"""Skin bands of a pose tree's nodes, and of a model for Drake.

A vertex of weight w lies where it would lie if it belonged to the child link and the joints had
moved by the fraction w of their values q:

    p_A(q) = X_AB(w q) p_B

with A the parent's frame, B the child's frame and p_B the vertex at rest. For one joint this is
dual quaternion blending. For several joints the band neither collapses nor jumps, however far they
turn.
"""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array
from drake_pose.body.link_graph import (
    JointMap,
    LinkGraph,
    PlantKinematics,
    build_link_graph,
    chain_transforms,
    inverse_transforms,
)
from drake_pose.body.meshes import TriangleMesh
from drake_pose.body.parsed_model import ParsedModel, SkinBand, skin_file
from drake_pose.errors import ModelError, SettingsError

if TYPE_CHECKING:
    from drake_pose.body.joint_kernel import PackedBands


@dataclass(frozen=True, eq=False)
class NodeSkin:
    """The skin band between a node and its parent, in the node's frame N."""

    mesh: TriangleMesh  # The closed band at rest (all joints at zero).
    # (v,) float64 read-only weights in [0, 1] with which vertices move with the link farther from
    # the plant's world: the node, or its parent if ``inverted``.
    weights: Array
    colour: tuple[float, float, float]  # (red, green, blue) in [0, 1].
    inverted: bool  # Whether the node, not its parent, is nearer to the plant's world.
    steps: tuple[JointMap, ...]  # The joints from the parent to the node.

    @property
    def triangles(self) -> NDArray[np.int32]:
        """(m, 3) int32 read-only indices of vertices, the same at all values."""
        return self.mesh.triangles

    def vertices(self, values: Array) -> Array:
        """Return the vertices (n, v, 3) [m] in the node's frame at its values (n, k) [rad or m].

        Raises SettingsError: the values have the wrong shape.
        """
        from drake_pose.body.joint_kernel import place_bands  # Slow to import.

        count = sum(step.position_count for step in self.steps)
        values = np.ascontiguousarray(values, dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != count:
            raise SettingsError(f"values of shape (n, {count}) expected, got {values.shape}")
        placed = np.empty((len(values), len(self.weights), 3))
        place_bands(
            self.packed, np.array([[0, count]]), values, np.full(values.shape, np.nan), placed
        )
        return placed

    @cached_property
    def packed(self) -> "PackedBands":
        """The band in the arrays that the kernel takes."""
        from drake_pose.body.joint_kernel import PackedBands, pack_steps

        points = self.mesh.vertices
        if self.inverted:
            X_PN = _pose_at_rest(self.steps)
            points = points @ X_PN[:3, :3].T + X_PN[:3, 3]
        weights, weight_index = np.unique(self.weights, return_inverse=True)
        return PackedBands(
            starts=np.array([[0, 0, 0], [len(self.steps), len(weights), len(points)]]),
            steps=pack_steps(self.steps),
            weights=weights,
            weight_index=weight_index.reshape(-1).astype(np.int64),
            points=np.array(points, dtype=np.float64, order="C"),
            inverted=np.array([self.inverted]),
        )


def _pose_at_rest(steps: tuple[JointMap, ...]) -> Array:
    """Return a chain's transform (4, 4) with all positions at zero."""
    count = sum(step.position_count for step in steps)
    rest: Array = chain_transforms(steps, np.zeros((1, count)))[0]
    return rest


def find_skin(
    model: ParsedModel, graph: LinkGraph, parent: int, group: int, steps: tuple[JointMap, ...]
) -> NodeSkin | None:
    """Return the skin band between a node and its parent; None if the model declares none.

    ``parent``: index of the parent's link group. ``group``: index of the node's link group.
    ``steps``: the joints from the parent to the node.
    """
    for band in model.skin:
        ends = (graph.group_of(band.parent), graph.group_of(band.child))
        if ends not in ((parent, group), (group, parent)):
            continue
        inverted = ends != (parent, group)
        kinematics = PlantKinematics(model)
        X_GB = inverse_transforms(kinematics.pose(graph.groups[ends[1]].body))
        mesh = band.mesh.transformed(X_GB @ kinematics.pose(model.link_index(band.child)))
        if inverted:
            mesh = mesh.transformed(inverse_transforms(_pose_at_rest(steps)))
        return NodeSkin(mesh, band.weights, band.colour, inverted, steps)
    return None


def require_neighbours(
    model: ParsedModel, graph: LinkGraph, pairs: Collection[tuple[int, int]]
) -> None:
    """Raise ModelError if the two links of a skin band are not neighbours in a tree.

    ``pairs``: the link groups (parent, node) of all neighbours, as indices in ``graph.groups``.
    """
    for band in model.skin:
        ends = (graph.group_of(band.parent), graph.group_of(band.child))
        if ends not in pairs and ends[::-1] not in pairs:
            raise ModelError(
                f"{skin_file(model.path)}: band '{band.parent}' - '{band.child}': these are not "
                "neighbours; a band joins two links with geometry that have joints, and no other "
                "link with geometry, between them"
            )


class ModelSkin:
    """A model's skin bands in the frame of the plant's world, for Drake and Meshcat.

    Raises ModelError: no joints lead outwards from a band's parent to its child.
    """

    def __init__(self, model: ParsedModel) -> None:
        self.bands: tuple[SkinBand, ...] = model.skin
        self._kinematics = PlantKinematics(model)
        graph = build_link_graph(model, None)
        self._parts: list[tuple[int, tuple[int, ...], NodeSkin]] = []
        for band in model.skin:
            steps, positions = _chain(model, graph, band)
            ends = (graph.group_of(band.parent), graph.group_of(band.child))
            skin = find_skin(model, graph, *ends, steps)
            if skin is not None:
                self._parts.append((graph.groups[ends[1]].body, positions, skin))

    @property
    def meshes(self) -> tuple[TriangleMesh, ...]:
        """The bands at rest, each in its child link's frame."""
        return tuple(band.mesh for band in self.bands)

    def vertices(self, q: Array) -> list[Array]:
        """Return each band's vertices (v, 3) [m] in the plant's world at q (nq,) [rad or m]."""
        placed = []
        for body, positions, skin in self._parts:
            X_BN = self._kinematics.pose_at(body, q)
            p_N = skin.vertices(q[None, list(positions)])[0]
            placed.append(p_N @ X_BN[:3, :3].T + X_BN[:3, 3])
        return placed


def _chain(
    model: ParsedModel, graph: LinkGraph, band: SkinBand
) -> tuple[tuple[JointMap, ...], tuple[int, ...]]:
    """Return a band's joints outwards from parent to child, and indices in q; ModelError: none."""
    inner, outer = graph.group_of(band.parent), graph.group_of(band.child)
    steps: list[JointMap] = []
    positions: list[int] = []
    group = outer
    while group != inner:
        edge = next((edge for edge in graph.edges if edge.outer == group), None)
        if edge is None or edge.joint_map is None:
            raise ModelError(
                f"{skin_file(model.path)}: band '{band.parent}' - '{band.child}': no joints lead "
                "outwards from the first to the second; are they exchanged?"
            )
        steps.insert(0, edge.joint_map)
        positions = [*edge.positions, *positions]
        group = edge.inner
    return tuple(steps), tuple(positions)
