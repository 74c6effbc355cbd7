"""An object by its background, learnt or beside it, or by a box (GrabCut, Rother et al., 2004)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Floats, Mask, Picture
from drake_pose.errors import SettingsError

_LEAST_DEVIATION = 3.0
# How many standard deviations the colour must be off.
_DEVIATIONS = 5.0
# Patches below this fraction of the largest one are noise.
_SMALLEST = 0.1
# From the median of normal noise's absolute values.
_TO_DEVIATION = 1.4826
# Opening leaves squares of this many pixels.
_STEP = 3
_SQUARE = np.ones((_STEP, _STEP), np.uint8)
# Around the middles of these squares: to their borders, as far as closing looks, and one to spare.
_MARGIN = 4
# Where OpenCV keeps the contour around a hole.
_PARENT = 3


@dataclass(frozen=True, eq=False)
class Background:
    """An empty scene's mean colour (H, W, 3) and its standard deviation (H, W) [grey levels]."""

    mean: Picture
    deviation: Floats


def learn_background(pictures: Sequence[Picture]) -> Background:
    """The background from pictures (H, W, 3) of the empty scene, all of one size.

    Raises SettingsError for no picture, or pictures of different sizes.
    """
    _require_one_size(pictures, 1, "a background needs one or more pictures of the same size")
    stack = np.stack([picture.astype(np.float32) for picture in pictures])
    deviation = np.sqrt(stack.var(axis=0).mean(axis=-1))
    mean = np.rint(stack.mean(axis=0)).astype(np.uint8)
    return Background(mean, np.maximum(deviation, _LEAST_DEVIATION))


def background_of_recording(pictures: Sequence[Picture]) -> Background:
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
    noise = max(_LEAST_DEVIATION, float(_TO_DEVIATION * np.median(spread)))
    return Background(mean, np.full(spread.shape, noise, dtype=np.float32))


def _require_one_size(pictures: Sequence[Picture], least: int, message: str) -> None:
    if len(pictures) < least or any(one.shape != pictures[0].shape for one in pictures):
        raise SettingsError(message)


def background_support(pictures: Sequence[Picture], background: Background) -> Floats:
    """(H, W) in what fraction of pictures each pixel shows the background."""
    tolerance = _tolerance(background)
    shown = np.zeros(background.deviation.shape, dtype=np.float32)
    for picture in pictures:
        shown += _off(picture, background.mean, tolerance) == 0
    return np.asarray(shown / len(pictures), dtype=np.float32)


def person_region(picture: Picture, background: Background) -> Mask:
    """Where a picture (H, W, 3 or 4) differs from its camera's background: the person, (H, W).

    Patches much smaller than the largest are dropped as noise; the rest may be several parts, or
    nothing. Raises SettingsError for a picture of another size than the background.
    """
    size = background.mean.shape[:2]
    if picture.shape not in ((*size, 3), (*size, 4)):
        raise SettingsError(
            f"the picture is {picture.shape}, but its background {background.mean.shape}"
        )
    region = np.zeros(picture.shape[:2], dtype=np.bool_)
    seen = picture, background.mean, _tolerance(background)
    middles = _where_squares_may_be(*seen)
    if middles is None:
        return region
    inner = _slices(middles, _MARGIN)
    eroded = cv2.erode(_off(*(one[inner] for one in seen)), _SQUARE)
    # Erosion takes what is beyond the inner part for the person: only squares' middles are right.
    kept = np.zeros_like(eroded)
    rows, columns = (
        slice(own.start - outer.start, own.stop - outer.start)
        for own, outer in zip(_slices(middles, 0), inner, strict=True)
    )
    kept[rows, columns] = eroded[rows, columns]
    closed = cv2.morphologyEx(cv2.dilate(kept, _SQUARE), cv2.MORPH_CLOSE, _SQUARE)
    region[inner] = _largest_patches(closed)
    return region


def _where_squares_may_be(
    picture: Picture, mean: Picture, tolerance: Picture
) -> tuple[range, range] | None:
    """Rows and columns of the middles of all squares off throughout, told by every third row."""
    rows = slice(int(picture.shape[0] % _STEP == 0), None, _STEP)
    told = cv2.erode(_off(picture[rows], mean[rows], tolerance[rows]), _SQUARE[:1])
    left, top, width, height = cv2.boundingRect(told)
    if not width:
        return None
    first, last = rows.start + _STEP * top, rows.start + _STEP * (top + height - 1)
    return range(first - 1, last + 2), range(left, left + width)


def _slices(ranges: tuple[range, range], margin: int) -> tuple[slice, slice]:
    """Ranges of rows and columns with a margin, as far as it is in the picture."""
    rows, columns = (slice(max(0, one.start - margin), one.stop + margin) for one in ranges)
    return rows, columns


def _off(picture: Picture, mean: Picture, tolerance: Picture) -> NDArray[Any]:
    """(H, W) not 0 where a channel of a picture (H, W, 3 or 4) is off; a fourth says nothing."""
    seen = cv2.cvtColor(picture, cv2.COLOR_RGBA2RGB) if picture.shape[2] == 4 else picture
    off = cv2.compare(cv2.absdiff(seen, mean), tolerance, cv2.CMP_GT)
    return cv2.cvtColor(off, cv2.COLOR_RGB2GRAY)


@lru_cache(maxsize=64)
def _tolerance(background: Background) -> Picture:
    """How far each channel (H, W, 3) may be off where only the background is seen."""
    off = np.minimum(np.floor(_DEVIATIONS * background.deviation), 255.0).astype(np.uint8)
    return np.repeat(off[:, :, None], 3, axis=2)


def _largest_patches(patches: NDArray[Any]) -> Mask:
    """What is not 0 in patches (H, W), without those much smaller than the largest one."""
    # The contours tell soon that there is but one patch, as there mostly is; areas take longer.
    _, levels = cv2.findContours(patches, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    if levels is None:
        return np.zeros(patches.shape, dtype=np.bool_)
    if np.count_nonzero(levels[0, :, _PARENT] < 0) == 1:
        return patches > 0
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(patches, connectivity=8)
    areas = statistics[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    keep = areas >= _SMALLEST * areas.max()
    keep[0] = False
    return keep.take(labels)


# A pixel shows the background where the body is less likely there than this.
_BESIDE = 0.1
# So many pictures must show a pixel's background.
_LEAST = 2
# Where the body is less likely than this in all that are wanted, nothing is looked at.
_NOWHERE = 0.011
# At most so many pictures make a median, and so many pixels tell the exposure.
_MOST, _EXPOSED = 40, 20_000
# The least standard deviation of a colour [grey levels]; where hardly a picture tells it, more.
_DEVIATION, _UNSURE_DEVIATION = 4.0, 9.0
# At this many standard deviations the colour is as likely another's as the background's.
_EVEN = 3.0
# Beyond these a log-likelihood ratio says no more: shadows, reflections, the body's own colours.
_LOWEST, _HIGHEST = -3.0, 6.0


def tell_from_background(
    pictures: Sequence[Picture], probabilities: Sequence[Floats], wanted: Sequence[int]
) -> list[Floats]:
    """How much more likely each pixel's colour is the body's than the background's.

    Pictures (H, W, 3) of one camera that stands still are brought to each other's exposure and
    light; ``probabilities`` (H, W) say how likely the body is at each pixel.

    Returns:
        The log likelihood ratio (H, W) of each picture that is wanted; 0 where no other shows the
        background, and the lowest where the body is likely in none of them.
    """
    near = np.max([probabilities[k] for k in wanted], axis=0) >= _NOWHERE
    gains = _exposures(pictures, np.max(probabilities, axis=0) < 0.5 * _BESIDE)
    even = [
        np.minimum(picture[near] / gain, 255.0, dtype=np.float32)
        for picture, gain in zip(pictures, gains, strict=True)
    ]
    step = -(-len(even) // _MOST)
    hidden = np.stack([one[near] for one in probabilities[::step]]) >= _BESIDE
    count = np.count_nonzero(~hidden, axis=0)
    stack = np.stack(even[::step])
    middle = _masked_median(stack, hidden, count)
    spread = _masked_median(np.abs(stack - middle), hidden, count).mean(axis=-1) * _TO_DEVIATION
    deviation = np.where(count > _LEAST, np.maximum(spread, _DEVIATION), _UNSURE_DEVIATION)
    found = []
    for k in wanted:
        squares = np.mean((even[k] - middle) ** 2, axis=-1) / deviation**2
        ratio = np.full(near.shape, _LOWEST if len(pictures) >= _LEAST else 0.0, np.float32)
        told = np.clip(0.5 * (squares - _EVEN**2), _LOWEST, _HIGHEST)
        ratio[near] = np.where(count >= _LEAST, told, 0.0)
        found.append(ratio)
    return found


def _exposures(pictures: Sequence[Picture], sure: NDArray[np.bool_]) -> Floats:
    """(n, 3) the channels' exposures, by what surely is background (H, W) in all pictures."""
    where = np.flatnonzero(sure)
    if not len(where):
        return np.ones((len(pictures), 3), np.float32)
    where = where[:: -(-len(where) // _EXPOSED)]
    seen = np.stack([picture.reshape(-1, 3)[where] for picture in pictures]).astype(np.float32)
    return np.asarray(np.median((seen + 1.0) / (np.median(seen, axis=0) + 1.0), axis=1))


def _masked_median(stack: Floats, hidden: NDArray[np.bool_], count: NDArray[np.intp]) -> Floats:
    """The median (p, 3) of a stack (n, p, 3) without what is hidden (n, p); 0 of nothing."""
    values = np.sort(np.where(hidden[:, :, None], np.float32(np.inf), stack), axis=0)
    last, across = np.maximum(count - 1, 0), np.arange(len(count))
    middle = 0.5 * (values[last // 2, across] + values[(last + 1) // 2, across])
    return np.where(count[:, None] > 0, middle, np.float32(0.0))


# GrabCut draws its first clusters at random.
_SEED = 1


def cut_box(picture: Picture, box: Sequence[float]) -> Mask:
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
    return cut(picture, labels)


def cut(picture: Picture, labels: NDArray[np.uint8], iterations: int = 6, every: int = 1) -> Mask:
    """The object (H, W) by the labels (H, W) of OpenCV's GrabCut, which are left as they are.

    ``every``: colours are learnt from every so manieth row and column, and what is in doubt is cut
    once by these; 1: all of it is cut in each of the iterations.
    """
    found = labels.copy()
    is_doubted = np.isin(labels, (cv2.GC_PR_FGD, cv2.GC_PR_BGD))
    if is_doubted.any():
        cv2.setRNGSeed(_SEED)
        colours, nowhere = (np.zeros((1, 65)), np.zeros((1, 65))), (0, 0, 0, 0)
        some, own = (np.ascontiguousarray(one[::every, ::every]) for one in (picture, found))
        cv2.grabCut(some, own, nowhere, *colours, iterations, cv2.GC_INIT_WITH_MASK)
        if every == 1:
            found = own
        else:
            x, y, w, h = cv2.boundingRect(is_doubted.astype(np.uint8))
            box = np.s_[max(0, y - 1) : y + h + 1, max(0, x - 1) : x + w + 1]
            own = np.ascontiguousarray(found[box])
            some = np.ascontiguousarray(picture[box])
            cv2.grabCut(some, own, nowhere, *colours, 1, cv2.GC_EVAL_FREEZE_MODEL)
            found[box] = own
    return np.asarray((found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD))
