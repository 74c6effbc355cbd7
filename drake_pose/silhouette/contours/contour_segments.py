"""Projected contour edges, and where they cross the rows and columns of a raster."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled, with_room
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.areas.viewpoint import viewpoint_in_node

# Slits and overlaps narrower than this [pixel] are rounding where surfaces touch.
_SLIT = 1e-6


class Segments(NamedTuple):
    """Projected contour edges.

    ends: (n, 4) u, v of their start and end [pixel]; depths: (n, 2) there [m]; ones for a parallel
    camera; weights: (n,) int64 how the winding number changes across; nodes: (n,) int64; vertices:
    (n, 2) int64 indices into the packed points.
    """

    ends: np.ndarray
    depths: np.ndarray
    weights: np.ndarray
    nodes: np.ndarray
    vertices: np.ndarray


@compiled
def _project_node(
    packed: PackedOutlines, node: int, X: np.ndarray, camera: np.ndarray, uvz: np.ndarray
) -> None:
    """Writes u, v and depth (3, points) of one surface; depth 1 for a parallel camera."""
    begin, end = packed.starts[node, 0], packed.starts[node + 1, 0]
    for i in range(end - begin):
        x, y, z = (
            packed.points[0, begin + i],
            packed.points[1, begin + i],
            packed.points[2, begin + i],
        )
        across = X[0, 0] * x + X[0, 1] * y + X[0, 2] * z + X[0, 3]
        down = X[1, 0] * x + X[1, 1] * y + X[1, 2] * z + X[1, 3]
        depth = 1.0
        if camera[0] == 0.0:
            depth = X[2, 0] * x + X[2, 1] * y + X[2, 2] * z + X[2, 3]
        uvz[0, i] = camera[1] * across / depth + camera[3]
        uvz[1, i] = camera[2] * down / depth + camera[4]
        uvz[2, i] = depth


@compiled
def _find_facings(
    packed: PackedOutlines,
    node: int,
    X: np.ndarray,
    camera: np.ndarray,
    uvz: np.ndarray,
    facings: np.ndarray,
) -> None:
    """Writes which side of each triangle is seen: +1, 0 or -1; 0 after the last and too near."""
    e0, e1, e2, share = viewpoint_in_node(X, camera)
    begin, end = packed.starts[node, 1], packed.starts[node + 1, 1]
    for i in range(end - begin):
        t = begin + i
        side = packed.planes[0, t] * e0 + packed.planes[1, t] * e1 + packed.planes[2, t] * e2
        side -= packed.planes[3, t] * share
        facings[i] = np.int64(side > 0.0) - np.int64(side < 0.0)
        if camera[0] == 0.0:
            for k in range(3):
                if not uvz[2, packed.triangles[t, k]] >= camera[5]:
                    facings[i] = 0
    facings[end - begin] = 0


@compiled
def find_segments(packed: PackedOutlines, X_CN: np.ndarray, camera: np.ndarray) -> Segments:
    """Returns the projected contour edges of all surfaces at poses X_CN (nodes, 4, 4)."""
    most_points, most_triangles = 0, 0
    for node in range(X_CN.shape[0]):
        most_points = max(most_points, packed.starts[node + 1, 0] - packed.starts[node, 0])
        most_triangles = max(most_triangles, packed.starts[node + 1, 1] - packed.starts[node, 1])
    uvz = np.empty((3, most_points))
    facings = np.empty(most_triangles + 1, dtype=np.int64)
    capacity, count = 1024, 0
    ends, depths = np.empty((capacity, 4)), np.empty((capacity, 2))
    labels = np.empty((capacity, 4), dtype=np.int64)
    edges = packed.edges
    for node in range(X_CN.shape[0]):
        _project_node(packed, node, X_CN[node], camera, uvz)
        _find_facings(packed, node, X_CN[node], camera, uvz, facings)
        first = packed.starts[node, 0]
        for e in range(packed.starts[node, 2], packed.starts[node + 1, 2]):
            weight = facings[edges[2, e]] + np.int64(packed.sides[e]) * facings[edges[3, e]]
            if weight == 0:
                continue
            if count == capacity:
                capacity *= 2
                ends, depths = with_room(ends, count, capacity), with_room(depths, count, capacity)
                labels = with_room(labels, count, capacity)
            a, b = np.int64(edges[0, e]), np.int64(edges[1, e])
            ends[count, 0], ends[count, 1] = uvz[0, a], uvz[1, a]
            ends[count, 2], ends[count, 3] = uvz[0, b], uvz[1, b]
            depths[count, 0], depths[count, 1] = uvz[2, a], uvz[2, b]
            labels[count, 0], labels[count, 1] = weight, node
            labels[count, 2], labels[count, 3] = first + a, first + b
            count += 1
    return Segments(
        ends[:count], depths[:count], labels[:count, 0], labels[:count, 1], labels[:count, 2:]
    )


@compiled
def find_crossings(
    segments: Segments, across: int, first: float, spacing: float, lines: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the contour edges cross lines of a raster, sorted along each line.

    An edge crosses the lines from its lower end, included, to its upper, excluded.

    Args:
        segments: the projected contour edges.
        across: 0: the lines are rows, along u; 1: columns, along v.
        first: where the first line is, on the other axis [pixel].
        spacing: from line to line [pixel].
        lines: their number.

    Returns:
        starts (lines + 1,) of the lines' crossings, their places (n,) [pixel] and segments (n,).
    """
    ends = segments.ends
    counts = np.zeros(lines + 1, dtype=np.int64)
    begin = np.empty(ends.shape[0], dtype=np.int64)
    after = np.empty(ends.shape[0], dtype=np.int64)
    for s in range(ends.shape[0]):
        a, b = ends[s, 1 - across], ends[s, 3 - across]
        low, high = (min(a, b) - first) / spacing, (max(a, b) - first) / spacing
        begin[s] = after[s] = 0
        if high > 0.0 and low <= lines - 1:
            begin[s] = np.int64(np.ceil(max(low, 0.0)))
            after[s] = np.int64(np.ceil(min(high, float(lines))))
        for line in range(begin[s], after[s]):
            counts[line + 1] += 1
    for line in range(lines):
        counts[line + 1] += counts[line]
    starts = counts
    places = np.empty(starts[lines])
    owners = np.empty(starts[lines], dtype=np.int64)
    used = starts[:-1].copy()
    for s in range(ends.shape[0]):
        a, b = ends[s, 1 - across], ends[s, 3 - across]
        for line in range(begin[s], after[s]):
            share = (first + line * spacing - a) / (b - a)
            place = ends[s, across] + share * (ends[s, 2 + across] - ends[s, across])
            k = used[line]
            used[line] += 1
            while k > starts[line] and places[k - 1] > place:
                places[k], owners[k] = places[k - 1], owners[k - 1]
                k -= 1
            places[k], owners[k] = place, s
    return starts, places, owners


@compiled
def find_line_spans(
    segments: Segments,
    across: int,
    starts: np.ndarray,
    places: np.ndarray,
    owners: np.ndarray,
    line: int,
    spans: np.ndarray,
) -> int:
    """Writes the covered spans of one line as indices of crossings (k, 2); returns their number."""
    found, winding, start = 0, 0, 0
    ends = segments.ends
    for k in range(starts[line], starts[line + 1]):
        s = owners[k]
        if winding == 0:
            start = k
        # Both runs of an edge cross a line at one place, in opposite directions.
        rising = ends[s, 1 - across] < ends[s, 3 - across]
        winding += segments.weights[s] if rising else -segments.weights[s]
        if winding == 0 and places[k] - places[start] > _SLIT:
            if found > 0 and places[start] - places[spans[found - 1, 1]] <= _SLIT:
                spans[found - 1, 1] = k
            else:
                spans[found, 0], spans[found, 1] = start, k
                found += 1
    return found
