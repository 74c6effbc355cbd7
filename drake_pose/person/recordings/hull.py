"""The visual hull of a person, and how much of each silhouette it fills.

Where a rig is consistent, every silhouette is filled by the body that all silhouettes together
allow (silhouette coherence, Hernandez, Schmitt and Cipolla 2007). No model of the body is needed.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.person.recordings.figures import pixels_per_metre

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Points of the grid are so far apart, and so far from its middle at most, to the side and up [m].
_SPACING = 0.04
_SIDE, _HEIGHT = 1.1, 1.3


def hull_grid(middle: Array) -> Array:
    """Points (n, 3) of a grid about a person's middle (3,) [m]."""
    side = np.arange(-_SIDE, _SIDE, _SPACING)
    height = np.arange(-_HEIGHT, _HEIGHT, _SPACING)
    grid = np.stack(np.meshgrid(side, side, height, indexing="ij"), axis=-1)
    return np.asarray(grid.reshape(-1, 3) + middle)


class HullView:
    """One camera's share in the hull of a grid.

    Args:
        camera: the camera.
        points: (n, 3) of the grid [m].
    """

    def __init__(self, camera: Camera, points: Array) -> None:
        uv, depth = camera.project(points)
        self._reach = max(1.0, _SPACING * pixels_per_metre(camera, points.mean(axis=0)))
        # A cell is a grid point's size in the picture.
        self._shape = (
            int(np.ceil(camera.height / self._reach)),
            int(np.ceil(camera.width / self._reach)),
        )
        with np.errstate(invalid="ignore"):
            cells = np.floor((uv + 0.5) / self._reach)
            seen = (depth > 0.0) & (cells >= 0).all(axis=1)
            seen &= (cells[:, 0] < self._shape[1]) & (cells[:, 1] < self._shape[0])
        self._cells = np.where(seen, np.nan_to_num(cells[:, 1]) * self._shape[1], -1)
        self._cells = (self._cells + np.where(seen, np.nan_to_num(cells[:, 0]), 0)).astype(np.int64)

    def cells(self, mask: Mask) -> Mask:
        """Which cells (h, w) a mask (H, W) touches."""
        height, width = self._shape
        padded = np.zeros(
            (int(np.ceil(height * self._reach)), int(np.ceil(width * self._reach))), np.float32
        )
        padded[: mask.shape[0], : mask.shape[1]] = mask
        small = cv2.resize(padded, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(small > 0.25)

    def inside(self, cells: Mask) -> Mask:
        """Which points (n,) cells (h, w) and those beside them allow; all that are not seen."""
        wide = cv2.dilate(cells.view(np.uint8), np.ones((3, 3), np.uint8)).ravel() > 0
        return np.asarray(np.where(self._cells < 0, True, wide[self._cells]))

    def filled(self, cells: Mask, inside: Mask) -> float:
        """What share of the cells (h, w) the points that are inside (n,) fill."""
        found = np.zeros(cells.size, dtype=np.uint8)
        chosen = self._cells[inside]
        found[chosen[chosen >= 0]] = 1
        wide = cv2.dilate(found.reshape(cells.shape), np.ones((3, 3), np.uint8)) > 0
        total = int(cells.sum())
        return float((wide & cells).sum()) / total if total else 1.0


def coherence(views: Sequence[HullView], cells: Sequence[Mask]) -> Array:
    """(c,) what share of each camera's cells the hull of all of them fills."""
    inside = np.ones(len(views[0].inside(cells[0])), dtype=np.bool_)
    for view, own in zip(views, cells, strict=True):
        inside &= view.inside(own)
    return np.array([view.filled(own, inside) for view, own in zip(views, cells, strict=True)])
