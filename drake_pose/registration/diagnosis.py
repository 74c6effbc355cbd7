"""Which frames, cameras or joints contradict the rest, where all of them are given.

Each frame, fitted by itself (``per_frame_fit``), gives N x = h for the error x of what is given,
with h's covariance Q by ``fit.covariance``. What all frames that agree are off alike is the fault
of a joint's offset, a camera or the base. A frame is an outlier if it is significantly off from the
others: r^T Q^-1 r, r = h - N x_common, follows Fisher's distribution where nothing is wrong.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import reduce
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc, fdtri

from drake_pose.arrays import Array, Mask
from drake_pose.fit.covariance import (
    ComparedMask,
    Distances,
    ErrorSizes,
    distances_covariance,
    distances_in_masks,
    estimate_sizes,
)
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.registration.findings import Diagnosis, Finding, FrameDiagnosis
from drake_pose.registration.per_frame_fit import FrameFit, PerFrameFit
from drake_pose.registration.shared_fit import SHARED


class DiagnosisSettings(NamedTuple):
    """From when on something counts as wrong.

    significance: a right scene, or a right frame, is named with at most this probability.
    min_pixels, min_joint_pixels: what moves outlines by less [pixel] is not named; the latter is
    for joint offsets in all frames that agree, whatever cameras are off by. least_focal: focal
    lengths are known no better [share]. min_information: directions with less information, in units
    of the priors, are left out.
    """

    significance: float = 1e-4
    min_pixels: float = 1.0
    min_joint_pixels: float = 0.3
    focal_sd_floor: float = 0.001
    min_information: float = 1.0


DIAGNOSIS = DiagnosisSettings()


class _Information(NamedTuple):
    """The information of frames on what was free, in units of its deviations: x^T N x - 2 h^T x.

    N: (p, p); h: (p,); of_surface: (p, 12 nodes) how h follows the surfaces, which are the same in
    all frames; outlines: (nodes, p, p) squares of how far x moves each part's outline, summed along
    it, and lengths: (nodes,) [pixel]; scale: of the frame's errors, a variance; freedom: with which
    that is known.
    """

    N: Array
    h: Array
    of_surface: Array
    outlines: Array
    lengths: Array
    scale: float
    freedom: float

    def plus(self, info: "_Information", sign: float = 1.0) -> "_Information":
        """With another frame, by the scale of its errors; or without one of these: sign -1."""
        weight = sign / info.scale
        return self._replace(
            N=self.N + weight * info.N,
            h=self.h + weight * info.h,
            of_surface=self.of_surface + weight * info.of_surface,
            outlines=self.outlines + sign * info.outlines,
            lengths=self.lengths + sign * info.lengths,
            freedom=self.freedom + sign * info.freedom,
        )

    def pixels(self, x: Array) -> float:
        """How far x moves the outlines of the parts that it moves, root mean square [pixel]."""
        squares = np.einsum("p,npq,q->n", x, self.outlines, x)
        moved = squares > 1e-6 * squares.max(initial=0.0)
        return float(np.sqrt(squares[moved].sum() / max(self.lengths[moved].sum(), 1e-9)))


class _Cause(NamedTuple):
    """What may be off: a "joint", a "camera", the "base", "focal" or "center", and its name.

    moves: (p, d) how what was free follows it: a joint's position [rad or m], or a rotation vector
    [rad] and a shift [m] of a camera along its axes, or of the base in the world, a share of focal
    lengths, or principal points [pixel]; units: (d,).
    rank: of causes that explain equally well, the one with the lowest rank is named.
    Once it was tested: by what amount (d,) it is off, with covariance, and how far that moves what
    was free, x (p,); with what chance; Akaike's gain.
    """

    kind: str
    name: str
    moves: Array
    units: Array
    rank: float
    amount: Array = np.zeros(0)
    covariance: Array = np.zeros((0, 0))
    x: Array = np.zeros(0)
    p_value: float = 1.0
    gain: float = 0.0


class _Residual(NamedTuple):
    """The residual r (p,) of N x = r, and its covariance Q."""

    info: _Information
    N: Array
    r: Array
    Q: Array

    def solved(self, r: Array) -> Array:
        """(p,) x of another r, zero where there is no information."""
        return np.asarray(np.linalg.solve(self.N + np.eye(len(r)), r))

    def pixels(self, without: float | Array = 0.0) -> float:
        """How far outlines are off [pixel]; without x (p,)."""
        x = np.broadcast_to(without, self.r.shape)
        return self.info.pixels(self.solved(self.r - self.N @ x))

    @property
    def p_value(self) -> float:
        """How often a residual is as large by chance."""
        return _p_value(*_statistic(self.r, self.Q, self.N), self.info.freedom)

    def test(self, cause: _Cause) -> _Cause:
        """Whether a cause is off."""
        M = cause.moves
        N, r, Q = M.T @ self.N @ M, M.T @ self.r, M.T @ self.Q @ M
        T, rank = _statistic(r, Q, N)
        inverse = np.linalg.inv(N + 1e-3 * np.eye(len(r)))
        amount = inverse @ r
        # More numbers explain more by chance.
        return cause._replace(
            amount=amount, covariance=inverse @ Q @ inverse, x=M @ amount,
            p_value=_p_value(T, rank, self.info.freedom), gain=T - 2.0 * rank,
        )  # fmt: skip

    def sufficient(
        self, tests: Sequence[_Cause], least: float, share: float = 0.25
    ) -> list[_Cause]:
        """Causes that suffice, sorted by rank and gain.

        They leave less than a fraction of the residual, or less than `least` [pixel].
        """
        most = max(least, share * self.pixels())
        enough = [one for one in tests if self.pixels(one.x) < most]
        return sorted(enough, key=lambda one: (one.rank, -one.gain))

    def without(self, cause: _Cause) -> "_Residual":
        """The residual once a cause was put right."""
        M, N = cause.moves, self.N
        gain = np.eye(len(N)) - N @ M @ np.linalg.pinv(M.T @ N @ M) @ M.T
        return _Residual(self.info, gain @ N @ gain.T, gain @ self.r, gain @ self.Q @ gain.T)


def diagnose_frames(
    fit: PerFrameFit,
    frames: Sequence[FrameFit],
    asked: Collection[tuple[str, str]] = (),
    moved: bool = False,
) -> Diagnosis:
    """Finds what contradicts the rest in frames that were fitted, in time linear in them.

    Args:
        asked: kinds and names of what is told of all frames that agree, however little it is off.
        moved: whether cameras or the base may stand far from where they are said to, lenses being
            right.
    """
    return _Diagnoser(fit, frames, asked, moved).diagnose()


class _Diagnoser:
    """A diagnosis under way."""

    def __init__(
        self,
        fit: PerFrameFit,
        frames: Sequence[FrameFit],
        asked: Collection[tuple[str, str]],
        moved: bool,
    ) -> None:
        self._fit, self._frames, self._asked, self._moved = fit, frames, asked, moved
        # Errors of a single frame: standard deviations of angles [rad], and of places [m].
        tolerance = np.where(fit.is_angle, np.radians(0.1), 0.001)
        self._tolerance = np.diag((tolerance / fit.deviations) ** 2)
        self._seen = dict[str, Distances]()
        # Outlines are in the pictures, however far off a linear fit says they are.
        self._most = max(float(np.hypot(one.width, one.height)) for one in fit.cameras)
        p, nodes = len(fit.names), len(fit.outlines)
        self._nothing = _Information(
            np.zeros((p, p)), np.zeros(p), np.zeros((p, 12 * nodes)), np.zeros((nodes, p, p)),
            np.zeros(nodes), 1.0, 0.0,
        )  # fmt: skip

    def diagnose(self) -> Diagnosis:
        """Does it."""
        usual = 4.0 if self._moved else 0.4
        explained = explained_frames([one.inlier_ratios[1] for one in self._frames])

        def evaluate(kept: Mask) -> tuple[Array, Array]:
            common = self._common(self._sum(kept))
            residuals = [self._residual(info, *common) for info in self._info]
            return np.array([one.p_value for one in residuals]), common[0]

        # While it is unknown which frames agree, sizes of errors come from each by itself.
        agreeing, together = explained, 1
        for _ in range(2):
            sizes = self._pooled_sizes(np.flatnonzero(agreeing).tolist(), together)
            self._info = [self._info_of(one, sizes) for one in self._frames]
            self._surface = sizes.surface
            # Contradicting frames no longer make errors seem large.
            agreeing, together = likeliest_inliers(explained, evaluate, usual), 4
        total, frames = self._sum(agreeing), list[FrameDiagnosis]()
        for fitted, info, is_inlier, is_explained in zip(
            self._frames, self._info, agreeing, explained, strict=True
        ):
            common = self._common(total.plus(info, -1.0) if is_inlier else total)
            residual = self._residual(info, *common)
            tests = [residual.test(cause) for cause in self._causes(fitted)]
            # Each of the tests may find something by chance.
            least = min(residual.p_value, *(one.p_value for one in tests)) * (1 + len(tests))
            finding, pixels = None, min(residual.pixels(), self._most)
            if not is_explained:
                finding = self._joints_finding("unexplained", residual)
            elif least <= DIAGNOSIS.significance and pixels >= DIAGNOSIS.min_pixels:
                sufficient = residual.sufficient(tests, DIAGNOSIS.min_pixels)
                finding = (
                    self._finding(sufficient, info.pixels(sufficient[0].x))
                    if sufficient
                    else self._joints_finding("joints", residual)
                )
            frames.append(FrameDiagnosis(fitted.name, *fitted.inlier_ratios, pixels, finding))
        kept = np.array([one.finding is None for one in frames])
        common_findings = self._common_findings(kept) if kept.any() else ((), None, {})
        return Diagnosis(tuple(frames), common_findings[0], sizes, *common_findings[1:])

    def _pooled_sizes(self, which: Sequence[int], together: int, most: int = 5) -> ErrorSizes:
        """How large errors are: medians over some groups of frames that are spread over all."""
        if not len(which):
            # Contours err by about a pixel.
            return ErrorSizes(1.0, 0.0, 1.0, 1.0, 1.0)
        groups = max(1, min(most, len(which) // together))
        count = min(len(which), groups * together)
        spread = [which[k] for k in np.linspace(0, len(which) - 1, count).round().astype(int)]
        sizes = []
        for k in range(groups):
            pictures = [one for i in spread[k::groups] for one in self._frames[i].compared_masks]
            seen = self._distances(pictures)
            is_angle = np.append(self._fit.is_angle, np.zeros(len(pictures), bool))
            sizes.append(estimate_sizes(seen, is_angle, min_camera=0.0)[:5])
        return ErrorSizes(*np.median(np.array(sizes), axis=0).tolist())

    def _distances(self, pictures: Sequence[ComparedMask]) -> Distances:
        """The distances in pictures; their values are what was free, then each picture's width."""
        return distances_in_masks(self._fit.outlines, pictures, with_bias=True)

    def _info_of(self, fitted: FrameFit, sizes: ErrorSizes, width_sd: float = 2.0) -> _Information:
        """The information of a frame, whose masks' widths are right to a deviation [pixel]."""
        known = float(SHARED.prior_freedom)
        if not fitted.compared_masks:
            return self._nothing._replace(lengths=fitted.outline_lengths, freedom=known)
        if fitted.name not in self._seen:
            self._seen[fitted.name] = self._distances(fitted.compared_masks)
        seen = self._seen[fitted.name]
        own, widths = np.split(seen.X, [len(self._fit.names)], axis=1)
        X = own * self._fit.deviations
        V = distances_covariance(seen, sizes) + width_sd**2 * widths @ widths.T
        PX, Py = np.split(np.linalg.solve(V, np.column_stack([X, seen.y])), [-1], axis=1)
        N, h = X.T @ PX, PX.T @ seen.y
        T, rank = _statistic(h, N)
        residual = max(float(seen.y @ Py[:, 0]) - T, 0.0)
        freedom = known + len(seen.y) - rank
        scale = max((known + residual) / freedom, 1.0)
        outlines = self._nothing.outlines.copy()
        for one in fitted.compared_masks:
            moves = one.moves * self._fit.deviations[:, None]
            outlines += moves @ one.A @ np.swapaxes(moves, 1, 2)
        return _Information(
            N, h, PX.T @ seen.bends, outlines, fitted.outline_lengths, scale, freedom
        )

    def _sum(self, kept: Mask) -> _Information:
        """The information of some frames, each by the scale of its errors."""
        return reduce(_Information.plus, compress(self._info, kept), self._nothing)

    def _covariance(self, total: _Information) -> Array:
        """(p, p) of a sum's h, the surfaces' errors included."""
        surface = self._surface * total.of_surface
        return np.asarray(total.N + surface @ surface.T)

    def _common(self, total: _Information) -> tuple[Array, Array]:
        """What frames have in common, x (p,), and its covariance; without any, nothing is off."""
        # Without other frames what is given is right to within a tolerance.
        prior = np.eye(len(total.h)) if total.freedom else np.linalg.inv(self._tolerance)
        inverse = np.linalg.inv(total.N + prior)
        return inverse @ total.h, inverse @ (self._covariance(total) + prior) @ inverse

    def _residual(self, info: _Information, x: Array, covariance: Array) -> _Residual:
        """A frame's residual from what is common, x (p,) with its covariance."""
        Q = info.scale * info.N + info.N @ (covariance + self._tolerance) @ info.N
        return _Residual(info, info.N, info.h - info.N @ x, Q)

    def _causes(self, fitted: FrameFit | None) -> list[_Cause]:
        """All that may be off by itself; of the cameras those that see a frame.

        In all frames (None) focal lengths and principal points, too: of all cameras, of each.
        """
        fit, six = self._fit, len(POSE_NAMES)
        deviations, joints, names = fit.deviations, len(fit.joints), fit.camera_names
        eye = np.eye(len(fit.names))
        causes = [
            _Cause("joint", name, eye[:, [k]], deviations[[k]], 1)
            for k, name in enumerate(fit.joints)
        ]
        for c, name in enumerate(names):
            if fitted is None or c in {one.camera for one in fitted.compared_masks}:
                own = slice(joints + c * six, joints + (c + 1) * six)
                causes.append(_Cause("camera", name, eye[:, own], deviations[own], six))
        if len(names) > 1:
            causes.append(_Cause("base", "base", fit.base_jacobian(), np.ones(six), six))
        if fitted is not None or self._moved:
            return causes
        groups = [("", [*range(len(names))])] if len(names) > 1 else []
        groups += [(f" of camera '{name}'", [c]) for c, name in enumerate(names)]
        for where, group in groups:
            # A single camera was rather moved than has its principal point elsewhere.
            many, rank = ("", 6.5) if where else ("s", 2.0)
            focal, center = fit.focal_jacobian(group), fit.center_jacobian(group)
            if focal.any():
                causes.append(_Cause("focal", f"focal length{many}{where}", focal, np.ones(1), 1))
            text = f"principal point{many}{where}"
            causes.append(_Cause("center", text, center, np.ones(2), rank))
        return causes

    def _finding(self, sufficient: Sequence[_Cause], pixels: float) -> Finding:
        """The first of the causes that suffice, and its rivals."""
        best, *others = sufficient
        alternatives = [one.name for one in others]
        seen_by_one = len(self._fit.camera_names) == 1
        if seen_by_one and any(one.kind == "camera" for one in sufficient):
            alternatives.append("base")
        kind, name = best.kind, best.name
        variances = np.maximum(np.diag(best.covariance), 0.0)
        if kind == "focal":
            # A body is seen larger as if it were nearer to a thousandth of its depth at best.
            variances = variances + DIAGNOSIS.focal_sd_floor**2
        x, sd = best.amount * best.units, np.sqrt(variances) * best.units
        # Poses turn and shift; a joint does one of them; the rest is shifts.
        turns = len(x) // 2 if kind in ("camera", "base") else 0
        if kind == "joint":
            turns = int(self._fit.is_angle[self._fit.joints.index(name)])

        def size(part: Array) -> float:
            return float(part[0]) if len(part) == 1 else float(np.linalg.norm(part))

        at_body = 0.0
        if kind == "camera":
            # A camera that turns where it stands shifts the body.
            own, at_body = self._fit.camera_jacobian(name), size(x[3:])
            covariance = best.covariance * np.outer(best.units, best.units)
            x[3:], sd[3:] = own @ x, np.sqrt(np.diag(own @ covariance @ own.T))
        sizes = (size(x[:turns]), size(x[turns:]), size(sd[:turns]), size(sd[turns:]))
        off = (*sizes, min(pixels, self._most), best.p_value, tuple(alternatives))
        return Finding(kind, name, *off, at_body=at_body)

    def _joints_finding(self, kind: str, residual: _Residual) -> Finding:
        """What is off in a frame where no cause by itself explains it."""
        x, names = residual.solved(residual.r), self._fit.joints
        sd = np.sqrt(residual.info.scale * np.diag(np.linalg.inv(residual.N + np.eye(len(x)))))
        joints = (x * self._fit.deviations)[: len(names)]
        turns = self._fit.is_angle[: len(names)]
        angle = float(np.abs(joints[turns]).max(initial=0.0))
        shift = float(np.abs(joints[~turns]).max(initial=0.0))
        sure = np.flatnonzero((np.abs(x) > 3.0 * sd)[: len(names)])
        named = {names[k]: float(joints[k]) for k in sure}
        off = (angle, shift, 0.0, 0.0, min(residual.pixels(), self._most))
        return Finding(kind, "", *off, residual.p_value, (), named)

    def _common_findings(
        self, kept: Mask
    ) -> tuple[tuple[Finding, ...], tuple[list[float], list[float]] | None, dict[str, float]]:
        """What is off in all frames that agree, and what would be seen, as Diagnosis has it."""
        info, count = self._sum(kept), np.count_nonzero(kept)
        Q = self._covariance(info) + info.N @ self._tolerance @ info.N / count
        residual = _Residual(info, info.N, info.h, Q)
        causes = self._causes(None)
        if self._moved:
            # Cameras that moved by themselves are not told as the base and the rest.
            tests = [residual.test(one) for one in causes if one.kind == "base"]
            alone = residual.sufficient(tests, DIAGNOSIS.min_pixels, 0.1)
            causes = [one for one in causes if one.kind != "base" or alone]
        every = range(len(self._fit.camera_names))
        shifted = residual.test(
            _Cause("center", "", self._fit.center_jacobian(every), np.ones(2), 2)
        )
        others = [residual.test(one).gain for one in causes if one.kind != "center"]
        center = None
        if is_half_pixel(shifted.amount, shifted.covariance) and shifted.gain > max(others):
            residual = residual.without(shifted)
            sd = np.sqrt(np.diag(shifted.covariance))
            center = shifted.amount.tolist(), sd.tolist()
        whole, (residual, found) = residual, _name(residual, causes, DIAGNOSIS.min_pixels)
        # A joint's offset moves little beside what calibrations are off by: these are free now.
        named, joints, freed = [one[0].name for one in found], list[_Cause](), list[_Cause]()
        for cause in causes:
            if cause.kind == "camera":
                residual = residual.without(cause)
                freed.append(cause)
            elif cause.kind == "joint" and cause.name not in named:
                joints.append(cause)
        residual, zeros = _name(residual, joints, DIAGNOSIS.min_joint_pixels)
        found += zeros
        names = {(one[0].kind, one[0].name) for one in found}
        for cause in causes:
            if (key := (cause.kind, cause.name)) in self._asked and key not in names:
                found.append([whole.test(cause)])
        findings = list[Finding]()
        if found:
            # By how much they are off together, and the others that are free beside.
            own = [best for best, *_ in found]
            names = {(one.kind, one.name) for one in own}
            free = [
                one for one in freed if (zeros or self._asked) and (one.kind, one.name) not in names
            ]
            moves = np.hstack([one.moves for one in (*own, *free)])
            whole_test, first = whole.test(_Cause("", "", moves, np.ones(0), 0)), 0
            for best, *alternatives in found:
                k = slice(first, first + len(best.amount))
                first = k.stop
                better = best._replace(
                    amount=whole_test.amount[k], covariance=whole_test.covariance[k, k]
                )
                pixels = whole.info.pixels(best.moves @ better.amount)
                least = DIAGNOSIS.min_joint_pixels if best.kind == "joint" else DIAGNOSIS.min_pixels
                # Beside the others there may be nothing left of it.
                if pixels >= least or (best.kind, best.name) in self._asked:
                    findings.append(self._finding([better, *alternatives], pixels))
        named = [one[0].name for one in found]
        noticed = _minimum_detectable(residual, [one for one in joints if one.name not in named])
        return tuple(findings), center, noticed


def _name(
    residual: _Residual, causes: Sequence[_Cause], least: float
) -> tuple[_Residual, list[list[_Cause]]]:
    """What causes, one after the other, are off, and the residual without them.

    With each stand those that suffice in its place. least: how far they move outlines at least
    [pixel].
    """
    left, named = list(causes), list[list[_Cause]]()
    while left:
        # What is named is off by itself, and so are its rivals.
        tests = [
            one
            for one in map(residual.test, left)
            if one.p_value * len(left) <= DIAGNOSIS.significance
            and residual.info.pixels(one.x) >= least
        ]
        if not tests:
            break
        most = max(tests, key=lambda one: one.gain)
        named.append(residual.sufficient(tests, least) or [most])
        best = named[-1][0]
        residual = residual.without(best)
        left = [one for one in left if (one.kind, one.name) != (best.kind, best.name)]
    return residual, named


def _minimum_detectable(residual: _Residual, causes: Sequence[_Cause]) -> dict[str, float]:
    """How far joints must be off to be named 19 times of 20 [rad or m]; inf: never."""
    level = DIAGNOSIS.significance / max(1, len(causes))
    critical, found = fdtri(1, residual.info.freedom, 1.0 - level), {}
    for cause in causes:
        along = cause.moves[:, 0]
        sd = np.sqrt(max(float(along @ residual.Q @ along), 0.0))
        information = max(float(along @ residual.N @ along), 1e-9)
        amount = (np.sqrt(critical) + 1.645) * sd / information
        pixels = max(residual.info.pixels(along), 1e-9)
        is_told = information > DIAGNOSIS.min_information
        least = max(amount, DIAGNOSIS.min_joint_pixels / pixels) if is_told else np.inf
        found[cause.name] = float(least * cause.units[0])
    return found


def likeliest_inliers(
    explained: Mask,
    evaluate: Callable[[Mask], tuple[Array, Array]],
    usual_deviation: float = 0.4,
    *,
    outlier_cost: float = 3.0,
    max_iterations: int = 10,
) -> Mask:
    """(frames,) the frames that agree: the likeliest of the sets that some starts lead to.

    Args:
        explained: (frames,) those that may agree.
        judge: of a set the p-values (frames,) of all frames' residuals, and x (p,) that the set has
            in common.
        usual_deviation: standard deviation of x.
        outlier_cost: negative log-likelihood of each outlier.
        max_iterations: of each start; also the number of single frames that are starts.
    """
    best, least = explained & False, np.inf
    starts = [np.zeros(len(explained), bool), explained]
    order = np.flatnonzero(explained)
    count = min(len(order), max_iterations)
    for k in order[np.linspace(0, len(order) - 1, count).astype(int)]:
        starts.append(np.arange(len(explained)) == k)
    for kept in starts:
        for _ in range(max_iterations):
            p_values, x = evaluate(kept)
            now = explained & (p_values > DIAGNOSIS.significance)
            if (now == kept).all():
                break
            kept = now
        else:
            x = evaluate(kept)[1]
        off = x / usual_deviation
        unlikely = outlier_cost * np.count_nonzero(~kept) + 0.5 * float(off @ off)
        if unlikely < least:
            best, least = kept, unlikely
    return best


def explained_frames(
    ratios: Sequence[Mapping[str, float]], share_of_best: float = 0.75, least: float = 0.5
) -> Mask:
    """(frames,) whether something within reach explains all pictures of a frame.

    Args:
        ratios: of each frame the fitted inlier ratios by camera.
        share_of_best, least: of the best frames' ratio, and absolutely.
    """
    limits = {}
    for name in {name for one in ratios for name in one}:
        own = sorted(one[name] for one in ratios if name in one)
        best = float(np.mean(own[-max(2, len(own) // 4) :]))
        limits[name] = max(share_of_best * best, least)
    return np.array([all(ratio >= limits[name] for name, ratio in one.items()) for one in ratios])


def is_half_pixel(offset: Array, covariance: Array, near: float = 0.25) -> bool:
    """Whether principal points are off by half a pixel along both axes, and not by chance.

    Args:
        offset: (2,) by how much they are off, and covariance: (2, 2) [pixel].
        near: the largest difference from half a pixel [pixel].
    """
    half = np.copysign(0.5, offset.sum())
    T = float(offset @ np.linalg.solve(covariance, offset))
    return chdtrc(2, T) <= DIAGNOSIS.significance and bool(np.abs(offset - half).max() <= near)


def _statistic(r: Array, Q: Array, N: Array | None = None) -> tuple[float, int]:
    """r^T Q^-1 r in the directions with information, and how many these are."""
    known, turn = np.linalg.eigh(Q if N is None else N)
    turn = turn[:, known > DIAGNOSIS.min_information]
    if not turn.shape[1]:
        return 0.0, 0
    along = turn.T @ r
    return float(along @ np.linalg.solve(turn.T @ Q @ turn, along)), turn.shape[1]


def _p_value(T: float, rank: int, freedom: float) -> float:
    """How often a statistic is as large by chance."""
    return float(fdtrc(rank, freedom, max(T, 0.0) / rank)) if rank else 1.0
