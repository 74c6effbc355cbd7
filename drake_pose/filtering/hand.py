"""Observation of a hand in weak perspective, with its Jacobian: (9) to (13) of Shimada et al.

A point p in the palm's frame has the image wrist + s (M(q) p)_xy, where s is the number of pixels
per metre, q the palm's quaternion and M(q) = ``|q|^2`` R(q). M is a polynomial of degree two in q,
and the squared norm of q is the image scale.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.compiled import compiled, copy_into
from drake_pose.errors import require_positive
from drake_pose.filtering.hand_model import (
    QUATERNION,
    SEGMENT,
    TURN,
    TWO_FINGERS,
    Chains,
    HandModel,
)
from drake_pose.filtering.state import Belief

HAND_STATE, MEASURED = TWO_FINGERS.layout, TWO_FINGERS.measured
"""Layout of the two-finger hand's state, and names of its measurements."""
SPREADS, FLEXIONS, LENGTHS = TWO_FINGERS.spreads, TWO_FINGERS.flexions, TWO_FINGERS.lengths

_QUATERNION, _ANGLES = 2, 6


@dataclass(frozen=True)
class HandObservation:
    """The observation h of (13) for the state ``hand.layout``.

    Raises:
        SettingsError: a number is not positive.
    """

    pixels_per_metre: float = 1000.0  # Of the image at scale 1.
    point_deviation: float = 0.5  # Standard deviation of a joint, fingertip or the wrist [pixel].
    # angle_deviation, distance_deviation: standard deviation of a line's alpha [rad] and rho
    # [pixel].
    angle_deviation: float = math.radians(1.0)
    distance_deviation: float = 1.0
    # (30) holds if a joint's rotation moves its segment's end in the image by less than this
    # fraction of its motion in space.
    mirror_slope: float = 0.35
    # Mirrored angles closer to the original are skipped [rad].
    smallest_change: float = math.radians(8.0)
    # Mirrored angles farther from the prediction are skipped [standard deviations].
    mirror_reach: float = 3.0
    shortest: float = 5.0  # Segments shorter in the image have no line [pixel].
    scale_deviation: float = 1e-3  # Standard deviation of a known scale.
    # Number of frames in which the joints' prior counts as one measurement.
    prior_frames: float = 30.0
    hand: HandModel = field(default=TWO_FINGERS, repr=False)  # The hand's fingers and palm.

    def __post_init__(self) -> None:
        require_positive(**{name: value for name, value in vars(self).items() if name != "hand"})

    @cached_property
    def names(self) -> tuple[str, ...]:
        """(m) names of the measurements."""
        return self.hand.measured

    @cached_property
    def variances(self) -> Array:
        """(m,) variances of the measurement noise."""
        scale, prior = self.names.index("scale"), self.hand.prior
        lines = scale - 2 * len(self.hand.line_ends)
        deviations = np.full(len(self.names), self.point_deviation)
        deviations[lines:scale:2] = self.angle_deviation
        deviations[lines + 1 : scale : 2] = self.distance_deviation
        deviations[scale] = self.scale_deviation
        if prior is not None:
            deviations[scale + 1 :] = math.sqrt(self.prior_frames) * prior.deviation
        return deviations**2

    @cached_property
    def wraps(self) -> Mask:
        """(m,) which measurements are angles."""
        return np.array([name.startswith("alpha") for name in self.names])

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Return the measurements (m,) of (13), scale ``|q|^2`` and prior; and the Jacobian.

        The Jacobian is (m, n). Lines of short segments are NaN.
        """
        hand = self.hand
        h, visible, *_ = self._project(x)
        H = np.zeros((len(self.names), len(x)))
        H[: len(h), hand.visible] = visible
        if hand.prior is not None:
            H[len(h) :, hand.layout.indices(hand.angles)] = hand.prior.phi
            h = np.r_[h, H[len(h) :] @ x]
        return h, H

    def drawing(self, x: Array) -> Array:
        """Return the drawn points (p, 2) [pixel].

        These are base, joints and tip of each finger, then the ends of the palm's four edges.
        """
        return np.asarray(self._project(x)[2][:, :2])

    def _project(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """Return ``project_hand`` of a state x (n,)."""
        hand = self.hand
        return project_hand(x[hand.visible], hand.chains, self.pixels_per_metre, self.shortest)

    def mirrors(self, belief: Belief) -> list[Array]:
        """Return states (n,), each the belief's mean with one flexion mirrored at the image plane.

        A segment that points slightly towards the camera looks like one that points as much away
        from it. Only the angle at the segment's root changes. A joint is mirrored if its rotation
        moves the segment's end mostly in depth (``mirror_slope``) and its change is more than
        ``smallest_change`` [rad] and less than ``mirror_reach`` of its standard deviations.
        """
        hand, x, found = self.hand, belief.mean, []
        _, _, points, J = self._project(x)
        flexions = hand.layout.indices(hand.flexions)
        reaches = self.mirror_reach * belief.deviations()[flexions]
        starts, ends = hand.line_ends[: len(flexions)].T
        own = np.searchsorted(hand.visible, flexions)
        a = points[ends] - points[starts]
        b = J[ends, :, own] - J[starts, :, own]
        slopes = np.linalg.norm(b[:, :2], axis=1) / np.maximum(np.linalg.norm(b, axis=1), 1e-9)
        changes = 2.0 * np.arctan2(b[:, 2], a[:, 2]) + np.pi
        changes -= 2.0 * np.pi * np.round(changes / (2.0 * np.pi))
        can = (slopes <= self.mirror_slope) & (np.abs(changes) > self.smallest_change)
        for k in np.flatnonzero(can & (np.abs(changes) < reaches)):
            found.append(x.copy())
            found[-1][flexions[k]] += changes[k]
        return found


def plant_positions(
    x: Array, names: Sequence[str], pixels_per_metre: float, distance: float | None = None
) -> Array:
    """Return positions (nq,) of ``urdf/two_finger_hand`` for a state (n,) with layout HAND_STATE.

    Args:
        x: (n,) the state. Its quaternion is normalised.
        names: (nq) names of the plant's positions.
        pixels_per_metre: of the image at scale 1.
        distance: None: the palm's position is the wrist's image point at scale 1 and depth 0.
            Otherwise the distance of a pinhole camera on the z axis [m], in whose image the hand
            has the state's scale and wrist.
    """
    value = dict(zip(HAND_STATE.names, x, strict=True))
    quaternion = np.array([value[name] for name in QUATERNION])
    value.update(zip(QUATERNION, quaternion / np.linalg.norm(quaternion), strict=True))
    scale = 1.0 if distance is None else float(quaternion @ quaternion)
    value["palm_x"] = value["wrist_x"] / (scale * pixels_per_metre)
    value["palm_y"] = value["wrist_y"] / (scale * pixels_per_metre)
    value["palm_z"] = 0.0 if distance is None else distance * (1.0 / scale - 1.0)
    for i in TWO_FINGERS.fingers:
        value[f"base_height_{i}"] = value["palm_height"]
        value[f"base_side_{i}"] = 0.25 * value["palm_width"]
    return np.array([value[name] for name in names])


@compiled
def scaled_rotation(q: Array) -> tuple[Array, Array]:
    """Return ``|q|^2 R(q)`` (3, 3) of q = (w, x, y, z), and its derivatives (4, 3, 3) by q."""
    w, x, y, z = q
    D = np.empty((4, 3, 3))
    copy_into(D[0], 2 * np.array([[w, -z, y], [z, w, -x], [-y, x, w]]))
    copy_into(D[1], 2 * np.array([[x, y, z], [y, -x, -w], [z, w, -x]]))
    copy_into(D[2], 2 * np.array([[-y, x, w], [x, y, z], [-w, z, -y]]))
    copy_into(D[3], 2 * np.array([[-z, -w, x], [w, -z, y], [x, y, z]]))
    return 0.5 * (w * D[0] + x * D[1] + y * D[2] + z * D[3]), D


@compiled
def _place_finger(x: Array, chains: Chains, finger: int, p: Array, dp: Array) -> None:
    """Compute a finger's base and segment ends p (k, 3) and derivatives dp (k, 3, n): (9), (10).

    p and dp are written in place, in the palm's frame. dp must be 0 before.

    ``x``: (n,) as for ``project_hand``. ``finger``: index of the finger.
    """
    first, last = chains.firsts[finger], chains.firsts[finger + 1]
    R, origin, point = np.eye(3), np.zeros(3), 0
    axes, origins = np.zeros((last - first, 3)), np.zeros((last - first, 3))
    for s in range(first, last):
        kind, value, own = chains.kinds[s], x[chains.elements[s]], chains.vectors[s]
        v = np.zeros(3)
        for a in range(3):
            for b in range(3):
                v[a] += R[a, b] * own[b]
        copy_into(axes[s - first], v)
        copy_into(origins[s - first], origin)
        if kind == TURN:
            c, i = math.cos(value), math.sin(value)
            for b in range(3):
                # Rodrigues' formula, column by column.
                along = (1.0 - c) * (v[0] * R[0, b] + v[1] * R[1, b] + v[2] * R[2, b])
                r0, r1, r2 = R[0, b], R[1, b], R[2, b]
                R[0, b] = c * r0 + i * (v[1] * r2 - v[2] * r1) + along * v[0]
                R[1, b] = c * r1 + i * (v[2] * r0 - v[0] * r2) + along * v[1]
                R[2, b] = c * r2 + i * (v[0] * r1 - v[1] * r0) + along * v[2]
            continue
        for moved in range(2):
            if moved:
                origin += value * v
            elif point > 0:
                continue
            if kind != SEGMENT:
                continue
            # A point depends on all steps up to here.
            copy_into(p[point], origin)
            for k in range(first, s + moved):
                e, axis = chains.elements[k], axes[k - first]
                d0, d1, d2 = origin - origins[k - first]
                if chains.kinds[k] == TURN:
                    dp[point, 0, e] += axis[1] * d2 - axis[2] * d1
                    dp[point, 1, e] += axis[2] * d0 - axis[0] * d2
                    dp[point, 2, e] += axis[0] * d1 - axis[1] * d0
                else:
                    dp[point, :, e] += axis
            point += 1


@compiled
def _palm_ends(M: Array, chains: Chains, sizes: Array) -> Array:
    """Return the ends (8, 3) of the four PALM_EDGES in the image, two each, as fractions of sizes.

    Args:
        M: (3, 3) ``|q|^2 R(q)`` of the palm.
        sizes: (3,) height, thickness and width of the palm [m].
    """
    ends = np.zeros((8, 3))
    x, y = M[0, 0], M[1, 0]
    # Across the palm's axis in the image. The left edge is on the side of positive z.
    turned = 1.0 if x * M[1, 2] - y * M[0, 2] >= 0.0 else -1.0
    for k in range(4):
        side = turned if k < 2 else -turned
        best = -np.inf
        for fraction in chains.rings[k % 2]:
            across = 0.0
            for c in range(3):
                across += side * (x * M[1, c] - y * M[0, c]) * fraction[c] * sizes[c]
            if across > best:
                best = across
                copy_into(ends[k], fraction)
    for k in range(2):
        best, sign = -np.inf, 1.0 - 2.0 * k
        for row in chains.rows[k]:
            along = 0.0
            for c in range(3):
                middle = 0.5 * (row[0, c] + row[1, c]) * sizes[c]
                along += sign * (x * M[0, c] + y * M[1, c]) * middle
            if along > best:
                best = along
                copy_into(ends[4 + 2 * k], row[0])
                copy_into(ends[5 + 2 * k], row[1])
    return ends


@compiled
def project_hand(
    x: Array, chains: Chains, scale: float, shortest: float
) -> tuple[Array, Array, Array, Array]:
    """Project all features of the hand into the image.

    Args:
        x: (n,) the visible part of the state, in the order of ``HandModel.visible``.
        chains: the hand.
        scale: pixels per metre for a quaternion of norm 1.
        shortest: lines shorter in the image are NaN [pixel].

    Returns:
        h (m,) of (13) without the prior; its Jacobian (m, n); the points (p, 3) with z away from
            the camera: bases, joints and tips of the fingers and ends of the palm's four edges; and
            their derivatives (p, 3, n).
    """
    n, fingers, lines = len(x), len(chains.firsts) - 1, chains.lines
    M, D = scaled_rotation(x[_QUATERNION:_ANGLES])
    sizes = x[chains.palm]
    ends = _palm_ends(M, chains, sizes)
    on_fingers = lines[len(lines) - 4, 0]
    each = on_fingers // fingers
    p, dp = np.zeros((on_fingers + 8, 3)), np.zeros((on_fingers + 8, 3, n))
    for f in range(fingers):
        own = slice(f * each, (f + 1) * each)
        _place_finger(x, chains, f, p[own], dp[own])
    points, J = np.zeros(p.shape), np.zeros(dp.shape)
    for k in range(len(p)):
        if k >= on_fingers:
            for c in range(3):
                p[k, c] = ends[k - on_fingers, c] * sizes[c]
                dp[k, c, chains.palm[c]] = ends[k - on_fingers, c]
        for a in range(3):
            for c in range(3):
                points[k, a] += scale * M[a, c] * p[k, c]
                for e in range(n):
                    J[k, a, e] += scale * M[a, c] * dp[k, c, e]
                for q in range(4):
                    J[k, a, _QUATERNION + q] += scale * D[q, a, c] * p[k, c]
        for a in range(2):
            points[k, a] += x[a]
            J[k, a, a] += 1.0
    first = 2 + 2 * on_fingers
    h = np.zeros(first + 2 * len(lines) + 1)
    H = np.zeros((len(h), n))
    for a in range(2):
        h[a], H[a, a] = x[a], 1.0
        for k in range(on_fingers):
            h[2 + 2 * k + a] = points[k, a]
            copy_into(H[2 + 2 * k + a], J[k, a])
    for line in range(len(lines)):
        # Angle and signed distance from the origin: (11) and (12).
        row, start, end = first + 2 * line, lines[line, 0], lines[line, 1]
        u, v = points[start, 0], points[start, 1]
        dx, dy = points[end, 0] - u, points[end, 1] - v
        length = math.sqrt(dx * dx + dy * dy)
        if length < shortest:
            h[row], h[row + 1] = np.nan, np.nan
            continue
        dx, dy = dx / length, dy / length
        h[row], h[row + 1] = math.atan2(dy, dx), dx * v - dy * u
        for e in range(n):
            du, dv = J[start, 0, e], J[start, 1, e]
            turn = (dx * (J[end, 1, e] - dv) - dy * (J[end, 0, e] - du)) / length
            H[row, e] = turn
            H[row + 1, e] = dx * dv - dy * du - (dx * u + dy * v) * turn
    for q in range(_QUATERNION, _ANGLES):
        h[-1] += x[q] ** 2
        H[-1, q] = 2.0 * x[q]
    return h, H, points, J
