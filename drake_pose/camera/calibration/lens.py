"""Lenses: a pinhole with distortion, and pictures freed from it.

drake_pose's cameras have no distortion. A calibrated lens therefore gives a second pinhole, whose
camera matrix is chosen so that every pixel of the undistorted picture was seen by the lens: no
black rim that would pass for background.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from drake_pose.camera.checks import check_number, check_side
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError
from drake_pose.yaml_files import read_yaml

Array = NDArray[np.float64]

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
"""The distortion coefficients of a Lens, in OpenCV's order."""

_UNDISTORTION_STEPS = 50
_NUMBERS = ("focal_x", "focal_y", "center_x", "center_y")


@dataclass(frozen=True, eq=False)
class Lens:
    """A pinhole with radial (k1, k2, k3) and tangential (p1, p2) distortion, as OpenCV has it.

    Args:
        width, height: the picture's size [pixel].
        focal_x, focal_y: [pixel].
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

    @property
    def matrix(self) -> Array:
        """(3, 3) the camera matrix of the pictures as taken."""
        return _matrix(self.focal_x, self.focal_y, self.center_x, self.center_y)

    @cached_property
    def straight_matrix(self) -> Array:
        """(3, 3) the camera matrix of the undistorted pictures."""
        if not self.distortion.any():
            return self.matrix
        size = (self.width, self.height)
        straight, _ = cv2.getOptimalNewCameraMatrix(self.matrix, self.distortion, size, 0.0)
        return np.asarray(straight, dtype=np.float64)

    def camera(self, name: str, X_WC: Array) -> PinholeCamera:
        """The camera, free of distortion, that took the undistorted pictures.

        Args:
            name: the camera's name.
            X_WC: (4, 4) the camera's pose in the world [m].
        """
        straight = self.straight_matrix
        return PinholeCamera(
            name=name,
            width=self.width,
            height=self.height,
            focal_x=float(straight[0, 0]),
            focal_y=float(straight[1, 1]),
            center_x=float(straight[0, 2]),
            center_y=float(straight[1, 2]),
            X_WC=X_WC,
        )

    def project(self, p_C: Array) -> Array:
        """Projects points (n, 3) of the camera's frame [m] to (n, 2) pixels as taken."""
        points = np.asarray(p_C, dtype=np.float64).reshape(-1, 1, 3)
        uv, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.matrix, self.distortion)
        return np.asarray(uv, dtype=np.float64).reshape(-1, 2)

    def undistort_points(self, uv: Array) -> Array:
        """Moves pixels (n, 2) as taken to where they are in the undistorted picture."""
        seen = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
        focal = np.array([self.focal_x, self.focal_y])
        start = (seen - [self.center_x, self.center_y]) / focal
        ray = np.column_stack([start, np.ones(len(seen))])
        # The distortion is small beside the picture: what is still missing is added as it is.
        for _ in range(_UNDISTORTION_STEPS):
            ray[:, :2] += (seen - self.project(ray)) / focal
        straight: Array = ray @ self.straight_matrix.T
        return straight[:, :2]

    def undistort(self, picture: NDArray[np.uint8], *, exact: bool = False) -> NDArray[np.uint8]:
        """Frees a picture from distortion.

        Args:
            picture: (H, W) or (H, W, 3), of the lens's size.
            exact: take the nearest pixel instead of mixing four: for masks and labels.

        Raises:
            CameraError: when the picture has another size.
        """
        if picture.shape[:2] != (self.height, self.width):
            raise CameraError(
                f"a picture of {picture.shape[1]} x {picture.shape[0]} pixels (width x height) is "
                f"not of the lens of {self.width} x {self.height}"
            )
        how = cv2.INTER_NEAREST if exact else cv2.INTER_LINEAR
        across, down = self._maps
        return np.asarray(cv2.remap(picture, across, down, how), dtype=np.uint8)

    @cached_property
    def _maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where each pixel of the undistorted picture is in the picture as taken."""
        across, down = cv2.initUndistortRectifyMap(
            self.matrix, self.distortion, np.eye(3), self.straight_matrix,
            (self.width, self.height), cv2.CV_32FC1,
        )  # fmt: skip
        return np.asarray(across), np.asarray(down)


def save_lenses(path: str | Path, lenses: Mapping[str, Lens]) -> None:
    """Writes lenses to a YAML file that load_lenses reads back to the last digit.

    Raises:
        CameraError: when the file cannot be written.
    """
    content: dict[str, Any] = {}
    for name, lens in lenses.items():
        entry: dict[str, Any] = {"width": lens.width, "height": lens.height}
        entry |= {field: float(getattr(lens, field)) for field in _NUMBERS}
        entry |= dict(zip(COEFFICIENTS, map(float, lens.distortion), strict=True))
        content[name] = entry
    try:
        Path(path).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    except OSError as error:
        raise CameraError(f"{path}: cannot write the lenses: {error.strerror}") from error


def load_lenses(path: str | Path) -> dict[str, Lens]:
    """Reads lenses from a YAML file: the fields of Lens, and k1, k2, p1, p2, k3.

    Raises:
        CameraError: names the file, the camera and the field.
    """
    content = read_yaml(Path(path), CameraError)
    if not isinstance(content, dict) or not content:
        raise CameraError(f"{path}: expected a mapping from camera names to their lenses")
    lenses = {}
    needed = {"width", "height", *_NUMBERS, *COEFFICIENTS}
    for name, entry in content.items():
        where = f"{path}: camera '{name}'"
        if not isinstance(entry, dict) or set(entry) != needed:
            raise CameraError(f"{where}: a lens has exactly {', '.join(sorted(needed))}")
        numbers = {field: check_number(entry[field], field, where) for field in _NUMBERS}
        lenses[str(name)] = Lens(
            width=check_side(entry["width"], "width", where),
            height=check_side(entry["height"], "height", where),
            distortion=np.array([check_number(entry[k], k, where) for k in COEFFICIENTS]),
            **numbers,
        )
    return lenses


def _matrix(focal_x: float, focal_y: float, center_x: float, center_y: float) -> Array:
    return np.array([[focal_x, 0.0, center_x], [0.0, focal_y, center_y], [0.0, 0.0, 1.0]])
