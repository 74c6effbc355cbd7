"""How the root of a pose tree may be turned, and how its rotations are sampled."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from drake_pose.body.limits import nearest_turn
from drake_pose.errors import SettingsError

Axis = Literal["x", "y", "z"]


@dataclass(frozen=True, eq=False)
class RootRotation:
    """The rotation R_WR of the root link R in the world W: fixed, limited, or free.

    The rotation's values are an array (k,): nothing when fixed; a rotation vector [rad] relative to
    R_W0 when free; one angle [rad] for each axis, in order of rotation, when limited:
    R_WR = R_W0 R(axis 1) R(axis 2) ...

    Attributes:
        R_W0: (3, 3) the rotation at values of zero, read-only.
        lower, upper: (k,) limits [rad], read-only.
        interval: sampling interval [rad]; None for the search's general one.
    """

    kind: Literal["fixed", "free", "limited"]
    R_W0: NDArray[np.float64]
    axes: tuple[Axis, ...]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    interval: float | None

    @staticmethod
    def fixed(rotation: ArrayLike | None = None) -> "RootRotation":
        """Always R_W0 (3, 3), by default the identity; SettingsError where that is no rotation."""
        return _root_rotation("fixed", (), [], rotation, None)

    @staticmethod
    def free(
        interval_deg: float | None = None, rotation: ArrayLike | None = None
    ) -> "RootRotation":
        """Any rotation, sampled evenly; R_W0 (3, 3) is one of the samples.

        Raises SettingsError for no rotation matrix, or an interval that is not positive.
        """
        return _root_rotation("free", (), [(-180.0, 180.0)] * 3, rotation, interval_deg)

    @staticmethod
    def limited(
        ranges_deg: Sequence[tuple[Axis, float, float]],
        *,
        rotation: ArrayLike | None = None,
        interval_deg: float | None = None,
    ) -> "RootRotation":
        """Rotations about one to three different axes, each within limits.

        Args:
            ranges_deg: (axis letter, lower, upper) [deg] in order of rotation, for example
                ``[("y", -180, 180), ("z", -10, 10)]``; each axis is the one already turned by
                those before it.
            rotation: R_W0 (3, 3); None for the identity.
            interval_deg: None for the search's general one.

        Raises SettingsError: repeated or unknown axes, crossed limits, or not a rotation matrix.
        """
        axes = tuple(axis for axis, _, _ in ranges_deg)
        if not axes or len(set(axes)) != len(axes) or not set(axes) <= {"x", "y", "z"}:
            raise SettingsError(
                f"root rotation axes {axes}: give one to three different of x, y, z"
            )
        for axis, lower, upper in ranges_deg:
            if not -360.0 <= lower <= upper <= 360.0:
                raise SettingsError(
                    f"root rotation axis {axis}: limits {lower:g}, {upper:g}: give the lower first,"
                    " in degrees between -360 and 360"
                )
        limits = [(low, high) for _, low, high in ranges_deg]
        return _root_rotation("limited", axes, limits, rotation, interval_deg)

    @property
    def value_names(self) -> tuple[str, ...]:
        """A name for each value."""
        if self.kind == "free":
            return ("root_rotation_x", "root_rotation_y", "root_rotation_z")
        return tuple(f"root_{axis}" for axis in self.axes)

    def rotations(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """R_WR (n, 3, 3) at values (n, k) [rad]."""
        if self.kind == "free":
            return self.R_W0 @ Rotation.from_rotvec(values).as_matrix()
        if self.kind == "limited":
            return self.R_W0 @ Rotation.from_euler("".join(self.axes).upper(), values).as_matrix()
        return np.broadcast_to(self.R_W0, (len(values), 3, 3)).copy()

    def values_from(self, R_WR: NDArray[np.float64]) -> NDArray[np.float64]:
        """The values (k,) [rad] of a rotation (3, 3), the nearest there are where it is limited."""
        rotation = Rotation.from_matrix(self.R_W0.T @ R_WR)
        if self.kind == "fixed":
            return np.zeros(0)
        if self.kind == "free":
            return np.asarray(rotation.as_rotvec())
        sequence = "".join(self.axes).upper()
        completed = sequence + "".join(axis for axis in "XYZ" if axis not in sequence)
        angles = np.asarray(rotation.as_euler(completed))[: len(sequence)]
        middle = 0.5 * (self.lower + self.upper)
        return nearest_turn(angles, middle, True)


def _root_rotation(
    kind: Literal["fixed", "free", "limited"],
    axes: tuple[Axis, ...],
    limits_deg: Sequence[tuple[float, float]],
    rotation: ArrayLike | None,
    interval_deg: float | None,
) -> RootRotation:
    """A RootRotation after checks, its arrays copied and read-only."""
    R = np.eye(3) if rotation is None else np.array(rotation, dtype=np.float64)
    orthonormal = R.shape == (3, 3) and np.allclose(R @ R.T, np.eye(3), atol=1e-6)
    if not orthonormal or np.linalg.det(R) < 0.0:
        raise SettingsError(f"root rotation {R.tolist()} is not a 3 x 3 rotation matrix")
    if interval_deg is not None and not 0.0 < interval_deg <= 180.0:
        raise SettingsError(
            f"root rotation interval {interval_deg:g} deg: give 0 < interval <= 180"
        )
    limits = np.radians(np.array(limits_deg, dtype=np.float64).reshape(-1, 2))
    for array in (R, limits):
        array.setflags(write=False)
    interval = None if interval_deg is None else math.radians(interval_deg)
    return RootRotation(kind, R, axes, limits[:, 0], limits[:, 1], interval)


def even_rotations(interval: float) -> NDArray[np.float64]:
    """Rotation vectors (n, 3) [rad] about ``interval`` [rad] apart, nearest to none first.

    Rz(azimuth) Ry(polar) Rz(turn - azimuth), with directions on circles of latitude and turns that
    are multiples of the interval; the samples hold the identity.
    """
    angles = []
    turns = _full_turn(2.0 * math.pi / interval)
    circles = max(1, round(math.pi / interval))
    for polar in np.linspace(0.0, math.pi, circles + 1):
        for azimuth in _full_turn(2.0 * math.pi * math.sin(polar) / interval):
            angles += [(azimuth, polar, turn - azimuth) for turn in turns]
    vectors = np.asarray(Rotation.from_euler("ZYZ", np.array(angles)).as_rotvec())
    order = np.argsort(np.round(np.linalg.norm(vectors, axis=1), 9), kind="stable")
    return vectors[order]


def _full_turn(count: float) -> NDArray[np.float64]:
    """About so many angles [rad] of a full turn, evenly spaced, zero first; at least one."""
    whole = max(1, round(count))
    return np.asarray(np.arange(whole) * (2.0 * math.pi / whole), dtype=np.float64)
