"""The two cameras: pinhole, and the parallel projection of Kameda's experiments."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from drake_pose.camera.checks import check_number, check_pose, check_side


class _PosedCamera:
    """What both cameras have: a name, a picture's size and principal point, and a pose."""

    name: str
    X_WC: np.ndarray

    def __post_init__(self) -> None:
        where = f"camera '{self.name}'"
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if field.name in ("width", "height"):
                value = check_side(value, field.name, where)
            elif field.name == "X_WC":
                value = check_pose(value, field.name, where)
            elif field.name != "name":
                positive = not field.name.startswith("center")
                value = check_number(value, field.name, where, positive=positive)
            object.__setattr__(self, field.name, value)

    @property
    def X_CW(self) -> np.ndarray:
        """(4, 4) the world's pose in the camera."""
        return inverse_pose(self.X_WC)

    def _in_camera(self, p_W: np.ndarray) -> np.ndarray:
        """Points (n, 3) of the world in the camera's frame."""
        X_CW = self.X_CW
        return np.asarray(p_W, dtype=np.float64).reshape(-1, 3) @ X_CW[:3, :3].T + X_CW[:3, 3]

    def with_pose(self: _Camera, X_WC: np.ndarray) -> _Camera:
        """Returns the same camera at another pose (4, 4)."""
        return dataclasses.replace(self, X_WC=X_WC)  # type: ignore[type-var]


_Camera = TypeVar("_Camera", bound=_PosedCamera)


@dataclass(frozen=True, eq=False)
class PinholeCamera(_PosedCamera):
    """A pinhole camera without distortion.

    Args:
        width, height, focal_x, focal_y: [pixel].
        center_x, center_y: the principal point [pixel], pixel centres at integers.
        X_WC: (4, 4) the camera's pose in the world, x right, y down, z forward [m]; read-only.
        near: the nearest visible depth [m].

    Raises CameraError: a parameter is not finite or out of its range, or X_WC is no rigid
    transform.
    """

    name: str
    width: int
    height: int
    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    X_WC: np.ndarray
    near: float = 0.01

    def project(self, p_W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points (n, 3) [m] to (n, 2) pixels, NaN where depth <= 0, and (n,) depths [m]."""
        p_C = self._in_camera(p_W)
        depth = p_C[:, 2]
        visible = np.where(depth > 0.0, depth, np.nan)
        u = self.center_x + self.focal_x * p_C[:, 0] / visible
        v = self.center_y + self.focal_y * p_C[:, 1] / visible
        return np.column_stack([u, v]), depth

    def resized(self, width: int, height: int) -> PinholeCamera:
        """Returns the camera of the same pictures at another size [pixel]."""
        x, y = width / self.width, height / self.height
        return dataclasses.replace(
            self,
            width=width,
            height=height,
            focal_x=x * self.focal_x,
            focal_y=y * self.focal_y,
            center_x=x * (self.center_x + 0.5) - 0.5,
            center_y=y * (self.center_y + 0.5) - 0.5,
        )

    def kernel_parameters(self) -> np.ndarray:
        """Returns (8,) kind (0: pinhole), f_x, f_y, c_x, c_y, near, width, height."""
        projection = [0.0, self.focal_x, self.focal_y, self.center_x, self.center_y, self.near]
        return np.array([*projection, self.width, self.height], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class ParallelCamera(_PosedCamera):
    """A camera of parallel rays (Kameda, Minoh and Ikeda, section 6: 2.26 pixels a centimetre).

    u = center_x + pixels_per_metre * x_C, v = center_y + pixels_per_metre * y_C; the other
    parameters, and what is raised, are those of a PinholeCamera.
    """

    name: str
    width: int
    height: int
    pixels_per_metre: float
    center_x: float
    center_y: float
    X_WC: np.ndarray

    def project(self, p_W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Projects points (n, 3) [m] of the world to (n, 2) pixels and (n,) depths [m]."""
        p_C = self._in_camera(p_W)
        uv = np.array([self.center_x, self.center_y]) + self.pixels_per_metre * p_C[:, :2]
        return uv, p_C[:, 2]

    def kernel_parameters(self) -> np.ndarray:
        """Returns (8,) kind (1: parallel), f_x, f_y, c_x, c_y, near (unused), width, height."""
        scale = self.pixels_per_metre
        projection = [1.0, scale, scale, self.center_x, self.center_y, 0.0]
        return np.array([*projection, self.width, self.height], dtype=np.float64)


Camera = PinholeCamera | ParallelCamera
"""A camera of either kind."""


def inverse_pose(X_AB: np.ndarray) -> np.ndarray:
    """Returns X_BA of a pose X_AB (4, 4)."""
    X_BA = np.eye(4)
    X_BA[:3, :3] = X_AB[:3, :3].T
    X_BA[:3, 3] = -X_AB[:3, :3].T @ X_AB[:3, 3]
    return X_BA
