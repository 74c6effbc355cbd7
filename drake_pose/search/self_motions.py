"""Find other joint values of a chain that leave the links behind it in place (self-motions).

Counter-turns: two joints with nearly parallel axes turn by opposite angles. Flips: three joints
with angles (a1, a2, a3) take (a1 + pi, -a2, a3 + pi), if the first and last axes can be aligned,
as in a spherical wrist. The links behind the last joint keep their pose, or nearly so, and only the
links between move. A local refinement does not get from one of these poses to another.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from drake_pose.body.tree_kinematics import TreeKinematics


@dataclass(frozen=True, eq=False)
class Flip:
    """A pose with three joints of a chain flipped, once or several times in succession."""

    values: np.ndarray  # (m,) the flipped values [rad or m].
    changed: np.ndarray  # (m,) bool which values were turned by pi or mirrored.
    # (m,) bool which values have the opposite direction of motion: a2 becomes -a2 or pi - a2.
    mirrored: np.ndarray


def counter_turns(
    kinematics: TreeKinematics, values: np.ndarray, interval: float, parallel: float = 0.8
) -> list[np.ndarray]:
    """Return poses (m,) in which two joints with nearly parallel axes turn by opposite angles.

    The joints are of one chain, at most one movable angle apart. Poses outside the limits are left
    out.

    Args:
        kinematics: kinematics of the pose tree, with m values.
        values: (m,) the pose [rad or m].
        interval: the angles are multiples of this, up to a full turn [rad].
        parallel: least absolute cosine of the angle between the axes.
    """
    motions = kinematics.motions(values)
    turns, moves = motions.twists[:, :3], motions.moves
    steps = range(1, math.ceil(2.0 * math.pi / interval))
    found = []
    for first, second in _chained_pairs(kinematics, moves):
        along = float(turns[first] @ turns[second])
        if abs(along) < parallel:
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
    """Return flipped poses within the limits in which the links behind the flipped joints stay.

    ``kinematics``: kinematics of the pose tree, with m values. ``values``: (m,) the pose [rad or
    m]. ``count``: greatest number of flips that are examined, those outside the limits included.
    """
    untouched = np.zeros(len(values), dtype=np.bool_)
    known = [Flip(values, untouched, untouched)]
    # Triples (n, 3) of angles, each at most two movable angles behind the previous one.
    pairs = sorted(_chained_pairs(kinematics, kinematics.motions(values).moves))
    chained = [(*pair, last) for pair in pairs for middle, last in pairs if middle == pair[1]]
    triples = np.array(chained, dtype=np.int64).reshape(-1, 3)
    # One flip may leave the limits and the next return into them.
    for one in known:
        if len(known) > count:
            break
        for flip in _single_flips(kinematics, one, triples):
            gaps = flip.values - np.array([other.values for other in known])
            if np.abs(np.angle(np.exp(1j * gaps))).max(axis=1).min() > 1e-6:
                known.append(flip)
    found = []
    for flip in known[1 : count + 1]:
        inside = _inside(kinematics, flip.values.copy(), np.flatnonzero(flip.changed))
        if inside is not None:
            found.append(Flip(inside, flip.changed, flip.mirrored))
    return found


def _single_flips(
    kinematics: TreeKinematics,
    start: Flip,
    triples: np.ndarray,
    stays: float = 1e-3,
    nearly: float = 0.02,
) -> list[Flip]:
    """Return poses with one more triple of joints flipped, regardless of limits.

    ``kinematics``: kinematics of the pose tree, with m values. ``start``: the pose, with what was
    changed by earlier flips. ``triples``: (n, 3) indices of the values (angles) of three joints of
    a chain, the first first. ``stays``: greatest motion of the last link, as a fraction of the
    body's size, or in the entries of its rotation matrix. ``nearly``: greatest error of the cosines
    by which triples are preselected.
    """
    motions = kinematics.motions(start.values)
    size = float(np.ptp(motions.X_WN[:, :3, 3], axis=0).max()) + 1e-9
    middles = start.values[triples[:, 1]]
    mirrored = np.stack([-middles, math.pi - middles], axis=1)
    # Condition for the last link to keep its orientation: half turns about two axes are together a
    # turn about their common perpendicular by twice the angle between them. The middle joint must
    # be perpendicular to both axes, and its change must undo this turn.
    first, middle, last = motions.twists[triples, :3].transpose(1, 0, 2)
    across = np.abs(np.stack([first * middle, last * middle]).sum(axis=2)).max(axis=0) < nearly
    doubled = 2.0 * (first * last).sum(axis=1) ** 2 - 1.0
    undone = np.abs(np.cos(mirrored - middles[:, None]) - doubled[:, None]) < nearly
    found = []
    for row, way in np.argwhere(across[:, None] & undone):
        first, middle, last = triples[row]
        flipped = start.values.copy()
        flipped[[first, last]] += math.pi
        flipped[middle] = mirrored[row, way]
        node = kinematics.value_nodes[last]
        gap = kinematics.poses(flipped)[node] - motions.X_WN[node]
        if max(float(np.abs(gap[:3, :3]).max()), np.abs(gap[:3, 3]).max() / size) < stays:
            changed, other_way = start.changed.copy(), start.mirrored.copy()
            changed[[first, middle, last]] = True
            other_way[middle] = not other_way[middle]
            found.append(Flip(flipped, changed, other_way))
    return found


def _chained_pairs(kinematics: TreeKinematics, moves: np.ndarray) -> list[tuple[int, int]]:
    """Return pairs of indices of angles: the second is one or two movable angles behind the first.

    ``moves``: (nodes, m) bool whether each of the m values moves each node.
    """
    movable = np.flatnonzero((kinematics.upper > kinematics.lower) & kinematics.is_angle)
    nodes = kinematics.value_nodes
    pairs = []
    for second in movable:
        before = [int(i) for i in movable if i < second and moves[nodes[second], i]]
        pairs += [(first, int(second)) for first in before[-2:]]
    return pairs


def _inside(
    kinematics: TreeKinematics, values: np.ndarray, changed: Iterable[int]
) -> np.ndarray | None:
    """Return values (m,) with full turns added so that they are within their limits, else None.

    ``changed``: indices of the values that are brought into their limits. Angles that turn around
    are given in the turn nearest to their defaults.
    """
    values = kinematics.nearest_turns(values)
    for index in changed:
        if kinematics.covers_full_turn[index]:
            continue
        lower, upper = kinematics.lower[index], kinematics.upper[index]
        full = 2.0 * math.pi
        values[index] -= full * math.floor((values[index] - lower) / full)
        if values[index] > upper:
            return None
    return values
