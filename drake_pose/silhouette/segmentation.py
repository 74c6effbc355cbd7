"""Segmentation of objects in pictures: by a background model, or strong outlines.

Foreground pixels differ from a learnt background, or from the same pixel in pictures without the
object. Regions with strong outlines are candidates for an unknown object.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Floats, Mask, Picture
from drake_pose.errors import SettingsError
from drake_pose.silhouette.pictures.masks import intersection_over_union


class Background:
    """A background model: mean colour and noise of each pixel of an empty scene.

    Attributes:
        mean: (H, W, 3) uint8 mean colour [grey levels].
        deviation: (H, W) float32 standard deviation [grey levels].
    """

    def __init__(self, mean: Picture, deviation: Floats, threshold: float = 5.0) -> None:
        """Store mean and deviation (see the class).

        ``threshold``: a colour with a channel that differs from the mean by more than this is not
        the background's [standard deviations].
        """
        self.mean, self.deviation, self._threshold = mean, deviation, threshold
        largest = np.minimum(np.floor(threshold * deviation), 255.0).astype(np.uint8)
        self.tolerance = np.repeat(largest[:, :, None], 3, axis=2)
        """(H, W, 3) largest difference of each channel from the mean [grey levels]."""

    @staticmethod
    def of_noise(mean: Picture, noise: Floats, least: float = 3.0) -> "Background":
        """Return the background of a mean and its noise (H, W), ``least`` or more [grey levels]."""
        return Background(mean, np.maximum(noise, np.float32(least)))

    def with_noise(self, factor: float) -> "Background":
        """Return the background with its standard deviations multiplied by a factor."""
        return Background(self.mean, factor * self.deviation, self._threshold)


def learn_background(pictures: Sequence[Picture]) -> Background:
    """Return the background of pictures (H, W, 3) of the empty scene.

    SettingsError: there is no picture, or sizes differ.
    """
    _require_one_size(pictures, 1, "a background needs one or more pictures of the same size")
    stack = np.stack([picture.astype(np.float32) for picture in pictures])
    deviation = np.sqrt(stack.var(axis=0).mean(axis=-1))
    mean = np.rint(stack.mean(axis=0)).astype(np.uint8)
    return Background.of_noise(mean, deviation)


def background_of_recording(pictures: Sequence[Picture]) -> Background:
    """Return the background model of a recording: each pixel's median over three or more pictures.

    An object that covers a pixel in half of the pictures, or never moves, is taken for background.
    The standard deviation is the same for all pixels.

    Raises SettingsError: there are too few pictures, or sizes differ.
    """
    message = "the median of a recording needs three or more pictures of one size"
    _require_one_size(pictures, 3, message)
    mean, spread = np.empty_like(pictures[0]), np.empty(pictures[0].shape[:2], dtype=np.float32)
    # Row by row, because all pictures as floats would fill the memory.
    for row in range(len(mean)):
        stack = np.stack([picture[row] for picture in pictures]).astype(np.float32)
        middle = np.median(stack, axis=0)
        mean[row] = np.rint(middle)
        spread[row] = np.median(np.abs(stack - middle), axis=0).mean(axis=-1)
    # The spread of a pixel that the body covers at times is the body's, so the noise is the median
    # over pixels. A normal standard deviation is 1.4826 median absolute deviations.
    noise = np.full_like(spread, 1.4826 * np.median(spread))
    return Background.of_noise(mean, noise)


def _require_one_size(pictures: Sequence[Picture], min_count: int, message: str) -> None:
    """Raise SettingsError(message) unless there are min_count or more pictures, all of one size."""
    if len(pictures) < min_count or any(picture.shape != pictures[0].shape for picture in pictures):
        raise SettingsError(message)


def person_region(picture: Picture, background: Background, min_fraction: float = 0.1) -> Mask:
    """Return the mask (H, W) where a picture (H, W, 3 or 4) differs from the background: a person.

    The difference is opened and closed morphologically. Patches smaller than ``min_fraction`` of
    the largest one are dropped as noise. Several patches or none may remain.

    Raises SettingsError: picture and background have different sizes.
    """
    size = background.mean.shape[:2]
    if picture.shape not in ((*size, 3), (*size, 4)):
        raise SettingsError(
            f"the picture is {picture.shape}, but its background {background.mean.shape}"
        )
    region, square = np.zeros(size, dtype=np.bool_), np.ones((3, 3), np.uint8)
    # Opening keeps squares of 3 x 3 pixels, so every third row suffices to locate them.
    rows = slice(int(size[0] % 3 == 0), None, 3)
    inputs = picture, background.mean, background.tolerance
    squares = cv2.erode(_differs(*(image[rows] for image in inputs)), square[:1])
    left, top, width, height = cv2.boundingRect(squares)
    if not width:
        return region
    first, last = rows.start + 3 * top, rows.start + 3 * (top + height - 1)

    def window(margin: int) -> tuple[slice, slice]:
        """Return the rows and columns of the squares' middles with a margin [pixel]."""
        ends = ((first - 1, last + 2), (left, left + width))
        down, across = (slice(max(0, a - margin), b + margin) for a, b in ends)
        return down, across

    # The margin covers the squares' borders, the reach of closing, and one more pixel.
    inner, middles = window(4), window(0)
    eroded = cv2.erode(_differs(*(image[inner] for image in inputs)), square)
    # Erosion counts pixels beyond the inner part as foreground: keep the squares' middles only.
    kept = np.zeros_like(eroded)
    pairs = zip(middles, inner, strict=True)
    place = tuple(slice(own.start - out.start, own.stop - out.start) for own, out in pairs)
    kept[place] = eroded[place]
    patches = cv2.morphologyEx(cv2.dilate(kept, square), cv2.MORPH_CLOSE, square)
    # Usually there is one patch; counting contours is faster than measuring areas.
    _, levels = cv2.findContours(patches, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    if levels is None:
        return region
    around_holes = levels[0, :, 3] >= 0
    if np.count_nonzero(~around_holes) == 1:
        region[inner] = patches > 0
        return region
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(patches, connectivity=8)
    areas = statistics[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    keep = areas >= min_fraction * areas.max()
    keep[0] = False
    region[inner] = keep.take(labels)
    return region


def _differs(picture: Picture, mean: Picture, tolerance: Picture) -> NDArray[Any]:
    """Return (H, W) uint8, non-zero where a channel differs from the mean by more than tolerance.

    ``picture``: (H, W, 3 or 4) uint8; a fourth channel is ignored. ``mean``: (H, W, 3) uint8 mean
    colour of the background [grey levels]. ``tolerance``: (H, W, 3) uint8 largest difference of the
    background's colours [grey levels].
    """
    colours = cv2.cvtColor(picture, cv2.COLOR_RGBA2RGB) if picture.shape[2] == 4 else picture
    exceeds = cv2.compare(cv2.absdiff(colours, mean), tolerance, cv2.CMP_GT)
    return cv2.cvtColor(exceeds, cv2.COLOR_RGB2GRAY)


def find_regions(
    picture: Picture,
    max_count: int,
    max_width: int = 480,
    levels: int = 16,
    max_overlap: float = 0.85,
) -> list[Mask]:
    """Return regions (H, W) of a picture with strong outlines, each of which may be an object.

    Lightness and two colour channels are thresholded at many levels. Each connected component above
    or below a threshold, with its holes filled, is a region, as in a component tree (MSER, Matas et
    al. 2002). Of regions of one channel that overlap, the one with the strongest outline is kept.
    Regions of different channels may overlap.

    Args:
        picture: (H, W, 3) the picture.
        max_count: largest number of regions.
        max_width: width to which larger pictures are reduced [pixel].
        levels: number of thresholds of each channel.
        max_overlap: regions of one channel with a larger IoU are duplicates.
    """
    height, width = picture.shape[:2]
    scale = min(1.0, max_width / width)
    size = max(1, round(scale * width)), max(1, round(scale * height))
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB).astype(np.float32)
    whole = np.moveaxis(cv2.GaussianBlur(lab, (0, 0), 1.0), -1, 0)
    by_channel = []
    for channel in (cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in whole):
        slopes = (cv2.Sobel(channel, cv2.CV_32F, *by) for by in ((1, 0), (0, 1)))
        change = np.hypot(*slopes)
        low, high = np.quantile(channel, (0.01, 0.99)).tolist()
        # Each region with its outline's strength, its side of the threshold, and the threshold.
        regions = [
            (_strength(mask, change), mask, sign, level)
            for level in np.linspace(low, high, levels + 2)[1:-1].tolist()
            for sign in (1.0, -1.0)
            for mask in _components(np.asarray(sign * channel > sign * level))
        ]
        kept = list[tuple[Mask, float, float]]()
        for _, *region in sorted(regions, key=lambda region: -region[0]):
            if all(intersection_over_union(region[0], one[0]) < max_overlap for one in kept):
                kept.append(tuple(region))
            if len(kept) == max_count:
                break
        by_channel.append(kept)
    # All regions of a grey picture come from its lightness.
    rows = zip_longest(*by_channel)
    found = [(k, *region) for row in rows for k, region in enumerate(row) if region is not None]
    return [
        _upscaled(mask, sign * whole[k] > sign * level)
        for k, mask, sign, level in found[:max_count]
    ]


def _strength(mask: Mask, change: Floats, quantile: float = 0.25) -> float:
    """Return the strength of a mask's outline: a quantile of the change along it, times sqrt(area).

    ``mask``: (h, w) the region. ``change``: (h, w) gradient magnitude of the channel. ``quantile``:
    the quantile, 0 to 1. Returns the strength; 0 if the mask has no pixel on its edge.
    """
    inside = cv2.erode(mask.view(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
    edge = change[mask & ~inside]
    if not len(edge):
        return 0.0
    return float(np.quantile(edge, quantile)) * math.sqrt(np.count_nonzero(mask))


def _components(above: Mask, sizes: tuple[float, float] = (0.003, 0.7)) -> Iterator[Mask]:
    """Yield the connected components (H, W) of ``above`` (H, W), with holes filled.

    ``sizes``: smallest area of a component before, and largest area after filling, as fractions of
    the picture's area.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats(above.view(np.uint8), connectivity=4)
    for k in np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= sizes[0] * above.size) + 1:
        region = _filled(labels == k)
        if np.count_nonzero(region) <= sizes[1] * above.size:
            yield region


def _filled(region: Mask, max_fraction: float = 0.1) -> Mask:
    """Return a region (H, W) without holes.

    ``max_fraction``: an area enclosed together with the picture's border is a hole if it is smaller
    than this fraction of the region.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~region).view(np.uint8))
    u, v, width, height, area = stats.T
    inside = (u > 0) & (v > 0) & (u + width < region.shape[1]) & (v + height < region.shape[0])
    fills = inside | (area < max_fraction * np.count_nonzero(region))
    return np.asarray(region | fills[labels])


def _upscaled(region: Mask, above: Mask) -> Mask:
    """Return a region (h, w) at full size (H, W), its edge set by the threshold, holes filled.

    ``above``: (H, W) whether the picture's pixels are on the region's side of its threshold.
    """
    height, width = above.shape
    size = (width, height)
    rough = cv2.resize(region.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    by = np.ones((2 * math.ceil(width / region.shape[1]) + 1,) * 2, np.uint8)
    sure, near = cv2.erode(rough, by, borderValue=1) > 0, cv2.dilate(rough, by) > 0
    return _filled(sure | (near & above))
