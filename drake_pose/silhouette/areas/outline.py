"""A surface made ready for the span kernel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

if TYPE_CHECKING:
    from drake_pose.body import TriangleMesh


@dataclass(frozen=True, eq=False)
class Outline:
    """A triangle surface and its edges, each with the one or two triangles it bounds.

    Any set of triangles will do: holes, inner parts and edges of three triangles (of which there
    are several records) included.

    Args:
        vertices: (n, 3) float64 points in the surface's own frame N [m].
        triangles: (m, 3) int32 vertex indices, in any orientation.
        edges: (e, 5) int32 records v0, v1, t0, t1, s1: the triangle t0 runs from v0 to v1; s1 is +1
            where t1 does, too, and -1 where it runs back; t1 = -1, s1 = 0: no second triangle.
        rest: the surface that this is with some vertices moved; what they share is packed once.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    edges: np.ndarray
    rest: Outline | None = None

    @cached_property
    def moments(self) -> np.ndarray:
        """(4, 4) means of the products of x, y, z and 1 over the vertices [m^2, m, 1]."""
        points = np.column_stack([self.vertices, np.ones(len(self.vertices))])
        return points.T @ points / max(len(points), 1)

    @cached_property
    def planes(self) -> np.ndarray:
        """(m, 4) twice the area times the unit normal [m^2], and its product with a corner."""
        corners = self.vertices[self.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        offsets = np.einsum("ij,ij->i", normals, corners[:, 0])
        return np.column_stack([normals, offsets])

    @cached_property
    def is_closed(self) -> bool:
        """Whether all parts are closed, and run around counter-clockwise seen from outside."""
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
        """(4,) centre of a ball around the vertices, and its radius [m]."""
        if len(self.vertices) == 0:
            return np.zeros(4)
        center = 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))
        radius = np.sqrt(((self.vertices - center) ** 2).sum(axis=1).max())
        return np.append(center, radius)


class PackedOutlines(NamedTuple):
    """Several outlines one after the other, in the arrays that the kernel walks.

    points: (3, n) float64; planes: (4, m) float64; balls: (nodes, 4) float64;
    triangles: (m, 3) int32; edges: (4, e) uint32 rows v0, v1, t0, t1, where indices count from
    the outline's own first vertex and triangle and t1 = the outline's number of triangles where
    there is none; sides: (e,) int8 s1; starts: (nodes + 1, 3) int64 first vertex, triangle and edge
    of each outline; ordinary_ends: (nodes,) int64 where the edges end whose triangles run in
    opposite directions (s1 = -1); they come first.
    """

    points: np.ndarray
    planes: np.ndarray
    balls: np.ndarray
    triangles: np.ndarray
    edges: np.ndarray
    sides: np.ndarray
    starts: np.ndarray
    ordinary_ends: np.ndarray


def outline_from_mesh(mesh: TriangleMesh) -> Outline:
    """The outline of a mesh; vertices at equal places are merged, null triangles left out."""
    places = np.asarray(mesh.vertices, dtype=np.float64).reshape(-1, 3) + 0.0  # -0.0 becomes 0.0
    vertices, renumbered = np.unique(places, axis=0, return_inverse=True)
    triangles = renumbered.reshape(-1)[np.asarray(mesh.triangles, dtype=np.int64).reshape(-1, 3)]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return outline_of_triangles(np.ascontiguousarray(vertices[used]), renumbered.reshape(-1, 3))


def outline_of_triangles(vertices: np.ndarray, triangles: np.ndarray) -> Outline:
    """The outline of vertices (n, 3) and triangles (m, 3) as they are."""
    indices = np.asarray(triangles, dtype=np.int32).reshape(-1, 3)
    return Outline(np.asarray(vertices).reshape(-1, 3), indices, edge_records(indices))


def edge_records(triangles: np.ndarray) -> np.ndarray:
    """Returns the records of Outline.edges."""
    heads = triangles.T.reshape(-1).astype(np.int64)
    tails = triangles[:, [1, 2, 0]].T.reshape(-1).astype(np.int64)
    owners = np.tile(np.arange(len(triangles)), 3)
    forward = heads < tails
    low, high = np.minimum(heads, tails), np.maximum(heads, tails)
    # Order the uses of an edge forward, backward, forward, backward, ..., then what is left over,
    # and pair them from the start: as many pairs as can be run in opposite directions, which
    # cancel wherever both triangles face the same way.
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
    """Returns each entry's position in its run of equal keys."""
    index = np.arange(len(keys[0]))
    begins = np.ones(len(index), dtype=bool)
    begins[1:] = np.any([key[1:] != key[:-1] for key in keys], axis=0)
    return index - np.maximum.accumulate(np.where(begins, index, 0))


NOTHING = outline_of_triangles(np.zeros((0, 3)), np.zeros((0, 3)))
"""The outline of a part without a surface."""


def pack(outlines: tuple[Outline, ...]) -> PackedOutlines:
    """Returns outlines in the kernel's arrays (remembered: outlines are immutable)."""
    packed = _pack_rest(tuple(outline.rest or outline for outline in outlines))
    if all(outline.rest is None for outline in outlines):
        return packed
    return packed._replace(
        points=np.concatenate([o.vertices for o in outlines]).T.copy(),
        planes=np.concatenate([o.planes for o in outlines]).T.copy(),
        balls=np.array([o.ball for o in outlines]),
    )


def own_copy(packed: PackedOutlines) -> PackedOutlines:
    """The surfaces with points, planes and balls that may be changed."""
    return packed._replace(
        points=packed.points.copy(), planes=packed.planes.copy(), balls=packed.balls.copy()
    )


@lru_cache(maxsize=256)
def _pack_rest(outlines: tuple[Outline, ...]) -> PackedOutlines:
    """As pack, for outlines that are at rest."""
    starts = np.zeros((len(outlines) + 1, 3), dtype=np.int64)
    sizes = [(len(o.vertices), len(o.triangles), len(o.edges)) for o in outlines]
    starts[1:] = np.cumsum(np.array(sizes, dtype=np.int64).reshape(-1, 3), axis=0)
    records = [_kernel_edges(outline) for outline in outlines]
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


def _kernel_edges(outline: Outline) -> np.ndarray:
    """Returns the records (e, 5) as the kernel has them, those with s1 = -1 first."""
    v0, v1, t0, t1, s1 = outline.edges.T
    other = np.where(s1 == 0, len(outline.triangles), t1)
    order = np.lexsort((t0, s1 != -1))  # neighbours in memory, too
    return np.column_stack([v0, v1, t0, other, s1])[order]


def _stacked(parts: Sequence[np.ndarray], columns: int, dtype: type) -> np.ndarray:
    """Returns arrays (k, columns) below each other; none gives (0, columns)."""
    return np.ascontiguousarray(np.vstack([np.empty((0, columns), dtype), *parts]), dtype=dtype)
