"""Pictures as evidence of a body's pose: colours along lines across the body's contour.

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

Nothing is kept here between frames: a tracker keeps the histograms, and gets new ones.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.camera.models import Camera
from drake_pose.compiled import compiled
from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import Comparison, Noise, camera_weights, pack_cameras
from drake_pose.fit.kernel import Sum, add_pull, add_pulls, count_distance, seen_from
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import Placement
from drake_pose.silhouette.contour_points import sample_contour
from drake_pose.silhouette.outline import Outline, PackedOutlines
from drake_pose.silhouette.scoring import draw_labels

COLOURS = 4096
"""Number of colours that histograms tell apart: 16 steps of red, green and blue."""


class Colour(IntEnum):
    """Rows of a node's histograms: frequencies on it and beside it, and their ratio."""

    ON = 0
    BESIDE = 1
    FOREGROUND = 2


class LineSettings(NamedTuple):
    """Lines across a contour.

    Attributes:
        offsets: number of the edge's offsets along a line.
        blocks: number of blocks of pixels on either side of the contour: four beyond the last
            offset.
        pixels: number of pixels that are read of a block: its others say the same.
        blocks_across: least number of blocks across the thinnest part, where they are coarser than
            a pixel.
        trust: a block is believed to be on the right side with at most this above one half.
        speaks: a line counts if the window's variance is this factor above the edge's.
        spacing: from line to line along the contour [pixel], where the step is one.
        correlation: length of contour whose lines err together [pixel].
        steps: from offset to offset, round after round [pixel]; the last is that of all further
            rounds.
        widths: of the strips inside and outside of the contour in which colours are counted
            [pixel].
        rate: weight of a frame's colours in the histograms after it.
        agreeing: a line whose edge seems to be further from the contour [pixel] teaches nothing.
    """

    offsets: int = 12
    blocks: int = 9
    pixels: int = 4
    blocks_across: float = 6.0
    trust: float = 0.4
    speaks: float = 1.15
    spacing: float = 2.0
    correlation: float = 5.0
    steps: tuple[int, int, int] = (4, 2, 1)
    widths: tuple[float, float] = (16.0, 30.0)
    rate: float = 0.1
    agreeing: float = 2.5


LINES = LineSettings()


def colour_numbers(pixels: Picture) -> NDArray[np.intp]:
    """(...) the colours of pixels (..., 3 or 4), as histograms count them."""
    red, green, blue = np.moveaxis(pixels[..., :3].astype(np.intp) >> 4, -1, 0)
    return (red * 16 + green) * 16 + blue


@dataclass(frozen=True, eq=False)
class PartColours:
    """What parts look like to whichever camera, learned where the body is known to be.

    Args:
        known: (nodes, COLOURS) which colours are a part's own.
        usual: (nodes,) the share of its pixels that had them there; nan: it was not seen.
    """

    known: Mask
    usual: Array

    @staticmethod
    def learned(
        histograms: Iterable[Floats],
        outlines: Sequence[Outline],
        X_WN: Array,
        views: Iterable[tuple[Camera, Picture]],
    ) -> "PartColours":
        """Those of cameras' histograms, of a body of these surfaces at X_WN (nodes, 4, 4)."""
        # Rarer colours than this fraction of the pixels are not a part's own.
        known = np.any([one[:, Colour.ON] > 4e-4 for one in histograms], axis=0)
        own = PartColours(known, np.ones(len(known)))
        return PartColours(known, own._shares(outlines, X_WN, views))

    def shown(
        self, outlines: Sequence[Outline], X_WN: Array, views: Iterable[tuple[Camera, Picture]]
    ) -> Array:
        """(nodes,) how many times the usual share shows: of the median, as light changes all."""
        shares = self._shares(outlines, X_WN, views) / self.usual
        return np.asarray(shares / max(float(np.nanmedian([*shares, 1.0])), 1e-9))

    def _shares(
        self, outlines: Sequence[Outline], X_WN: Array, views: Iterable[tuple[Camera, Picture]]
    ) -> Array:
        counts = np.zeros((2, len(outlines)))
        for camera, picture in views:
            labels = draw_labels(outlines, range(1, 1 + len(outlines)), camera.X_CW @ X_WN, camera)
            seen = labels > 0
            parts = labels[seen] - 1
            np.add.at(counts[0], parts, self.known[parts, colour_numbers(picture[seen])])
            np.add.at(counts[1], parts, 1.0)
        # Fewer than a hundred pixels say nothing of a part.
        return np.where(counts[1] < 100, np.nan, counts[0] / np.maximum(counts[1], 1.0))


def search_line_step(number: int) -> int:
    """From offset to offset of lines in a round, counted from 0 [pixel]."""
    return LINES.steps[min(number, len(LINES.steps) - 1)]


def uninformed_histograms(cameras: int, nodes: int) -> Floats:
    """What is known of a body that was never seen: nothing."""
    known = np.zeros((cameras, nodes, len(Colour), COLOURS), dtype=np.float32)
    known[:, :, Colour.FOREGROUND] = 1.0
    return known


def check_picture(camera: Camera, picture: Picture) -> Picture:
    """A picture as kernels take it: a copy where it cannot be written or lies in pieces.

    Raises:
        SettingsError: it is not (H, W, 3) or (H, W, 4) bytes of the camera's size.
    """
    shape = (camera.height, camera.width)
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] not in (3, 4):
        raise SettingsError(
            f"camera '{camera.name}': a picture of red, green and blue bytes expected, got "
            f"{picture.shape} {picture.dtype}"
        )
    if picture.shape[:2] != shape:
        raise SettingsError(
            f"camera '{camera.name}': picture of {picture.shape[1]} x {picture.shape[0]} pixels, "
            f"{camera.width} x {camera.height} expected"
        )
    return np.require(picture, requirements=["C", "W"])


def add_pictures(
    compared: Comparison,
    cameras: Sequence[Camera],
    pictures: Sequence[Picture | None],
    histograms: Floats,
    step: AnnealingStage,
    noise: Noise,
    pixels: int,
) -> None:
    """Adds what pictures say to what silhouettes say, in place.

    Args:
        compared: of all cameras.
        cameras: the cameras.
        pictures: of each; None: no lines are looked at in it.
        histograms: what is known of the colours.
        step: the scale of the residuals, and the spacing of lines [pixel].
        noise: of lines [pixel].
        pixels: from offset to offset along lines.
    """
    placed = compared.placement
    packed = pack_cameras(cameras)
    weights = camera_weights(packed, placed, step, noise, 1.0)
    for c, picture in enumerate(pictures):
        if picture is not None:
            compare_lines(
                placed.packed, placed.X_WN, (packed[0][c], packed[1][c]), picture, histograms[c],
                weights[c], pixels, compared.A[c], compared.b[c], compared.sums[c],
                compared.wide[c],
            )  # fmt: skip


def weigh_parts(
    compared: Comparison,
    deviation: float,
    pictures: Sequence[Picture | None],
    noisiest: float = 2.0,
) -> None:
    """Gives parts whose lines scatter more than those of others less weight, in place.

    A part has few lines that err independently: its variance is taken half way, on a scale of
    logarithms, between its own and that of all.

    Args:
        compared: of all cameras.
        deviation: the least of lines [pixel].
        pictures: of each camera; None: its silhouettes are not weighed.
        noisiest: the largest standard deviation that a part's lines are given [pixel]: lines of a
            part that is far off must still show where it is.
    """
    shown = [c for c, picture in enumerate(pictures) if picture is not None]
    squares, weight = (compared.sums[shown, :-1, k] for k in (Sum.SQUARES, Sum.WEIGHT))
    overall = max(deviation**2, float(squares.sum() / max(float(weight.sum()), 1e-12)))
    own = np.clip(squares / np.maximum(weight, 1e-12), deviation**2, noisiest**2)
    share = np.sqrt(overall / own)
    compared.A[shown] *= share[..., None, None]
    compared.b[shown] *= share[..., None]


def part_distances(sums: Array, closest: float = 0.7, shortest: float = 20.0) -> Array:
    """(nodes,) how far each part is from the contour that colours show [pixel].

    What covers a part in one camera says nothing against it where another sees it: the mean over
    cameras is that of one over the distances' squares. 0: of the part too little is said.

    Args:
        sums: (cameras, nodes + 1, 6) of pictures, as of `compare_contours`.
        closest: a part is no closer to a contour [pixel].
        shortest: a part with less contour is not evaluated [pixel].
    """
    squares, weight, length = (sums[:, :-1, k] for k in (Sum.SQUARES, Sum.WEIGHT, Sum.COMPARED))
    own = np.maximum(closest**2, squares / np.maximum(weight, 1e-12))
    told = length.sum(axis=0)
    distances = np.sqrt(told / np.maximum((length / own).sum(axis=0), 1e-12))
    return np.where(told >= shortest, distances, 0.0)


def update_histograms(
    placed: Placement,
    cameras: Sequence[Camera],
    pictures: Sequence[Picture | None],
    histograms: Floats,
    surely: bool = False,
) -> Floats:
    """What is known of the colours after a frame.

    Args:
        placed: the body where it stands.
        cameras: the cameras.
        pictures: of each; None: it teaches nothing.
        histograms: what was known before.
        surely: whether the pose is known, so that all lines teach and old colours are forgotten.
    """
    known = histograms.copy()
    packed = pack_cameras(cameras)
    rate, agreeing = (1.0, math.inf) if surely else (LINES.rate, LINES.agreeing)
    for c, picture in enumerate(pictures):
        if picture is not None:
            learn_colours(
                placed.packed, placed.X_WN, (packed[0][c], packed[1][c]), picture, known[c],
                LINES.spacing, np.array(LINES.widths), rate, agreeing, 0,
                np.zeros((0, 0), np.bool_),
            )  # fmt: skip
    return known


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
        width: by which the body looks too wide on all sides [pixel].
    """
    contour = sample_contour(packed, seen_from(camera[0], X_WN), camera[1], weights[2])
    uv, normals, lengths, nodes, p_N, clearances = contour
    noise = (weights[1] / 2.5) ** 2
    pulls = np.zeros((len(uv), 7))
    scratch, place = np.empty((3, 2 * LINES.blocks + 2)), np.empty(2)
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
    histograms: Floats,
    uv: Array,
    normal: Array,
    clearance: Array,
    step: int,
    scratch: Array,
) -> tuple[float, float]:
    """Where the edge lies on a line, outwards, and the variance [pixel]; -1: nothing is said."""
    blocks, on, beside = scratch[0], scratch[1], scratch[2]
    # The variance of an edge that lies anywhere in the window [steps^2].
    anywhere = (LINES.offsets**2 - 1) / 12.0
    # Of a thin part coarse blocks would see little, and too much of what is beyond.
    step = max(1, min(step, int(clearance[0] / LINES.blocks_across)))
    pixels = min(step, LINES.pixels)
    apart = step / pixels
    for k in range(-LINES.blocks, LINES.blocks + 1):
        foreground = 1.0
        for pixel in range(pixels):
            r = k * step + apart * (pixel + 0.5) - 0.5 * step
            colour = _colour(picture, uv[0] + r * normal[0], uv[1] + r * normal[1])
            if colour >= 0:
                foreground *= histograms[Colour.FOREGROUND, colour]
        share = foreground / (1.0 + foreground)
        # How much more likely than not the block is on the body; 0: its colours do not say.
        blocks[k + LINES.blocks] = 4.0 * LINES.trust * (share - 0.5)
    inner, outer = clearance[0] / step, clearance[1] / step
    # How likely the colours of all blocks before one are, on the body and beside it.
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
    # An edge between two offsets has the least variance.
    variance = max(second / total - mean * mean, 1.0 / 12.0)
    # The window alone would say 0 +- its own width: what the colours say is the rest.
    information = 1.0 / variance - 1.0 / anywhere
    if variance * LINES.speaks > anywhere:
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
    widths: Array,
    rate: float,
    agreeing: float,
    step: int,
    region: Mask,
    rare: float = 1e-4,
    fewest: float = 20.0,
) -> None:
    """Counts the colours on both sides of a body's contour, and forgets old ones.

    Args:
        packed, X_WN, camera, picture: as of `compare_lines`.
        histograms: (nodes, 3, COLOURS) changed.
        spacing: of the contour's points [pixel].
        widths: (2,) of the strips inside and outside that are counted [pixel].
        rate: weight of the new colours; 1 where no colours of the node are known yet.
        agreeing: lines on which the edge seems to be further from the contour than this teach
            nothing [pixel]; inf: all do.
        step: from offset to offset [pixel] of lines that say where the edge is, on both sides of
            which colours are then counted; 0: they are counted on both sides of the contour.
        region: (H, W) where the body is known to be seen: it says what is on the body and what is
            beside it. (0, 0): that is not known.
        rare: added to frequencies, so that colours below it count as never seen [of all pixels].
        fewest: fewer pixels on one side of a node's contour teach nothing.
    """
    X_CN = seen_from(camera[0], X_WN)
    uv, normals, _, nodes, _, clearances = sample_contour(packed, X_CN, camera[1], spacing)
    counts = np.zeros((len(histograms), 2, COLOURS), dtype=np.float32)
    totals = np.zeros((len(histograms), 2))
    scratch = np.empty((3, 2 * LINES.blocks + 2))
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
            sign = -1.0 if side == Colour.ON else 1.0
            pixels = int(min(widths[side], clearances[i, side] - 1.0))
            for k in range(1, pixels):
                r = middle + sign * k
                u, v = uv[i, 0] + r * normals[i, 0], uv[i, 1] + r * normals[i, 1]
                colour = _colour(picture, u, v)
                if colour < 0:
                    break
                where = side
                if len(region):
                    where = (
                        Colour.ON
                        if region[math.floor(v + 0.5), math.floor(u + 0.5)]
                        else Colour.BESIDE
                    )
                counts[node, where, colour] += 1.0
                totals[node, where] += 1.0
    for node in range(len(histograms)):
        for side in range(2):
            shares, total = histograms[node, side], totals[node, side]
            if total >= fewest:
                # Where no colours are known yet the new ones are all.
                share = rate if shares.any() else 1.0
                for colour in range(COLOURS):
                    shares[colour] += share * (counts[node, side, colour] / total - shares[colour])
        for colour in range(COLOURS):
            on_it, beside_it = (
                histograms[node, Colour.ON, colour],
                histograms[node, Colour.BESIDE, colour],
            )
            histograms[node, Colour.FOREGROUND, colour] = (on_it + rare) / (beside_it + rare)
