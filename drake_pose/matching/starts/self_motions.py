"""Other values of a chain's joints that leave most of the body where it is.

Two joints whose axes are parallel can turn against each other, and three whose first and last axes
can be brought into line may be flipped (A1 + 180, -A2, A3 + 180): what hangs on the last joint
stays where it is, or nearly so, and only the links between turn. A refinement does not find its way
from one of these to another.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from drake_pose.body.tree.tree_kinematics import TreeKinematics

_PARALLEL = 0.8
# What a flip may move, as a share of the body's size.
_STAYS = 1e-3
# Values nearer than this are the same [rad].
_DIFFERENT = 1e-6


@dataclass(frozen=True, eq=False)
class Flip:
    """Three joints of a chain flipped, or several such flips one after another.

    Args:
        values: (m,) all values afterwards.
        changed: (m,) bool, those that were turned by 180 degrees or mirrored.
        mirrored: (m,) bool, those that turn the other way round now.
    """

    values: np.ndarray
    changed: np.ndarray
    mirrored: np.ndarray


def counter_turns(
    kinematics: TreeKinematics, values: np.ndarray, interval: float
) -> list[np.ndarray]:
    """Values (m,) with pairs of joints of nearly parallel axes turned against each other.

    Args:
        kinematics: the pose tree's.
        values: (m,) to begin with.
        interval: from one turn to the next [rad].
    """
    motions = kinematics.motions(values)
    turns, moves = motions.twists[:, :3], motions.moves
    steps = range(1, math.ceil(2.0 * math.pi / interval))
    found = []
    for first, second in _chained_pairs(kinematics, moves):
        along = float(turns[first] @ turns[second])
        if abs(along) < _PARALLEL:
            continue
        for step in steps:
            turned = values.copy()
            turned[first] += step * interval
            turned[second] -= math.copysign(step * interval, along)
            inside = _inside(kinematics, turned, (first, second))
            if inside is not None:
                found.append(inside)
    return found


def flips(kinematics: TreeKinematics, values: np.ndarray, count: int = 16) -> list[Flip]:
    """Poses with joints of a chain flipped, where what hangs on the last stays.

    Args:
        kinematics: the pose tree's.
        values: (m,) to begin with; not among those returned.
        count: at most so many poses are looked at; those outside the limits are left out.
    """
    untouched = np.zeros(len(values), dtype=np.bool_)
    known = [Flip(values, untouched, untouched)]
    # One flip may leave the limits and the next return into them.
    for one in known:
        for flip in _single_flips(kinematics, one):
            if len(known) > count:
                break
            gaps = [np.abs(_remainder(flip.values - other.values)).max() for other in known]
            if min(gaps) > _DIFFERENT:
                known.append(flip)
    found = []
    for flip in known[1:]:
        inside = _inside(kinematics, flip.values.copy(), np.flatnonzero(flip.changed))
        if inside is not None:
            found.append(Flip(inside, flip.changed, flip.mirrored))
    return found


def _single_flips(kinematics: TreeKinematics, start: Flip) -> list[Flip]:
    """One flip more, limits left aside."""
    motions = kinematics.motions(start.values)
    size = float(np.ptp(motions.X_WN[:, :3, 3], axis=0).max()) + 1e-9
    pairs = sorted(_chained_pairs(kinematics, motions.moves))
    found = []
    for first, middle in pairs:
        for last in (one for other, one in pairs if other == middle):
            for mirrored in (-start.values[middle], math.pi - start.values[middle]):
                flipped = start.values.copy()
                flipped[[first, last]] += math.pi
                flipped[middle] = mirrored
                node = kinematics.value_nodes[last]
                gap = kinematics.poses(flipped)[node] - motions.X_WN[node]
                if max(float(np.abs(gap[:3, :3]).max()), np.abs(gap[:3, 3]).max() / size) < _STAYS:
                    changed, other_way = start.changed.copy(), start.mirrored.copy()
                    changed[[first, middle, last]] = True
                    other_way[middle] = not other_way[middle]
                    found.append(Flip(flipped, changed, other_way))
    return found


def _chained_pairs(kinematics: TreeKinematics, moves: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of angles, the second at most two movable angles behind the first on its chain."""
    movable = np.flatnonzero((kinematics.upper > kinematics.lower) & kinematics.is_angle)
    nodes = kinematics.value_nodes
    pairs = []
    for second in movable:
        before = [int(i) for i in movable if i < second and moves[nodes[second], i]]
        pairs += [(first, int(second)) for first in before[-2:]]
    return pairs


def _remainder(angles: np.ndarray) -> np.ndarray:
    """Angles less full turns, from -pi to pi."""
    return np.asarray((angles + math.pi) % (2.0 * math.pi) - math.pi)


def _inside(
    kinematics: TreeKinematics, values: np.ndarray, changed: Iterable[int]
) -> np.ndarray | None:
    """The values, turned by full turns into their limits; None where that cannot be.

    Angles that turn around are brought to where answers are given.
    """
    values = kinematics.nearest_turns(values)
    for index in changed:
        if kinematics.turns_around[index]:
            continue
        lower, upper = kinematics.lower[index], kinematics.upper[index]
        full = 2.0 * math.pi
        values[index] -= full * math.floor((values[index] - lower) / full)
        if values[index] > upper:
            return None
    return values
