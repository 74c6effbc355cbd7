"""Pinhole and parallel cameras, checks of their parameters, lenses, and rigs of several cameras."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import cv2
import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.errors import CameraError

LARGEST_SIDE = 16384
"""The largest supported width or height [pixel]."""


def check_side(value: Any, field: str, where: str) -> int:
    """Return a side as int from 1 to LARGEST_SIDE [pixel]; CameraError (``where``) otherwise."""
    number = check_number(value, field, where)
    if number != math.floor(number) or not 1 <= number <= LARGEST_SIDE:
        raise CameraError(
            f"{where}: {field} must be a whole number of pixels from 1 to {LARGEST_SIDE}, "
            f"not {value!r}"
        )
    return int(number)


def check_number(value: Any, field: str, where: str, *, positive: bool = False) -> float:
    """Return a finite (and, if required, positive) number as a float, or raise CameraError.

    Text that spells a number is accepted, because YAML 1.1 reads ``1e-3`` as text.

    ``value``: the number, not yet checked. ``field``, ``where``: field and start of the error
    message. ``positive``: refuse 0 and negative numbers.
    """
    try:
        number = math.nan if isinstance(value, bool | np.ndarray) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number) or (positive and number <= 0.0):
        kind = "a finite positive number" if positive else "a finite number"
        raise CameraError(f"{where}: {field} must be {kind}, not {_short(value)}")
    return number


def numbers(value: Any) -> Array | None:
    """Return the finite numbers (n,), by rows, of an array or of small nested lists; or None.

    ``value``: also a mapping whose ``data`` is one of these, as in ROS' files.
    """
    value = value.get("data") if isinstance(value, dict) else value
    if not isinstance(value, list | tuple | np.ndarray) or not _is_small(value, 3):
        return None
    try:
        found = np.asarray(value, dtype=np.float64).ravel()
    except (ValueError, TypeError):
        return None
    return found if np.isfinite(found).all() else None


def _is_small(value: Any, depth: int) -> bool:
    """Return whether nested lists have few levels and entries; aliases of YAML may hold billions.

    ``value``: the lists; anything else is small. ``depth``: maximum number of levels. A list may
    have several times as many entries as a pose.
    """
    if not isinstance(value, list | tuple):
        return True
    return depth > 0 and len(value) <= 100 and all(_is_small(one, depth - 1) for one in value)


def check_pose(value: Any, field: str, where: str, most: float = 1e-4) -> np.ndarray:
    """Return a rigid transform, Drake's or a matrix, as a read-only (4, 4) float64 array.

    A rounded rotation R, with R R^T within ``most`` of the identity, is replaced by the nearest
    exact one, as Drake requires.

    ``value``: the transform. ``field``, ``where``: field and start of the error message. Raises
    CameraError: not a finite 4 x 4 matrix, its last row is not 0 0 0 1, or it is not a rotation.
    """
    found = numbers(value.GetAsMatrix4() if hasattr(value, "GetAsMatrix4") else value)
    if found is None or found.size != 16:
        raise CameraError(
            f"{where}: {field} must be a 4 x 4 matrix of finite numbers, not {_short(value)}"
        )
    matrix = found.reshape(4, 4).copy()
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-12:
        raise CameraError(f"{where}: the last row of {field} must be 0 0 0 1")
    R = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(R @ R.T - np.eye(3)).max()
    if not deviation <= most or np.linalg.det(R) < 0.0:
        kind = f"R R^T differs from the identity by {deviation:.3g}"
        raise CameraError(
            f"{where}: the upper left 3 x 3 block of {field} is not a rotation "
            f"({'it is a reflection' if deviation <= most else kind}); its columns must be the "
            "camera's axes in the world, x right, y down, z forward"
        )
    if deviation > 1e-13:
        U, _, Vt = np.linalg.svd(R)
        matrix[:3, :3] = U @ Vt
    matrix[3] = [0.0, 0.0, 0.0, 1.0]
    matrix.flags.writeable = False
    return matrix


def _short(value: Any) -> str:
    """Return a value as text of limited length, for messages."""
    is_plain = value is None or isinstance(value, str | int | float)
    return repr(value)[:40] if is_plain else f"a {type(value).__name__}"


class _PosedCamera:
    """Checks and pose of both kinds of cameras."""

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

    @cached_property
    def X_CW(self) -> np.ndarray:
        """(4, 4) pose of the world in the camera."""
        return inverse_pose(self.X_WC)

    def _in_camera(self, p_W: np.ndarray) -> np.ndarray:
        """Return world points (n, 3) in the camera's frame [m]."""
        X_CW = self.X_CW
        return np.asarray(p_W, dtype=np.float64).reshape(-1, 3) @ X_CW[:3, :3].T + X_CW[:3, 3]

    def with_pose(self, X_WC: np.ndarray) -> Self:
        """Return the same camera at another pose X_WC (4, 4)."""
        return dataclasses.replace(self, X_WC=X_WC)  # type: ignore[type-var]


@dataclass(frozen=True, eq=False)
class PinholeCamera(_PosedCamera):
    """A pinhole camera without distortion.

    Args:
        width, height, focal_x, focal_y: size of the image and focal lengths [pixel].
        center_x, center_y: principal point [pixel], pixel centres at integers.
        X_WC: pose of the camera in the world, x right, y down, z forward [m]: a RigidTransform or a
            matrix (4, 4); it is stored as a read-only matrix.
        near: minimum visible depth [m].

    Raises:
        CameraError: a parameter is not finite or out of range, or X_WC is not a rigid transform.
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
        """Project points (n, 3) [m] to (n, 2) pixels, nan if not in front, and depths z_C [m]."""
        p_C = self._in_camera(p_W)
        depth = p_C[:, 2]
        visible = np.where(depth > 0.0, depth, np.nan)
        u = self.center_x + self.focal_x * p_C[:, 0] / visible
        v = self.center_y + self.focal_y * p_C[:, 1] / visible
        return np.column_stack([u, v]), depth

    def resized(self, width: int, height: int) -> "PinholeCamera":
        """Return the camera of the same images resized to a width and height [pixel]."""
        scaled = self.with_scaled_intrinsics(width / self.width, height / self.height)
        return dataclasses.replace(scaled, width=width, height=height)

    def with_scaled_intrinsics(self, x: float, y: float) -> "PinholeCamera":
        """Return the camera with intrinsics of images x times as wide and y times as high.

        Its width and height stay.
        """
        return dataclasses.replace(
            self, focal_x=x * self.focal_x, focal_y=y * self.focal_y,
            center_x=x * (self.center_x + HALF_PIXEL) - HALF_PIXEL,
            center_y=y * (self.center_y + HALF_PIXEL) - HALF_PIXEL,
        )  # fmt: skip

    def mirrored(self) -> "PinholeCamera":
        """Return the camera of the same images with left and right exchanged."""
        return dataclasses.replace(self, center_x=self.width - 1 - self.center_x)

    def kernel_parameters(self) -> np.ndarray:
        """Return (8,) kind (0: pinhole), f_x, f_y, c_x, c_y, near [m], width, height [pixel]."""
        projection = [0.0, self.focal_x, self.focal_y, self.center_x, self.center_y, self.near]
        return np.array([*projection, self.width, self.height], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class ParallelCamera(_PosedCamera):
    """A camera with parallel rays (Kameda, Minoh and Ikeda, section 6: 2.26 pixels per centimetre).

    u = center_x + pixels_per_metre * x_C and v = center_y + pixels_per_metre * y_C. The other
    parameters, and the errors, are those of a PinholeCamera.
    """

    name: str
    width: int
    height: int
    pixels_per_metre: float
    center_x: float
    center_y: float
    X_WC: np.ndarray

    def project(self, p_W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (n, 3) [m] to (n, 2) pixels and (n,) depths z_C [m], of any sign."""
        p_C = self._in_camera(p_W)
        uv = np.array([self.center_x, self.center_y]) + self.pixels_per_metre * p_C[:, :2]
        return uv, p_C[:, 2]

    def kernel_parameters(self) -> np.ndarray:
        """Return (8,) kind (1: parallel), f_x, f_y [pixel/m], c_x, c_y, near (0), width, height."""
        scale = self.pixels_per_metre
        projection = [1.0, scale, scale, self.center_x, self.center_y, 0.0]
        return np.array([*projection, self.width, self.height], dtype=np.float64)


HALF_PIXEL = 0.5
"""Difference of Drake's principal point from ours [pixel]."""

Camera = PinholeCamera | ParallelCamera
"""A camera of either kind."""


def intrinsics_warnings(cameras: Iterable[Camera], aside: float = 0.1) -> list[str]:
    """Return a warning for each pinhole camera whose principal point is far from the middle.

    ``aside``: maximum distance from the middle of real lenses [size of the pictures].
    """
    texts = []
    for camera in cameras:
        size = np.array([camera.width, camera.height])
        centre = np.array([camera.center_x, camera.center_y])
        twice = 2.0 * (centre + HALF_PIXEL)
        if isinstance(camera, PinholeCamera) and np.any(np.abs(twice / size - 1.0) > 2.0 * aside):
            texts.append(
                f"camera '{camera.name}': its principal point {centre[0]:.0f}, {centre[1]:.0f} is "
                f"far from the middle of its pictures of {size[0]} x {size[1]} pixels; it is the "
                f"middle of pictures of {twice[0]:.0f} x {twice[1]:.0f}: are the intrinsics those "
                "of pictures of another size, or center_x and center_y exchanged? (It is right "
                "only for pictures that were cut out beside the middle.)"
            )
    return texts


def camera_tuple(cameras: Mapping[str, Camera] | Iterable[Camera]) -> tuple[Camera, ...]:
    """Return cameras, given by name or as a sequence, as a tuple.

    Raises CameraError: an element is not a camera, or a single camera is given.
    """
    given = cameras.values() if isinstance(cameras, Mapping) else cameras
    found = tuple(given) if isinstance(given, Iterable) else (given,)
    wrong = [type(one).__name__ for one in found if not isinstance(one, Camera)]
    if wrong or isinstance(given, Camera):
        raise CameraError(
            f"got {(wrong or ['one camera'])[0]} where cameras are expected: give [camera], or "
            "{name: camera} as from load_cameras"
        )
    return found


def pose_matrix(R: Array, p: Sequence[float] | Array) -> Array:
    """Return the pose (4, 4) of a rotation (3, 3) and a position (3,) [m]."""
    return np.vstack([np.column_stack([R, p]), [0.0, 0.0, 0.0, 1.0]])


def inverse_pose(X_AB: np.ndarray) -> np.ndarray:
    """Return X_BA of a pose X_AB (4, 4)."""
    R_BA = X_AB[:3, :3].T
    return pose_matrix(R_BA, -R_BA @ X_AB[:3, 3])


FACE_CAMERA = "face"
"""The name of the camera that looks at the face."""


def circle_of_cameras(
    count: int,
    *,
    radius: float = 3.0,
    height: float = 1.3,
    target: Sequence[float] = (0.0, 0.0, 0.95),
    field_of_view: float = math.radians(46.0),
    size: tuple[int, int] = (640, 480),
    face_camera: bool = True,
) -> dict[str, PinholeCamera]:
    """Return by name cameras on a circle that look at its centre, and one that looks at the face.

    Date et al. (figure 1) have eight "horizontal" cameras about 45 degrees apart and one for the
    face. The world's z axis points up; a person at the centre who faces +x looks into the face
    camera.

    Args:
        count: number of cameras on the circle, camera_0, camera_1 ... counterclockwise from above;
            the x axis bisects the angle between the last and the first one.
        radius, height: radius of the circle and height of its cameras [m].
        target: (3,) point they look at [m]; the face camera takes its x and y.
        field_of_view: vertical field of view of the cameras on the circle [rad].
        size: width and height of the images [pixel].
        face_camera: whether there is a camera for the face.

    Raises CameraError: there is no camera, or a number is out of range.
    """
    if count < 1 and not face_camera:
        raise CameraError("a rig needs at least one camera")
    if not (0.0 < radius < math.inf and 0.0 < field_of_view < math.pi):
        raise CameraError("a rig's radius must be positive, its field of view below 180 degrees")
    views = list[tuple[str, list[float], Sequence[float], float]]()
    for k in range(count):
        angle = 2.0 * math.pi * (k + 0.5) / count
        eye = [radius * math.cos(angle), radius * math.sin(angle), height]
        views.append((f"camera_{k}", eye, target, field_of_view))
    if face_camera:
        # Height of an adult's face, and a narrow view in which the face fills the image.
        height, view = 1.6, math.radians(22.0)
        eye, face = [target[0] + radius, target[1], height], [target[0], target[1], height]
        views.append((FACE_CAMERA, eye, face, view))
    cameras, centre = {}, (0.5 * (size[0] - 1), 0.5 * (size[1] - 1))
    for name, eye, point, view in views:
        focal = 0.5 * size[1] / math.tan(0.5 * view)
        cameras[name] = PinholeCamera(name, *size, focal, focal, *centre, look_at(eye, point))
    return cameras


def look_at(
    eye: Sequence[float] | Array, target: Sequence[float] | Array, up: Sequence[float] = (0, 0, 1)
) -> Array:
    """Return the pose X_WC (4, 4) of a camera at `eye` (3,) that looks at `target` (3,) [m].

    ``eye``, ``target``: (3,) points [m]. ``up``: (3,) direction that is up in the image.

    Raises CameraError: both points coincide, or the camera looks along `up`.
    """
    forward = np.asarray(target, dtype=np.float64) - np.asarray(eye, dtype=np.float64)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
        raise CameraError(f"a camera at {list(eye)} cannot look at {list(target)} with {up} up")
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    return pose_matrix(np.column_stack([right, np.cross(forward, right), forward]), eye)


@dataclass(frozen=True, eq=False)
class Lens:
    """A pinhole with radial and tangential distortion, or a fisheye, as in OpenCV."""

    # width, height: size of the images [pixel].
    width: int
    height: int
    matrix: Array  # (3, 3) camera matrix of the images as taken [pixel], pixel centres at integers.
    distortion: Array  # OpenCV's coefficients k1, k2, p1, p2, k3 ...; for a fisheye (4,) k1 to k4.
    fisheye: bool = False  # Whether it is OpenCV's fisheye, called equidistant by ROS and Kalibr.

    @cached_property
    def undistorted_matrix(self) -> Array:
        """(3, 3) camera matrix [pixel] of the undistorted images, which have no blank pixels."""
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
        """Source of each pixel of an undistorted image, as cv2.remap takes it."""
        maps = cv2.fisheye.initUndistortRectifyMap if self.fisheye else cv2.initUndistortRectifyMap
        lens, size = (self.matrix, self.distortion), (self.width, self.height)
        return maps(*lens, np.eye(3), self.undistorted_matrix, size, cv2.CV_16SC2)

    def camera(self, name: str, X_WC: Array) -> PinholeCamera:
        """Return the pinhole camera of the undistorted images, at pose X_WC (4, 4)."""
        (fx, _, cx), (_, fy, cy), _ = self.undistorted_matrix.tolist()
        return PinholeCamera(name, self.width, self.height, fx, fy, cx, cy, X_WC)

    def undistort(self, picture: Picture) -> Picture:
        """Return an image (H, W) or (H, W, 3) without distortion; CameraError for another size."""
        if picture.shape[:2] != (self.height, self.width):
            raise CameraError(
                f"a picture of {picture.shape[1]} x {picture.shape[0]} pixels (width x height) "
                f"does not fit the lens, which is for {self.width} x {self.height}"
            )
        return np.asarray(cv2.remap(picture, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)
