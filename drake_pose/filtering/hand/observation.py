"""Observing Shimada's two-finger hand: joints, fingertips, axes of segments, the palm's outline."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SettingsError
from drake_pose.filtering.hand import projection as kernel
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

_QUATERNION = HAND_STATE.indices(QUATERNION)
_SPREADS = HAND_STATE.indices(SPREADS)
_FLEXIONS = HAND_STATE.indices(FLEXIONS).reshape(len(FINGERS), len(JOINTS))
_SEEN = HAND_STATE.indices((*WRIST, *QUATERNION, *SPREADS, *FLEXIONS, *LENGTHS, *PALM))


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
        deviations = np.full(kernel.MEASUREMENTS, self.point_deviation)
        deviations[kernel.FINGER_LINES : kernel.SCALE : 2] = self.angle_deviation
        deviations[kernel.FINGER_LINES + 1 : kernel.SCALE : 2] = self.distance_deviation
        deviations[kernel.SCALE] = self.scale_deviation
        return deviations**2

    @cached_property
    def wraps(self) -> NDArray[np.bool_]:
        """(37,) true for the angles."""
        return np.array([name.startswith("alpha") for name in MEASURED])

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Features (37,) of (13) and the scale ``|q|^2``, NaN for short axes; Jacobian (37, n)."""
        h, seen, _ = kernel.project_hand(x[_SEEN], self.pixels_per_metre, self.shortest)
        H = np.zeros((kernel.MEASUREMENTS, len(HAND_STATE)))
        H[:, _SEEN] = seen
        return h, H

    def drawing(self, x: Array) -> Array:
        """(14, 2) pixels: base, knuckles, tip of each finger; ends of the palm's three edges."""
        return kernel.project_hand(x[_SEEN], self.pixels_per_metre, self.shortest)[2]

    def mirrors(self, belief: Belief) -> list[Array]:
        """Predictions (n,) mirrored at the image plane in one joint, where (30) holds.

        A segment that points a little towards the camera looks like one that points as much away
        from it. Only the angle at its root is changed.
        """
        x = belief.mean
        reach = self.mirror_reach * np.sqrt(np.diag(belief.covariance)[_FLEXIONS])
        changes = kernel.mirror_changes(x[_SEEN], reach.ravel(), self.mirror_slope)
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
