"""Lenses: a pinhole with distortion, and pictures freed from it.

An undistorted picture's pinhole is chosen so that the lens saw every pixel: no black rim.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from drake_pose.camera.checks import check_number, check_side, write_file
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError
from drake_pose.yaml_files import read_yaml

Array = NDArray[np.float64]

NUMBERS = ("focal_x", "focal_y", "center_x", "center_y", "k1", "k2", "p1", "p2", "k3")
"""Focal lengths, principal point and distortion coefficients of a Lens, in OpenCV's order."""


@dataclass(frozen=True, eq=False)
class Lens:
    """A pinhole with radial and tangential distortion, as OpenCV has it.

    Args:
        width, height, focal_x, focal_y: [pixel].
        center_x, center_y: the principal point [pixel], pixel centres at integers.
        distortion: (5,) k1, k2, p1, p2, k3.
    """

    width: int
    height: int
    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    distortion: Array

    @classmethod
    def from_numbers(cls, size: tuple[int, int], numbers: Sequence[float] | Array) -> Lens:
        """The lens of pictures of a width and height, with the values of NUMBERS in their order."""
        fx, fy, cx, cy, *distortion = np.asarray(numbers, dtype=np.float64).tolist()
        return cls(*size, fx, fy, cx, cy, np.array(distortion))

    def numbers(self) -> dict[str, float]:
        """The values of NUMBERS."""
        own = [self.focal_x, self.focal_y, self.center_x, self.center_y, *self.distortion.tolist()]
        return dict(zip(NUMBERS, map(float, own), strict=True))

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
        straight, _ = cv2.getOptimalNewCameraMatrix(self.matrix, self.distortion, size, 0.0)
        return np.asarray(straight, dtype=np.float64)

    def camera(self, name: str, X_WC: Array) -> PinholeCamera:
        """The camera, free of distortion, that took the undistorted pictures from X_WC (4, 4)."""
        (fx, _, cx), (_, fy, cy), _ = self.straight_matrix.tolist()
        return PinholeCamera(name, self.width, self.height, fx, fy, cx, cy, X_WC)

    def undistort(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Frees a picture (H, W) or (H, W, 3) from distortion; CameraError: another size."""
        if picture.shape[:2] != (self.height, self.width):
            raise CameraError(
                f"a picture of {picture.shape[1]} x {picture.shape[0]} pixels (width x height) is "
                f"not of the lens of {self.width} x {self.height}"
            )
        straight = cv2.undistort(picture, self.matrix, self.distortion, None, self.straight_matrix)
        return np.asarray(straight, dtype=np.uint8)


def save_lenses(path: str | Path, lenses: Mapping[str, Lens]) -> None:
    """Writes lenses to a YAML file for load_lenses, to the last digit; or raises CameraError."""
    content = {
        name: {"width": lens.width, "height": lens.height, **lens.numbers()}
        for name, lens in lenses.items()
    }
    write_file(path, yaml.safe_dump(content, sort_keys=False), "the lenses")


def load_lenses(path: str | Path) -> dict[str, Lens]:
    """Reads lenses from a YAML file; CameraError names the file, the camera and the field."""
    content = read_yaml(Path(path), CameraError)
    if not isinstance(content, dict) or not content:
        raise CameraError(f"{path}: expected a mapping from camera names to their lenses")
    lenses = {}
    needed = {"width", "height", *NUMBERS}
    for name, entry in content.items():
        where = f"{path}: camera '{name}'"
        if not isinstance(entry, dict) or set(entry) != needed:
            raise CameraError(f"{where}: a lens has exactly {', '.join(sorted(needed))}")
        width, height = (check_side(entry[side], side, where) for side in ("width", "height"))
        numbers = [check_number(entry[field], field, where) for field in NUMBERS]
        lenses[str(name)] = Lens.from_numbers((width, height), numbers)
    return lenses
