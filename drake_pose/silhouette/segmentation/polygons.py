"""Areas as annotation tools describe them: polygons, and run lengths of COCO.

Polygons have their corners between pixels, as COCO and labelme count: pixel (0, 0) reaches from 0
to 1. A pixel belongs to what its centre lies in. OpenCV's ``fillPoly`` takes every pixel that the
border touches, which widens an object by half a pixel on all sides; the library of COCO returns
memory that nobody has written where run lengths end too early. So both are done here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

# A character of compressed run lengths holds five bits, and whether more follow.
_FIRST_CHARACTER, _MORE, _SIGN, _BITS = 48, 0x20, 0x10, 5
# A run length of a picture has no more characters.
_LONGEST = 7


def fill_polygon(corners: NDArray[np.float64], height: int, width: int) -> Mask:
    """The pixels whose centres lie in a polygon; where it crosses itself, by the even-odd rule.

    Args:
        corners: (n, 2) x and y [pixel], pixel centres at halves; it is closed by itself.
        height, width: of the picture.

    Returns:
        (H, W).

    Raises:
        ValueError: fewer than three corners, or one that is no finite number.
    """
    if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 2:
        raise ValueError("a polygon needs three corners (x, y) or more")
    if not np.isfinite(corners).all():
        raise ValueError("a polygon's corners must be finite numbers")
    # What lies right of a border is turned over; what two borders turn over is as before.
    turned = np.zeros((height, width + 1), dtype=np.uint8)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        low, high = min(y0, y1), max(y0, y1)
        first, last = (int(np.clip(np.ceil(y - 0.5), 0, height)) for y in (low, high))
        if first >= last:
            continue
        rows = np.arange(first, last)
        x = x0 + (rows + 0.5 - y0) * (x1 - x0) / (y1 - y0)
        columns = np.clip(np.ceil(x - 0.5), 0, width).astype(np.intp)
        turned[rows, columns] ^= 1
    return np.bitwise_xor.accumulate(turned[:, :width], axis=1) > 0


def decode_runs(counts: Sequence[int] | str, height: int, width: int) -> Mask:
    """The area that COCO's run lengths describe: down the columns, outside and inside in turn.

    Args:
        counts: run lengths, or the text that they are compressed to.
        height, width: of the picture.

    Returns:
        (H, W).

    Raises:
        ValueError: run lengths that are none, or do not fill the picture.
    """
    runs = _decompress(counts) if isinstance(counts, str) else list(counts)
    if any(isinstance(run, bool) or not isinstance(run, int) or run < 0 for run in runs):
        raise ValueError("run lengths must be whole numbers, none negative")
    if sum(runs) != height * width:
        raise ValueError(
            f"the run lengths fill {sum(runs)} pixels of a picture of {width} x {height} "
            f"(width x height), which has {height * width}"
        )
    inside = np.arange(len(runs)) % 2 == 1
    return np.repeat(inside, runs).reshape(width, height).T


def _decompress(text: str) -> list[int]:
    """Run lengths from text: from the fourth on each is told from the one two before it."""
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - _FIRST_CHARACTER
        if not 0 <= bits < 2 * _MORE or shift >= _BITS * _LONGEST:
            raise ValueError("the compressed run lengths are damaged")
        value |= (bits & (_MORE - 1)) << shift
        shift += _BITS
        if bits & _MORE:
            continue
        if bits & _SIGN:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("the compressed run lengths end too early")
    return runs
