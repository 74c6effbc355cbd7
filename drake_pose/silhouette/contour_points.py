"""Points on the visible contour of a silhouette, and tables of possible contour edges by direction.

Contour points: where the winding number along a row of a raster rises from zero or falls back to
zero, the row enters or leaves the union of all surfaces. Parts of the contour whose normals are
nearer to a row's direction are sampled by rows, the others by columns. Points lie on the contour to
rounding. Sums over points, weighted by their lengths, approximate integrals along the contour.

Tables: viewing directions are divided into square cells on three faces of a cube, because a
direction and its opposite have the same contour. An edge is left out of a cell's table if both its
triangles clearly face the same way at the cell's middle, so that it is on the contour for no
direction in the cell. About a tenth of the edges remain.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np

from drake_pose.body import TriangleMesh
from drake_pose.compiled import compiled, grow_rows, multiply
from drake_pose.silhouette.outline import (
    Outline,
    PackedOutlines,
    mutable_copy,
    outline_of_triangles,
    pack,
    place_surface,
)
from drake_pose.silhouette.span_kernel import make_rows


class Segments(NamedTuple):
    """Projected contour edges.

    Attributes:
        ends: (n, 4) u, v of the start and u, v of the end [pixel].
        depths: (n, 2) depths of both ends [m]; ones for a parallel camera.
        weights: (n,) int64 change of the winding number along a raster line where it crosses the
            edge, if the edge runs towards later lines; otherwise the negative of the change.
        nodes: (n,) int64 index of the surface.
        vertices: (n, 2) int64 indices of both ends in the packed points.
    """

    ends: np.ndarray
    depths: np.ndarray
    weights: np.ndarray
    nodes: np.ndarray
    vertices: np.ndarray


@compiled
def find_segments(
    packed: PackedOutlines,
    X_WN: np.ndarray,
    view: tuple[np.ndarray, np.ndarray],
    selected: np.ndarray,
) -> Segments:
    """Return the projected contour edges of surfaces.

    Triangles with a corner nearer than a pinhole camera's near plane are left out.

    Args:
        packed: the surfaces of all nodes, each in its node's frame N.
        X_WN: (nodes, 4, 4) poses of the nodes; rotations may be scaled uniformly for a parallel
            camera.
        view: X_CW (4, 4) and ``Camera.kernel_parameters()`` (8,) of the camera.
        selected: (nodes,) bool, whether each node's edges are returned.
    """
    X_CW, camera = view
    rows, _ = make_rows(packed, camera)
    capacity, count = 1024, 0
    ends, depths = np.empty((capacity, 4)), np.empty((capacity, 2))
    labels = np.empty((capacity, 4), dtype=np.int64)
    u, v, facings, points = rows.u, rows.v, rows.facings, packed.points
    chosen = np.empty(packed.edges.shape[1], dtype=np.uint32)
    X_CN = np.empty((X_WN.shape[0], 3, 4))
    for node in range(X_WN.shape[0]):
        if not selected[node]:
            continue
        X, ball = X_CN[node], packed.balls[node]
        multiply(X_CW, X_WN[node], X)
        place_surface(packed, node, X_CN, camera, u, v, facings)
        first, t0 = packed.starts[node, 0], packed.starts[node, 1]
        depth = X[2, 0] * ball[0] + X[2, 1] * ball[1] + X[2, 2] * ball[2] + X[2, 3]
        radius = 1.000001 * ball[3] * np.sqrt(X[2, 0] ** 2 + X[2, 1] ** 2 + X[2, 2] ** 2)
        if camera[0] == 0.0 and not depth - radius > camera[5]:
            for t in range(packed.starts[node + 1, 1] - t0):
                for k in range(3):
                    i = first + packed.triangles[t0 + t, k]
                    depth = X[2, 0] * points[0, i] + X[2, 1] * points[1, i]
                    if not depth + X[2, 2] * points[2, i] + X[2, 3] >= camera[5]:
                        facings[t] = 0
        begin, end = packed.starts[node, 2], packed.starts[node + 1, 2]
        sides = packed.sides[begin:end]
        owners, neighbours = packed.edges[2, begin:end], packed.edges[3, begin:end]
        found = 0
        for e in range(len(sides)):
            # Branch-free, because the branch would be unpredictable.
            chosen[found] = e
            found += facings[owners[e]] + sides[e] * facings[neighbours[e]] != 0
        if count + found > capacity:
            capacity = 2 * (count + found)
            ends, depths = grow_rows(ends, count, capacity), grow_rows(depths, count, capacity)
            labels = grow_rows(labels, count, capacity)
        for e in chosen[:found]:
            weight = int(facings[owners[e]]) + int(sides[e]) * int(facings[neighbours[e]])
            labels[count, 0], labels[count, 1] = weight, node
            for k in range(2):
                i = np.int64(packed.edges[k, begin + e])
                ends[count, 2 * k], ends[count, 2 * k + 1] = u[i], v[i]
                i += first
                labels[count, 2 + k], depths[count, k] = i, 1.0
                if camera[0] == 0.0:
                    depth = X[2, 0] * points[0, i] + X[2, 1] * points[1, i]
                    depths[count, k] = depth + X[2, 2] * points[2, i] + X[2, 3]
            count += 1
    return Segments(
        ends[:count], depths[:count], labels[:count, 0], labels[:count, 1], labels[:count, 2:]
    )


@compiled
def find_crossings(
    segments: Segments, across: int, first: float, spacing: float, lines: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where the lines of a raster enter and leave the union of the surfaces.

    An edge crosses lines from its upper (for columns: left) end, included, to its other end,
    excluded.

    Args:
        segments: the contour edges.
        across: 0: the lines are rows, along u; 1: the lines are columns, along v.
        first: coordinate of the first line on the other axis [pixel].
        spacing: distance between lines [pixel].
        lines: number of lines.

    Returns starts (lines + 1,) index of each line's first crossing, places (n,) of the crossings
    along their lines [pixel], ascending and alternately entering and leaving, and indices (n,) of
    their edges.
    """
    ends = segments.ends
    starts = np.zeros(lines + 1, dtype=np.int64)
    # Difference array of the number of edges that cross each line.
    changes = np.zeros(lines + 1, dtype=np.int64)
    # (n, 3) the edges that cross a line, each with its first line and the line after its last.
    crossing, count, scale = np.empty((ends.shape[0] + 1, 3), dtype=np.int64), 0, 1.0 / spacing
    for s in range(ends.shape[0]):
        a, b = (ends[s, 1 - across] - first) * scale, (ends[s, 3 - across] - first) * scale
        begin = np.int64(np.ceil(min(max(min(a, b), 0.0), float(lines))))
        after = np.int64(np.ceil(min(max(max(a, b), 0.0), float(lines))))
        # Branch-free, because the branch would be unpredictable.
        crossing[count, 0], crossing[count, 1], crossing[count, 2] = s, begin, after
        count += int(begin < after)
        changes[begin] += 1
        changes[after] -= 1
    crossed = 0
    for line in range(lines):
        crossed += changes[line]
        starts[line + 1] = starts[line] + crossed
    found, at = np.empty((starts[lines], 3), dtype=np.int64), np.empty(starts[lines])
    n, low, high = 0, np.inf, -np.inf
    for k in range(count):
        s = crossing[k, 0]
        a, b = ends[s, 1 - across], ends[s, 3 - across]
        slope = (ends[s, 2 + across] - ends[s, across]) / (b - a)
        for line in range(crossing[k, 1], crossing[k, 2]):
            at[n] = ends[s, across] + (first + line * spacing - a) * slope
            found[n, 0], found[n, 1] = line, s
            low, high, n = min(low, at[n]), max(high, at[n]), n + 1
    # Bucket sort by place first, so that the insertion sort on each line moves few crossings.
    size = 128
    buckets, per_pixel = np.zeros(size + 2, dtype=np.int64), size / max(high - low, 1e-9)
    for k in range(n):
        found[k, 2] = min(max(int((at[k] - low) * per_pixel), 0), size)
        buckets[found[k, 2] + 1] += 1
    for k in range(size + 1):
        buckets[k + 1] += buckets[k]
    order = np.empty(n, dtype=np.int64)
    for k in range(n):
        order[buckets[found[k, 2]]] = k
        buckets[found[k, 2]] += 1
    places, owners = np.empty(n), np.empty(n, dtype=np.int64)
    used = starts[:-1].copy()
    for index in order:
        line, s, place = found[index, 0], found[index, 1], at[index]
        i = used[line]
        used[line] += 1
        while i > starts[line] and places[i - 1] > place:
            places[i], owners[i] = places[i - 1], owners[i - 1]
            i -= 1
        places[i], owners[i] = place, s
    # Keep the crossings at which the winding number rises from zero or falls back to it, in place.
    # Gaps and overlaps up to the tolerance [pixel] are rounding errors where surfaces touch.
    n, tolerance = 0, 1e-6
    for line in range(lines):
        kept, winding, entry = n, 0, 0
        for k in range(starts[line], used[line]):
            s = owners[k]
            if winding == 0:
                entry = k
            # The weight holds for an edge towards later lines; otherwise its sign is opposite.
            rising = ends[s, 1 - across] < ends[s, 3 - across]
            winding += segments.weights[s] if rising else -segments.weights[s]
            if winding == 0 and places[k] - places[entry] > tolerance:
                if n > kept and places[entry] - places[n - 1] <= tolerance:
                    n -= 1
                else:
                    places[n], owners[n] = places[entry], owners[entry]
                    n += 1
                places[n], owners[n] = places[k], owners[k]
                n += 1
        starts[line] = kept
    starts[lines] = n
    return starts, places[:n], owners[:n]


class ContourPoints(NamedTuple):
    """Points on the contour of a body's silhouette inside the image."""

    uv: np.ndarray  # (n, 2) image coordinates [pixel].
    normals: np.ndarray  # (n, 2) outward unit normals.
    lengths: np.ndarray  # (n,) length of contour that each point represents [pixel].
    nodes: np.ndarray  # (n,) int64 index of the surface that each point lies on.
    p_N: np.ndarray  # (n, 3) the surface point in the surface's frame N [m].
    # (n, 2) distances along the normal [pixel], inwards to where the silhouette ends and outwards
    # to where it begins again, as if the contour there were parallel; inf if it does not begin
    # again.
    clearances: np.ndarray


@compiled
def sample_contour(
    packed: PackedOutlines, X_WN: np.ndarray, view: tuple[np.ndarray, np.ndarray], spacing: float
) -> ContourPoints:
    """Return points on the visible contour of the union of surfaces.

    Args:
        packed, X_WN, view: as of ``find_segments``.
        spacing: distance between sampled rows and between columns [pixel]; the first row and column
            are pixel centres.
    """
    segments, camera = find_segments(packed, X_WN, view, np.ones(len(X_WN), np.bool_)), view[1]
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
    count = 0
    for across in range(2):
        starts, places, owners = crossings[across]
        extent = camera[6 + across] - 0.5
        for line in range(len(starts) - 1):
            for k in range(starts[line], starts[line + 1]):
                place, s, leaves = places[k], owners[k], (k - starts[line]) % 2
                du, dv = ends[s, 2] - ends[s, 0], ends[s, 3] - ends[s, 1]
                steep = abs(dv) >= abs(du)
                if steep != (across == 0) or not -0.5 <= place <= extent:
                    continue
                size = np.sqrt(du * du + dv * dv)
                n0, n1 = dv / size, -du / size
                # Outward: backwards along the line where it enters, forwards where it leaves.
                sign = 1.0 if (n0 if across == 0 else n1) > 0.0 else -1.0
                sign = sign if leaves else -sign
                normals[count, 0], normals[count, 1] = sign * n0, sign * n1
                cosine = abs(normals[count, across])
                lengths[count] = spacing / cosine
                uv[count, across], uv[count, 1 - across] = place, line * spacing
                fraction = (line * spacing - ends[s, 1 - across]) / (dv if across == 0 else du)
                # Perspective-correct interpolation along the edge.
                near, far = segments.depths[s, 0], segments.depths[s, 1]
                fraction = fraction * near / (fraction * near + (1.0 - fraction) * far)
                a, b = segments.vertices[s, 0], segments.vertices[s, 1]
                for i in range(3):
                    p_N[count, i] = (1.0 - fraction) * packed.points[
                        i, a
                    ] + fraction * packed.points[i, b]
                nodes[count] = segments.nodes[s]
                enters = k - leaves
                clearances[count, 0] = cosine * (places[enters + 1] - places[enters])
                clearances[count, 1] = np.inf
                if leaves and k + 1 < starts[line + 1]:
                    clearances[count, 1] = cosine * (places[k + 1] - place)
                elif not leaves and k > starts[line]:
                    clearances[count, 1] = cosine * (place - places[k - 1])
                count += 1
    return ContourPoints(
        uv[:count], normals[:count], lengths[:count], nodes[:count], p_N[:count], clearances[:count]
    )


CELLS_PER_SIDE = 20
"""Number of cells along each side of a face of the cube."""


class CelledOutline(NamedTuple):
    """A surface with the possible contour edges of every cell of directions, and its skin band."""

    points: np.ndarray  # (n, 4) vertices x, y, z, 1 [m].
    # (m + 1, 4) planes of the triangles, and a zero plane for missing triangles.
    planes: np.ndarray
    edges: np.ndarray  # (e, 5) int32 v0, v1, t0, t1, s1 as packed.
    # (cells + 1,) int64 index of each cell's first entry in ``cell_edges``.
    cell_starts: np.ndarray
    cell_edges: np.ndarray  # (k,) int32 indices of edges, cell after cell.
    # (1,) sine of the largest angle between the viewing directions of the surface's points and of
    # its ball's centre for which the cells are valid.
    max_sine: np.ndarray
    packed: PackedOutlines  # The surface, then its band, which kernels deform in place.
    # (n, v, 3) vertices of the band at the samples of its node [m]; n = 0 without a band.
    bands: np.ndarray


def divide_outline(
    outline: Outline,
    spread: float = 0.0,
    band: TriangleMesh | None = None,
    bands: np.ndarray | None = None,
) -> CelledOutline:
    """Return a surface with the possible contour edges for each cell of viewing directions.

    Args:
        outline: the rigid surface, in its node's frame N.
        spread: largest angle between the viewing directions of the surface's points and of its
            ball's centre [rad]; 0 for parallel rays.
        band: the surface's skin band at rest, which gets no cells; None: no band.
        bands: (n, v, 3) vertices of the band at the samples of its node, in frame N [m]; None: no
            band.
    """
    rigid, skin = pack((outline,)), band or TriangleMesh.empty()
    starts, edges = _find_cell_edges(rigid, CELLS_PER_SIDE, spread)
    records = np.vstack([rigid.edges, rigid.sides]).T
    return CelledOutline(
        points=np.column_stack([outline.vertices, np.ones(len(outline.vertices))]),
        planes=np.vstack([outline.planes, np.zeros(4)]),
        edges=np.ascontiguousarray(records, dtype=np.int32),
        cell_starts=starts,
        cell_edges=edges,
        max_sine=np.array([math.sin(spread)]),
        packed=mutable_copy(pack((outline, outline_of_triangles(skin.vertices, skin.triangles)))),
        bands=np.ascontiguousarray(np.zeros((0, 0, 3)) if bands is None else bands),
    )


def _find_cell_edges(
    packed: PackedOutlines, side: int, spread: float, margin: float = 1e-6
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``cell_starts`` and ``cell_edges`` of ``CelledOutline``.

    Args:
        packed: the one surface.
        side: number of cells along each side of a face.
        spread: largest angle between the viewing directions of the surface's points and of its
            ball's centre [rad].
        margin: tolerance for rounding errors of directions [rad].
    """
    normals, edges = packed.planes[:3].T, packed.edges
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    middles = (2.0 * np.arange(side) + 1.0) / side - 1.0
    # An edge of one triangle, or of two that traverse it alike, is always on the contour.
    always = packed.sides[:, None] != -1
    counts, found = [0], [np.zeros(0, dtype=np.int64)]
    for face, t in itertools.product(range(3), middles):
        directions = _directions(face, middles, t)
        lowest = np.ones(side)
        for ds, dt in itertools.product((-1.0 / side, 1.0 / side), repeat=2):
            corners = _directions(face, middles + ds, t + dt)
            lowest = np.minimum(lowest, (directions * corners).sum(axis=1))
        angles = np.arccos(lowest) + spread + margin
        limits = np.where(angles < 0.5 * math.pi, np.sin(angles), 2.0)
        heights = normals @ directions.T
        thresholds = limits * lengths
        facings = np.zeros((len(normals) + 1, side), dtype=np.int8)
        np.subtract(heights > thresholds, heights < -thresholds, out=facings[:-1], dtype=np.int8)
        first, second = facings[edges[2]], facings[edges[3]]
        possible = (first == 0) | always | (first != second)
        cells, chosen = np.nonzero(np.ascontiguousarray(possible.T))
        counts += np.bincount(cells, minlength=side).tolist()
        found.append(chosen)
    return np.cumsum(counts), np.concatenate(found).astype(np.int32)


def _directions(face: int, s: np.ndarray, t: float) -> np.ndarray:
    """Return unit directions (n, 3) of points on a face of the cube [-1, 1]^3.

    ``face``: the axis on which all are 1. ``s``, ``t``: coordinates on the other axes.
    """
    columns = [s, np.full_like(s, t)]
    columns.insert(face, np.ones_like(s))
    directions = np.stack(columns, axis=1)
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))
