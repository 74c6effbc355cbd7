"""Evidence exact to hundredths of a pixel on exact masks: contours compared along raster lines.

Along every row (and column) the contour of the body and the border of the silhouette are crossed a
few times, each time into or out of the covered part. Each crossing of the one is compared with the
nearest of the same sense of the other, in both directions; their distance d along the line times
the cosine c between line and contour normal is a residual [pixel], of weight
c / 2 / (1 + (d c / scale)^2) (Geman and McClure 1987). A silhouette drawn by pixels has its border
half way between two pixels there, which is where the truth is on average. As with edge points, what
the crossings of a node say adds up to a 12 x 12 matrix.
"""

import math
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.compiled import compiled
from drake_pose.fit.kernel import add_pull, add_pulls, seen_from
from drake_pose.silhouette.contour_points import (
    find_crossings,
    find_line_spans,
    find_segments,
)
from drake_pose.silhouette.outline import PackedOutlines


class Border(NamedTuple):
    """Where a silhouette's border crosses rows and columns of pixel centres.

    rows: (H + 1,) where each row's crossings begin, and (n,) u, half way between two pixels;
    columns: (W + 1,) and (m,) v likewise.
    """

    rows: tuple[Indices, Array]
    columns: tuple[Indices, Array]

    @classmethod
    def nothing(cls, height: int, width: int) -> "Border":
        """Of an empty picture."""
        return cls(
            (np.zeros(height + 1, dtype=np.int64), np.zeros(0)),
            (np.zeros(width + 1, dtype=np.int64), np.zeros(0)),
        )

    @property
    def length(self) -> float:
        """About how long it is [pixel]: crossings a pixel are 4 / pi on average."""
        return (len(self.rows[1]) + len(self.columns[1])) * math.pi / 4.0

    def covered(self, step: int, shape: tuple[int, ...]) -> Mask:
        """What it bounds, in a picture (h, w) of every step-th row and column."""
        starts, places = self.rows
        rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        chosen = rows % step == 0
        columns = np.clip(np.ceil(places[chosen] / step), 0, shape[1]).astype(np.int64)
        changes = np.zeros((shape[0], shape[1] + 1), dtype=np.int8)
        np.add.at(changes, (rows[chosen] // step, columns), 1)
        return np.cumsum(changes, axis=1)[:, :-1] % 2 == 1


def find_border(mask: Mask) -> Border:
    """The border of a silhouette (H, W); what lies beyond the picture counts as outside."""
    found = []
    for pixels in (mask.view(np.uint8), mask.T.view(np.uint8)):
        lines, places = np.nonzero(np.diff(np.pad(pixels, ((0, 0), (1, 1)))))
        starts = np.searchsorted(lines, np.arange(len(pixels) + 1)).astype(np.int64)
        found.append((starts, np.asarray(places - 0.5)))
    return Border(*found)


@compiled
def compare_raster(
    packed: PackedOutlines,
    skin: tuple[Array, Indices],
    X_WN: Array,
    wanted: Mask,
    camera: tuple[Array, Array],
    still: Border,
    border: Border,
    lines: tuple[int, int],
    scale: float,
    slack: float,
    A: Array,
    b: Array,
) -> tuple[float, float, float]:
    """Adds one camera's evidence of the nodes' affine motions.

    Args:
        packed: the nodes' surfaces.
        skin: (v,) by what fraction each vertex follows its own node, and not that node's parent;
            (nodes,) the parents.
        X_WN: (nodes, 4, 4).
        wanted: (nodes,) which nodes move.
        camera: X_CW (4, 4) and kernel parameters (8,).
        still: the border of all other nodes' union.
        border: the silhouette's.
        lines: the step from row to row and column to column that are looked at, and the first.
        scale: residuals beyond it lose weight [pixel].
        slack: distances count by what they are beyond it; 0: all count [pixel].
        A, b: (nodes, 12, 12), lower triangles, and (nodes, 12) added to, as of `compare_contours`.

    Returns:
        Number of pixels that either body or silhouette covers, estimated from the rows; the sum of
        all weights; and that of the weighted squares of the residuals.
    """
    stride, offset = lines
    segments = find_segments(packed, seen_from(camera[0], X_WN), camera[1], wanted)
    ends = segments.ends
    apart, total, squares = 0.0, 0.0, 0.0
    spans = np.empty((ends.shape[0] + 1, 2), dtype=np.int64)
    most = 2 * ends.shape[0] + 2 + max(len(still.rows[1]), len(still.columns[1]))
    chosen = np.empty(most, dtype=np.int64)
    places, slopes = np.empty(most), np.empty(most)
    weights, residuals = np.empty(most), np.empty(most)
    wide = np.zeros((len(X_WN), 13))
    for across in range(2):
        border_starts, border_places = border[across]
        still_starts, still_places = still[across]
        extent = camera[1][6 + across] - 0.5
        count = (int(camera[1][7 - across]) - 1 - offset) // stride + 1
        crossings = find_crossings(segments, across, float(offset), float(stride), count)
        # Of each crossing, and once more where skin follows another node, too.
        p_N, pulls = np.empty((2 * len(crossings[1]), 3)), np.zeros((2 * len(crossings[1]), 7))
        labels = np.empty((2, len(pulls)), dtype=np.int64)
        pulling = 0
        for line in range(count):
            at = offset + line * stride
            first, end = border_starts[at], border_starts[at + 1]
            moving = find_line_spans(segments, across, *crossings, line, spans)
            if moving == 0 and across == 1:
                continue
            found = _unite_line(
                spans, moving, crossings[1], still_places, still_starts[at], still_starts[at + 1],
                places, chosen,
            )  # fmt: skip
            if across == 0:
                apart += _pixels_apart(places, found, border_places, first, end, int(extent + 1.0))
            if first == end or moving == 0:
                continue
            for k in range(found):
                slopes[k] = 1.0
                if chosen[k] >= 0:
                    chosen[k] = s = crossings[2][chosen[k]]
                    du, dv = ends[s, 2] - ends[s, 0], ends[s, 3] - ends[s, 1]
                    slopes[k] = abs(dv if across == 0 else du) / math.sqrt(du * du + dv * dv)
            _compare_line(
                places, slopes, found, border_places, first, end, extent, scale, slack, weights,
                residuals,
            )  # fmt: skip
            for k in range(found):
                s = chosen[k]
                if s < 0 or weights[k] == 0.0:
                    continue
                node = segments.nodes[s]
                low, high = ends[s, 1 - across], ends[s, 3 - across]
                share = (at - low) / (high - low)
                # Straight in the picture is not at even pace along the edge (perspective).
                near, far = segments.depths[s, 0], segments.depths[s, 1]
                share = share * near / (share * near + (1.0 - share) * far)
                i, j = segments.vertices[s, 0], segments.vertices[s, 1]
                # The normal that points on along the line, as the residuals do.
                du, dv = ends[s, 2] - ends[s, 0], ends[s, 3] - ends[s, 1]
                size = math.sqrt(du * du + dv * dv)
                size = size if (high > low) == (across == 0) else -size
                weight, residual = stride * weights[k], residuals[k] / weights[k]
                total += weight
                squares += weight * residual * residual
                # A share of a weight for each node that the point follows: the slope is exact, and
                # the curvature no less than it is.
                own = (1.0 - share) * skin[0][i] + share * skin[0][j]
                for part in range(2 if own < 1.0 else 1):
                    labels[0, pulling] = node
                    labels[1, pulling] = node if part == 0 else skin[1][node]
                    for axis in range(3):
                        begin, after = packed.points[axis, i], packed.points[axis, j]
                        p_N[pulling, axis] = (1.0 - share) * begin + share * after
                    share_of_it = own if part == 0 else 1.0 - own
                    add_pull(pulls, pulling, dv / size, -du / size, -residual, share_of_it * weight)
                    pulling += 1
        nodes, owners = labels
        add_pulls(A, b, wide, X_WN, camera, p_N, nodes[:pulling], owners[:pulling], pulls[:pulling])
    return stride * apart, total, squares


@compiled
def find_body_border(
    packed: PackedOutlines, X_WN: Array, wanted: Mask, camera: tuple[Array, Array]
) -> Border:
    """The border of the wanted nodes' union; arguments as of compare_raster."""
    segments = find_segments(packed, seen_from(camera[0], X_WN), camera[1], wanted)
    spans = np.empty((segments.ends.shape[0] + 1, 2), dtype=np.int64)
    borders = []
    for across in range(2):
        lines = int(camera[1][7 - across])
        starts, places, owners = find_crossings(segments, across, 0.0, 1.0, lines)
        kept, kept_starts = np.empty_like(places), np.zeros(lines + 1, dtype=np.int64)
        count = 0
        for line in range(lines):
            found = find_line_spans(segments, across, starts, places, owners, line, spans)
            for k in range(2 * found):
                kept[count] = places[spans[k // 2, k % 2]]
                count += 1
            kept_starts[line + 1] = count
        borders.append((kept_starts, kept[:count].copy()))
    return Border(borders[0], borders[1])


@compiled
def _unite_line(
    spans: Indices, found: int, moving: Array, still: Array, first: int, end: int, places: Array,
    chosen: Indices,
) -> int:  # fmt: skip
    """Writes where a line enters and leaves the union of moving and still surfaces; their number.

    Args:
        spans, found, moving: the line's moving spans, as from ``find_line_spans``.
        still: the still surfaces' crossings, of this line from ``first`` to ``end``.
        places, chosen: written; chosen is the crossing of the moving surfaces, or -1.
    """
    count, depth, i, j = 0, 0, 0, first
    while i < 2 * found or j < end:
        k = spans[i // 2, i % 2] if i < 2 * found else -1
        if j >= end or (k >= 0 and moving[k] < still[j]):
            place, step = moving[k], 1 - 2 * (i % 2)
            i += 1
        else:
            k, place, step = -1, still[j], 1 - 2 * ((j - first) % 2)
            j += 1
        if depth == 0 or depth + step == 0:
            places[count], chosen[count] = place, k
            count += 1
        depth += step
    return count


@compiled
def _pixels_apart(
    places: Array, count: int, border: Array, first: int, end: int, width: int
) -> float:
    """Number of a line's pixels whose centre either body or silhouette covers, but not both.

    Arguments as of _compare_line; width: the line's length.
    """
    length, open_at, inside = 0.0, -0.5, False
    i, j = 0, first
    while i < count or j < end:
        place = min(max(math.ceil(places[i]), 0), width) - 0.5 if i < count else math.inf
        if j < end and border[j] <= place:
            place = border[j]
            j += 1
        else:
            i += 1
        if inside:
            length += place - open_at
        inside, open_at = not inside, place
    return length


@compiled
def _compare_line(
    places: Array, slopes: Array, count: int, border: Array, first: int, end: int, extent: float,
    scale: float, slack: float, weights: Array, residuals: Array,
) -> None:  # fmt: skip
    """Writes each contour crossing's weight and weighted residual.

    Args:
        places: (count,) the contour's crossings, in turns in and out.
        slopes: (count,) cosines between the line and the contour's normal there.
        border: the silhouette's crossings, of this line from ``first`` to ``end``.
        extent: the picture's end [pixel].
        scale, slack: as of compare_raster.
        weights, residuals: written.
    """
    for k in range(count):
        weights[k] = residuals[k] = 0.0
    # First each crossing of the contour with the nearest of the border, then the other way round.
    for one in range(count + end - first):
        begin, after = (first + one % 2, end) if one < count else ((one - count) % 2, count)
        nearest, best = -1, math.inf
        for other in range(begin, after, 2):
            k, m = (one, other) if one < count else (other, first + one - count)
            distance = places[k] - border[m]
            if abs(distance) < abs(best):
                best, nearest = distance, k
        if nearest < 0 or not -0.5 <= places[nearest] <= extent:
            continue
        residual = best * slopes[nearest]
        weight = 0.5 * slopes[nearest] / (1.0 + (residual / scale) ** 2)
        if slack > 0.0:
            beyond = abs(best) - slack
            if beyond > 0.0:
                hinge = math.copysign(beyond, best) * slopes[nearest]
                residuals[nearest] += weight * hinge
                weights[nearest] += weight
            # Enough to choose among the poses that all bounds allow.
            weight *= 0.03
        weights[nearest] += weight
        residuals[nearest] += weight * residual
