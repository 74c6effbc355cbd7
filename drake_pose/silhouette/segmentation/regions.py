"""Regions of a picture that may be one object: of about one colour, with a strong outline.

Nothing is known of the object. Of lightness and of colours there are thresholds at many levels;
what is connected above or below one is a region, as in a tree of components (MSER, Matas et al.
2002), its holes filled. Of regions that are about the same the one is kept along whose outline the
channel changes most.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import zip_longest
from typing import NamedTuple

import cv2
import numpy as np

from drake_pose.arrays import Floats, Mask, Picture
from drake_pose.silhouette.pictures.masks import intersection_over_union

# Pictures are looked at so wide at most [pixel], at so many levels of each channel.
_WIDTH, _LEVELS = 480, 16
# Regions are no smaller and no larger than these shares of the picture.
_LEAST, _MOST = 0.003, 0.7
# What a region encloses together with the picture's border is a hole that is smaller than this
# share of it.
_AT_BORDER = 0.1
# Regions that overlap so much (IoU) are one.
_SAME = 0.85
# How strong an outline is, its weaker parts tell: so many are weaker still.
_WEAKEST = 0.25


def find_regions(picture: Picture, most: int) -> list[Mask]:
    """So many regions (H, W) of a picture (H, W, 3), of each channel those with strong outlines.

    The channels are lightness and two of colour; regions of two of them may be about the same.
    """
    height, width = picture.shape[:2]
    share = min(1.0, _WIDTH / width)
    size = max(1, round(share * width)), max(1, round(share * height))
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB).astype(np.float32)
    whole = np.moveaxis(cv2.GaussianBlur(lab, (0, 0), 1.0), -1, 0)
    small = [np.asarray(cv2.resize(one, size, interpolation=cv2.INTER_AREA)) for one in whole]
    # A grey picture has all of them of its lightness.
    rows = zip_longest(*(_strongest(one, most) for one in small))
    found = [(k, one) for row in rows for k, one in enumerate(row) if one is not None]
    return [
        _enlarged(one.mask, one.sign * whole[k] > one.sign * one.level) for k, one in found[:most]
    ]


class _Region(NamedTuple):
    """A mask (h, w) in a smaller picture, how strong its outline is, and the threshold."""

    mask: Mask
    strength: float
    sign: float
    level: float


def _strongest(channel: Floats, most: int) -> list[_Region]:
    """So many regions of a channel (h, w) with the strongest outlines, no two of them alike."""
    slopes = (cv2.Sobel(channel, cv2.CV_32F, *by) for by in ((1, 0), (0, 1)))
    change = np.hypot(*slopes)
    low, high = np.quantile(channel, (0.01, 0.99)).tolist()
    found = [
        _Region(mask, _strength(mask, change), sign, level)
        for level in np.linspace(low, high, _LEVELS + 2)[1:-1].tolist()
        for sign in (1.0, -1.0)
        for mask in _components(sign * channel > sign * level)
    ]
    kept = list[_Region]()
    for one in sorted(found, key=lambda one: -one.strength):
        if all(intersection_over_union(one.mask, other.mask) < _SAME for other in kept):
            kept.append(one)
        if len(kept) == most:
            break
    return kept


def _strength(mask: Mask, change: Floats) -> float:
    """How much a picture changes (h, w) along an outline, the longer the better."""
    inside = cv2.erode(mask.view(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
    edge = change[mask & ~inside]
    if not len(edge):
        return 0.0
    return float(np.quantile(edge, _WEAKEST)) * math.sqrt(np.count_nonzero(mask))


def _components(above: Mask) -> Iterator[Mask]:
    """What is connected in (H, W), of a fit size, its holes filled."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(above.view(np.uint8), connectivity=4)
    for k in np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= _LEAST * above.size) + 1:
        region = _filled(labels == k)
        if np.count_nonzero(region) <= _MOST * above.size:
            yield region


def _filled(region: Mask) -> Mask:
    """A region (H, W) without holes."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~region).view(np.uint8))
    u, v, width, height, area = stats.T
    inside = (u > 0) & (v > 0) & (u + width < region.shape[1]) & (v + height < region.shape[0])
    fills = inside | (area < _AT_BORDER * np.count_nonzero(region))
    return np.asarray(region | fills[labels])


def _enlarged(region: Mask, above: Mask) -> Mask:
    """A region found in a smaller picture, in the whole one (H, W): as a threshold has it."""
    height, width = above.shape
    size = (width, height)
    rough = cv2.resize(region.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    by = np.ones((2 * math.ceil(width / region.shape[1]) + 1,) * 2, np.uint8)
    sure, near = cv2.erode(rough, by, borderValue=1) > 0, cv2.dilate(rough, by) > 0
    return _filled(sure | (near & above))
