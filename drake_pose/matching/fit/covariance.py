"""How sure fitted values are where contours do not err point by point.

Four things make the contours of a body and of its silhouettes differ: the noise of their points;
the surface of a part, which all cameras see shifted, turned and stretched alike; a part's edge in
one camera's mask, so too; and a camera, which stands or looks a little elsewhere than its
calibration says. How large they are is estimated from what is left of the distances once the values
are fitted: variance components by restricted maximum likelihood (Patterson and Thompson 1971) in
steps of Fisher's scoring, each with a prior of about a pixel, for a single instant tells little of
them.

A camera's error hardly shows in what is left, for the joints follow it. So a calibration is not
trusted beyond a pixel, however well everything fits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.matching.fit.contour_fit import Comparison, ContourFit, Views, pixels_per_metre

Array = NDArray[np.float64]

# A camera's picture is off by no less [of the unit].
_LEAST_CAMERA = 1.0
# Standard deviation of the logarithms of sizes about the unit, before anything is seen.
_PRIOR_DEVIATION = 1.0
# A motion by a unit that is seen along less contour than this is as noise [units].
_LEAST_INFORMATION = 1.0
# At most so many independent distances are looked at, the best known ones.
_MOST_DISTANCES = 400
_ITERATIONS, _SETTLED = 20, 0.03
# A place is known to about as much, and an angle to a full turn [m, rad].
_PLACE = 10.0


class ErrorSizes(NamedTuple):
    """Standard deviations of what makes contours differ.

    Attributes:
        noise: of a point of contour, as the fit weights it.
        surface, mask, camera: how far they move contours [the unit of the distances].
    """

    noise: float
    surface: float
    mask: float
    camera: float


class Distances(NamedTuple):
    """What is left of the contours' distances, in independent combinations.

    Attributes:
        y: (n,) the distances.
        X: (n, m) how they follow the values.
        effects: (n, n) covariances that surfaces, masks' parts and cameras make that err by a unit.
        information: (m, m) what all distances tell of the values where each errs by itself.
    """

    y: Array
    X: Array
    effects: tuple[Array, Array, Array]
    information: Array


def distances(fit: ContourFit, views: Views, compared: Comparison, unit: float) -> Distances:
    """The distances at a pose that was fitted.

    Args:
        fit: what fitted it.
        views: what the cameras say.
        compared: the comparison at the pose.
        unit: in which errors are measured [pixel].
    """
    X_WN = compared.placement.X_WN
    A = np.tril(compared.A) + np.swapaxes(np.tril(compared.A, -1), -1, -2)
    moves = compared.placement.dense(len(fit.kinematics.names))
    size = unit / pixels_per_metre(views.cameras, X_WN[:, :3, 3].mean(axis=0))
    shakes = _camera_motions(fit, views, X_WN, size)
    found: list[tuple[float, int, int, Array, Array, Array, float]] = []
    for c, n in np.argwhere(np.einsum("cnii->cn", A) > 0.0):
        D = surface_deformations(fit.outlines[n].vertices, X_WN[n]) * size.mean()
        share, turns = np.linalg.eigh(D.T @ A[c, n] @ D)
        for known, turn in zip(share, turns.T, strict=True):
            if known >= _LEAST_INFORMATION:
                along = D @ turn / np.sqrt(known)
                row = along @ A[c, n]
                found.append(
                    (known, int(c), int(n), row @ moves[n].T, np.sqrt(known) * turn,
                     row @ shakes[c], float(along @ compared.b[c, n]))
                )  # fmt: skip
    found = sorted(found, key=lambda one: -one[0])[:_MOST_DISTANCES]
    of = np.array([(one[1], one[2]) for one in found]).reshape(-1, 2)
    bends = np.array([one[4] for one in found]).reshape(-1, 12)
    shaken = np.array([one[5] for one in found]).reshape(-1, 6)
    same_camera, same_part = (of[:, None, k] == of[None, :, k] for k in range(2))
    alike = bends @ bends.T * same_part
    return Distances(
        y=np.array([one[6] for one in found]),
        X=np.array([one[3] for one in found]).reshape(-1, moves.shape[1]),
        effects=(alike, alike * same_camera, shaken @ shaken.T * same_camera),
        information=(moves @ A.sum(axis=0) @ np.swapaxes(moves, 1, 2)).sum(axis=0),
    )


def surface_deformations(vertices: Array, X_WN: Array) -> Array:
    """(12, 12) affine motions, in columns, that each move a part's surface by about one metre."""
    R = X_WN[:3, :3]
    middle = vertices.mean(axis=0)
    sizes = np.maximum(np.sqrt(((vertices - middle) ** 2).mean(axis=0)), 1e-3)
    K = np.zeros((12, 12))
    for i in range(3):
        K[[3, 7, 11], i] = R[:, i]
        for j in range(3):
            M = np.outer(R[:, i], R[:, j]) / sizes[j]
            v = -M @ (X_WN[:3, 3] + R @ middle)
            K[:, 3 + 3 * i + j] = np.column_stack([M, v]).ravel()
    return K


def _camera_motions(fit: ContourFit, views: Views, X_WN: Array, size: Array) -> Array:
    """(cameras, 12, 6) the body's shifts along and turns about the axes of cameras.

    Each moves it by about so much: size (cameras,) [m].
    """
    points = np.vstack(
        [one.vertices @ X[:3, :3].T + X[:3, 3] for one, X in zip(fit.outlines, X_WN, strict=True)]
    )
    middle = points.mean(axis=0)
    extent = max(float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean())), 1e-9)
    motions = np.zeros((len(size), 12, 6))
    for c, X_CW in enumerate(views.cameras[0]):
        for k, axis in enumerate(X_CW[:3, :3]):
            M = np.cross(np.eye(3), axis).T / extent
            motions[c, [3, 7, 11], k] = axis
            motions[c, :, 3 + k] = np.column_stack([M, -M @ middle]).ravel()
        motions[c] *= size[c]
    return motions


def estimate_sizes(seen: Distances, is_angle: NDArray[np.bool_]) -> ErrorSizes:
    """How large the errors are: the likeliest, given what is left and the prior.

    Args:
        seen: the distances.
        is_angle: (m,) which values are angles.
    """
    n = len(seen.y)
    effects = (np.eye(n), *seen.effects)
    apriori = _apriori(is_angle)

    def likelihood(t: Array) -> tuple[float, Array, Array]:
        V = sum((np.exp(2.0 * a) * W for a, W in zip(t, effects, strict=True)), np.zeros((n, n)))
        inverse = np.linalg.inv(V)
        VX = inverse @ seen.X
        H = seen.X.T @ VX + apriori
        P = inverse - VX @ np.linalg.solve(H, VX.T)
        Py = P @ seen.y
        freedom = np.linalg.slogdet(V)[1] + np.linalg.slogdet(H)[1]
        return -0.5 * float(freedom + seen.y @ Py + (t @ t) / _PRIOR_DEVIATION**2), P, Py

    t = np.zeros(len(effects))
    value, P, Py = likelihood(t)
    for _ in range(_ITERATIONS):
        shares = [2.0 * np.exp(2.0 * a) * (P @ W) for a, W in zip(t, effects, strict=True)]
        pulls = [2.0 * np.exp(2.0 * a) * (Py @ W @ Py) for a, W in zip(t, effects, strict=True)]
        g = 0.5 * (np.array(pulls) - [np.trace(one) for one in shares]) - t / _PRIOR_DEVIATION**2
        fisher = np.array([[0.5 * np.sum(one * other.T) for one in shares] for other in shares])
        step = np.linalg.solve(fisher + np.eye(len(t)) / _PRIOR_DEVIATION**2, g)
        step /= max(1.0, np.abs(step).max())
        trial = likelihood(t + step)
        while trial[0] < value and np.abs(step).max() > _SETTLED:
            step *= 0.5
            trial = likelihood(t + step)
        if trial[0] < value:
            break
        t, (value, P, Py) = t + step, trial
        if np.abs(step).max() < _SETTLED:
            break
    noise, surface, mask, camera = np.exp(t)
    return ErrorSizes(noise, surface, mask, max(camera, _LEAST_CAMERA))


def values_covariance(
    seen: Distances, sizes: ErrorSizes, free: NDArray[np.intp], is_angle: NDArray[np.bool_]
) -> Array:
    """(f, f) covariance of the free values, fitted as if each distance erred by itself.

    That is no better than the fit: H^-1 J^T V J H^-1 (the sandwich of Huber 1967), where V is the
    covariance of the distances.
    """
    white = sizes.noise**2
    own = seen.X[:, free]
    V = sum(
        (size**2 * W for size, W in zip(sizes[1:], seen.effects, strict=True)),
        np.zeros((len(own), len(own))),
    )
    apriori = white * _apriori(is_angle)[np.ix_(free, free)]
    H = seen.information[np.ix_(free, free)] + apriori
    # What is not among the distances, and what is known beforehand, is as noise.
    inverse = np.linalg.inv(H)
    return np.asarray(inverse @ (own.T @ V @ own + white * H) @ inverse)


def _apriori(is_angle: NDArray[np.bool_]) -> Array:
    """(m, m) information: as much as an even distribution over its range has variance."""
    return np.diag(12.0 / np.where(is_angle, 2.0 * np.pi, _PLACE) ** 2)
