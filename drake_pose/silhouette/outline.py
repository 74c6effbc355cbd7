"""Triangle surfaces prepared for the span kernel: their edges, planes and skin bands.

A camera is passed to kernels as eight numbers, ``Camera.kernel_parameters()``: 1 for a parallel or
0 for a pinhole camera, fx, fy, cx, cy [pixel, or pixel/m for parallel fx and fy], near plane [m],
width and height [pixel].
"""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from drake_pose.body.joint_kernel import join_bands, place_bands
from drake_pose.compiled import compiled

if TYPE_CHECKING:
    from drake_pose.body import TriangleMesh


@dataclass(frozen=True, eq=False)
class Outline:
    """A triangle surface and its edges, each with the one or two triangles that it bounds.

    Any set of triangles is allowed, with holes, inner parts, and edges of three or more triangles,
    which have several records.
    """

    vertices: np.ndarray  # (n, 3) float64 points in the surface's own frame N [m].
    triangles: np.ndarray  # (m, 3) int32 vertex indices, in any orientation.
    # (e, 5) int32 records v0, v1, t0, t1, s1. Triangle t0 traverses the edge from v0 to v1. s1 is
    # +1 if triangle t1 does, too, and -1 if t1 traverses it backwards; t1 = -1 and s1 = 0 if there
    # is no second triangle.
    edges: np.ndarray
    # The surface at rest, if this one differs from it in vertices only; the arrays that both share
    # are packed once.
    rest: Outline | None = None

    @cached_property
    def moments(self) -> np.ndarray:
        """(4, 4) means over the vertices of products of x, y, z and 1 [m^2, m, 1]."""
        points = np.column_stack([self.vertices, np.ones(len(self.vertices))])
        return points.T @ points / max(len(points), 1)

    @cached_property
    def planes(self) -> np.ndarray:
        """(m, 4) normals of length twice the area [m^2], and their products with a corner [m^3]."""
        corners = self.vertices[self.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        offsets = np.einsum("ij,ij->i", normals, corners[:, 0])
        return np.column_stack([normals, offsets])

    @cached_property
    def is_closed(self) -> bool:
        """Whether all parts are closed with outward normals (counter-clockwise from outside)."""
        neighbours = self.edges[:, [2, 3]]
        if not np.all(self.edges[:, 4] == -1):
            return False
        count = len(self.triangles)
        graph = coo_array((np.ones(len(neighbours)), neighbours.T), shape=(count, count))
        _, part = connected_components(graph, directed=False)
        corners = self.vertices[self.triangles]
        volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
        return bool(np.all(np.bincount(part, volumes) > 0.0))

    @cached_property
    def ball(self) -> np.ndarray:
        """(4,) centre and radius [m] of a ball around the vertices."""
        if len(self.vertices) == 0:
            return np.zeros(4)
        center = 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))
        radius = np.sqrt(((self.vertices - center) ** 2).sum(axis=1).max())
        return np.append(center, radius)


class PackedOutlines(NamedTuple):
    """Several outlines, one after the other, in the arrays that kernels take."""

    points: np.ndarray  # (3, n) float64 vertices [m].
    planes: np.ndarray  # (4, m) float64 planes, as ``Outline.planes``.
    balls: np.ndarray  # (nodes, 4) float64 bounding balls, as ``Outline.ball``.
    # (m, 3) int32 vertex indices, counted from the outline's own first vertex.
    triangles: np.ndarray
    # (4, e) uint32 rows v0, v1, t0, t1, counted from the outline's own first vertex and triangle;
    # t1 is the outline's number of triangles if there is no second triangle.
    edges: np.ndarray
    sides: np.ndarray  # (e,) int8 s1 of ``Outline.edges``.
    starts: np.ndarray  # (nodes + 1, 3) int64 first vertex, triangle and edge of each outline.
    # (nodes,) int64 end of each outline's ordinary edges (s1 = -1), which come first.
    ordinary_ends: np.ndarray


def outline_from_mesh(mesh: TriangleMesh) -> Outline:
    """Return a mesh's outline, of merged vertices, without degenerate triangles; cached."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64) + 0.0  # -0.0 becomes 0.0
    return _merged_outline(vertices.tobytes(), np.asarray(mesh.triangles, dtype=np.int64).tobytes())


@lru_cache(maxsize=64)
def _merged_outline(points: bytes, corners: bytes) -> Outline:
    """Return `outline_from_mesh` of bytes of (n, 3) float64 and (m, 3) int64."""
    places = np.frombuffer(points, np.float64).reshape(-1, 3)
    vertices, renumbered = np.unique(places, axis=0, return_inverse=True)
    triangles = renumbered.reshape(-1)[np.frombuffer(corners, np.int64).reshape(-1, 3)]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return outline_of_triangles(np.ascontiguousarray(vertices[used]), renumbered.reshape(-1, 3))


def outline_of_triangles(vertices: np.ndarray, triangles: np.ndarray) -> Outline:
    """Return the outline of vertices (n, 3) [m] and triangles (m, 3) without merging."""
    indices = np.asarray(triangles, dtype=np.int32).reshape(-1, 3)
    return Outline(np.asarray(vertices).reshape(-1, 3), indices, edge_records(indices))


def edge_records(triangles: np.ndarray) -> np.ndarray:
    """Return the records (e, 5) of ``Outline.edges`` for triangles (m, 3)."""
    heads = triangles.T.reshape(-1).astype(np.int64)
    tails = triangles[:, [1, 2, 0]].T.reshape(-1).astype(np.int64)
    owners = np.tile(np.arange(len(triangles)), 3)
    forward = heads < tails
    low, high = np.minimum(heads, tails), np.maximum(heads, tails)
    # Sort the uses of an edge alternately forward and backward, the surplus last, and pair them
    # from the start. This gives the most pairs in opposite directions, which cancel wherever both
    # triangles face the same way.
    order = np.lexsort((owners, ~forward, high, low))
    rank = _position_in_run(low[order], high[order], forward[order])
    order = order[np.lexsort((~forward[order], rank, high[order], low[order]))]
    low, high, owners, forward = low[order], high[order], owners[order], forward[order]
    position = _position_in_run(low, high)
    first = np.flatnonzero(position % 2 == 0)
    following = np.minimum(first + 1, len(order) - 1)
    paired = position[following] == position[first] + 1
    side = np.where(forward[following] == forward[first], 1, -1)
    records = [
        np.where(forward[first], low[first], high[first]),
        np.where(forward[first], high[first], low[first]),
        owners[first],
        np.where(paired, owners[following], -1),
        np.where(paired, side, 0),
    ]
    return np.ascontiguousarray(np.column_stack(records), dtype=np.int32)


def _position_in_run(*keys: np.ndarray) -> np.ndarray:
    """Return (n,) each entry's position, from 0, in its run of equal and sorted ``keys`` (n,)."""
    index = np.arange(len(keys[0]))
    begins = np.ones(len(index), dtype=bool)
    begins[1:] = np.any([key[1:] != key[:-1] for key in keys], axis=0)
    return index - np.maximum.accumulate(np.where(begins, index, 0))


EMPTY_OUTLINE = outline_of_triangles(np.zeros((0, 3)), np.zeros((0, 3)))
"""The outline of a node without geometry."""


def pack(outlines: tuple[Outline, ...]) -> PackedOutlines:
    """Return outlines, one per node, in the kernel's arrays; cached, as they are immutable."""
    packed = _pack_rest(tuple(outline.rest or outline for outline in outlines))
    if all(outline.rest is None for outline in outlines):
        return packed
    return packed._replace(
        points=np.concatenate([o.vertices for o in outlines]).T.copy(),
        planes=np.concatenate([o.planes for o in outlines]).T.copy(),
        balls=np.array([o.ball for o in outlines]),
    )


def mutable_copy(packed: PackedOutlines) -> PackedOutlines:
    """Return packed outlines with writable copies of points, planes and balls."""
    return packed._replace(
        points=packed.points.copy(), planes=packed.planes.copy(), balls=packed.balls.copy()
    )


@lru_cache(maxsize=256)
def _pack_rest(outlines: tuple[Outline, ...]) -> PackedOutlines:
    """As ``pack``, for outlines whose ``rest`` is None."""
    starts = np.zeros((len(outlines) + 1, 3), dtype=np.int64)
    sizes = [(len(o.vertices), len(o.triangles), len(o.edges)) for o in outlines]
    starts[1:] = np.cumsum(np.array(sizes, dtype=np.int64).reshape(-1, 3), axis=0)
    # Edges in the kernel's convention: those with s1 = -1 first, then by triangle for locality.
    records = []
    for outline in outlines:
        v0, v1, t0, t1, s1 = outline.edges.T
        second = np.where(s1 == 0, len(outline.triangles), t1)
        order = np.lexsort((t0, s1 != -1))
        records.append(np.column_stack([v0, v1, t0, second, s1])[order])
    ordinary = [np.count_nonzero(record[:, 4] == -1) for record in records]
    edges = _stacked(records, 5, np.int32)
    return PackedOutlines(
        points=_stacked([o.vertices for o in outlines], 3, np.float64).T.copy(),
        planes=_stacked([o.planes for o in outlines], 4, np.float64).T.copy(),
        balls=_stacked([o.ball[None] for o in outlines], 4, np.float64),
        triangles=_stacked([o.triangles for o in outlines], 3, np.int32),
        edges=edges[:, :4].T.astype(np.uint32, order="C"),
        sides=edges[:, 4].astype(np.int8),
        starts=starts,
        ordinary_ends=starts[:-1, 2] + np.array(ordinary, dtype=np.int64),
    )


def _stacked(parts: Sequence[np.ndarray], columns: int, dtype: type) -> np.ndarray:
    """Return parts (k, columns) stacked vertically, of type dtype; (0, columns) without parts."""
    return np.ascontiguousarray(np.vstack([np.empty((0, columns), dtype), *parts]), dtype=dtype)


@compiled
def viewpoint_in_node(X: np.ndarray, camera: np.ndarray) -> tuple[float, float, float, float]:
    """Return the viewpoint (e0, e1, e2, w) in a node's frame, in homogeneous coordinates.

    A triangle with plane (n, d) faces a pinhole camera if n . e - d w > 0. For a parallel camera w
    is 0 and e is the viewing direction; facings then have the opposite sign. For a pinhole camera w
    is the squared scale of the pose X, 1 for a rigid one, and the viewpoint is e / w [m].

    Args:
        X: (3 or 4, 4) pose of the node in the camera, possibly scaled uniformly.
        camera: (8,) ``Camera.kernel_parameters()``.
    """
    if camera[0] != 0.0:
        return X[2, 0], X[2, 1], X[2, 2], 0.0
    t0, t1, t2 = X[0, 3], X[1, 3], X[2, 3]
    return (
        -(X[0, 0] * t0 + X[1, 0] * t1 + X[2, 0] * t2),
        -(X[0, 1] * t0 + X[1, 1] * t1 + X[2, 1] * t2),
        -(X[0, 2] * t0 + X[1, 2] * t1 + X[2, 2] * t2),
        X[0, 0] * X[0, 0] + X[1, 0] * X[1, 0] + X[2, 0] * X[2, 0],
    )


@compiled
def place_surface(
    packed: PackedOutlines,
    node: int,
    X_CN: np.ndarray,
    camera: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    facings: np.ndarray,
) -> None:
    """Write where one surface's points lie in the image, and which sides of its triangles it shows.

    Args:
        packed: the surfaces of all nodes, each in its node's frame N.
        node: index of the surface.
        X_CN: (nodes, 3 or 4, 4) poses in the camera.
        camera: (8,) ``Camera.kernel_parameters()``.
        u, v: (points,) output: image coordinates [pixel], at any depth.
        facings: (at least triangles + 1,) int8 output: +1 where a pinhole camera sees the triangle
            counter-clockwise, -1 clockwise, 0 edge-on, and opposite for a parallel camera; 0 after
            the last triangle: the facing of a missing second triangle.
    """
    fx, fy, cx, cy = camera[1], camera[2], camera[3], camera[4]
    begin, end = packed.starts[node, 0], packed.starts[node + 1, 0]
    x, y = packed.points[0, begin:end], packed.points[1, begin:end]
    z = packed.points[2, begin:end]
    X = X_CN[node]
    a0, a1, a2, a3 = fx * X[0, 0], fx * X[0, 1], fx * X[0, 2], fx * X[0, 3]
    b0, b1, b2, b3 = fy * X[1, 0], fy * X[1, 1], fy * X[1, 2], fy * X[1, 3]
    if camera[0] == 1.0:
        a3, b3 = a3 + cx, b3 + cy
        for i in range(x.shape[0]):
            u[i] = a0 * x[i] + a1 * y[i] + a2 * z[i] + a3
            v[i] = b0 * x[i] + b1 * y[i] + b2 * z[i] + b3
    else:
        d0, d1, d2, d3 = X[2, 0], X[2, 1], X[2, 2], X[2, 3]
        for i in range(x.shape[0]):
            inverse = 1.0 / (d0 * x[i] + d1 * y[i] + d2 * z[i] + d3)
            u[i] = (a0 * x[i] + a1 * y[i] + a2 * z[i] + a3) * inverse + cx
            v[i] = (b0 * x[i] + b1 * y[i] + b2 * z[i] + b3) * inverse + cy
    e0, e1, e2, w = viewpoint_in_node(X, camera)
    begin, end = packed.starts[node, 1], packed.starts[node + 1, 1]
    n0, n1 = packed.planes[0, begin:end], packed.planes[1, begin:end]
    n2, offset = packed.planes[2, begin:end], packed.planes[3, begin:end]
    for i in range(n0.shape[0]):
        side = n0[i] * e0 + n1[i] * e1 + n2[i] * e2 - offset[i] * w
        facings[i] = np.int8(side > 0.0) - np.int8(side < 0.0)
    facings[n0.shape[0]] = 0


@compiled
def clip_triangle(
    packed: PackedOutlines,
    node: int,
    t: int,
    X_CN: np.ndarray,
    camera: np.ndarray,
    corners: np.ndarray,
) -> int:
    """Write u, v [pixel] and 1 / depth [1/m] of a triangle's part beyond a pinhole's near plane.

    Args:
        packed: the surfaces of all nodes, each in its node's frame N.
        node: index of the surface.
        X_CN: (nodes, 3 or 4, 4) poses in the camera.
        camera: (8,) ``Camera.kernel_parameters()``.
        t: index of the triangle within its surface.
        corners: (4, 3) output, one corner a row.

    Returns the number of corners: 0, 3 or 4.
    """
    X, near, size = X_CN[node], camera[5], 0
    begin, first = packed.starts[node, 0], packed.starts[node, 1]
    p_C = np.empty((3, 3))
    for k in range(3):
        i = begin + packed.triangles[first + t, k]
        x, y, z = packed.points[0, i], packed.points[1, i], packed.points[2, i]
        for j in range(3):
            p_C[k, j] = X[j, 0] * x + X[j, 1] * y + X[j, 2] * z + X[j, 3]
    for a in range(3):
        b = (a + 1) % 3
        visible = p_C[a, 2] >= near
        if visible:
            corners[size, 0] = camera[1] * p_C[a, 0] / p_C[a, 2] + camera[3]
            corners[size, 1] = camera[2] * p_C[a, 1] / p_C[a, 2] + camera[4]
            corners[size, 2] = 1.0 / p_C[a, 2]
            size += 1
        if visible != (p_C[b, 2] >= near):
            # Interpolate from the visible end, so that both triangles of an edge get equal points.
            i, o = (a, b) if visible else (b, a)
            fraction = (near - p_C[i, 2]) / (p_C[o, 2] - p_C[i, 2])
            x = p_C[i, 0] + fraction * (p_C[o, 0] - p_C[i, 0])
            y = p_C[i, 1] + fraction * (p_C[o, 1] - p_C[i, 1])
            corners[size, 0] = camera[1] * x / near + camera[3]
            corners[size, 1] = camera[2] * y / near + camera[4]
            corners[size, 2] = 1.0 / near
            size += 1
    return size


@compiled
def bend(packed: PackedOutlines, parts: np.ndarray, band: np.ndarray) -> None:
    """Move the vertices of skin bands in place and update planes and balls; balls only grow.

    ``packed``: the surfaces, changed in place. ``parts``: (k, 4) int64, for each band: its surface,
    its first vertex and its first triangle, both counted from the surface's own first, and its
    first row in ``band``. ``band``: (v, 3) positions of the vertices of all bands [m].
    """
    for part in parts:
        node, row = part[0], part[3]
        begin, first = packed.starts[node, 0], packed.starts[node, 1]
        points, planes, ball = packed.points, packed.planes, packed.balls[node]
        max_squared = 0.0
        for i in range(begin + part[1], packed.starts[node + 1, 0]):
            x, y, z = band[row, 0], band[row, 1], band[row, 2]
            row += 1
            points[0, i], points[1, i], points[2, i] = x, y, z
            squared = (x - ball[0]) ** 2 + (y - ball[1]) ** 2 + (z - ball[2]) ** 2
            max_squared = max(max_squared, squared)
        ball[3] = max(ball[3], math.sqrt(max_squared))
        for t in range(first + part[2], packed.starts[node + 1, 1]):
            a = begin + packed.triangles[t, 0]
            b = begin + packed.triangles[t, 1]
            c = begin + packed.triangles[t, 2]
            x, y, z = points[0, a], points[1, a], points[2, a]
            bx, by, bz = points[0, b] - x, points[1, b] - y, points[2, b] - z
            cx, cy, cz = points[0, c] - x, points[1, c] - y, points[2, c] - z
            nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
            planes[0, t], planes[1, t], planes[2, t] = nx, ny, nz
            planes[3, t] = nx * x + ny * y + nz * z


if TYPE_CHECKING:
    from drake_pose.body import PoseTree, TriangleMesh


class BendingOutline:
    """A rigid surface and a skin band in its frame N, whose vertices move.

    Args:
        rigid: the rigid surface.
        band: the band at rest.

    Attributes:
        rest: both parts with the band at rest; the rigid part's vertices and triangles come first.
    """

    def __init__(self, rigid: Outline, band: TriangleMesh) -> None:
        self.rigid = rigid
        own = outline_of_triangles(band.vertices, band.triangles)
        self._band_triangles = own.triangles
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

    def at(self, band: np.ndarray) -> Outline:
        """Return the whole surface with the band's vertices at (v, 3) [m] in frame N."""
        outline = Outline(
            np.concatenate([self.rigid.vertices, band]),
            self.rest.triangles,
            self.rest.edges,
            self.rest,
        )
        # Fill the cached property: only the planes of the band's triangles change.
        bent = Outline(band, self._band_triangles, self.rest.edges[:0])
        vars(outline)["planes"] = np.concatenate([self.rigid.planes, bent.planes])
        return outline


# Outlines of nodes' meshes, while the meshes exist.
_node_outlines: WeakKeyDictionary[TriangleMesh, Outline] = WeakKeyDictionary()


class TreeSurfaces:
    """The surfaces of a pose tree's nodes at any values, each in its node's frame.

    Attributes:
        value_counts: number of values (joint positions) of each node.
        skins: the skin band of each node; None: it has none.
        rigid: the outline of each node's rigid mesh.
        bending: the rigid part and band of each node; None: it has no band.
    """

    def __init__(self, tree: PoseTree) -> None:
        self._nodes = tree.nodes
        self.value_counts = [len(node.value_names) for node in tree.nodes]
        self.skins = [node.skin for node in tree.nodes]
        for node in tree.nodes:
            if node.mesh not in _node_outlines:
                _node_outlines[node.mesh] = outline_from_mesh(node.mesh)
        self.rigid = [_node_outlines[node.mesh] for node in tree.nodes]
        self.bending = [
            None if node.skin is None else BendingOutline(rigid, node.skin.mesh)
            for node, rigid in zip(tree.nodes, self.rigid, strict=True)
        ]

    def with_rigid(self, rigid: Sequence[Outline]) -> TreeSurfaces:
        """Return the surfaces with the same bands and other rigid parts, one outline per node."""
        other = copy.copy(self)
        other.rigid = list(rigid)
        other.bending = [
            None if skin is None else BendingOutline(outline, skin.mesh)
            for skin, outline in zip(self.skins, other.rigid, strict=True)
        ]
        return other

    @property
    def bends(self) -> bool:
        """Whether any node has a skin band."""
        return any(bending is not None for bending in self.bending)

    def whole(self, node: int) -> Outline | BendingOutline:
        """Return a node's surface: with its band if it has one, else its rigid outline."""
        return self.bending[node] or self.rigid[node]

    def at_rest(self, node: int) -> Outline:
        """Return a node's surface with its band at rest."""
        bending = self.bending[node]
        return self.rigid[node] if bending is None else bending.rest

    def node_at(self, node: int, values: np.ndarray) -> Outline:
        """Return a node's whole surface in its frame at its values (k,) [rad or m]."""
        bending, skin = self.bending[node], self._nodes[node].skin
        if bending is None or skin is None:
            return self.rigid[node]
        return bending.at(skin.vertices(np.asarray(values)[None])[0])

    def at(self, values: Sequence[np.ndarray]) -> list[Outline]:
        """Return all nodes' surfaces in their own frames, given each node's values (k_i,)."""
        return [self.node_at(node, part) for node, part in enumerate(values)]


class PackedSurfaces:
    """A tree's surfaces, maybe simplified, in the kernel's arrays, deformed to its values."""

    def __init__(self, surfaces: TreeSurfaces) -> None:
        self._rest = pack(tuple(surfaces.at_rest(node) for node in range(len(surfaces.rigid))))
        # Each band's entry for ``bend``, and the range of its node's values.
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
        # Each thread bends its own copy.
        self._threads = threading.local()

    def at(self, values: np.ndarray) -> PackedOutlines:
        """Return all nodes' surfaces at the tree's values (m,) [rad or m], the nodes' in order."""
        return self._rest if self._bands is None else mutable_copy(self.bend_to(values))

    def bend_to(self, values: np.ndarray | None) -> PackedOutlines:
        """Return all nodes' surfaces at the tree's values, overwritten by the thread's next call.

        ``values``: (m,) [rad or m]; None: leave the bands where this thread's last call put them.
        """
        if self._bands is None:
            return self._rest
        if not hasattr(self._threads, "bent"):
            last_values, placed = (np.full(shape, np.nan) for shape in self._shapes)
            self._threads.bent = mutable_copy(self._rest), last_values, placed
        packed, last_values, placed = self._threads.bent
        if values is not None:
            values = np.ascontiguousarray(values, dtype=np.float64)[None]
            changed = place_bands(self._bands, self._ranges, values, last_values, placed)[0]
            if changed.any():
                parts = self._parts[changed]
                packed.balls[parts[:, 0]] = self._rest.balls[parts[:, 0]]
                bend(packed, parts, placed[0])
        return packed
