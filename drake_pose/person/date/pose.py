"""Pose of a person in one frame, from features, face and silhouettes (Date et al., section 4).

Inverse kinematics moves the last frame's angles in small steps until hands and feet are in place
(4.1.1, 4.2). Elbows and knees are then searched on circles: P = r sin(theta) i + r cos(theta) j,
with r the circle's radius and i, j its axes; theta has the highest correlation C(theta) of the
limb's back-projection with the silhouettes (4.1.2, 4.2).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.body.tree_kinematics import PackedTree, find_motions
from drake_pose.camera.models import Camera
from drake_pose.compiled import compiled
from drake_pose.fit.levenberg_marquardt import eliminate
from drake_pose.person.date.skeleton import LIMBS, Limb, Skeleton
from drake_pose.person.views import sum_at_points


@dataclass(frozen=True)
class PoseSettings:
    """Step sizes and tolerances of the inverse kinematics and of the circle search."""

    max_step: float = math.radians(2.0)  # Largest change of any angle in a step [rad].
    damping: float = 0.05**2  # Added to the diagonal of a step's normal equations [m^2].
    tolerance: float = 1e-3  # A point at this distance from its target has reached it [m].
    min_step: float = 1e-4  # The search ends if no angle changes by more than this in a step [rad].
    max_steps: int = 100  # Largest number of steps.
    steps_per_turn: int = 4  # Number of steps of one arm before the other arm's turn.
    # Least initial bend of a middle joint; small steps cannot bend a straight limb [rad].
    min_bend: float = math.radians(3.0)
    # Angles on the circle [deg]: from behind over outwards to a little in front.
    elbow_range: tuple[float, float] = (0.0, 120.0)
    # Angles on the circle [deg]: 0 in front, positive outwards, as far as the hip can turn. A
    # straight leg's knee lies behind, as the leg ends at the middle of the foot.
    knee_range: tuple[float, float] = (-180.0, 175.0)
    circle_step: float = 5.0  # Spacing of the candidates on a circle [deg].
    # bend_tolerance, hip_tolerance: how far a straight limb's middle joint, or a hip, may exceed
    # its limits, because the trunk's direction is measured with errors [rad].
    bend_tolerance: float = math.radians(3.0)
    hip_tolerance: float = math.radians(10.0)
    # along, across: number of points along and across a limb's rectangle.
    along: int = 12
    across: int = 5
    # Weight of the head's height in the waist's height (4.2); the feet's is the rest.
    head_fraction: float = 0.55


SETTINGS = PoseSettings()

# Lengths [m] and components of directions below this count as 0.
_TINY = 1e-9


def move_upper_body(skeleton: Skeleton, q: Array, features: Array, *, face_known: bool) -> Array:
    """Move neck base and arms of q (nq,) until the hands are at those of features (5, 3) [m].

    The head must be in place already. Each side's chain has 2 angles of the head, 2 of the neck
    base, 3 of the shoulder and 1 of the elbow (4.1.1). Both chains share head and neck base, so
    they take turns of a few steps each.

    ``features``: (5, 3) positions of FEATURES; only the hands count. ``face_known``: whether the
    head's angles were measured and stay. Returns (nq,) positions; a hand out of reach is only near
    its target.
    """
    shared = () if face_known else skeleton.head_angles
    for name in LIMBS[:2]:
        q = _with_bent_joint(q, skeleton.limbs[name])
    for _ in range(SETTINGS.max_steps // SETTINGS.steps_per_turn):
        farthest, moved = 0.0, 0.0
        for name, hand in zip(LIMBS[:2], features[1:3], strict=True):
            limb, before = skeleton.limbs[name], q
            index = np.array([*shared, *skeleton.neck_angles, *limb.positions])
            part = limb.lower_node, limb.end_L
            q, distance = reach(skeleton, q, index, part, hand, SETTINGS.steps_per_turn)
            farthest = max(farthest, distance)
            moved = max(moved, float(np.abs(q - before).max()))
        # One side's turn may have moved the other's hand, so only a round without steps is the end.
        if moved < SETTINGS.min_step or max(farthest, moved) < SETTINGS.tolerance:
            break
    return q


def move_limb(skeleton: Skeleton, q: Array, name: str, target: Array) -> Array:
    """Move a limb of LIMBS until its end is at a target (3,) [m]; return the new q (nq,)."""
    limb = skeleton.limbs[name]
    part = limb.lower_node, limb.end_L
    return reach(skeleton, _with_bent_joint(q, limb), limb.positions, part, target)[0]


def _with_bent_joint(q: Array, limb: Limb) -> Array:
    """Return q (nq,) with a limb's middle joint bent by `min_bend` or more."""
    q, least = np.array(q), SETTINGS.min_bend
    if abs(q[limb.positions[3]]) < least:
        q[limb.positions[3]] = least if limb.upper[3] > -limb.lower[3] else -least
    return q


def reach(
    skeleton: Skeleton,
    q: Array,
    index: Indices,
    part: tuple[int, Array],
    target: Array,
    max_steps: int = SETTINGS.max_steps,
) -> tuple[Array, float]:
    """Move positions of q (nq,) in small steps until a point is at the target (3,) [m].

    The step is J (J^T J + damping I)^-1 gap, with J (n, 3) the point's derivatives by the n angles
    and gap (3,) the vector to the target. It is scaled so that no angle changes by more than
    `max_step`, then clipped to the limits. Damping makes all joints take part.

    ``index``: (n,) indices in q of the angles that may change; they must move the point. ``part``:
    index of a node, and the point (3,) in the node's frame [m]. ``max_steps``: largest number of
    steps. Returns (nq,) positions, and the remaining distance [m].
    """
    node, point = part
    packed, order = skeleton.chains[node]
    place = np.zeros(len(q), dtype=np.int64)
    place[order] = np.arange(len(order))
    limits, moved = (skeleton.lower[index], skeleton.upper[index]), np.array(q)
    numbers = SETTINGS.damping, SETTINGS.max_step, SETTINGS.tolerance, SETTINGS.min_step
    moved[order], distance = _reach(
        packed, q[order], place[index], point, limits, target, max_steps, numbers
    )
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
    numbers: tuple[float, float, float, float],
) -> tuple[Array, float]:
    """`reach` for a chain of nodes from the root, whose last one carries the point.

    Args:
        packed: the chain.
        values: (m,) the chain's values [rad, m]; changed.
        index: (n,) indices in `values` of the angles that may change.
        point: (3,) in the last node's frame [m].
        limits: (n,) lower and (n,) upper limits of these angles [rad].
        target: (3,) in the world [m].
        steps: largest number of steps.
        numbers: damping [m^2], max_step [rad], tolerance [m] and min_step [rad] of the settings.

    Returns the values, and the remaining distance [m].
    """
    damping, max_step, tolerance, min_step = numbers
    n, distance = len(index), np.inf
    tip, J, M = np.empty(3), np.empty((n, 3)), np.empty((3, 4))
    for step in range(steps + 1):
        X_WN, twists = find_motions(packed, values)
        M[:] = 0.0
        for r in range(3):
            tip[r] = X_WN[-1, r, 3]
            for c in range(3):
                tip[r] += X_WN[-1, r, c] * point[c]
            M[r, r], M[r, 3] = damping, target[r] - tip[r]
        distance = math.sqrt(M[0, 3] ** 2 + M[1, 3] ** 2 + M[2, 3] ** 2)
        if distance < tolerance or step == steps:
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
        scale = min(1.0, max_step / max(1e-12, np.abs(changes).max()))
        moved = 0.0
        for k in range(n):
            old = values[index[k]]
            new = min(max(old + scale * changes[k], limits[0][k]), limits[1][k])
            moved, values[index[k]] = max(moved, abs(new - old)), new
        if moved < min_step:
            break
    return values, distance


def estimate_pose(
    skeleton: Skeleton,
    last: Array,
    features: Array,
    head_angles: Array | None,
    cameras: Sequence[Camera],
    regions: Sequence[Mask],
    *,
    search: bool = True,
) -> tuple[Array, dict[str, Array]]:
    """Estimate a frame's pose by the paper's method.

    Args:
        skeleton: of the person.
        last: (nq,) positions in the last frame [rad, m].
        features: (5, 3) positions of FEATURES: head, hands and feet [m].
        head_angles: (2,) turn and nod of the head [rad]; None: unknown, start at the last frame's.
        cameras: whose silhouettes score elbows and knees.
        regions: (H, W) region of the person in each camera's picture; empty ones are skipped.
        search: whether elbows and knees are searched on their circles; if not, they stay where
            inverse kinematics puts them.

    Returns (nq,) positions inside their limits; and by limb (3, 3) positions of shoulder, elbow and
    hand, or hip, knee and foot, before the model is fitted to them [m].
    """
    q = np.array(last, dtype=np.float64)
    if head_angles is not None:
        index = skeleton.head_angles
        q[index] = np.clip(head_angles, skeleton.lower[index], skeleton.upper[index])
    q[skeleton.head_positions] = features[0] - skeleton.head_rotation(q) @ skeleton.face_H
    q = move_upper_body(skeleton, q, features, face_known=head_angles is not None)
    # The head's angles may have changed: put its middle back to where it was measured.
    q[skeleton.head_positions] = features[0] - skeleton.head_rotation(q) @ skeleton.face_H
    # The waist, half-way between the hips, by the formula of section 4.2.
    feet = 0.5 * (features[4, 2] + features[3, 2])
    share = SETTINGS.head_fraction
    waist = np.array([*features[0, :2], share * features[0, 2] + (1.0 - share) * feet])
    # The model's trunk is rigid: it cannot fit shoulders and waist that were found separately. The
    # waist decides its pose, which also keeps the neck base from drifting from frame to frame.
    _, neck = skeleton.trunk_pose(q)
    across, length = waist - neck, float(np.linalg.norm(skeleton.waist_T))
    target = neck + across * (length / max(float(np.linalg.norm(across)), SETTINGS.tolerance))
    trunk = skeleton.nodes["trunk"], skeleton.waist_T
    aimed, _ = reach(skeleton, q, skeleton.neck_angles, trunk, target)
    R_aimed, _ = skeleton.trunk_pose(aimed)
    limbs = {}
    for name, end in zip(LIMBS, features[1:], strict=True):
        limb, model_q, off = skeleton.limbs[name], q, np.zeros(3)
        R_WT, own_root = skeleton.trunk_pose(q)[0], skeleton.limb_points(aimed, name)[0]
        outward, last_angles = R_WT @ limb.root_T, q[limb.positions]
        if limb.is_leg:
            # Hang the leg on the waist that was found, not on the model's.
            R_WT, outward = R_aimed, R_aimed @ (limb.root_T - skeleton.waist_T)
            off = waist + outward - own_root
            model_q = move_limb(skeleton, aimed, name, end - off)
        joints = skeleton.limb_points(model_q, name) + off
        joints[2] = end
        if search:
            # Search the circle for the highest correlation. A knee must be where the hip can turn
            # it. Of equally good places the one nearest to inverse kinematics' is taken.
            start, stop = SETTINGS.knee_range if limb.is_leg else SETTINGS.elbow_range
            degrees = np.arange(start, stop + 0.5 * SETTINGS.circle_step, SETTINGS.circle_step)
            middles = joint_circle(limb, joints[0], end, outward, degrees)
            if limb.is_leg:
                _, beyond = limb_angles(limb, R_WT, joints[0], middles, end, last_angles)
                middles = middles[beyond <= np.maximum(SETTINGS.hip_tolerance, beyond.min())]
            samples = rectangles(joints[0], middles, end, limb.half_widths)
            scores = correlation(samples, cameras, regions)
            best = middles[scores >= scores.max() - _TINY]
            joints[1] = best[np.argmin(np.linalg.norm(best - joints[1], axis=1))]
        angles, _ = limb_angles(limb, R_aimed, own_root, joints[1:2], joints[2], last_angles)
        aimed[limb.positions] = np.clip(angles[0], limb.lower, limb.upper)
        # Where limits do not allow both, the end's position matters more than the middle joint's.
        aimed = move_limb(skeleton, aimed, name, joints[2])
        limbs[name] = joints
    return skeleton.clip(aimed), limbs


def joint_circle(limb: Limb, root: Array, end: Array, outward: Array, degrees: Array) -> Array:
    """Return places (n, 3) of an elbow or knee on its circle, at angles (n,) [deg] (4.1.2).

    Place = center + radius (sin(theta) i + cos(theta) j) [m]. i is the direction in the circle's
    plane nearest to the horizontal part of `outward`; j = i x z for the left arm, with z from
    shoulder to hand. The right arm and the legs are mirrored, so that j points behind an arm and in
    front of a leg. A limb whose end is out of reach is stretched or folded in proportion.

    ``root``, ``end``: (3,) shoulder and hand, or hip and foot [m]. ``outward``: (3,) from neck base
    to shoulder, or from waist to hip [m]. ``degrees``: (n,) theta of each place.
    """
    z, distance = _directions(root, end)
    a, b = limb.lengths
    reached = np.clip(distance, max(abs(a - b), _TINY), a + b)
    along = (a * a - b * b + reached * reached) / (2.0 * reached)
    radius = np.sqrt(np.maximum(0.0, a * a - along * along))
    level = np.array([outward[0], outward[1], 0.0])
    i = level - (level @ z) * z
    if np.linalg.norm(i) < _TINY:
        i = _perpendicular(z[None])[0]
    i = i / np.linalg.norm(i)
    j = limb.side * np.cross(i, z) * (-1.0 if limb.is_leg else 1.0)
    theta = np.radians(degrees)[:, None]
    center = root + along * distance / reached * z
    return np.asarray(center + radius * (np.sin(theta) * i + np.cos(theta) * j))


def rectangles(root: Array, middles: Array, end: Array, half_widths: Array) -> Array:
    """Return points (n, m, 3) of a limb's two rectangles, for n places of its middle joint [m].

    They lie in the plane of the three joints (figure 6).

    Args:
        root, middles, end: (3,), (n, 3) and (3,) the limb's joints [m].
        half_widths: (2,) of the rectangles before and after the middle joint [m].
    """
    normal = np.cross(middles - root, end - root)
    along = ((np.arange(SETTINGS.along) + 0.5) / SETTINGS.along)[:, None, None]
    across = np.linspace(-1.0, 1.0, SETTINGS.across)[:, None]
    parts = []
    for start, stop, half in ((root, middles, half_widths[0]), (middles, end, half_widths[1])):
        sideways = np.cross(normal, stop - start)
        length = np.linalg.norm(sideways, axis=1, keepdims=True)
        sideways = half * sideways / np.maximum(length, _TINY**2)
        start_each = np.broadcast_to(start, middles.shape)[:, None, None]
        step_each = (stop - start)[:, None, None]
        points = start_each + along * step_each + across * sideways[:, None, None]
        parts.append(points.reshape(len(middles), -1, 3))
    return np.concatenate(parts, axis=1)


def correlation(samples: Array, cameras: Sequence[Camera], regions: Sequence[Mask]) -> Array:
    """Return the correlation C (n,) of limbs with the silhouettes (H, W), 0 to 1.

    C is the mean, over cameras with a silhouette, of the fraction of a limb's points (n, m, 3) in
    the picture that lie inside the silhouette; 0 where no camera has one.
    """
    total, seers, weights = np.zeros(len(samples)), 0, np.ones(samples.shape[:2])
    for camera, region in zip(cameras, regions, strict=True):
        if region.any():
            inside, seen = sum_at_points(camera, region.view(np.int8), samples, weights)
            total += inside / np.maximum(seen, 1.0)
            seers += 1
    return total / max(1, seers)


def limb_angles(
    limb: Limb, R_WT: Array, root: Array, middles: Array, end: Array, last: Array
) -> tuple[Array, Array]:
    """Return a limb's joint angles that put its joints in given places, for n middle joints.

    A nearly straight limb has the same length for two bends: limits decide.

    Args:
        R_WT: (3, 3) axes of the trunk in the world.
        root, middles, end: (3,), (n, 3) and (3,) the limb's joints [m].
        last: (4,) angles to stay near where several solutions exist [rad].

    Returns (n, 4) angles, three at the root and the bend; and (n,) how far the worst of the root's
    angles exceeds its limits, 0 if none does [rad]. The bend is inside its limits.
    """
    letters = "".join("XYZ"[axis] for axis in limb.axes)
    towards, distances = _directions(root, np.broadcast_to(end, middles.shape))
    frames, off_line = _triads(towards, middles - root)
    # A straight limb does not determine its turn about itself, which stays as in the last frame.
    stretched = off_line * distances < SETTINGS.tolerance * ((middles - root) ** 2).sum(axis=1)
    R_last = R_WT @ Rotation.from_euler(letters[:3], last[:3]).as_matrix()
    # The squared distance of root and end is base + swing cos(bend - start). Of its two solutions
    # (n, 2) those are kept that exceed the limits by about the least.
    axis = np.eye(3)[limb.axes[3]]
    aside = (limb.middle_U @ axis) * (limb.end_L @ axis)
    cosine = limb.middle_U @ limb.end_L - aside
    sine = limb.middle_U @ np.cross(axis, limb.end_L)
    a, b = limb.lengths
    base, swing = float(a * a + b * b + 2.0 * aside), 2.0 * math.hypot(cosine, sine)
    turns = np.arccos(np.clip((distances**2 - base) / swing, -1.0, 1.0))
    options = math.atan2(sine, cosine) + np.array([-1.0, 1.0]) * turns[:, None]
    options = np.remainder(options + math.pi, 2.0 * math.pi) - math.pi
    bends = np.clip(options, limb.lower[3], limb.upper[3])
    excess = np.abs(options - bends)
    row, option = np.nonzero(excess <= excess.min(axis=1, keepdims=True) + SETTINGS.bend_tolerance)
    bend = bends[row, option]
    end_U = limb.middle_U + Rotation.from_euler(letters[3], bend[:, None]).apply(limb.end_L)
    towards_U = _directions(np.zeros(3), end_U)[0]
    triads_U = _triads(towards_U, np.broadcast_to(limb.middle_U, end_U.shape))[0]
    R_WU = frames[row] @ triads_U.transpose(0, 2, 1)
    if stretched.any():
        is_straight = stretched[row]
        R_WU[is_straight] = (
            _smallest_rotations(towards_U[is_straight] @ R_last.T, towards[row[is_straight]])
            @ R_last
        )
    # Two sets of the root's angles give the same rotation: take the one nearer to the limits.
    first, second, third = Rotation.from_matrix(R_WT.T @ R_WU).as_euler(letters[:3]).T
    options = np.array(
        [[first, second, third], [first + math.pi, math.pi - second, third + math.pi]]
    ).transpose(0, 2, 1)
    options = np.remainder(options + math.pi, 2.0 * math.pi) - math.pi
    excess = np.abs(options - np.clip(options, limb.lower[:3], limb.upper[:3]))
    cost = excess.sum(axis=2) + 1e-3 * np.abs(options - last[:3]).sum(axis=2)
    better, each = np.argmin(cost, axis=0), np.arange(len(row))
    beyond = excess[better, each].max(axis=1)
    costs, beyonds = np.full(bends.shape, np.inf), np.zeros(bends.shape)
    roots = np.zeros((*bends.shape, 3))
    costs[row, option] = beyond + 1e-3 * np.abs(bend - last[3])
    roots[row, option], beyonds[row, option] = options[better, each], beyond
    chosen, each = np.argmin(costs, axis=1), np.arange(len(middles))
    return np.column_stack([roots[each, chosen], bends[each, chosen]]), beyonds[each, chosen]


def _directions(root: Array, ends: Array) -> tuple[Array, Array]:
    """Return directions (..., 3), down if undefined, and distances [m] of ends from a root."""
    across = ends - root
    distances = np.sqrt((across**2).sum(axis=-1))
    is_far = distances[..., None] > _TINY
    directions = across / np.where(is_far, distances[..., None], 1.0)
    return np.where(is_far, directions, [0.0, 0.0, -1.0]), distances


def _triads(x: Array, others: Array) -> tuple[Array, Array]:
    """Return right-handed axes in columns (n, 3, 3), the first along x, the second towards others.

    Also return the distances (n,) of the others' ends from the lines along x [m].

    Args:
        x: (n, 3) unit vectors.
        others: (n, 3) vectors [m]; of one along x, the second axis is any perpendicular one.
    """
    across = others - (others * x).sum(axis=1, keepdims=True) * x
    length = np.sqrt((across**2).sum(axis=1))
    straight = length < _TINY
    across[straight] = _perpendicular(x[straight])
    y = across / np.sqrt((across**2).sum(axis=1, keepdims=True))
    return np.stack([x, y, np.cross(x, y)], axis=2), length


def _smallest_rotations(starts: Array, ends: Array) -> Array:
    """Return the smallest rotations (n, 3, 3) that turn unit vectors (n, 3) into others (n, 3)."""
    quaternions = np.column_stack([np.cross(starts, ends), 1.0 + (starts * ends).sum(axis=1)])
    turned_about = np.sqrt((quaternions**2).sum(axis=1)) < _TINY
    quaternions[turned_about, :3] = _perpendicular(starts[turned_about])
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def _perpendicular(axes: Array) -> Array:
    """Return vectors (n, 3) perpendicular to axes (n, 3), not 0."""
    return np.cross(axes, np.eye(3)[np.argmin(np.abs(axes), axis=1)])
