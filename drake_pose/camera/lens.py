"""A lens with distortion, and the pinhole of the pictures that are free of it.

An undistorted picture's pinhole is chosen so that the lens saw every pixel: no black rim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError


@dataclass(frozen=True, eq=False)
class Lens:
    """A pinhole with radial and tangential distortion, or a fisheye, as OpenCV has them.

    Args:
        width, height, focal_x, focal_y: [pixel].
        center_x, center_y: the principal point [pixel], pixel centres at integers.
        distortion: (5,) k1, k2, p1, p2, k3, or as many of OpenCV's as a recording gives; of a
            fisheye (4,) k1, k2, k3, k4.
        fisheye: whether it is OpenCV's fisheye, which ROS calls equidistant.
    """

    width: int
    height: int
    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    distortion: Array
    fisheye: bool = False

    @classmethod
    def from_numbers(cls, size: tuple[int, int], numbers: Sequence[float] | Array) -> Lens:
        """The lens of pictures of a width and height; numbers: f_x, f_y, c_x, c_y, distortion."""
        fx, fy, cx, cy, *distortion = np.asarray(numbers, dtype=np.float64).tolist()
        return cls(*size, fx, fy, cx, cy, np.array(distortion))

    @property
    def matrix(self) -> Array:
        """(3, 3) the camera matrix of the pictures as taken."""
        return np.array(
            [[self.focal_x, 0.0, self.center_x], [0.0, self.focal_y, self.center_y], [0, 0, 1]]
        )

    @cached_property
    def straight_matrix(self) -> Array:
        """(3, 3) the camera matrix of the undistorted pictures."""
        if not self.distortion.any():
            return self.matrix
        size = (self.width, self.height)
        if self.fisheye:
            straight = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                self.matrix, self.distortion, size, np.eye(3), balance=0.0
            )
        else:
            straight, _ = cv2.getOptimalNewCameraMatrix(self.matrix, self.distortion, size, 0.0)
        return np.asarray(straight, dtype=np.float64)

    @cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each pixel of an undistorted picture comes from, as cv2.remap takes it."""
        maps = cv2.fisheye.initUndistortRectifyMap if self.fisheye else cv2.initUndistortRectifyMap
        size = (self.width, self.height)
        return maps(
            self.matrix, self.distortion, np.eye(3), self.straight_matrix, size, cv2.CV_16SC2
        )

    def camera(self, name: str, X_WC: Array) -> PinholeCamera:
        """The camera, free of distortion, that took the undistorted pictures from X_WC (4, 4)."""
        (fx, _, cx), (_, fy, cy), _ = self.straight_matrix.tolist()
        return PinholeCamera(name, self.width, self.height, fx, fy, cx, cy, X_WC)

    def undistort(self, picture: Picture) -> Picture:
        """Frees a picture (H, W) or (H, W, 3) from distortion; CameraError: another size."""
        if picture.shape[:2] != (self.height, self.width):
            raise CameraError(
                f"a picture of {picture.shape[1]} x {picture.shape[0]} pixels (width x height) is "
                f"not of the lens of {self.width} x {self.height}"
            )
        return np.asarray(cv2.remap(picture, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)
