"""Find which frames, cameras or joints contradict the others, where all of them are given.

Each frame, fitted by itself (``per_frame_fit``), gives linear equations N x = h for the errors x of
the given values, in units of their prior deviations. The covariance Q of h follows from
``fit.covariance``. An error common to all inlier frames is attributed to a joint offset, a camera
or the base. A frame is an outlier if its residual r = h - N x_common is significant: without errors
r^T Q^-1 r follows an F distribution.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import reduce
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc, fdtri

from drake_pose.arrays import Array, Mask
from drake_pose.fit.covariance import (
    Distances,
    ErrorSizes,
    distances_covariance,
    distances_in_masks,
    estimate_sizes,
)
from drake_pose.fit.judge import LEVEL
from drake_pose.fit.parameters import CAMERA_NAMES, POSE_NAMES
from drake_pose.registration.findings import Diagnosis, Finding, FrameDiagnosis
from drake_pose.registration.per_frame_fit import (
    FrameFit,
    PerFrameFit,
    explained_frames,
    likeliest_inliers,
)
from drake_pose.registration.shared_fit import SHARED


class DiagnosisSettings(NamedTuple):
    """Thresholds of a diagnosis."""

    # Probability with which a correct scene, or a correct frame, gets a finding.
    significance: float = 1e-4
    # Errors of a frame, and of all frames, that move outlines by less get no finding [pixel].
    min_pixels: float = 1.0
    min_common_pixels: float = 0.3
    focal_sd_floor: float = 0.001  # Minimum standard deviation of focal lengths [relative].
    # Statistics use directions of x with more information [of x's prior].
    min_information: float = 1.0


DIAGNOSIS = DiagnosisSettings()


class Information(NamedTuple):
    """The information of frames about x: the quadratic form x^T N x - 2 h^T x.

    N: (p, p) and h: (p,). of_surface: (p, 12 nodes) derivative of h by surface errors, which are
    the same in all frames. outlines: (nodes, p, p) quadratic forms of the squared motion of each
    node's outline, summed along it. lengths: (nodes,) of the outlines [pixel]. scale: variance
    factor of a frame's errors. freedom: degrees of freedom of this factor.
    """

    N: Array
    h: Array
    of_surface: Array
    outlines: Array
    lengths: Array
    scale: float
    freedom: float

    def plus(self, info: "Information", sign: float = 1.0) -> "Information":
        """Return the sum with `info` divided by its variance factor; sign -1: the difference."""
        weight = sign / info.scale
        return self._replace(
            N=self.N + weight * info.N,
            h=self.h + weight * info.h,
            of_surface=self.of_surface + weight * info.of_surface,
            outlines=self.outlines + sign * info.outlines,
            lengths=self.lengths + sign * info.lengths,
            freedom=self.freedom + sign * info.freedom,
        )

    def part(self, rows: Mask) -> "Information":
        """Return the information about the errors in `rows` (p,) if the others are known."""
        both = np.ix_(rows, rows)
        N, outlines = self.N[both], self.outlines[:, rows][:, :, rows]
        return self._replace(N=N, h=self.h[rows], outlines=outlines)

    def pixels(self, x: Array) -> float:
        """Return the root mean square motion of the outlines that x (p,) moves [pixel]."""
        squares = np.einsum("p,npq,q->n", x, self.outlines, x)
        moved = squares > 1e-6 * squares.max(initial=0.0)
        return float(np.sqrt(squares[moved].sum() / max(self.lengths[moved].sum(), 1e-9)))


class Cause(NamedTuple):
    """A possible cause of errors, and the result of its test.

    kind: "joint", "length", "camera", "base", "focal" or "center"; name: of the joint, link or
    camera, or words.
    jacobian: (p, d) derivative of x by the cause's d parameters. units: (d,) factors from amounts
    to a joint's position [rad or m]; rotation vector [rad] and translation [m] of a camera along
    its axes, or of the base in the world; logarithms of lengths; principal points [pixel].
    rank: of causes that explain errors equally well, the one with the lowest rank is reported.
    amount: (d,) the estimated parameters, with covariance (d, d). x: (p,) the errors they explain.
    p_value: of the test. gain: improvement of Akaike's information criterion.
    """

    kind: str
    name: str
    jacobian: Array
    units: Array
    rank: float
    amount: Array = np.zeros(0)
    covariance: Array = np.zeros((0, 0))
    x: Array = np.zeros(0)
    p_value: float = 1.0
    gain: float = 0.0


class Residual(NamedTuple):
    """Residual r (p,) of N x = r, with N (p, p), r's covariance Q (p, p), and frames' info."""

    info: Information
    N: Array
    r: Array
    Q: Array

    def solved(self, r: Array) -> Array:
        """Return x (p,) for a right-hand side r (p,), with the prior as regularisation."""
        return np.asarray(np.linalg.solve(self.N + np.eye(len(r)), r))

    def pixels(self, without: float | Array = 0.0) -> float:
        """Return how far the residual less N x, with x = `without` (p,), moves outlines [pixel]."""
        x = np.broadcast_to(without, self.r.shape)
        return self.info.pixels(self.solved(self.r - self.N @ x))

    @property
    def p_value(self) -> float:
        """Probability of a residual at least as large if nothing is wrong."""
        return f_test(*weighted_square(self.r, self.Q, self.N), self.info.freedom)

    def test(self, cause: Cause) -> Cause:
        """Return a cause with estimated amount, covariance and x, and with its p_value and gain."""
        M = cause.jacobian
        T, rank = weighted_square(M.T @ self.r, M.T @ self.Q @ M, M.T @ self.N @ M)
        # The number of parameters penalises causes that have several.
        p_value, gain = (
            f_test(T, rank, self.info.freedom),
            self.explained(M)[0] - 2.0 * M.shape[1],
        )
        return self.together([cause._replace(p_value=p_value, gain=gain)])[0]

    def explained(self, M: Array) -> tuple[float, int]:
        """Return by how much errors x = M a raise twice the log-likelihood, and M's rank."""
        known, turn = np.linalg.eigh(self.N)
        turn = turn[:, known > DIAGNOSIS.min_information]
        L = np.linalg.cholesky(turn.T @ self.Q @ turn)
        A = np.linalg.solve(L, turn.T @ np.column_stack([self.N @ M, self.r]))
        U, singular, _ = np.linalg.svd(A[:, :-1], full_matrices=False)
        along = U[:, singular > 1e-6 * singular.max(initial=1e-6)].T @ A[:, -1]
        return float(along @ along), len(along)

    def is_explained_by(self, one: Cause, other: Cause) -> bool:
        """Return whether another cause is not significant beside a cause."""
        both, alone = (
            self.explained(M) for M in (np.hstack([one.jacobian, other.jacobian]), one.jacobian)
        )
        more = both[0] - alone[0], both[1] - alone[1]
        return f_test(*more, self.info.freedom) > DIAGNOSIS.significance

    def together(self, causes: Sequence[Cause], cameras: Sequence[Cause] = ()) -> list[Cause]:
        """Return the causes, estimated together and beside small errors of the cameras' poses.

        cameras: causes with a prior: errors along each direction move outlines by
            ``min_common_pixels``.
        """
        M = np.hstack([one.jacobian for one in (*causes, *cameras)])
        ends = np.cumsum([one.jacobian.shape[1] for one in causes])
        prior, own = np.zeros((M.shape[1],) * 2), M[:, ends[-1] :]
        length = max(float(self.info.lengths.sum()), 1e-9) * DIAGNOSIS.min_common_pixels**2
        prior[ends[-1] :, ends[-1] :] = own.T @ self.info.outlines.sum(axis=0) @ own / length
        inverse = np.linalg.inv(M.T @ self.N @ M + prior + 1e-3 * np.eye(len(prior)))
        amounts = inverse @ M.T @ self.r
        covariance = inverse @ (M.T @ self.Q @ M + prior) @ inverse
        rows = (
            slice(end - one.jacobian.shape[1], end) for one, end in zip(causes, ends, strict=True)
        )
        return [
            one._replace(
                amount=amounts[k], covariance=covariance[k, k], x=one.jacobian @ amounts[k]
            )
            for one, k in zip(causes, rows, strict=True)
        ]

    def sufficient(self, tests: Sequence[Cause], fraction: float = 0.25) -> list[Cause]:
        """Return the tested causes that explain the residual by themselves, see `_best_first`.

        They leave less than a fraction of the residual's pixels, or less than ``min_pixels``.
        """
        most = max(DIAGNOSIS.min_pixels, fraction * self.pixels())
        return _best_first(one for one in tests if self.pixels(one.x) < most)

    def without(self, cause: Cause) -> "Residual":
        """Return the residual after elimination of a cause's parameters, whatever their amount."""
        M, N = cause.jacobian, self.N
        gain = np.eye(len(N)) - N @ M @ np.linalg.pinv(M.T @ N @ M) @ M.T
        return Residual(self.info, gain @ N @ gain.T, gain @ self.r, gain @ self.Q @ gain.T)


def diagnose_frames(
    fit: PerFrameFit, frames: Sequence[FrameFit], at: Array | None = None, moved: bool = False
) -> Diagnosis:
    """Diagnose fitted frames, in time linear in their number.

    ``fit``: the fit with which the frames were fitted. ``at``: (p,) corrections at which they were
    fitted; None: 0. ``moved``: whether cameras or the base may be far from their given poses, and
    intrinsics are right.
    """
    return _Diagnoser(fit, frames, np.zeros(len(fit.names)) if at is None else at, moved).diagnose()


class _Diagnoser:
    """State of a diagnosis."""

    def __init__(
        self, fit: PerFrameFit, frames: Sequence[FrameFit], at: Array, moved: bool
    ) -> None:
        self._fit, self._frames, self._at, self._moved = fit, frames, at, moved
        # Tolerated errors of a single frame: standard deviations [rad, m].
        tolerance = np.where(fit.is_angle, np.radians(0.1), 0.001)
        self._tolerance = np.diag((tolerance / fit.deviations) ** 2)
        self._known_distances = dict[str, Distances]()
        # Reported motions are clipped at a picture's diagonal: the linear model has no limit.
        self._max_pixels = max(float(np.hypot(one.width, one.height)) for one in fit.cameras)
        p, nodes = len(fit.names), len(fit.outlines)
        self._empty = Information(
            np.zeros((p, p)), np.zeros(p), np.zeros((p, 12 * nodes)), np.zeros((nodes, p, p)),
            np.zeros(nodes), 1.0, 0.0,
        )  # fmt: skip

    def diagnose(self) -> Diagnosis:
        """Return the diagnosis of all frames."""
        usual = 4.0 if self._moved else 0.4
        explained = explained_frames([one.inlier_ratios[1] for one in self._frames])

        def evaluate(kept: Mask) -> tuple[Mask, Array]:
            """Return which frames (frames,) fit to a set's common errors (p,), and these."""
            common = self._common(self._sum(kept))
            residuals = [self._residual(info, *common) for info in self._info]
            fits = np.array([one.p_value > DIAGNOSIS.significance for one in residuals])
            return fits, common[0] - self._at

        # In the first pass inliers are unknown, so error sizes come from single frames.
        inliers, together = explained, 1
        for _ in range(2):
            sizes = self._pooled_sizes(np.flatnonzero(inliers).tolist(), together)
            self._info = [self._info_of(one, sizes) for one in self._frames]
            self._surface = sizes.surface
            # In the second pass, outliers no longer enlarge the error sizes.
            inliers, together = likeliest_inliers(explained, evaluate, usual), 4
        total, frames = self._sum(inliers), list[FrameDiagnosis]()
        rows = zip(self._frames, self._info, inliers, explained, strict=True)
        for fitted, info, is_inlier, is_explained in rows:
            common = self._common(total.plus(info, -1.0) if is_inlier else total)
            residual = self._residual(info, *common)
            tests = [residual.test(cause) for cause in self._causes(fitted)]
            # Bonferroni correction for the number of tests.
            least = min(residual.p_value, *(one.p_value for one in tests)) * (1 + len(tests))
            finding, pixels = None, min(residual.pixels(), self._max_pixels)
            if not is_explained:
                finding = self._joints_finding("unexplained", residual)
            elif least <= DIAGNOSIS.significance and pixels >= DIAGNOSIS.min_pixels:
                sufficient = residual.sufficient(tests)
                finding = self._joints_finding("joints", residual)
                if sufficient:
                    finding = self._finding(sufficient, residual.info.pixels(sufficient[0].x))
            frames.append(FrameDiagnosis(fitted.name, *fitted.inlier_ratios, pixels, finding))
        kept = np.array([one.finding is None for one in frames])
        common_findings = self._common_findings(kept) if kept.any() else ((), None, {}, self._at)
        found = Diagnosis(tuple(frames), *common_findings)
        remaining = total.pixels(found.corrections - self._at)
        return replace(found, remaining=min(remaining, self._max_pixels))

    def _pooled_sizes(self, indices: Sequence[int], together: int, most: int = 5) -> ErrorSizes:
        """Return the median error sizes of up to `most` groups of `together` frames.

        indices: of the frames that groups are drawn from; empty: sizes of a pixel are assumed.
        """
        if not len(indices):
            # Contours err by about a pixel.
            return ErrorSizes(1.0, 0.0, 1.0, 1.0, 1.0)
        groups = max(1, min(most, len(indices) // together))
        count = min(len(indices), groups * together)
        spread = [indices[k] for k in np.linspace(0, len(indices) - 1, count).round().astype(int)]
        sizes = []
        for k in range(groups):
            masks = [one for i in spread[k::groups] for one in self._frames[i].compared_masks]
            distances = distances_in_masks(self._fit.outlines, masks, with_bias=True)
            is_angle = np.append(self._fit.is_angle, np.zeros(len(masks), bool))
            sizes.append(estimate_sizes(distances, is_angle, min_camera=0.0)[:5])
        return ErrorSizes(*np.median(np.array(sizes), axis=0).tolist())

    def _info_of(self, fitted: FrameFit, sizes: ErrorSizes, bias_sd: float = 2.0) -> Information:
        """Return a frame's information; bias_sd: prior deviation of its masks' biases [pixel]."""
        known = float(SHARED.prior_freedom)
        if not fitted.compared_masks:
            return self._empty._replace(lengths=fitted.outline_lengths, freedom=known)
        if fitted.name not in self._known_distances:
            self._known_distances[fitted.name] = distances_in_masks(
                self._fit.outlines, fitted.compared_masks, with_bias=True
            )
        distances = self._known_distances[fitted.name]
        own, biases = np.split(distances.X, [len(self._fit.names)], axis=1)
        X = own * self._fit.deviations
        V = distances_covariance(distances, sizes) + bias_sd**2 * biases @ biases.T
        PX, Py = np.split(np.linalg.solve(V, np.column_stack([X, distances.y])), [-1], axis=1)
        N, h = X.T @ PX, PX.T @ distances.y
        T, rank = weighted_square(h, N)
        residual = max(float(distances.y @ Py[:, 0]) - T, 0.0)
        freedom = known + len(distances.y) - rank
        scale = max((known + residual) / freedom, 1.0)
        outlines = self._empty.outlines.copy()
        for one in fitted.compared_masks:
            moves = one.moves * self._fit.deviations[:, None]
            outlines += moves @ one.A @ np.swapaxes(moves, 1, 2)
        return Information(
            N, h, PX.T @ distances.surface_derivatives, outlines, fitted.outline_lengths, scale,
            freedom,
        )  # fmt: skip

    def _sum(self, kept: Mask) -> Information:
        """Return the sum of the information of the `kept` (frames,) ones."""
        return reduce(Information.plus, compress(self._info, kept), self._empty)

    def _covariance(self, total: Information) -> Array:
        """Return the covariance (p, p) of a sum's h, with errors of the surfaces."""
        surface = self._surface * total.of_surface
        return np.asarray(total.N + surface @ surface.T)

    def _common(self, total: Information) -> tuple[Array, Array]:
        """Return the errors x (p,) common to the frames of a sum, and their covariance (p, p)."""
        # Without frames, the given values are right to within the tolerance.
        prior = np.eye(len(total.h)) if total.freedom else np.linalg.inv(self._tolerance)
        inverse, left = np.linalg.inv(total.N + prior), total.h - total.N @ self._at
        return self._at + inverse @ left, inverse @ (self._covariance(total) + prior) @ inverse

    def _residual(self, info: Information, x: Array, covariance: Array) -> Residual:
        """Return a frame's residual from the common errors x (p,), with their covariance (p, p)."""
        Q = info.scale * info.N + info.N @ (covariance + self._tolerance) @ info.N
        rows, part = self._fit.posed, info.part(self._fit.posed)
        return Residual(part, part.N, (info.h - info.N @ x)[rows], Q[np.ix_(rows, rows)])

    def _causes(self, fitted: FrameFit | None) -> list[Cause]:
        """Return the possible causes, untested, of errors in one fitted frame, or in all (None).

        A frame's cameras are those with a mask. In all frames focal lengths and principal points
        are causes, too, of all cameras together and of each; and lengths of links.
        """
        fit, names, six = self._fit, self._fit.camera_names, len(POSE_NAMES)

        def cause(kind: str, name: str, rows: Sequence[int], rank: float) -> Cause:
            """Return a cause with one parameter for each of some rows."""
            return Cause(kind, name, np.eye(len(fit.names))[:, rows], fit.deviations[rows], rank)

        causes = [cause("joint", name, [k], 1.0) for k, name in enumerate(fit.joints)]
        for c, name in enumerate(names):
            if fitted is None or c in {one.camera for one in fitted.compared_masks}:
                causes.append(cause("camera", name, fit.rows(POSE_NAMES, [name]), six))
        if len(names) > 1:
            causes.append(Cause("base", "base", fit.base_jacobian(), np.ones(six), six))
        if fitted is not None:
            return [one._replace(jacobian=one.jacobian[fit.posed]) for one in causes]
        if self._moved:
            return causes
        for k, link in enumerate(fit.links, len(fit.names) - len(fit.links)):
            causes.append(cause("length", link, [k], 1.5))
        flat = {one.name for one in fit.cameras if one.kernel_parameters()[0] == 1.0}
        groups = [("", names)] if len(names) > 1 else []
        groups += [(f" of camera '{name}'", (name,)) for name in names]
        for where, group in groups:
            # For one camera, a wrong pose explains more often than a wrong principal point.
            many, rank = ("", 6.5) if where else ("s", 2.0)
            for kind, text, of, order in (
                ("focal", f"focal length{many}{where}", CAMERA_NAMES[six:7], 1.0),
                ("center", f"principal point{many}{where}", CAMERA_NAMES[7:], rank),
            ):
                if kind == "focal" and not flat.isdisjoint(group):
                    continue
                single = [cause(kind, text, fit.rows(of, [name]), order) for name in group]
                jacobian = np.sum([one.jacobian for one in single], axis=0)
                causes.append(single[0]._replace(jacobian=jacobian))
        return causes

    def _finding(self, sufficient: Sequence[Cause], pixels: float) -> Finding:
        """Return the finding of the first sufficient cause; the others are its alternatives.

        pixels: root mean square distance by which the cause moves outlines [pixel].
        """
        best, *others = sufficient
        alternatives = [one.name for one in others]
        one_camera = len(self._fit.camera_names) == 1
        if one_camera and any(one.kind == "camera" for one in sufficient):
            alternatives.append("base")
        kind, name = best.kind, best.name
        variances = np.maximum(np.diag(best.covariance), 0.0)
        x, sd = best.amount * best.units, np.sqrt(variances) * best.units
        if kind in ("focal", "length"):
            # Errors of the body's size limit the accuracy of a focal length.
            x, sd = np.expm1(x), np.exp(x) * np.hypot(sd, DIAGNOSIS.focal_sd_floor)
        # Poses are rotation, then translation; a joint is one of them; the rest counts as shift.
        turns = len(x) // 2 if kind in ("camera", "base") else 0
        if kind == "joint":
            turns = int(self._fit.is_angle[self._fit.joints.index(name)])

        def size(part: Array) -> float:
            return float(part[0]) if len(part) == 1 else float(np.linalg.norm(part))

        at_body = 0.0
        if kind == "camera":
            # Report the shift of the camera's centre, not that of the body in its frame.
            own, at_body = self._fit.camera_jacobian(name), size(x[3:])
            covariance = best.covariance * np.outer(best.units, best.units)
            x[3:], sd[3:] = own @ x, np.sqrt(np.diag(own @ covariance @ own.T))
        sizes = (size(x[:turns]), size(x[turns:]), size(sd[:turns]), size(sd[turns:]))
        off = (*sizes, min(pixels, self._max_pixels), best.p_value, tuple(alternatives))
        return Finding(kind, name, *off, at_body=at_body)

    def _joints_finding(self, kind: str, residual: Residual) -> Finding:
        """Return a finding, "joints" or "unexplained", of a frame that no single cause explains."""
        x, names = residual.solved(residual.r), self._fit.joints
        sd = np.sqrt(residual.info.scale * np.diag(np.linalg.inv(residual.N + np.eye(len(x)))))
        joints = x[: len(names)] * self._fit.deviations[: len(names)]
        turns = self._fit.is_angle[: len(names)]
        angle = float(np.abs(joints[turns]).max(initial=0.0))
        shift = float(np.abs(joints[~turns]).max(initial=0.0))
        sure = np.flatnonzero((np.abs(x) > 3.0 * sd)[: len(names)])
        named = {names[k]: float(joints[k]) for k in sure}
        off = (angle, shift, 0.0, 0.0, min(residual.pixels(), self._max_pixels))
        return Finding(kind, "", *off, residual.p_value, (), named)

    def _common_findings(
        self, kept: Mask
    ) -> tuple[
        tuple[Finding, ...], tuple[list[float], list[float]] | None, dict[str, float], Array
    ]:
        """Return all but the frames of a ``Diagnosis`` from `kept` (frames,)."""
        info = self._sum(kept)
        Q = self._covariance(info) + info.N @ self._tolerance @ info.N / np.count_nonzero(kept)
        h = info.h - info.N @ self._at * self._moved
        residual = Residual(info, info.N, h, Q)
        causes = self._causes(None)
        if self._moved:
            # The base is a cause only if its motion explains nearly all by itself.
            tests = [residual.test(one) for one in causes if one.kind == "base"]
            alone = residual.sufficient(tests, 0.1)
            causes = [one for one in causes if one.kind != "base" or alone]
        # The first principal points are those of all cameras.
        shifted = next((residual.test(one) for one in causes if one.kind == "center"), None)
        others = [residual.test(one).gain for one in causes if one.kind != "center"]
        center = None
        if shifted is not None and shifted.gain > max(others):
            x, covariance = shifted.amount * shifted.units, shifted.covariance * shifted.units**2
            if is_half_pixel(x, covariance):
                residual = residual.without(shifted)
                center = x.tolist(), np.sqrt(np.diag(covariance)).tolist()
        # The linear equations err by a part of the step from where the frames were fitted.
        slack = 0.25 * residual.pixels(self._at)
        whole, (residual, found, left) = residual, name_causes(residual, causes, slack)
        # Small offsets and lengths are tested after elimination of all cameras' poses.
        for cause in (one for one in causes if one.kind == "camera"):
            residual = residual.without(cause)
        small = [one for one in left if one.kind in ("joint", "length")]
        residual, offsets, undetected = name_causes(residual, small, slack)
        found += offsets
        findings, at = list[Finding](), np.zeros(len(info.h))
        if found:
            free = [one for one in left if one.kind == "camera"]
            own = [best for best, *_ in found]
            for better, (_, *others_too) in zip(whole.together(own, free), found, strict=True):
                pixels = info.pixels(better.x)
                # A cause may vanish in the joint estimate.
                T = float(better.amount @ np.linalg.solve(better.covariance, better.amount))
                p_value = f_test(T, len(better.amount), info.freedom)
                if p_value <= LEVEL and pixels >= DIAGNOSIS.min_common_pixels:
                    findings.append(self._finding([better, *others_too], pixels))
                    at += better.x
        undetected = [one for one in undetected if one.kind == "joint"]
        return tuple(findings), center, minimum_detectable_offsets(residual, undetected), at


def name_causes(
    residual: Residual, causes: Sequence[Cause], slack: float = 0.0
) -> tuple[Residual, list[list[Cause]], list[Cause]]:
    """Select significant causes, of untested ones, one after another.

    Of those that explain as much as the best, so that it is not significant beside them, the one
    with the lowest rank is selected.

    ``slack``: causes that leave less of the residual explain as much, too [pixel]. Returns the
    residual without the selected causes; for each a list of it and its alternatives; and the
    causes that are left.
    """
    left, named = list(causes), list[list[Cause]]()
    while left:
        # A cause must be significant by itself (Bonferroni), and so must its alternatives.
        tests = [
            one
            for one in map(residual.test, left)
            if one.p_value * len(left) <= DIAGNOSIS.significance
            and residual.info.pixels(one.x) >= DIAGNOSIS.min_common_pixels
        ]
        if not tests:
            break
        most = max(tests, key=lambda one: one.gain)
        enough = (
            one
            for one in tests
            if one is most or residual.pixels(one.x) < slack or residual.is_explained_by(one, most)
        )
        named.append(_best_first(enough))
        best = named[-1][0]
        residual = residual.without(best)
        left = [one for one in left if (one.kind, one.name) != (best.kind, best.name)]
    return residual, named, left


def _best_first(causes: Iterable[Cause]) -> list[Cause]:
    """Return causes, the lowest rank first, among equal ranks that with the largest gain."""
    return sorted(causes, key=lambda one: (one.rank, -one.gain))


def minimum_detectable_offsets(residual: Residual, causes: Sequence[Cause]) -> dict[str, float]:
    """Return by joint the offset detected with a probability of 95 % [rad or m]; inf: never.

    causes: of kind "joint", without a finding in the residual.
    """
    level = DIAGNOSIS.significance / max(1, len(causes))
    critical, found = fdtri(1, residual.info.freedom, 1.0 - level), {}
    for cause in causes:
        along = cause.jacobian[:, 0]
        sd = np.sqrt(max(float(along @ residual.Q @ along), 0.0))
        information = max(float(along @ residual.N @ along), 1e-9)
        amount = (np.sqrt(critical) + 1.645) * sd / information
        pixels = max(residual.info.pixels(along), 1e-9)
        is_observable = information > DIAGNOSIS.min_information
        least = max(amount, DIAGNOSIS.min_common_pixels / pixels) if is_observable else np.inf
        found[cause.name] = float(least * cause.units[0])
    return found


def is_half_pixel(offset: Array, covariance: Array, near: float = 0.25) -> bool:
    """Return whether principal points' offset (2,) [pixel] is significant, and half a pixel.

    ``near``: largest difference from half a pixel along both axes [pixel].
    """
    half = np.copysign(0.5, offset.sum())
    T = float(offset @ np.linalg.solve(covariance, offset))
    return chdtrc(2, T) <= DIAGNOSIS.significance and bool(np.abs(offset - half).max() <= near)


def weighted_square(r: Array, Q: Array, N: Array | None = None) -> tuple[float, int]:
    """Return r^T Q^-1 r in the directions with enough information, and their number.

    r (p,) has the covariance Q (p, p) and the information N (p, p); None: Q is both.
    """
    known, turn = np.linalg.eigh(Q if N is None else N)
    turn = turn[:, known > DIAGNOSIS.min_information]
    if not turn.shape[1]:
        return 0.0, 0
    along = turn.T @ r
    return float(along @ np.linalg.solve(turn.T @ Q @ turn, along)), turn.shape[1]


def f_test(T: float, rank: int, freedom: float) -> float:
    """Return the p-value of T, see `weighted_square`: T / rank has an F distribution; rank 0: 1."""
    return float(fdtrc(rank, freedom, max(T, 0.0) / rank)) if rank else 1.0
