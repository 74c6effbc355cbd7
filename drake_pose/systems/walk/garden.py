"""The place of the walk-through: a walled garden of simple shapes, drawn in Meshcat."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from pydrake.geometry import Box, Cylinder, Ellipsoid, Meshcat, Rgba, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw

from drake_pose.arrays import Array

HALF_SIZE = 12.0
"""Half the side of the garden [m]; the origin is its middle."""

START = (-8.0, 0.0, 0.0)
"""Where a walk begins: x, y [m] and heading [rad]."""

_SIDE, _WALL_HEIGHT = 2.0 * HALF_SIZE, 2.4
_STONE = (0.76, 0.72, 0.65)
_GATE = (0.85, 0.25, 0.10)
_BARK = (0.36, 0.25, 0.16)
_LEAVES = (0.18, 0.45, 0.20)
_PATH = (0.82, 0.76, 0.62)
_LAWN = (0.42, 0.60, 0.33)
_WATER = (0.20, 0.45, 0.65)
# Meshcat's point lights stand near the origin: daylight comes from far away.
_LIGHTS = {
    "AmbientLight": 1.6,
    "FillLight": 1.6,
    "PointLightNegativeX": 0.0,
    "PointLightPositiveX": 0.0,
}
_GATES = (-4.0, -1.5, 4.0, 7.5)
_TREES = ((3.5, 4.0), (6.5, -4.5), (-3.0, 5.5), (-6.5, -4.0), (-8.5, 7.5), (8.5, 8.0), (1.0, -7.0))
_BALLS = ((2.5, -2.5, (0.95, 0.75, 0.10)), (-3.5, -1.5, (0.45, 0.20, 0.60)))
_FOUNTAIN = (-6.0, 3.0)


class GardenObject(NamedTuple):
    """An object of the place: its path in Meshcat's tree, and its middle's position [m].

    Nobody comes nearer to its axis than the radius [m]; 0: one walks over or under it.
    """

    name: str
    shape: Shape
    position: tuple[float, float, float]
    colour: tuple[float, float, float]
    radius: float = 0.0


def garden_objects() -> tuple[GardenObject, ...]:
    """All objects: lawn, paths, walls, gates over the path, trees, balls, a fountain."""
    z = 0.5 * _WALL_HEIGHT
    long, deep = Box(_SIDE, 0.3, _WALL_HEIGHT), Box(0.3, _SIDE, _WALL_HEIGHT)
    x, y = _FOUNTAIN
    found = [
        GardenObject("lawn", Box(_SIDE, _SIDE, 0.1), (0.0, 0.0, -0.05), _LAWN),
        GardenObject("path_x", Box(_SIDE, 1.8, 0.02), (0.0, 0.0, 0.0), _PATH),
        GardenObject("path_y", Box(1.8, _SIDE, 0.02), (0.0, 0.0, 0.001), _PATH),
        GardenObject("wall_left", long, (0.0, HALF_SIZE, z), _STONE),
        GardenObject("wall_right", long, (0.0, -HALF_SIZE, z), _STONE),
        GardenObject("wall_ahead", deep, (HALF_SIZE, 0.0, z), _STONE),
        GardenObject("wall_behind", deep, (-HALF_SIZE, 0.0, z), _STONE),
        GardenObject("basin", Cylinder(1.3, 0.45), (x, y, 0.225), _STONE, 1.3),
        GardenObject("water", Cylinder(1.15, 0.02), (x, y, 0.46), _WATER),
        GardenObject("spout", Cylinder(0.12, 1.3), (x, y, 0.65), _STONE),
    ]
    for k, x in enumerate(_GATES):
        for side, y in (("left", 1.3), ("right", -1.3)):
            post = Cylinder(0.15, 2.8)
            found.append(GardenObject(f"gate_{k}_{side}", post, (x, y, 1.4), _GATE, 0.15))
        found.append(GardenObject(f"gate_{k}_top", Box(0.3, 3.4, 0.25), (x, 0.0, 2.9), _GATE))
    for k, (x, y) in enumerate(_TREES):
        found.append(GardenObject(f"trunk_{k}", Cylinder(0.18, 2.0), (x, y, 1.0), _BARK, 0.18))
        found.append(GardenObject(f"crown_{k}", Ellipsoid(1.1, 1.1, 1.4), (x, y, 2.9), _LEAVES))
    for k, (x, y, colour) in enumerate(_BALLS):
        found.append(GardenObject(f"ball_{k}", Sphere(0.5), (x, y, 0.5), colour, 0.5))
    return tuple(found)


def garden_obstacles() -> Array:
    """(n, 3) x, y and radius of what one cannot walk through [m]."""
    return np.array([(*one.position[:2], one.radius) for one in garden_objects() if one.radius])


def draw_garden(meshcat: Meshcat) -> None:
    """Draw the place, under ``place`` of Meshcat's tree, below a sky."""
    for one in garden_objects():
        here = f"place/{one.name}"
        meshcat.SetObject(here, one.shape, Rgba(*one.colour))
        meshcat.SetTransform(here, RigidTransform(one.position))
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    for name, intensity in _LIGHTS.items():
        meshcat.SetProperty(f"/Lights/{name}/<object>", "intensity", intensity)
    meshcat.SetProperty("/Background", "top_color", [0.45, 0.65, 0.90])
    meshcat.SetProperty("/Background", "bottom_color", [0.85, 0.92, 0.98])


def look_over_shoulder(meshcat: Meshcat, pose: Array) -> None:
    """Point the view as the walker at x, y [m] and heading [rad] looks, from behind and above."""
    forward = np.array([math.cos(pose[2]), math.sin(pose[2]), 0.0])
    ground = np.array([pose[0], pose[1], 0.0])
    eye = np.clip(ground - 3.2 * forward, 0.3 - HALF_SIZE, HALF_SIZE - 0.3)
    eye[2], target = 2.1, ground + 1.5 * forward + (0.0, 0.0, 1.1)
    meshcat.SetCameraPose(eye, target)


def walker_transform(pose: Array, rest: Array) -> RigidTransform:
    """X_PR: the room in the place, so that who stands at rest in it is where the walker is.

    Args:
        pose: (3,) x, y [m] and heading [rad] of the walker in the place.
        rest: (5,) stance at rest in the room; the feet's place counts.
    """
    turn = RollPitchYaw(0.0, 0.0, pose[2] - rest[0])
    X_PF = RigidTransform(turn, [pose[0], pose[1], 0.0])
    return X_PF.multiply(RigidTransform([-rest[3], -rest[4], 0.0]))
