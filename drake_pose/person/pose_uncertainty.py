"""How sure a pose is that was fitted to silhouettes.

Distances of the frame's contours give the noise, of one part in one camera together, and how far
each part's surface is off the model's: variance components by restricted maximum likelihood
(Patterson and Thompson 1971). What silhouettes do not tell is as unsure as the limits let it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.fit.contour_fit import Comparison, ContourFit
from drake_pose.fit.covariance import surface_deformations

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# How far parts' surfaces may be off the model's [m].
_SURFACES = 0.0005 * np.sqrt(2.0) ** np.arange(13)
# The fit's own noise counts as much as this many distances.
_ASSUMED = 4.0
# A person is somewhere in a place as large [m].
_PLACE = 10.0


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """How sure a pose is.

    Args:
        covariance: (m, m) of the pose tree's values [rad, m].
        information: (m, m) by the silhouettes alone, of all values, held ones included.
        noise: the variance of the contours' distances, 1 as the fit's noise says.
        surface: how far the parts' surfaces are off the model's [m].
    """

    covariance: Array
    information: Array
    noise: float
    surface: float


def pose_uncertainty(
    fit: ContourFit,
    compared: Comparison,
    held: Mask | None = None,
    held_covariance: Array | None = None,
) -> PoseUncertainty:
    """The uncertainty of a fitted pose by the pictures and the limits, without the last frame.

    Args:
        compared: what the cameras say of the pose at the scale of the last step.
        held: (m,) values that were held, such as lengths.
        held_covariance: (h, h) of these; None: they are exact.
    """
    size = len(fit.lower)
    held = np.zeros(size, dtype=np.bool_) if held is None else held
    free = np.flatnonzero(~held)
    A = np.tril(compared.A) + np.swapaxes(np.tril(compared.A, -1), -1, -2)
    # (nodes, m, 12): what each value does to each node.
    moves = compared.placement.dense(size)
    apriori = _limits_information(fit)
    parts = _parts(fit, compared, A)
    between = _noise(A, parts.left, parts.alone)
    likelihoods = [
        _with_surfaces(parts, between, surface, moves, free, apriori)[0] for surface in _SURFACES
    ]
    surface = float(_SURFACES[int(np.argmax(likelihoods))])
    # The nearest points of two contours are nearer than those that belong together. So the noise
    # that counts is the larger one: of the whole body's distances, the surface's share included.
    own = (moves @ A.sum(axis=0) @ np.swapaxes(moves, 1, 2)).sum(axis=0)[np.ix_(free, free)]
    V = np.linalg.inv(own + np.diag(apriori[free]))
    Q = np.swapaxes(moves[:, free], 1, 2) @ V @ moves[:, free]
    noise = max(between, _noise(A, compared.b, Q))
    H = _with_surfaces(parts, noise, surface, moves, free, apriori)[1]
    covariance = np.zeros((size, size))
    own = np.linalg.inv(H[np.ix_(free, free)] + np.diag(apriori[free]))
    covariance[np.ix_(free, free)] = own
    if held_covariance is not None and held.any():
        follow = np.eye(size)[:, held]
        follow[free] = -own @ H[np.ix_(free, held)]
        covariance += follow @ held_covariance @ follow.T
    return PoseUncertainty(covariance, H, noise, surface)


def _limits_information(fit: ContourFit) -> Array:
    """(m,) what limits tell: as much as an even distribution between them has variance."""
    widest = np.where(fit.kinematics.is_angle, 2.0 * np.pi, _PLACE)
    span = np.minimum(fit.upper - fit.lower, widest)
    return np.asarray(12.0 / np.maximum(span, 1e-6) ** 2)


def _noise(A: Array, b: Array, Q: Array) -> float:
    """The variance of distances (A, b of a comparison); Q (nodes, 12, 12): motions' covariance."""
    shares = Q @ A
    # What was fitted follows the distances: they are as much smaller as it has freedom.
    freedom = np.einsum("cnii->", shares) - np.einsum("cnij,cnji->", shares, shares)
    pulls = np.einsum("cni,nij,cnj->", b, Q, b)
    return float((pulls + _ASSUMED) / (max(freedom, 0.0) + _ASSUMED))


class _Parts(NamedTuple):
    """What all cameras together say of each part by itself, along independent directions.

    A: (nodes, 12, 12); b: (nodes, 12); directions: (nodes, 12, 12) in columns, each a motion of the
    surface by about a metre; information: (nodes, 12) about each; alone: (nodes, 12, 12) covariance
    of each part's affine motion; left: (cameras, nodes, 12) b where each part fits best by itself.
    """

    A: Array
    b: Array
    directions: Array
    information: Array
    alone: Array
    left: Array


def _parts(fit: ContourFit, compared: Comparison, A: Array) -> _Parts:
    """All parts, each free to shift, turn and stretch; A: (cameras, nodes, 12, 12), symmetric."""
    K = np.array(
        [
            surface_deformations(outline.vertices, X_WN)
            for outline, X_WN in zip(fit.outlines, compared.placement.X_WN, strict=True)
        ]
    )
    whole, b = A.sum(axis=0), compared.b.sum(axis=0)
    information, turns = np.linalg.eigh(np.swapaxes(K, 1, 2) @ whole @ K)
    information, K = np.maximum(information, 0.0), K @ turns
    alone = (K / (information + _SURFACES[-1] ** -2)[:, None]) @ np.swapaxes(K, 1, 2)
    left = compared.b - np.einsum("cnij,njk,nk->cni", A, alone, b)
    return _Parts(whole, b, K, information, alone, left)


def _with_surfaces(
    parts: _Parts,
    noise: float,
    surface: float,
    moves: Array,
    free: NDArray[np.intp],
    apriori: Array,
) -> tuple[float, Array]:
    """The likelihood of the distances where surfaces are so far off, and the information (m, m)."""
    information = parts.information / noise
    pulls = np.einsum("nij,ni->nj", parts.directions, parts.b) / noise
    share = 1.0 / (information + surface**-2)
    across = parts.A @ parts.directions / noise
    A = parts.A / noise - (across * share[:, None]) @ np.swapaxes(across, 1, 2)
    b = parts.b / noise - np.einsum("nij,nj->ni", across, share * pulls)
    H = (moves @ A @ np.swapaxes(moves, 1, 2)).sum(axis=0)
    g = np.einsum("njk,nk->j", moves, b)[free]
    own = H[np.ix_(free, free)] + np.diag(apriori[free])
    explained = (share * pulls**2).sum() + g @ np.linalg.solve(own, g)
    freedom = np.log1p(surface**2 * information).sum() + np.linalg.slogdet(own)[1]
    return float(0.5 * (explained - freedom)), H
