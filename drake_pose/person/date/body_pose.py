"""A frame's pose the paper's way, from features, face and silhouettes (Date et al., section 4).

Inverse kinematics goes in small steps from the last frame's angles (4.1.1 and 4.2).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.body.tree.tree_kinematics import PackedTree, find_motions
from drake_pose.camera.models import Camera
from drake_pose.compiled import compiled
from drake_pose.fit.levenberg_marquardt import eliminate
from drake_pose.person.date.limb_search import FEATURE_ERROR, Search, limb_angles, search_limb
from drake_pose.person.date.skeleton import LIMBS, Limb, Skeleton

_LARGEST_STEP = math.radians(2.0)
_LEAST_BEND = math.radians(3.0)
_CLOSE_ENOUGH = 1e-3
_STALLED = 1e-4
_DAMPING = 0.05**2
_ROUNDS = 25
_STEPS_A_ROUND = 4
# How far the left foot may be to the right of the right one [m].
_CROSSED = 0.05


def upper_body(skeleton: Skeleton, q: Array, features: Array, *, face_known: bool) -> Array:
    """Moves neck base and arms from q (nq,), in place at the head, to hands of features (5, 3) [m].

    Each side's chain is head 2, neck base 2, shoulder 3, elbow 1. Both sides share head and neck
    base, so they take turns, a few small steps each. A known face's head angles stay; legs, too.
    """
    shared = () if face_known else skeleton.head_angles
    q = _unlocked(_unlocked(q, skeleton.limbs["left_arm"]), skeleton.limbs["right_arm"])
    for _ in range(_ROUNDS):
        farthest, moved = 0.0, 0.0
        for name, hand in zip(LIMBS[:2], features[1:3], strict=True):
            limb, before = skeleton.limbs[name], q
            index = np.array([*shared, *skeleton.neck_angles, *limb.positions])
            part = limb.lower_node, limb.end_L
            q, distance = reach(skeleton, q, index, part, hand, _STEPS_A_ROUND)
            farthest = max(farthest, distance)
            moved = max(moved, float(np.abs(q - before).max()))
        # One side's turn may have moved the other's hand: only a round without steps is the end.
        if moved < _STALLED or (farthest < _CLOSE_ENOUGH and moved < _CLOSE_ENOUGH):
            break
    return q


def move_limb(skeleton: Skeleton, q: Array, name: str, target: Array) -> Array:
    """Moves a limb of q (nq,) until its end is at a target (3,) [m]; all else stays."""
    limb = skeleton.limbs[name]
    part = limb.lower_node, limb.end_L
    return reach(skeleton, _unlocked(q, limb), limb.positions, part, target)[0]


def aim_trunk(skeleton: Skeleton, q: Array, waist: Array) -> Array:
    """Turns the neck base of q (nq,) so that the trunk points from there to the waist (3,) [m]."""
    _, neck = skeleton.trunk_pose(q)
    across, length = waist - neck, float(np.linalg.norm(skeleton.waist_T))
    target = neck + across * (length / max(float(np.linalg.norm(across)), _CLOSE_ENOUGH))
    part = skeleton.nodes["trunk"], skeleton.waist_T
    return reach(skeleton, q, skeleton.neck_angles, part, target)[0]


def _unlocked(q: Array, limb: Limb) -> Array:
    """Positions with a limb's middle joint bent by three degrees, lest no small step can help."""
    q, bend = np.array(q), q[limb.positions[3]]
    if abs(bend) < _LEAST_BEND:
        is_up = limb.upper[3] > -limb.lower[3]
        q[limb.positions[3]] = _LEAST_BEND if is_up else -_LEAST_BEND
    return q


def reach(
    skeleton: Skeleton,
    q: Array,
    index: Indices,
    part: tuple[int, Array],
    target: Array,
    steps: int = _ROUNDS * _STEPS_A_ROUND,
) -> tuple[Array, float]:
    """Moves some positions of q (nq,) in small steps until a point is at the target (3,) [m].

    A step is Levenberg and Marquardt's, J (J^T J + damping)^-1 gap, damped so that all joints take
    part, none by more than two degrees; then limits hold.

    Args:
        index: (n,) which positions may change: angles that move the point.
        part: a node, and the point (3,) in its frame [m].
        steps: how many at most.

    Returns:
        (nq,) positions, and the distance that is left [m].
    """
    node, point = part
    packed, order = skeleton.chains[node]
    place = np.zeros(len(q), dtype=np.int64)
    place[order] = np.arange(len(order))
    limits, moved = (skeleton.lower[index], skeleton.upper[index]), np.array(q)
    moved[order], distance = _reach(packed, q[order], place[index], point, limits, target, steps)
    return moved, distance


@compiled(error_model="python")
def _reach(
    packed: PackedTree,
    values: Array,
    index: Indices,
    point: Array,
    limits: tuple[Array, Array],
    target: Array,
    steps: int,
) -> tuple[Array, float]:
    """As reach, of the values (m,) of a chain whose last node moves the point."""
    n, distance = len(index), np.inf
    tip, J, M = np.empty(3), np.empty((n, 3)), np.empty((3, 4))
    for step in range(steps + 1):
        X_WN, twists = find_motions(packed, values)
        M[:] = 0.0
        for r in range(3):
            tip[r] = X_WN[-1, r, 3]
            for c in range(3):
                tip[r] += X_WN[-1, r, c] * point[c]
            M[r, r], M[r, 3] = _DAMPING, target[r] - tip[r]
        distance = math.sqrt(M[0, 3] ** 2 + M[1, 3] ** 2 + M[2, 3] ** 2)
        if distance < _CLOSE_ENOUGH or step == steps:
            break
        for k in range(n):
            twist = twists[index[k]]
            for r in range(3):
                u, v = (r + 1) % 3, (r + 2) % 3
                J[k, r] = twist[3 + r] + twist[u] * tip[v] - twist[v] * tip[u]
            for r in range(3):
                for c in range(3):
                    M[r, c] += J[k, r] * J[k, c]
        eliminate(M)
        changes = J[:, 0] * M[0, 3] + J[:, 1] * M[1, 3] + J[:, 2] * M[2, 3]
        share = min(1.0, _LARGEST_STEP / max(1e-12, np.abs(changes).max()))
        moved = 0.0
        for k in range(n):
            old = values[index[k]]
            new = min(max(old + share * changes[k], limits[0][k]), limits[1][k])
            moved, values[index[k]] = max(moved, abs(new - old)), new
        if moved < _STALLED:
            break
    return values, distance


@dataclass(frozen=True)
class Waist:
    """The constants of the waist formula (4.2). They are a person's; the defaults are the paper's.

    Args:
        head_share: the head's share in the waist's height.
        ahead: how far the waist of a person standing upright is ahead of the head's middle [m].
        in_reach: whether the waist, which lifting a foot raises, is lowered until both feet are in
            the legs' reach; else no circle may be left to search on.
    """

    head_share: float = 0.55
    ahead: float = 0.0
    in_reach: bool = False

    def place(self, features: Array, heading: float) -> Array:
        """The waist (3,) [m] below the head, of features (5, 3) [m] and the heading [rad]."""
        head, _, _, left_foot, right_foot = features
        feet = 0.5 * (right_foot[2] + left_foot[2])
        height = self.head_share * head[2] + (1.0 - self.head_share) * feet
        forward = self.ahead * np.array([np.cos(heading), np.sin(heading)])
        return np.array([*(head[:2] + forward), height])


def waist_of(skeleton: Skeleton) -> Waist:
    """The constants for this person standing upright, both feet in reach; centimetres matter."""
    q = np.zeros(len(skeleton.lower))
    head, _, _, left_foot, right_foot = skeleton.features(q)
    hips = np.mean([skeleton.limb_points(q, name)[0] for name in LIMBS[2:]], axis=0)
    feet = 0.5 * (left_foot[2] + right_foot[2])
    return Waist(float((hips[2] - feet) / (head[2] - feet)), float(hips[0] - head[0]), True)


@dataclass(frozen=True, eq=False)
class PaperPose:
    """A pose estimated the paper's way.

    Args:
        q: (nq,) positions inside their limits.
        limbs: by name, (3, 3) shoulder, elbow and hand, or hip, knee and foot, as found [m].
        waist: (3,) half-way between the hips, by the waist formula [m].
    """

    q: Array
    limbs: Mapping[str, Array]
    waist: Array


def estimate_pose(
    skeleton: Skeleton,
    last: Array,
    features: Array,
    head_angles: Array | None,
    cameras: Sequence[Camera],
    regions: Sequence[Mask],
    *,
    search: Search = "surfaces",
    waist: Waist | None = None,
) -> PaperPose:
    """Estimates a frame's pose.

    Args:
        last: (nq,) the last frame's positions.
        features: (5, 3) head, hands and feet in the order of FEATURES [m].
        head_angles: (2,) [rad] where the face was seen; None: the last frame's, free to move.
        cameras, regions: those on the circle, and (H, W) the person in each of their pictures.
        search: how elbows and knees are searched: "surfaces" by points of the limbs' surfaces, on
            the circles of all ends within what hands and feet are measured off; "rectangles" as in
            the paper, on one circle; "none": they stay where inverse kinematics puts them.
    """
    q = _head_and_arms(skeleton, last, features, head_angles)
    waist = waist or Waist()
    place = waist.place(features, float(q[skeleton.head_angles[0]]))
    if waist.in_reach:
        place = _lowered(skeleton, skeleton.trunk_pose(q)[0], place, features[3:])
    # The model's trunk is one piece: it cannot hold shoulders and waist found apart. For its
    # positions the waist counts; so the neck's base cannot wander off from frame to frame either.
    aimed = aim_trunk(skeleton, q, place)
    R_aimed, _ = skeleton.trunk_pose(aimed)
    limbs = {}
    for name, end in zip(LIMBS, features[1:], strict=True):
        limb, posed, off = skeleton.limbs[name], q, np.zeros(3)
        R_WT, own_root = skeleton.trunk_pose(q)[0], skeleton.limb_points(aimed, name)[0]
        outward, last_angles = R_WT @ limb.root_T, q[limb.positions]
        if name.endswith("leg"):
            # It hangs on the waist that was found, not on the model's.
            R_WT, outward = R_aimed, R_aimed @ (limb.root_T - skeleton.waist_T)
            off = place + outward - own_root
            posed = move_limb(skeleton, aimed, name, end - off)
        found = skeleton.limb_points(posed, name) + off
        found[2] = end
        if search != "none":
            found[1:] = search_limb(
                limb, R_WT, found[0], end, outward, found[1], last_angles, cameras, regions, search
            )
        aimed[limb.positions] = limb_angles(
            limb, R_aimed, own_root, found[1], found[2], last_angles
        )
        # Where limits forbid that, the hand or foot counts more than the elbow or knee.
        aimed = move_limb(skeleton, aimed, name, found[2])
        limbs[name] = found
    return PaperPose(skeleton.clip(aimed), limbs, place)


def uncross_feet(skeleton: Skeleton, last: Array, features: Array) -> Indices:
    """The order (5,) in which features (5, 3) [m] have the feet not crossed, by the last q (nq,).

    Feet that pass each other are exchanged where one is taken for the other, which then lasts.
    """
    left_W = skeleton.trunk_pose(last)[0][:, 0]
    is_crossed = (features[3] - features[4]) @ left_W < -_CROSSED
    return np.array([0, 1, 2, 4, 3] if is_crossed else [0, 1, 2, 3, 4])


def _lowered(skeleton: Skeleton, R_WT: Array, place: Array, feet: Array) -> Array:
    """The waist (3,), lowered until both legs reach their feet (2, 3) [m], within tolerance."""
    beyond = 0.0
    for name, foot in zip(LIMBS[2:], feet, strict=True):
        limb = skeleton.limbs[name]
        hip = place + R_WT @ (limb.root_T - skeleton.waist_T)
        across = float(np.linalg.norm(hip[:2] - foot[:2]))
        above = np.sqrt(max(0.0, sum(limb.lengths) ** 2 - across**2))
        beyond = max(beyond, float(hip[2] - foot[2] - above))
    lower = min(beyond, max(0.0, 2.0 * (beyond - FEATURE_ERROR)))
    return np.array([*place[:2], place[2] - lower])


def _head_and_arms(
    skeleton: Skeleton, last: Array, features: Array, head_angles: Array | None
) -> Array:
    """Positions (nq,) with head and hands where they were measured; legs as in the last frame."""
    q = np.array(last, dtype=np.float64)
    if head_angles is not None:
        index = skeleton.head_angles
        q[index] = np.clip(head_angles, skeleton.lower[index], skeleton.upper[index])
    q[skeleton.head_positions] = features[0] - skeleton.head_rotation(q) @ skeleton.face_H
    q = upper_body(skeleton, q, features, face_known=head_angles is not None)
    # Where the head's angles moved, its middle must still be where it was measured.
    q[skeleton.head_positions] = features[0] - skeleton.head_rotation(q) @ skeleton.face_H
    return q
