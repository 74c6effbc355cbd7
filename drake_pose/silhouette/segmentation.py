"""Objects in pictures: by their background, learnt or beside them, by a box, or by outlines."""

import math
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Floats, Mask, Picture
from drake_pose.errors import SettingsError
from drake_pose.silhouette.pictures.masks import intersection_over_union


class Background:
    """An empty scene's mean colour (H, W, 3) and its standard deviation (H, W) [grey levels]."""

    def __init__(self, mean: Picture, deviation: Floats, deviations: float = 5.0) -> None:
        """``deviations``: a colour farther off is not the background's [standard deviations]."""
        self.mean, self.deviation, self._deviations = mean, deviation, deviations
        off = np.minimum(np.floor(deviations * deviation), 255.0).astype(np.uint8)
        self.tolerance = np.repeat(off[:, :, None], 3, axis=2)
        """(H, W, 3) how far each channel may be off where only the background is seen."""

    def with_noise(self, times: float) -> "Background":
        """The same background with its noise multiplied."""
        return Background(self.mean, times * self.deviation, self._deviations)


def learn_background(pictures: Sequence[Picture], least_deviation: float = 3.0) -> Background:
    """The background from pictures (H, W, 3) of the empty scene, all of one size.

    ``least_deviation``: the camera's noise is no less [grey levels]. Raises SettingsError for no
    picture, or pictures of different sizes.
    """
    _require_one_size(pictures, 1, "a background needs one or more pictures of the same size")
    stack = np.stack([picture.astype(np.float32) for picture in pictures])
    deviation = np.sqrt(stack.var(axis=0).mean(axis=-1))
    mean = np.rint(stack.mean(axis=0)).astype(np.uint8)
    return Background(mean, np.maximum(deviation, least_deviation))


def background_of_recording(
    pictures: Sequence[Picture], least_deviation: float = 3.0
) -> Background:
    """The background from three or more pictures (H, W, 3) of a recording: each pixel's median.

    What covers a pixel in half of the pictures, or never moves, is taken for background. Raises
    SettingsError for too few pictures, or pictures of different sizes.
    """
    message = "the median of a recording needs three or more pictures of one size"
    _require_one_size(pictures, 3, message)
    mean, spread = np.empty_like(pictures[0]), np.empty(pictures[0].shape[:2], dtype=np.float32)
    # Row by row: all pictures as numbers with a point would fill the memory.
    for row in range(len(mean)):
        stack = np.stack([picture[row] for picture in pictures]).astype(np.float32)
        middle = np.median(stack, axis=0)
        mean[row] = np.rint(middle)
        spread[row] = np.median(np.abs(stack - middle), axis=0).mean(axis=-1)
    # Where the body passes the spread is the body's: the camera's noise is that of most pixels.
    # Normal noise deviates by 1.4826 medians of its absolute values.
    noise = max(least_deviation, float(1.4826 * np.median(spread)))
    return Background(mean, np.full(spread.shape, noise, dtype=np.float32))


def _require_one_size(pictures: Sequence[Picture], least: int, message: str) -> None:
    if len(pictures) < least or any(one.shape != pictures[0].shape for one in pictures):
        raise SettingsError(message)


def background_support(pictures: Sequence[Picture], background: Background) -> Floats:
    """(H, W) in what fraction of pictures each pixel shows the background."""
    shown = np.zeros(background.deviation.shape, dtype=np.float32)
    for picture in pictures:
        shown += _off(picture, background.mean, background.tolerance) == 0
    return np.asarray(shown / len(pictures), dtype=np.float32)


def person_region(picture: Picture, background: Background, smallest: float = 0.1) -> Mask:
    """Where a picture (H, W, 3 or 4) differs from its camera's background: the person, (H, W).

    Patches smaller than the fraction ``smallest`` of the largest are dropped as noise; the rest may
    be several parts, or nothing. Raises SettingsError for a picture of another size than the
    background.
    """
    size = background.mean.shape[:2]
    if picture.shape not in ((*size, 3), (*size, 4)):
        raise SettingsError(
            f"the picture is {picture.shape}, but its background {background.mean.shape}"
        )
    region, square = np.zeros(size, dtype=np.bool_), np.ones((3, 3), np.uint8)
    # Opening leaves squares of 3 x 3 pixels: every third row tells where they may be.
    rows = slice(int(size[0] % 3 == 0), None, 3)
    seen = picture, background.mean, background.tolerance
    told = cv2.erode(_off(*(one[rows] for one in seen)), square[:1])
    left, top, width, height = cv2.boundingRect(told)
    if not width:
        return region
    first, last = rows.start + 3 * top, rows.start + 3 * (top + height - 1)

    def around(margin: int) -> tuple[slice, slice]:
        """Rows and columns of the squares' middles with a margin, as far as in the picture."""
        ends = ((first - 1, last + 2), (left, left + width))
        down, across = (slice(max(0, a - margin), b + margin) for a, b in ends)
        return down, across

    # The margin reaches to the squares' borders, as far as closing looks, and one to spare.
    inner, middles = around(4), around(0)
    eroded = cv2.erode(_off(*(one[inner] for one in seen)), square)
    # Erosion takes what is beyond the inner part for the person: only squares' middles are right.
    kept = np.zeros_like(eroded)
    place = tuple(
        slice(own.start - outer.start, own.stop - outer.start)
        for own, outer in zip(middles, inner, strict=True)
    )
    kept[place] = eroded[place]
    patches = cv2.morphologyEx(cv2.dilate(kept, square), cv2.MORPH_CLOSE, square)
    # The contours tell soon that there is but one patch, as there mostly is; areas take longer.
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
    keep = areas >= smallest * areas.max()
    keep[0] = False
    region[inner] = keep.take(labels)
    return region


def _off(picture: Picture, mean: Picture, tolerance: Picture) -> NDArray[Any]:
    """(H, W) not 0 where a channel of a picture (H, W, 3 or 4) is off; a fourth says nothing."""
    seen = cv2.cvtColor(picture, cv2.COLOR_RGBA2RGB) if picture.shape[2] == 4 else picture
    off = cv2.compare(cv2.absdiff(seen, mean), tolerance, cv2.CMP_GT)
    return cv2.cvtColor(off, cv2.COLOR_RGB2GRAY)


def foreground_log_ratios(
    pictures: Sequence[Picture],
    probabilities: Sequence[Floats],
    wanted: Sequence[int],
    *,
    beside: float = 0.1,
    nowhere: float = 0.011,
    min_count: int = 2,
    max_count: int = 40,
    exposure_pixels: int = 20_000,
    least_deviation: float = 4.0,
    unsure_deviation: float = 9.0,
    even: float = 3.0,
    bounds: tuple[float, float] = (-3.0, 6.0),
) -> list[Floats]:
    """How much more likely each pixel's colour is the body's than the background's.

    Pictures (H, W, 3) of one camera that stands still are brought to each other's exposure and
    light; ``probabilities`` (H, W) say how likely the body is at each pixel.

    Args:
        beside: a pixel shows the background where the body is less likely.
        nowhere: nothing is looked at where the body is less likely in all that are wanted.
        min_count: number of pictures that must show a pixel's background.
        max_count: largest number of pictures of a median.
        exposure_pixels: largest number of pixels that tell the exposure.
        least_deviation: least standard deviation of a colour [grey levels].
        unsure_deviation: that of a colour which only ``min_count`` pictures show [grey levels].
        even: distance at which a colour is as likely another's as the background's [standard
            deviations].
        bounds: of a log-likelihood ratio, for shadows, reflections and the body's own colours.

    Returns:
        The log likelihood ratio (H, W) of each picture that is wanted; 0 where no other shows the
        background, and the lowest where the body is likely in none of them.
    """
    near = np.max([probabilities[k] for k in wanted], axis=0) >= nowhere
    # The channels' exposures (n, 3), by what surely is background in all pictures.
    gains = np.ones((len(pictures), 3), np.float32)
    sure = np.flatnonzero(np.max(probabilities, axis=0) < 0.5 * beside)
    if len(sure):
        sure = sure[:: -(-len(sure) // exposure_pixels)]
        seen = np.stack([picture.reshape(-1, 3)[sure] for picture in pictures]).astype(np.float32)
        gains = np.median((seen + 1.0) / (np.median(seen, axis=0) + 1.0), axis=1)
    evened = [
        np.minimum(picture[near] / gain, 255.0, dtype=np.float32)
        for picture, gain in zip(pictures, gains, strict=True)
    ]
    step = -(-len(evened) // max_count)
    hidden = np.stack([one[near] for one in probabilities[::step]]) >= beside
    count = np.count_nonzero(~hidden, axis=0)
    stack = np.stack(evened[::step])
    middle = _masked_median(stack, hidden, count)
    spread = _masked_median(np.abs(stack - middle), hidden, count).mean(axis=-1) * 1.4826
    deviation = np.where(count > min_count, np.maximum(spread, least_deviation), unsure_deviation)
    found = []
    for k in wanted:
        squares = np.mean((evened[k] - middle) ** 2, axis=-1) / deviation**2
        lowest = bounds[0] if len(pictures) >= min_count else 0.0
        ratio = np.full(near.shape, lowest, np.float32)
        told = np.clip(0.5 * (squares - even**2), *bounds)
        ratio[near] = np.where(count >= min_count, told, 0.0)
        found.append(ratio)
    return found


def _masked_median(stack: Floats, hidden: NDArray[np.bool_], count: NDArray[np.intp]) -> Floats:
    """The median (p, 3) of a stack (n, p, 3) without what is hidden (n, p); 0 of nothing."""
    values = np.sort(np.where(hidden[:, :, None], np.float32(np.inf), stack), axis=0)
    last, across = np.maximum(count - 1, 0), np.arange(len(count))
    middle = 0.5 * (values[last // 2, across] + values[(last + 1) // 2, across])
    return np.where(count[:, None] > 0, middle, np.float32(0.0))


def grab_cut_box(picture: Picture, box: Sequence[float]) -> Mask:
    """The object (H, W) in a picture (H, W, 3) and a box x, y, width, height [pixel] around it.

    Raises SettingsError where the box lies outside the picture, or is all of it.
    """
    height, width = picture.shape[:2]
    x, y, w, h = box
    left, right = (int(np.clip(np.rint(value), 0, width)) for value in (x, x + w))
    top, bottom = (int(np.clip(np.rint(value), 0, height)) for value in (y, y + h))
    if right - left < 2 or bottom - top < 2:
        raise SettingsError(
            f"the box {x:g},{y:g},{w:g},{h:g} (x, y, width, height) lies outside the picture, "
            f"{width} x {height} pixels"
        )
    if (right - left, bottom - top) == (width, height):
        raise SettingsError("the box is the whole picture: leave some of the surroundings out")
    labels = np.full((height, width), cv2.GC_BGD, dtype=np.uint8)
    labels[top:bottom, left:right] = cv2.GC_PR_FGD
    return grab_cut(picture, labels)


def grab_cut(
    picture: Picture,
    labels: NDArray[np.uint8],
    iterations: int = 6,
    every: int = 1,
    seed: int = 1,
) -> Mask:
    """The object (H, W) by labels (H, W) of GrabCut (Rother et al., 2004), left as they are.

    Args:
        every: colours are learnt from every nth row and column, and what is in doubt is cut once by
            these; 1: all of it is cut in each of the iterations.
        seed: GrabCut draws its first clusters at random.
    """
    found = labels.copy()
    is_doubted = np.isin(labels, (cv2.GC_PR_FGD, cv2.GC_PR_BGD))
    if is_doubted.any():
        cv2.setRNGSeed(seed)
        colours, no_box = (np.zeros((1, 65)), np.zeros((1, 65))), (0, 0, 0, 0)
        some, own = (np.ascontiguousarray(one[::every, ::every]) for one in (picture, found))
        cv2.grabCut(some, own, no_box, *colours, iterations, cv2.GC_INIT_WITH_MASK)
        if every == 1:
            found = own
        else:
            x, y, w, h = cv2.boundingRect(is_doubted.astype(np.uint8))
            box = np.s_[max(0, y - 1) : y + h + 1, max(0, x - 1) : x + w + 1]
            own = np.ascontiguousarray(found[box])
            some = np.ascontiguousarray(picture[box])
            cv2.grabCut(some, own, no_box, *colours, 1, cv2.GC_EVAL_FREEZE_MODEL)
            found[box] = own
    return np.asarray((found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD))


class _Region(NamedTuple):
    """A mask (h, w) in a smaller picture, how strong its outline is, and the threshold."""

    mask: Mask
    strength: float
    sign: float
    level: float


def find_regions(
    picture: Picture, most: int, max_width: int = 480, levels: int = 16, same: float = 0.85
) -> list[Mask]:
    """Regions (H, W) of a picture (H, W, 3) that may be one object, those with strong outlines.

    Nothing is known of the object. Of lightness and of two channels of colour there are thresholds
    at many levels; what is connected above or below one is a region, as in a tree of components
    (MSER, Matas et al. 2002), its holes filled. Of regions that are about the same the one is kept
    along whose outline the channel changes most; two of two channels may be about the same.

    Args:
        most: largest number of regions.
        max_width: pictures are looked at so wide at most [pixel].
        levels: thresholds of each channel.
        same: regions that overlap more (IoU) are one.
    """
    height, width = picture.shape[:2]
    share = min(1.0, max_width / width)
    size = max(1, round(share * width)), max(1, round(share * height))
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB).astype(np.float32)
    whole = np.moveaxis(cv2.GaussianBlur(lab, (0, 0), 1.0), -1, 0)
    strongest = []
    for channel in (cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in whole):
        slopes = (cv2.Sobel(channel, cv2.CV_32F, *by) for by in ((1, 0), (0, 1)))
        change = np.hypot(*slopes)
        low, high = np.quantile(channel, (0.01, 0.99)).tolist()
        regions = [
            _Region(mask, _strength(mask, change), sign, level)
            for level in np.linspace(low, high, levels + 2)[1:-1].tolist()
            for sign in (1.0, -1.0)
            for mask in _components(np.asarray(sign * channel > sign * level))
        ]
        kept = list[_Region]()
        for region in sorted(regions, key=lambda one: -one.strength):
            if all(intersection_over_union(region.mask, other.mask) < same for other in kept):
                kept.append(region)
            if len(kept) == most:
                break
        strongest.append(kept)
    # A grey picture has all of them of its lightness.
    rows = zip_longest(*strongest)
    found = [(k, one) for row in rows for k, one in enumerate(row) if one is not None]
    return [
        _enlarged(one.mask, one.sign * whole[k] > one.sign * one.level) for k, one in found[:most]
    ]


def _strength(mask: Mask, change: Floats, weakest: float = 0.25) -> float:
    """How much a picture changes (h, w) along an outline, the longer the better.

    ``weakest``: the quantile of the change that tells how strong the outline is.
    """
    inside = cv2.erode(mask.view(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
    edge = change[mask & ~inside]
    if not len(edge):
        return 0.0
    return float(np.quantile(edge, weakest)) * math.sqrt(np.count_nonzero(mask))


def _components(above: Mask, sizes: tuple[float, float] = (0.003, 0.7)) -> Iterator[Mask]:
    """What is connected in (H, W), its holes filled; ``sizes``: fractions of the picture."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(above.view(np.uint8), connectivity=4)
    for k in np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= sizes[0] * above.size) + 1:
        region = _filled(labels == k)
        if np.count_nonzero(region) <= sizes[1] * above.size:
            yield region


def _filled(region: Mask, at_border: float = 0.1) -> Mask:
    """A region (H, W) without holes.

    ``at_border``: what it encloses together with the picture's border is a hole if it is smaller
    than this fraction of it.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~region).view(np.uint8))
    u, v, width, height, area = stats.T
    inside = (u > 0) & (v > 0) & (u + width < region.shape[1]) & (v + height < region.shape[0])
    fills = inside | (area < at_border * np.count_nonzero(region))
    return np.asarray(region | fills[labels])


def _enlarged(region: Mask, above: Mask) -> Mask:
    """A region found in a smaller picture, in the whole one (H, W): as a threshold has it."""
    height, width = above.shape
    size = (width, height)
    rough = cv2.resize(region.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    by = np.ones((2 * math.ceil(width / region.shape[1]) + 1,) * 2, np.uint8)
    sure, near = cv2.erode(rough, by, borderValue=1) > 0, cv2.dilate(rough, by) > 0
    return _filled(sure | (near & above))
