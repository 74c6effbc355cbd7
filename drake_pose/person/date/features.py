"""Skin-coloured blobs in views, and from them head, hands and feet in space (Date et al., 3.1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from drake_pose.arrays import Array, Indices, Mask, Picture
from drake_pose.camera.models import Camera
from drake_pose.person.date.skeleton import FEATURES
from drake_pose.person.rays import meeting_points

_FIRST_FOOT = FEATURES.index("left_foot")
# Two rays show the same skin where they pass each other by less than the first; the radius of the
# dense part of a feature's points [m]; how far outside a silhouette a point may be seen [pixel].
_THRESHOLD, _DENSE, _MARGIN = 0.05, 0.08, 2
# Rays that meet by chance: so far nothing moves from one frame to the next [m].
_FARTHEST = 0.5


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
    areas: Indices
    boxes: Indices
    mask: Mask


def skin_blobs(
    picture: Picture, region: Mask, colour: SkinColour, smallest: int = 12, most: int = 12
) -> Blobs:
    """The largest `most` skin blobs of a picture (H, W, 3) in the person's region (H, W).

    None has an area of less than `smallest` pixels.
    """
    # Where nobody is seen one pixel is looked at.
    left, top, width, height = cv2.boundingRect(np.ascontiguousarray(region).view(np.uint8))
    part = slice(top, top + max(height, 1)), slice(left, left + max(width, 1))
    chroma = cv2.cvtColor(np.ascontiguousarray(picture[part]), cv2.COLOR_RGB2YCrCb)
    low = (colour.darkest, colour.red[0], colour.blue[0])
    inner = (cv2.inRange(chroma, low, (255.0, colour.red[1], colour.blue[1])) > 0) & region[part]
    joined = cv2.morphologyEx(inner.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, labels, statistics, middles = cv2.connectedComponentsWithStats(joined, connectivity=8)
    order = np.argsort(-statistics[1:, cv2.CC_STAT_AREA], kind="stable")[:most] + 1
    order = order[statistics[order, cv2.CC_STAT_AREA] >= smallest] if count > 1 else order[:0]
    mask = np.zeros(region.shape, dtype=bool)
    kept = np.zeros(count, dtype=bool)
    kept[order] = True
    mask[part] = kept[labels]
    boxes = statistics[order, :4].astype(np.int64)
    boxes[:, :2] += [left, top]
    return Blobs(
        centroids=middles[order] + [left, top],
        areas=statistics[order, cv2.CC_STAT_AREA].astype(np.int64),
        boxes=boxes,
        mask=mask,
    )


@dataclass(frozen=True, eq=False)
class Features:
    """The features of a frame.

    Args:
        places: (k, 3) [m]; the last frame's where nothing was measured.
        support: (k,) how many 3-D points the place was taken from; 0: not measured.
        points, owners: (m, 3) all inside every silhouette [m], and each's feature (m,); -1: none.
    """

    places: Array
    support: Indices
    points: Array
    owners: Indices


def inside_silhouettes(
    points: Array, cameras: Sequence[Camera], regions: Sequence[Mask], margin: int = 0
) -> Mask:
    """Which points (m, 3) [m] every camera sees in its silhouette, or `margin` pixels beside it.

    A camera has no say about points outside its picture, nor where it sees nobody at all.
    """
    kept = np.ones(len(points), dtype=bool)
    aside = np.arange(1, margin + 1)
    # To all sides along or across, and not at all.
    beside = np.concatenate([[0], aside, -aside])[:, None]
    for camera, region in zip(cameras, regions, strict=True):
        if not region.any():
            continue
        uv, depth = camera.project(points)
        with np.errstate(invalid="ignore"):
            pixels = np.rint(uv)
            visible = (depth > 0.0) & (pixels >= 0).all(axis=1)
            visible &= (pixels < [camera.width, camera.height]).all(axis=1)
        column, row = pixels[visible].astype(np.int64).T
        near = region[np.clip(row + beside, 0, len(region) - 1), column].any(axis=0)
        near |= region[row, np.clip(column + beside, 0, region.shape[1] - 1)].any(axis=0)
        kept[visible] &= near
    return kept


def expect_features(places: Array, support: Indices, last: Array, last_support: Indices) -> Array:
    """Where FEATURES are expected in the next frame (5, 3) [m]: feet a step on, the others here.

    Else passing feet would be exchanged; hands that meet stop, and a step on would be exchanged.

    Args:
        places, last: (5, 3) the features in this frame and in the one before [m].
        support, last_support: (5,) how many 3-D points each was taken from.
    """
    measured = (np.asarray(support) > 0) & (np.asarray(last_support) > 0)
    step = np.where(measured[:, None], places - last, 0.0)
    step[:_FIRST_FOOT] = 0.0
    return np.asarray(places + step)


def dense_mean(points: Array, radius: float) -> tuple[Array, int]:
    """The mean of those points (m, 3) within `radius` of the one with most others; their count."""
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = distances <= radius
    spread = np.where(near, distances, 0.0).sum(axis=1)
    counts = near.sum(axis=1)
    center = np.lexsort((spread, -counts))[0]
    part = points[near[center]]
    return part.mean(axis=0), len(part)


def find_features(
    cameras: Sequence[Camera],
    centroids: Sequence[Array],
    regions: Sequence[Mask],
    last: Array,
    expected: Array | None = None,
) -> Features:
    """The features' places in a frame.

    Args:
        centroids: (n_k, 2) the skin blobs' centroids in each camera [pixel].
        regions: (H, W) the person in each camera's picture.
        last: (k, 3) the last frame's features [m].
        expected: (k, 3) where they are expected in this frame [m], points farther than half a metre
            from all being nobody's; None, as in the paper: `last`, the nearest's however far.
    """
    points = meeting_points(cameras, centroids, _THRESHOLD)
    points = points[inside_silhouettes(points, cameras, regions, _MARGIN)]
    near = last if expected is None else expected
    distances = np.linalg.norm(points[:, None] - near[None], axis=2)
    owners = distances.argmin(axis=1)
    if expected is not None:
        owners[distances.min(axis=1) > _FARTHEST] = -1
    places, support = np.array(last, dtype=np.float64), np.zeros(len(last), dtype=np.int64)
    for k in range(len(last)):
        mine = points[owners == k]
        if len(mine):
            places[k], support[k] = dense_mean(mine, _DENSE)
    return Features(places, support, points, owners)
