"""Triangle meshes: what a link looks like, as plain arrays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TriangleMesh:
    """A surface of triangles; not necessarily closed, not necessarily connected. Read-only.

    ``vertices``: (n, 3) [m] in the frame of the link; ``triangles``: (m, 3) indices into them.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]

    def __post_init__(self) -> None:
        """Make private read-only copies, so that nobody can change a mesh that others hold."""
        vertices = np.array(self.vertices, dtype=np.float64).reshape(-1, 3)
        triangles = np.array(self.triangles, dtype=np.int32).reshape(-1, 3)
        vertices.setflags(write=False)
        triangles.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles)

    @staticmethod
    def empty() -> "TriangleMesh":
        """A mesh without triangles: a link that is not seen."""
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))

    @property
    def is_empty(self) -> bool:
        """True where there is nothing to draw."""
        return len(self.triangles) == 0

    def transformed(self, X_AB: NDArray[np.float64]) -> "TriangleMesh":
        """The same surface in frame A, given this mesh in frame B and X_AB (4, 4)."""
        vertices_A = self.vertices @ X_AB[:3, :3].T + X_AB[:3, 3]
        return TriangleMesh(vertices_A, self.triangles)


def merge_duplicate_vertices(mesh: TriangleMesh) -> TriangleMesh:
    """Join vertices at exactly the same place, and drop triangles that lose their area by it."""
    if mesh.is_empty:
        return TriangleMesh.empty()
    # As np.unique of rows, which takes five times as long for a million of them.
    by_place = np.lexsort(mesh.vertices.T)
    ordered = mesh.vertices[by_place]
    begins = np.concatenate([[True], np.any(ordered[1:] != ordered[:-1], axis=1)])
    first = by_place[begins]
    inverse = np.empty(len(by_place), dtype=np.int64)
    inverse[by_place] = np.cumsum(begins) - 1
    order = np.argsort(first, kind="stable")
    rank = np.empty(len(order), dtype=np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    triangles = rank[inverse][mesh.triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    vertices = mesh.vertices[first[order]]
    used = np.zeros(len(vertices), dtype=bool)
    used[triangles] = True
    renumbered = np.cumsum(used, dtype=np.int32) - 1
    return TriangleMesh(vertices[used], renumbered[triangles].astype(np.int32))


def join_meshes(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """All triangles of several meshes that are given in one common frame."""
    parts = [mesh for mesh in meshes if not mesh.is_empty]
    if not parts:
        return TriangleMesh.empty()
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in parts[:-1]])
    triangles = [mesh.triangles + offset for mesh, offset in zip(parts, offsets, strict=True)]
    return TriangleMesh(np.concatenate([m.vertices for m in parts]), np.concatenate(triangles))


def is_watertight(mesh: TriangleMesh) -> bool:
    """True where every edge is used exactly once in each of its two directions."""
    if mesh.is_empty:
        return False
    edges = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]]])
    edges = np.concatenate([edges, mesh.triangles[:, [2, 0]]]).astype(np.int64)
    count = len(mesh.vertices)
    forward = np.sort(edges[:, 0] * count + edges[:, 1])
    backward = np.sort(edges[:, 1] * count + edges[:, 0])
    return bool(np.all(np.diff(forward) > 0) and np.array_equal(forward, backward))
