"""Covariance of fitted values whose contours do not err point by point.

Five errors make the contours of a body and of its silhouettes differ: noise of points; noise that
is repeated in all pictures of a part that stands still before a camera; the surface of a part,
which all cameras see shifted, turned and stretched alike; a part's edge in one mask, likewise; and
a camera, which stands or looks a little elsewhere than its calibration says. Their sizes are
estimated from the residuals of the distances: variance components by restricted maximum likelihood
(Patterson and Thompson 1971) in steps of average information (Gilmour, Thompson and Cullis 1995),
each with a prior of about a pixel, as a single instant tells little of them.

A camera's error hardly shows in the residuals, for the joints follow it. So a calibration is not
trusted beyond a pixel, however well everything fits.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotri
from threadpoolctl import ThreadpoolController

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.fit.contour_fit import Comparison, pixels_per_metre, symmetric
from drake_pose.silhouette.outline import Outline

# Of some hundred rows BLAS's threads wait for each other: it is ten times as slow with two.
_on_one_thread = ThreadpoolController().wrap(limits=1, user_api="blas")


class ErrorSizes(NamedTuple):
    """Standard deviations of what makes contours differ.

    Attributes:
        noise: of a point of contour, as the fit weights it.
        repeated: the same of what noise repeats in all pictures of a part that stands still before
            a camera; 0 where no part does.
        surface, mask, camera: how far they move contours [the unit of the distances].
        nuisances: of each group of what is doubted [its own unit].
    """

    noise: float
    repeated: float
    surface: float
    mask: float
    camera: float
    nuisances: tuple[float, ...] = ()


class Distances(NamedTuple):
    """Residuals of the contours' distances, in independent combinations.

    Attributes:
        y: (n,) the distances.
        X: (n, m) their derivatives by the values.
        effects: (5, n, n) their covariances if each error of ``ErrorSizes`` has the size one.
        information: (m, m) about the values, were all errors independent.
        bends: (n, 12 nodes) derivatives by the parts' surfaces, which all pictures see alike.
        pictures: (n,) the picture of each.
        nuisances: (n, k) derivatives, by groups, by what may be off in all pictures and is not
            among the values, such as joints' offsets; each by a unit of its group.
    """

    y: Array
    X: Array
    effects: Array
    information: Array
    bends: Array
    pictures: Indices
    nuisances: tuple[Array, ...] = ()


class ComparedMask(NamedTuple):
    """A body's contours compared with one silhouette.

    Attributes:
        A: (nodes, 12, 12), lower triangles, and b: (nodes, 12), as of ``Comparison``.
        X_WN: (nodes, 4, 4) where the body stands.
        X_CW: (4, 4) the world's pose in the camera.
        moves: (nodes, m, 12) the affine motions that the m values give to the nodes.
        size: the unit of errors, at the body [m].
        camera: the camera's index.
    """

    A: Array
    b: Array
    X_WN: Array
    X_CW: Array
    moves: Array
    size: float
    camera: int = 0


def error_unit(size: float) -> float:
    """The unit of masks' and cameras' errors [pixel]: one, or a 200th of the silhouettes' size.

    size: the root of the silhouettes' area [pixel].
    """
    return max(1.0, size / 200.0)


def distances(
    outlines: Sequence[Outline],
    cameras: tuple[Array, Array],
    compared: Comparison,
    moves: Array,
    unit: float,
) -> Distances:
    """The distances at a fitted pose.

    Args:
        outlines: the nodes' surfaces.
        cameras: packed, see ``pack_cameras``.
        compared: the comparison at the pose.
        moves: (nodes, m, 12) the affine motions that the values give to the nodes.
        unit: of errors [pixel].
    """
    X_WN = compared.placement.X_WN
    size = unit / pixels_per_metre(cameras, X_WN[:, :3, 3].mean(axis=0))
    pictures = [
        ComparedMask(A, b, X_WN, X_CW, moves, float(one))
        for A, b, X_CW, one in zip(compared.A, compared.b, cameras[0], size, strict=True)
    ]
    return distances_in_masks(outlines, pictures)


def distances_in_masks(
    outlines: Sequence[Outline],
    pictures: Sequence[ComparedMask],
    most: int = 400,
    widths: bool = False,
) -> Distances:
    """The distances in several masks, each of which errs as a whole, too.

    Args:
        outlines: the nodes' surfaces.
        pictures: the masks, each with the same values.
        most: number of independent distances that are used, the best known ones.
        widths: whether each silhouette may be too wide on all sides, by a further value [unit].
    """
    if widths:
        seen, wider = [[len(outline.vertices) > 0] for outline in outlines], []
        for one, wide in zip(pictures, np.eye(len(pictures)), strict=True):
            # A part's surface is a metre wider on all sides; one without any is nowhere.
            by = surface_deformations(outlines, one.X_WN)[:, :, [3, 7, 11]].sum(axis=2)
            by = (by * one.size * seen)[:, None] * wide[:, None]
            wider.append(one._replace(moves=np.concatenate([one.moves, by], axis=1)))
        pictures = wider
    of, along, bends = _known_directions(outlines, pictures, most)
    count = pictures[0].moves.shape[1]
    y, X, shaken = np.zeros(len(of)), np.zeros((len(of), count)), np.zeros((len(of), 6))
    information = np.zeros((count, count))
    for c, one in enumerate(pictures):
        at = np.flatnonzero(of[:, 0] == c)
        parts = of[at, 1]
        rows = np.einsum("ri,rij->rj", along[at], symmetric(one.A)[parts])
        y[at] = np.einsum("ri,ri->r", along[at], one.b[parts])
        X[at] = np.einsum("rj,rmj->rm", rows, one.moves[parts])
        shaken[at] = rows @ _camera_motions(outlines, one)
        # Of many values a picture tells few: of all pictures' own ones none but its own.
        own = np.flatnonzero(one.moves.any(axis=(0, 2)))
        moves = one.moves[:, own]
        told = moves @ symmetric(one.A) @ np.swapaxes(moves, 1, 2)
        information[np.ix_(own, own)] += told.sum(axis=0)
    same_picture, same_part = (of[:, None, k] == of[None, :, k] for k in range(2))
    alike = bends @ bends.T * same_part
    view = _views(outlines, pictures)[of[:, 0], of[:, 1]]
    turns = bends / np.linalg.norm(bends, axis=1, keepdims=True)
    repeated = turns @ turns.T * same_part * (view[:, None] == view)
    of_part = of[:, 1, None] == np.arange(len(outlines))
    camera = shaken @ shaken.T * same_picture
    return Distances(
        y=y,
        X=X,
        effects=np.array([np.eye(len(of)), repeated, alike, alike * same_picture, camera]),
        information=information,
        bends=(of_part[:, :, None] * bends[:, None]).reshape(len(of), 12 * len(outlines)),
        pictures=of[:, 0],
    )


def _known_directions(
    outlines: Sequence[Outline], pictures: Sequence[ComparedMask], most: int
) -> tuple[Indices, Array, Array]:
    """Affine motions of parts, each with a distance that a picture tells, best known ones first.

    Returns: picture and node (n, 2) of each; the motion (n, 12) by which it changes by one
    deviation; and its derivative by deformations of the part's surface (n, 12).
    """
    mean_size = float(np.mean([picture.size for picture in pictures]))
    found: list[tuple[Array, Indices, Indices, Array, Array]] = []
    for c, one in enumerate(pictures):
        A = symmetric(one.A)
        seen = np.flatnonzero(np.einsum("nii->n", A) > 0.0)
        D = mean_size * surface_deformations([outlines[n] for n in seen.tolist()], one.X_WN[seen])
        shares, turns = np.linalg.eigh(np.swapaxes(D, 1, 2) @ A[seen] @ D)
        # Motions by a unit that are seen along less contour are as noise.
        k, j = np.nonzero(shares >= 1.0)
        known, turned = shares[k, j], turns[k, :, j]
        root = np.sqrt(known)[:, None]
        along = np.einsum("rij,rj->ri", D[k], turned) / root
        found.append((known, np.full(len(k), c), seen[k], along, root * turned))
    known, picture, part, along, bends = (np.concatenate(one) for one in zip(*found, strict=True))
    best = np.argsort(-known, kind="stable")[:most]
    return np.column_stack([picture, part])[best], along[best], bends[best]


def _views(outlines: Sequence[Outline], pictures: Sequence[ComparedMask]) -> Indices:
    """(pictures, nodes) the first picture that showed a part where this one does.

    A part stands still where it moves by less than half the unit.
    """
    X_CN = np.array([one.X_CW @ one.X_WN for one in pictures])[:, :, :3]
    found = np.tile(np.arange(len(pictures))[:, None], len(outlines))
    for n, outline in enumerate(outlines):
        for c, one in enumerate(pictures if len(outline.vertices) else ()):
            by = X_CN[: c + 1, n] - X_CN[c, n]
            still = np.einsum("kij,jl,kil->k", by, outline.moments, by) < (0.5 * one.size) ** 2
            found[c, n] = found[np.flatnonzero(still)[0], n]
    return found


def surface_deformations(outlines: Sequence[Outline], X_WN: Array) -> Array:
    """(n, 12, 12) affine motions, in columns, that move each part's surface by about a metre."""
    R, moments = X_WN[:, :3, :3], np.array([one.moments for one in outlines]).reshape(-1, 4, 4)
    middles = moments[:, 3, :3]
    squares = np.diagonal(moments, axis1=1, axis2=2)[:, :3] - middles**2
    sizes = np.sqrt(np.maximum(squares, 1e-6))
    stretches = np.einsum("nxi,nyj->nijxy", R, R / sizes[:, None])
    shifts = -(stretches @ (X_WN[:, :3, 3:] + R @ middles[..., None])[:, None, None])
    K = np.zeros((len(R), 12, 12))
    K[:, [3, 7, 11], :3] = R
    K[:, :, 3:] = np.swapaxes(np.concatenate([stretches, shifts], axis=4).reshape(-1, 9, 12), 1, 2)
    return K


def _camera_motions(outlines: Sequence[Outline], one: ComparedMask) -> Array:
    """(12, 6) the body's shifts along and turns about a camera's axes, by about the unit."""
    placed = zip(outlines, one.X_WN, strict=True)
    moments = sum(len(own.vertices) * (X @ own.moments @ X.T) for own, X in placed)
    moments = np.asarray(moments) / sum(len(own.vertices) for own in outlines)
    middle = moments[3, :3]
    extent = math.sqrt(max(float(np.trace(moments[:3, :3]) - middle @ middle), 1e-18))
    motions = np.zeros((12, 6))
    for k, axis in enumerate(one.X_CW[:3, :3]):
        M = np.cross(np.eye(3), axis).T / extent
        motions[[3, 7, 11], k] = axis
        motions[:, 3 + k] = np.column_stack([M, -M @ middle]).ravel()
    return motions * one.size


@_on_one_thread
def estimate_sizes(
    seen: Distances,
    is_angle: Mask,
    least_camera: float = 1.0,
    prior_deviation: float = 1.0,
    settled: float = 0.03,
) -> ErrorSizes:
    """The likeliest sizes of the errors, given the residuals and the prior.

    Args:
        seen: the distances.
        is_angle: (m,) which values are angles.
        least_camera: a camera errs by no less [of the unit].
        prior_deviation: standard deviation of the sizes' logarithms about the unit.
        settled: steps end where logarithms of sizes change by no more.
    """
    n = len(seen.y)
    stands_still = np.abs(seen.effects[1] - seen.effects[0]).max(initial=0.0) > settled
    # Of parts that move, noise is not repeated.
    told = [0, 1, 2, 3, 4] if stands_still else [0, 2, 3, 4]
    effects = [*seen.effects[told], *(Z @ Z.T for Z in seen.nuisances)]
    stacked = np.reshape(effects, (len(effects), -1))

    apriori = _apriori(is_angle)

    def likelihood(t: Array) -> tuple[float, Array, Array]:
        """Restricted log-likelihood and prior of sizes' logarithms t (k,); P (n, n); P y (n,)."""
        L = np.linalg.cholesky((np.exp(2.0 * t) @ stacked).reshape(n, n))
        inverse = symmetric(dpotri(L.T)[0].T)
        VX = inverse @ seen.X
        H = seen.X.T @ VX + apriori
        P = inverse - VX @ np.linalg.solve(H, VX.T)
        Py = P @ seen.y
        freedom = 2.0 * np.log(np.diag(L)).sum() + np.linalg.slogdet(H)[1]
        return -0.5 * float(freedom + seen.y @ Py + (t @ t) / prior_deviation**2), P, Py

    t = np.zeros(len(effects))
    value, P, Py = likelihood(t)
    # All may be smaller alike by much, to which single steps would be many.
    smaller = np.full(len(t), 0.5 * np.log(max(float(seen.y @ Py), 1e-9) / max(n, 1)))
    scaled = likelihood(smaller)
    if scaled[0] > value:
        t, (value, P, Py) = smaller, scaled
    longest = 1.0
    for _ in range(20):
        scales = 2.0 * np.exp(2.0 * t)
        WPy = np.array([W @ Py for W in effects])
        g = 0.5 * scales * (WPy @ Py - stacked @ P.ravel()) - t / prior_deviation**2
        # Average information: no product of whole matrices, unlike Fisher's.
        average = 0.5 * np.outer(scales, scales) * (WPy @ P @ WPy.T)
        step = np.linalg.solve(average + np.eye(len(t)) / prior_deviation**2, g)
        step *= min(1.0, longest / max(np.abs(step).max(), 1e-9))
        trial = likelihood(t + step)
        while trial[0] < value and np.abs(step).max() > settled:
            step *= 0.5
            trial = likelihood(t + step)
        if trial[0] < value:
            break
        gain, longest = trial[0] - value, min(1.0, 1.25 * np.abs(step).max())
        t, (value, P, Py) = t + step, trial
        if gain < 0.05 or np.abs(step).max() < settled:
            break
    sizes = np.zeros(5)
    sizes[told] = np.exp(t[: len(told)])
    noise, repeated, surface, mask, camera = sizes.tolist()
    nuisances = tuple(np.exp(t[len(told) :]).tolist())
    return ErrorSizes(noise, repeated, surface, mask, max(camera, least_camera), nuisances)


@_on_one_thread
def values_covariance(
    seen: Distances, sizes: ErrorSizes, free: NDArray[np.intp], is_angle: Mask
) -> Array:
    """(f, f) covariance of the free values, which were fitted as if errors were independent.

    It is H^-1 J^T V J H^-1 (the sandwich of Huber 1967), V the covariance of the distances.
    """
    white = sizes.noise**2 + sizes.repeated**2
    own = seen.X[:, free]
    V = distances_covariance(seen, sizes)
    apriori = white * _apriori(is_angle)[np.ix_(free, free)]
    H = seen.information[np.ix_(free, free)] + apriori
    # What is not among the distances, and what is known beforehand, is as noise.
    inverse = np.linalg.inv(H)
    return np.asarray(inverse @ (own.T @ V @ own + white * (H - own.T @ own)) @ inverse)


def distances_covariance(seen: Distances, sizes: ErrorSizes) -> Array:
    """(n, n) of the distances, nuisances left out."""
    parts = zip(sizes[:5], seen.effects, strict=True)
    return sum((size**2 * W for size, W in parts), np.zeros((len(seen.y), len(seen.y))))


@_on_one_thread
def nuisance_covariance(
    seen: Distances, sizes: ErrorSizes, is_angle: Mask
) -> tuple[Array, Distances]:
    """Covariance (m, m) of the values due to nuisances, and the distances without them.

    Doubts were not fitted, so the values follow them: by the nuisances' variance, and the square of
    their likeliest values by the residuals (best linear unbiased prediction, Henderson 1975).
    """
    white = sizes.noise**2 + sizes.repeated**2
    A = np.concatenate(seen.nuisances, axis=1)
    variances = np.repeat(np.square(sizes.nuisances), [Z.shape[1] for Z in seen.nuisances])
    inverse = np.linalg.inv(distances_covariance(seen, sizes) + (A * variances) @ A.T)
    VX, apriori = inverse @ seen.X, _apriori(is_angle)
    left = inverse @ seen.y - VX @ np.linalg.solve(seen.X.T @ VX + apriori, VX.T @ seen.y)
    likeliest = variances * (A.T @ left)
    follow = np.linalg.solve(seen.information + white * apriori, seen.X.T @ A)
    off = follow @ likeliest
    without = seen._replace(y=seen.y - A @ likeliest, nuisances=())
    return (follow * variances) @ follow.T + np.outer(off, off), without


@_on_one_thread
def score_nuisances(seen: Distances, sizes: ErrorSizes) -> tuple[Array, Array]:
    """(k,) value and standard deviation of each doubt, one group after another [its unit].

    Each is what explains the residuals best by itself, beside the values (score test, Rao 1948).
    """
    if not seen.nuisances:
        return np.zeros(0), np.zeros(0)
    A = np.concatenate(seen.nuisances, axis=1)
    inverse = np.linalg.inv(distances_covariance(seen, sizes))
    VX = inverse @ seen.X
    P = inverse - VX @ np.linalg.pinv(seen.X.T @ VX) @ VX.T
    weights = np.maximum(np.einsum("nk,nm,mk->k", A, P, A, optimize=True), 1e-12)
    return A.T @ P @ seen.y / weights, weights**-0.5


def _apriori(is_angle: Mask) -> Array:
    """(m, m) information of an even distribution over a full turn, or over ten metres."""
    return np.diag(12.0 / np.where(is_angle, 2.0 * np.pi, 10.0) ** 2)


def vuong_statistic(pieces: Array, others: Array) -> float:
    """By how many standard deviations costs by pieces of pictures are above others (same shape).

    Vuong's test (1989): differences of pieces scatter as that of the whole does by chance. What no
    pose explains costs both alike.
    """
    more = pieces - others
    return float(more.sum() / max(np.sqrt(float((more**2).sum())), 1e-9))
