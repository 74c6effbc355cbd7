"""Which edges of a surface can be on its contour, by the direction it is seen from.

All directions are divided into cells of a few degrees: squares on the faces of a cube. An edge is
on the contour where the camera sees its two triangles from different sides, so an edge both of
whose triangles turn clearly to one side at the middle of a cell is never on the contour for any
direction in the cell. What is left is some tenth of the edges. A direction and its opposite have
the same contour, so three faces of the cube are enough.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.compiled import compiled, with_room
from drake_pose.silhouette.areas.bending import BendingOutline
from drake_pose.silhouette.areas.outline import Outline, PackedOutlines, outline_from_mesh, pack

_CELLS_A_SIDE = 20
# A little more than rounding can move a direction.
_MARGIN = 1e-6


class CelledOutline(NamedTuple):
    """One surface, packed for the kernels, with the edges of every cell.

    packed: the surface alone; points: (n, 4) its vertices, a record each; planes: (m + 1, 4)
    likewise, and a plane that faces nowhere; edges: (e, 5) int32 v0, v1, t0, t1, s1 as in packed;
    cell_starts: (cells + 1,) int64; cell_edges: (k,) int32 indices into edges, cell after cell;
    reach: (1,) the sine of how far the directions in which a camera sees the surface's points may
    differ from that of its ball's centre; bands: (n, v, 3) the vertices of the surface's band of
    skin at the samples of its node [m], n = 0 where it has none; band: the band alone, packed;
    whole: the surface with its band, packed; part: (4,) int64 the band in the latter, as the
    bending kernel wants it.
    """

    packed: PackedOutlines
    points: np.ndarray
    planes: np.ndarray
    edges: np.ndarray
    cell_starts: np.ndarray
    cell_edges: np.ndarray
    reach: np.ndarray
    bands: np.ndarray
    band: PackedOutlines
    whole: PackedOutlines
    part: np.ndarray


def divide_outline(
    outline: Outline,
    spread: float = 0.0,
    band: TriangleMesh | None = None,
    bands: np.ndarray | None = None,
) -> CelledOutline:
    """Returns the surface with its cells.

    Args:
        outline: the surface.
        spread: how far the directions in which a camera sees the surface's points may differ from
            that of its ball's centre [rad]: 0 for parallel rays.
        band: the band of skin that belongs to the surface, at rest; it gets no cells.
        bands: (n, v, 3) its vertices at the samples of its node [m].
    """
    packed = pack((outline,))
    skin = band or TriangleMesh.empty()
    whole = BendingOutline(outline, skin)
    alone = BendingOutline(outline_from_mesh(TriangleMesh.empty()), skin)
    starts, edges = _find_cell_edges(packed, _CELLS_A_SIDE, spread)
    points = np.column_stack([packed.points.T, np.ones(packed.points.shape[1])])
    planes = np.vstack([packed.planes.T, np.zeros(4)])
    records = np.vstack([packed.edges, packed.sides]).T.astype(np.int32)
    return CelledOutline(
        packed=packed,
        points=np.ascontiguousarray(points),
        planes=planes,
        edges=np.ascontiguousarray(records),
        cell_starts=starts,
        cell_edges=edges,
        reach=np.array([math.sin(spread)]),
        bands=np.ascontiguousarray(np.zeros((0, 0, 3)) if bands is None else bands),
        band=pack((alone.rest,)),
        whole=pack((whole.rest,)),
        part=np.array([0, len(outline.vertices), len(outline.triangles), 0], dtype=np.int64),
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


@compiled
def _cell_direction(face: int, s: float, t: float) -> np.ndarray:
    """Returns the unit direction (3,) of a point (s, t) of a face."""
    direction = np.ones(3)
    direction[1 if face == 0 else 0] = s
    direction[1 if face == 2 else 2] = t
    return direction / np.sqrt((direction**2).sum())


@compiled
def _find_cell_edges(
    packed: PackedOutlines, side: int, spread: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns CelledOutline's cell_starts and cell_edges."""
    planes, edges = packed.planes, packed.edges
    triangles = planes.shape[1]
    lengths = np.sqrt(planes[0] ** 2 + planes[1] ** 2 + planes[2] ** 2)
    starts = np.zeros(3 * side * side + 1, dtype=np.int64)
    found = np.empty(edges.shape[1] * 64, dtype=np.int32)
    facings = np.zeros(triangles + 1, dtype=np.int8)
    count = 0
    for cell in range(3 * side * side):
        face, row, column = cell // (side * side), cell // side % side, cell % side
        s, t = (2 * column + 1) / side - 1.0, (2 * row + 1) / side - 1.0
        middle = _cell_direction(face, s, t)
        lowest = 1.0
        for corner in range(4):
            ds, dt = (2 * (corner % 2) - 1) / side, (2 * (corner // 2) - 1) / side
            lowest = min(lowest, (middle * _cell_direction(face, s + ds, t + dt)).sum())
        angle = math.acos(min(1.0, lowest)) + spread + _MARGIN
        limit = math.sin(angle) if angle < 0.5 * math.pi else 2.0
        for i in range(triangles):
            height = planes[0, i] * middle[0] + planes[1, i] * middle[1] + planes[2, i] * middle[2]
            sure = abs(height) > limit * lengths[i]
            facings[i] = 0 if not sure else (1 if height > 0.0 else -1)
        if count + edges.shape[1] > found.shape[0]:
            found = with_room(found, count, 2 * found.shape[0])
        for e in range(edges.shape[1]):
            one, other = facings[edges[2, e]], facings[edges[3, e]]
            # An edge of one triangle, or of two that run the same way, is always a contour.
            if one == 0 or packed.sides[e] != -1 or one != other:
                found[count] = e
                count += 1
        starts[cell + 1] = count
    return starts, found[:count].copy()
