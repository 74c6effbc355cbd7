"""Lenses and poses of cameras that saw a board, and where it was.

Each camera's lens by Zhang's method (OpenCV's calibrateCamera); first poses from pairs of cameras,
chained; then everything at once: the sum over all corners of ``|pi_c(X_RC^-1 X_RB p_B) - uv|^2``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import least_squares
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import LinearOperator, aslinearoperator

from drake_pose.camera.calibration.board import Detection
from drake_pose.camera.calibration.lens import NUMBERS, Lens
from drake_pose.camera.models import inverse_pose
from drake_pose.errors import CameraError

Array = NDArray[np.float64]
Detections = Mapping[str, Mapping[str, Detection]]
"""Detections by camera, then by frame."""

FREE_COEFFICIENTS = {"none": 0, "standard": 4, "full": 5}
"""How many of a lens's distortion coefficients are free, by the lens model's name."""

_FEWEST_PICTURES = 3
_LENS, _POSE = len(NUMBERS), 6
# Cauchy's loss counts squares up to a scale: this many pixels, or medians of the start's errors.
_ROBUST_PIXELS, _ROBUST_MEDIANS = 1.0, 3.0
_MOST_STEPS = 50


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

    def errors(self, points: Array, detections: Detections) -> dict[tuple[str, str], float]:
        """Root mean square corner distance [pixel] of each (camera, frame)."""
        return {
            (name, frame): _error(points, detection, self.lenses[name], X_CR @ self.X_RB[frame])
            for name, seen in detections.items()
            for X_CR in [inverse_pose(self.X_RC[name])]
            for frame, detection in seen.items()
        }


@dataclass(frozen=True, eq=False)
class LensEstimate:
    """A lens as one camera's pictures alone give it.

    Args:
        points: (n, 3) the board's corners in its frame B [m].
        detections: the board in the camera's pictures, by frame.
        X_CB: (4, 4) by frame: the board's pose in the camera [m].
        errors: by frame: root mean square distance of the corners [pixel].
        focal_deviation: standard deviation of the focal length over the focal length.
    """

    points: Array
    detections: Mapping[str, Detection]
    lens: Lens
    X_CB: Mapping[str, Array]
    errors: Mapping[str, float]
    focal_deviation: float

    def error(self, frame: str, X_CB: Array) -> float:
        """Root mean square corner distance of a picture with the board at X_CB (4, 4) [pixel]."""
        return _error(self.points, self.detections[frame], self.lens, X_CB)


def estimate_lens(
    name: str,
    points: Array,
    detections: Mapping[str, Detection],
    size: tuple[int, int],
    model: str = "standard",
) -> LensEstimate:
    """Estimates a camera's lens from the board in its pictures.

    Args:
        points: (n, 3) the board's corners in its frame B [m].
        detections: by frame.
        size: the pictures' width and height [pixel].
        model: a key of FREE_COEFFICIENTS.

    Raises:
        CameraError: when there are fewer than three pictures of the board, or OpenCV finds no lens.
    """
    if len(detections) < _FEWEST_PICTURES:
        found = ", ".join(f"'{frame}'" for frame in detections) or "none"
        raise CameraError(
            f"camera '{name}': the board was found in {len(detections)} pictures ({found}), but at "
            f"least {_FEWEST_PICTURES} are needed, better 15, with the board tilted"
        )
    objects = [points[seen.corners].astype(np.float32) for seen in detections.values()]
    images = [seen.uv.astype(np.float32) for seen in detections.values()]
    flags = cv2.CALIB_FIX_K3 if model != "full" else 0
    if model == "none":
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_ZERO_TANGENT_DIST
    try:
        _, matrix, distortion, turns, shifts, deviations, _, errors = cv2.calibrateCameraExtended(
            objects, images, size, np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise CameraError(f"camera '{name}': OpenCV finds no lens: {error.err}") from error
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
        raise CameraError(f"camera '{name}': its pictures give no lens; tilt the board more")
    numbers = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    row = np.array([*numbers, *np.ravel(distortion)[: _LENS - 4]])
    vectors = np.hstack([np.reshape(turns, (-1, 3)), np.reshape(shifts, (-1, 3))])
    return LensEstimate(
        points,
        dict(detections),
        Lens.from_numbers(size, row),
        {frame: _pose(vector) for frame, vector in zip(detections, vectors, strict=True)},
        dict(zip(detections, np.ravel(errors).tolist(), strict=True)),
        float(np.ravel(deviations)[0] / row[0]),
    )


def require_shared_pictures(detections: Detections) -> None:
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


def chain_rig(estimates: Mapping[str, LensEstimate]) -> Rig:
    """A rig of the most trustworthy pairs of cameras, in the first one's frame.

    Raises:
        CameraError: when the cameras fall into groups that share no picture.
    """
    require_shared_pictures({name: one.detections for name, one in estimates.items()})
    cameras = list(estimates.values())
    pairs: dict[tuple[int, int], Array] = {}
    costs = np.zeros((len(cameras), len(cameras)))
    for i, j in combinations(range(len(cameras)), 2):
        shared = len(set(cameras[i].X_CB) & set(cameras[j].X_CB))
        if shared:
            X_ij, error = pair_pose(cameras[i], cameras[j])
            pairs[i, j], pairs[j, i] = X_ij, inverse_pose(X_ij)
            # More shared instants and a smaller error make a better link; both stay positive.
            costs[i, j] = (1.0 + min(error, 1e6)) / shared
    order, parents = breadth_first_order(minimum_spanning_tree(costs), 0, directed=False)
    poses = {0: np.eye(4)}
    for child in order[1:]:
        poses[child] = poses[parents[child]] @ pairs[parents[child], child]
    X_RB = {}
    for frame in dict.fromkeys(frame for camera in cameras for frame in camera.X_CB):
        # Every camera that saw the board proposes; the smallest median error wins.
        seers = [(camera, poses[i]) for i, camera in enumerate(cameras) if frame in camera.X_CB]
        proposals = [X_RC @ camera.X_CB[frame] for camera, X_RC in seers]
        errors = [
            np.median([camera.error(frame, inverse_pose(X_RC) @ X) for camera, X_RC in seers])
            for X in proposals
        ]
        X_RB[frame] = proposals[int(np.argmin(errors))]
    lenses = {name: estimate.lens for name, estimate in estimates.items()}
    return Rig(lenses, {name: poses[i] for i, name in enumerate(estimates)}, X_RB)


def pair_pose(a: LensEstimate, b: LensEstimate) -> tuple[Array, float]:
    """The pose X_AB (4, 4) of two cameras that saw the board at the same instants, and its error.

    Each shared instant proposes a pose; the one with the least median error [pixel] over all wins.
    """
    shared = [frame for frame in a.X_CB if frame in b.X_CB]
    proposals = []
    for proposer in shared:
        X_AB = a.X_CB[proposer] @ inverse_pose(b.X_CB[proposer])
        # A proposer explains itself: it has no say where others can be asked.
        asked = [frame for frame in shared if frame != proposer] or shared
        errors = [a.error(frame, X_AB @ b.X_CB[frame]) for frame in asked]
        proposals.append((X_AB, float(np.median(errors))))
    return min(proposals, key=lambda proposal: proposal[1])


def adjust_rig(
    points: Array, detections: Detections, start: Rig, model: str, *, robust: bool
) -> Rig:
    """Moves lenses and poses until the corners are met best; the first camera's pose is held.

    Args:
        points: (n, 3) the board's corners in its frame [m].
        model: a key of FREE_COEFFICIENTS.
        robust: corners far off count little, so that a spoilt picture stands out instead of
            spoiling the others. The start must be good for most.
    """
    # In a row: each camera's lens, then each camera's pose X_CR, then each board's pose X_RB.
    poses = [inverse_pose(X) for X in start.X_RC.values()] + list(start.X_RB.values())
    rows = [np.array([*lens.numbers().values()]) for lens in start.lenses.values()] + [
        _vector(X) for X in poses
    ]
    x0, count = np.concatenate(rows), len(start.lenses)
    is_free = np.ones(len(x0), dtype=bool)
    is_free[: _LENS * count].reshape(count, -1)[:, 4 + FREE_COEFFICIENTS[model] :] = False
    is_free[_LENS * count :][:_POSE] = False
    places = {frame: k for k, frame in enumerate(start.X_RB)}
    residuals, J = _project_corners(x0, points, detections, places)
    whiten = _whitening(J[:, is_free])

    def evaluate(z: Array) -> tuple[Array, csr_array]:
        return _project_corners(unknowns(z), points, detections, places)

    def unknowns(z: Array) -> Array:
        x = x0.copy()
        x[is_free] += whiten.matvec(z)
        return x

    median = float(np.median(np.linalg.norm(residuals.reshape(-1, 2), axis=1)))
    found = least_squares(
        lambda z: evaluate(z)[0],
        np.zeros(np.count_nonzero(is_free)),
        lambda z: aslinearoperator(evaluate(z)[1][:, is_free]) @ whiten,
        loss="cauchy" if robust else "linear",
        f_scale=max(_ROBUST_PIXELS, _ROBUST_MEDIANS * median) if robust else 1.0,
        tr_solver="lsmr",
        tr_options={"atol": 1e-8, "btol": 1e-8},
        ftol=1e-6 if robust else 1e-10,
        max_nfev=_MOST_STEPS,
        xtol=1e-12,
        gtol=1e-12,
    )
    lenses, X_CR, X_RB = _split(unknowns(found.x), count)
    sizes = [(lens.width, lens.height) for lens in start.lenses.values()]
    return Rig(
        {
            name: Lens.from_numbers(size, row)
            for name, size, row in zip(start.lenses, sizes, lenses, strict=True)
        },
        {name: inverse_pose(_pose(row)) for name, row in zip(start.X_RC, X_CR, strict=True)},
        {frame: _pose(row) for frame, row in zip(start.X_RB, X_RB, strict=True)},
    )


def _whitening(J: csr_array) -> LinearOperator:
    """Units of the unknowns in which the normal matrix J^T J is 1, so that the solver converges."""
    normal = (J.T @ J).toarray()
    units = 1.0 / np.sqrt(np.maximum(np.diag(normal), np.finfo(np.float64).tiny))
    normal *= np.outer(units, units)
    normal[np.diag_indices_from(normal)] += 1e-12
    root = cholesky(normal)
    return LinearOperator(
        normal.shape,
        matvec=lambda z: units * solve_triangular(root, np.ravel(z)),
        rmatvec=lambda g: solve_triangular(root, units * np.ravel(g), trans=1),
    )


def _project_corners(
    x: Array, points: Array, detections: Detections, places: Mapping[str, int]
) -> tuple[Array, csr_array]:
    """Corner differences (2 m,) [pixel], and their derivatives (2 m, n)."""
    count = len(detections)
    lenses, X_CR, X_RB = _split(x, count)
    residuals, values, columns = [], [], []
    for i, seen in enumerate(detections.values()):
        fx, fy, cx, cy = lenses[i, :4]
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        for frame, detection in seen.items():
            k = places[frame]
            turn, shift, *chain = cv2.composeRT(X_RB[k, :3], X_RB[k, 3:], X_CR[i, :3], X_CR[i, 3:])
            uv, J = cv2.projectPoints(points[detection.corners], turn, shift, matrix, lenses[i, 4:])
            residuals.append((np.reshape(uv, (-1, 2)) - detection.uv).ravel())
            # By the board's pose, the camera's pose, and the lens.
            by_poses = J[:, :_POSE] @ np.block([chain[:4], chain[4:]])
            values.append(np.hstack([by_poses, J[:, _POSE : _POSE + _LENS]]).ravel())
            begins = _LENS * count + _POSE * (count + k), _LENS * count + _POSE * i, _LENS * i
            row = np.concatenate(
                [np.arange(b, b + n) for b, n in zip(begins, (_POSE, _POSE, _LENS), strict=True)]
            )
            columns.append(np.tile(row, len(J)))
    residual = np.concatenate(residuals)
    pointers = np.arange(len(residual) + 1) * (2 * _POSE + _LENS)
    shape = (len(residual), len(x))
    J_all = csr_array((np.concatenate(values), np.concatenate(columns), pointers), shape=shape)
    return residual, J_all


def _error(points: Array, detection: Detection, lens: Lens, X_CB: Array) -> float:
    """Root mean square corner distance [pixel]; infinite where the board is behind the camera."""
    p_C = points[detection.corners] @ X_CB[:3, :3].T + X_CB[:3, 3]
    if p_C[:, 2].min() <= 0.0:
        return float("inf")
    difference = lens.project(p_C) - detection.uv
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))


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
