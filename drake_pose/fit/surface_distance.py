"""How far apart two triangle surfaces are, from points of each to the other's triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_pose.compiled import compiled
from drake_pose.silhouette.areas.outline import Outline

Array = NDArray[np.float64]

_POINTS = 300


def surface_distance(one: Outline, other: Outline) -> float:
    """The root mean square distance of two surfaces [m]; infinite where one has no triangles.

    From points spread evenly over each to the nearest point of the other: what one lacks counts as
    much as what it has too much.
    """
    if len(one.triangles) == 0 or len(other.triangles) == 0:
        return np.inf
    there = _nearest(_spread(one), other.vertices, other.triangles, *_balls(other))
    back = _nearest(_spread(other), one.vertices, one.triangles, *_balls(one))
    return float(np.sqrt(0.5 * (there.mean() + back.mean())))


def _spread(outline: Outline) -> Array:
    """Points (n, 3) of a surface, as many in equal areas."""
    generator = np.random.default_rng(0)
    areas = np.cumsum(np.linalg.norm(outline.planes[:, :3], axis=1))
    where = np.searchsorted(areas, areas[-1] * (np.arange(_POINTS) + 0.5) / _POINTS)
    a, b, c = outline.vertices[outline.triangles[where]].transpose(1, 0, 2)
    across, along = generator.uniform(size=(2, _POINTS, 1))
    return a + np.sqrt(across) * ((b - a) + along * (c - b))


def _balls(outline: Outline) -> tuple[Array, Array]:
    """Centres (m, 3) and radii (m,) of balls around a surface's triangles."""
    corners = outline.vertices[outline.triangles]
    centers = corners.mean(axis=1)
    return centers, np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)


@compiled
def _nearest(
    points: Array, vertices: Array, triangles: NDArray[np.int32], centers: Array, radii: Array
) -> Array:
    """The squared distance of each point (n, 3) to a surface (n,)."""
    result = np.empty(len(points))
    for i in range(len(points)):
        nearest = np.inf
        for vertex in range(len(vertices)):
            nearest = min(nearest, _squared(points[i], vertices[vertex]))
        reach = np.sqrt(nearest)
        for t in range(len(triangles)):
            # Nothing in the ball around a triangle is nearer than what was found.
            if _squared(points[i], centers[t]) < (reach + radii[t]) ** 2:
                distance = _to_triangle(points[i], vertices, triangles[t])
                if distance < nearest:
                    nearest, reach = distance, np.sqrt(distance)
        result[i] = nearest
    return result


@compiled
def _to_triangle(p: Array, vertices: Array, corners: NDArray[np.int32]) -> float:
    """The squared distance of a point (3,) to a triangle; of slivers, to its edges."""
    a = vertices[corners[0]]
    bb = bc = cc = pb = pc = 0.0
    for k in range(3):
        b, c, d = vertices[corners[1], k] - a[k], vertices[corners[2], k] - a[k], p[k] - a[k]
        bb, bc, cc = bb + b * b, bc + b * c, cc + c * c
        pb, pc = pb + d * b, pc + d * c
    area = bb * cc - bc * bc
    if area > 1e-12 * bb * cc:
        u, v = (cc * pb - bc * pc) / area, (bb * pc - bc * pb) / area
        if u >= 0.0 and v >= 0.0 and u + v <= 1.0:
            result = 0.0
            for k in range(3):
                b, c = vertices[corners[1], k] - a[k], vertices[corners[2], k] - a[k]
                result += (p[k] - a[k] - u * b - v * c) ** 2
            return result
    return min(
        _to_segment(p, a, vertices[corners[1]]),
        _to_segment(p, vertices[corners[1]], vertices[corners[2]]),
        _to_segment(p, vertices[corners[2]], a),
    )


@compiled
def _to_segment(p: Array, a: Array, b: Array) -> float:
    """The squared distance of a point (3,) to a segment."""
    length = _squared(a, b)
    along = 0.0
    for k in range(3):
        along += (p[k] - a[k]) * (b[k] - a[k])
    share = 0.0 if length == 0.0 else min(1.0, max(0.0, along / length))
    result = 0.0
    for k in range(3):
        result += (p[k] - a[k] - share * (b[k] - a[k])) ** 2
    return result


@compiled
def _squared(p: Array, q: Array) -> float:
    return (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2
