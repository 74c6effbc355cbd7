"""Skin-coloured blobs inside the person's region, and their centroids (Date et al., 3.1.1)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class SkinColour:
    """Which colours are skin: a box in the chroma plane, so that shade matters little.

    The defaults are those of Chai and Ngan (1999), found on faces of many origins.

    Args:
        red, blue: lowest and highest chroma Cr and Cb (0 to 255, 128 is grey).
        darkest: lowest brightness Y: chroma means nothing in the dark.
    """

    red: tuple[float, float] = (133.0, 173.0)
    blue: tuple[float, float] = (77.0, 127.0)
    darkest: float = 30.0


@dataclass(frozen=True, eq=False)
class Blobs:
    """Patches of skin in one picture, the largest first.

    Centroids (n, 2), areas (n,), boxes (n, 4) of left, top, width, height [pixel]; mask (H, W).
    """

    centroids: Array
    areas: NDArray[np.int64]
    boxes: NDArray[np.int64]
    mask: Mask


def skin_mask(picture: Picture, region: Mask, colour: SkinColour) -> Mask:
    """Where the region (H, W) of a picture (H, W, 3) in red, green, blue has the colour of skin."""
    chroma = _chroma(picture)
    low = (colour.darkest, colour.red[0], colour.blue[0])
    high = (255.0, colour.red[1], colour.blue[1])
    return np.asarray((cv2.inRange(chroma, low, high) > 0) & region)


def skin_blobs(
    picture: Picture, region: Mask, colour: SkinColour, smallest: int = 12, most: int = 12
) -> Blobs:
    """The largest `most` skin blobs of a picture (H, W, 3) in the person's region (H, W).

    None has an area of less than `smallest` pixels.
    """
    top, bottom, left, right = _bounds(region)
    inner = skin_mask(picture[top:bottom, left:right], region[top:bottom, left:right], colour)
    joined = cv2.morphologyEx(inner.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, labels, statistics, middles = cv2.connectedComponentsWithStats(joined, connectivity=8)
    order = np.argsort(-statistics[1:, cv2.CC_STAT_AREA], kind="stable")[:most] + 1
    order = order[statistics[order, cv2.CC_STAT_AREA] >= smallest] if count > 1 else order[:0]
    mask = np.zeros(region.shape, dtype=bool)
    kept = np.zeros(count, dtype=bool)
    kept[order] = True
    mask[top:bottom, left:right] = kept[labels]
    boxes = statistics[order, :4].astype(np.int64)
    boxes[:, :2] += [left, top]
    return Blobs(
        centroids=middles[order] + [left, top],
        areas=statistics[order, cv2.CC_STAT_AREA].astype(np.int64),
        boxes=boxes,
        mask=mask,
    )


def _chroma(picture: Picture) -> Picture:
    """Brightness, red and blue chroma of a picture in red, green, blue."""
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2YCrCb))


def _bounds(region: Mask) -> tuple[int, int, int, int]:
    """Top, bottom, left, right of a region; one pixel where it is empty."""
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    if not len(rows):
        return 0, 1, 0, 1
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
