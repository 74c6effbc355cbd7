"""The person's region in a picture, by a model of the empty background (Date et al., 3.1.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SettingsError

Array = NDArray[np.float32]
Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_LEAST_DEVIATION = 3.0


@dataclass(frozen=True, eq=False)
class Background:
    """What a camera sees when nobody is there.

    Args:
        mean: (H, W, 3) mean colour.
        deviation: (H, W) standard deviation of a channel: noise and flicker [grey levels].
    """

    mean: Picture
    deviation: Array


def learn_background(pictures: Sequence[Picture]) -> Background:
    """The background from one or more pictures (H, W, 3) of the empty scene.

    Raises:
        SettingsError: no picture, or pictures of different sizes.
    """
    if not pictures or any(picture.shape != pictures[0].shape for picture in pictures):
        raise SettingsError("a background needs one or more pictures of the same size")
    stack = np.stack([picture.astype(np.float32) for picture in pictures])
    deviation = np.sqrt(stack.var(axis=0).mean(axis=-1))
    mean = np.rint(stack.mean(axis=0)).astype(np.uint8)
    return Background(mean, np.maximum(deviation, _LEAST_DEVIATION))


def person_region(
    picture: Picture,
    background: Background,
    *,
    deviations: float = 5.0,
    smallest_share: float = 0.1,
) -> Mask:
    """Where a picture differs from the background: the person.

    Args:
        picture: (H, W, 3), its colours in the order of the background's.
        background: of the same camera.
        deviations: how many standard deviations the colour must be off.
        smallest_share: patches smaller than this share of the largest are dropped as noise; what is
            left may be in several parts (a hand before a background of its own colour).

    Returns:
        (H, W); empty where nobody is seen.

    Raises:
        SettingsError: when the picture's size is not the background's.
    """
    if picture.shape != background.mean.shape:
        raise SettingsError(
            f"the picture is {picture.shape}, but its background {background.mean.shape}"
        )
    low, high = _background_colours(background, deviations)
    mask = cv2.bitwise_not(cv2.inRange(picture, low, high))
    kernel = np.ones((3, 3), np.uint8)
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel)
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, kernel)
    return largest_patches(closed > 0, smallest_share)


@lru_cache(maxsize=64)
def _background_colours(background: Background, deviations: float) -> tuple[Picture, Picture]:
    """The lowest and highest colours (H, W, 3) that are still the background's."""
    off = np.floor(deviations * background.deviation)[:, :, None]
    mean = background.mean.astype(np.float32)
    low, high = np.clip(mean - off, 0, 255), np.clip(mean + off, 0, 255)
    return low.astype(np.uint8), high.astype(np.uint8)


def largest_patches(mask: Mask, smallest_share: float) -> Mask:
    """A mask (H, W) without patches smaller than a share of its largest one."""
    picture = np.ascontiguousarray(mask).view(np.uint8)
    left, top, width, height = cv2.boundingRect(picture)
    kept = np.zeros(mask.shape, dtype=np.bool_)
    if not width:
        return kept
    inner = (slice(top, top + height), slice(left, left + width))
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(
        np.ascontiguousarray(picture[inner]), connectivity=8
    )
    areas = statistics[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    keep = areas >= smallest_share * areas.max()
    keep[0] = False
    kept[inner] = keep[labels]
    return kept
