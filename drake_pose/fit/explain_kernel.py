"""Score poses of a body by sums over the pixels of a static camera's pictures.

The model of the pixels is that of ``fit.background``. One 64-bit word per pixel has a bit for each
frame in which the body covers the pixel, so at most 32 frames are supported. Where neighbouring
words differ lies the body's outline.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Floats, Mask
from drake_pose.compiled import compiled, multiply
from drake_pose.silhouette.outline import PackedOutlines
from drake_pose.silhouette.span_kernel import Rows, fill_rows, find_spans, make_rows


class PixelSums(NamedTuple):
    """Log-likelihoods of each pixel, from which ``explain_pose`` scores poses."""

    visible: Floats  # (H, W, 3) log-likelihoods of the three backgrounds if no frame is covered.
    covered: Floats  # (H, W, f, 3) change of each log-likelihood if a frame is covered.
    uncovered: Floats  # (H, W) maximum of ``visible``.
    edges: Floats  # (2, f, H, W) strength of edges across u and v in each frame, minus its mean.


class Explained(IntEnum):
    """Indices of the sums of ``explain_pose``.

    GAIN: log-likelihood minus that without a body. CONTOUR: edge strength along the outlines, minus
    its expectation. OUTLINE: length of the outlines [pixel]. AREA: area of the bodies [pixel].
    """

    GAIN = 0
    CONTOUR = 1
    OUTLINE = 2
    AREA = 3


class Words(NamedTuple):
    """Scratch arrays for the words of one body's pixels.

    Attributes:
        words: (H, W) uint64 a bit for each frame that covers the pixel, and frames further up for
            static nodes; zero between calls.
        ends: (H, 2) int64 first column, and column after the last, of each row's words; (W, 0)
            between calls.
        rows: scratch of the span kernel.
        positions: (64,) position of a word's only bit, by the upper six bits of its product with
            a de Bruijn number.
    """

    words: np.ndarray
    ends: np.ndarray
    rows: Rows
    positions: np.ndarray


# Its 64 windows of six bits all differ (de Bruijn).
_WINDOWS = np.uint64(0x03F79D71B4CB0A89)


@compiled
def make_words(packed: PackedOutlines, camera: Array) -> tuple[Words, np.ndarray]:
    """Return scratch for packed surfaces, and crossings as of ``make_rows``.

    camera: (8,) `Camera.kernel_parameters`.
    """
    width, height = int(camera[6]), int(camera[7])
    rows, crossings = make_rows(packed, camera)
    ends = np.zeros((height, 2), dtype=np.int64)
    ends[:, 0] = width
    positions = np.zeros(64, dtype=np.int64)
    for k in range(64):
        positions[((np.uint64(1) << np.uint64(k)) * _WINDOWS) >> np.uint64(58)] = k
    return Words(np.zeros((height, width), dtype=np.uint64), ends, rows, positions), crossings


@compiled
def explain_pose(
    packed: PackedOutlines, X_CW: Array, X_WN: Array, is_static: Mask, camera: Array,
    sums: PixelSums, X_CN: Array, totals: Array, tiles: Array, side: float, scratch: Words,
    crossings: np.ndarray, always_covered: float = 0.3,
) -> np.ndarray:  # fmt: skip
    """Write the sums (4,) by ``Explained`` of one pose of the camera into ``totals``.

    Args:
        packed: surfaces of the nodes.
        X_CW: (3, 4) pose of the world in the camera.
        X_WN: (f, nodes, 3, 4) poses of the nodes in the world.
        is_static: (nodes,) whether a node belongs to the background; only its outline is scored.
        camera: (8,) `Camera.kernel_parameters`.
        sums: log-likelihoods and edges of the f frames' images.
        X_CN: (f, nodes, 3, 4) scratch.
        totals, tiles: (4,) the sums, and (t, t) to which the gain of each tile (row, column) is
            added, with indices taken modulo t; t = 0: there are no tiles.
        side: side of a tile [pixel].
        scratch, crossings: of ``make_words``.
        always_covered: factor of the positive gain of pixels that the body covers in all frames,
            whose background is unknown; a negative gain there counts 0.

    Returns the crossings, reallocated if need be.
    """
    words, ends, rows, positions = scratch.words, scratch.ends, scratch.rows, scratch.positions
    one, zero, frames = np.uint64(1), np.uint64(0), X_WN.shape[0]
    every = (one << np.uint64(frames)) - one
    top, bottom, count = words.shape[0], 0, tiles.shape[0]
    # Set the bits of all covered pixels, and the ends of their rows.
    for node in range(X_WN.shape[1]):
        if packed.starts[node, 1] == packed.starts[node + 1, 1]:
            continue
        # A node that stands in all frames is drawn once.
        stands = True
        for f in range(frames):
            for i in range(3):
                for j in range(4):
                    stands &= X_WN[f, node, i, j] == X_WN[0, node, i, j]
            multiply(X_CW, X_WN[f, node], X_CN[f, node])
        for f in range(1 if stands else frames):
            crossings = fill_rows(packed, node, node + 1, X_CN[f], camera, crossings, rows)
            top, bottom = min(top, rows.row_range[0]), max(bottom, rows.row_range[1])
            bit = every if stands else one << np.uint64(f)
            if is_static[node]:  # Static nodes use the upper bits.
                bit <<= np.uint64(frames)
            for row in range(rows.row_range[0], rows.row_range[1]):
                found = find_spans(row, crossings, rows.counts, rows.changes, rows.spans)
                if found == 0:
                    continue
                ends[row, 0] = min(ends[row, 0], rows.spans[0, 0])
                ends[row, 1] = max(ends[row, 1], rows.spans[found - 1, 1])
                for k in range(found):
                    for column in range(rows.spans[k, 0], rows.spans[k, 1]):
                        words[row, column] |= bit
    last, lowest = words.shape[1] - 1, words.shape[0] - 1
    totals[:] = 0.0
    for row in range(top, bottom):
        for column in range(ends[row, 0], ends[row, 1]):
            word = words[row, column]
            if word == zero:
                continue
            covered = word & every
            if covered != zero:
                a, b, c = sums.visible[row, column]
                remaining = covered
                while remaining != zero:
                    bit = remaining & (~remaining + one)
                    f = positions[(bit * _WINDOWS) >> np.uint64(58)]
                    totals[Explained.AREA] += 1.0
                    a += sums.covered[row, column, f, 0]
                    b += sums.covered[row, column, f, 1]
                    c += sums.covered[row, column, f, 2]
                    remaining ^= bit
                gain = max(a, b, c) - sums.uncovered[row, column]
                if covered == every:
                    gain = always_covered * max(gain, 0.0)
                totals[Explained.GAIN] += gain
                if count > 0:
                    tiles[int(row / side) % count, int(column / side) % count] += gain
            left_of = words[row, column - 1] if column > 0 else word
            right_of = words[row, column + 1] if column < last else word
            above = words[row - 1, column] if row > 0 else word
            below = words[row + 1, column] if row < lowest else word
            across_u, across_v = word & ~(left_of & right_of), word & ~(above & below)
            remaining = across_u | across_v
            while remaining != zero:
                bit = remaining & (~remaining + one)
                f = positions[(bit * _WINDOWS) >> np.uint64(58)] % frames
                strength = np.float32(-np.inf)
                if across_u & bit != zero:
                    strength = sums.edges[0, f, row, column]
                if across_v & bit != zero:
                    strength = max(strength, sums.edges[1, f, row, column])
                totals[Explained.CONTOUR] += strength
                totals[Explained.OUTLINE] += 1.0
                remaining ^= bit
    for row in range(top, bottom):
        words[row, ends[row, 0] : ends[row, 1]] = zero
        ends[row, 0], ends[row, 1] = words.shape[1], 0
    return crossings


@compiled
def explain_poses(
    packed: PackedOutlines,
    X_CW: Array,
    X_WN: Array,
    is_static: Mask,
    camera: Array,
    sums: PixelSums,
    side: float,
    tiles_per_side: int,
) -> tuple[Array, Array]:
    """Score poses of a camera by sums over the pixels of a body's pictures.

    ``X_CW``: (n, 3, 4) the poses. ``side``: side of a tile in which the gain is also summed
    [pixel]. ``tiles_per_side``: t; 0: there are no tiles. The rest as of ``explain_pose``.

    Returns (n, 4) sums by ``Explained``, and (t, t) the gain of each tile, summed over the poses.
    """
    totals, tiles = np.zeros((X_CW.shape[0], 4)), np.zeros((tiles_per_side, tiles_per_side))
    X_CN = np.empty_like(X_WN)
    scratch, crossings = make_words(packed, camera)
    for n in range(X_CW.shape[0]):
        crossings = explain_pose(
            packed, X_CW[n], X_WN, is_static, camera, sums, X_CN, totals[n], tiles, side, scratch,
            crossings,
        )  # fmt: skip
    return totals, tiles
