"""The span kernel for surfaces of which a part has other vertices at every pose."""

from __future__ import annotations

import math

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.areas.span_kernel import (
    _FIRST_CAPACITY,
    _add_areas,
    _fill_safely,
    _make_work,
)


@compiled
def own_copy(packed: PackedOutlines) -> PackedOutlines:
    """Returns surfaces whose points, planes and balls may be changed."""
    return PackedOutlines(
        packed.points.copy(),
        packed.planes.copy(),
        packed.balls.copy(),
        packed.triangles,
        packed.edges,
        packed.sides,
        packed.starts,
        packed.ordinary_ends,
    )


@compiled
def bend(own: PackedOutlines, part: np.ndarray, band: np.ndarray) -> None:
    """Puts the vertices of one surface's band at other places.

    Args:
        own: the surfaces, changed: the band's points, their planes, and the surface's ball, which
            only grows.
        part: (4,) int64 the surface, its first vertex of the band and its first triangle of the
            band, both counted from the surface's own first; the band's first row in ``band``.
        band: (v, 3) places of the vertices of all bands [m].
    """
    node, row = part[0], part[3]
    begin, first = own.starts[node, 0], own.starts[node, 1]
    points, planes, ball = own.points, own.planes, own.balls[node]
    farthest = 0.0
    for i in range(begin + part[1], own.starts[node + 1, 0]):
        x, y, z = band[row, 0], band[row, 1], band[row, 2]
        row += 1
        points[0, i], points[1, i], points[2, i] = x, y, z
        away = (x - ball[0]) ** 2 + (y - ball[1]) ** 2 + (z - ball[2]) ** 2
        farthest = max(farthest, away)
    ball[3] = max(ball[3], math.sqrt(farthest))
    for t in range(first + part[2], own.starts[node + 1, 1]):
        a = begin + own.triangles[t, 0]
        b = begin + own.triangles[t, 1]
        c = begin + own.triangles[t, 2]
        x, y, z = points[0, a], points[1, a], points[2, a]
        bx, by, bz = points[0, b] - x, points[1, b] - y, points[2, b] - z
        cx, cy, cz = points[0, c] - x, points[1, c] - y, points[2, c] - z
        nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        planes[0, t], planes[1, t], planes[2, t] = nx, ny, nz
        planes[3, t] = nx * x + ny * y + nz * z


@compiled
def score_bent(
    packed: PackedOutlines,
    parts: np.ndarray,
    bands: np.ndarray,
    X_CN: np.ndarray,
    camera: np.ndarray,
    prefixes: np.ndarray,
) -> np.ndarray:
    """Areas of whole bodies with bands, and of their intersections with sets.

    Args:
        packed: the body's surfaces at rest.
        parts: (b, 4) int64 the bands, as in ``bend``.
        bands: (n, v, 3) the vertices of all bands, one band after the other, at each pose [m].
        X_CN: (n, nodes, 3, 4) the poses in the camera.
        camera: (8,) kernel parameters of the camera.
        prefixes: (k, H, W + 1) int32 prefix sums of the sets.

    Returns:
        (n, 1 + k) int64 area inside the picture, then area of intersection with each set [pixel].
    """
    own, work = own_copy(packed), _make_work(packed, camera)
    crossings = np.empty((int(camera[7]), _FIRST_CAPACITY), dtype=np.int32)
    areas = np.zeros((X_CN.shape[0], 1 + prefixes.shape[0]), dtype=np.int64)
    for n in range(X_CN.shape[0]):
        for k in range(parts.shape[0]):
            bend(own, parts[k], bands[n])
        crossings = _fill_safely(own, X_CN[n], camera, crossings, work)
        _add_areas(work, crossings, prefixes, areas[n])
    return areas
