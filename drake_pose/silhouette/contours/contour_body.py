"""A body whose contour edges are found quickly, by the direction that each surface is seen from."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.compiled import compiled, copy_into, with_room
from drake_pose.silhouette.areas.outline import Outline
from drake_pose.silhouette.contours.contour_segments import Segments
from drake_pose.silhouette.contours.direction_cells import CelledOutline, divide_outline, find_cell

# Cells are made for these spreads of directions [rad], the smallest that will do.
_SPREADS = tuple(0.02 * 1.5**k for k in range(9))
# How much nearer a surface may come before its cells are too narrow.
_NEARER = 0.7


class ContourBody(NamedTuple):
    """All surfaces of a body one after the other, with the edges of every cell.

    points: (v, 3) vertices, each in its surface's frame [m]; planes: (t + 1, 4) as Outline.planes,
    and one that faces nowhere; edges: (e, 5) int64 v0, v1, t0, t1, s1 as in PackedOutlines,
    counted through all surfaces; edge_starts: (surfaces + 1,); cell_starts: (surfaces, cells + 1)
    and cell_edges: the edges of each surface and cell; balls: (surfaces, 4) centre and radius [m];
    reaches: (surfaces,) sine of the spread of directions that the cells allow, -1 for surfaces
    without cells; weights: (v,) how far each vertex follows the values of its own node.
    """

    points: np.ndarray
    planes: np.ndarray
    edges: np.ndarray
    edge_starts: np.ndarray
    cell_starts: np.ndarray
    cell_edges: np.ndarray
    balls: np.ndarray
    reaches: np.ndarray
    weights: np.ndarray


def contour_body(
    outlines: Sequence[Outline],
    X_CN: np.ndarray,
    camera: Camera,
    rigid: int | None = None,
) -> ContourBody:
    """A body made ready for a camera.

    Args:
        X_CN: (nodes, 4, 4) about where they are in the camera: a pinhole sees near surfaces from
            many directions. At other poses the contour is the same but may take longer.
        rigid: how many of the surfaces keep their shape; those after them, whose vertices will be
            moved, get no cells. None: all.
    """
    rigid = len(outlines) if rigid is None else rigid
    spreads: list[float | None] = [0.0 if i < rigid else None for i in range(len(outlines))]
    if not isinstance(camera, ParallelCamera):
        for i, (outline, X) in enumerate(zip(outlines[:rigid], X_CN[:rigid], strict=True)):
            center = X[:3, :3] @ outline.ball[:3] + X[:3, 3]
            distance = max(_NEARER * float(np.linalg.norm(center)), 1e-9)
            needed = float(np.arcsin(min(1.0, float(outline.ball[3]) / distance)))
            spreads[i] = next((spread for spread in _SPREADS if spread >= needed), _SPREADS[-1])
    return _join(tuple(outlines), tuple(spreads))


@lru_cache(maxsize=64)
def _join(outlines: tuple[Outline, ...], spreads: tuple[float | None, ...]) -> ContourBody:
    """The surfaces with cells of their spreads; None: without."""
    celled = [
        _divide(outline, spread or 0.0) for outline, spread in zip(outlines, spreads, strict=True)
    ]
    vertices = np.cumsum([0, *(len(outline.vertices) for outline in outlines)])
    triangles = np.cumsum([0, *(len(outline.triangles) for outline in outlines)])
    edge_starts = np.cumsum([0, *(len(part.edges) for part in celled)])
    cell_counts = np.cumsum([0, *(len(part.cell_edges) for part in celled)])
    edges = []
    for i, part in enumerate(celled):
        records = part.edges.astype(np.int64)
        lonely = records[:, 3] == len(outlines[i].triangles)
        records[:, :2] += vertices[i]
        records[:, 2:4] += triangles[i]
        records[lonely, 3] = triangles[-1]
        edges.append(records)
    return ContourBody(
        points=_stack([outline.vertices for outline in outlines], 3, np.float64),
        planes=_stack([*(outline.planes for outline in outlines), np.zeros((1, 4))], 4, np.float64),
        edges=_stack(edges, 5, np.int64),
        edge_starts=edge_starts,
        cell_starts=np.array(
            [p.cell_starts + n for p, n in zip(celled, cell_counts, strict=False)]
        ),
        cell_edges=np.concatenate(
            [
                np.zeros(0, np.int64),
                *(p.cell_edges + n for p, n in zip(celled, edge_starts, strict=False)),
            ]
        ),
        balls=_stack([outline.ball[None] for outline in outlines], 4, np.float64),
        reaches=np.array([-1.0 if s is None else np.sin(s) for s in spreads]),
        weights=np.ones(vertices[-1]),
    )


@lru_cache(maxsize=512)
def _divide(outline: Outline, spread: float) -> CelledOutline:
    """One surface's cells, remembered."""
    return divide_outline(outline, spread)


def _stack(parts: Sequence[np.ndarray], columns: int, dtype: type) -> np.ndarray:
    """Arrays (k, columns) below each other."""
    return np.ascontiguousarray(np.vstack([np.empty((0, columns), dtype), *parts]), dtype=dtype)


@compiled
def move_surface(
    points: np.ndarray, planes: np.ndarray, triangles: np.ndarray, vertices: np.ndarray
) -> None:
    """Gives one surface of a ContourBody other vertices (v, 3) [m] in the surface's frame.

    ``points`` and ``planes`` are the body's from the surface's first on, and written.
    """
    copy_into(points, vertices)
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x, y, z = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        bx, by, bz = vertices[b, 0] - x, vertices[b, 1] - y, vertices[b, 2] - z
        cx, cy, cz = vertices[c, 0] - x, vertices[c, 1] - y, vertices[c, 2] - z
        n0, n1, n2 = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        planes[t, 0], planes[t, 1], planes[t, 2] = n0, n1, n2
        planes[t, 3] = n0 * x + n1 * y + n2 * z


@compiled(inline="always")
def _facing(
    planes: np.ndarray,
    t: int,
    viewpoint_x: float,
    viewpoint_y: float,
    viewpoint_z: float,
    near: float,
) -> int:
    """Which side of a plane an viewpoint sees: a point (near = 1) or a direction (near = 0)."""
    side = planes[t, 0] * viewpoint_x + planes[t, 1] * viewpoint_y + planes[t, 2] * viewpoint_z
    side -= planes[t, 3] * near
    return int(side > 0.0) - int(side < 0.0)


@compiled
def _find_viewpoint(X: np.ndarray, camera: np.ndarray, viewpoint: np.ndarray) -> None:
    """Writes where the camera is in a surface's frame, as _facing takes it."""
    if camera[0] == 1.0:
        viewpoint[0], viewpoint[1], viewpoint[2], viewpoint[3] = X[2, 0], X[2, 1], X[2, 2], 0.0
        return
    size = X[0, 0] ** 2 + X[1, 0] ** 2 + X[2, 0] ** 2
    for k in range(3):
        viewpoint[k] = -(X[0, k] * X[0, 3] + X[1, k] * X[1, 3] + X[2, k] * X[2, 3]) / size
    viewpoint[3] = 1.0


@compiled
def find_body_segments(
    body: ContourBody, X_CN: np.ndarray, camera: np.ndarray, wanted: np.ndarray
) -> Segments:
    """The projected contour edges of wanted surfaces; ``vertices`` index ``body.points``.

    Edges with an end nearer than a pinhole's near plane are left out. X_CN: (surfaces, 4, 4).
    """
    capacity, count = 2048, 0
    ends, depths = np.empty((capacity, 4)), np.empty((capacity, 2))
    labels = np.empty((capacity, 4), dtype=np.int64)
    viewpoint, uvz = np.empty(4), np.empty((2, 3))
    points, planes, edges, cell_edges = body.points, body.planes, body.edges, body.cell_edges
    for surface in range(X_CN.shape[0]):
        begin, end = body.edge_starts[surface], body.edge_starts[surface + 1]
        if not wanted[surface] or begin == end:
            continue
        X = X_CN[surface]
        _find_viewpoint(X, camera, viewpoint)
        away = viewpoint[:3] - viewpoint[3] * body.balls[surface, :3]
        distance = np.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2)
        in_cell = camera[0] == 1.0 or body.balls[surface, 3] <= body.reaches[surface] * distance
        in_cell = in_cell and body.reaches[surface] >= 0.0
        if in_cell:
            cell = find_cell(away[0], away[1], away[2])
            begin, end = body.cell_starts[surface, cell], body.cell_starts[surface, cell + 1]
        ex, ey, ez, near = viewpoint[0], viewpoint[1], viewpoint[2], viewpoint[3]
        for index in range(begin, end):
            e = cell_edges[index] if in_cell else index
            weight = _facing(planes, edges[e, 2], ex, ey, ez, near)
            weight += edges[e, 4] * _facing(planes, edges[e, 3], ex, ey, ez, near)
            if weight == 0:
                continue
            seen = True
            for k in range(2):
                x, y, z = points[edges[e, k], 0], points[edges[e, k], 1], points[edges[e, k], 2]
                across = X[0, 0] * x + X[0, 1] * y + X[0, 2] * z + X[0, 3]
                down = X[1, 0] * x + X[1, 1] * y + X[1, 2] * z + X[1, 3]
                depth = 1.0
                if camera[0] == 0.0:
                    depth = X[2, 0] * x + X[2, 1] * y + X[2, 2] * z + X[2, 3]
                    seen = seen and depth >= camera[5]
                uvz[k, 0] = camera[1] * across / depth + camera[3]
                uvz[k, 1] = camera[2] * down / depth + camera[4]
                uvz[k, 2] = depth
            if not seen:
                continue
            if count == capacity:
                capacity *= 2
                ends, depths = with_room(ends, count, capacity), with_room(depths, count, capacity)
                labels = with_room(labels, count, capacity)
            ends[count, 0], ends[count, 1] = uvz[0, 0], uvz[0, 1]
            ends[count, 2], ends[count, 3] = uvz[1, 0], uvz[1, 1]
            depths[count, 0], depths[count, 1] = uvz[0, 2], uvz[1, 2]
            labels[count, 0], labels[count, 1] = weight, surface
            labels[count, 2], labels[count, 3] = edges[e, 0], edges[e, 1]
            count += 1
    return Segments(
        ends[:count], depths[:count], labels[:count, 0], labels[:count, 1], labels[:count, 2:]
    )
