"""Residuals accurate to hundredths of a pixel on exact masks, along raster lines.

Along every row (and column) the contour of the body and the border of the silhouette have a few
crossings, alternately entering and leaving. Each crossing is matched to the nearest one of the same
sense of the other, in both directions. With d the distance along the line and c the cosine between
the line and the contour's normal, the residual is d c [pixel] and its weight
c / 2 / (1 + (d c / scale)^2) (Geman and McClure 1987). The border of a rasterised silhouette lies
half way between two pixels, which is unbiased. As with edge points, the crossings of a node add up
to a 12 x 12 matrix.
"""

import math
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.compiled import compiled
from drake_pose.fit.kernel import accumulate_residuals, add_residual
from drake_pose.silhouette.contour_points import find_crossings, find_segments
from drake_pose.silhouette.outline import PackedOutlines


class Border(NamedTuple):
    """Crossings of a silhouette's border with rows and columns of pixel centres.

    Attributes:
        rows: (H + 1,) index of each row's first crossing, and (n,) u of the crossings, half way
            between two pixels.
        columns: (W + 1,) index of each column's first crossing, and (m,) v likewise.
    """

    rows: tuple[Indices, Array]
    columns: tuple[Indices, Array]

    @classmethod
    def empty(cls, height: int, width: int) -> "Border":
        """Return the border of an empty mask (height, width), without crossings."""
        return cls(
            (np.zeros(height + 1, dtype=np.int64), np.zeros(0)),
            (np.zeros(width + 1, dtype=np.int64), np.zeros(0)),
        )

    @property
    def length(self) -> float:
        """Approximate length [pixel]: there are 4 / pi crossings per pixel on average."""
        return (len(self.rows[1]) + len(self.columns[1])) * math.pi / 4.0

    def covered(self, step: int, shape: tuple[int, ...]) -> Mask:
        """Return the mask inside the border, on every step-th row and column.

        Args:
            step: distance between the rows and between the columns that are kept [pixel]; the first
                ones are 0.
            shape: shape (h, w) of the mask: the image's, divided by the step and rounded up.
        """
        starts, places = self.rows
        rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        chosen = rows % step == 0
        columns = np.clip(np.ceil(places[chosen] / step), 0, shape[1]).astype(np.int64)
        changes = np.zeros((shape[0], shape[1] + 1), dtype=np.int8)
        np.add.at(changes, (rows[chosen] // step, columns), 1)
        return np.cumsum(changes, axis=1)[:, :-1] % 2 == 1


def find_border(mask: Mask) -> Border:
    """Return the border of a silhouette (H, W); pixels beyond the image count as outside."""
    found = []
    for pixels in (mask.view(np.uint8), mask.T.view(np.uint8)):
        lines, places = np.nonzero(np.diff(np.pad(pixels, ((0, 0), (1, 1)))))
        starts = np.searchsorted(lines, np.arange(len(pixels) + 1)).astype(np.int64)
        found.append((starts, np.asarray(places - 0.5)))
    return Border(*found)


@compiled
def compare_raster(
    packed: PackedOutlines, skin: tuple[Array, Indices], X_WN: Array, is_moving: Mask,
    camera: tuple[Array, Array], static_border: Border, border: Border, lines: tuple[int, int],
    scale: float, slack: float, A: Array, b: Array,
) -> tuple[float, float, float]:  # fmt: skip
    """Add one camera's quadratic cost of the nodes' affine motions to A and b.

    Args:
        packed: surfaces of the nodes.
        skin: (v,) fraction by which each vertex follows its own node rather than that node's
            parent; (nodes,) indices of the parents.
        X_WN, is_moving: (nodes, 4, 4) poses of the nodes, and (nodes,) whether a node moves.
        camera: X_CW (4, 4) and `Camera.kernel_parameters` (8,).
        static_border: border of the union of all other nodes, see `find_body_border`.
        border: border of the silhouette.
        lines: step between the rows and columns used, and index of the first one [pixel].
        scale: residual at which the weight drops to a half [pixel].
        slack: only the excess of a distance along the line over this counts [pixel], and with 0.03
            of the weight the whole distance; 0: the whole distance counts.
        A, b: (nodes, 12, 12), lower triangles, and (nodes, 12), added to: the cost
            x^T A x - 2 b^T x of each node's affine motion x (12,), the rows of (M v).

    Returns number of pixels covered by exactly one of body and silhouette, estimated from the rows;
    sum of all weights; weighted sum of squared residuals.
    """
    segments = find_segments(packed, X_WN, camera, is_moving)
    ends, (stride, offset) = segments.ends, lines
    differing, total, squares = 0.0, 0.0, 0.0
    most = 2 * ends.shape[0] + 2 + max(len(static_border.rows[1]), len(static_border.columns[1]))
    chosen = np.empty(most, dtype=np.int64)
    places, slopes = np.empty(most), np.empty(most)
    weights, residuals = np.empty(most), np.empty(most)
    bias_terms = np.zeros((len(X_WN), 13))
    for across in range(2):
        border_starts, border_places = border[across]
        still_starts, still_places = static_border[across]
        extent = camera[1][6 + across] - 0.5
        count = (int(camera[1][7 - across]) - 1 - offset) // stride + 1
        found_crossings = find_crossings(segments, across, float(offset), float(stride), count)
        starts, moving, owners = found_crossings
        # One entry per crossing, and a second one where skin follows two nodes.
        p_N, point_sums = np.empty((2 * len(moving), 3)), np.zeros((2 * len(moving), 7))
        nodes = np.empty(len(point_sums), dtype=np.int64)
        followed = np.empty_like(nodes)
        entries = 0
        for line in range(count):
            at = offset + line * stride
            first, end = border_starts[at], border_starts[at + 1]
            is_crossed = starts[line] < starts[line + 1]
            if not is_crossed and across == 1:
                continue
            found = _unite_line(
                moving, owners, starts[line], starts[line + 1], still_places, still_starts[at],
                still_starts[at + 1], places, chosen,
            )  # fmt: skip
            if across == 0:
                width = int(extent + 1.0)
                differing += _pixels_apart(places, found, border_places, first, end, width)
            if first == end or not is_crossed:
                continue
            for k in range(found):
                slopes[k], s = 1.0, chosen[k]
                if s >= 0:
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
                weight, residual = stride * weights[k], residuals[k] / weights[k]
                total += weight
                squares += weight * residual * residual
                low, high = ends[s, 1 - across], ends[s, 3 - across]
                along = (at - low) / (high - low)
                near, far = segments.depths[s, 0], segments.depths[s, 1]
                along = along * near / (along * near + (1.0 - along) * far)  # Perspective.
                i, j = segments.vertices[s, 0], segments.vertices[s, 1]
                du, dv = ends[s, 2] - ends[s, 0], ends[s, 3] - ends[s, 1]
                size = math.sqrt(du * du + dv * dv)  # Its sign turns the normal as residuals go.
                size = size if (high > low) == (across == 0) else -size
                # Split the weight: the gradient is exact, and the curvature an upper bound.
                own_fraction = (1.0 - along) * skin[0][i] + along * skin[0][j]
                for part in range(2 if own_fraction < 1.0 else 1):
                    nodes[entries] = node = segments.nodes[s]
                    followed[entries] = node if part == 0 else skin[1][node]
                    for axis in range(3):
                        begin, after = packed.points[axis, i], packed.points[axis, j]
                        p_N[entries, axis] = (1.0 - along) * begin + along * after
                    share = weight * (own_fraction if part == 0 else 1.0 - own_fraction)
                    add_residual(point_sums, entries, dv / size, -du / size, -residual, share)
                    entries += 1
        accumulate_residuals(
            A, b, bias_terms, X_WN, camera, p_N, nodes[:entries], followed[:entries],
            point_sums[:entries],
        )  # fmt: skip
    return stride * differing, total, squares


def find_body_border(
    packed: PackedOutlines, X_WN: Array, is_moving: Mask, camera: tuple[Array, Array]
) -> Border:
    """Return the border of the union of some nodes in a camera's image.

    Args:
        packed: surfaces of all nodes.
        X_WN: (nodes, 4, 4) poses of the nodes.
        is_moving: (nodes,) whether a node belongs to the union.
        camera: X_CW (4, 4) and `Camera.kernel_parameters` (8,).
    """
    segments = find_segments(packed, X_WN, camera, is_moving)
    sizes = (int(camera[1][7]), int(camera[1][6]))
    found = (find_crossings(segments, k, 0.0, 1.0, lines) for k, lines in enumerate(sizes))
    return Border(*((starts, places) for starts, places, _ in found))


@compiled
def _unite_line(
    moving: Array, owners: Indices, begin: int, after: int, static_border: Array, first: int,
    end: int, places: Array, chosen: Indices,
) -> int:  # fmt: skip
    """Write where a line enters and leaves the union of moving and static surfaces.

    Args:
        moving: positions of the moving surfaces' crossings along their lines [pixel], alternately
            entering and leaving.
        owners: the crossings' edges.
        begin, after: range of this line's moving crossings.
        static_border: positions of the static surfaces' crossings, likewise.
        first, end: range of this line's static crossings.
        places, chosen: output (count,): positions along the line, ascending and alternately
            entering and leaving [pixel], and the edge of the moving crossing, or -1 if it is
            static.

    Returns number of positions; the rest of the output is unchanged.
    """
    count, depth, i, j = 0, 0, begin, first
    while i < after or j < end:
        if j >= end or (i < after and moving[i] < static_border[j]):
            place, owner, step = moving[i], owners[i], 1 - 2 * ((i - begin) % 2)
            i += 1
        else:
            place, owner, step = static_border[j], -1, 1 - 2 * ((j - first) % 2)
            j += 1
        if depth == 0 or depth + step == 0:
            places[count], chosen[count] = place, owner
            count += 1
        depth += step
    return count


@compiled
def _pixels_apart(
    places: Array, count: int, border: Array, first: int, end: int, width: int
) -> float:
    """Return the number of a line's pixel centres covered by exactly one of body and silhouette.

    ``places``: ascending crossings of the contour [pixel], the first ``count`` of them. ``border``:
    those of the silhouette, ``first`` to ``end`` of this line. ``width``: its length [pixel].
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
    """Write the weight and the weighted residual of each contour crossing.

    Each crossing of either border is matched to the nearest one of the other border that has the
    same sense. Contour crossings beyond the image are ignored.

    Args:
        places: (count,) positions of the contour's crossings, alternately entering and leaving
            [pixel].
        slopes: (count,) cosines between the line and the contour's normal.
        border: positions of the silhouette's crossings; those of this line are ``first`` to
            ``end``.
        extent: end of the image along the line [pixel].
        scale: residual at which the weight drops to a half [pixel].
        slack: distance along the line that hardly counts [pixel], see compare_raster; 0: none.
        weights, residuals: (count,) output: sum over the matches of the weights, and of the
            weights times the residuals (contour minus silhouette) [pixel].
    """
    for k in range(count):
        weights[k] = residuals[k] = 0.0
    # Match each contour crossing to the nearest border crossing, then vice versa.
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
            # A small weight inside the slack selects among poses that satisfy all bounds.
            weight *= 0.03
        weights[nearest] += weight
        residuals[nearest] += weight * residual
