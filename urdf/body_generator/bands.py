"""Bands of skin between two segments: closed tubes just under the standing body's surface.

A band runs along an axis through the joint, from the parent's side to the child's. Each of its
vertices lies where a ray from the axis first leaves all shells of the two segments. So the band is
hidden while the body stands upright.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .shapes import Shell, ring_angles, tube

CLEARANCE = 0.0001  # distance of the band under the surface [m]


@dataclass(frozen=True)
class Band:
    """Place of the band of one kind of joint on the left side, in the child's frame.

    Lengths are those of the mean woman; other bodies' bands are scaled by their stature.

    Attributes:
        axis: (3,) direction from the parent to the child.
        begin, end: ends along the axis, from the joint [m].
        reach: largest distance from the axis [m].
        material: of the band.
        rings: number of rings of vertices.
        around: number of vertices per ring.
        through: (3,) a point of the axis [m]; the axis must stay inside the two segments.
    """

    axis: tuple[float, float, float]
    begin: float
    end: float
    reach: float
    material: str
    rings: int = 7
    around: int = 14
    through: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def scaled(self, scale: float) -> "Band":
        """Return the band of a body `scale` times as large."""
        x, y, z = self.through
        return replace(
            self,
            begin=scale * self.begin,
            end=scale * self.end,
            reach=scale * self.reach,
            through=(scale * x, scale * y, scale * z),
        )


BANDS: dict[str, Band] = {
    "chest": Band((0.0, -1.0, 0.0), -0.050, 0.050, 0.085, "skin"),
    "waist": Band((0.0, -1.0, 0.0), -0.090, 0.090, 0.16, "suit", around=20),
    "upper_arm": Band(
        (0.7, -0.7, 0.0), -0.080, 0.080, 0.075, "suit", around=16, through=(-0.02, -0.03, 0.0)
    ),
    "forearm": Band((0.0, -1.0, 0.0), -0.060, 0.060, 0.065, "skin"),
    "hand": Band((0.0, -1.0, 0.0), -0.035, 0.035, 0.040, "skin", rings=6, around=12),
    "thigh": Band((0.15, -1.0, 0.0), -0.100, 0.120, 0.125, "shorts", around=18),
    "shin": Band((0.0, -1.0, 0.0), -0.085, 0.085, 0.085, "skin"),
    "foot": Band((0.0, -0.9, 0.4), -0.055, 0.040, 0.060, "skin", rings=6, around=12),
}


def band_shell(band: Band, shells: Sequence[Shell]) -> Shell:
    """Return the closed band.

    Args:
        band: its place.
        shells: shells of the two segments of the standing body, in the child's frame.
    """
    surface = _Surface(shells, band)
    heights = np.linspace(-band.end, -band.begin, band.rings)
    angles = ring_angles(band.around)
    grid = np.stack(np.meshgrid(heights, angles, indexing="ij"), axis=-1)
    radius = surface.radius(grid[..., 0], grid[..., 1])
    for _ in range(2):
        radius = radius - _protrusion(surface, grid, radius)
    radius = np.maximum(radius - CLEARANCE, CLEARANCE)
    points = surface.points(grid[..., 0], grid[..., 1], radius).reshape(-1, 3)
    poles = surface.points(heights[[0, -1]], np.zeros(2), np.zeros(2))
    return tube(np.concatenate([points, poles]), band.rings, band.around, band.material)


def _protrusion(surface: "_Surface", grid: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return how far the facets at each vertex (rings, around) protrude from the surface [m]."""
    points = surface.points(grid[..., 0], grid[..., 1], radius)
    beside = np.roll(points, -1, axis=1)
    corners = np.stack([points[:-1], points[1:], beside[:-1], beside[1:]])
    worst = np.zeros(corners.shape[1:3])
    for up in (0.0, 0.2, 0.4, 0.6, 0.8):  # a cell's other sides belong to its neighbours
        for side in (0.0, 0.5):
            weights = ((1 - up) * (1 - side), up * (1 - side), (1 - up) * side, up * side)
            height, angle, found = surface.coordinates(np.tensordot(weights, corners, axes=1))
            worst = np.maximum(worst, found - surface.radius(height, angle))
    inside = np.zeros_like(radius)
    for rows in (slice(None, -1), slice(1, None)):
        for step in (0, 1):
            inside[rows] = np.maximum(inside[rows], np.roll(worst, step, axis=1))
    return inside


class _Surface:
    """The union of shells, as radii about an axis.

    Heights run against the band's axis, from the child to the parent, so that rings of growing
    height and angle form a tube that faces outwards.
    """

    def __init__(self, shells: Sequence[Shell], band: Band) -> None:
        y = -np.asarray(band.axis) / np.linalg.norm(band.axis)
        z = np.array([0.0, 0.0, 1.0]) - y[2] * y
        z /= np.linalg.norm(z)
        self._frame = np.stack([np.cross(y, z), y, z])
        self._reach = band.reach
        # Heights are measured from the joint, so the axis may be shifted only across itself.
        through = np.array(band.through)
        self._foot = through - (through @ y) * y
        corners = np.concatenate([shell.vertices[shell.triangles] for shell in shells])
        self._corners = (corners - self._foot) @ self._frame.T
        self._lowest = self._corners[:, :, 1].min(axis=1)
        self._highest = self._corners[:, :, 1].max(axis=1)

    def points(self, height: np.ndarray, angle: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Return points (..., 3) at cylindrical coordinates."""
        local = np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=-1)
        return np.asarray(local @ self._frame + self._foot)

    def coordinates(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the cylindrical coordinates height, angle and radius of points (..., 3)."""
        x, y, z = np.moveaxis((points - self._foot) @ self._frame.T, -1, 0)
        return y, np.arctan2(x, z), np.hypot(x, z)

    def radius(self, height: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Return where rays from the axis first leave the shells, at most `reach` [m]."""
        # The small shifts avoid rays exactly through an edge, which would meet two triangles there.
        rays = zip(np.ravel(height) + 1.3e-7, np.ravel(angle) + 2.1e-7, strict=True)
        found = [self._exit(h, np.sin(a), np.cos(a)) for h, a in rays]
        return np.minimum(np.array(found), self._reach).reshape(np.shape(height))

    def _exit(self, height: float, sine: float, cosine: float) -> float:
        """Return the distance from the axis at a height to the first point outside all shells."""
        a, b, c = np.moveaxis(
            self._corners[(self._lowest <= height) & (self._highest >= height)], 1, 0
        )
        # A ray meets a triangle whose three edges, seen along the ray, turn about it in one sense.
        across = [corner[:, 0] * cosine - corner[:, 2] * sine for corner in (a, b, c)]
        up = [corner[:, 1] - height for corner in (a, b, c)]
        turns = [across[i] * up[i - 2] - across[i - 2] * up[i] for i in range(3)]
        total = turns[0] + turns[1] + turns[2]
        hit = (np.minimum.reduce(turns) >= 0.0) | (np.maximum.reduce(turns) <= 0.0)
        hit &= total != 0.0
        along = [corner[hit, 0] * sine + corner[hit, 2] * cosine for corner in (a, b, c)]
        turns = [turn[hit] for turn in turns]
        # turns[i] belongs to the edge from corner i to the next, and is the third corner's weight.
        way = (turns[1] * along[0] + turns[2] * along[1] + turns[0] * along[2]) / total[hit]
        ahead = way > 0.0
        order = np.argsort(way[ahead], kind="stable")
        leaves = np.where(total[hit][ahead] > 0.0, 1, -1)[order]
        outside = np.flatnonzero(leaves.sum() - np.cumsum(leaves) <= 0)
        return float(way[ahead][order][outside[0]]) if outside.size else 0.0
