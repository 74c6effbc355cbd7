"""A frame's pose the paper's way, from features, face and silhouettes (Date et al., section 4).

Inverse kinematics goes in small steps from the last frame's angles (4.1.1 and 4.2).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.arrays import Array, Integers, Mask
from drake_pose.camera.models import Camera
from drake_pose.compiled import compiled
from drake_pose.person.date.limb_search import (
    FEATURE_ERROR,
    Search,
    limb_angles,
    search_limb,
)
from drake_pose.person.date.skeleton import LIMBS, Limb, Skeleton, rotation

_LARGEST_STEP = math.radians(2.0)
_LEAST_BEND = math.radians(3.0)
_CLOSE_ENOUGH = 1e-3
_STALLED = 1e-4
_DAMPING = 0.05**2
_ROUNDS = 25
_STEPS_A_ROUND = 4


def upper_body(skeleton: Skeleton, q: Array, features: Array, *, face_known: bool) -> Array:
    """Moves neck base and arms from q (nq,), in place at the head, to hands of features (5, 3) [m].

    Each side's chain is head 2, neck base 2, shoulder 3, elbow 1. Both sides share head and neck
    base, so they take turns, a few small steps each. A known face's head angles stay; legs, too.
    """
    q = np.array(q)
    shared = np.concatenate([skeleton.head_angles, skeleton.neck_angles])
    free = np.ones(8, dtype=np.bool_)
    free[:2] = not face_known
    offsets = np.zeros((8, 3))
    offsets[2] = skeleton.neck_H
    for name in ("left_arm", "right_arm"):
        limb = skeleton.limbs[name]
        q[limb.positions] = unlocked(limb, q[limb.positions])
    for _ in range(_ROUNDS):
        farthest, moved = 0.0, 0.0
        for k, name in enumerate(("left_arm", "right_arm")):
            limb = skeleton.limbs[name]
            index = np.concatenate([shared, limb.positions])
            axes = np.concatenate([skeleton.head_axes, skeleton.neck_axes, limb.axes])
            offsets[4], offsets[7] = limb.root_T, limb.middle_U
            angles, distance = reach(
                skeleton.R_WA,
                q[skeleton.head_positions],
                axes,
                offsets,
                limb.end_L,
                q[index],
                skeleton.lower[index],
                skeleton.upper[index],
                free,
                features[1 + k],
                _STEPS_A_ROUND,
            )
            farthest = max(farthest, distance)
            moved = max(moved, float(np.abs(angles - q[index]).max()))
            q[index] = angles
        # One side's turn may have moved the other's hand: only a round without steps is the end.
        if moved < _STALLED or (farthest < _CLOSE_ENOUGH and moved < _CLOSE_ENOUGH):
            break
    return q


def move_limb(limb: Limb, R_WT: Array, root: Array, angles: Array, target: Array) -> Array:
    """Moves a limb's angles (4,) until its end is at a target (3,), its root (3,) held [m, rad]."""
    offsets = np.zeros((4, 3))
    offsets[3] = limb.middle_U
    moved: Array
    moved, _ = reach(
        np.ascontiguousarray(R_WT),
        root,
        limb.axes,
        offsets,
        limb.end_L,
        unlocked(limb, angles),
        limb.lower,
        limb.upper,
        np.ones(4, dtype=np.bool_),
        target,
        _ROUNDS * _STEPS_A_ROUND,
    )
    return moved


def aim_trunk(skeleton: Skeleton, q: Array, waist: Array) -> Array:
    """Turns the neck base of q (nq,) so that the trunk points from there to the waist (3,) [m]."""
    index = skeleton.neck_angles
    _, neck = skeleton.trunk_pose(q)
    across = waist - neck
    length = float(np.linalg.norm(skeleton.waist_T))
    target = neck + across * (length / max(float(np.linalg.norm(across)), _CLOSE_ENOUGH))
    angles, _ = reach(
        skeleton.head_rotation(q),
        neck,
        skeleton.neck_axes,
        np.zeros((2, 3)),
        skeleton.waist_T,
        q[index],
        skeleton.lower[index],
        skeleton.upper[index],
        np.ones(2, dtype=np.bool_),
        target,
        _ROUNDS * _STEPS_A_ROUND,
    )
    aimed = np.array(q)
    aimed[index] = angles
    return aimed


def unlocked(limb: Limb, angles: Array) -> Array:
    """A limb's angles (4,), its middle joint bent by three degrees, lest no small step can help."""
    bend = angles[3]
    if abs(bend) < _LEAST_BEND:
        bend = _LEAST_BEND if limb.upper[3] > -limb.lower[3] else -_LEAST_BEND
    return np.array([*angles[:3], bend])


@compiled(error_model="python")
def reach(
    R_start: Array,
    p_start: Array,
    axes: Integers,
    offsets: Array,
    end: Array,
    angles: Array,
    lower: Array,
    upper: Array,
    free: Mask,
    target: Array,
    steps: int,
) -> tuple[Array, float]:
    """Moves a chain's angles in small steps until its end is at the target (3,) [m].

    A step is Levenberg and Marquardt's, J (J^T J + damping)^-1 gap, damped so that all joints take
    part, none by more than two degrees; then limits hold.

    Args:
        R_start, p_start: (3, 3) and (3,) frame on which the chain hangs, in the world.
        axes: (n,) 0, 1, 2: the joints' axes.
        offsets: (n, 3) each joint's place in the frame of the one before [m].
        end: (3,) the end's place in the last joint's frame [m].
        angles, lower, upper, free: (n,) the start and limits [rad], and which may change.
        steps: how many at most.

    Returns:
        (n,) angles, and the distance that is left [m].
    """
    n = len(axes)
    angles, distance = angles.copy(), np.inf
    turning, places, J = np.empty((n, 3)), np.empty((n, 3)), np.zeros((n, 3))
    for step in range(steps + 1):
        R, tip = R_start.copy(), p_start.copy()
        for k in range(n):
            i, j = (axes[k] + 1) % 3, (axes[k] + 2) % 3
            cosine, sine = math.cos(angles[k]), math.sin(angles[k])
            for r in range(3):
                for c in range(3):
                    tip[r] += R[r, c] * offsets[k, c]
                places[k, r], turning[k, r] = tip[r], R[r, axes[k]]
                old_i, old_j = R[r, i], R[r, j]
                R[r, i] = cosine * old_i + sine * old_j
                R[r, j] = cosine * old_j - sine * old_i
        gap = target - tip
        for r in range(3):
            for c in range(3):
                gap[r] -= R[r, c] * end[c]
        tip = target - gap
        distance = math.sqrt(gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2)
        if distance < _CLOSE_ENOUGH or step == steps:
            break
        A = _DAMPING * np.eye(3)
        for k in range(n):
            if free[k]:
                for r in range(3):
                    u, v = (r + 1) % 3, (r + 2) % 3
                    arm_u, arm_v = tip[u] - places[k, u], tip[v] - places[k, v]
                    J[k, r] = turning[k, u] * arm_v - turning[k, v] * arm_u
                for r in range(3):
                    for c in range(3):
                        A[r, c] += J[k, r] * J[k, c]
        pull = np.linalg.solve(A, gap)
        largest = 1e-12
        for k in range(n):
            largest = max(largest, abs(J[k, 0] * pull[0] + J[k, 1] * pull[1] + J[k, 2] * pull[2]))
        share, moved = min(1.0, _LARGEST_STEP / largest), 0.0
        for k in range(n):
            change = J[k, 0] * pull[0] + J[k, 1] * pull[1] + J[k, 2] * pull[2]
            new = min(max(angles[k] + share * change, lower[k]), upper[k])
            moved = max(moved, abs(new - angles[k]))
            angles[k] = new
        if moved < _STALLED:
            break
    return angles, distance


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
    R_WT, neck = skeleton.trunk_pose(q)
    waist = waist or Waist()
    place = waist.place(features, float(q[skeleton.head_angles[0]]))
    if waist.in_reach:
        place = _lowered(skeleton, R_WT, place, features[3:])
    # The model's trunk is one piece: it cannot hold shoulders and waist found apart. For its
    # positions the waist counts; so the neck's base cannot wander off from frame to frame either.
    aimed = aim_trunk(skeleton, q, place)
    R_aimed, _ = skeleton.trunk_pose(aimed)
    limbs = {}
    for k, name in enumerate(LIMBS):
        limb, end = skeleton.limbs[name], features[1 + k]
        if name.endswith("arm"):
            R, root, outward = R_WT, neck + R_WT @ limb.root_T, R_WT @ limb.root_T
            found = np.array([root, _middle(limb, R_WT, root, q[limb.positions]), end])
        else:
            R, outward = R_aimed, R_aimed @ (limb.root_T - skeleton.waist_T)
            root = place + outward
            angles = move_limb(limb, R_aimed, root, q[limb.positions], end)
            found = np.array([root, _middle(limb, R_aimed, root, angles), end])
        if search != "none":
            last_angles = q[limb.positions]
            found[1], end = search_limb(
                limb, R, root, end, outward, found[1], last_angles, cameras, regions, search
            )
            found[2] = end
        own_root = neck + R_aimed @ limb.root_T
        angles = limb_angles(limb, R_aimed, own_root, found[1], end, q[limb.positions])
        # Where limits forbid that, the hand or foot counts more than the elbow or knee.
        aimed[limb.positions] = move_limb(limb, R_aimed, own_root, angles, end)
        limbs[name] = found
    return PaperPose(skeleton.clip(aimed), limbs, place)


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


def _middle(limb: Limb, R_WT: Array, root: Array, angles: Array) -> Array:
    """(3,) the middle joint of a limb at angles (4,) [m]."""
    return np.asarray(root + R_WT @ rotation(limb.axes[:3], angles[:3]) @ limb.middle_U)
