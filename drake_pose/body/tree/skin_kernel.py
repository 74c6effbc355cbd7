"""Where a band's vertices are, compiled: for real values, or complex ones for derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.body.tree.joint_map import ChainStep
from drake_pose.compiled import compiled


class PackedBand(NamedTuple):
    """A band in the arrays that the kernel walks.

    sizes: (s,) int64 how many positions each joint of the chain has; inverted: (s,) bool;
    coefficient_starts: (s,) int64; coefficients: (r, 16) those of JointMap; levels: (l,) the
    different weights; which: (v,) int64 the level of each vertex; points: (v, 3) the band at rest,
    in the node's frame or, where turned over, in the parent's; turned: (1,) bool.
    """

    sizes: np.ndarray
    inverted: np.ndarray
    coefficient_starts: np.ndarray
    coefficients: np.ndarray
    levels: np.ndarray
    which: np.ndarray
    points: np.ndarray
    turned: np.ndarray


def pack_band(
    steps: Sequence[ChainStep], weights: np.ndarray, points: np.ndarray, *, turned: bool
) -> PackedBand:
    """A band in arrays.

    Args:
        steps: the joints from the node's parent to the node.
        weights: (v,) of the vertices.
        points: (v, 3) the vertices at rest, in the node's frame or, where turned over, in the
            parent's.
        turned: whether the tree is turned over here.
    """
    levels, which = np.unique(weights, return_inverse=True)
    rows = [len(step.joint_map.coefficients) for step in steps]
    return PackedBand(
        sizes=np.array([step.joint_map.position_count for step in steps], dtype=np.int64),
        inverted=np.array([step.inverted for step in steps], dtype=np.bool_),
        coefficient_starts=np.cumsum([0, *rows])[:-1].astype(np.int64),
        coefficients=np.vstack(
            [np.zeros((0, 16)), *(step.joint_map.coefficients for step in steps)]
        ),
        levels=levels,
        which=which.reshape(-1).astype(np.int64),
        points=np.array(points, dtype=np.float64, order="C"),
        turned=np.array([turned]),
    )


@compiled
def _find_joint(
    band: PackedBand, step: int, values: np.ndarray, share: float, scratch: np.ndarray
) -> None:
    """Writes one joint's transform (3, 4) at a share of its values into scratch[0]."""
    size, begin, coefficients = band.sizes[step], band.coefficient_starts[step], band.coefficients
    if size == 1:
        # Nearly every joint; four terms without a search for what is 0 in them.
        value = share * values[0]
        cosine, sine = np.cos(value), np.sin(value)
        for i in range(3):
            for j in range(4):
                k = 4 * i + j
                scratch[0, i, j] = (
                    coefficients[begin, k]
                    + cosine * coefficients[begin + 1, k]
                    + sine * coefficients[begin + 2, k]
                    + value * coefficients[begin + 3, k]
                )
        return
    scratch[1, 0, 0] = 1.0
    for k in range(size):
        value = share * values[k]
        scratch[1, k, 0] = 1.0
        scratch[1, k, 1], scratch[1, k, 2], scratch[1, k, 3] = np.cos(value), np.sin(value), value
    for i in range(3):
        for j in range(4):
            scratch[0, i, j] = 0.0
    for row in range(4**size):
        factor, rest = scratch[1, 0, 0], row
        for k in range(size - 1, -1, -1):
            factor = factor * scratch[1, k, rest % 4]
            rest //= 4
        if factor != 0.0:
            for i in range(3):
                for j in range(4):
                    scratch[0, i, j] += factor * coefficients[begin + row, 4 * i + j]


@compiled
def _invert(X: np.ndarray) -> None:
    """Inverts a rigid transform (3, 4) in its place."""
    x, y, z = X[0, 3], X[1, 3], X[2, 3]
    X[0, 1], X[1, 0] = X[1, 0], X[0, 1]
    X[0, 2], X[2, 0] = X[2, 0], X[0, 2]
    X[1, 2], X[2, 1] = X[2, 1], X[1, 2]
    for i in range(3):
        X[i, 3] = -(X[i, 0] * x + X[i, 1] * y + X[i, 2] * z)


@compiled
def _find_transform(
    band: PackedBand, values: np.ndarray, share: float, X: np.ndarray, scratch: np.ndarray
) -> None:
    """Writes X_PN (3, 4) with the joints gone only a share of their way to values (k,)."""
    first = 0
    for step in range(band.sizes.shape[0]):
        _find_joint(band, step, values[first:], share, scratch)
        if band.inverted[step]:
            _invert(scratch[0])
        for i in range(3):
            if step == 0:
                for j in range(4):
                    X[i, j] = scratch[0, i, j]
                continue
            x, y, z = X[i, 0], X[i, 1], X[i, 2]
            for j in range(4):
                X[i, j] = (
                    x * scratch[0, 0, j]
                    + y * scratch[0, 1, j]
                    + z * scratch[0, 2, j]
                    + (X[i, 3] if j == 3 else 0.0)
                )
        first += band.sizes[step]


@compiled
def place_band(band: PackedBand, values: np.ndarray, placed: np.ndarray) -> None:
    """Writes the vertices (n, v, 3) in the node's frame at values (n, k), both real or complex."""
    scratch = np.empty((2, 3, 4), dtype=values.dtype)
    X_whole = np.empty((3, 4), dtype=values.dtype)
    X_part = np.empty((band.levels.shape[0], 3, 4), dtype=values.dtype)
    x = np.empty(3, dtype=values.dtype)
    for n in range(values.shape[0]):
        _find_transform(band, values[n], 1.0, X_whole, scratch)
        for level in range(band.levels.shape[0]):
            _find_transform(band, values[n], band.levels[level], X_part[level], scratch)
        for vertex in range(band.points.shape[0]):
            p, X = band.points[vertex], X_part[band.which[vertex]]
            if band.turned[0]:
                for i in range(3):
                    x[i] = p[i] - X[i, 3]
                for i in range(3):
                    placed[n, vertex, i] = X[0, i] * x[0] + X[1, i] * x[1] + X[2, i] * x[2]
                continue
            for i in range(3):
                x[i] = X[i, 0] * p[0] + X[i, 1] * p[1] + X[i, 2] * p[2] + X[i, 3] - X_whole[i, 3]
            for i in range(3):
                total = X_whole[0, i] * x[0] + X_whole[1, i] * x[1] + X_whole[2, i] * x[2]
                placed[n, vertex, i] = total
