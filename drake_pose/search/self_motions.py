"""Other values of a chain's joints that leave most of the body where it is.

Two joints whose axes are parallel can turn against each other, and three whose first and last axes
can be brought into line may be flipped (A1 + 180, -A2, A3 + 180): what hangs on the last joint
stays where it is, or nearly so, and only the links between turn. A refinement does not find its way
from one of these to another.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from drake_pose.body.tree_kinematics import TreeKinematics


@dataclass(frozen=True, eq=False)
class Flip:
    """Values (m,) with three joints of a chain flipped, or several such flips one after another.

    ``changed``: (m,) bool, turned by 180 degrees or mirrored; ``mirrored``: turned round.
    """

    values: np.ndarray
    changed: np.ndarray
    mirrored: np.ndarray


def counter_turns(
    kinematics: TreeKinematics, values: np.ndarray, interval: float, parallel: float = 0.8
) -> list[np.ndarray]:
    """Values (m,) with pairs of joints of nearly parallel axes turned against each other.

    ``parallel``: the cosine of the angle between the axes is at least this.
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
    """Poses with joints of a chain flipped, where what hangs on the last stays.

    ``count``: the greatest number looked at; those outside the limits are left out.
    """
    untouched = np.zeros(len(values), dtype=np.bool_)
    known = [Flip(values, untouched, untouched)]
    # Triples (n, 3) of angles, each at most two movable angles behind the one before it.
    pairs = sorted(_chained_pairs(kinematics, kinematics.motions(values).moves))
    chained = [(*pair, last) for pair in pairs for middle, last in pairs if middle == pair[1]]
    triples = np.array(chained, dtype=np.int64).reshape(-1, 3)
    # One flip may leave the limits and the next return into them.
    for one in known:
        if len(known) > count:
            break
        for flip in _single_flips(kinematics, one, triples):
            gaps = flip.values - np.array([other.values for other in known])
            # Less full turns, from -pi to pi.
            gaps = np.abs((gaps + math.pi) % (2.0 * math.pi) - math.pi)
            if gaps.max(axis=1).min() > 1e-6:
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
    """One flip more, limits left aside; triples (n, 3) of joints.

    ``stays``: what a flip may move, as a share of the body's size; ``nearly``: how far cosines are
    from where they are if all stays: wider.
    """
    motions = kinematics.motions(start.values)
    size = float(np.ptp(motions.X_WN[:, :3, 3], axis=0).max()) + 1e-9
    middles = start.values[triples[:, 1]]
    mirrored = np.stack([-middles, math.pi - middles], axis=1)
    # What hangs on the last joint can have its old direction: half turns about two axes make a turn
    # about what is perpendicular to both, by twice the angle between them, and the turns of the
    # middle joint must undo it.
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
    """Pairs of angles, the second at most two movable angles behind the first on its chain."""
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
