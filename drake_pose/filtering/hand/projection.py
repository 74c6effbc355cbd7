"""Shimada's two-finger hand in weak perspective, with its Jacobian: (9) to (13)."""

import math

import numpy as np
from numpy.typing import NDArray

from drake_pose.compiled import compiled, copy_into

Array = NDArray[np.float64]

# Elements of the state that are seen, in the kernel's own order.
WRIST, QUATERNION, SPREAD, FLEXION, LENGTH, PALM = 0, 2, 6, 8, 14, 20
SEEN_ELEMENTS = 23
# A mirrored angle closer than this is the same [rad].
_SMALLEST_CHANGE = math.radians(8)
# wrist 2, points 8 x 2, finger lines 6 x 2, palm lines 3 x 2, scale 1
POINTS, FINGER_LINES, PALM_LINES, SCALE = 2, 18, 30, 36
MEASUREMENTS = 37


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
        out[a] = x[WRIST + a]
        for c in range(3):
            out[a] += scale * M[a, c] * p[c]
        for e in range(SEEN_ELEMENTS):
            jacobian[a, e] = scale * (M[a, 0] * dp[0, e] + M[a, 1] * dp[1, e] + M[a, 2] * dp[2, e])
        jacobian[a, WRIST + a] += 1.0
        for k in range(4):
            for c in range(3):
                jacobian[a, QUATERNION + k] += scale * D[k, a, c] * p[c]


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
    spread = x[SPREAD + i]
    c, s = math.cos(spread), math.sin(spread)
    width, height = x[PALM], x[PALM + 1]
    local = np.array([height, 0.0, 0.25 * side * width])
    # Derivatives before the spread is applied.
    d_local = np.zeros((3, SEEN_ELEMENTS))
    d_local[0, PALM + 1] = 1.0
    d_local[2, PALM] = 0.25 * side
    p, dp = np.empty(3), np.empty((3, SEEN_ELEMENTS))
    psi = 0.0
    for j in range(4):
        if j > 0:
            psi += x[FLEXION + 3 * i + j - 1]
            r = x[LENGTH + 3 * i + j - 1]
            u, v = math.cos(psi), math.sin(psi)
            local[0] += r * u
            local[1] += r * v
            d_local[0, LENGTH + 3 * i + j - 1] = u
            d_local[1, LENGTH + 3 * i + j - 1] = v
            for k in range(j):
                d_local[0, FLEXION + 3 * i + k] -= r * v
                d_local[1, FLEXION + 3 * i + k] += r * u
        p[0] = c * local[0] + s * local[2]
        p[1] = local[1]
        p[2] = -s * local[0] + c * local[2]
        for e in range(SEEN_ELEMENTS):
            dp[0, e] = c * d_local[0, e] + s * d_local[2, e]
            dp[1, e] = d_local[1, e]
            dp[2, e] = -s * d_local[0, e] + c * d_local[2, e]
        dp[0, SPREAD + i] += -s * local[0] + c * local[2]
        dp[2, SPREAD + i] += -c * local[0] - s * local[2]
        _place(x, M, D, p, dp, scale, points[4 * i + j], jacobians[4 * i + j])


@compiled
def _palm(x: Array, M: Array, D: Array, scale: float, points: Array, jacobians: Array) -> None:
    """Ends of the three outer edges of the palm's box: its two sides and its top."""
    width, height, thickness = x[PALM], x[PALM + 1], x[PALM + 2]
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
        dp[0, PALM + 1] = corners[k, 0]
        dp[1, PALM + 2] = 0.5 * corners[k, 1]
        dp[2, PALM] = 0.5 * corners[k, 2]
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
    M, D = scaled_rotation(x[QUATERNION : QUATERNION + 4])
    points, jacobians = np.empty((14, 2)), np.empty((14, 2, SEEN_ELEMENTS))
    for i in range(2):
        _finger(x, i, M, D, scale, points, jacobians)
    _palm(x, M, D, scale, points, jacobians)
    h, H = np.empty(MEASUREMENTS), np.zeros((MEASUREMENTS, SEEN_ELEMENTS))
    for a in range(2):
        h[a] = x[WRIST + a]
        H[a, WRIST + a] = 1.0
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
        h[SCALE] += x[QUATERNION + k] ** 2
        H[SCALE, QUATERNION + k] = 2.0 * x[QUATERNION + k]
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
    M, _ = scaled_rotation(x[QUATERNION : QUATERNION + 4])
    M /= (x[QUATERNION : QUATERNION + 4] ** 2).sum()
    changes = np.zeros(6)
    for i in range(2):
        c, s = math.cos(x[SPREAD + i]), math.sin(x[SPREAD + i])
        # Where the finger's plane points in the camera at flexions of 0 and of 90 degrees.
        forward, normal = c * M[:, 0] - s * M[:, 2], M[:, 1]
        towards_camera = math.atan2(normal[2], forward[2])
        direction = 0.0
        for j in range(3):
            direction += x[FLEXION + 3 * i + j]
            u, v = math.cos(direction), math.sin(direction)
            if math.hypot(u * normal[0] - v * forward[0], u * normal[1] - v * forward[1]) > slope:
                continue
            change = 2 * (towards_camera - direction) + math.pi
            change -= 2 * math.pi * round(change / (2 * math.pi))
            if _SMALLEST_CHANGE < abs(change) < reach[3 * i + j]:
                changes[3 * i + j] = change
    return changes
