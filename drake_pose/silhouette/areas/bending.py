"""Surfaces with a band of skin, which bends: a rigid part and a band whose vertices are given."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from drake_pose.body.tree.joint_kernel import place_band
from drake_pose.silhouette.areas.outline import (
    Outline,
    PackedOutlines,
    outline_from_mesh,
    outline_of_triangles,
    own_copy,
    pack,
)
from drake_pose.silhouette.areas.projection import bend

if TYPE_CHECKING:
    from drake_pose.body.surfaces.meshes import TriangleMesh
    from drake_pose.body.tree.pose_tree import PoseTree


class BendingOutline:
    """A rigid surface and a band in its frame N, whose vertices move and whose triangles do not.

    ``rest``: both, the band at rest; its first vertices and triangles are the rigid part's.
    """

    def __init__(self, rigid: Outline, band: TriangleMesh) -> None:
        self.rigid = rigid
        own = outline_of_triangles(band.vertices, band.triangles)
        edges = own.edges.copy()
        edges[:, :2] += len(rigid.vertices)
        edges[:, 2] += len(rigid.triangles)
        edges[:, 3] += np.where(edges[:, 3] < 0, 0, len(rigid.triangles))
        self.rest = Outline(
            vertices=np.concatenate([rigid.vertices, own.vertices]),
            triangles=np.concatenate(
                [rigid.triangles, own.triangles + np.int32(len(rigid.vertices))]
            ),
            edges=np.concatenate([rigid.edges, edges]),
        )

    @cached_property
    def _band_triangles(self) -> np.ndarray:
        """(m, 3) the band's triangles, indices into the band's own vertices."""
        return self.rest.triangles[len(self.rigid.triangles) :] - len(self.rigid.vertices)

    def at(self, band: np.ndarray) -> Outline:
        """The whole surface with the band's vertices at (v, 3) [m] in frame N."""
        outline = Outline(
            np.concatenate([self.rigid.vertices, band]),
            self.rest.triangles,
            self.rest.edges,
            self.rest,
        )
        # Nothing but the band's own planes is new: a cached property may be set where it is kept.
        bent = Outline(band, self._band_triangles, self.rest.edges[:0])
        vars(outline)["planes"] = np.concatenate([self.rigid.planes, bent.planes])
        return outline


class TreeSurfaces:
    """The surfaces of a pose tree's nodes at any values, each in its node's frame.

    ``bending`` and ``skins``: rigid part and band, and the band's motion; None without a band.
    """

    def __init__(self, tree: PoseTree) -> None:
        self._nodes = tree.nodes
        self.skins = [node.skin for node in tree.nodes]
        self.rigid = [outline_from_mesh(node.mesh) for node in tree.nodes]
        self.bending = [
            None if node.skin is None else BendingOutline(rigid, node.skin.mesh)
            for node, rigid in zip(tree.nodes, self.rigid, strict=True)
        ]

    def with_rigid(self, rigid: Sequence[Outline]) -> TreeSurfaces:
        """The same bands beside other rigid parts."""
        other = copy.copy(self)
        other.rigid = list(rigid)
        other.bending = [
            None if skin is None else BendingOutline(outline, skin.mesh)
            for skin, outline in zip(self.skins, other.rigid, strict=True)
        ]
        return other

    @property
    def bends(self) -> bool:
        """Whether any node has a band."""
        return any(bending is not None for bending in self.bending)

    def whole(self, node: int) -> Outline | BendingOutline:
        """A node's surface: bending where the node has a band."""
        return self.bending[node] or self.rigid[node]

    def node_at(self, node: int, values: np.ndarray) -> Outline:
        """A node's whole surface in its frame at its values (k,) [rad or m]."""
        bending, skin = self.bending[node], self._nodes[node].skin
        if bending is None or skin is None:
            return self.rigid[node]
        return bending.at(skin.vertices(np.asarray(values)[None])[0])

    def at(self, values: Sequence[np.ndarray]) -> list[Outline]:
        """All nodes' whole surfaces, each in its node's frame, at each node's values (k_i,)."""
        return [self.node_at(node, part) for node, part in enumerate(values)]


class PackedSurfaces:
    """A tree's surfaces as kernels take them; rigid parts may have fewer triangles than its own."""

    def __init__(self, surfaces: TreeSurfaces) -> None:
        outlines = [surfaces.whole(node) for node in range(len(surfaces.rigid))]
        self._rest = pack(tuple(o.rest if isinstance(o, BendingOutline) else o for o in outlines))
        self._own = own_copy(self._rest)
        self._bands = []
        for node, bending in enumerate(surfaces.bending):
            skin = surfaces.skins[node]
            if bending is not None and skin is not None:
                rigid = bending.rigid
                part = np.array([node, len(rigid.vertices), len(rigid.triangles), 0], np.int64)
                placed = np.empty((1, len(skin.weights), 3))
                self._bands.append((node, part, skin.packed, placed))
        self._bent = [b""] * len(outlines)

    def at(self, values: Sequence[np.ndarray]) -> PackedOutlines:
        """All nodes' surfaces at each node's values (k_i,) [rad or m]."""
        return own_copy(self.bend_to(values)) if self._bands else self._rest

    def bend_to(self, values: Sequence[np.ndarray] | None) -> PackedOutlines:
        """As at, in arrays that the next call changes; None: as they are."""
        if values is None:
            return self._own
        for node, part, band, placed in self._bands:
            own = np.ascontiguousarray(values[node], dtype=np.float64)
            # Bands whose values are as before stay.
            if self._bent[node] != own.tobytes():
                self._bent[node] = own.tobytes()
                self._own.balls[node] = self._rest.balls[node]
                place_band(band, own[None], placed)
                bend(self._own, part, placed[0])
        return self._own
