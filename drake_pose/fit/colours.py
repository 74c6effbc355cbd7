"""Residuals of a body's contour from colour images, along search lines across the contour.

For each part of a body there are histograms of the colours on the part and beside it. Along a
search line across the contour, the colours are compared with those expected if the edge lay at each
of twelve offsets. The mean of the offset's posterior is a residual and its variance gives the
weight, so a line where body and background look alike has little weight. An occluder moves the edge
far from where neighbouring lines see it; the cost saturates as for silhouette edges.

The method follows region-based trackers (Prisacariu and Reid 2012, Tjaden et al. 2018, Stoiber et
al. 2022 (SRT3D) and 2023 (M3T)), with two differences. Only the contour of the whole body is used,
beyond which the background begins, and a line ends where the model has another part of the body or
the other side of a thin part. The posterior is divided by the window's own contribution, so that a
line without information has zero weight.

This module keeps no state: a tracker stores the histograms and passes them in.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Floats, Picture
from drake_pose.camera.models import Camera
from drake_pose.compiled import compiled, default_arguments
from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import Comparison, Noise, camera_weights, pack_cameras
from drake_pose.fit.kernel import Sum, accumulate_residuals, add_residual, robust_weight
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import Placement
from drake_pose.silhouette.contour_points import sample_contour
from drake_pose.silhouette.outline import PackedOutlines

COLOURS = 4096
"""Number of bins of a colour histogram: 16 levels each of red, green and blue."""


class Colour(IntEnum):
    """Rows of a node's histograms: colour frequencies on it and beside it, and their ratio."""

    ON = 0
    BESIDE = 1
    FOREGROUND = 2


class LineSettings(NamedTuple):
    """Search lines across a contour.

    Attributes:
        offsets: number of edge offsets evaluated along a line.
        blocks: number of blocks of pixels on either side of the contour: four beyond the last
            offset.
        pixels_per_block: maximum number of pixels sampled per block.
        blocks_across: minimum number of blocks across the thinnest part, where blocks are larger
            than a pixel.
        trust: maximum excess over 1/2 of the probability that a block lies on the side its colours
            suggest.
        min_variance_ratio: a line is used if the variance of a uniform offset exceeds the edge's
            variance by this factor.
        spacing: distance between lines along the contour [pixel], at a step of one pixel.
        correlation: length of contour over which the errors of lines are correlated [pixel].
        steps: distance between offsets in successive rounds [pixel]; the last value applies to all
            further rounds.
        strip_widths: widths of the strips inside and outside the contour in which colours are
            counted [pixel].
        learning_rate: weight of a new frame's colours in the histograms.
        max_residual: a line whose edge is further from the contour than this [pixel] does not
            update the histograms.
    """

    offsets: int = 12
    blocks: int = 9
    pixels_per_block: int = 4
    blocks_across: float = 6.0
    trust: float = 0.4
    min_variance_ratio: float = 1.15
    spacing: float = 2.0
    correlation: float = 5.0
    steps: tuple[int, int, int] = (4, 2, 1)
    strip_widths: tuple[float, float] = (16.0, 30.0)
    learning_rate: float = 0.1
    max_residual: float = 2.5


LINES = LineSettings()


def colour_numbers(pixels: Picture) -> NDArray[np.intp]:
    """Return (...) histogram indices, below COLOURS, of pixels (..., 3 or 4) without alpha."""
    red, green, blue = np.moveaxis(pixels[..., :3] & 240, -1, 0)
    numbers = red.astype(np.uint16) << 4
    numbers |= green
    numbers |= blue >> 4
    return numbers.astype(np.intp)


def search_line_step(number: int) -> int:
    """Return the distance between edge offsets of search lines [pixel] in a round.

    Args:
        number: number of the round of a fit, from 0; LINES.steps has the distances.
    """
    return LINES.steps[min(number, len(LINES.steps) - 1)]


def uninformed_histograms(cameras: int, nodes: int) -> Floats:
    """Return histograms (cameras, nodes, 3, COLOURS) in which all colour ratios are one.

    Rows ``Colour.ON`` and ``Colour.BESIDE`` are 0, so that the first colours replace them.
    """
    histograms = np.zeros((cameras, nodes, len(Colour), COLOURS), dtype=np.float32)
    histograms[:, :, Colour.FOREGROUND] = 1.0
    return histograms


def check_picture(camera: Camera, picture: Picture) -> Picture:
    """Return an image as kernels take it; a copy unless it is contiguous and writeable.

    ``camera``: the camera that took the image. ``picture``: the image. Raises SettingsError: it is
    not (H, W, 3) or (H, W, 4) bytes of the camera's size.
    """
    shape = (camera.height, camera.width)
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] not in (3, 4):
        raise SettingsError(
            f"camera '{camera.name}': expected an image of red, green and blue bytes, got "
            f"{picture.shape} {picture.dtype}"
        )
    if picture.shape[:2] != shape:
        raise SettingsError(
            f"camera '{camera.name}': expected an image of {camera.width} x {camera.height} "
            f"pixels, got {picture.shape[1]} x {picture.shape[0]}"
        )
    return np.require(picture, requirements=["C", "W"])


def add_pictures(
    compared: Comparison,
    cameras: Sequence[Camera],
    pictures: Sequence[Picture | None],
    histograms: Floats,
    stage: AnnealingStage,
    noise: Noise,
    pixels: int,
) -> None:
    """Add the residuals of colour images to those of silhouettes, in place.

    Args:
        compared: comparison with the silhouettes of all cameras; its arrays are added to.
        cameras: the cameras, in the same order.
        pictures: image (H, W, 3 or 4) of each camera; None: this camera has none.
        histograms: (cameras, nodes, 3, COLOURS) colour histograms, in rows by ``Colour``.
        stage: scale of the residuals and spacing of the lines [pixel].
        noise: noise of search lines [pixel].
        pixels: distance between the edge offsets that are evaluated along a line [pixel].
    """
    placement = compared.placement
    packed = pack_cameras(cameras)
    weights = camera_weights(packed, placement, stage, noise, 1.0)
    for c, picture in enumerate(pictures):
        if picture is not None:
            compare_lines(
                placement.packed, placement.X_WN, (packed[0][c], packed[1][c]), picture,
                histograms[c], weights[c], pixels, compared.A[c], compared.b[c], compared.sums[c],
                compared.bias_terms[c], *default_arguments(compare_lines),
            )  # fmt: skip


def weigh_parts(
    compared: Comparison,
    deviation: float,
    pictures: Sequence[Picture | None],
    noisiest: float = 2.0,
) -> None:
    """Reduce the weight of parts whose search lines scatter more than average, in place.

    A part has few independent lines, so the geometric mean of its own variance and that of all
    parts is used.

    Args:
        compared: comparison of all cameras; its A and b are changed.
        deviation: minimum standard deviation of a line [pixel].
        pictures: image of each camera; None: its silhouettes keep their weight.
        noisiest: maximum standard deviation of a part's lines [pixel], so that the lines of a
            misplaced part still pull.
    """
    active = [c for c, picture in enumerate(pictures) if picture is not None]
    squares, weight = (compared.sums[active, :-1, k] for k in (Sum.SQUARES, Sum.WEIGHT))
    overall = max(deviation**2, float(squares.sum() / max(float(weight.sum()), 1e-12)))
    own = np.clip(squares / np.maximum(weight, 1e-12), deviation**2, noisiest**2)
    factor = np.sqrt(overall / own)
    compared.A[active] *= factor[..., None, None]
    compared.b[active] *= factor[..., None]


def part_distances(sums: Array, closest: float = 0.7, shortest: float = 20.0) -> Array:
    """Return (nodes,) root mean square distance of each part from its contour in images [pixel].

    It is 0 for parts that are not evaluated.

    The harmonic mean of the squared distances over the cameras is used, so that an occluder in one
    camera does not count against a part that another camera sees.

    Args:
        sums: (cameras, nodes + 1, 6) by ``Sum`` of the lines of each node; the last row is unused.
        closest: minimum of a distance [pixel].
        shortest: a part with less contour than this is not evaluated [pixel].
    """
    squares, weight, length = (sums[:, :-1, k] for k in (Sum.SQUARES, Sum.WEIGHT, Sum.COMPARED))
    own = np.maximum(closest**2, squares / np.maximum(weight, 1e-12))
    total_length = length.sum(axis=0)
    distances = np.sqrt(total_length / np.maximum((length / own).sum(axis=0), 1e-12))
    return np.where(total_length >= shortest, distances, 0.0)


def update_histograms(
    placement: Placement,
    cameras: Sequence[Camera],
    pictures: Sequence[Picture | None],
    histograms: Floats,
    pose_is_known: bool = False,
) -> Floats:
    """Return colour histograms (cameras, nodes, 3, COLOURS) updated with the images of a frame.

    Args:
        placement: the body at its estimated pose.
        cameras: the cameras.
        pictures: image (H, W, 3 or 4) of each camera; None: its histograms stay.
        histograms: histograms before the frame, of the same shape.
        pose_is_known: use all lines, and discard the old histograms; else lines whose edge is far
            from the contour are ignored, and new colours have the weight LINES.learning_rate.
    """
    updated = histograms.copy()
    packed = pack_cameras(cameras)
    rate, max_residual = (
        (1.0, math.inf) if pose_is_known else (LINES.learning_rate, LINES.max_residual)
    )
    for c, picture in enumerate(pictures):
        if picture is not None:
            learn_colours(
                placement.packed, placement.X_WN, (packed[0][c], packed[1][c]), picture, updated[c],
                LINES.spacing, np.array(LINES.strip_widths), rate, max_residual,
                *default_arguments(learn_colours),
            )  # fmt: skip
    return updated


@compiled
def compare_lines(
    packed: PackedOutlines,
    X_WN: Array,
    camera: tuple[Array, Array],
    picture: Picture,
    histograms: Floats,
    weights: Array,
    step: int,
    A: Array,
    b: Array,
    sums: Array,
    bias_terms: Array,
    bias: float = 0.0,
) -> None:
    """Add the residuals of one camera's image along search lines to A, b, sums and bias_terms.

    Args:
        packed: surfaces of the nodes.
        X_WN: (nodes, 4, 4) poses of the nodes.
        camera: X_CW (4, 4) and `Camera.kernel_parameters` (8,).
        picture: (H, W, 3 or 4) image.
        histograms: (nodes, 3, COLOURS) of each node the frequencies of colours on it, of colours
            beside it, and their ratio.
        weights: (4,) units of length per pixel, scale of the cost [pixel], distance between search
            lines along the contour [pixel], and weight per pixel of contour length.
        step: distance between the edge offsets that are evaluated along a line [pixel]; on thin
            parts they are closer.
        A, b: (nodes, 12, 12), lower triangles, and (nodes, 12), added to: the quadratic cost
            x^T A x - 2 b^T x of each node's affine motion x (12,).
        sums: (nodes + 1, 6) by ``Sum`` of each node's contour, added to; the last row stays. A
            line's length is weighted by its information.
        bias_terms: (nodes, 13) derivatives of b and of half the cost by the bias, added to.
        bias: boundary bias: the image shows the body wider by this on all sides [pixel].
    """
    contour = sample_contour(packed, X_WN, camera, weights[2])
    uv, normals, lengths, nodes, p_N, clearances = contour
    noise = (weights[1] / 2.5) ** 2
    point_sums = np.zeros((len(uv), 7))
    scratch, place = np.empty((3, 2 * LINES.blocks + 2)), np.empty(2)
    for i in range(len(uv)):
        node = nodes[i]
        for k in range(2):
            place[k] = uv[i, k] + bias * normals[i, k]
        edge, variance = _find_edge(
            picture, histograms[node], place, normals[i], clearances[i], step, scratch
        )
        if variance > 0.0:
            length = 2.0 * lengths[i] / (1.0 + variance / noise)
            weight, _ = robust_weight(sums, node, weights, length, edge)
            add_residual(point_sums, i, normals[i, 0], normals[i, 1], edge, weight)
            point_sums[i, 5], point_sums[i, 6] = weight * normals[i, 0], weight * normals[i, 1]
            bias_terms[node, 12] += weight * edge
    accumulate_residuals(A, b, bias_terms, X_WN, camera, p_N, nodes, nodes, point_sums)


@compiled
def _colour(picture: Picture, u: float, v: float) -> int:
    """Return the histogram index of an image's colour at (u, v) [pixel]; -1 outside the image.

    Args:
        picture: (H, W, 3 or 4) image.
    """
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
    histograms: Floats,
    uv: Array,
    normal: Array,
    clearance: Array,
    step: int,
    scratch: Array,
) -> tuple[float, float]:
    """Locate the edge of a node on a search line across its contour.

    Args:
        picture: (H, W, 3 or 4) image.
        histograms: (3, COLOURS) histograms of the node, in rows by ``Colour``.
        uv, normal: (2,) point of the contour and its outward normal [pixel].
        clearance: (2,) distance inwards and outwards [pixel] over which the line crosses no other
            contour.
        step: distance between the LINES.offsets edge offsets that are evaluated [pixel]; on thin
            parts they are closer.
        scratch: (3, 2 LINES.blocks + 2) working memory, overwritten.

    Returns:
        The edge's offset outwards [pixel], and its variance [pixel^2]; (0, -1) without information.
    """
    blocks, on, beside = scratch[0], scratch[1], scratch[2]
    # The variance of an edge that lies anywhere in the window [steps^2].
    anywhere = (LINES.offsets**2 - 1) / 12.0
    # On a thin part, coarse blocks would reach across it and mix in what lies beyond.
    step = max(1, min(step, int(clearance[0] / LINES.blocks_across)))
    pixels = min(step, LINES.pixels_per_block)
    pixel_spacing = step / pixels
    for k in range(-LINES.blocks, LINES.blocks + 1):
        ratio = 1.0
        for pixel in range(pixels):
            r = k * step + pixel_spacing * (pixel + 0.5) - 0.5 * step
            colour = _colour(picture, uv[0] + r * normal[0], uv[1] + r * normal[1])
            if colour >= 0:
                ratio *= histograms[Colour.FOREGROUND, colour]
        probability = ratio / (1.0 + ratio)
        # Twice the excess over 1/2 of the probability that the block is on the body.
        blocks[k + LINES.blocks] = 4.0 * LINES.trust * (probability - 0.5)
    inner, outer = clearance[0] / step, clearance[1] / step
    # Cumulative likelihoods of the blocks before each one, on the body and beside it.
    on[0] = beside[0] = 1.0
    for k in range(2 * LINES.blocks + 1):
        on[k + 1] = on[k] * (1.0 + blocks[k])
        beside[k + 1] = beside[k] * (1.0 - blocks[k])
    total, first, second = 0.0, 0.0, 0.0
    for offset in range(LINES.offsets):
        d = offset - 0.5 * (LINES.offsets - 1)
        # The blocks at d - inner < k < d are on the body, those at d < k < d + outer beside it.
        here = offset - LINES.offsets // 2 + 1 + LINES.blocks
        begin = max(
            0, min(here, math.floor(max(d - inner, -2.0 * LINES.blocks)) + 1 + LINES.blocks)
        )
        end = min(
            2 * LINES.blocks + 1,
            max(here, math.ceil(min(d + outer, 2.0 * LINES.blocks)) + LINES.blocks),
        )
        likelihood = on[here] / on[begin] * beside[end] / beside[here]
        total += likelihood
        first += likelihood * d
        second += likelihood * d * d
    if total < 1e-30:
        return 0.0, -1.0
    mean = first / total
    # The variance is at least that of a uniform distribution between two offsets.
    variance = max(second / total - mean * mean, 1.0 / 12.0)
    # Subtract the information of the window itself, which says 0 +- its width.
    information = 1.0 / variance - 1.0 / anywhere
    if variance * LINES.min_variance_ratio > anywhere:
        return 0.0, -1.0
    edge = min(max(mean / variance / information, -0.5 * LINES.offsets), 0.5 * LINES.offsets)
    return edge * step, step * step / information


@compiled
def learn_colours(
    packed: PackedOutlines,
    X_WN: Array,
    camera: tuple[Array, Array],
    picture: Picture,
    histograms: Floats,
    spacing: float,
    strip_widths: Array,
    rate: float,
    max_residual: float,
    rare: float = 1e-4,
    fewest: float = 20.0,
) -> None:
    """Update a camera's colour histograms from both sides of a body's contour, in place.

    Args:
        packed: surfaces of the nodes.
        X_WN: (nodes, 4, 4) poses of the nodes.
        camera: X_CW (4, 4) and `Camera.kernel_parameters` (8,).
        picture: (H, W, 3 or 4) image.
        histograms: (nodes, 3, COLOURS) histograms, in rows by ``Colour``, changed.
        spacing: distance between search lines along the contour [pixel].
        strip_widths: (2,) widths of the strips inside and outside the contour that are counted
            [pixel].
        rate: weight of the new colours against the old histograms; where a node's histogram is
            empty, it becomes the new colours.
        max_residual: a line whose edge is further from the contour than this is ignored [pixel];
            inf: no line is ignored.
        rare: added to frequencies, so that rarer colours count as unobserved [fraction of pixels].
        fewest: minimum number of pixels on a side of a node's contour for an update.
    """
    uv, normals, _, nodes, _, clearances = sample_contour(packed, X_WN, camera, spacing)
    counts = np.zeros((len(histograms), 2, COLOURS), dtype=np.float32)
    totals = np.zeros((len(histograms), 2))
    scratch = np.empty((3, 2 * LINES.blocks + 2))
    for i in range(len(uv)):
        node = nodes[i]
        if max_residual < np.inf:
            edge, variance = _find_edge(
                picture, histograms[node], uv[i], normals[i], clearances[i], 1, scratch
            )
            if variance > 0.0 and abs(edge) > max_residual:
                continue
        for side in range(2):
            sign = -1.0 if side == Colour.ON else 1.0
            pixels = int(min(strip_widths[side], clearances[i, side] - 1.0))
            for k in range(1, pixels):
                r = sign * k
                u, v = uv[i, 0] + r * normals[i, 0], uv[i, 1] + r * normals[i, 1]
                colour = _colour(picture, u, v)
                if colour < 0:
                    break
                counts[node, side, colour] += 1.0
                totals[node, side] += 1.0
    for node in range(len(histograms)):
        for side in range(2):
            frequencies, total = histograms[node, side], totals[node, side]
            if total >= fewest:
                # The first colours of a node replace the empty histogram.
                weight = rate if frequencies.any() else 1.0
                for colour in range(COLOURS):
                    frequencies[colour] += weight * (
                        counts[node, side, colour] / total - frequencies[colour]
                    )
        for colour in range(COLOURS):
            on_it, beside_it = (
                histograms[node, Colour.ON, colour],
                histograms[node, Colour.BESIDE, colour],
            )
            histograms[node, Colour.FOREGROUND, colour] = (on_it + rare) / (beside_it + rare)
