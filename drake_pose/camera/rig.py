"""Lenses and poses of cameras that saw a board, and where it was.

Each camera's lens by Zhang's method (OpenCV's calibrateCamera); first poses from pairs of cameras,
chained; then everything at once: the sum over all corners of ``|pi_c(X_RC^-1 X_RB p_B) - uv|^2``.
An undistorted picture's pinhole is chosen so that the lens saw every pixel: no black rim.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from drake_pose.arrays import Array
from drake_pose.camera.board import BoardDetections, Detection, Picture
from drake_pose.camera.models import (
    PinholeCamera,
    check_number,
    check_side,
    inverse_pose,
    write_file,
)
from drake_pose.errors import CameraError
from drake_pose.yaml_files import read_yaml

NUMBERS = ("focal_x", "focal_y", "center_x", "center_y", "k1", "k2", "p1", "p2", "k3")
"""Focal lengths, principal point and distortion coefficients of a Lens, in OpenCV's order."""


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

    def undistort(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Frees a picture (H, W) or (H, W, 3) from distortion; CameraError: another size."""
        if picture.shape[:2] != (self.height, self.width):
            raise CameraError(
                f"a picture of {picture.shape[1]} x {picture.shape[0]} pixels (width x height) is "
                f"not of the lens of {self.width} x {self.height}"
            )
        return np.asarray(cv2.remap(picture, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)


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


FREE_COEFFICIENTS = {"none": 0, "standard": 4, "full": 5}
"""How many of a lens's distortion coefficients are free, by the lens model's name."""

_FEWEST_PICTURES = 3
_LENS, _POSE = len(NUMBERS), 6
# Cauchy's loss counts squares up to a scale: this many pixels, or medians of the start's errors.
_ROBUST_PIXELS, _ROBUST_MEDIANS = 1.0, 3.0
_MOST_STEPS, _MOST_DAMPED = 50, 1e6


@dataclass(frozen=True, eq=False)
class Rig:
    """Lenses and poses of cameras, and where the board was.

    Args:
        X_RC: (4, 4) by camera: its pose in the rig's frame, that of the first camera [m].
        X_RB: (4, 4) by frame: the board's pose in the rig's frame [m].
    """

    lenses: Mapping[str, Lens]
    X_RC: Mapping[str, Array]
    X_RB: Mapping[str, Array]

    def errors(self, seen: BoardDetections) -> dict[Picture, float]:
        """Root mean square corner distance [pixel] of each (camera, frame)."""
        return {
            (name, frame): self.error(seen, name, frame, inverse_pose(X_RC) @ self.X_RB[frame])
            for name, X_RC in self.X_RC.items()
            for frame in seen.detections[name]
        }

    def error(self, seen: BoardDetections, name: str, frame: str, X_CB: Array) -> float:
        """The same of one picture with the board at X_CB (4, 4); infinite: behind the camera."""
        detection, lens = seen.detections[name][frame], self.lenses[name]
        points = seen.board.points[detection.corners]
        if (points @ X_CB[2, :3] + X_CB[2, 3]).min() <= 0.0:
            return float("inf")
        vector = _vector(X_CB)
        uv, _ = cv2.projectPoints(points, vector[:3], vector[3:], lens.matrix, lens.distortion)
        difference = np.reshape(uv, (-1, 2)) - detection.uv
        return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))


def own_rig(name: str, seen: BoardDetections, model: str = "standard") -> tuple[Rig, float]:
    """A camera's lens and the board's poses as its pictures alone give them.

    ``model`` is a key of FREE_COEFFICIENTS. Returns the focal length's standard deviation over the
    focal length, too.

    Raises CameraError when there are fewer than three pictures of the board, or OpenCV finds no
    lens.
    """
    detections, points = seen.detections[name], seen.board.points
    if len(detections) < _FEWEST_PICTURES:
        found = ", ".join(f"'{frame}'" for frame in detections) or "none"
        raise CameraError(
            f"camera '{name}': the board was found in {len(detections)} pictures ({found}), but at "
            f"least {_FEWEST_PICTURES} are needed, better 15, with the board tilted"
        )
    objects = [points[one.corners].astype(np.float32) for one in detections.values()]
    images = [one.uv.astype(np.float32) for one in detections.values()]
    flags = cv2.CALIB_FIX_K3 if model != "full" else 0
    if model == "none":
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_ZERO_TANGENT_DIST
    size = seen.sizes[name]
    try:
        _, matrix, distortion, turns, shifts, deviations, _, _ = cv2.calibrateCameraExtended(
            objects, images, size, np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise CameraError(f"camera '{name}': OpenCV finds no lens: {error.err}") from error
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
        raise CameraError(f"camera '{name}': its pictures give no lens; tilt the board more")
    numbers = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(distortion)[:5]]
    vectors = np.hstack([np.reshape(turns, (-1, 3)), np.reshape(shifts, (-1, 3))])
    X_CB = {frame: _pose(vector) for frame, vector in zip(detections, vectors, strict=True)}
    rig = Rig({name: Lens.from_numbers(size, numbers)}, {name: np.eye(4)}, X_CB)
    return rig, float(np.ravel(deviations)[0] / numbers[0])


def require_shared_pictures(detections: Mapping[str, Mapping[str, Detection]]) -> None:
    """CameraError when the cameras fall into groups that share no picture."""
    shared = [[len(set(a) & set(b)) for b in detections.values()] for a in detections.values()]
    count, groups = connected_components(csr_array(shared), directed=False)
    if count == 1:
        return
    named = list(zip(detections, groups, strict=True))
    parts = [[f"'{name}'" for name, group in named if group == g] for g in range(count)]
    parts.sort(key=len)
    few = ", ".join(parts[0])
    raise CameraError(
        f"camera {few} shares no picture of the board with the others (groups: "
        f"{'; '.join(map(', '.join, parts))}): show the board to cameras of both groups at the "
        f"same instant (the same file name), or leave camera {few} out"
    )


def chain_rig(seen: BoardDetections, own: Mapping[str, Rig]) -> Rig:
    """A rig of the most trustworthy pairs of cameras, in the first one's frame.

    Raises CameraError when the cameras fall into groups that share no picture.
    """
    require_shared_pictures(seen.detections)
    names = list(own)
    pairs: dict[tuple[int, int], Array] = {}
    costs = np.zeros((len(names), len(names)))
    for i, j in combinations(range(len(names)), 2):
        shared = len(set(own[names[i]].X_RB) & set(own[names[j]].X_RB))
        if shared:
            pairs[i, j], error = pair_pose(seen, own[names[i]], own[names[j]])
            pairs[j, i] = inverse_pose(pairs[i, j])
            # More shared instants and a smaller error make a better link; both stay positive.
            costs[i, j] = (1.0 + min(error, 1e6)) / shared
    order, parents = breadth_first_order(minimum_spanning_tree(costs), 0, directed=False)
    poses = {0: np.eye(4)}
    for child in order[1:]:
        poses[child] = poses[parents[child]] @ pairs[parents[child], child]
    X_RC = {name: poses[i] for i, name in enumerate(names)}
    X_RB = {}
    for frame in dict.fromkeys(frame for one in own.values() for frame in one.X_RB):
        # Every camera that saw the board proposes; the smallest median error wins.
        seers = {
            name: X_RC[name] @ own[name].X_RB[frame] for name in own if frame in own[name].X_RB
        }
        errors = [
            np.median([own[n].error(seen, n, frame, inverse_pose(X_RC[n]) @ X) for n in seers])
            for X in seers.values()
        ]
        X_RB[frame] = list(seers.values())[int(np.argmin(errors))]
    return Rig({name: one.lenses[name] for name, one in own.items()}, X_RC, X_RB)


def pair_pose(seen: BoardDetections, a: Rig, b: Rig) -> tuple[Array, float]:
    """The pose X_AB (4, 4) of two cameras that saw the board at the same instants, and its error.

    Each shared instant proposes a pose; the one with the least median error [pixel] over all wins.
    """
    (name,) = a.lenses
    shared = [frame for frame in a.X_RB if frame in b.X_RB]
    proposals = []
    for proposer in shared:
        X_AB = a.X_RB[proposer] @ inverse_pose(b.X_RB[proposer])
        # A proposer explains itself: it has no say where others can be asked.
        asked = [frame for frame in shared if frame != proposer] or shared
        errors = [a.error(seen, name, frame, X_AB @ b.X_RB[frame]) for frame in asked]
        proposals.append((X_AB, float(np.median(errors))))
    return min(proposals, key=lambda proposal: proposal[1])


def adjust_rig(seen: BoardDetections, start: Rig, model: str, *, robust: bool) -> Rig:
    """Moves lenses and poses until the corners are met best; the first camera's pose is held.

    ``robust``: corners far off count little, so that a spoilt picture stands out instead of
    spoiling the others; the start must be good for most. By Levenberg's and Marquardt's steps.
    """
    # In a row: each camera's lens, then each camera's pose X_CR, then each board's pose X_RB.
    poses = [inverse_pose(X) for X in start.X_RC.values()] + list(start.X_RB.values())
    lenses = [list(lens.numbers().values()) for lens in start.lenses.values()]
    x, count = np.concatenate([*lenses, *map(_vector, poses)]), len(lenses)
    free = np.ones(len(x), dtype=bool)
    free[: _LENS * count].reshape(count, -1)[:, 4 + FREE_COEFFICIENTS[model] :] = False
    free[_LENS * count :][:_POSE] = False
    r, J = corner_residuals(seen, x, list(start.X_RB))
    median = float(np.median(np.linalg.norm(r.reshape(-1, 2), axis=1)))
    scale = max(_ROBUST_PIXELS, _ROBUST_MEDIANS * median) if robust else np.inf

    def cost(r: Array) -> float:
        return float(np.sum(scale**2 * np.log1p((r / scale) ** 2) if robust else r**2))

    damping = 1e-6
    for _ in range(_MOST_STEPS):
        J, weights = J[:, free], 1.0 / (1.0 + (r / scale) ** 2)
        normal, slope = (J.T @ (J * weights[:, None])).toarray(), J.T @ (weights * r)
        while damping < _MOST_DAMPED:
            moved = x.copy()
            damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
            moved[free] -= np.linalg.solve(damped, slope)
            r_moved, J_moved = corner_residuals(seen, moved, list(start.X_RB))
            if cost(r_moved) <= cost(r):
                break
            damping *= 10.0
        else:
            break
        gain, x, r, J, damping = cost(r) - cost(r_moved), moved, r_moved, J_moved, 0.1 * damping
        if gain <= (1e-4 if robust else 1e-13) * cost(r) + 1e-12 * len(r):
            break
    numbers, X_CR, X_RB = _split(x, count)
    return Rig(
        {
            name: Lens.from_numbers(seen.sizes[name], row)
            for name, row in zip(start.lenses, numbers, strict=True)
        },
        {name: inverse_pose(_pose(row)) for name, row in zip(start.X_RC, X_CR, strict=True)},
        {frame: _pose(row) for frame, row in zip(start.X_RB, X_RB, strict=True)},
    )


def corner_residuals(seen: BoardDetections, x: Array, frames: list[str]) -> tuple[Array, csr_array]:
    """Corner differences (2 m,) [pixel], and their derivatives (2 m, n) by unknowns in a row."""
    count = len(seen.detections)
    lenses, X_CR, X_RB = _split(x, count)
    board, residuals, values, columns = seen.board.points, [], [], []
    for i, found in enumerate(seen.detections.values()):
        fx, fy, cx, cy = lenses[i, :4]
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        for frame, detection in found.items():
            k = frames.index(frame)
            turn, shift, *chain = cv2.composeRT(X_RB[k, :3], X_RB[k, 3:], X_CR[i, :3], X_CR[i, 3:])
            points = board[detection.corners]
            uv, J = cv2.projectPoints(points, turn, shift, matrix, lenses[i, 4:])
            residuals.append((np.reshape(uv, (-1, 2)) - detection.uv).ravel())
            # By the board's pose, the camera's pose, and the lens.
            by_poses = J[:, :_POSE] @ np.block([chain[:4], chain[4:]])
            values.append(np.hstack([by_poses, J[:, _POSE : _POSE + _LENS]]).ravel())
            begins = _LENS * count + _POSE * (count + k), _LENS * count + _POSE * i, _LENS * i
            row = [np.arange(b, b + n) for b, n in zip(begins, (_POSE, _POSE, _LENS), strict=True)]
            columns.append(np.tile(np.concatenate(row), len(J)))
    residual = np.concatenate(residuals)
    pointers = np.arange(len(residual) + 1) * (2 * _POSE + _LENS)
    entries = (np.concatenate(values), np.concatenate(columns), pointers)
    return residual, csr_array(entries, shape=(len(residual), len(x)))


def _split(x: Array, count: int) -> tuple[Array, Array, Array]:
    """Lenses, poses X_CR and poses X_RB of a row of unknowns."""
    lenses, X_CR, X_RB = np.split(x, [_LENS * count, (_LENS + _POSE) * count])
    return lenses.reshape(-1, _LENS), X_CR.reshape(-1, _POSE), X_RB.reshape(-1, _POSE)


def _vector(X: Array) -> Array:
    """(6,) rotation vector [rad] and position [m] of a pose (4, 4)."""
    return np.concatenate([np.ravel(cv2.Rodrigues(X[:3, :3])[0]), X[:3, 3]])


def _pose(vector: Array) -> Array:
    """The pose (4, 4) of a rotation vector [rad] and a position [m], (6,)."""
    X = np.eye(4)
    X[:3, :3] = cv2.Rodrigues(vector[:3])[0]
    X[:3, 3] = vector[3:]
    return X
