"""Which edges of a surface can be on its contour, by the direction it is seen from.

Directions are divided into cells: squares on three faces of a cube, as a direction and its opposite
have the same contour. An edge both of whose triangles turn clearly to one side at the middle of a
cell is on the contour for no direction in it; some tenth of the edges is left.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from drake_pose.body.surfaces.meshes import TriangleMesh
from drake_pose.compiled import compiled
from drake_pose.silhouette.areas.outline import (
    Outline,
    PackedOutlines,
    outline_of_triangles,
    own_copy,
    pack,
)

_CELLS_A_SIDE = 20
# A little more than rounding can move a direction.
_MARGIN = 1e-6


class CelledOutline(NamedTuple):
    """One surface with the edges of every cell, and its band of skin.

    points: (n, 4) vertices, a record each; planes: (m + 1, 4) likewise, and a plane that faces
    nowhere; edges: (e, 5) int32 v0, v1, t0, t1, s1 as packed; cell_starts: (cells + 1,) int64;
    cell_edges: (k,) int32 indices into edges, cell after cell; reach: (1,) the sine of how far the
    directions in which a camera sees the surface's points may differ from that of its ball's
    centre; packed: the surface, then its band, which kernels bend in place; bands: (n, v, 3) the
    band's vertices at the samples of its node [m], n = 0 where there is none.
    """

    points: np.ndarray
    planes: np.ndarray
    edges: np.ndarray
    cell_starts: np.ndarray
    cell_edges: np.ndarray
    reach: np.ndarray
    packed: PackedOutlines
    bands: np.ndarray


def divide_outline(
    outline: Outline,
    spread: float = 0.0,
    band: TriangleMesh | None = None,
    bands: np.ndarray | None = None,
) -> CelledOutline:
    """The surface with its cells.

    Args:
        spread: how far the directions in which a camera sees the surface's points may differ from
            that of its ball's centre [rad]: 0 for parallel rays.
        band: the band of skin that belongs to the surface, at rest; it gets no cells.
        bands: (n, v, 3) its vertices at the samples of its node [m].
    """
    rigid, skin = pack((outline,)), band or TriangleMesh.empty()
    starts, edges = _find_cell_edges(rigid, _CELLS_A_SIDE, spread)
    records = np.vstack([rigid.edges, rigid.sides]).T
    return CelledOutline(
        points=np.column_stack([outline.vertices, np.ones(len(outline.vertices))]),
        planes=np.vstack([outline.planes, np.zeros(4)]),
        edges=np.ascontiguousarray(records, dtype=np.int32),
        cell_starts=starts,
        cell_edges=edges,
        reach=np.array([math.sin(spread)]),
        packed=own_copy(pack((outline, outline_of_triangles(skin.vertices, skin.triangles)))),
        bands=np.ascontiguousarray(np.zeros((0, 0, 3)) if bands is None else bands),
    )


@compiled
def find_cell(x: float, y: float, z: float) -> int:
    """Returns the cell of a direction (of any length but 0)."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, s, t = 0, y / x, z / x
    elif ay >= az:
        face, s, t = 1, x / y, z / y
    else:
        face, s, t = 2, x / z, y / z
    half = 0.5 * _CELLS_A_SIDE
    column = min(int((s + 1.0) * half), _CELLS_A_SIDE - 1)
    row = min(int((t + 1.0) * half), _CELLS_A_SIDE - 1)
    return (face * _CELLS_A_SIDE + row) * _CELLS_A_SIDE + column


def _find_cell_edges(
    packed: PackedOutlines, side: int, spread: float
) -> tuple[np.ndarray, np.ndarray]:
    """CelledOutline's cell_starts and cell_edges."""
    normals, edges = packed.planes[:3].T, packed.edges
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    middles = (2.0 * np.arange(side) + 1.0) / side - 1.0
    # An edge of one triangle, or of two that run the same way, is always a contour.
    always = packed.sides[:, None] != -1
    counts, found = [0], [np.zeros(0, dtype=np.int64)]
    for face, t in itertools.product(range(3), middles):
        directions = _directions(face, middles, t)
        lowest = np.ones(side)
        for ds, dt in itertools.product((-1.0 / side, 1.0 / side), repeat=2):
            corners = _directions(face, middles + ds, t + dt)
            lowest = np.minimum(lowest, (directions * corners).sum(axis=1))
        angles = np.arccos(lowest) + spread + _MARGIN
        limits = np.where(angles < 0.5 * math.pi, np.sin(angles), 2.0)
        heights = normals @ directions.T
        surely = limits * lengths
        facings = np.zeros((len(normals) + 1, side), dtype=np.int8)
        np.subtract(heights > surely, heights < -surely, out=facings[:-1], dtype=np.int8)
        one, other = facings[edges[2]], facings[edges[3]]
        apart = (one == 0) | always | (one != other)
        cells, chosen = np.nonzero(np.ascontiguousarray(apart.T))
        counts += np.bincount(cells, minlength=side).tolist()
        found.append(chosen)
    return np.cumsum(counts), np.concatenate(found).astype(np.int32)


def _directions(face: int, s: np.ndarray, t: float) -> np.ndarray:
    """Unit directions (n, 3) of points (s, t) of a face, s (n,)."""
    columns = [s, np.full_like(s, t)]
    columns.insert(face, np.ones_like(s))
    directions = np.stack(columns, axis=1)
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))
