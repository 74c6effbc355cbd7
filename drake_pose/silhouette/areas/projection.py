"""Packed surfaces seen by a camera: the arithmetic that all kernels share."""

import math

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.silhouette.areas.outline import PackedOutlines


@compiled
def viewpoint_in_node(X: np.ndarray, camera: np.ndarray) -> tuple[float, float, float, float]:
    """Where a camera stands, or the way it looks, in a node's frame, times a last number.

    That is 0 for a parallel camera's way; else 1, where the pose X has not grown.
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
def project(
    packed: PackedOutlines,
    node: int,
    X_CN: np.ndarray,
    camera: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
) -> None:
    """Writes u, v [pixel] of one surface's points, whatever their depth."""
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
        return
    d0, d1, d2, d3 = X[2, 0], X[2, 1], X[2, 2], X[2, 3]
    for i in range(x.shape[0]):
        inverse = 1.0 / (d0 * x[i] + d1 * y[i] + d2 * z[i] + d3)
        u[i] = (a0 * x[i] + a1 * y[i] + a2 * z[i] + a3) * inverse + cx
        v[i] = (b0 * x[i] + b1 * y[i] + b2 * z[i] + b3) * inverse + cy


@compiled
def find_facings(
    packed: PackedOutlines, node: int, X_CN: np.ndarray, camera: np.ndarray, facings: np.ndarray
) -> None:
    """Writes which side of each triangle the camera sees: +1, 0 or -1; 0 after the last."""
    e0, e1, e2, share = viewpoint_in_node(X_CN[node], camera)
    begin, end = packed.starts[node, 1], packed.starts[node + 1, 1]
    n0, n1 = packed.planes[0, begin:end], packed.planes[1, begin:end]
    n2, offset = packed.planes[2, begin:end], packed.planes[3, begin:end]
    for i in range(n0.shape[0]):
        side = n0[i] * e0 + n1[i] * e1 + n2[i] * e2 - offset[i] * share
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
    """Writes u, v and 1 / depth of the corners of a triangle's part beyond a pinhole's near plane.

    ``t`` is the triangle among its own; ``X_CN`` (nodes, 3 or 4, 4); ``corners`` (4, 3).

    Returns how many corners there are: 0, 3 or 4.
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
            # From the visible end to the hidden one, whichever way the triangle runs.
            i, o = (a, b) if visible else (b, a)
            share = (near - p_C[i, 2]) / (p_C[o, 2] - p_C[i, 2])
            x = p_C[i, 0] + share * (p_C[o, 0] - p_C[i, 0])
            y = p_C[i, 1] + share * (p_C[o, 1] - p_C[i, 1])
            corners[size, 0] = camera[1] * x / near + camera[3]
            corners[size, 1] = camera[2] * y / near + camera[4]
            corners[size, 2] = 1.0 / near
            size += 1
    return size


@compiled
def bend(own: PackedOutlines, parts: np.ndarray, band: np.ndarray) -> None:
    """Puts the vertices of surfaces' bands at other places; the surfaces' balls only grow.

    Args:
        parts: (k, 4) int64 each surface, its first vertex of the band and its first triangle of the
            band, both counted from the surface's own first; the band's first row in ``band``.
        band: (v, 3) places of the vertices of all bands [m].
    """
    for part in parts:
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
