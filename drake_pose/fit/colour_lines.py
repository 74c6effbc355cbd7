"""The inner loop of the fit where there are pictures: colours along lines across a body's contour.

Of every part of a body it is known how frequent colours are on it and beside it. Along a line
across the contour the pixels' colours then say where the edge lies, and how surely: the colours are
compared with those that were to be expected if the edge lay at each of twelve offsets. The mean of
the offsets is a residual and their variance its weight, so that lines over which body and
background look alike count for little. What covers the body puts edges far from where neighbouring
lines have them: the cost saturates as that of silhouettes' edges does.

The idea is that of region-based trackers: Prisacariu and Reid 2012, Tjaden et al. 2018, Stoiber et
al. 2022 (SRT3D), 2023 (M3T). Two things differ. Only the contour of the whole body is looked at,
beyond which the background begins, and lines end where the model says that another part of the body
or the other side of a thin one begins. And what a line says is divided by what the window of
offsets would say by itself, so that a line that says nothing has no weight.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.compiled import compiled
from drake_pose.fit.kernel import add_pull, add_pulls, count_distance, seen_from
from drake_pose.silhouette.areas.outline import PackedOutlines
from drake_pose.silhouette.contours.contour_points import sample_contour

Histograms = NDArray[np.float32]

COLOURS = 4096
"""Colours that are told apart: 16 steps of red, green and blue."""

ON, BESIDE, ODDS = range(3)
"""What is known of a node's colours: their shares on it and beside it, and one over the other."""

OFFSETS = 12
"""Of the edge along a line."""

# Blocks of pixels on either side of the contour: beyond the last offset there are four more.
_BLOCKS = 9
# Of a block so many pixels are looked at: its others say the same, and each is far off in memory.
_PIXELS = 4
# So many blocks go across the thinnest part at least, where they are coarser than a pixel.
_BLOCKS_ACROSS = 6.0
# A block's colours are believed to be on the right side with this much above one half, at most.
_TRUST = 0.4
# Colours so rare [a share of all] are as good as never seen.
_RARE = 1e-4
# The variance of an edge that lies anywhere in the window [steps^2].
_ANYWHERE = (OFFSETS**2 - 1) / 12.0
# The least variance, of an edge between two offsets [steps^2].
_SURE = 1.0 / 12.0
# Fewer pixels tell nothing of a node's colours.
_FEW = 20.0
# A line says something when the window is at least so many times as wide.
_SPEAKS = 1.15


@compiled
def compare_lines(
    packed: PackedOutlines,
    X_WN: Array,
    camera: tuple[Array, Array],
    picture: Picture,
    histograms: Histograms,
    weights: Array,
    step: int,
    A: Array,
    b: Array,
    sums: Array,
    wide: Array,
    width: float = 0.0,
) -> None:
    """Adds what one camera's picture says of the nodes' affine motions.

    Args:
        packed: the nodes' surfaces.
        X_WN: (nodes, 4, 4).
        camera: X_CW (4, 4) and kernel parameters (8,).
        picture: (H, W, 3 or 4).
        histograms: (nodes, 3, COLOURS) what is known of the nodes' colours.
        weights: (4,) as of `compare_contours`.
        step: from offset to offset [pixel].
        A, b, sums, wide: (nodes, 12, 12), (nodes, 12), (nodes + 1, 6) and (nodes, 13) added to, as
            of `compare_contours`; lengths are of lines that say something, by how much they do.
        width: the body looks wider than it is by so much on all sides [pixel].
    """
    contour = sample_contour(packed, seen_from(camera[0], X_WN), camera[1], weights[2])
    uv, normals, lengths, nodes, p_N, clearances = contour
    noise = (weights[1] / 2.5) ** 2
    pulls = np.zeros((len(uv), 7))
    scratch, place = np.empty((3, 2 * _BLOCKS + 2)), np.empty(2)
    for i in range(len(uv)):
        node = nodes[i]
        for k in range(2):
            place[k] = uv[i, k] + width * normals[i, k]
        edge, variance = _find_edge(
            picture, histograms[node], place, normals[i], clearances[i], step, scratch
        )
        if variance > 0.0:
            length = 2.0 * lengths[i] / (1.0 + variance / noise)
            weight, _ = count_distance(sums, node, weights, length, edge)
            add_pull(pulls, i, normals[i, 0], normals[i, 1], edge, weight)
            pulls[i, 5], pulls[i, 6] = weight * normals[i, 0], weight * normals[i, 1]
            wide[node, 12] += weight * edge
    add_pulls(A, b, wide, X_WN, camera, p_N, nodes, nodes, pulls)


@compiled
def _colour(picture: Picture, u: float, v: float) -> int:
    """The colour at a place [pixel]; -1 outside of the picture."""
    column, row = math.floor(u + 0.5), math.floor(v + 0.5)
    if column < 0 or row < 0 or column >= picture.shape[1] or row >= picture.shape[0]:
        return -1
    colour = 0
    for channel in range(3):
        colour = 16 * colour + (int(picture[row, column, channel]) >> 4)
    return colour


@compiled
def _find_edge(
    picture: Picture,
    histograms: Histograms,
    uv: Array,
    normal: Array,
    clearance: Array,
    step: int,
    scratch: Array,
) -> tuple[float, float]:
    """Where the edge lies on a line, outwards, and the variance [pixel]; -1: nothing is said."""
    blocks, on, beside = scratch[0], scratch[1], scratch[2]
    # Of a thin part coarse blocks would see little, and too much of what is beyond.
    step = max(1, min(step, int(clearance[0] / _BLOCKS_ACROSS)))
    pixels = min(step, _PIXELS)
    apart = step / pixels
    for k in range(-_BLOCKS, _BLOCKS + 1):
        odds = 1.0
        for pixel in range(pixels):
            r = k * step + apart * (pixel + 0.5) - 0.5 * step
            colour = _colour(picture, uv[0] + r * normal[0], uv[1] + r * normal[1])
            if colour >= 0:
                odds *= histograms[ODDS, colour]
        share = odds / (1.0 + odds)
        # How much more likely than not the block is on the body; 0: its colours do not say.
        blocks[k + _BLOCKS] = 4.0 * _TRUST * (share - 0.5)
    inner, outer = clearance[0] / step, clearance[1] / step
    # How likely the colours of all blocks before one are, on the body and beside it.
    on[0] = beside[0] = 1.0
    for k in range(2 * _BLOCKS + 1):
        on[k + 1] = on[k] * (1.0 + blocks[k])
        beside[k + 1] = beside[k] * (1.0 - blocks[k])
    total, first, second = 0.0, 0.0, 0.0
    for offset in range(OFFSETS):
        d = offset - 0.5 * (OFFSETS - 1)
        # The blocks at d - inner < k < d are on the body, those at d < k < d + outer beside it.
        here = offset - OFFSETS // 2 + 1 + _BLOCKS
        begin = max(0, min(here, math.floor(max(d - inner, -2.0 * _BLOCKS)) + 1 + _BLOCKS))
        end = min(2 * _BLOCKS + 1, max(here, math.ceil(min(d + outer, 2.0 * _BLOCKS)) + _BLOCKS))
        likelihood = on[here] / on[begin] * beside[end] / beside[here]
        total += likelihood
        first += likelihood * d
        second += likelihood * d * d
    if total < 1e-30:
        return 0.0, -1.0
    mean = first / total
    variance = max(second / total - mean * mean, _SURE)
    # The window alone would say 0 +- its own width: what the colours say is the rest.
    information = 1.0 / variance - 1.0 / _ANYWHERE
    if variance * _SPEAKS > _ANYWHERE:
        return 0.0, -1.0
    edge = min(max(mean / variance / information, -0.5 * OFFSETS), 0.5 * OFFSETS)
    return edge * step, step * step / information


@compiled
def learn_colours(
    packed: PackedOutlines,
    X_WN: Array,
    camera: tuple[Array, Array],
    picture: Picture,
    histograms: Histograms,
    spacing: float,
    widths: Array,
    rate: float,
    agreeing: float,
    step: int,
    region: Mask,
) -> None:
    """Counts the colours on both sides of a body's contour, and forgets old ones.

    Args:
        packed, X_WN, camera, picture: as of `compare_lines`.
        histograms: (nodes, 3, COLOURS) changed.
        spacing: of the contour's points [pixel].
        widths: (2,) of the strips inside and outside that are counted [pixel].
        rate: the new colours' share; of a node of which nothing is known yet they are all.
        agreeing: lines on which the edge seems to be further from the contour than this teach
            nothing [pixel]; inf: all do.
        step: from offset to offset [pixel] of lines that say where the edge is, on both sides of
            which colours are then counted; 0: they are counted on both sides of the contour.
        region: (H, W) where the body is known to be seen: it says what is on the body and what is
            beside it. (0, 0): that is not known.
    """
    X_CN = seen_from(camera[0], X_WN)
    uv, normals, _, nodes, _, clearances = sample_contour(packed, X_CN, camera[1], spacing)
    counts = np.zeros((len(histograms), 2, COLOURS), dtype=np.float32)
    totals = np.zeros((len(histograms), 2))
    scratch = np.empty((3, 2 * _BLOCKS + 2))
    for i in range(len(uv)):
        node, middle = nodes[i], 0.0
        if agreeing < np.inf and not len(region):
            edge, variance = _find_edge(
                picture, histograms[node], uv[i], normals[i], clearances[i], max(step, 1), scratch
            )
            if variance > 0.0 and abs(edge) > agreeing:
                continue
            if variance > 0.0 and step > 0:
                middle = edge
        for side in range(2):
            sign = -1.0 if side == ON else 1.0
            pixels = int(min(widths[side], clearances[i, side] - 1.0))
            for k in range(1, pixels):
                r = middle + sign * k
                u, v = uv[i, 0] + r * normals[i, 0], uv[i, 1] + r * normals[i, 1]
                colour = _colour(picture, u, v)
                if colour < 0:
                    break
                where = side
                if len(region):
                    where = ON if region[math.floor(v + 0.5), math.floor(u + 0.5)] else BESIDE
                counts[node, where, colour] += 1.0
                totals[node, where] += 1.0
    for node in range(len(histograms)):
        for side in range(2):
            shares, total = histograms[node, side], totals[node, side]
            if total >= _FEW:
                # Of a side of which nothing is known yet the new colours are all.
                share = rate if shares.any() else 1.0
                for colour in range(COLOURS):
                    shares[colour] += share * (counts[node, side, colour] / total - shares[colour])
        for colour in range(COLOURS):
            on_it, beside_it = histograms[node, ON, colour], histograms[node, BESIDE, colour]
            histograms[node, ODDS, colour] = (on_it + _RARE) / (beside_it + _RARE)
