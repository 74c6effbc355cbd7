"""Balls that a surface's picture covers, whatever the direction it is seen from.

A ball is in the visual hull if every line that meets it meets the surface; a point's distance to
the edges of pictures from many sides bounds it. The mesh may have holes and inner parts.
"""

from __future__ import annotations

import cv2
import numpy as np

from drake_pose.camera.models import ParallelCamera
from drake_pose.silhouette.areas.outline import Outline
from drake_pose.silhouette.areas.scoring import draw_mask

_SIDE = 96
_DIRECTIONS = 72
_POINTS_A_SIDE = 15
# Between the directions that were looked from, the hull may be a little narrower.
_SHRINK = 0.97
# From a point to the nearest pixel centre, and from a distance between centres to the edge.
_ROUNDING = 0.75 + 0.5


class VisualHull:
    """A surface's distances to the edges of its pictures from many sides; may be empty."""

    def __init__(self, outline: Outline) -> None:
        self._center = outline.ball[:3]
        self._size = float(outline.ball[3])
        self._views: list[tuple[np.ndarray, np.ndarray]] = []
        if self._size > 0.0 and len(outline.triangles):
            scale = 0.46 * _SIDE / self._size
            self._views = [_look(outline, R_CN, scale) for R_CN in _rotations(_DIRECTIONS)]
            self._scale = scale

    def radii(self, p_N: np.ndarray) -> np.ndarray:
        """Returns the radii (n,) [m] of the largest balls around points (n, 3) in the hull."""
        if not self._views:
            return np.zeros(len(p_N))
        smallest = np.full(len(p_N), np.inf)
        for rows, distances in self._views:
            uv = np.rint((p_N - self._center) @ rows.T + 0.5 * (_SIDE - 1)).astype(int)
            inside = np.all((uv >= 0) & (uv < _SIDE), axis=1)
            u, v = np.clip(uv, 0, _SIDE - 1).T
            smallest = np.minimum(smallest, np.where(inside, distances[v, u], 0.0))
        return np.maximum(0.0, _SHRINK * (smallest - _ROUNDING) / self._scale)

    def spread_balls(self, count: int) -> np.ndarray:
        """Returns (count or fewer, 4) centres and radii [m] of balls that reach far apart."""
        if not self._views:
            return np.zeros((0, 4))
        steps = np.linspace(-self._size, self._size, _POINTS_A_SIDE)
        grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        points = grid + self._center
        radii = self.radii(points)
        points, radii = points[radii > 0.0], radii[radii > 0.0]
        if len(points) == 0:
            return np.zeros((0, 4))
        chosen = [int(np.argmax(radii))]
        beyond = np.full(len(points), np.inf)
        while len(chosen) < min(count, len(points)):
            last = chosen[-1]
            gap = np.linalg.norm(points - points[last], axis=1) - radii[last]
            beyond = np.minimum(beyond, gap)
            # How far the ball reaches beyond all those chosen before.
            chosen.append(int(np.argmax(beyond + radii)))
        return np.column_stack([points, radii])[chosen]


def _rotations(count: int) -> np.ndarray:
    """Returns rotations R_CN (count, 3, 3) whose viewing directions fill half a sphere evenly."""
    index = np.arange(count) + 0.5
    z = index / count
    azimuth = index * np.pi * (1.0 + 5.0**0.5)
    flat = np.sqrt(1.0 - z**2)
    forward = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z])
    right = np.column_stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(count)])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _look(outline: Outline, R_CN: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the axes (2, 3) [pixel/m] of a picture and its pixels' distances to its edge."""
    middle = 0.5 * (_SIDE - 1)
    camera = ParallelCamera("hull", _SIDE, _SIDE, scale, middle, middle, np.eye(4))
    X_CN = np.eye(4)
    X_CN[:3, :3] = R_CN
    X_CN[:3, 3] = -R_CN @ outline.ball[:3]
    mask = draw_mask([outline], X_CN[None], camera)
    distances = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return scale * R_CN[:2], distances
