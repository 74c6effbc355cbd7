"""Surfaces with a band of skin, which bends: a rigid part and a band whose vertices are given."""

from __future__ import annotations

import copy
import threading
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from drake_pose.body.joint_kernel import join_bands, place_bands
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
    from drake_pose.body import PoseTree, TriangleMesh


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

    ``bending`` and ``skins``: rigid part and band, and the band's motion; None without a band;
    ``value_counts``: how many values each node has.
    """

    def __init__(self, tree: PoseTree) -> None:
        self._nodes = tree.nodes
        self.value_counts = [len(node.value_names) for node in tree.nodes]
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

    def at_rest(self, node: int) -> Outline:
        """A node's surface with its skin at rest."""
        bending = self.bending[node]
        return self.rigid[node] if bending is None else bending.rest

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
        self._rest = pack(tuple(surfaces.at_rest(node) for node in range(len(surfaces.rigid))))
        # Of each node's band its place, as in ``bend``, and which of all values are the node's.
        ends = np.cumsum([0, *surfaces.value_counts])
        skins, parts, ranges, vertices = [], [], [], 0
        for node, bending in enumerate(surfaces.bending):
            skin, rigid = surfaces.skins[node], surfaces.rigid[node]
            if bending is not None and skin is not None:
                skins.append(skin.packed)
                parts.append((node, len(rigid.vertices), len(rigid.triangles), vertices))
                ranges.append(ends[node : node + 2])
                vertices += len(skin.weights)
        self._bands = join_bands(skins) if skins else None
        self._parts, self._ranges = np.array(parts), np.array(ranges)
        self._shapes = (1, ends[-1]), (1, vertices, 3)
        # Threads bend side by side.
        self._threads = threading.local()

    def at(self, values: np.ndarray) -> PackedOutlines:
        """All nodes' surfaces at all values (m,) [rad or m]."""
        return self._rest if self._bands is None else own_copy(self.bend_to(values))

    def bend_to(self, values: np.ndarray | None) -> PackedOutlines:
        """As at, in arrays that the thread's next call changes; None: as they are."""
        if self._bands is None:
            return self._rest
        if not hasattr(self._threads, "bent"):
            bent, placed = (np.full(shape, np.nan) for shape in self._shapes)
            self._threads.bent = own_copy(self._rest), bent, placed
        own, bent, placed = self._threads.bent
        if values is not None:
            values = np.ascontiguousarray(values, dtype=np.float64)[None]
            changed = place_bands(self._bands, self._ranges, values, bent, placed)[0]
            if changed.any():
                parts = self._parts[changed]
                own.balls[parts[:, 0]] = self._rest.balls[parts[:, 0]]
                bend(own, parts, placed[0])
        return own
