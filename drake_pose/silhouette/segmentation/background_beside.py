"""The background beside a body that is about known: other pictures show what is behind it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Picture = NDArray[np.uint8]

# A pixel shows the background where the body is less likely there than this.
_BESIDE = 0.1
# So many pictures must show a pixel's background.
_LEAST = 2
# At most so many pictures make a median.
_MOST = 40
# The least standard deviation of a colour [grey levels]; where hardly a picture tells it, more.
_DEVIATION, _UNSURE_DEVIATION = 4.0, 9.0
# At this many standard deviations the colour is as likely another's as the background's.
_EVEN = 3.0
# Beyond these a log-likelihood ratio says no more: shadows, reflections, the body's own colours.
_LOWEST, _HIGHEST = -3.0, 6.0
_TO_DEVIATION = 1.4826


def tell_from_background(
    pictures: Sequence[Picture], probabilities: Sequence[Array]
) -> list[Array]:
    """How much more likely each pixel's colour is the body's than the background's.

    Pictures (H, W, 3) of one camera that stands still are brought to each other's exposure and
    light; ``probabilities`` (H, W) say how likely the body is at each pixel.

    Returns:
        The log likelihood ratio (H, W) of each picture; 0 where no other shows the background.
    """
    even = _match_exposure(pictures, probabilities)
    step = -(-len(even) // _MOST)
    stack = np.stack(even[::step])
    hidden = np.stack(probabilities[::step]) >= _BESIDE
    count = np.count_nonzero(~hidden, axis=0)
    middle = _masked_median(stack, hidden, count)
    spread = _masked_median(np.abs(stack - middle), hidden, count).mean(axis=-1) * _TO_DEVIATION
    deviation = np.where(count > _LEAST, np.maximum(spread, _DEVIATION), _UNSURE_DEVIATION)
    found = []
    for picture in even:
        off = np.sqrt(np.mean((picture - middle) ** 2, axis=-1)) / deviation
        ratio = np.clip(0.5 * (off**2 - _EVEN**2), _LOWEST, _HIGHEST)
        found.append(np.where(count >= _LEAST, ratio, 0.0).astype(np.float32))
    return found


def _match_exposure(pictures: Sequence[Picture], probabilities: Sequence[Array]) -> list[Array]:
    """Pictures of one exposure: each channel is scaled by what surely is background in all."""
    sure = np.max(probabilities, axis=0) < 0.5 * _BESIDE
    if not sure.any():
        return [picture.astype(np.float32) for picture in pictures]
    seen = np.stack([picture[sure] for picture in pictures]).astype(np.float32) + 1.0
    reference = np.median(seen, axis=0)
    gains = np.median(seen / reference, axis=1)
    return [
        np.clip(picture / gain, 0.0, 255.0).astype(np.float32)
        for picture, gain in zip(pictures, gains, strict=True)
    ]


def _masked_median(stack: Array, hidden: NDArray[np.bool_], count: NDArray[np.intp]) -> Array:
    """The median (H, W, 3) of a stack (n, H, W, 3) without what is hidden (n, H, W)."""
    result = np.zeros(stack.shape[1:], dtype=np.float32)
    last = np.maximum(count - 1, 0)
    for row in range(stack.shape[1]):
        values = np.sort(np.where(hidden[:, row, :, None], np.inf, stack[:, row]), axis=0)
        across = np.arange(values.shape[1])
        middle = values[last[row] // 2, across] + values[(last[row] + 1) // 2, across]
        result[row] = np.where(count[row][:, None] > 0, 0.5 * middle, 0.0)
    return result
