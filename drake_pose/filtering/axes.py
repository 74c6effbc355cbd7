"""The axes of segments in a silhouette, matched to a rough pose.

Shimada et al., (11), (12) and figure 17: no picture says which part of it shows which segment. A
rough pose does: each point of the silhouette's edge goes to the side of a segment that is nearest.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.fit.evidence import EdgePoints

SPACING = 2.0
"""The spacing of the silhouette's edge points that are matched [pixel]."""

GATES = (14.0, 9.0, 6.0, 4.0)
"""How far from a rough side edge points may be, from match to match [pixel]."""

# A point's error; how much of an edge errs together, more as the next frame errs alike; how far a
# side lies from where a width says; what no edge is surer than: of a line's place and direction,
# and of a tip [pixel, rad].
_EDGE_DEVIATION, _CORRELATION, _WIDTH_DEVIATION = 0.35, 8.0, 0.4
_SUREST, _SUREST_ANGLE, _SUREST_TIP = 0.1, math.radians(0.2), 0.15
# A line or a tip that is less sure is not measured [rad, pixel].
_LEAST_SURE_ANGLE, _LEAST_SURE_TIP = math.radians(10.0), 3.0
# A point's normal must agree with the side's to this cosine; ends of sides are not matched.
_FACING, _FACING_TIP, _END = 0.85, 0.7, 0.08
# So far outside a side the rough body must show nothing: else the side is hidden [pixel].
_BESIDE = 2.0
_ROUNDS = 4
# A segment that points at the camera shows no axis [pixel].
_SHORTEST = 5.0


class RoughBody(NamedTuple):
    """What a rough pose shows in one picture [pixel].

    Attributes:
        ends: (L, 2, 2) start and end of each segment's axis, or of an edge.
        widths: (L,) half the width of a segment; 0 for an edge.
        sides: (L, 2) whether a side may be seen: that of the normal (-y, x), and the other.
        tips: (T,) the lines that end in a round tip of their width.
        drawn: (H, W) the body.
    """

    ends: Array
    widths: Array
    sides: Mask
    tips: NDArray[np.intp]
    drawn: NDArray[np.uint8] | Mask


class Axes(NamedTuple):
    """Lines and tips, NaN where not seen.

    Attributes:
        lines: (L, 2) alpha, the angle from start to end [rad], and rho [pixel]: points (u, v) of a
            line have rho = v cos(alpha) - u sin(alpha).
        line_covariances: (L, 2, 2).
        tips: (T, 2) [pixel]; tip_covariances: (T, 2, 2).
    """

    lines: Array
    line_covariances: Array
    tips: Array
    tip_covariances: Array


class _Matched(NamedTuple):
    """Edge points by the feature they were matched to: offset = slope @ (its two unknowns)."""

    feature: NDArray[np.intp]
    side: NDArray[np.intp]
    slope: Array
    offset: Array
    weight: Array


def match_axes(
    edge: EdgePoints, rough: RoughBody, gate: float, origin: tuple[float, float] = (0.0, 0.0)
) -> Axes:
    """The axes of segments that a silhouette's edge shows, both sides or one.

    Args:
        gate: how far from the rough side an edge point may be [pixel].
        origin: where the picture's point (0, 0) of the lines and tips is [pixel].
    """
    count = len(rough.ends)
    along = rough.ends[:, 1] - rough.ends[:, 0]
    size = np.linalg.norm(along, axis=1)
    along = along / np.maximum(size, 1e-9)[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    matched = _match(edge, rough, gate, along, normal, size)
    solution, covariance, sides = _solve(matched, count + len(rough.tips), gate)
    one_sided = (rough.widths > 0) & (sides[:count].min(axis=1) < 0.3 * sides[:count].max(axis=1))
    shift, turn = solution[:count].T
    C = covariance[:count]
    C[:, 0, 0] += np.where(one_sided, _WIDTH_DEVIATION**2, 0.0) + _SUREST**2
    C[:, 1, 1] += _SUREST_ANGLE**2
    middle = rough.ends.mean(axis=1) - origin + shift[:, None] * normal
    alpha = np.arctan2(along[:, 1], along[:, 0]) + np.arctan(turn)
    alpha = np.remainder(alpha + np.pi, 2 * np.pi) - np.pi
    c, s = np.cos(alpha), np.sin(alpha)
    lines = np.column_stack([alpha, c * middle[:, 1] - s * middle[:, 0]])
    # rho changes with alpha by minus the distance along the axis.
    J = np.zeros((count, 2, 2))
    J[:, 0, 1], J[:, 1, 0], J[:, 1, 1] = 1.0, 1.0, -(c * middle[:, 0] + s * middle[:, 1])
    lines[(C[:, 1, 1] > _LEAST_SURE_ANGLE**2) | (size < _SHORTEST)] = np.nan
    tips = rough.ends[rough.tips, 1] - origin + solution[count:]
    tip_covariances = covariance[count:] + _SUREST_TIP**2 * np.eye(2)
    # The end of a segment that points at the camera may be its joint.
    unsure = np.linalg.eigvalsh(tip_covariances)[:, 1] > _LEAST_SURE_TIP**2
    tips[unsure | (size < rough.widths)[rough.tips]] = np.nan
    return Axes(lines, J @ C @ J.transpose(0, 2, 1), tips, tip_covariances)


def _match(
    edge: EdgePoints, rough: RoughBody, gate: float, along: Array, normal: Array, size: Array
) -> _Matched:
    """Gives each edge point to the visible side or tip that is nearest, within the gate."""
    line, side = np.nonzero(rough.sides)
    sign, uv = 1.0 - 2.0 * side, edge.uv
    relative = uv - rough.ends[line, :1]
    place = np.einsum("cnk,ck->cn", relative, along[line])
    across = np.einsum("cnk,ck->cn", relative, normal[line])
    outside = sign[:, None] * across - rough.widths[line, None]
    facing = sign[:, None] * (normal[line] @ edge.normals.T)
    share = place / np.maximum(size[line], 1e-9)[:, None]
    beside = uv + (sign[:, None] * (_BESIDE - outside))[..., None] * normal[line, None]
    can = (np.abs(outside) < gate) & (facing > _FACING) & (np.abs(share - 0.5) < 0.5 - _END)
    can &= _is_empty(rough.drawn, beside)
    ends, widths = rough.ends[rough.tips, 1], rough.widths[rough.tips]
    radial = uv - ends[:, None]
    distance = np.linalg.norm(radial, axis=2)
    radial = radial / np.maximum(distance, 1e-9)[..., None]
    beyond = distance - widths[:, None]
    beside = ends[:, None] + (widths[:, None, None] + _BESIDE) * radial
    round_tip = (np.abs(beyond) < gate) & _is_empty(rough.drawn, beside)
    round_tip &= np.einsum("tnk,nk->tn", radial, edge.normals) > _FACING_TIP
    round_tip &= np.einsum("tnk,tk->tn", radial, along[rough.tips]) > 0.1
    cost = np.abs(np.vstack([outside, beyond]))
    cost[~np.vstack([can, round_tip])] = np.inf
    nearest = np.argmin(cost, axis=0)
    points = np.flatnonzero(np.isfinite(cost[nearest, np.arange(len(uv))]))
    own = nearest[points]
    is_tip = own >= len(line)
    k, t = np.where(is_tip, 0, own), np.where(is_tip, own - len(line), 0)
    lever = (share[k, points] - 0.5) * size[line[k]]
    on_line = np.column_stack([np.ones(len(points)), lever])
    slope = on_line
    offset = sign[k] * outside[k, points]
    feature = line[k]
    if len(rough.tips):
        slope = np.where(is_tip[:, None], radial[t, points], on_line)
        offset = np.where(is_tip, beyond[t, points], offset)
        feature = np.where(is_tip, len(rough.ends) + t, feature)
    return _Matched(feature, side[k], slope, offset, edge.lengths[points])


def _is_empty(drawn: NDArray[np.uint8] | Mask, uv: Array) -> Mask:
    """Whether a picture shows nothing at points (..., 2), the nearest ones inside of it."""
    size = (drawn.shape[1] - 1, drawn.shape[0] - 1)
    u, v = np.moveaxis(np.clip(np.rint(uv).astype(np.intp), 0, size), -1, 0)
    return np.asarray(drawn[v, u] == 0)


def _solve(matched: _Matched, count: int, gate: float) -> tuple[Array, Array, Array]:
    """Each feature's unknowns (F, 2), their covariance (F, 2, 2), weight of its sides (F, 2)."""
    f, g, e = matched.feature, matched.slope, matched.offset

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(f, values, count), dtype=np.float64)

    solution = np.zeros((count, 2))
    for k in range(_ROUNDS):
        residual = e - np.einsum("nk,nk->n", g, solution[f])
        # Geman and McClure's weight, of a scale that shrinks to a pixel.
        w = matched.weight / (1.0 + (residual / max(2.0, gate / 3.0**k)) ** 2) ** 2
        N = np.empty((count, 2, 2))
        N[:, 0, 0], N[:, 1, 1] = total(w * g[:, 0] ** 2) + 1e-9, total(w * g[:, 1] ** 2) + 1e-9
        N[:, 0, 1] = N[:, 1, 0] = total(w * g[:, 0] * g[:, 1])
        right = np.column_stack([total(w * e * g[:, 0]), total(w * e * g[:, 1])])
        solution[:] = np.linalg.solve(N, right[..., None])[..., 0]
    residual = e - np.einsum("nk,nk->n", g, solution[f])
    variance = total(w * residual**2) / np.maximum(total(w), 1e-9)
    noise = np.maximum(variance, _EDGE_DEVIATION**2) * _CORRELATION
    sides = np.column_stack([total(w * (matched.side == side)) for side in range(2)])
    return solution, noise[:, None, None] * np.linalg.inv(N), sides


def block_covariance(blocks: Array) -> Array:
    """(2 k, 2 k) with the blocks (k, 2, 2) on the diagonal, else 0."""
    count = len(blocks)
    R = np.zeros((count, 2, count, 2))
    R[np.arange(count), :, np.arange(count)] = blocks
    return R.reshape(2 * count, 2 * count)
