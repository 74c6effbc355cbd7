"""The person's contour against that of a registered pose (Date et al., 3.1.1 and section 5)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DIRECTIONS = 72
"""In how many directions a contour is measured."""


@dataclass(frozen=True, eq=False)
class Contour:
    """The outer contour of a person in one picture.

    Args:
        shape: (DIRECTIONS,) distance of the farthest contour point in each direction from the
            region's middle, counterclockwise in the picture from its right, over the square root of
            the area: neither place nor size matters.
        middle: (2,) of the bounding box [pixel].
    """

    shape: Array
    middle: Array


def measure_contour(region: Mask) -> Contour | None:
    """Measures the contour of a region.

    Args:
        region: (H, W) the person.

    Returns:
        The contour. None where nobody is seen, or the region touches the picture's edge and so a
        part of the contour is not the person's.
    """
    if not region.any() or _touches_edge(region):
        return None
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    corner = np.array([columns[0], rows[0]], dtype=np.float64)
    picture = region[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].astype(np.uint8)
    moments = cv2.moments(picture, binaryImage=True)
    area = moments["m00"]
    contours, _ = cv2.findContours(picture, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = np.concatenate([contour.reshape(-1, 2) for contour in contours]).astype(np.float64)
    off = points - [moments["m10"] / area, moments["m01"] / area]
    angle = np.arctan2(-off[:, 1], off[:, 0])
    place = np.floor(angle / (2.0 * np.pi) * DIRECTIONS).astype(np.int64) % DIRECTIONS
    reach = np.zeros(DIRECTIONS)
    np.maximum.at(reach, place, np.linalg.norm(off, axis=1))
    middle = corner + 0.5 * (points.min(axis=0) + points.max(axis=0))
    return Contour(_filled(reach) / np.sqrt(area), middle)


def similarity(first: Array, second: Array) -> float:
    """How alike two contour shapes (DIRECTIONS,) are: 1 for equal ones, 0 for nothing in common."""
    return float(1.0 - np.abs(first - second).sum() / np.maximum(first, second).sum())


def _touches_edge(region: Mask) -> bool:
    edges = (region[0], region[-1], region[:, 0], region[:, -1])
    return any(bool(edge.any()) for edge in edges)


def _filled(reach: Array) -> Array:
    """Distances (n,) on a circle, with gaps (a contour thinner than a direction) interpolated."""
    known = np.flatnonzero(reach)
    return np.interp(np.arange(len(reach)), known, reach[known], period=len(reach))
