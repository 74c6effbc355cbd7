"""How sure a camera's pose is, where contours do not err point by point.

There are the noise of points, the surface of a part in all frames alike, its edge in one mask, and
each frame as a whole (``fit.covariance``). How large these are is told by what is left of the
distances at the scale of the fit; frames' pulls scatter as these say, or by a factor more.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drake_pose.fit.contour_fit import pack_cameras, pixels_per_metre
from drake_pose.fit.covariance import (
    Distances,
    ErrorSizes,
    Picture,
    distances_covariance,
    distances_in_pictures,
    estimate_sizes,
    values_covariance,
    widening,
)
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.registration.calibration_fit import TOLD_APART, Calibration, CalibrationFit

Array = NDArray[np.float64]

KNOWN_BEFOREHAND = 20
"""The scale of frames' errors is known beforehand as well as so many distances tell it."""

# At this scale a calibration was fitted in the end.
_FITTED = AnnealingStage(0.005, 0.005)
# Sizes of errors are known beforehand to a factor of twenty; frames tell them.
_PRIOR_DEVIATION = 3.0
# What a picture tells of a direction is nothing below this share of what it tells best.
_TOLD = 1e-3
# Where parts err by so much [pixel], a calibration is no better than this [pixel].
_PARTS_ERR, _NO_BETTER = 0.2, 1.0


def calibration_covariance(fit: CalibrationFit, found: Calibration) -> Array:
    """(u, u) of the errors of a calibration's shared unknowns, by the names of its fit."""
    shared = len(fit.names)
    seen = _distances(fit, found, _FITTED)
    is_angle = np.zeros(seen.X.shape[1], bool)
    sizes = estimate_sizes(seen, is_angle, 0.0, _PRIOR_DEVIATION)
    covariance = values_covariance(seen, sizes, np.arange(len(is_angle)), is_angle)
    covariance *= _scatter(seen, sizes, shared)
    trusted = _calibration_error(_distances(fit, found, TOLD_APART))
    for c in range(len(fit.fits)):
        unseen = _unseen_errors(fit, found, c, trusted)
        at = np.arange(len(unseen)) + c * len(unseen)
        covariance[at, at] += unseen**2
    return covariance[:shared, :shared]


def _distances(fit: CalibrationFit, found: Calibration, step: AnnealingStage) -> Distances:
    """The distances in all pictures; their values are what is shared, then each mask's width."""
    rows = [(c, int(k)) for c, frames in enumerate(fit.which) for k in frames]
    shared = len(fit.names)
    pictures = []
    for place, (c, k) in enumerate(rows):
        own, width, X_CW = fit.fits[c], float(found.widths[c][k]), found.X_CW[c]
        values = fit.values(found, c, k)
        compared = own.compare(X_CW, k, step, width, values, found.log_focal[c])
        X_WN = compared.placement.X_WN
        camera = own.frames.camera.with_pose(np.linalg.inv(X_CW))
        size = 1.0 / float(pixels_per_metre(pack_cameras([camera]), X_WN[:, :3, 3].mean(axis=0))[0])
        moves = np.zeros((len(X_WN), shared + len(rows), 12))
        moves[:, :shared] = fit.motions(found, c, compared.placement.dense(len(values)))
        for n, (outline, X) in enumerate(zip(own.contours.outlines, X_WN, strict=True)):
            if len(outline.vertices):
                moves[n, shared + place] = widening(outline.vertices, X) * size
        pictures.append(Picture(compared.A[0], compared.b[0], X_WN, X_CW, moves, size))
    return distances_in_pictures(fit.fits[0].contours.outlines, pictures)


def _scatter(seen: Distances, sizes: ErrorSizes, shared: int) -> float:
    """By what factor frames disagree more about what they share than errors say: of variances.

    Each frame's distances along what it tells of the shared values, its width put right, are
    normal with a known covariance about what these values make of them.
    """
    V = distances_covariance(seen, sizes)
    designs, lefts = [], []
    for picture in np.unique(seen.pictures):
        rows = np.flatnonzero(seen.pictures == picture)
        X, widths = np.split(seen.X[rows], [shared], axis=1)
        X = X - widths @ np.linalg.pinv(widths) @ X
        U, told, _ = np.linalg.svd(X, full_matrices=False)
        U = U[:, told > _TOLD * told.max()]
        L = np.linalg.cholesky(U.T @ V[np.ix_(rows, rows)] @ U)
        designs.append(np.linalg.solve(L, U.T @ X))
        lefts.append(np.linalg.solve(L, U.T @ seen.y[rows]))
    if not designs:
        return 1.0
    design, left = np.concatenate(designs), np.concatenate(lefts)
    by, _, rank, _ = np.linalg.lstsq(design, left)
    off = left - design @ by
    scale = (KNOWN_BEFOREHAND + float(off @ off)) / (KNOWN_BEFOREHAND + len(off) - rank)
    # Frames that agree by chance are no surer.
    return max(scale, 1.0)


def _calibration_error(seen: Distances) -> float:
    """By how much a calibration may be off that no frame contradicts [pixel].

    Wrong intrinsics err alike in all frames: the pose follows, and nothing is left of it. So where
    parts are seen to err, a calibration is not trusted beyond a pixel either. What comes again
    where a part stands still may be the part's surface: none of it counts as noise here.
    """
    seen = seen._replace(effects=seen.effects._replace(repeated=seen.effects.noise))
    sizes = estimate_sizes(seen, np.zeros(seen.X.shape[1], bool), 0.0, _PRIOR_DEVIATION)
    return min(_NO_BETTER, _NO_BETTER * (sizes.surface**2 + sizes.mask**2) / _PARTS_ERR**2)


def _unseen_errors(fit: CalibrationFit, found: Calibration, camera: int, pixels: float) -> Array:
    """(6 or 7,) by how much a camera's turn, shift and focal length are off then: deviations."""
    frames = fit.fits[camera].frames
    X_CW = found.X_CW[camera]
    depth = float(X_CW[2, :3] @ frames.middle + X_CW[2, 3])
    size = pixels * depth / frames.camera.focal_x
    turn = size / frames.extent
    return np.array([turn, turn, turn, size, size, size * depth / frames.extent, turn])[
        : fit.per_camera
    ]


def pose_covariance(moved: Callable[[Array], Array], covariance: Array) -> Array:
    """(6, 6) of a camera's error in the world: a rotation vector [rad], a shift [m].

    Args:
        moved: gives X_CW (4, 4) after a change by POSE_NAMES (6,) from where it was fitted.
        covariance: (6, 6) of these as they were fitted.
    """
    X_CW = moved(np.zeros(6))
    R_WC, p_WC = X_CW[:3, :3].T, -X_CW[:3, :3].T @ X_CW[:3, 3]
    J = np.zeros((6, 6))
    step = 1e-6
    for k in range(6):
        X_WC = np.linalg.inv(moved(step * np.eye(6)[k]))
        turn = X_WC[:3, :3] @ R_WC.T
        J[:3, k] = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / step
        J[3:, k] = (X_WC[:3, 3] - p_WC) / step
    return np.asarray(J @ covariance @ J.T)
