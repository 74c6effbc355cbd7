"""Observing Shimada's two-finger hand in weak perspective, with the Jacobian: (9) to (13)."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from drake_pose.compiled import compiled, copy_into
from drake_pose.errors import SettingsError
from drake_pose.filtering.state import Belief, StateLayout

Array = NDArray[np.float64]

FINGERS, JOINTS = (1, 2), (1, 2, 3)
SPREADS = tuple(f"spread_{i}" for i in FINGERS)
FLEXIONS = tuple(f"flexion_{i}{j}" for i in FINGERS for j in JOINTS)
LENGTHS = tuple(f"length_{i}{j}" for i in FINGERS for j in JOINTS)
PALM = ("palm_width", "palm_height", "palm_thickness")
WRIST = ("wrist_x", "wrist_y")
QUATERNION = ("palm_qw", "palm_qx", "palm_qy", "palm_qz")

HAND_STATE = StateLayout((*WRIST, *QUATERNION, *SPREADS, *FLEXIONS), (*LENGTHS, *PALM))
"""The state (5): wrist in the image [pixel], quaternion, angles [rad]; rates; lengths [m]."""

MEASURED = (
    *WRIST,
    *(f"point_{i}{j}_{axis}" for i in FINGERS for j in (0, *JOINTS) for axis in "xy"),
    *(f"{kind}_{i}{j}" for i in FINGERS for j in JOINTS for kind in ("alpha", "rho")),
    *(f"{kind}_palm_{edge}" for edge in ("left", "right", "top") for kind in ("alpha", "rho")),
    "scale",
)
"""What is measured (13): points [pixel]; lines by angle [rad] and distance [pixel]; the scale."""

_FLEXIONS = HAND_STATE.indices(FLEXIONS).reshape(len(FINGERS), len(JOINTS))
_SEEN = HAND_STATE.indices((*WRIST, *QUATERNION, *SPREADS, *FLEXIONS, *LENGTHS, *PALM))

# Elements of the state that are seen, in the kernel's own order.
_WRIST, _QUATERNION, _SPREAD, _FLEXION, _LENGTH, _PALM = 0, 2, 6, 8, 14, 20
SEEN_ELEMENTS = 23
# A mirrored angle closer than this is the same [rad].
_SMALLEST_CHANGE = math.radians(8)
# wrist 2, points 8 x 2, finger lines 6 x 2, palm lines 3 x 2, scale 1
POINTS, FINGER_LINES, PALM_LINES, SCALE = 2, 18, 30, 36
MEASUREMENTS = 37


@dataclass(frozen=True)
class HandObservation:
    """The observation h of (13) for the state ``HAND_STATE``.

    Args:
        pixels_per_metre: of the image, for scale 1.
        point_deviation: noise of a joint, a fingertip or the wrist [pixel].
        angle_deviation, distance_deviation: noise of a line's alpha [rad] and rho [pixel].
        scale_deviation: of the scale, where it is known.
        shortest: a segment shorter than this in the image shows no axis [pixel].
        mirror_slope: (30) holds where a joint's turn moves its segment's end by less than this
            fraction of what it would move it in the image plane.
        mirror_reach: mirrored angles further from the prediction are not tried [deviations].

    Raises:
        SettingsError: a number that is not positive.
    """

    pixels_per_metre: float = 1000.0
    point_deviation: float = 0.5
    angle_deviation: float = math.radians(1.0)
    distance_deviation: float = 1.0
    scale_deviation: float = 1e-3
    shortest: float = 5.0
    mirror_slope: float = 0.35
    mirror_reach: float = 3.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < math.inf:
                raise SettingsError(f"{name} must be positive, not {value}")

    @cached_property
    def names(self) -> tuple[str, ...]:
        """What is measured."""
        return MEASURED

    @cached_property
    def variances(self) -> Array:
        """(37,) of the noise."""
        deviations = np.full(MEASUREMENTS, self.point_deviation)
        deviations[FINGER_LINES:SCALE:2] = self.angle_deviation
        deviations[FINGER_LINES + 1 : SCALE : 2] = self.distance_deviation
        deviations[SCALE] = self.scale_deviation
        return deviations**2

    @cached_property
    def wraps(self) -> NDArray[np.bool_]:
        """(37,) true for the angles."""
        return np.array([name.startswith("alpha") for name in MEASURED])

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Features (37,) of (13) and the scale ``|q|^2``, NaN for short axes; Jacobian (37, n)."""
        h, seen, _ = project_hand(x[_SEEN], self.pixels_per_metre, self.shortest)
        H = np.zeros((MEASUREMENTS, len(HAND_STATE)))
        H[:, _SEEN] = seen
        return h, H

    def drawing(self, x: Array) -> Array:
        """(14, 2) pixels: base, knuckles, tip of each finger; ends of the palm's three edges."""
        return project_hand(x[_SEEN], self.pixels_per_metre, self.shortest)[2]

    def mirrors(self, belief: Belief) -> list[Array]:
        """Predictions (n,) mirrored at the image plane in one joint, where (30) holds.

        A segment that points a little towards the camera looks like one that points as much away
        from it. Only the angle at its root is changed.
        """
        x = belief.mean
        reach = self.mirror_reach * np.sqrt(np.diag(belief.covariance)[_FLEXIONS])
        changes = mirror_changes(x[_SEEN], reach.ravel(), self.mirror_slope)
        found = []
        for index, change in zip(_FLEXIONS.ravel(), changes, strict=True):
            if change != 0.0:
                mirrored = x.copy()
                mirrored[index] += change
                found.append(mirrored)
        return found


def plant_positions(x: Array, names: tuple[str, ...], pixels_per_metre: float) -> Array:
    """(nq,) positions of ``urdf/two_finger_hand`` for a state (n,) as in ``HAND_STATE``.

    The palm's quaternion is normalised; its position is the wrist's pixel at scale 1, its depth 0.
    """
    value = dict(zip(HAND_STATE.names, x, strict=True))
    quaternion = np.array([value[name] for name in QUATERNION])
    value.update(zip(QUATERNION, quaternion / np.linalg.norm(quaternion), strict=True))
    value["palm_x"] = value["wrist_x"] / pixels_per_metre
    value["palm_y"] = value["wrist_y"] / pixels_per_metre
    value["palm_z"] = 0.0
    for i in FINGERS:
        value[f"base_height_{i}"] = value["palm_height"]
        value[f"base_side_{i}"] = 0.25 * value["palm_width"]
    return np.array([value[name] for name in names])


@compiled
def scaled_rotation(q: Array) -> tuple[Array, Array]:
    """The matrix ``|q|^2 R(q)`` (3, 3) of a quaternion (w, x, y, z), and its derivatives (4, 3, 3).

    A polynomial of second degree: the quaternion's squared norm is the scale.
    """
    w, x, y, z = q
    M = np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    D = np.empty((4, 3, 3))
    copy_into(D[0], 2 * np.array([[w, -z, y], [z, w, -x], [-y, x, w]]))
    copy_into(D[1], 2 * np.array([[x, y, z], [y, -x, -w], [z, w, -x]]))
    copy_into(D[2], 2 * np.array([[-y, x, w], [x, y, z], [-w, z, -y]]))
    copy_into(D[3], 2 * np.array([[-z, -w, x], [w, -z, y], [x, y, z]]))
    return M, D


@compiled
def _place(
    x: Array, M: Array, D: Array, p: Array, dp: Array, scale: float, out: Array, jacobian: Array
) -> None:
    """Project a point p (3) of the hand frame with derivatives dp (3, 23) into the image."""
    for a in range(2):
        out[a] = x[_WRIST + a]
        for c in range(3):
            out[a] += scale * M[a, c] * p[c]
        for e in range(SEEN_ELEMENTS):
            jacobian[a, e] = scale * (M[a, 0] * dp[0, e] + M[a, 1] * dp[1, e] + M[a, 2] * dp[2, e])
        jacobian[a, _WRIST + a] += 1.0
        for k in range(4):
            for c in range(3):
                jacobian[a, _QUATERNION + k] += scale * D[k, a, c] * p[c]


@compiled
def _line(
    start: Array, end: Array, d_start: Array, d_end: Array, shortest: float, h: Array, H: Array
) -> None:
    """Angle and signed distance from the origin of a line, (11) and (12), into h (2), H (2, 23)."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = math.sqrt(dx * dx + dy * dy)
    if length < shortest:
        h[:] = np.nan
        H[:] = 0.0
        return
    cosine, sine = dx / length, dy / length
    h[0] = math.atan2(dy, dx)
    h[1] = cosine * start[1] - sine * start[0]
    along = cosine * start[0] + sine * start[1]
    for e in range(SEEN_ELEMENTS):
        turn = (
            cosine * (d_end[1, e] - d_start[1, e]) - sine * (d_end[0, e] - d_start[0, e])
        ) / length
        H[0, e] = turn
        H[1, e] = cosine * d_start[1, e] - sine * d_start[0, e] - along * turn


@compiled
def _finger(
    x: Array, i: int, M: Array, D: Array, scale: float, points: Array, jacobians: Array
) -> None:
    """Base, two knuckles and tip of finger i (0 or 1): (9), (10)."""
    side = 1.0 if i == 0 else -1.0
    spread = x[_SPREAD + i]
    c, s = math.cos(spread), math.sin(spread)
    width, height = x[_PALM], x[_PALM + 1]
    local = np.array([height, 0.0, 0.25 * side * width])
    # Derivatives before the spread is applied.
    d_local = np.zeros((3, SEEN_ELEMENTS))
    d_local[0, _PALM + 1] = 1.0
    d_local[2, _PALM] = 0.25 * side
    p, dp = np.empty(3), np.empty((3, SEEN_ELEMENTS))
    psi = 0.0
    for j in range(4):
        if j > 0:
            psi += x[_FLEXION + 3 * i + j - 1]
            r = x[_LENGTH + 3 * i + j - 1]
            u, v = math.cos(psi), math.sin(psi)
            local[0] += r * u
            local[1] += r * v
            d_local[0, _LENGTH + 3 * i + j - 1] = u
            d_local[1, _LENGTH + 3 * i + j - 1] = v
            for k in range(j):
                d_local[0, _FLEXION + 3 * i + k] -= r * v
                d_local[1, _FLEXION + 3 * i + k] += r * u
        p[0] = c * local[0] + s * local[2]
        p[1] = local[1]
        p[2] = -s * local[0] + c * local[2]
        for e in range(SEEN_ELEMENTS):
            dp[0, e] = c * d_local[0, e] + s * d_local[2, e]
            dp[1, e] = d_local[1, e]
            dp[2, e] = -s * d_local[0, e] + c * d_local[2, e]
        dp[0, _SPREAD + i] += -s * local[0] + c * local[2]
        dp[2, _SPREAD + i] += -c * local[0] - s * local[2]
        _place(x, M, D, p, dp, scale, points[4 * i + j], jacobians[4 * i + j])


@compiled
def _palm(x: Array, M: Array, D: Array, scale: float, points: Array, jacobians: Array) -> None:
    """Ends of the three outer edges of the palm's box: its two sides and its top."""
    width, height, thickness = x[_PALM], x[_PALM + 1], x[_PALM + 2]
    # Across the palm's axis in the image, and along it: which face's edge lies outside.
    nx, ny = -M[1, 0], M[0, 0]
    wide = nx * M[0, 2] + ny * M[1, 2]
    deep = nx * M[0, 1] + ny * M[1, 1]
    side = 1.0 if wide * deep >= 0.0 else -1.0
    top = 1.0 if M[0, 0] * M[0, 1] + M[1, 0] * M[1, 1] >= 0.0 else -1.0
    corners = np.array(
        [
            [0.0, side, 1.0],
            [1.0, side, 1.0],
            [0.0, -side, -1.0],
            [1.0, -side, -1.0],
            [1.0, top, 1.0],
            [1.0, top, -1.0],
        ]
    )
    p, dp = np.empty(3), np.zeros((3, SEEN_ELEMENTS))
    for k in range(6):
        p[0] = corners[k, 0] * height
        p[1] = 0.5 * corners[k, 1] * thickness
        p[2] = 0.5 * corners[k, 2] * width
        dp[0, _PALM + 1] = corners[k, 0]
        dp[1, _PALM + 2] = 0.5 * corners[k, 1]
        dp[2, _PALM] = 0.5 * corners[k, 2]
        _place(x, M, D, p, dp, scale, points[8 + k], jacobians[8 + k])


@compiled
def project_hand(x: Array, scale: float, shortest: float) -> tuple[Array, Array, Array]:
    """All features of the hand.

    Args:
        x: (23,) wrist [pixel], quaternion, spreads, flexions [rad], lengths, palm sizes [m].
        scale: pixels per metre for a quaternion of norm 1.
        shortest: a line shorter than this in the image has no axis [pixel].

    Returns:
        h (37,) of (13), NaN for lines too short; H (37, 23); and the points drawn (14, 2): base,
        knuckles, tip of both fingers, and the ends of the palm's three edges.
    """
    M, D = scaled_rotation(x[_QUATERNION : _QUATERNION + 4])
    points, jacobians = np.empty((14, 2)), np.empty((14, 2, SEEN_ELEMENTS))
    for i in range(2):
        _finger(x, i, M, D, scale, points, jacobians)
    _palm(x, M, D, scale, points, jacobians)
    h, H = np.empty(MEASUREMENTS), np.zeros((MEASUREMENTS, SEEN_ELEMENTS))
    for a in range(2):
        h[a] = x[_WRIST + a]
        H[a, _WRIST + a] = 1.0
    for k in range(8):
        row = POINTS + 2 * k
        copy_into(h[row : row + 2], points[k])
        copy_into(H[row : row + 2], jacobians[k])
    for i in range(2):
        for j in range(3):
            k = 3 * i + j
            end, start = 4 * i + j + 1, 4 * i + j
            row = FINGER_LINES + 2 * k
            _line(
                points[start],
                points[end],
                jacobians[start],
                jacobians[end],
                shortest,
                h[row : row + 2],
                H[row : row + 2],
            )
    for k in range(3):
        row, start = PALM_LINES + 2 * k, 8 + 2 * k
        _line(
            points[start],
            points[start + 1],
            jacobians[start],
            jacobians[start + 1],
            shortest,
            h[row : row + 2],
            H[row : row + 2],
        )
    h[SCALE] = 0.0
    for k in range(4):
        h[SCALE] += x[_QUATERNION + k] ** 2
        H[SCALE, _QUATERNION + k] = 2.0 * x[_QUATERNION + k]
    return h, H, points


@compiled
def mirror_changes(x: Array, reach: Array, slope: float) -> Array:
    """What to add to each flexion so that its segment looks the same, mirrored in depth.

    Args:
        reach: (6,) larger changes are not wanted [rad].
        slope: nor segments whose end a turn moves by more than this, as a fraction of its length.

    Returns:
        (6,) [rad], 0 where there is nothing to mirror.
    """
    M, _ = scaled_rotation(x[_QUATERNION : _QUATERNION + 4])
    M /= (x[_QUATERNION : _QUATERNION + 4] ** 2).sum()
    changes = np.zeros(6)
    for i in range(2):
        c, s = math.cos(x[_SPREAD + i]), math.sin(x[_SPREAD + i])
        # Where the finger's plane points in the camera at flexions of 0 and of 90 degrees.
        forward, normal = c * M[:, 0] - s * M[:, 2], M[:, 1]
        towards_camera = math.atan2(normal[2], forward[2])
        direction = 0.0
        for j in range(3):
            direction += x[_FLEXION + 3 * i + j]
            u, v = math.cos(direction), math.sin(direction)
            if math.hypot(u * normal[0] - v * forward[0], u * normal[1] - v * forward[1]) > slope:
                continue
            change = 2 * (towards_camera - direction) + math.pi
            change -= 2 * math.pi * round(change / (2 * math.pi))
            if _SMALLEST_CHANGE < abs(change) < reach[3 * i + j]:
                changes[3 * i + j] = change
    return changes
