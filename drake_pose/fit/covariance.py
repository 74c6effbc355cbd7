"""Covariance of fitted values when the errors of contour points are correlated.

Five errors separate the contours of a body from those of its silhouettes: independent noise of
points; noise repeated in all images of a part that is static relative to a camera; the surface of a
part, shifted, rotated and stretched alike for all cameras; a part's edge in one mask, likewise; and
the extrinsics of a camera. Their standard deviations are variance components, estimated from the
residuals by restricted maximum likelihood (Patterson and Thompson 1971) with average-information
steps (Gilmour, Thompson and Cullis 1995). Each has a prior around one pixel, because a single frame
determines them poorly.

An extrinsics error hardly appears in the residuals, because the joints compensate for it. Therefore
no calibration is assumed to be better than one pixel.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotri
from threadpoolctl import ThreadpoolController

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.fit.contour_fit import Comparison, pixels_per_metre, symmetric
from drake_pose.fit.parameters import affine_motions
from drake_pose.silhouette.outline import Outline

# With a few hundred rows, BLAS is ten times slower on two threads than on one.
_on_one_thread = ThreadpoolController().wrap(limits=1, user_api="blas")


class ErrorSizes(NamedTuple):
    """Standard deviations of the errors of contours."""

    noise: float  # Independent noise of a contour point, relative to the fit's weights.
    # Noise repeated in all images of a part that is static relative to a camera, likewise; 0 if
    # there is none.
    repeated: float
    # surface, mask, camera: displacement of contours by an error of a part's surface, of its edge
    # in one mask, and of a camera's extrinsics [unit of errors, see ``ComparedMask``].
    surface: float
    mask: float
    camera: float
    nuisances: tuple[float, ...] = ()  # Each group of nuisance parameters [unit of the group].


class Distances(NamedTuple):
    """Residuals of the contours' distances, in independent linear combinations.

    The m values are the parameters that were fitted, such as joint positions.
    """

    y: Array  # (n,) residuals; their standard deviation is one if the fit's weights are correct.
    X: Array  # (n, m) derivatives of y by the values.
    # (5, n, n) covariances of y for the first five errors of ``ErrorSizes``, each of size one.
    effects: Array
    information: Array  # (m, m) information about the values if all errors were independent.
    # (n, 12 nodes) derivatives of y by deformations of the parts' surfaces, common to all images
    # [per unit of errors].
    surface_derivatives: Array
    pictures: Indices  # (n,) index of each residual's mask.
    # Per group (n, k) derivatives by nuisance parameters that are common to all images and not
    # among the values, such as joint offsets; each by a unit of its group.
    nuisances: tuple[Array, ...] = ()
    # (m,) inverse variances of the values' priors in the fit; 0: none.
    known: Array | float = 0.0


RoundPart = tuple[int, Array]
"""Index of a node, and its rotation that no silhouette shows: rotation vector, and velocity of the
node's origin (6,), for 1 rad, in its frame."""


class ComparedMask(NamedTuple):
    """A body's contours compared with one silhouette."""

    A: Array  # (nodes, 12, 12), lower triangles, one camera's part of ``Comparison.A``.
    b: Array  # (nodes, 12), likewise.
    X_WN: Array  # (nodes, 4, 4) poses of the nodes.
    X_CW: Array  # (4, 4) pose of the world in the camera.
    moves: Array  # (nodes, m, 12) affine motions of the nodes caused by the m values.
    size: float  # Unit of errors, some pixels of the image, at the body's distance [m].
    camera: int = 0  # Index of the camera.


@lru_cache(maxsize=16)
def round_parts(
    kinematics: TreeKinematics,
    outlines: tuple[Outline, ...],
    turned: frozenset[str] = frozenset(),
    sides: int = 12,
) -> tuple[RoundPart, ...]:
    """Return parts that are round about the axis of a joint that they carry, or are carried by.

    The facets of a round part's mesh move when it turns; those of the real part do not exist. A
    part is round if its extent in any direction, from the axis, changes in a turn by no more than
    that of a regular prism of this many sides.

    ``kinematics``: of the body's pose tree. ``outlines``: surface of each node. ``turned``: names
    of joints about whose axes all static parts count as round.
    """
    values = kinematics.flatten(kinematics.tree.default_values())
    at, found = kinematics.motions(values), list[RoundPart]()
    azimuth, height = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 73), np.linspace(-1.0, 1.0, 9))
    across = np.sqrt(1.0 - height**2)
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height])
    still: Mask = np.logical_not(at.moves.any(axis=1))
    for k in np.flatnonzero(kinematics.is_angle).tolist():
        child = int(kinematics.value_nodes[k])
        parent = kinematics.tree.nodes[child].parent
        beside = {child, parent} | (
            {*np.flatnonzero(still)} if parent < 0 or still[parent] else set()
        )
        for node in sorted(one for one in beside if one >= 0 and len(outlines[one].vertices)):
            X = np.linalg.inv(at.X_WN[node])
            omega = X[:3, :3] @ at.twists[k, :3]
            omega /= np.linalg.norm(omega)
            velocity = X[:3, :3] @ (
                at.twists[k, 3:6] + np.cross(at.twists[k, :3], at.X_WN[node, :3, 3])
            )
            place = np.cross(omega, velocity)
            frame = np.linalg.svd(omega[None])[2]
            points = (outlines[node].vertices - place) @ np.vstack([frame[1:], omega]).T
            reach = np.array([(points @ row).max(axis=0) for row in np.moveaxis(directions, 0, 1)])
            radius = np.linalg.norm(points[:, :2], axis=1).max()
            is_round = np.ptp(reach, axis=1).max() <= (1.0 - math.cos(np.pi / sides)) * radius
            if is_round or (still[node] and kinematics.names[k] in turned):
                found.append((node, np.append(omega, velocity)))
    return tuple(found)


def without_rotations(compared: Comparison, parts: Sequence[RoundPart]) -> Comparison:
    """Return a comparison that holds no information on rotations of round parts.

    They are marginalised in each mask: an unknown of its own turns each part.
    """
    if not parts:
        return compared
    A, b, bias_terms = symmetric(compared.A), compared.b.copy(), compared.bias_terms.copy()
    for node, twist in parts:
        X = compared.placement.X_WN[node]
        omega = X[:3, :3] @ twist[:3]
        velocity = X[:3, :3] @ twist[3:] - np.cross(omega, X[:3, 3])
        (r,) = affine_motions(np.concatenate([omega, velocity, [0.0]])[None])
        pulled = A[:, node] @ r
        gain = pulled / np.maximum(pulled @ r, 1e-12)[:, None]
        A[:, node] -= gain[:, :, None] * pulled[:, None]
        b[:, node] -= gain * (b[:, node] @ r)[:, None]
        bias_terms[:, node, :12] -= gain * (bias_terms[:, node, :12] @ r)[:, None]
    return compared._replace(A=A, b=b, bias_terms=bias_terms)


def error_unit(size: float) -> float:
    """Return the unit of masks' and cameras' errors [pixel]: one, or size / 200 if larger.

    Args:
        size: square root of the silhouettes' area [pixel].
    """
    return max(1.0, size / 200.0)


def distances(
    outlines: Sequence[Outline],
    cameras: tuple[Array, Array],
    compared: Comparison,
    moves: Array,
    unit: float,
) -> Distances:
    """Return the residuals of one frame, seen by all cameras, at a fitted pose.

    Args:
        outlines: surface of each node.
        cameras: X_CW (c, 4, 4) and kernel parameters (c, 8), see ``pack_cameras``.
        compared: comparison at the pose.
        moves: (nodes, m, 12) affine motions of the nodes caused by the m values.
        unit: unit of errors [pixel], see ``error_unit``.
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
    max_count: int = 400,
    with_bias: bool = False,
) -> Distances:
    """Return the residuals of the contours in several masks, at the values that were compared.

    Args:
        outlines: surface of each node.
        pictures: comparisons with the masks, of any frames and cameras, all with the same m values.
        max_count: maximum number of residuals; those with the largest information are kept.
        with_bias: append each mask's boundary bias [unit of errors] to the m values, so that X and
            the information have m + masks of them.
    """
    if with_bias:
        has_surface, wider = [[len(outline.vertices) > 0] for outline in outlines], []
        for one, mask in zip(pictures, np.eye(len(pictures)), strict=True):
            # Each part's surface grows by a metre on all sides; nodes without surface do not.
            by = surface_deformations(outlines, one.X_WN)[:, :, [3, 7, 11]].sum(axis=2)
            by = (by * one.size * has_surface)[:, None] * mask[:, None]
            wider.append(one._replace(moves=np.concatenate([one.moves, by], axis=1)))
        pictures = wider
    indices, along, surface_derivatives = _known_directions(outlines, pictures, max_count)
    count = pictures[0].moves.shape[1]
    y, X = np.zeros(len(indices)), np.zeros((len(indices), count))
    camera_rows = np.zeros((len(indices), 6))
    information = np.zeros((count, count))
    for c, one in enumerate(pictures):
        at = np.flatnonzero(indices[:, 0] == c)
        parts = indices[at, 1]
        rows = np.einsum("ri,rij->rj", along[at], symmetric(one.A)[parts])
        y[at] = np.einsum("ri,ri->r", along[at], one.b[parts])
        X[at] = np.einsum("rj,rmj->rm", rows, one.moves[parts])
        camera_rows[at] = rows @ _camera_motions(outlines, one)
        # An image depends on few of the values: only its own frame's and the shared ones.
        own = np.flatnonzero(one.moves.any(axis=(0, 2)))
        moves = one.moves[:, own]
        own_information = moves @ symmetric(one.A) @ np.swapaxes(moves, 1, 2)
        information[np.ix_(own, own)] += own_information.sum(axis=0)
    same_picture, same_part = (indices[:, None, k] == indices[None, :, k] for k in range(2))
    surface = surface_derivatives @ surface_derivatives.T * same_part
    view = _views(outlines, pictures)[indices[:, 0], indices[:, 1]]
    directions = surface_derivatives / np.linalg.norm(surface_derivatives, axis=1, keepdims=True)
    repeated = directions @ directions.T * same_part * (view[:, None] == view)
    of_part = indices[:, 1, None] == np.arange(len(outlines))
    camera = camera_rows @ camera_rows.T * same_picture
    return Distances(
        y=y,
        X=X,
        effects=np.array([np.eye(len(indices)), repeated, surface, surface * same_picture, camera]),
        information=information,
        surface_derivatives=(of_part[:, :, None] * surface_derivatives[:, None]).reshape(
            len(indices), 12 * len(outlines)
        ),
        pictures=indices[:, 0],
    )


def _known_directions(
    outlines: Sequence[Outline], pictures: Sequence[ComparedMask], max_count: int
) -> tuple[Indices, Array, Array]:
    """Return affine motions of parts that one mask determines, by information, descending.

    Args:
        outlines: surface of each node.
        pictures: comparisons with the masks.
        max_count: maximum number of motions; there are fewer if fewer are determined.

    Returns (n, 2) index of the mask and of the node of each; (n, 12) the affine motion, scaled to
    unit curvature of the cost; and (n, 12) derivatives of its residual by the part's
    ``surface_deformations`` of one unit of errors.
    """
    mean_size = float(np.mean([picture.size for picture in pictures]))
    found: list[tuple[Array, Indices, Indices, Array, Array]] = []
    for c, one in enumerate(pictures):
        A = symmetric(one.A)
        visible = np.flatnonzero(np.einsum("nii->n", A) > 0.0)
        D = mean_size * surface_deformations(
            [outlines[n] for n in visible.tolist()], one.X_WN[visible]
        )
        eigenvalues, directions = np.linalg.eigh(np.swapaxes(D, 1, 2) @ A[visible] @ D)
        # Directions below unit information are dominated by noise.
        k, j = np.nonzero(eigenvalues >= 1.0)
        curvatures, turned = eigenvalues[k, j], directions[k, :, j]
        root = np.sqrt(curvatures)[:, None]
        along = np.einsum("rij,rj->ri", D[k], turned) / root
        found.append((curvatures, np.full(len(k), c), visible[k], along, root * turned))
    curvatures, picture, part, along, surface_derivatives = (
        np.concatenate(one) for one in zip(*found, strict=True)
    )
    best = np.argsort(-curvatures, kind="stable")[:max_count]
    return np.column_stack([picture, part])[best], along[best], surface_derivatives[best]


def _views(outlines: Sequence[Outline], pictures: Sequence[ComparedMask]) -> Indices:
    """Return (masks, nodes) index of the first mask in which a part has the same pose.

    That is the mask's own index if none before it has. Poses relative to the camera are the same if
    the root mean square distance of the part's vertices is less than half the unit of errors.

    ``outlines``: surface of each node. ``pictures``: comparisons with the masks.
    """
    X_CN = np.array([one.X_CW @ one.X_WN for one in pictures])[:, :, :3]
    found = np.tile(np.arange(len(pictures))[:, None], len(outlines))
    for n, outline in enumerate(outlines):
        for c, one in enumerate(pictures if len(outline.vertices) else ()):
            moved = X_CN[: c + 1, n] - X_CN[c, n]
            matches = (
                np.einsum("kij,jl,kil->k", moved, outline.moments, moved) < (0.5 * one.size) ** 2
            )
            found[c, n] = found[np.flatnonzero(matches)[0], n]
    return found


def surface_deformations(outlines: Sequence[Outline], X_WN: Array) -> Array:
    """Return (n, 12, 12) affine motions, in columns, that move each surface by about a metre.

    The first three columns are shifts along the part's axes; the other nine stretch, shear and
    rotate the part about the mean of its vertices.

    ``outlines``: surface of each part. ``X_WN``: (n, 4, 4) poses of the parts.
    """
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
    """Return (12, 6) affine motions of the body that are equivalent to motions of a camera.

    They are three translations along and three rotations about the camera's axes, which move the
    body by about the unit of errors. ``one``: comparison with a mask of the camera.
    """
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
    residuals: Distances,
    is_angle: Mask,
    min_camera: float = 1.0,
    prior_deviation: float = 1.0,
    tolerance: float = 0.03,
) -> ErrorSizes:
    """Return the most likely sizes of the errors, given the residuals and the prior.

    Args:
        residuals: the residuals; each group of their nuisances gets a size, too.
        is_angle: (m,) which values are angles; the others are lengths.
        min_camera: minimum returned error of a camera [unit of errors, see ``ComparedMask``].
        prior_deviation: standard deviation of the prior of the sizes' logarithms, whose mean is 0.
        tolerance: iterations end when no log size changes by more than this, after 20, or when
            the log-likelihood gains less than 0.05. Repeated noise is estimated only if an element
            of its covariance differs from that of independent noise by more than this.
    """
    n = len(residuals.y)
    stands_still = np.abs(residuals.effects[1] - residuals.effects[0]).max(initial=0.0) > tolerance
    # Noise repeats only in images of static parts.
    active = [0, 1, 2, 3, 4] if stands_still else [0, 2, 3, 4]
    effects = [*residuals.effects[active], *(Z @ Z.T for Z in residuals.nuisances)]
    stacked = np.reshape(effects, (len(effects), -1))

    prior_information, known = _prior_information(is_angle), _known(residuals)

    def likelihood(t: Array) -> tuple[float, Array, Array]:
        """Return the restricted log-likelihood plus log prior of log sizes t (k,), P and P y.

        P (n, n) projects the values out: P = V^-1 - V^-1 X H^-1 X^T V^-1, with V the covariance.
        """
        L = np.linalg.cholesky((np.exp(2.0 * t) @ stacked).reshape(n, n))
        inverse = symmetric(dpotri(L.T)[0].T) if n else L  # LAPACK refuses empty matrices.
        VX = inverse @ residuals.X
        H = residuals.X.T @ VX + prior_information + known
        P = inverse - VX @ np.linalg.solve(H, VX.T)
        Py = P @ residuals.y
        freedom = 2.0 * np.log(np.diag(L)).sum() + np.linalg.slogdet(H)[1]
        return -0.5 * float(freedom + residuals.y @ Py + (t @ t) / prior_deviation**2), P, Py

    t = np.zeros(len(effects))
    value, P, Py = likelihood(t)
    # Try a common scale first; all sizes may be much smaller than the unit.
    smaller = np.full(len(t), 0.5 * np.log(max(float(residuals.y @ Py), 1e-9) / max(n, 1)))
    scaled = likelihood(smaller)
    if scaled[0] > value:
        t, (value, P, Py) = smaller, scaled
    longest = 1.0
    for _ in range(20):
        scales = 2.0 * np.exp(2.0 * t)
        WPy = np.array([W @ Py for W in effects])
        g = 0.5 * scales * (WPy @ Py - stacked @ P.ravel()) - t / prior_deviation**2
        # Average information needs no matrix-matrix products, unlike Fisher information.
        average = 0.5 * np.outer(scales, scales) * (WPy @ P @ WPy.T)
        step = np.linalg.solve(average + np.eye(len(t)) / prior_deviation**2, g)
        step *= min(1.0, longest / max(np.abs(step).max(), 1e-9))
        trial = likelihood(t + step)
        while trial[0] < value and np.abs(step).max() > tolerance:
            step *= 0.5
            trial = likelihood(t + step)
        if trial[0] < value:
            break
        gain, longest = trial[0] - value, min(1.0, 1.25 * np.abs(step).max())
        t, (value, P, Py) = t + step, trial
        if gain < 0.05 or np.abs(step).max() < tolerance:
            break
    sizes = np.zeros(5)
    sizes[active] = np.exp(t[: len(active)])
    noise, repeated, surface, mask, camera = sizes.tolist()
    nuisances = tuple(np.exp(t[len(active) :]).tolist())
    return ErrorSizes(noise, repeated, surface, mask, max(camera, min_camera), nuisances)


@_on_one_thread
def values_covariance(
    residuals: Distances, sizes: ErrorSizes, free: NDArray[np.intp], is_angle: Mask
) -> Array:
    """Return (f, f) covariance of the free values, which were fitted as if errors were independent.

    It is H^-1 J^T V J H^-1 (the sandwich of Huber 1967), with V the covariance of the residuals.

    Args:
        residuals: the residuals at the fitted values.
        sizes: sizes of their errors, see ``estimate_sizes``; nuisances are ignored.
        free: (f,) indices of the free values.
        is_angle: (m,) which values are angles; the others are lengths.
    """
    white = sizes.noise**2 + sizes.repeated**2
    own, square = residuals.X[:, free], np.ix_(free, free)
    V = distances_covariance(residuals, sizes)
    H = residuals.information[square] + white * _prior_information(is_angle)[square]
    # Residuals that were dropped, and the range's prior, are treated as noise.
    known = _known(residuals)[square]
    inverse = np.linalg.inv(H + known)
    errors = own.T @ V @ own + white * (H - own.T @ own) + known
    return np.asarray(inverse @ errors @ inverse)


def distances_covariance(residuals: Distances, sizes: ErrorSizes) -> Array:
    """Return the covariance (n, n) of the residuals y, given the sizes of the first five errors."""
    parts = zip(sizes[:5], residuals.effects, strict=True)
    return sum((size**2 * W for size, W in parts), np.zeros((len(residuals.y), len(residuals.y))))


@_on_one_thread
def nuisance_covariance(
    residuals: Distances, sizes: ErrorSizes, is_angle: Mask
) -> tuple[Array, Array, Distances]:
    """Return two covariances of the values (m, m) due to nuisances, and residuals without them.

    Nuisance parameters were not fitted, so they bias the values. The first result is their variance
    plus the square of their most likely values, given the residuals (best linear unbiased
    prediction, Henderson 1975). The second is what lacks to a standard deviation of their unit, as
    far as the residuals do not show them. The third has the likely values' effect subtracted from
    y, and no nuisances.

    Args:
        residuals: the residuals; without nuisances the covariance is 0.
        sizes: sizes of the errors and nuisances, see ``estimate_sizes``.
        is_angle: (m,) which values are angles; the others are lengths.
    """
    if not residuals.nuisances:
        return *np.zeros((2, len(is_angle), len(is_angle))), residuals
    white = sizes.noise**2 + sizes.repeated**2
    A = np.concatenate(residuals.nuisances, axis=1)
    variances = np.repeat(np.square(sizes.nuisances), [Z.shape[1] for Z in residuals.nuisances])
    inverse = np.linalg.inv(distances_covariance(residuals, sizes) + (A * variances) @ A.T)
    VX, prior_information = inverse @ residuals.X, _prior_information(is_angle)
    known = _known(residuals)
    P = inverse - VX @ np.linalg.solve(residuals.X.T @ VX + prior_information + known, VX.T)
    estimates = variances * (A.T @ P @ residuals.y)
    shown = np.einsum("nk,nm,mk->k", A, P, A, optimize=True)
    lacking = np.maximum(0.0, 1.0 / (1.0 + shown) - variances)
    sensitivities = np.linalg.solve(
        residuals.information + white * prior_information + known, residuals.X.T @ A
    )
    bias = sensitivities @ estimates
    without = residuals._replace(y=residuals.y - A @ estimates, nuisances=())
    found = (sensitivities * variances) @ sensitivities.T + np.outer(bias, bias)
    return found, (sensitivities * lacking) @ sensitivities.T, without


@_on_one_thread
def score_nuisances(residuals: Distances, sizes: ErrorSizes) -> tuple[Array, Array]:
    """Return estimates (k,) and standard deviations (k,) of all groups' nuisance parameters.

    Each is estimated beside the values as if all others were 0 (score test, Rao 1948) [unit of its
    group]. Without nuisances, k is 0; sizes of nuisances are ignored.
    """
    if not residuals.nuisances:
        return np.zeros(0), np.zeros(0)
    A = np.concatenate(residuals.nuisances, axis=1)
    inverse = np.linalg.inv(distances_covariance(residuals, sizes))
    VX = inverse @ residuals.X
    P = inverse - VX @ np.linalg.pinv(residuals.X.T @ VX) @ VX.T
    weights = np.maximum(np.einsum("nk,nm,mk->k", A, P, A, optimize=True), 1e-12)
    return A.T @ P @ residuals.y / weights, weights**-0.5


def _prior_information(is_angle: Mask) -> Array:
    """Return the information (m, m) of uniform priors: a full turn of angles, ten metres else."""
    return np.diag(12.0 / np.where(is_angle, 2.0 * np.pi, 10.0) ** 2)


def _known(residuals: Distances) -> Array:
    """Return the information (m, m) of the values' priors in the fit."""
    return np.diag(np.broadcast_to(residuals.known, residuals.X.shape[1]))


def vuong_statistic(tiles: Array, others: Array) -> float:
    """Return the difference of two costs in its standard deviations (Vuong's test, 1989).

    The scatter of the differences between tiles gives the standard deviation of their sum. Evidence
    that no pose explains cancels. Positive: ``tiles`` has the larger cost.
    """
    more = tiles - others
    return float(more.sum() / max(np.sqrt(float((more**2).sum())), 1e-9))
