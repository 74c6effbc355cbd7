"""The two cameras: pinhole, and the parallel projection of Kameda's experiments."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from drake_pose.camera.checks import check_number, check_pose, check_side


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """A pinhole camera without distortion.

    Args:
        name: the camera's name.
        width, height: the picture's size [pixel].
        focal_x, focal_y: focal lengths [pixel].
        center_x, center_y: the principal point [pixel], pixel centres at integers.
        X_WC: (4, 4) the camera's pose in the world, x right, y down, z forward [m]; read-only.
        near: the nearest visible depth [m].

    Raises:
        CameraError: when a parameter is not finite, has the wrong sign or size, or X_WC is not a
            rigid transform.
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

    def __post_init__(self) -> None:
        where = f"camera '{self.name}'"
        _set_sides_and_center(self, where)
        for field in ("focal_x", "focal_y", "near"):
            number = check_number(getattr(self, field), field, where, positive=True)
            object.__setattr__(self, field, number)

    @property
    def X_CW(self) -> np.ndarray:
        """(4, 4) the world's pose in the camera."""
        return inverse_pose(self.X_WC)

    def project(self, p_W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Projects points of the world.

        Args:
            p_W: (n, 3) points [m].

        Returns:
            (n, 2) pixels and (n,) depths along the camera's z [m]. A point whose depth is not
            positive has no picture: its pixel is NaN.
        """
        p_C = _in_camera(self.X_CW, p_W)
        depth = p_C[:, 2]
        visible = np.where(depth > 0.0, depth, np.nan)
        u = self.center_x + self.focal_x * p_C[:, 0] / visible
        v = self.center_y + self.focal_y * p_C[:, 1] / visible
        return np.column_stack([u, v]), depth

    def with_pose(self, X_WC: np.ndarray) -> PinholeCamera:
        """Returns the same camera at another pose (4, 4)."""
        return dataclasses.replace(self, X_WC=X_WC)

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
class ParallelCamera:
    """A camera of parallel rays (Kameda, Minoh and Ikeda, section 6: 2.26 pixels a centimetre).

    u = center_x + pixels_per_metre * x_C, v = center_y + pixels_per_metre * y_C.

    Args:
        name: the camera's name.
        width, height: the picture's size [pixel].
        pixels_per_metre: the scale.
        center_x, center_y: the picture of the camera's origin [pixel], pixel centres at integers.
        X_WC: (4, 4) the camera's pose in the world, x right, y down, z forward [m]; read-only.

    Raises:
        CameraError: when a parameter is not finite, has the wrong sign or size, or X_WC is not a
            rigid transform.
    """

    name: str
    width: int
    height: int
    pixels_per_metre: float
    center_x: float
    center_y: float
    X_WC: np.ndarray

    def __post_init__(self) -> None:
        where = f"camera '{self.name}'"
        _set_sides_and_center(self, where)
        scale = check_number(self.pixels_per_metre, "pixels_per_metre", where, positive=True)
        object.__setattr__(self, "pixels_per_metre", scale)

    @property
    def X_CW(self) -> np.ndarray:
        """(4, 4) the world's pose in the camera."""
        return inverse_pose(self.X_WC)

    def project(self, p_W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Projects points (n, 3) [m] of the world to (n, 2) pixels and (n,) depths [m]."""
        p_C = _in_camera(self.X_CW, p_W)
        uv = np.array([self.center_x, self.center_y]) + self.pixels_per_metre * p_C[:, :2]
        return uv, p_C[:, 2]

    def with_pose(self, X_WC: np.ndarray) -> ParallelCamera:
        """Returns the same camera at another pose (4, 4)."""
        return dataclasses.replace(self, X_WC=X_WC)

    def kernel_parameters(self) -> np.ndarray:
        """Returns (8,) kind (1: parallel), f_x, f_y, c_x, c_y, near (unused), width, height."""
        scale = self.pixels_per_metre
        projection = [1.0, scale, scale, self.center_x, self.center_y, 0.0]
        return np.array([*projection, self.width, self.height], dtype=np.float64)


Camera = PinholeCamera | ParallelCamera
"""A camera of either kind."""


def _set_sides_and_center(camera: Camera, where: str) -> None:
    """Checks the fields that both cameras have, and stores them as plain Python numbers."""
    for field in ("width", "height"):
        object.__setattr__(camera, field, check_side(getattr(camera, field), field, where))
    for field in ("center_x", "center_y"):
        object.__setattr__(camera, field, check_number(getattr(camera, field), field, where))
    object.__setattr__(camera, "X_WC", check_pose(camera.X_WC, "X_WC", where))


def inverse_pose(X_AB: np.ndarray) -> np.ndarray:
    """Returns X_BA of a pose X_AB (4, 4)."""
    X_BA = np.eye(4)
    X_BA[:3, :3] = X_AB[:3, :3].T
    X_BA[:3, 3] = -X_AB[:3, :3].T @ X_AB[:3, 3]
    return X_BA


def _in_camera(X_CW: np.ndarray, p_W: np.ndarray) -> np.ndarray:
    """Returns points (n, 3) of the world in the camera's frame."""
    return np.asarray(p_W, dtype=np.float64).reshape(-1, 3) @ X_CW[:3, :3].T + X_CW[:3, 3]
