"""Elbows and knees on their circles, by back-projection (Date et al., 4.1.2 and 4.2)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Mask
from drake_pose.camera.models import Camera
from drake_pose.person.date.skeleton import Limb
from drake_pose.person.rays import sum_at_points

ELBOW_RANGE = (0.0, 120.0)
"""Where an elbow may be on its circle [deg], from behind, over outwards, to a little in front."""

KNEE_RANGE = (-180.0, 175.0)
"""Where a knee may be on its circle [deg], as far as the hip can turn; 0 is in front, positive
outwards. Behind it lies where the leg is straight, as it ends at the foot's middle."""

FEATURE_ERROR = 0.015
"""How far hands and feet are measured off their places [m]."""

Search = Literal["surfaces", "rectangles", "none"]
# rectangles: the paper's way, a rectangle from root to middle joint and one from there to the end,
# on the one circle that the measured end gives. surfaces: points of the segments' surfaces, on the
# circles of all ends within FEATURE_ERROR along the limb: the radius of a nearly straight limb's
# circle is 2 cm where its end is measured 1 mm too near.

# A straight knee's angle is at its limit: how far beyond it may be measured.
_BEND_TOLERANCE = math.radians(3.0)

# The trunk's direction is measured, too: how far beyond its limits a hip may seem to be.
_HIP_TOLERANCE = math.radians(10.0)
_STEP_DEG = 5.0
_END_STEP = 0.005
_SAMPLES_ALONG = 12
_SAMPLES_ACROSS = 5
_STRAIGHT = 1e-9
_STRETCHED = 1e-3


@dataclass(frozen=True, eq=False)
class Circle:
    """Where a middle joint can be: center + radius (sin(theta) i + cos(theta) j) [m].

    i and j are orthonormal: outwards; and behind (arm) or in front (leg).
    """

    center: Array
    radius: float
    i: Array
    j: Array

    def points(self, degrees: Array) -> Array:
        """(n, 3) the circle's points at angles (n,) [deg]."""
        return np.asarray(self.center + self.radius * self.directions(degrees))

    def directions(self, degrees: Array) -> Array:
        """(n, 3) from the centre to the points at angles (n,) [deg], of length 1."""
        theta = np.radians(np.asarray(degrees, dtype=np.float64))[:, None]
        return np.asarray(np.sin(theta) * self.i + np.cos(theta) * self.j)


def joint_circle(limb: Limb, root: Array, end: Array, outward: Array) -> Circle:
    """The circle of an elbow or knee between root and end (3,) [m].

    i is the direction in the circle's plane that agrees best with the horizontal part of `outward`
    (3,), from neck base to shoulder or waist to hip; j = i x z for the left arm, z from shoulder to
    hand (for the right arm and for legs mirrored, to point behind the arm and in front of the leg).
    """
    z, distance = _along(root, end)
    along, radius = _circle_sizes(limb, distance)
    i = _unit_across(np.array([outward[0], outward[1], 0.0]), z)
    j = limb.side * np.cross(i, z)
    return Circle(root + along * z, float(radius), i, -j if limb.name.endswith("leg") else j)


def _circle_sizes(limb: Limb, distances: Array) -> tuple[Array, Array]:
    """How far from the root to the end circles' centres are, and radii, for distances of both."""
    a, b = limb.lengths
    # Beyond the limb's reach it is stretched out (or folded), in proportion.
    reach = np.clip(distances, max(abs(a - b), _STRAIGHT), a + b)
    along = (a * a - b * b + reach * reach) / (2.0 * reach)
    return along * distances / reach, np.sqrt(np.maximum(0.0, a * a - along * along))


def _along(root: Array, ends: Array) -> tuple[Array, Array]:
    """Directions (..., 3) from root to ends (..., 3), downwards where they are one, and distances.

    Distances (...) are in m.
    """
    across = ends - root
    distances = np.sqrt((across**2).sum(axis=-1))
    is_far = distances[..., None] > _STRAIGHT
    ways = across / np.where(is_far, distances[..., None], 1.0)
    return np.where(is_far, ways, [0.0, 0.0, -1.0]), distances


def search_limb(
    limb: Limb,
    R_WT: Array,
    root: Array,
    end: Array,
    outward: Array,
    near: Array,
    last: Array,
    cameras: Sequence[Camera],
    regions: Sequence[Mask],
    search: Search = "surfaces",
) -> tuple[Array, Array]:
    """The places (3,) of an elbow or knee, and of the end, that agree best with the silhouettes.

    Args:
        R_WT: (3, 3) the trunk's axes in the world: a knee is only where the hip can turn it.
        root, end: (3,) shoulder and hand, or hip and foot [m].
        outward: (3,) from the neck's base to the shoulder, or from the waist to the hip.
        near: (3,) of equally good places, the one nearest to this is taken: inverse kinematics's.
        last: (4,) the limb's angles in the last frame [rad].
        regions: (H, W) the person in each camera's picture.
    """
    ends = end[None] if search == "rectangles" else _possible_ends(limb, root, end)
    middles, angles, ends = _places(limb, R_WT, root, ends, outward, last)
    if search == "rectangles":
        samples = rectangles(root, middles, end, limb.half_widths)
    else:
        samples = _points_of_segments(limb, R_WT, root, middles, angles)
    scores = correlation(samples, cameras, regions)
    best = np.flatnonzero(scores >= scores.max() - 1e-9)
    chosen = best[np.argmin(np.linalg.norm(middles[best] - near, axis=1))]
    return middles[chosen], ends[chosen]


def _possible_ends(limb: Limb, root: Array, end: Array) -> Array:
    """Where the end may be in truth (k, 3): on its line from the root, and in reach."""
    direction, distance = _along(root, end)
    count = round(FEATURE_ERROR / _END_STEP)
    steps = _END_STEP * np.arange(-count, count + 1)
    distances = np.unique(np.clip(distance + steps, *_reach(limb)))
    return np.asarray(root + distances[:, None] * direction)


def _places(
    limb: Limb, R_WT: Array, root: Array, ends: Array, outward: Array, last: Array
) -> tuple[Array, Array, Array]:
    """Where the middle joint may be (n, 3), the limb's angles there (n, 4), and the ends (n, 3).

    ends: (k, 3) on one line from the root.
    """
    is_leg = limb.name.endswith("leg")
    low, high = KNEE_RANGE if is_leg else ELBOW_RANGE
    degrees = np.arange(low, high + 0.5 * _STEP_DEG, _STEP_DEG)
    z, distances = _along(root, ends)
    along, radii = _circle_sizes(limb, distances)
    directions = joint_circle(limb, root, ends[0], outward).directions(degrees)
    centers, radii = root + along[:, None] * z, radii[:, None, None]
    middles = (centers[:, None] + radii * directions).reshape(-1, 3)
    each = np.repeat(ends, len(degrees), axis=0)
    angles, beyond = place_limb(limb, R_WT, root, middles, each, last)
    if not is_leg:
        return middles, angles, each
    least = beyond.reshape(len(ends), -1).min(axis=1)
    possible = beyond <= np.repeat(np.maximum(_HIP_TOLERANCE, least), len(degrees))
    return middles[possible], angles[possible], each[possible]


def _points_of_segments(
    limb: Limb, R_WT: Array, root: Array, middles: Array, angles: Array
) -> Array:
    """Points (n, m, 3) of both segments' surfaces for places (n, 3) and angles (n, 4)."""
    R_WU = R_WT @ Rotation.from_euler(_letters(limb)[:3], angles[:, :3]).as_matrix()
    R_WL = R_WU @ Rotation.from_euler(_letters(limb)[3], angles[:, 3:]).as_matrix()
    uppers, lowers = (
        points @ R.transpose(0, 2, 1) for points, R in zip(limb.surfaces, (R_WU, R_WL), strict=True)
    )
    return np.concatenate([root + uppers, middles[:, None] + lowers], axis=1)


def _letters(limb: Limb) -> str:
    """The axes of a limb's joints, each turned by those before it."""
    return "".join("XYZ"[axis] for axis in limb.axes)


def rectangles(root: Array, middles: Array, end: Array, half_widths: Array) -> Array:
    """Points (n, m, 3) [m] of a limb's rectangles, from root (3,) over n middles (n, 3) to end.

    They lie in the plane of the three joints and are so wide as half_widths (2,) says [m].
    """
    normal = np.cross(middles - root, end - root)
    along = ((np.arange(_SAMPLES_ALONG) + 0.5) / _SAMPLES_ALONG)[:, None, None]
    across = np.linspace(-1.0, 1.0, _SAMPLES_ACROSS)[:, None]
    parts = []
    for start, stop, half in ((root, middles, half_widths[0]), (middles, end, half_widths[1])):
        sideways = np.cross(normal, stop - start)
        length = np.linalg.norm(sideways, axis=1, keepdims=True)
        sideways = half * sideways / np.maximum(length, _STRAIGHT**2)
        start_each = np.broadcast_to(start, middles.shape)[:, None, None]
        step_each = (stop - start)[:, None, None]
        points = start_each + along * step_each + across * sideways[:, None, None]
        parts.append(points.reshape(len(middles), -1, 3))
    return np.concatenate(parts, axis=1)


def correlation(samples: Array, cameras: Sequence[Camera], regions: Sequence[Mask]) -> Array:
    """C (n,): the share of samples (n, m, 3) inside silhouettes, where cameras see somebody."""
    total, seers, weights = np.zeros(len(samples)), 0, np.ones(samples.shape[:2])
    for camera, region in zip(cameras, regions, strict=True):
        if region.any():
            inside, seen = sum_at_points(camera, region.view(np.int8), samples, weights)
            total += inside / np.maximum(seen, 1.0)
            seers += 1
    return total / max(1, seers)


def limb_angles(
    limb: Limb, R_WT: Array, root: Array, middle: Array, end: Array, last: Array
) -> Array:
    """The angles (4,) inside limits that put a limb's joints (3,) [m] in place, or near it."""
    angles, _ = place_limb(limb, R_WT, root, middle[None], end, last)
    return np.clip(angles[0], limb.lower, limb.upper)


def place_limb(
    limb: Limb, R_WT: Array, root: Array, middles: Array, ends: Array, last: Array
) -> tuple[Array, Array]:
    """The joint angles that put a limb's joints where they are, for several places of the middle.

    A nearly straight limb may be as long when bent a little: limits decide.

    Args:
        R_WT: (3, 3) the trunk's axes in the world.
        root, middles, ends: (3,), (n, 3), and (n, 3) or (3,) [m].
        last: (4,) angles to stay near where several sets do the same [rad].

    Returns:
        (n, 4) angles, and (n,) by how much the worst of its root's lies beyond its limits [rad].
    """
    towards, distances = _along(root, np.broadcast_to(ends, middles.shape))
    frames, off_line = _triads(towards, middles - root)
    # Stretched it does not tell how it is turned about itself: as in the last frame.
    stretched = off_line * distances < _STRETCHED * ((middles - root) ** 2).sum(axis=1)
    R_last = R_WT @ Rotation.from_euler(_letters(limb)[:3], last[:3]).as_matrix()
    bends, is_possible = _middle_angles(limb, distances)
    row, option = np.nonzero(is_possible)
    bend = bends[row, option]
    end_U = limb.middle_U + Rotation.from_euler(_letters(limb)[3], bend[:, None]).apply(limb.end_L)
    towards_U = _along(np.zeros(3), end_U)[0]
    own = _triads(towards_U, np.broadcast_to(limb.middle_U, end_U.shape))[0]
    R_WU = frames[row] @ own.transpose(0, 2, 1)
    if stretched.any():
        still = stretched[row]
        R_WU[still] = _least_turns(towards_U[still] @ R_last.T, towards[row[still]]) @ R_last
    angles, beyond = _root_angles(limb, R_WT.T @ R_WU, last[:3])
    costs, beyonds = np.full(bends.shape, np.inf), np.zeros(bends.shape)
    roots, each = np.zeros((*bends.shape, 3)), np.arange(len(middles))
    costs[row, option] = beyond + 1e-3 * np.abs(bend - last[3])
    roots[row, option], beyonds[row, option] = angles, beyond
    chosen = np.argmin(costs, axis=1)
    return np.column_stack([roots[each, chosen], bends[each, chosen]]), beyonds[each, chosen]


def _least_turns(ones: Array, others: Array) -> Array:
    """The least rotations (n, 3, 3) from directions (n, 3) to others (n, 3)."""
    quaternions = np.column_stack([np.cross(ones, others), 1.0 + (ones * others).sum(axis=1)])
    turned_about = np.sqrt((quaternions**2).sum(axis=1)) < _STRAIGHT
    quaternions[turned_about, :3] = _any_across(ones[turned_about])
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def _middle_angles(limb: Limb, distances: Array) -> tuple[Array, Array]:
    """The middle joint's angles (n, 2) [rad] for distances (n,) of root and end.

    And which of them (n, 2) are inside limits, or about as near as the other one.
    """
    base, swing, start = _bending(limb)
    turns = np.arccos(np.clip((distances**2 - base) / swing, -1.0, 1.0))
    options = start + np.array([-1.0, 1.0]) * turns[:, None]
    options = np.remainder(options + math.pi, 2.0 * math.pi) - math.pi
    clipped = np.clip(options, limb.lower[3], limb.upper[3])
    beyond = np.abs(options - clipped)
    return clipped, beyond <= beyond.min(axis=1, keepdims=True) + _BEND_TOLERANCE


def _reach(limb: Limb) -> tuple[float, float]:
    """The least and the largest distance of root and end inside the middle joint's limits [m]."""
    base, swing, start = _bending(limb)
    straight = min(max(start, limb.lower[3]), limb.upper[3])
    squares = base + swing * np.cos(np.array([limb.lower[3], limb.upper[3], straight]) - start)
    low, high = np.sqrt(np.maximum([squares.min(), squares.max()], 0.0))
    return float(low), float(high)


@lru_cache(maxsize=16)
def _bending(limb: Limb) -> tuple[float, float, float]:
    """Base, swing [m^2], start [rad]: the squared distance is base + swing cos(bend - start)."""
    axis = np.zeros(3)
    axis[limb.axes[3]] = 1.0
    along = (limb.middle_U @ axis) * (limb.end_L @ axis)
    cosine = limb.middle_U @ limb.end_L - along
    sine = limb.middle_U @ np.cross(axis, limb.end_L)
    a, b = limb.lengths
    base, swing = a * a + b * b + 2.0 * along, 2.0 * math.hypot(cosine, sine)
    return float(base), swing, math.atan2(sine, cosine)


def _root_angles(limb: Limb, R_TU: Array, last: Array) -> tuple[Array, Array]:
    """Angles (n, 3) of rotations (n, 3, 3), and how far (n,) the worst is off limits [rad]."""
    first, second, third = Rotation.from_matrix(R_TU).as_euler(_letters(limb)[:3]).T
    options = np.array(
        [[first, second, third], [first + math.pi, math.pi - second, third + math.pi]]
    ).transpose(0, 2, 1)
    options = np.remainder(options + math.pi, 2.0 * math.pi) - math.pi
    beyond = np.abs(options - np.clip(options, limb.lower[:3], limb.upper[:3]))
    cost = beyond.sum(axis=2) + 1e-3 * np.abs(options - last).sum(axis=2)
    chosen, each = np.argmin(cost, axis=0), np.arange(len(R_TU))
    return options[chosen, each], beyond[chosen, each].max(axis=1)


def _triads(x: Array, others: Array) -> tuple[Array, Array]:
    """(n, 3, 3) axes: x (n, 3) of length 1, then what of the others (n, 3) is across; how much."""
    across = others - (others * x).sum(axis=1, keepdims=True) * x
    length = np.sqrt((across**2).sum(axis=1))
    straight = length < _STRAIGHT
    across[straight] = _any_across(x[straight])
    y = across / np.sqrt((across**2).sum(axis=1, keepdims=True))
    return np.stack([x, y, np.cross(x, y)], axis=2), length


def _unit_across(vector: Array, axis: Array) -> Array:
    """The direction of a vector (3,) across an axis of length 1; any where there is none."""
    across = vector - (vector @ axis) * axis
    if np.linalg.norm(across) < _STRAIGHT:
        across = _any_across(axis[None])[0]
    return np.asarray(across / np.linalg.norm(across))


def _any_across(axes: Array) -> Array:
    """Any vectors (n, 3) across axes (n, 3), not 0."""
    return np.cross(axes, np.eye(3)[np.argmin(np.abs(axes), axis=1)])
