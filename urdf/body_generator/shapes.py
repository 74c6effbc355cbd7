"""Closed triangle shells, made by sweeping anatomical cross sections along an axis.

x points to the body's left, y up, z forward, in metres, as in the paper. A *loft* is a stack of
cross sections perpendicular to y. Each section is a superellipse with a radius of its own to the
left, right, front and back. Bumps (ellipsoids that blend smoothly into the surface, or Gaussian
swellings) model noses, breasts and calves.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator


@dataclass(frozen=True)
class Shell:
    """A closed surface.

    Attributes:
        vertices: (n, 3) positions [m].
        triangles: (m, 3) vertex indices, counterclockwise seen from outside.
        materials: (m,) name of each triangle's material in the .mtl file.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    materials: np.ndarray

    def moved(self, offset: ArrayLike) -> "Shell":
        """Return the shell shifted by offset (3,) [m]."""
        return replace(self, vertices=self.vertices + np.asarray(offset, dtype=float))

    def transformed(self, matrix: np.ndarray) -> "Shell":
        """Return the shell under a linear map (3, 3); triangles keep facing outwards."""
        triangles = self.triangles if np.linalg.det(matrix) > 0.0 else self.triangles[:, ::-1]
        return replace(self, vertices=self.vertices @ np.asarray(matrix).T, triangles=triangles)

    def mirrored(self) -> "Shell":
        """Return the mirror image in the plane x = 0 (left becomes right)."""
        return self.transformed(np.diag([-1.0, 1.0, 1.0]))

    def painted_above(self, height: float, material: str) -> "Shell":
        """Return the shell with another material for triangles above a height [m]."""
        above = self.vertices[self.triangles, 1].min(axis=1) > height - 1e-6
        return replace(self, materials=np.where(above, material, self.materials))


@dataclass(frozen=True)
class EllipsoidBump:
    """An ellipsoid that protrudes from a loft.

    Attributes:
        centre: (3,) [m].
        radii: (3,) along x, y, z [m].
        blend: width of the smooth transition to the surface below [m].
    """

    centre: tuple[float, float, float]
    radii: tuple[float, float, float]
    blend: float

    def apply(self, radius: np.ndarray, axis: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return radii (n,) from axis points (n, 3) along directions (n, 3), with the bump."""
        scale = np.asarray(self.radii)
        start = (axis - np.asarray(self.centre)) / scale
        step = direction / scale
        a = np.einsum("ij,ij->i", step, step)
        b = np.einsum("ij,ij->i", start, step)
        c = np.einsum("ij,ij->i", start, start) - 1.0
        root = b * b - a * c
        # A ray that misses the ellipsoid gets a value that decreases smoothly from the tangent's.
        hit = (-b + np.sign(root) * np.sqrt(np.abs(root))) / a
        return smooth_maximum(radius, hit, self.blend)


@dataclass(frozen=True)
class SwellingBump:
    """A Gaussian swelling (amount > 0) or dent (amount < 0) of a loft's radius.

    Attributes:
        centre: (3,) [m].
        widths: (3,) standard deviations along x, y, z [m].
        amount: largest change of the radius [m].
    """

    centre: tuple[float, float, float]
    widths: tuple[float, float, float]
    amount: float

    def apply(self, radius: np.ndarray, axis: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return radii (n,) from axis points (n, 3) along directions (n, 3), with the swelling."""
        points = axis + radius[:, None] * direction
        away = (points - np.asarray(self.centre)) / np.asarray(self.widths)
        return radius + self.amount * np.exp(-0.5 * np.einsum("ij,ij->i", away, away))


Bump = EllipsoidBump | SwellingBump
RadiusRule = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Section:
    """Cross section at one height of a loft.

    Attributes:
        y: height [m].
        left, right, front, back: radii towards +x, -x, +z, -z [m].
        x, z: position of the axis [m].
        front_power, back_power: exponents of the superellipse's front and back half; 2 is an
            ellipse, larger is boxier.
    """

    y: float
    left: float
    right: float
    front: float
    back: float
    x: float = 0.0
    z: float = 0.0
    front_power: float = 2.0
    back_power: float = 2.0

    def values(self) -> list[float]:
        """Return the eight numbers that a loft interpolates along y."""
        radii = [self.left, self.right, self.front, self.back]
        return [*radii, self.x, self.z, self.front_power, self.back_power]

    def scaled_to_girth(self, girth: float) -> "Section":
        """Return the section scaled to a circumference [m]."""
        angles = np.linspace(0.0, 2.0 * np.pi, 721)
        radius = section_radius(np.tile(self.values(), (angles.size, 1)), angles)
        ring = radius[:, None] * np.stack([np.sin(angles), np.cos(angles)], axis=1)
        length = float(np.linalg.norm(np.diff(ring, axis=0), axis=1).sum())
        s = girth / length
        return replace(
            self, left=self.left * s, right=self.right * s, front=self.front * s, back=self.back * s
        )


@dataclass(frozen=True)
class Loft:
    """A closed body swept through sections, from the lowest to the highest.

    Attributes:
        sections: at least two, in any order.
        rings: heights of the rings of vertices [m], or their number, evenly spaced.
        low_cap, high_cap: heights of the rounded ends below and above the sections [m].
        angles: directions of the vertices about the axis [rad], 0 = front, or their number.
        bumps: applied in order.
        cap_rings: number of rings in each rounded end.
        rule: returns the final radii, given points on the axis, directions and radii.
    """

    sections: Sequence[Section]
    rings: int | Sequence[float]
    low_cap: float
    high_cap: float
    angles: int | np.ndarray = 16
    bumps: Sequence[Bump] = ()
    cap_rings: int = 4
    rule: RadiusRule | None = None

    def shell(self, material: str) -> Shell:
        """Return the closed surface."""
        heights, shrink, drop = self._rings()
        angles = ring_angles(self.angles)
        sections = sorted(self.sections, key=lambda section: section.y)
        knots = np.array([section.y for section in sections])
        table = PchipInterpolator(knots, np.array([section.values() for section in sections]))
        values = np.repeat(table(heights), angles.size, axis=0)
        around = np.tile(angles, heights.size)
        direction = np.stack([np.sin(around), np.zeros_like(around), np.cos(around)], axis=1)
        axis = np.stack(
            [values[:, 4], np.repeat(heights + drop, angles.size), values[:, 5]], axis=1
        )
        radius = section_radius(values, around) * np.repeat(shrink, angles.size)
        for bump in self.bumps:
            radius = bump.apply(radius, axis, direction)
        if self.rule is not None:
            radius = self.rule(axis, direction, radius)
        points = axis + radius[:, None] * direction
        low, high = axis[0].copy(), axis[-1].copy()
        low[1], high[1] = knots[0] - self.low_cap, knots[-1] + self.high_cap
        vertices = np.concatenate([points, low[None], high[None]])
        return tube(vertices, heights.size, angles.size, material)

    def _rings(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return each ring's height on the sections, factor on its radius, and cap offset."""
        knots = [section.y for section in self.sections]
        low, high = min(knots), max(knots)
        if isinstance(self.rings, int):
            middle = np.linspace(low, high, self.rings)
        else:
            middle = np.array(sorted({low, high, *self.rings}))
        turn = 0.5 * np.pi * np.arange(1, self.cap_rings + 1) / (self.cap_rings + 0.6)
        heights = np.concatenate([np.full(turn.size, low), middle, np.full(turn.size, high)])
        shrink = np.concatenate([np.cos(turn)[::-1], np.ones(middle.size), np.cos(turn)])
        drop = np.concatenate(
            [
                -self.low_cap * np.sin(turn)[::-1],
                np.zeros(middle.size),
                self.high_cap * np.sin(turn),
            ]
        )
        return heights, shrink, drop


def ring_angles(angles: int | np.ndarray) -> np.ndarray:
    """Return directions about an axis [rad]: n evenly spaced ones, or those given."""
    if isinstance(angles, int):
        return np.arange(angles) * (2.0 * np.pi / angles)
    return angles


def mirrored_angles(half_degrees: Iterable[float]) -> np.ndarray:
    """Return directions [rad] symmetric about the front, given those from 0 to 180 degrees."""
    half = np.radians(sorted(half_degrees))
    other = [2.0 * np.pi - a for a in half[::-1] if 1e-9 < a < np.pi - 1e-9]
    return np.concatenate([half, other])


def section_radius(values: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return the radius (n,) of sections with values (n, 8) in directions (n,) [rad]."""
    sine, cosine = np.sin(angles), np.cos(angles)
    side = np.where(sine >= 0.0, values[:, 0], values[:, 1])
    depth = np.where(cosine >= 0.0, values[:, 2], values[:, 3])
    power = np.where(cosine >= 0.0, values[:, 6], values[:, 7])
    return ((np.abs(sine) / side) ** power + (np.abs(cosine) / depth) ** power) ** (-1.0 / power)


def smooth_maximum(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Return max(a, b), rounded where they differ by less than `width`."""
    overlap = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.maximum(a, b) + overlap**2 * width * 0.25


def ellipsoid(
    centre: ArrayLike, radii: ArrayLike, material: str, around: int = 8, rings: int = 5
) -> Shell:
    """Return an ellipsoid with poles along y."""
    tilt = np.pi * (np.arange(rings) + 1.0) / (rings + 1.0)
    turn = ring_angles(around)
    unit = np.stack(
        [
            np.outer(np.sin(tilt), np.sin(turn)).ravel(),
            np.repeat(-np.cos(tilt), around),
            np.outer(np.sin(tilt), np.cos(turn)).ravel(),
        ],
        axis=1,
    )
    unit = np.concatenate([unit, [[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]])
    vertices = unit * np.asarray(radii) + np.asarray(centre)
    return tube(vertices, rings, around, material)


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return unit normals (n, 3): area-weighted means of the adjacent triangles' normals."""
    corners = vertices[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], face)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def tube(vertices: np.ndarray, rings: int, around: int, material: str) -> Shell:
    """Return the shell of rings, upwards, closed by two poles: the last vertices (low, high)."""
    index = np.arange(rings * around).reshape(rings, around)
    here, beside = index, np.roll(index, -1, axis=1)
    lower = np.stack([here[:-1], beside[:-1], beside[1:]], axis=-1).reshape(-1, 3)
    upper = np.stack([here[:-1], beside[1:], here[1:]], axis=-1).reshape(-1, 3)
    low, high = rings * around, rings * around + 1
    bottom = np.stack([beside[0], here[0], np.full(around, low)], axis=-1)
    top = np.stack([here[-1], beside[-1], np.full(around, high)], axis=-1)
    triangles = np.concatenate([lower, upper, bottom, top]).astype(np.int32)
    return Shell(vertices, triangles, np.full(len(triangles), material))
