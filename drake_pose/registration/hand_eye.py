"""The pose of a camera on a robot's link, from poses of a target or from a scene that stands still.

With link L, camera C, target T and world W, X_WL X_LC X_CT = X_WT is the same in every frame. Two
frames i, j give A X_LC = X_LC B, with A = X_WLj^-1 X_WLi and B = X_CTj X_CTi^-1, in closed form.

Without a target, points of the scene are matched between pictures. The link's poses X_WL are known,
so a pose X_LC of the camera on the link predicts X_WC = X_WL X_LC in each picture, in metres. All
rotations R_LC are searched: for each, the epipolar constraints are linear in the position p_LC. The
best poses are fitted by bundle adjustment over all points. Points that move with the camera, such
as the gripper's, contradict the scene's motion and are outliers.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Indices
from drake_pose.body import inverse_transforms
from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.picture_matches import Matches, Sightings, rays
from drake_pose.registration.register import uniform_rotations


class TrackSettings(NamedTuple):
    """Settings of search and fit; chosen on a Franka's pictures and on simulated tables."""

    matches: int = 300  # Maximum number of matches in the search.
    rotations: int = 2000  # Number of rotations from which the search starts.
    refined: int = 40  # Number of poses that are refined by the epipolar constraints.
    # Scale of the robust loss in the search, then in each refinement [rad].
    coarse: tuple[float, ...] = (0.08, 0.06, 0.04, 0.02, 0.01, 0.005)
    # Scale of the robust loss in each first step of the bundle adjustment [pixel].
    fine: tuple[float, ...] = (30.0, 15.0, 8.0, 4.0)
    last: int = 10  # Number of further steps, whose scale follows from the residuals.
    inlier: float = 4.0  # A sighting within this many standard deviations is an inlier.
    steps: int = 4  # Number of steps of each reweighted least squares.
    difference: float = 1e-5  # Differences that estimate derivatives [rad, m or s].
    groups: int = 12  # Number of groups of successive frames in the jackknife.


TRACKS = TrackSettings()


class EpipolarSearch:
    """Searches X_LC by the epipolar constraints of matches, without a guess.

    Args:
        camera: its intrinsics; its pose is not used.
        matches: between pictures; at most `TRACKS.matches` are used, as many of each pair of
            pictures as possible.
    """

    def __init__(self, camera: PinholeCamera, matches: Matches) -> None:
        pairs, pair = np.unique(matches.frames, axis=0, return_inverse=True)
        order = np.random.default_rng(0).permutation(len(pair))
        order = order[np.argsort(pair[order], kind="stable")]
        counts = np.bincount(pair)
        rank = np.arange(len(pair)) - np.repeat(np.cumsum(counts) - counts, counts)
        chosen = order[np.argsort(rank, kind="stable")[: TRACKS.matches]]
        x = rays(camera, matches.uv[chosen])
        self._pairs, self._pair, self._x, self._y = pairs, pair[chosen], x[:, 0], x[:, 1]

    def search(self, X_WL: Array, rotations: int = TRACKS.rotations) -> list[tuple[float, Array]]:
        """Return distinct poses, best first: the explained fraction of the matches, and X_LC.

        X_WL: (frames, 4, 4) the link's poses. rotations: number of rotations that are tried.
        """
        R, A = uniform_rotations(rotations), self._motions(X_WL)
        parts = [self._positions(A, part) for part in np.array_split(R, max(1, len(R) // 250))]
        p, gain = (np.concatenate(chunks) for chunks in zip(*parts, strict=True))
        best = np.argsort(-gain)[: TRACKS.refined]
        X = np.tile(np.eye(4), (len(best), 1, 1))
        X[:, :3, :3], X[:, :3, 3] = R[best], p[best]
        for scale in TRACKS.coarse[1:]:
            X = self._refined(A, X, scale)
        gains, kept = self._gains(A, X, TRACKS.coarse[-1]), list[tuple[float, Array]]()
        for k in np.argsort(-gains):
            if all(poses_differ(X[k], other) for _, other in kept):
                kept.append((float(gains[k]), X[k]))
        return kept

    def refine(self, X_WL: Array, X_LC: Array) -> tuple[float, Array]:
        """Refine a pose X_LC (4, 4); return the explained fraction of the matches, and the pose.

        X_WL: (frames, 4, 4) the link's poses.
        """
        A, X = self._motions(X_WL), X_LC[None]
        for scale in TRACKS.coarse[2:]:
            X = self._refined(A, X, scale)
        return float(self._gains(A, X, TRACKS.coarse[-1])[0]), X[0]

    def explained(self, X_WL: Array, X_LC: Array) -> Array:
        """Return the explained part (pairs,) of the matches of each pair of pictures.

        X_WL: (frames, 4, 4) the link's poses. X_LC: (4, 4) the camera's pose on it.
        """
        residuals = self._residuals(self._motions(X_WL), X_LC[None])
        own = np.sqrt(_weights(residuals, TRACKS.coarse[-1]))[0]
        return np.asarray(np.bincount(self._pair, own, len(self._pairs)), np.float64)

    def _motions(self, X_WL: Array) -> Array:
        """Return the link's motion (pairs, 4, 4) between the two pictures of each pair."""
        i, j = self._pairs.T
        return np.asarray(inverse_transforms(X_WL[j]) @ X_WL[i])

    def _positions(self, A: Array, R: Array) -> tuple[Array, Array]:
        """Return the best p_LC (n, 3) for rotations R_LC (n, 3, 3), and explained fractions (n,).

        A: as of `_motions`.
        """
        R_A, pair, scale = A[:, :3, :3], self._pair, TRACKS.coarse[0]
        R_B = np.einsum("nji,pjk,nkl->npil", R, R_A, R)[:, pair]
        Rx = np.einsum("nmij,mj->nmi", R_B, self._x)
        normal = np.einsum("nij,nmj->nmi", R, np.cross(Rx, self._y))
        a = np.einsum("mji,nmj->nmi", (R_A - np.eye(3))[pair], normal)
        b = np.einsum("nmi,mi->nm", normal, A[pair, :3, 3])
        weight = np.ones(b.shape)
        for _ in range(TRACKS.steps):
            wa = weight[..., None] * a
            H = np.swapaxes(wa, 1, 2) @ a
            H += 1e-4 * np.einsum("nii->n", H)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
            p = -np.linalg.solve(H, np.einsum("nmi,nm->ni", wa, b)[..., None])[..., 0]
            off, size = _sampson(self._translations(A, R, p), Rx, R_B, self._y)
            weight = _weights(off, scale) / size**2
        return p, np.sqrt(_weights(off, scale)).mean(axis=1)

    def _translations(self, A: Array, R: Array, p: Array) -> Array:
        """Return the camera's translations (n, matches, 3) between the pictures of each match [m].

        A: as of `_motions`. R, p: (n, 3, 3) and (n, 3) the camera's pose on the link.
        """
        moved = np.einsum("pij,nj->npi", A[:, :3, :3] - np.eye(3), p) + A[:, :3, 3]
        return np.asarray((moved @ R)[:, self._pair])

    def _residuals(self, A: Array, X: Array) -> Array:
        """Return the epipolar distances (n, matches) [rad] at poses X_LC (n, 4, 4).

        A: as of `_motions`.
        """
        R = X[:, :3, :3]
        R_B = np.einsum("nji,pjk,nkl->npil", R, A[:, :3, :3], R)[:, self._pair]
        Rx = np.einsum("nmij,mj->nmi", R_B, self._x)
        return _sampson(self._translations(A, R, X[:, :3, 3]), Rx, R_B, self._y)[0]

    def _gains(self, A: Array, X: Array, scale: float) -> Array:
        """Return the explained fractions (n,), 1 minus the mean robust loss, at X_LC (n, 4, 4).

        A: as of `_motions`. scale: of the loss [rad].
        """
        return np.asarray(np.sqrt(_weights(self._residuals(A, X), scale)).mean(axis=1))

    def _refined(self, A: Array, X: Array, scale: float) -> Array:
        """Return poses X_LC (n, 4, 4) after Gauss-Newton steps; steps that do not help are undone.

        A: as of `_motions`. X: (n, 4, 4) X_LC at the start. scale: of the loss [rad].
        """
        h = TRACKS.difference
        for _ in range(TRACKS.steps):
            r = self._residuals(A, X)
            shifted = [self._residuals(A, X @ motion(h * changed)) for changed in np.eye(6)]
            J = np.stack([(changed - r) / h for changed in shifted], axis=-1)
            wJ = _weights(r, scale)[..., None] * J
            H = np.swapaxes(wJ, 1, 2) @ J
            H += 1e-3 * np.einsum("nii->ni", H)[:, :, None] * np.eye(6) + 1e-9 * np.eye(6)
            step = -np.linalg.solve(H, np.einsum("nmi,nm->ni", wJ, r)[..., None])[..., 0]
            most = np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12)
            new = X @ motion(step * np.minimum(1.0, 0.2 / most))
            better = self._gains(A, new, scale) > self._gains(A, X, scale)
            X = np.where(better[:, None, None], new, X)
        return X


LinkPoses = Callable[[Array], Array]
"""Returns the link's poses X_WL (frames, 4, 4) at constants (k,): time offset, joint offsets."""


def difference_along_camera(X_LC: Array, other: Array) -> Array:
    """Return rotation vectors [rad] and translations [m] (..., 6) from one pose to another.

    X_LC, other: (..., 4, 4) poses. The result is along the camera's axes at X_LC.
    """
    X = inverse_transforms(X_LC) @ other
    turns = Rotation.from_matrix(X[..., :3, :3].reshape(-1, 3, 3)).as_rotvec()
    return np.concatenate([turns.reshape(*X.shape[:-2], 3), X[..., :3, 3]], axis=-1)


class TrackProblem(NamedTuple):
    """What a bundle adjustment fits."""

    camera: PinholeCamera  # Its intrinsics; its pose is not used.
    # The link's poses as a function of k constants, such as a time offset [s] and joint offsets
    # [rad or m]; the prior mean of each is 0.
    link_poses: LinkPoses
    seen: Sightings  # The sightings.
    # (1 + k,) prior standard deviations of the logarithm of the focal length and of the constants;
    # 0: it is known and not fitted.
    prior_sds: Array

    def without(self, frames: Indices) -> "TrackProblem":
        """Return the problem without the frames of these indices.

        Points that are seen in fewer than two of the other frames are left out, too.
        """
        seen = self.seen
        kept = ~np.isin(seen.frames, frames)
        repeated = np.bincount(seen.points[kept], minlength=seen.points.max() + 1) > 1
        kept &= repeated[seen.points]
        sightings = Sightings(seen.frames[kept], seen.points[kept], seen.uv[kept])
        return self._replace(seen=sightings)


class TrackFit(NamedTuple):
    """Result of a bundle adjustment."""

    X_LC: Array  # (4, 4) the camera's pose on the link.
    constants: Array  # (1 + k,) logarithm of the focal length over the camera's, and the constants.
    points: Array  # (p, 3) the points in the world [m].
    sigma: float  # Standard deviation of a coordinate of the sightings [pixel].
    # (7 + k, 7 + k) of the errors of X_LC, rotation vector [rad] and translation [m] along the
    # camera's axes, and of `constants`, as if sightings had independent errors.
    covariance: Array
    lengths: Array  # (n,) reprojection errors of the sightings [pixel].

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """Which sightings (n,) are inliers."""
        return self.lengths < TRACKS.inlier * self.sigma


def fit_tracks(
    problem: TrackProblem, start: Array | TrackFit, constants: Array | None = None
) -> TrackFit:
    """Fit X_LC, the constants and all points.

    Args:
        problem: what is fitted.
        start: a pose X_LC (4, 4); or an earlier fit, which takes a few last steps only.
        constants: (1 + k,) start of the constants for a pose; None: 0. An earlier fit has its own.
    """
    count, last = len(problem.prior_sds), [0.0] * TRACKS.last
    if isinstance(start, TrackFit):
        fit, scales = start, last[: len(last) // 2]
    else:
        constants = np.zeros(count) if constants is None else constants
        points = _triangulated(problem, problem.link_poses(constants[1:]) @ start)
        fit = TrackFit(start, constants, points, np.inf, np.eye(6 + count), constants)
        scales = [*TRACKS.fine, *last]
    free = problem.prior_sds > 0.0
    unknown = np.concatenate([np.ones(6, np.bool_), free])
    known = np.concatenate([np.full(6, 1e-9), np.where(free, problem.prior_sds, 1.0) ** -2])
    information = np.diag(known)
    for scale in scales:
        r, A, B = _residuals(problem, fit)
        lengths = np.linalg.norm(r, axis=1)
        # The median length of a two-dimensional normal distribution is 1.18 standard deviations.
        sigma = scale / TRACKS.inlier or max(float(np.median(lengths)) / 1.18, 0.05)
        w = _weights(lengths, TRACKS.inlier * sigma) / sigma**2
        G = _twists(problem, fit.X_LC, fit.constants)
        S, g, points_step = _without_points(problem.seen, r, A, B, w, len(fit.points))
        H = (G.T @ S @ G + information)[np.ix_(unknown, unknown)]
        errors = np.concatenate([np.zeros(6), fit.constants])
        step = np.zeros(6 + count)
        step[unknown] = -np.linalg.solve(H, (G.T @ g + information @ errors)[unknown])
        fit = fit._replace(
            X_LC=fit.X_LC @ motion(step[:6]), constants=fit.constants + step[6:],
            points=fit.points + points_step(G @ step), sigma=sigma,
        )  # fmt: skip
    # The damping of the points' steps would hide motions of the whole scene.
    S, _, _ = _without_points(problem.seen, r, A, B, w, len(fit.points), damping=1e-12)
    H = (G.T @ S @ G + information)[np.ix_(unknown, unknown)]
    variances, axes = np.linalg.eigh(H)
    covariance = np.zeros((6 + count, 6 + count))
    covariance[np.ix_(unknown, unknown)] = axes / variances.clip(min=1e-9) @ axes.T
    lengths = np.linalg.norm(_residuals(problem, fit)[0], axis=1)
    return fit._replace(covariance=covariance, lengths=lengths)


def jackknife(problem: TrackProblem, fit: TrackFit) -> Array:
    """Return the covariance (7 + k, 7 + k) of a fit's errors, see `TrackFit`, by a jackknife.

    Groups of successive frames are left out in turn, because the errors of joint positions and
    matches are correlated within a frame.
    """
    frames = np.unique(problem.seen.frames)
    groups = np.array_split(frames, min(TRACKS.groups, len(frames)))
    rows = [_moved(fit, fit_tracks(problem.without(group), fit)) for group in groups]
    differences = np.array(rows) - np.mean(rows, axis=0)
    return np.asarray((len(rows) - 1) / len(rows) * differences.T @ differences)


def intrinsics_effect(
    problem: TrackProblem, fit: TrackFit, focal: float = 0.003, centre: float = 1.0
) -> Array:
    """Return the covariance (7 + k, 7 + k), see `TrackFit`, from errors of the intrinsics.

    ``problem``, ``fit``: what was fitted, and the result. ``focal``: relative standard deviation of
    a focal length that is not fitted, as of usual calibrations. ``centre``: standard deviation of
    the principal point's coordinates [pixel].
    """
    camera = problem.camera
    wrong = [
        replace(camera, center_x=camera.center_x + centre),
        replace(camera, center_y=camera.center_y + centre),
    ]
    if not problem.prior_sds[0]:
        factor = 1.0 + focal
        wrong.append(
            replace(camera, focal_x=factor * camera.focal_x, focal_y=factor * camera.focal_y)
        )
    fits = [fit_tracks(problem._replace(camera=other), fit) for other in wrong]
    differences = np.array([_moved(fit, other) for other in fits])
    return np.asarray(differences.T @ differences)


def _moved(fit: TrackFit, other: TrackFit) -> Array:
    """Return the difference (7 + k,), as of `TrackFit.covariance`, from a fit to another."""
    difference = difference_along_camera(fit.X_LC, other.X_LC)
    return np.concatenate([difference, other.constants - fit.constants])


def gauge_constants(problem: TrackProblem, X_LC: Array, constants: Array) -> NDArray[np.bool_]:
    """Return which of the constants (1 + k,) the pictures cannot determine, whatever the motion.

    The offset of a first joint only turns the whole scene with all cameras. The offset of a last
    joint only turns the camera on the link.

    X_LC, constants: (4, 4) and (1 + k,), as of `TrackFit`.
    """
    frames = int(problem.seen.frames.max()) + 1
    twists = _twists(problem, X_LC, constants)[:-1, 6:].reshape(frames, 6, -1)
    X_WC = (problem.link_poses(constants[1:]) @ X_LC)[:frames]
    R, p = X_WC[:, :3, :3], X_WC[:, :3, 3]
    turn, shift = R @ twists[:, :3], R @ twists[:, 3:]
    in_world = np.concatenate([turn, shift + np.cross(p[:, :, None], turn, axis=1)], axis=1)
    spread = np.minimum(*(np.ptp(rates, axis=0).max(axis=0) for rates in (twists, in_world)))
    return np.asarray((problem.prior_sds > 0.0) & (spread < 1e-3))


def _residuals(problem: TrackProblem, fit: TrackFit) -> tuple[Array, Array, Array]:
    """Return reprojection residuals (n, 2) [pixel], and their derivatives (n, 2, 7) and (n, 2, 3).

    The first are by the twist along the camera's axes and the logarithm of the focal length, the
    second by the point. Points behind the camera have a large residual and derivatives of 0.
    """
    camera, seen = problem.camera, problem.seen
    X_WC = (problem.link_poses(fit.constants[1:]) @ fit.X_LC)[seen.frames]
    p = np.einsum("nji,nj->ni", X_WC[:, :3, :3], fit.points[seen.points] - X_WC[:, :3, 3])
    ahead = p[:, 2] > 0.01
    z = np.where(ahead, p[:, 2], 1.0)[:, None]
    f = np.exp(fit.constants[0]) * np.array([camera.focal_x, camera.focal_y])
    away = p[:, :2] / z * f
    centre = np.array([camera.center_x, camera.center_y])
    r = np.where(ahead[:, None], away + centre - seen.uv, 1e4)
    D = np.zeros((len(p), 2, 3))
    D[:, 0, 0], D[:, 1, 1] = (f / z).T
    D[:, :, 2] = -away / z
    D[~ahead], away[~ahead] = 0.0, 0.0
    # A twist (omega, v) of the camera moves the point by p x omega - v.
    turned = np.cross(D, p[:, None])
    A = np.concatenate([turned, -D, away[:, :, None]], axis=2)
    return r, A, np.einsum("nij,nkj->nik", D, X_WC[:, :3, :3])


def _twists(problem: TrackProblem, X_LC: Array, constants: Array) -> Array:
    """Return derivatives (6 frames + 1, 7 + k) of all frames' camera twists and log focal length.

    They are by the twist of X_LC, the logarithm of the focal length, and the k constants.

    X_LC, constants: (4, 4) and (1 + k,), as of `TrackFit`.
    """
    h = TRACKS.difference
    count = len(problem.prior_sds)
    frames, columns = int(problem.seen.frames.max()) + 1, []
    for sd, change in zip(problem.prior_sds[1:], h * np.eye(count - 1), strict=True):
        if not sd:
            columns.append(np.zeros(6 * frames))
            continue
        behind, ahead = (
            problem.link_poses(constants[1:] + step) @ X_LC for step in (-change, change)
        )
        columns.append(difference_along_camera(behind, ahead).ravel() / (2.0 * h))
    G = np.zeros((6 * frames + 1, 6 + count))
    G[:-1, :6], G[-1, 6] = np.tile(np.eye(6), (frames, 1)), 1.0
    for k, column in enumerate(columns):
        G[:-1, 7 + k] = column[: 6 * frames]
    return G


def _without_points(
    seen: Sightings, r: Array, A: Array, B: Array, w: Array, count: int, damping: float = 1e-6
) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Return the normal equations of cameras and focal length, without points (Schur complement).

    Args:
        seen: n sightings.
        r, A, B: residuals and derivatives, as of `_residuals`.
        w: (n,) weights of the sightings.
        count: number of points.
        damping: of the points' steps, relative to their information.

    Returns the matrix (u, u) and the gradient (u,) for u = 6 frames + 1 unknowns, and a function
    that returns the points' steps (count, 3) for a step (u,).
    """
    size = 6 * (int(seen.frames.max()) + 1) + 1
    rows = np.concatenate(
        [6 * seen.frames[:, None] + np.arange(6), np.full((len(r), 1), size - 1)], 1
    )
    wA, wB = w[:, None, None] * A, w[:, None, None] * B
    S, g = np.zeros((size, size)), np.zeros(size)
    np.add.at(S, (rows[:, :, None], rows[:, None, :]), np.swapaxes(wA, 1, 2) @ A)
    np.add.at(g, rows, np.einsum("nki,nk->ni", wA, r))
    V, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(V, seen.points, np.swapaxes(wB, 1, 2) @ B)
    np.add.at(b, seen.points, np.einsum("nki,nk->ni", wB, r))
    # Parallel rays, or none, leave a point's distance open: damping holds it where it is.
    V += damping * (np.einsum("nii->n", V)[:, None, None] + 1.0) * np.eye(3)
    W = np.zeros((count, 3, size))
    entries = seen.points[:, None, None], np.arange(3)[:, None], rows[:, None, :]
    np.add.at(W, entries, np.swapaxes(wB, 1, 2) @ A)
    VW, Vb = np.linalg.solve(V, W), np.linalg.solve(V, b[..., None])[..., 0]
    W_all = W.reshape(-1, size)
    S, g = S - W_all.T @ VW.reshape(-1, size), g - W_all.T @ Vb.ravel()
    return S, g, lambda step: -(Vb + VW @ step)


def _triangulated(problem: TrackProblem, X_WC: Array) -> Array:
    """Return the world points (p, 3) nearest to their sightings' rays, robustly [m].

    X_WC: (frames, 4, 4) the camera's poses.
    """
    seen = problem.seen
    d = rays(problem.camera, seen.uv)
    d = np.einsum("nij,nj->ni", X_WC[seen.frames, :3, :3], d / np.linalg.norm(d, axis=1)[:, None])
    c, count, w = X_WC[seen.frames, :3, 3], int(seen.points.max()) + 1, np.ones(len(d))
    P = np.eye(3) - d[:, :, None] * d[:, None, :]
    for _ in range(TRACKS.steps):
        H, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(H, seen.points, w[:, None, None] * P)
        np.add.at(b, seen.points, w[:, None] * np.einsum("nij,nj->ni", P, c))
        H += 1e-6 * np.einsum("nii->n", H)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
        points = np.linalg.solve(H, b[..., None])[..., 0]
        away = points[seen.points] - c
        size = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
        w = _weights(np.linalg.norm(np.cross(d, away), axis=1) / size, 0.02)
    return np.asarray(points)


def _sampson(t: Array, Rx: Array, R_B: Array, y: Array) -> tuple[Array, Array]:
    """Return signed epipolar distances (n, m) [rad], and the norms of the constraints' gradients.

    Args:
        t: (n, m, 3) translations of the camera between two pictures.
        Rx: (n, m, 3) rays of the first pictures, rotated into the second.
        R_B: (n, m, 3, 3) these rotations.
        y: (m, 3) rays of the second pictures.
    """
    # A camera that only turns satisfies every constraint: such a pose explains nothing.
    still = (t**2).sum(-1) < 1e-6
    line = np.cross(t, Rx)
    line_back = (np.cross(y, t)[..., None, :] @ R_B)[..., 0, :]
    size = np.sqrt((line[..., :2] ** 2).sum(-1) + (line_back[..., :2] ** 2).sum(-1)) + 1e-9
    return np.where(still, 1.0, (line * y).sum(-1) / size), size


def _weights(r: Array, scale: float) -> Array:
    """Return the weights of Geman and McClure's loss for residuals r; scale: in their unit."""
    return np.asarray((1.0 + (r / scale) ** 2) ** -2)


def motion(twist: Array) -> Array:
    """Return the transforms (..., 4, 4) of rotation vectors [rad] and translations [m] (..., 6)."""
    X = np.zeros((*twist.shape[:-1], 4, 4))
    turns = Rotation.from_rotvec(twist[..., :3].reshape(-1, 3)).as_matrix()
    X[..., :3, :3] = turns.reshape(*twist.shape[:-1], 3, 3)
    X[..., :3, 3], X[..., 3, 3] = twist[..., 3:], 1.0
    return X


def poses_differ(X: Array, other: Array, turn: float = 0.05, shift: float = 0.02) -> bool:
    """Return whether two poses (4, 4) differ by more than `turn` [rad] or `shift` [m]."""
    angle = Rotation.from_matrix(X[:3, :3].T @ other[:3, :3]).magnitude()
    return bool(angle > turn or np.linalg.norm(X[:3, 3] - other[:3, 3]) > shift)


def rotation_spread(R_WL: Array) -> Array:
    """Return how far a link rotates about its three principal axes [rad], descending.

    These are root mean squares over all pairs of the rotations R_WL (n, 3, 3). If the second value
    is 0, the link rotates about one axis only, and the hand-eye pose is not observable.
    """
    pairs = list(combinations(range(len(R_WL)), 2))
    if not pairs:
        return np.zeros(3)
    i, j = np.array(pairs).T
    turns = Rotation.from_matrix(np.swapaxes(R_WL[i], 1, 2) @ R_WL[j]).as_rotvec()
    by_axis = np.sqrt(np.linalg.eigvalsh(turns.T @ turns / len(turns))[::-1].clip(min=0.0))
    return np.asarray(by_axis)


def hand_eye_starts(X_WL: Array, X_CT: Sequence[Array], turns: Array, triples: int = 24) -> Array:
    """Return pairs of X_LC and X_WT (n, 2, 4, 4) from triples of frames.

    The triple with the largest rotation of the link comes first. There may be no pair (n = 0).

    Args:
        X_WL: (frames, 4, 4) the link's poses, of three frames or more.
        X_CT: for each frame (k, 4, 4) candidate poses of the target in the camera; k may vary.
        turns: (t, 4, 4) motions in frame T that leave the target's shape unchanged, with the
            identity.
        triples: maximum number of triples. Among four times as many random ones, those with the
            largest rotation about a second axis are used.
    """
    threes = list(combinations(range(len(X_WL)), 3))
    if len(threes) > triples:
        drawn = np.random.default_rng(0).permutation(len(threes))
        # Random triples include many without rotation; the best quarter is kept.
        threes = [threes[k] for k in drawn[: 4 * triples]]
    rotation = [rotation_spread(X_WL[list(three), :3, :3])[1] for three in threes]
    chosen = [threes[k] for k in np.argsort(rotation)[::-1][:triples]]
    turned = [(one[:, None] @ turns).reshape(-1, 4, 4) for one in X_CT]
    # The first frame's candidates fix which of the symmetric poses is called X_WT.
    found = [_of_three(X_WL[[i, j, k]], (X_CT[i], turned[j], turned[k])) for i, j, k in chosen]
    return np.concatenate(found)


def _of_three(
    X_WL: Array, X_CT: Sequence[Array], most: int = 500, angle: float = float(np.radians(20.0))
) -> Array:
    """Solve A X_LC = X_LC B for each combination of three frames' candidate poses.

    Args:
        X_WL: (3, 4, 4) the link's poses.
        X_CT: for each of the three frames (k, 4, 4) candidate poses.
        most: maximum number of combinations, those with the most similar angles of A and B first.
        angle: maximum difference of the rotation angles of A and B [rad].

    Returns (n, 2, 4, 4) X_LC and X_WT, the latter the mean of three frames.
    """
    pairs = ((0, 1), (0, 2), (1, 2))
    A = np.array([np.linalg.inv(X_WL[j]) @ X_WL[i] for i, j in pairs])
    a = Rotation.from_matrix(A[:, :3, :3]).as_rotvec()
    offs = []
    for (i, j), turned in zip(pairs, np.linalg.norm(a, axis=1), strict=True):
        traces = np.einsum("nij,mij->nm", X_CT[i][:, :3, :3], X_CT[j][:, :3, :3])
        offs.append(np.abs(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)) - turned))
    off = np.maximum(np.maximum(offs[0][:, :, None], offs[1][:, None]), offs[2][None])
    kept = np.argsort(off, axis=None)[: min(most, np.count_nonzero(off <= angle))]
    rows = np.unravel_index(kept, off.shape)
    poses = np.stack([one[row] for one, row in zip(X_CT, rows, strict=True)], axis=1)
    B = np.stack([poses[:, j] @ inverse_transforms(poses[:, i]) for i, j in pairs], axis=1)
    b = Rotation.from_matrix(B[:, :, :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(-1, 3, 3)
    # Least-squares rotation for a = R_LC b, with the rotation vectors a of A and b of B.
    R_LC = _nearest_rotations(np.einsum("pi,npj->nij", a, b))
    M = np.broadcast_to((A[:, :3, :3] - np.eye(3)).reshape(9, 3), (len(kept), 9, 3))
    t = (np.einsum("nij,npj->npi", R_LC, B[:, :, :3, 3]) - A[:, :3, 3]).reshape(-1, 9)
    X_LC = np.tile(np.eye(4), (len(kept), 1, 1))
    X_LC[:, :3, :3] = R_LC
    X_LC[:, :3, 3] = np.einsum("nij,nj->ni", np.linalg.pinv(M, rcond=1e-3), t)
    X_WT = (X_WL @ X_LC[:, None] @ poses).mean(axis=1)
    X_WT[:, :3, :3] = _nearest_rotations(X_WT[:, :3, :3])
    return np.stack([X_LC, X_WT], axis=1)


def _nearest_rotations(M: Array) -> Array:
    """Return the rotations (n, 3, 3) nearest to matrices M (n, 3, 3)."""
    U, _, V = np.linalg.svd(M)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ V))[:, None]
    return np.asarray(U @ V)
