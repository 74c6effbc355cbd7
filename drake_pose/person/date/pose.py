"""A frame's pose the paper's way, from features, face and silhouettes (Date et al., section 4).

Inverse kinematics goes in small steps from the last frame's angles (4.1.1 and 4.2). Elbows and
knees are searched on circles by back-projection into the silhouettes (4.1.2 and 4.2).
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
    """Step sizes and tolerances of the inverse kinematics and of the search on circles.

    Args:
        largest_step: of any angle in a step [rad].
        damping: of a step's normal equations [m^2].
        reached, stalled: a point is at its target below the first distance [m]; a search ends
            where no angle moves by more than the second [rad].
        steps, steps_per_turn: at most in all; and before the other arm has its turn.
        least_bend: a middle joint is bent by this much first, else no small step can help [rad].
        elbow_range, knee_range: angles on the circle [deg]. An elbow's go from behind over outwards
            to a little in front. A knee's are 0 in front and positive outwards, as far as the hip
            can turn; a straight leg's knee lies behind, as the leg ends at the foot's middle.
        circle_step: between two places that are compared [deg].
        bend_tolerance, hip_tolerance: how far beyond its limits a straight limb's middle joint, or
            a hip, may seem to be: the trunk's direction is measured, too [rad].
        along, across: points of a rectangle in either direction.
        head_fraction: the head's share in the waist's height (4.2), the feet have the rest.
    """

    largest_step: float = math.radians(2.0)
    damping: float = 0.05**2
    reached: float = 1e-3
    stalled: float = 1e-4
    steps: int = 100
    steps_per_turn: int = 4
    least_bend: float = math.radians(3.0)
    elbow_range: tuple[float, float] = (0.0, 120.0)
    knee_range: tuple[float, float] = (-180.0, 175.0)
    circle_step: float = 5.0
    bend_tolerance: float = math.radians(3.0)
    hip_tolerance: float = math.radians(10.0)
    along: int = 12
    across: int = 5
    head_fraction: float = 0.55


SETTINGS = PoseSettings()

# Below this a length [m], or a direction's component, counts as 0.
_TINY = 1e-9


def upper_body(skeleton: Skeleton, q: Array, features: Array, *, face_known: bool) -> Array:
    """Moves neck base and arms from q (nq,), in place at the head, to hands of features (5, 3) [m].

    Each side's chain is head 2, neck base 2, shoulder 3, elbow 1. Both sides share head and neck
    base, so they take turns, a few small steps each. A known face's head angles stay; legs, too.
    """
    shared = () if face_known else skeleton.head_angles
    for name in LIMBS[:2]:
        q = _bent(q, skeleton.limbs[name])
    for _ in range(SETTINGS.steps // SETTINGS.steps_per_turn):
        farthest, moved = 0.0, 0.0
        for name, hand in zip(LIMBS[:2], features[1:3], strict=True):
            limb, before = skeleton.limbs[name], q
            index = np.array([*shared, *skeleton.neck_angles, *limb.positions])
            part = limb.lower_node, limb.end_L
            q, distance = reach(skeleton, q, index, part, hand, SETTINGS.steps_per_turn)
            farthest = max(farthest, distance)
            moved = max(moved, float(np.abs(q - before).max()))
        # One side's turn may have moved the other's hand: only a round without steps is the end.
        if moved < SETTINGS.stalled or max(farthest, moved) < SETTINGS.reached:
            break
    return q


def move_limb(skeleton: Skeleton, q: Array, name: str, target: Array) -> Array:
    """Moves a limb of q (nq,) until its end is at a target (3,) [m]; all else stays."""
    limb = skeleton.limbs[name]
    part = limb.lower_node, limb.end_L
    return reach(skeleton, _bent(q, limb), limb.positions, part, target)[0]


def _bent(q: Array, limb: Limb) -> Array:
    """Positions with a limb's middle joint bent at least a little."""
    q, least = np.array(q), SETTINGS.least_bend
    if abs(q[limb.positions[3]]) < least:
        q[limb.positions[3]] = least if limb.upper[3] > -limb.lower[3] else -least
    return q


def reach(
    skeleton: Skeleton,
    q: Array,
    index: Indices,
    part: tuple[int, Array],
    target: Array,
    steps: int = SETTINGS.steps,
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
    numbers = SETTINGS.damping, SETTINGS.largest_step, SETTINGS.reached, SETTINGS.stalled
    moved[order], distance = _reach(
        packed, q[order], place[index], point, limits, target, steps, numbers
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
    """As reach, of the values (m,) of a chain whose last node moves the point."""
    damping, largest_step, reached, stalled = numbers
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
        if distance < reached or step == steps:
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
        share = min(1.0, largest_step / max(1e-12, np.abs(changes).max()))
        moved = 0.0
        for k in range(n):
            old = values[index[k]]
            new = min(max(old + share * changes[k], limits[0][k]), limits[1][k])
            moved, values[index[k]] = max(moved, abs(new - old)), new
        if moved < stalled:
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
    waist: Array | None = None,
) -> tuple[Array, dict[str, Array]]:
    """Estimates a frame's pose the paper's way.

    Args:
        last: (nq,) the last frame's positions.
        features: (5, 3) head, hands and feet in the order of FEATURES [m].
        head_angles: (2,) [rad] where the face was seen; None: the last frame's, free to move.
        cameras, regions: those on the circle, and (H, W) the person in each of their pictures.
        search: whether elbows and knees are searched on their circles, or stay where inverse
            kinematics puts them.
        waist: (3,) half-way between the hips [m]; None: by the paper's formula, below the head.

    Returns:
        (nq,) positions inside their limits; and by limb (3, 3) shoulder, elbow and hand, or hip,
        knee and foot, as found [m].
    """
    q = np.array(last, dtype=np.float64)
    if head_angles is not None:
        index = skeleton.head_angles
        q[index] = np.clip(head_angles, skeleton.lower[index], skeleton.upper[index])
    q[skeleton.head_positions] = features[0] - skeleton.head_rotation(q) @ skeleton.face_H
    q = upper_body(skeleton, q, features, face_known=head_angles is not None)
    # Where the head's angles moved, its middle must still be where it was measured.
    q[skeleton.head_positions] = features[0] - skeleton.head_rotation(q) @ skeleton.face_H
    if waist is None:
        feet = 0.5 * (features[4, 2] + features[3, 2])
        share = SETTINGS.head_fraction
        waist = np.array([*features[0, :2], share * features[0, 2] + (1.0 - share) * feet])
    # The model's trunk is one piece: it cannot hold shoulders and waist found apart. For its
    # positions the waist counts; so the neck's base cannot wander off from frame to frame either.
    _, neck = skeleton.trunk_pose(q)
    across, length = waist - neck, float(np.linalg.norm(skeleton.waist_T))
    target = neck + across * (length / max(float(np.linalg.norm(across)), SETTINGS.reached))
    trunk = skeleton.nodes["trunk"], skeleton.waist_T
    aimed, _ = reach(skeleton, q, skeleton.neck_angles, trunk, target)
    R_aimed, _ = skeleton.trunk_pose(aimed)
    limbs = {}
    for name, end in zip(LIMBS, features[1:], strict=True):
        limb, posed, off = skeleton.limbs[name], q, np.zeros(3)
        R_WT, own_root = skeleton.trunk_pose(q)[0], skeleton.limb_points(aimed, name)[0]
        outward, last_angles = R_WT @ limb.root_T, q[limb.positions]
        if limb.is_leg:
            # It hangs on the waist that was found, not on the model's.
            R_WT, outward = R_aimed, R_aimed @ (limb.root_T - skeleton.waist_T)
            off = waist + outward - own_root
            posed = move_limb(skeleton, aimed, name, end - off)
        found = skeleton.limb_points(posed, name) + off
        found[2] = end
        if search:
            # Where elbow or knee agree best with the silhouettes; a knee is only where the hip can
            # turn it. Of equally good places the one nearest to inverse kinematics's is taken.
            low, high = SETTINGS.knee_range if limb.is_leg else SETTINGS.elbow_range
            degrees = np.arange(low, high + 0.5 * SETTINGS.circle_step, SETTINGS.circle_step)
            middles = joint_circle(limb, found[0], end, outward, degrees)
            if limb.is_leg:
                _, beyond = place_limb(limb, R_WT, found[0], middles, end, last_angles)
                middles = middles[beyond <= np.maximum(SETTINGS.hip_tolerance, beyond.min())]
            samples = rectangles(found[0], middles, end, limb.half_widths)
            scores = correlation(samples, cameras, regions)
            best = middles[scores >= scores.max() - _TINY]
            found[1] = best[np.argmin(np.linalg.norm(best - found[1], axis=1))]
        angles, _ = place_limb(limb, R_aimed, own_root, found[1:2], found[2], last_angles)
        aimed[limb.positions] = np.clip(angles[0], limb.lower, limb.upper)
        # Where limits forbid that, the hand or foot counts more than the elbow or knee.
        aimed = move_limb(skeleton, aimed, name, found[2])
        limbs[name] = found
    return skeleton.clip(aimed), limbs


def joint_circle(limb: Limb, root: Array, end: Array, outward: Array, degrees: Array) -> Array:
    """Places (n, 3) of an elbow or knee between root and end (3,), at angles (n,) on its circle.

    A place is center + radius (sin(theta) i + cos(theta) j) [m]. i is the direction in the circle's
    plane that agrees best with the horizontal part of `outward` (3,), from neck base to shoulder or
    waist to hip; j = i x z for the left arm, z from shoulder to hand (for the right arm and for
    legs mirrored, to point behind the arm and in front of the leg). Beyond its reach the limb is
    stretched out, or folded, in proportion.
    """
    z, distance = _along(root, end)
    a, b = limb.lengths
    reached = np.clip(distance, max(abs(a - b), _TINY), a + b)
    along = (a * a - b * b + reached * reached) / (2.0 * reached)
    radius = np.sqrt(np.maximum(0.0, a * a - along * along))
    level = np.array([outward[0], outward[1], 0.0])
    i = level - (level @ z) * z
    if np.linalg.norm(i) < _TINY:
        i = _any_across(z[None])[0]
    i = i / np.linalg.norm(i)
    j = limb.side * np.cross(i, z) * (-1.0 if limb.is_leg else 1.0)
    theta = np.radians(degrees)[:, None]
    center = root + along * distance / reached * z
    return np.asarray(center + radius * (np.sin(theta) * i + np.cos(theta) * j))


def rectangles(root: Array, middles: Array, end: Array, half_widths: Array) -> Array:
    """Points (n, m, 3) [m] of a limb's rectangles, from root (3,) over n middles (n, 3) to end.

    They lie in the plane of the three joints and are so wide as half_widths (2,) says [m].
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
    """C (n,): the share of samples (n, m, 3) inside silhouettes, where cameras see somebody."""
    total, seers, weights = np.zeros(len(samples)), 0, np.ones(samples.shape[:2])
    for camera, region in zip(cameras, regions, strict=True):
        if region.any():
            inside, seen = sum_at_points(camera, region.view(np.int8), samples, weights)
            total += inside / np.maximum(seen, 1.0)
            seers += 1
    return total / max(1, seers)


def place_limb(
    limb: Limb, R_WT: Array, root: Array, middles: Array, end: Array, last: Array
) -> tuple[Array, Array]:
    """The joint angles that put a limb's joints where they are, for several places of the middle.

    A nearly straight limb may be as long when bent a little: limits decide.

    Args:
        R_WT: (3, 3) the trunk's axes in the world.
        root, middles, end: (3,), (n, 3) and (3,) [m].
        last: (4,) angles to stay near where several sets do the same [rad].

    Returns:
        (n, 4) angles, and (n,) by how much the worst of its root's lies beyond its limits [rad].
    """
    letters = "".join("XYZ"[axis] for axis in limb.axes)
    towards, distances = _along(root, np.broadcast_to(end, middles.shape))
    frames, off_line = _triads(towards, middles - root)
    # Stretched it does not tell how it is turned about itself: as in the last frame.
    stretched = off_line * distances < SETTINGS.reached * ((middles - root) ** 2).sum(axis=1)
    R_last = R_WT @ Rotation.from_euler(letters[:3], last[:3]).as_matrix()
    # The squared distance of root and end is base + swing cos(bend - start), so there are two
    # bends (n, 2): those inside limits, or about as near as the other one.
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
    off = np.abs(options - bends)
    row, option = np.nonzero(off <= off.min(axis=1, keepdims=True) + SETTINGS.bend_tolerance)
    bend = bends[row, option]
    end_U = limb.middle_U + Rotation.from_euler(letters[3], bend[:, None]).apply(limb.end_L)
    towards_U = _along(np.zeros(3), end_U)[0]
    own = _triads(towards_U, np.broadcast_to(limb.middle_U, end_U.shape))[0]
    R_WU = frames[row] @ own.transpose(0, 2, 1)
    if stretched.any():
        still = stretched[row]
        R_WU[still] = _least_turns(towards_U[still] @ R_last.T, towards[row[still]]) @ R_last
    # The root's two sets of angles for a rotation: the one that is less beyond the limits.
    first, second, third = Rotation.from_matrix(R_WT.T @ R_WU).as_euler(letters[:3]).T
    options = np.array(
        [[first, second, third], [first + math.pi, math.pi - second, third + math.pi]]
    ).transpose(0, 2, 1)
    options = np.remainder(options + math.pi, 2.0 * math.pi) - math.pi
    off = np.abs(options - np.clip(options, limb.lower[:3], limb.upper[:3]))
    cost = off.sum(axis=2) + 1e-3 * np.abs(options - last[:3]).sum(axis=2)
    better, each = np.argmin(cost, axis=0), np.arange(len(row))
    beyond = off[better, each].max(axis=1)
    costs, beyonds = np.full(bends.shape, np.inf), np.zeros(bends.shape)
    roots = np.zeros((*bends.shape, 3))
    costs[row, option] = beyond + 1e-3 * np.abs(bend - last[3])
    roots[row, option], beyonds[row, option] = options[better, each], beyond
    chosen, each = np.argmin(costs, axis=1), np.arange(len(middles))
    return np.column_stack([roots[each, chosen], bends[each, chosen]]), beyonds[each, chosen]


def _along(root: Array, ends: Array) -> tuple[Array, Array]:
    """Directions (..., 3) from root to ends (..., 3), downwards where they are one, and distances.

    Distances (...) are in m.
    """
    across = ends - root
    distances = np.sqrt((across**2).sum(axis=-1))
    is_far = distances[..., None] > _TINY
    ways = across / np.where(is_far, distances[..., None], 1.0)
    return np.where(is_far, ways, [0.0, 0.0, -1.0]), distances


def _triads(x: Array, others: Array) -> tuple[Array, Array]:
    """(n, 3, 3) axes: x (n, 3) of length 1, then what of the others (n, 3) is across; how much."""
    across = others - (others * x).sum(axis=1, keepdims=True) * x
    length = np.sqrt((across**2).sum(axis=1))
    straight = length < _TINY
    across[straight] = _any_across(x[straight])
    y = across / np.sqrt((across**2).sum(axis=1, keepdims=True))
    return np.stack([x, y, np.cross(x, y)], axis=2), length


def _least_turns(ones: Array, others: Array) -> Array:
    """The least rotations (n, 3, 3) from directions (n, 3) to others (n, 3)."""
    quaternions = np.column_stack([np.cross(ones, others), 1.0 + (ones * others).sum(axis=1)])
    turned_about = np.sqrt((quaternions**2).sum(axis=1)) < _TINY
    quaternions[turned_about, :3] = _any_across(ones[turned_about])
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def _any_across(axes: Array) -> Array:
    """Any vectors (n, 3) across axes (n, 3), not 0."""
    return np.cross(axes, np.eye(3)[np.argmin(np.abs(axes), axis=1)])
