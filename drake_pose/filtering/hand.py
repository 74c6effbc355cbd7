"""Observing Shimada's two-finger hand in weak perspective, with the Jacobian: (9) to (13).

A point p of the hand's frame is seen at wrist + s (M(q) p)_xy, where M = ``|q|^2`` R(q) is a
polynomial of second degree: the quaternion's squared norm is the scale.
"""

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
PALM_EDGES = ("left", "right", "top", "bottom")

HAND_STATE = StateLayout((*WRIST, *QUATERNION, *SPREADS, *FLEXIONS), (*LENGTHS, *PALM))
"""The state (5): wrist in the image [pixel], quaternion, angles [rad]; rates; lengths [m]."""

MEASURED = (
    *WRIST,
    *(f"point_{i}{j}_{axis}" for i in FINGERS for j in (0, *JOINTS) for axis in "xy"),
    *(f"{kind}_{i}{j}" for i in FINGERS for j in JOINTS for kind in ("alpha", "rho")),
    *(f"{kind}_palm_{edge}" for edge in PALM_EDGES for kind in ("alpha", "rho")),
    "scale",
)
"""What is measured (13): points [pixel]; lines by angle [rad] and distance [pixel]; the scale."""

_FLEXIONS = HAND_STATE.indices(FLEXIONS).reshape(len(FINGERS), len(JOINTS))
# What is seen, in the kernel's own order, and where its parts begin there.
SEEN = HAND_STATE.indices((*WRIST, *QUATERNION, *SPREADS, *FLEXIONS, *LENGTHS, *PALM))
_QUATERNION, _SPREAD, _FLEXION, _LENGTH, _PALM = 2, 6, 8, 14, 20
# A mirrored angle closer than this is the same [rad].
_SMALLEST_CHANGE = math.radians(8)
# Where lines and the scale stand among MEASURED.
_LINES, _SCALE = MEASURED.index("alpha_11"), MEASURED.index("scale")
LINE_STARTS = np.array([0, 1, 2, 4, 5, 6, 8, 10, 12, 14])
LINE_ENDS = np.array([1, 2, 3, 5, 6, 7, 9, 11, 13, 15])
"""Between which of the points drawn the lines are: six of fingers, four of the palm."""


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
        """(39,) of the noise."""
        deviations = np.full(len(MEASURED), self.point_deviation)
        deviations[_LINES:_SCALE:2] = self.angle_deviation
        deviations[_LINES + 1 : _SCALE : 2] = self.distance_deviation
        deviations[_SCALE] = self.scale_deviation
        return deviations**2

    @cached_property
    def wraps(self) -> NDArray[np.bool_]:
        """(39,) true for the angles."""
        return np.array([name.startswith("alpha") for name in MEASURED])

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Features (39,) of (13) and the scale ``|q|^2``, NaN for short axes; Jacobian (39, n)."""
        h, seen, _ = project_hand(x[SEEN], self.pixels_per_metre, self.shortest)
        H = np.zeros((len(MEASURED), len(HAND_STATE)))
        H[:, SEEN] = seen
        return h, H

    def drawing(self, x: Array) -> Array:
        """(16, 2) pixels: base, knuckles, tip of each finger; ends of the palm's four edges."""
        return project_hand(x[SEEN], self.pixels_per_metre, self.shortest)[2]

    def mirrors(self, belief: Belief) -> list[Array]:
        """Predictions (n,) mirrored at the image plane in one joint, where (30) holds.

        A segment that points a little towards the camera looks like one that points as much away
        from it. Only the angle at its root is changed.
        """
        x, found = belief.mean, []
        quaternion, spreads = x[SEEN[_QUATERNION:_SPREAD]], x[SEEN[_SPREAD:_FLEXION]].tolist()
        M = scaled_rotation(quaternion)[0] / (quaternion @ quaternion)
        reaches = self.mirror_reach * np.sqrt(np.diag(belief.covariance)[_FLEXIONS])
        normal = M[:, 1].tolist()
        for spread, flexions, own in zip(spreads, _FLEXIONS, reaches.tolist(), strict=True):
            # Where the finger's plane points in the camera at flexions of 0 and of 90 degrees.
            forward = (math.cos(spread) * M[:, 0] - math.sin(spread) * M[:, 2]).tolist()
            direction = 0.0
            for index, reach in zip(flexions.tolist(), own, strict=True):
                direction += float(x[index])
                u, v = math.cos(direction), math.sin(direction)
                moved = math.hypot(*(u * normal[k] - v * forward[k] for k in range(2)))
                change = 2.0 * (math.atan2(normal[2], forward[2]) - direction) + math.pi
                change -= 2.0 * math.pi * round(change / (2.0 * math.pi))
                if moved <= self.mirror_slope and _SMALLEST_CHANGE < abs(change) < reach:
                    found.append(x.copy())
                    found[-1][index] += change
        return found


def plant_positions(
    x: Array, names: tuple[str, ...], pixels_per_metre: float, distance: float | None = None
) -> Array:
    """(nq,) positions of ``urdf/two_finger_hand`` for a state (n,) as in ``HAND_STATE``.

    The palm's quaternion is normalised; its position is the wrist's pixel at scale 1, its depth 0:
    or, before a pinhole so far away on the z axis [m], where its scale and the wrist are seen.
    """
    value = dict(zip(HAND_STATE.names, x, strict=True))
    quaternion = np.array([value[name] for name in QUATERNION])
    value.update(zip(QUATERNION, quaternion / np.linalg.norm(quaternion), strict=True))
    scale = 1.0 if distance is None else float(quaternion @ quaternion)
    value["palm_x"] = value["wrist_x"] / (scale * pixels_per_metre)
    value["palm_y"] = value["wrist_y"] / (scale * pixels_per_metre)
    value["palm_z"] = 0.0 if distance is None else distance * (1.0 / scale - 1.0)
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
    D = np.empty((4, 3, 3))
    copy_into(D[0], 2 * np.array([[w, -z, y], [z, w, -x], [-y, x, w]]))
    copy_into(D[1], 2 * np.array([[x, y, z], [y, -x, -w], [z, w, -x]]))
    copy_into(D[2], 2 * np.array([[-y, x, w], [x, y, z], [-w, z, -y]]))
    copy_into(D[3], 2 * np.array([[-z, -w, x], [w, -z, y], [x, y, z]]))
    return 0.5 * (w * D[0] + x * D[1] + y * D[2] + z * D[3]), D


@compiled
def _place_finger(x: Array, i: int, count: int, p: Array, dp: Array) -> None:
    """The end p (3,) of so many joints of finger i (0 or 1), and derivatives (3, 23): (9), (10)."""
    c, s = math.cos(x[_SPREAD + i]), math.sin(x[_SPREAD + i])
    width, height, side = x[_PALM], x[_PALM + 1], 0.25 - 0.5 * i
    p[0], p[2] = c * height + s * side * width, c * side * width - s * height
    dp[0, _PALM], dp[2, _PALM] = s * side, c * side
    dp[0, _PALM + 1], dp[2, _PALM + 1] = c, -s
    psi = 0.0
    for j in range(3 * i, 3 * i + count):
        psi += x[_FLEXION + j]
        u, v, r = math.cos(psi), math.sin(psi), x[_LENGTH + j]
        p[0] += r * u * c
        p[1] += r * v
        p[2] -= r * u * s
        dp[0, _LENGTH + j], dp[1, _LENGTH + j], dp[2, _LENGTH + j] = u * c, v, -u * s
        for k in range(_FLEXION + 3 * i, _FLEXION + j + 1):
            dp[0, k] -= r * v * c
            dp[1, k] += r * u
            dp[2, k] += r * v * s
    # The spread turns all about the palm's y axis.
    dp[0, _SPREAD + i], dp[2, _SPREAD + i] = p[2], -p[0]


@compiled
def _palm_ends(M: Array) -> Array:
    """(8, 3) ends of the outer edges of the palm's box, PALM_EDGES, as shares of its size.

    Of height, thickness and width, along the hand's x, y and z.
    """
    # Across the palm's axis in the image, and along it: which face's edge lies outside.
    wide = M[0, 0] * M[1, 2] - M[1, 0] * M[0, 2]
    deep = M[0, 0] * M[1, 1] - M[1, 0] * M[0, 1]
    side = 0.5 if wide * deep >= 0.0 else -0.5
    top = 0.5 if M[0, 0] * M[0, 1] + M[1, 0] * M[1, 1] >= 0.0 else -0.5
    return np.array(
        [
            [0.0, side, 0.5],
            [1.0, side, 0.5],
            [0.0, -side, -0.5],
            [1.0, -side, -0.5],
            [1.0, top, 0.5],
            [1.0, top, -0.5],
            [0.0, -top, 0.5],
            [0.0, -top, -0.5],
        ]
    )


@compiled
def project_hand(x: Array, scale: float, shortest: float) -> tuple[Array, Array, Array]:
    """All features of the hand.

    Args:
        x: (23,) wrist [pixel], quaternion, spreads, flexions [rad], lengths, palm sizes [m].
        scale: pixels per metre for a quaternion of norm 1.
        shortest: a line shorter than this in the image has no axis [pixel].

    Returns:
        h (39,) of (13), NaN for lines too short; H (39, 23); and the points drawn (16, 2): base,
        knuckles, tip of both fingers, and the ends of the palm's four edges.
    """
    n = len(x)
    M, D = scaled_rotation(x[_QUATERNION:_SPREAD])
    ends = _palm_ends(M)
    points, J = np.zeros((16, 2)), np.zeros((16, 2, n))
    for k in range(16):
        p, dp = np.zeros(3), np.zeros((3, n))
        if k < 8:
            _place_finger(x, k // 4, k % 4, p, dp)
        for c in range(3):
            if k >= 8:
                size = _PALM + (c + 1) % 3
                p[c], dp[c, size] = ends[k - 8, c] * x[size], ends[k - 8, c]
            for a in range(2):
                points[k, a] += scale * M[a, c] * p[c]
                for e in range(n):
                    J[k, a, e] += scale * M[a, c] * dp[c, e]
                for q in range(4):
                    J[k, a, _QUATERNION + q] += scale * D[q, a, c] * p[c]
        for a in range(2):
            points[k, a] += x[a]
            J[k, a, a] += 1.0
    h, H = np.zeros(_SCALE + 1), np.zeros((_SCALE + 1, n))
    for a in range(2):
        h[a], H[a, a] = x[a], 1.0
        for k in range(8):
            h[2 + 2 * k + a] = points[k, a]
            copy_into(H[2 + 2 * k + a], J[k, a])
    for line in range(len(LINE_STARTS)):
        # Angle and signed distance from the origin: (11) and (12).
        row, start, end = _LINES + 2 * line, LINE_STARTS[line], LINE_ENDS[line]
        u, v = points[start]
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
    for q in range(_QUATERNION, _SPREAD):
        h[_SCALE] += x[q] ** 2
        H[_SCALE, q] = 2.0 * x[q]
    return h, H, points
