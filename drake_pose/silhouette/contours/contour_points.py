"""The visible contour of a body's silhouette as points, exact where a row or column crosses it.

Where the winding number along a row of a raster rises from zero or falls back to it, the row enters
or leaves the union of all surfaces. A stretch of contour whose normal is nearer to a row is sampled
by rows, else by columns. Points lie on the contour to rounding; sums over them times their lengths
are sums along the contour.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drake_pose.compiled import compiled
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.contours.contour_segments import (
    find_crossings,
    find_line_spans,
    find_segments,
)


class ContourPoints(NamedTuple):
    """Points of the contour of a body's silhouette inside the picture.

    Attributes:
        uv: (n, 2) where they are seen [pixel].
        normals: (n, 2) unit normals out of the silhouette.
        lengths: (n,) the length of contour that each stands for [pixel].
        nodes: (n,) int64 the surface each lies on.
        p_N: (n, 3) the point of that surface, in its frame N [m].
        clearances: (n, 2) how far along the normals it is inwards to where the silhouette ends
            again, and outwards to where it begins again, inf where it does not, as if the
            contour there were parallel to here [pixel].
    """

    uv: np.ndarray
    normals: np.ndarray
    lengths: np.ndarray
    nodes: np.ndarray
    p_N: np.ndarray
    clearances: np.ndarray


@compiled
def sample_contour(
    packed: PackedOutlines, X_CN: np.ndarray, camera: np.ndarray, spacing: float
) -> ContourPoints:
    """Points of the visible contour of the union of surfaces.

    Args:
        X_CN: (nodes, 4, 4) their poses in the camera; for a parallel camera their rotations may be
            scaled uniformly.
        camera: (8,) kernel parameters. Triangles nearer than its near plane are left out.
        spacing: from row to row and from column to column [pixel], positive; the first row and
            column are pixel centres, and with a spacing of 1 all are.
    """
    segments = find_segments(packed, X_CN, camera, np.ones(len(X_CN), dtype=np.bool_))
    ends = segments.ends
    crossings = [(np.zeros(1, np.int64), np.zeros(1), np.zeros(1, np.int64)) for _ in range(0)]
    capacity = 0
    for across in range(2):
        lines = int((camera[7 - across] - 1.0) / spacing) + 1
        crossings.append(find_crossings(segments, across, 0.0, spacing, lines))
        capacity += len(crossings[across][1])
    uv, normals, lengths = np.empty((capacity, 2)), np.empty((capacity, 2)), np.empty(capacity)
    nodes, p_N = np.empty(capacity, dtype=np.int64), np.empty((capacity, 3))
    clearances = np.empty((capacity, 2))
    spans = np.empty((capacity // 2 + 1, 2), dtype=np.int64)
    count = 0
    for across in range(2):
        starts, places, owners = crossings[across]
        extent = camera[6 + across] - 0.5
        for line in range(len(starts) - 1):
            found = find_line_spans(segments, across, starts, places, owners, line, spans)
            for k in range(2 * found):
                crossing = spans[k // 2, k % 2]
                place, s = places[crossing], owners[crossing]
                du, dv = ends[s, 2] - ends[s, 0], ends[s, 3] - ends[s, 1]
                steep = abs(dv) >= abs(du)
                if steep != (across == 0) or not -0.5 <= place <= extent:
                    continue
                size = np.sqrt(du * du + dv * dv)
                n0, n1 = dv / size, -du / size
                # Out of the silhouette: back along the line where it enters, on where it leaves.
                sign = 1.0 if (n0 if across == 0 else n1) > 0.0 else -1.0
                sign = sign if k % 2 == 1 else -sign
                normals[count, 0], normals[count, 1] = sign * n0, sign * n1
                lengths[count] = spacing / abs(normals[count, across])
                uv[count, across], uv[count, 1 - across] = place, line * spacing
                share = (line * spacing - ends[s, 1 - across]) / (dv if across == 0 else du)
                # Straight in the picture is not at even pace along the edge (perspective).
                near, far = segments.depths[s, 0], segments.depths[s, 1]
                share = share * near / (share * near + (1.0 - share) * far)
                a, b = segments.vertices[s, 0], segments.vertices[s, 1]
                for i in range(3):
                    p_N[count, i] = (1.0 - share) * packed.points[i, a] + share * packed.points[
                        i, b
                    ]
                nodes[count] = segments.nodes[s]
                straight = abs(normals[count, across])
                clearances[count, 0] = straight * (
                    places[spans[k // 2, 1]] - places[spans[k // 2, 0]]
                )
                clearances[count, 1] = np.inf
                if k % 2 == 1 and k + 1 < 2 * found:
                    clearances[count, 1] = straight * (places[spans[k // 2 + 1, 0]] - place)
                elif k % 2 == 0 and k > 0:
                    clearances[count, 1] = straight * (place - places[spans[k // 2 - 1, 1]])
                count += 1
    return ContourPoints(
        uv[:count],
        normals[:count],
        lengths[:count],
        nodes[:count],
        p_N[:count],
        clearances[:count],
    )
