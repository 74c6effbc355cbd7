"""The kernel of a search without masks: what a body's pose explains of pictures of one camera.

Bits of a word for each pixel say in which frames the body covers it; what that is worth is a sum
over the pixels (``fit.background``). The words' edges are the body's outline in each frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Floats
from drake_pose.compiled import compiled
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.areas.span_kernel import fill_rows, find_spans, make_rows

# What pixels that the body covers in all frames count: of their background nothing is known.
_ALWAYS_COVERED = 0.3

GAIN, CONTOUR, OUTLINE, AREA = range(4)
"""What explain sums up: the log-likelihood beyond that of no body; the edges' strength beyond
chance along the outlines, their length, and the bodies' area [pixel]."""


class PixelSums(NamedTuple):
    """What pictures say of sets of frames in which a body covers a pixel.

    shown: (H, W, 3) float32 log-likelihoods of three backgrounds where no frame is covered; more:
    (H, W, f, 3) float32 what a covered frame adds; none: (H, W) float32 the best of shown; edges:
    (2, f, H, W) float32 how strong edges across u and v are in each frame, beyond chance.
    """

    shown: Floats
    more: Floats
    none: Floats
    edges: Floats


@compiled
def explain(
    packed: PackedOutlines,
    X_CN: Array,
    still: NDArray[np.bool_],
    camera: Array,
    sums: PixelSums,
    side: float,
    squares: int,
) -> tuple[Array, Array]:
    """What a body explains that stands at X_CN (f, nodes, 3, 4) in the frames.

    Args:
        packed: the nodes' surfaces.
        still: (nodes,) which nodes stand at one place in all frames: they are their own background,
            so that their outline tells alone.
        camera: (8,) kernel parameters.
        sums: of the pictures.
        side, squares: the gain is also told by (squares, squares) squares of a side [pixel]; 0:
            it is not.

    Returns:
        (4,) GAIN, CONTOUR, OUTLINE and AREA; (squares, squares) the gain in each.
    """
    height, width = sums.none.shape
    frames, one = X_CN.shape[0], np.uint64(1)
    told, pieces = np.zeros(4), np.zeros((squares, squares))
    words = np.zeros((height, width), dtype=np.uint64)
    rows, crossings = make_rows(packed, camera)
    top, bottom = height, 0
    for f in range(frames):
        for node in range(X_CN.shape[1]):
            crossings = fill_rows(packed, node, node + 1, X_CN[f], camera, crossings, rows)
            top, bottom = min(top, rows.reach[0]), max(bottom, rows.reach[1])
            # Higher bits are those of what stands still.
            bit = one << np.uint64(f + frames if still[node] else f)
            for row in range(rows.reach[0], rows.reach[1]):
                for k in range(find_spans(row, crossings, rows.counts, rows.changes, rows.spans)):
                    for column in range(rows.spans[k, 0], rows.spans[k, 1]):
                        words[row, column] |= bit
    every = (one << np.uint64(frames)) - one
    for row in range(top, bottom):
        for column in range(width):
            word = words[row, column]
            if word == 0:
                continue
            covered = word & every
            if covered != 0:
                a, b, c = sums.shown[row, column]
                left, f = covered, 0
                while left != 0:
                    if left & one:
                        told[AREA] += 1.0
                        a += sums.more[row, column, f, 0]
                        b += sums.more[row, column, f, 1]
                        c += sums.more[row, column, f, 2]
                    left >>= one
                    f += 1
                gain = max(a, b, c) - sums.none[row, column]
                if covered == every:
                    gain = _ALWAYS_COVERED * max(gain, 0.0)
                told[GAIN] += gain
                if squares > 0:
                    pieces[int(row / side) % squares, int(column / side) % squares] += gain
            left_of = words[row, column - 1] if column > 0 else word
            right_of = words[row, column + 1] if column < width - 1 else word
            above = words[row - 1, column] if row > 0 else word
            below = words[row + 1, column] if row < height - 1 else word
            across_u, across_v = word & ~(left_of & right_of), word & ~(above & below)
            left, f = across_u | across_v, 0
            while left != 0:
                if left & one:
                    strength = -np.inf
                    if across_u >> np.uint64(f) & one:
                        strength = sums.edges[0, f % frames, row, column]
                    if across_v >> np.uint64(f) & one:
                        strength = max(strength, sums.edges[1, f % frames, row, column])
                    told[CONTOUR] += strength
                    told[OUTLINE] += 1.0
                left >>= one
                f += 1
    return told, pieces
