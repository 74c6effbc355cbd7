"""Bundle adjustment: all lenses, camera poses and board poses at once, least squares in pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from drake_pose.camera.calibration.initial_poses import Detections
from drake_pose.camera.calibration.intrinsics import inverse_pose, pose_matrix, pose_vector
from drake_pose.camera.calibration.lens import COEFFICIENTS, Lens

Array = NDArray[np.float64]

_POSE = 6
_FREE_COEFFICIENTS = {"none": 0, "standard": 4, "full": 5}
_ROBUST_PIXELS = 1.0
_ROBUST_MEDIANS = 3.0

# Levenberg and Marquardt's damping, on a matrix whose diagonal is 1. A solver that iterates for its
# step (least_squares with lsmr) does not converge here: lenses and poses are nearly exchangeable.
_FIRST_DAMPING = 1e-3
_LEAST_DAMPING = 1e-10
_LARGEST_DAMPING = 1e6
_MOST_STEPS = 100
_GAIN = 1e-9


@dataclass(frozen=True, eq=False)
class Rig:
    """Lenses and poses of cameras, and where the board was.

    Args:
        lenses: by camera.
        X_RC: (4, 4) by camera: its pose in the rig's frame, that of the first camera [m].
        X_RB: (4, 4) by frame: the board's pose in the rig's frame [m].
    """

    lenses: Mapping[str, Lens]
    X_RC: Mapping[str, Array]
    X_RB: Mapping[str, Array]

    def errors(self, points: Array, detections: Detections) -> dict[tuple[str, str], float]:
        """Root mean square corner distance [pixel] of each (camera, frame)."""
        found = {}
        for name, seen in detections.items():
            X_CR = inverse_pose(self.X_RC[name])
            for frame, detection in seen.items():
                X_CB = X_CR @ self.X_RB[frame]
                p_C = points[detection.corners] @ X_CB[:3, :3].T + X_CB[:3, 3]
                difference = self.lenses[name].project(p_C) - detection.uv
                found[name, frame] = float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))
        return found


def adjust_rig(
    points: Array, detections: Detections, start: Rig, model: str, *, robust: bool
) -> Rig:
    """Moves lenses and poses until the corners are met best.

    The first camera's pose is held. The Jacobian is analytic (OpenCV's projectPoints and
    composeRT) and sparse: a corner knows its own camera and its own instant only.

    Args:
        points: (n, 3) the board's corners in its frame [m].
        detections: by camera, then by frame.
        start: where to start.
        model: which distortion coefficients are free, one of LENS_MODELS.
        robust: corners far off count little, so that a spoilt picture stands out instead of
            spoiling the others. The start must be good for most.
    """
    problem = _Problem(points, detections, start, model)
    x = problem.start
    residuals = problem.residuals(x)
    scale = None
    if robust:
        distances = np.linalg.norm(residuals.reshape(-1, 2), axis=1)
        scale = max(_ROBUST_PIXELS, _ROBUST_MEDIANS * float(np.median(distances)))
    weights, cost = _weigh(residuals, scale)
    damping = _FIRST_DAMPING
    for _ in range(_MOST_STEPS):
        J = problem.jacobian(x)
        weighted = J.multiply(weights[:, None]).tocsr()
        normal = (J.T @ weighted).toarray()
        slope = weighted.T @ residuals
        diagonal = np.maximum(np.diag(normal), np.finfo(np.float64).tiny)
        while True:
            step = _solve(normal, diagonal, slope, damping)
            candidate = problem.residuals(x - step)
            new_weights, new_cost = _weigh(candidate, scale)
            if new_cost < cost or damping > _LARGEST_DAMPING:
                break
            damping *= 10.0
        if not new_cost < cost:
            break
        gain = cost - new_cost
        x, residuals, weights, cost = x - step, candidate, new_weights, new_cost
        damping = max(0.1 * damping, _LEAST_DAMPING)
        if gain <= _GAIN * cost:
            break
    return problem.rig(x)


def _solve(normal: Array, diagonal: Array, slope: Array, damping: float) -> Array:
    """A step of Levenberg and Marquardt, scaled by the diagonal (lenses in pixels, poses in m)."""
    scale = 1.0 / np.sqrt(diagonal)
    scaled = normal * scale[:, None] * scale[None, :]
    scaled[np.diag_indices_from(scaled)] += damping
    step: Array = scale * cho_solve(cho_factor(scaled), scale * slope)
    return step


def _weigh(residuals: Array, scale: float | None) -> tuple[Array, float]:
    """Weights (2 m,) of the residuals, equal for a corner's two, and the cost.

    With a scale [pixel] Cauchy's loss, as reweighted least squares: squares up to the scale, and
    what lies far beyond has hardly a say.
    """
    squares = np.sum(residuals.reshape(-1, 2) ** 2, axis=1)
    if not np.isfinite(squares).all():
        return np.ones(len(residuals)), np.inf
    if scale is None:
        return np.ones(len(residuals)), float(np.sum(squares))
    relative = squares / scale**2
    return np.repeat(1.0 / (1.0 + relative), 2), float(np.sum(np.log1p(relative)))


class _Problem:
    """Unknowns in a row: every camera's lens, every camera's pose but the first, the boards'."""

    def __init__(self, points: Array, detections: Detections, start: Rig, model: str) -> None:
        self.points = points
        self.cameras = list(detections)
        self.frames = list(start.X_RB)
        self.detections = detections
        self.first = start
        self.coefficients = _FREE_COEFFICIENTS[model]
        self.lens_size = 4 + self.coefficients
        self.pose_start = self.lens_size * len(self.cameras)
        self.board_start = self.pose_start + _POSE * (len(self.cameras) - 1)
        self.size = self.board_start + _POSE * len(self.frames)
        self.start = self._pack(start)

    def _pack(self, rig: Rig) -> Array:
        parts = []
        for name in self.cameras:
            lens = rig.lenses[name]
            parts.append([lens.focal_x, lens.focal_y, lens.center_x, lens.center_y])
            parts.append(list(lens.distortion[: self.coefficients]))
        parts += [list(pose_vector(inverse_pose(rig.X_RC[name]))) for name in self.cameras[1:]]
        parts += [list(pose_vector(rig.X_RB[frame])) for frame in self.frames]
        return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])

    def rig(self, x: Array) -> Rig:
        """The rig of a row of unknowns."""
        lenses, X_RC = {}, {}
        for i, name in enumerate(self.cameras):
            old = self.first.lenses[name]
            numbers = self._lens(x, i)
            distortion = np.zeros(len(COEFFICIENTS))
            distortion[: self.coefficients] = numbers[4:]
            focal_x, focal_y, center_x, center_y = map(float, numbers[:4])
            lenses[name] = Lens(
                old.width, old.height, focal_x, focal_y, center_x, center_y, distortion
            )
            pose = self._pose(x, i)
            X_RC[name] = inverse_pose(pose_matrix(pose[:3], pose[3:]))
        X_RB = {}
        for k, frame in enumerate(self.frames):
            pose = self._board(x, k)
            X_RB[frame] = pose_matrix(pose[:3], pose[3:])
        return Rig(lenses, X_RC, X_RB)

    def _lens(self, x: Array, camera: int) -> Array:
        return x[self.lens_size * camera : self.lens_size * (camera + 1)]

    def _pose(self, x: Array, camera: int) -> Array:
        """X_CR of a camera as a vector (6,)."""
        if camera == 0:
            return np.zeros(_POSE)
        begin = self.pose_start + _POSE * (camera - 1)
        return x[begin : begin + _POSE]

    def _board(self, x: Array, frame: int) -> Array:
        begin = self.board_start + _POSE * frame
        return x[begin : begin + _POSE]

    def residuals(self, x: Array) -> Array:
        """(2 m,) corner differences [pixel]."""
        return np.concatenate([part[0] for part in self._parts(x, with_jacobian=False)])

    def jacobian(self, x: Array) -> csr_array:
        """(2 m, size) derivatives of the residuals."""
        data, columns, widths = [], [], []
        for _, blocks in self._parts(x, with_jacobian=True):
            index = np.concatenate([begin + np.arange(block.shape[1]) for begin, block in blocks])
            values = np.concatenate([block for _, block in blocks], axis=1)
            data.append(values.ravel())
            columns.append(np.tile(index, len(values)))
            widths.append(np.full(len(values), len(index)))
        pointers = np.concatenate([[0], np.cumsum(np.concatenate(widths))])
        shape = (len(pointers) - 1, self.size)
        return csr_array((np.concatenate(data), np.concatenate(columns), pointers), shape=shape)

    def _parts(
        self, x: Array, *, with_jacobian: bool
    ) -> list[tuple[Array, list[tuple[int, Array]]]]:
        """For each picture its residuals, and the Jacobian's blocks with their first columns."""
        places = {frame: k for k, frame in enumerate(self.frames)}
        parts = []
        for i, name in enumerate(self.cameras):
            numbers, pose = self._lens(x, i), self._pose(x, i)
            matrix = np.array(
                [[numbers[0], 0.0, numbers[2]], [0.0, numbers[1], numbers[3]], [0.0, 0.0, 1.0]]
            )
            distortion = np.zeros(len(COEFFICIENTS))
            distortion[: self.coefficients] = numbers[4:]
            for frame, detection in self.detections[name].items():
                k = places[frame]
                board = self._board(x, k)
                composed = cv2.composeRT(board[:3], board[3:], pose[:3], pose[3:])
                uv, full = cv2.projectPoints(
                    self.points[detection.corners], composed[0], composed[1], matrix, distortion
                )
                residuals = (np.reshape(uv, (-1, 2)) - detection.uv).ravel()
                blocks = []
                if with_jacobian:
                    chain = [np.asarray(d, dtype=np.float64) for d in composed[2:]]
                    blocks = self._blocks(np.asarray(full, dtype=np.float64), chain, i, k)
                parts.append((residuals, blocks))
        return parts

    def _blocks(
        self, full: Array, chain: list[Array], camera: int, frame: int
    ) -> list[tuple[int, Array]]:
        """The Jacobian's blocks of one picture.

        Args:
            full: (2 n, 15) of projectPoints: composed rotation, position, focal lengths, centre,
                distortion.
            chain: composeRT's derivatives of rotation, then position, each by the board's rotation
                and position and the camera's rotation and position (8 times (3, 3)).
            camera, frame: which.
        """
        by_turn, by_shift = full[:, :3], full[:, 3:6]
        moved = [by_turn @ chain[i] + by_shift @ chain[4 + i] for i in range(4)]
        blocks = [(self.lens_size * camera, full[:, 6 : 6 + self.lens_size])]
        if camera > 0:
            begin = self.pose_start + _POSE * (camera - 1)
            blocks.append((begin, np.concatenate(moved[2:], axis=1)))
        blocks.append((self.board_start + _POSE * frame, np.concatenate(moved[:2], axis=1)))
        return blocks
