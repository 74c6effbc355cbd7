"""Joints' transforms at their values, and the bands of skin that follow them, compiled."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.body.link_graph import JointMap
from drake_pose.compiled import compiled, multiply


class PackedSteps(NamedTuple):
    """Joints in the arrays that kernels walk.

    sizes: (s,) int64 how many positions each has; inverted: (s,) bool; starts: (s,) int64 the first
    of its coefficients; coefficients: (r, 16) those of JointMap.
    """

    sizes: np.ndarray
    inverted: np.ndarray
    starts: np.ndarray
    coefficients: np.ndarray


class PackedBands(NamedTuple):
    """Bands of skin in the arrays that the kernels walk, one band after another.

    starts: (b + 1, 3) int64 the first step, level and vertex of each; steps: the joints from the
    node's parent to the node; levels: (l,) the different weights; which: (v,) int64 the level of
    each vertex, counted in its band; points: (v, 3) the band at rest, in the node's frame or, where
    turned over, in the parent's; turned: (b,) bool.
    """

    starts: np.ndarray
    steps: PackedSteps
    levels: np.ndarray
    which: np.ndarray
    points: np.ndarray
    turned: np.ndarray


def join_bands(bands: Sequence[PackedBands]) -> PackedBands:
    """All bands together."""
    steps = [band.steps for band in bands]
    rows = np.cumsum([0, *(len(one.coefficients) for one in steps)])
    counts = [np.diff(band.starts, axis=0) for band in bands]
    return PackedBands(
        starts=np.cumsum(np.vstack([np.zeros((1, 3), dtype=np.int64), *counts]), axis=0),
        steps=PackedSteps(
            sizes=np.concatenate([one.sizes for one in steps]),
            inverted=np.concatenate([one.inverted for one in steps]),
            starts=np.concatenate(
                [one.starts + row for one, row in zip(steps, rows, strict=False)]
            ),
            coefficients=np.vstack([one.coefficients for one in steps]),
        ),
        levels=np.concatenate([band.levels for band in bands]),
        which=np.concatenate([band.which for band in bands]),
        points=np.vstack([band.points for band in bands]),
        turned=np.concatenate([band.turned for band in bands]),
    )


def pack_steps(steps: Sequence[JointMap]) -> PackedSteps:
    """Joints in arrays."""
    rows = [len(step.coefficients) for step in steps]
    return PackedSteps(
        sizes=np.array([step.position_count for step in steps], dtype=np.int64),
        inverted=np.array([step.inverted for step in steps], dtype=np.bool_),
        starts=np.cumsum([0, *rows])[:-1].astype(np.int64),
        coefficients=np.vstack([np.zeros((0, 16)), *(step.coefficients for step in steps)]),
    )


@compiled
def find_joint(
    steps: PackedSteps,
    step: int,
    values: np.ndarray,
    share: float,
    changed: int,
    basis: np.ndarray,
    X: np.ndarray,
) -> None:
    """Writes the upper rows of a joint's transform as it is walked, or a derivative.

    Args:
        step: which of them.
        values: its values and any after them [rad or m].
        share: how far it goes of its way to them.
        changed: -1, or the position by which the transform, walked outwards, is derived.
        basis: (3, 4) scratch.
        X: (3 or 4, 4) written.
    """
    size, begin, coefficients = steps.sizes[step], steps.starts[step], steps.coefficients
    for k in range(size):
        q = share * values[k]
        cosine, sine = np.cos(q), np.sin(q)
        if k == changed:
            basis[k, 0], basis[k, 1], basis[k, 2], basis[k, 3] = 0.0, -sine, cosine, 1.0
        else:
            basis[k, 0], basis[k, 1], basis[k, 2], basis[k, 3] = 1.0, cosine, sine, q
    for i in range(3):
        for j in range(4):
            X[i, j] = 0.0
    for row in range(4**size):
        factor, rest = 1.0, row
        for k in range(size - 1, -1, -1):
            factor *= basis[k, rest % 4]
            rest //= 4
        if factor != 0.0:
            for i in range(3):
                for j in range(4):
                    X[i, j] += factor * coefficients[begin + row, 4 * i + j]
    if changed < 0 and steps.inverted[step]:
        x, y, z = X[0, 3], X[1, 3], X[2, 3]
        X[0, 1], X[1, 0] = X[1, 0], X[0, 1]
        X[0, 2], X[2, 0] = X[2, 0], X[0, 2]
        X[1, 2], X[2, 1] = X[2, 1], X[1, 2]
        for i in range(3):
            X[i, 3] = -(X[i, 0] * x + X[i, 1] * y + X[i, 2] * z)


@compiled
def place_bands(
    bands: PackedBands, ranges: np.ndarray, values: np.ndarray, bent: np.ndarray, placed: np.ndarray
) -> np.ndarray:
    """Places bands, each in its node's frame, but those whose values are as before.

    Args:
        ranges: (b, 2) of all values the first of each band's node, and the one after its last.
        values: (n, m) [rad or m].
        bent: (n, m) the values before, or NaN; they are written.
        placed: (n, v, 3) all bands' vertices, written.

    Returns:
        (n, b) bool which bands' values have changed.
    """
    basis, joint, product = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    most, x = 0, np.empty(3)
    for band in range(ranges.shape[0]):
        most = max(most, bands.starts[band + 1, 1] - bands.starts[band, 1])
    # The last one is that of the whole way.
    X_PN = np.zeros((most + 1, 3, 4))
    changed, steps = np.zeros((values.shape[0], ranges.shape[0]), dtype=np.bool_), bands.steps
    for n in range(values.shape[0]):
        for band in range(ranges.shape[0]):
            begin, end = bands.starts[band], bands.starts[band + 1]
            for k in range(ranges[band, 0], ranges[band, 1]):
                changed[n, band] |= values[n, k] != bent[n, k]
                bent[n, k] = values[n, k]
            if not changed[n, band]:
                continue
            count = end[1] - begin[1]
            for level in range(count + 1):
                share = bands.levels[begin[1] + level] if level < count else 1.0
                first = ranges[band, 0]
                for i in range(3):
                    for j in range(4):
                        X_PN[level, i, j] = 1.0 if i == j else 0.0
                for step in range(begin[0], end[0]):
                    find_joint(steps, step, values[n, first:], share, -1, basis, joint)
                    multiply(X_PN[level], joint, product)
                    for i in range(3):
                        for j in range(4):
                            X_PN[level, i, j] = product[i, j]
                    first += steps.sizes[step]
            whole = X_PN[count]
            for vertex in range(begin[2], end[2]):
                p, X = bands.points[vertex], X_PN[bands.which[vertex]]
                if bands.turned[band]:
                    for i in range(3):
                        x[i] = p[i] - X[i, 3]
                    for i in range(3):
                        placed[n, vertex, i] = X[0, i] * x[0] + X[1, i] * x[1] + X[2, i] * x[2]
                    continue
                for i in range(3):
                    x[i] = X[i, 0] * p[0] + X[i, 1] * p[1] + X[i, 2] * p[2] + X[i, 3] - whole[i, 3]
                for i in range(3):
                    total = whole[0, i] * x[0] + whole[1, i] * x[1] + whole[2, i] * x[2]
                    placed[n, vertex, i] = total
    return changed
