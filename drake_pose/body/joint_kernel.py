"""Compiled transforms of joints at their values, and of the skin bands that deform with them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.body.link_graph import JointMap
from drake_pose.compiled import compiled, multiply


class PackedSteps(NamedTuple):
    """s joints in the arrays that kernels take, usually a chain or several chains in a row."""

    sizes: np.ndarray  # (s,) int64 number of positions of each joint.
    inverted: np.ndarray  # (s,) bool, whether the joint is traversed inwards.
    starts: np.ndarray  # (s,) int64 index of each joint's first row in ``coefficients``.
    # (r, 16) coefficients of each joint's ``JointMap``, one joint after another.
    coefficients: np.ndarray


class PackedBands(NamedTuple):
    """b skin bands with v vertices in all, in the arrays that kernels take, one after another."""

    starts: np.ndarray  # (b + 1, 3) int64 index of each band's first step, weight and vertex.
    steps: PackedSteps  # The joints from each node's parent to the node.
    weights: np.ndarray  # (l,) the distinct vertex weights in [0, 1] of each band.
    weight_index: np.ndarray  # (v,) int64 index of each vertex's weight, counted in its band.
    # (v, 3) vertices at rest [m], in the node's frame, or in its parent's if inverted.
    points: np.ndarray
    # (b,) bool, whether the node is nearer to the plant's world than its parent.
    inverted: np.ndarray


def join_bands(bands: Sequence[PackedBands]) -> PackedBands:
    """Return all bands of several ``PackedBands`` in one, in the given order."""
    steps = [band.steps for band in bands]
    rows = np.cumsum([0, *(len(chain.coefficients) for chain in steps)])
    counts = [np.diff(band.starts, axis=0) for band in bands]
    return PackedBands(
        starts=np.cumsum(np.vstack([np.zeros((1, 3), dtype=np.int64), *counts]), axis=0),
        steps=PackedSteps(
            sizes=np.concatenate([chain.sizes for chain in steps]),
            inverted=np.concatenate([chain.inverted for chain in steps]),
            starts=np.concatenate(
                [chain.starts + row for chain, row in zip(steps, rows, strict=False)]
            ),
            coefficients=np.vstack([chain.coefficients for chain in steps]),
        ),
        weights=np.concatenate([band.weights for band in bands]),
        weight_index=np.concatenate([band.weight_index for band in bands]),
        points=np.vstack([band.points for band in bands]),
        inverted=np.concatenate([band.inverted for band in bands]),
    )


def pack_steps(steps: Sequence[JointMap]) -> PackedSteps:
    """Return joints, in their order, in the arrays that kernels take."""
    rows = [len(step.coefficients) for step in steps]
    return PackedSteps(
        sizes=np.array([step.position_count for step in steps], dtype=np.int64),
        inverted=np.array([step.inverted for step in steps], dtype=np.bool_),
        starts=np.cumsum([0, *rows])[:-1].astype(np.int64),
        coefficients=np.vstack([np.zeros((0, 16)), *(step.coefficients for step in steps)]),
    )


@compiled
def evaluate_joint(
    steps: PackedSteps,
    step: int,
    values: np.ndarray,
    fraction: float,
    derived: int,
    basis: np.ndarray,
    X: np.ndarray,
) -> None:
    """Write the upper three rows of a joint's transform, or of its derivative by one position.

    The transform is in traversal order: it is inverted if the joint is.

    Args:
        steps: joints in the kernels' arrays.
        step: index of the joint in ``steps``.
        values: (j,) array whose first entries are the joint's values [rad or m].
        fraction: factor by which the values are multiplied.
        derived: index among the joint's positions of the one by which to differentiate; -1: write
            the transform itself. A derivative is that of the transform outwards, whether or not the
            joint is inverted.
        basis: (3, 4) working memory, overwritten.
        X: (3 or 4, 4) output, whose first three rows are written.
    """
    size, begin, coefficients = steps.sizes[step], steps.starts[step], steps.coefficients
    for k in range(size):
        q = fraction * values[k]
        cosine, sine = np.cos(q), np.sin(q)
        if k == derived:
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
    if derived < 0 and steps.inverted[step]:
        x, y, z = X[0, 3], X[1, 3], X[2, 3]
        X[0, 1], X[1, 0] = X[1, 0], X[0, 1]
        X[0, 2], X[2, 0] = X[2, 0], X[0, 2]
        X[1, 2], X[2, 1] = X[2, 1], X[1, 2]
        for i in range(3):
            X[i, 3] = -(X[i, 0] * x + X[i, 1] * y + X[i, 2] * z)


@compiled
def place_bands(
    bands: PackedBands,
    ranges: np.ndarray,
    values: np.ndarray,
    last_values: np.ndarray,
    placed: np.ndarray,
) -> np.ndarray:
    """Place the vertices of bands in their nodes' frames; skip bands whose values have not changed.

    Args:
        bands: b bands with v vertices in all.
        ranges: (b, 2) range of each band's values [first, end) in the columns of ``values``.
        values: (n, m) values [rad or m] of n poses.
        last_values: (n, m) ``values`` of the previous call, NaN at the first; overwritten.
        placed: (n, v, 3) vertices of all bands in their nodes' frames [m]; the vertices of changed
            bands are overwritten, the others keep their positions of the previous call.

    Returns (n, b) bool, whether each band was placed anew at each pose.
    """
    basis, joint, product = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    max_count, x = 0, np.empty(3)
    for band in range(ranges.shape[0]):
        max_count = max(max_count, bands.starts[band + 1, 1] - bands.starts[band, 1])
    # The last transform is the one at the full values.
    X_PN = np.zeros((max_count + 1, 3, 4))
    changed, steps = np.zeros((values.shape[0], ranges.shape[0]), dtype=np.bool_), bands.steps
    for n in range(values.shape[0]):
        for band in range(ranges.shape[0]):
            begin, end = bands.starts[band], bands.starts[band + 1]
            for k in range(ranges[band, 0], ranges[band, 1]):
                changed[n, band] |= values[n, k] != last_values[n, k]
                last_values[n, k] = values[n, k]
            if not changed[n, band]:
                continue
            count = end[1] - begin[1]
            for weight in range(count + 1):
                fraction = bands.weights[begin[1] + weight] if weight < count else 1.0
                first = ranges[band, 0]
                for i in range(3):
                    for j in range(4):
                        X_PN[weight, i, j] = 1.0 if i == j else 0.0
                for step in range(begin[0], end[0]):
                    evaluate_joint(steps, step, values[n, first:], fraction, -1, basis, joint)
                    multiply(X_PN[weight], joint, product)
                    for i in range(3):
                        for j in range(4):
                            X_PN[weight, i, j] = product[i, j]
                    first += steps.sizes[step]
            whole = X_PN[count]
            for vertex in range(begin[2], end[2]):
                p, X = bands.points[vertex], X_PN[bands.weight_index[vertex]]
                if bands.inverted[band]:
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
