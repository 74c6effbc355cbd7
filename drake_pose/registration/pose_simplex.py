"""Improve poses of a body in pictures by Nelder and Mead's simplex search, many in one call."""

from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.compiled import compiled
from drake_pose.fit.explain_kernel import Explained, PixelSums, Words, explain_pose, make_words
from drake_pose.silhouette.outline import PackedOutlines


class ScoredPictures(NamedTuple):
    """Pictures of one size in which poses are scored.

    Attributes:
        packed, X_WN, is_static, camera, sums: as for ``explain_poses``.
        middle: (3,) the body's middle in the world [m].
        scales: (3,) numbers a [nat], b [pixel] and c of the score: gain / a + c * contours'
            strength / (outlines' length + b).
    """

    packed: PackedOutlines
    X_WN: Array
    is_static: Mask
    camera: Array
    sums: PixelSums
    middle: Array
    scales: Array


@compiled
def move_pose(X_CW: Array, middle: Array, x: Array, moved: Array) -> None:
    """Move a body in the camera's frame.

    Args:
        X_CW: (3, 4) the pose.
        middle: (3,) the body's middle in the world [m].
        x: (6,) rotation vector about the middle [rad], shift of the middle in the picture along u
            and v [focal lengths], and change of the logarithm of the middle's depth.
        moved: (3, 4) output, the moved pose X_CW.
    """
    angle = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    turn = np.eye(3)
    if angle > 0.0:
        a, b, c = x[0] / angle, x[1] / angle, x[2] / angle
        s, d = np.sin(angle), 1.0 - np.cos(angle)
        turn[0, 0], turn[0, 1], turn[0, 2] = (
            1.0 - d * (b * b + c * c),
            d * a * b - s * c,
            d * a * c + s * b,
        )
        turn[1, 0], turn[1, 1], turn[1, 2] = (
            d * a * b + s * c,
            1.0 - d * (a * a + c * c),
            d * b * c - s * a,
        )
        turn[2, 0], turn[2, 1], turn[2, 2] = (
            d * a * c - s * b,
            d * b * c + s * a,
            1.0 - d * (a * a + b * b),
        )
    p = X_CW[:, 3].copy()
    for i in range(3):
        for k in range(3):
            p[i] += X_CW[i, k] * middle[k]
            moved[i, k] = 0.0
            for j in range(3):
                moved[i, k] += turn[i, j] * X_CW[j, k]
    depth = p[2] * np.exp(x[5])
    place = (depth * (p[0] / p[2] + x[3]), depth * (p[1] / p[2] + x[4]), depth)
    for i in range(3):
        moved[i, 3] = place[i]
        for k in range(3):
            moved[i, 3] -= moved[i, k] * middle[k]


@compiled
def _cost(
    pictures: ScoredPictures,
    X_CW: Array,
    x: Array,
    moved: Array,
    X_CN: Array,
    totals: Array,
    scratch: Words,
    crossings: np.ndarray,
) -> tuple[float, np.ndarray]:
    """Return the negative score of a moved pose, and `crossings`, which may be reallocated.

    X_CW, x, moved: as for ``move_pose``. X_CN, totals, scratch, crossings: as for ``explain_pose``.
    """
    move_pose(X_CW, pictures.middle, x, moved)
    crossings = explain_pose(
        pictures.packed, moved, pictures.X_WN, pictures.is_static, pictures.camera, pictures.sums,
        X_CN, totals, scratch, crossings,
    )  # fmt: skip
    scales = pictures.scales
    contour = totals[Explained.CONTOUR] / (totals[Explained.OUTLINE] + scales[1])
    return -(totals[Explained.GAIN] / scales[0] + scales[2] * contour), crossings


@compiled
def search_simplexes(
    pictures: ScoredPictures, X_CW: Array, corners: Array, costs: Array, evaluations: int
) -> None:
    """Search the best scores near n poses.

    The steps are Nelder and Mead's (1965), as in ``scipy.optimize.minimize``: reflection, expansion
    by 2, contraction and shrinkage by a half.

    Args:
        pictures: in which poses are scored.
        X_CW: (n, 3, 4) poses from which the coordinates `x` of ``move_pose`` are counted.
        corners: (n, 7, 6) corners of each search's first simplex; output: of its last simplex, best
            first.
        costs: (n, 7) output: the corners' negative scores, ascending.
        evaluations: maximum number of scores for each pose, at least 7.
    """
    scratch, crossings = make_words(pictures.packed, pictures.camera)
    X_CN, totals, moved = np.empty_like(pictures.X_WN), np.zeros(4), np.empty((3, 4))
    centre, tried = np.empty(6), np.empty(6)
    for n in range(X_CW.shape[0]):
        start, corner, cost_of = X_CW[n], corners[n], costs[n]
        for k in range(7):
            cost_of[k], crossings = _cost(
                pictures, start, corner[k], moved, X_CN, totals, scratch, crossings
            )
        _sort(corner, cost_of)
        count = 7
        while count < evaluations:
            for i in range(6):
                centre[i] = 0.0
                for k in range(6):
                    centre[i] += corner[k, i]
                centre[i] /= 6.0
                tried[i] = 2.0 * centre[i] - corner[6, i]
            cost, crossings = _cost(pictures, start, tried, moved, X_CN, totals, scratch, crossings)
            count += 1
            # Expand, keep the reflected corner, or contract outside or inside of the simplex.
            factor = 2.0 if cost < cost_of[0] else 0.0 if cost < cost_of[5] else 0.5
            factor = factor if cost < cost_of[6] else -0.5
            limit = min(cost, cost_of[6])
            if factor == 0.0 or (factor == 2.0 and count < evaluations):
                corner[6], cost_of[6] = tried, cost
            if factor != 0.0 and count < evaluations:
                for i in range(6):
                    tried[i] = centre[i] + factor * (tried[i] - centre[i])
                cost, crossings = _cost(
                    pictures, start, tried, moved, X_CN, totals, scratch, crossings
                )
                count += 1
                if cost < limit or (cost == limit and factor == 0.5):
                    corner[6], cost_of[6] = tried, cost
                elif factor != 2.0:
                    for k in range(1, min(7, 1 + evaluations - count)):
                        for i in range(6):
                            corner[k, i] = corner[0, i] + 0.5 * (corner[k, i] - corner[0, i])
                        cost_of[k], crossings = _cost(
                            pictures, start, corner[k], moved, X_CN, totals, scratch, crossings
                        )
                        count += 1
            _sort(corner, cost_of)


@compiled
def _sort(corners: Array, costs: Array) -> None:
    """Sort the corners (7, 6) of a simplex by their costs (7,), stably."""
    for i in range(1, 7):
        k = i
        while k > 0 and costs[k] < costs[k - 1]:
            costs[k], costs[k - 1] = costs[k - 1], costs[k]
            for j in range(6):
                corners[k, j], corners[k - 1, j] = corners[k - 1, j], corners[k, j]
            k -= 1
