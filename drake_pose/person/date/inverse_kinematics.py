"""Inverse kinematics in small steps from the last frame's angles (Date et al., 4.1.1 and 4.2)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drake_pose.compiled import compiled
from drake_pose.person.date.skeleton import Limb, Skeleton

Array = NDArray[np.float64]

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
    axes: NDArray[np.int64],
    offsets: Array,
    end: Array,
    angles: Array,
    lower: Array,
    upper: Array,
    free: NDArray[np.bool_],
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
