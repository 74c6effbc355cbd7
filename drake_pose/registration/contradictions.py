"""Which frames, cameras or joints contradict the rest, where all of them are given.

Each frame, fitted by itself (``per_frame_fit``), tells N x = h of by how much x what is given is
off, with h's covariance Q by ``fit.covariance``. What all frames that agree are off alike is the
fault of a joint's zero, a camera or the base; a frame is at fault that is significantly off from
the others: r^T Q^-1 r, r = h - N x_common, follows Fisher's distribution where nothing is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from drake_pose.fit.covariance import (
    Distances,
    ErrorSizes,
    Picture,
    distances_covariance,
    distances_in_pictures,
    estimate_sizes,
    with_widths,
)
from drake_pose.registration.per_frame_fit import FrameFit, PerFrameFit
from drake_pose.registration.shared_fit import KNOWN_BEFOREHAND, POSE_NAMES

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BASE = "base"

# How large errors are is told by at most so many groups of so many frames.
_GROUPS, _IN_GROUP = 5, 4
# What is known to less than this share of how far it may be off is not asked for.
_TOLD = 1.0
# Contours of a frame fit that fit as well as this share of what fits in the best frames.
_FITS, _FITS_AT_ALL = 0.75, 0.5
# A cause explains what is off that leaves less than this share of it, or what would not be named.
_EXPLAINED = 0.25
# A frame that is wrong is as unlikely as this logarithm says, and what is given is usually off by
# this share of how far it may be off.
_WRONG, _USUAL = 3.0, 0.4
_ROUNDS = 10
# A joint is named that is off by so many standard deviations.
_SURE = 3.0
# Where no frame tells it, contours err by about a pixel.
_UNKNOWN_SIZES = ErrorSizes(1.0, 0.0, 1.0, 1.0, 1.0)
# A silhouette's width was put right to within this [pixel].
_WIDTH = 2.0


# What is right is named by chance this often, and not where it moves outlines by less [pixel].
_SIGNIFICANCE, _LEAST_PIXELS = 1e-4, 1.0
# Joints, or sliding ones and the base, may be off by so much in each frame by itself [rad; m].
_ANGLE_SD, _SHIFT_SD = np.radians(0.1), 0.001


class Cause(NamedTuple):
    """What may be off: a "joint", a "camera" or the "base", and its name.

    moves: (p, d) how what was free to move follows it: a joint's position [rad or m], or a rotation
    vector [rad] and a shift [m] of a camera along its axes, or of the base in the world.
    """

    kind: str
    name: str
    moves: Array


@dataclass(frozen=True)
class Finding:
    """By how much something is off.

    Args:
        kind: "joint", "camera", "base", "joints" where several are off, or "unexplained" where
            nothing within reach explains a frame.
        name: of the joint or the camera; else "".
        angle, shift: [rad, m]; of joints the largest.
        angle_sd, shift_sd: their standard deviations.
        pixels: how far it moves the outlines of the parts that it moves, root mean square.
        p_value: how often nothing would seem so much off by chance.
        rivals: names of what explains it as well.
        joints: by how much joints are off where several are [rad or m].
    """

    kind: str
    name: str
    angle: float
    shift: float
    angle_sd: float
    shift_sd: float
    pixels: float
    p_value: float
    rivals: tuple[str, ...] = ()
    joints: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class FrameAudit:
    """What was found of one frame.

    Args:
        given, fitted: by camera, the inlier ratio with everything as given, and once fitted.
        pixels: how far the outlines are off from what all frames have in common.
        finding: what contradicts the other frames; None: it agrees.
    """

    frame: str
    given: Mapping[str, float]
    fitted: Mapping[str, float]
    pixels: float
    finding: Finding | None


@dataclass(frozen=True)
class Audit:
    """What contradicts the rest: of each frame; in all that agree; sizes of errors [pixel]."""

    frames: tuple[FrameAudit, ...]
    common: tuple[Finding, ...]
    sizes: ErrorSizes

    @property
    def contradicting(self) -> tuple[str, ...]:
        """The frames that contradict the others."""
        return tuple(one.frame for one in self.frames if one.finding is not None)


class FrameInformation(NamedTuple):
    """What a frame tells of what was free, in units of its deviations: x^T N x - 2 h^T x.

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


class _Sum(NamedTuple):
    """Sums over frames of N, h and of_surface, each by the scale of the frame's errors."""

    frames: int
    N: Array
    h: Array
    of_surface: Array

    def with_frame(self, told: FrameInformation, sign: float) -> _Sum:
        """With another frame, or without one of them: sign -1."""
        weight = sign / told.scale
        return _Sum(
            self.frames + int(sign),
            self.N + weight * told.N,
            self.h + weight * told.h,
            self.of_surface + weight * told.of_surface,
        )


class FrameDeviation(NamedTuple):
    """By how much a frame is off from the others, in units of the deviations.

    r: (p,) its h without what is common, and Q: (p, p) the covariance of that; x: (p,) by how much
    what was free is off, as far as that is told, and covariance: (p, p).
    """

    r: Array
    Q: Array
    x: Array
    covariance: Array


class _Common(NamedTuple):
    """What frames have in common: x (p,), its covariance, and the sums it is from."""

    x: Array
    covariance: Array
    N: Array
    h: Array
    Q: Array


def audit_frames(fit: PerFrameFit, frames: Sequence[FrameFit]) -> Audit:
    """Finds what contradicts the rest in frames that were fitted, in time linear in them."""
    return _Auditor(fit, frames).audit()


class _Auditor:
    """An audit under way."""

    def __init__(self, fit: PerFrameFit, frames: Sequence[FrameFit]) -> None:
        self._fit, self._frames = fit, frames
        self._joints = len(fit.joints)
        self._is_angle = fit.is_angle
        tolerance = np.where(self._is_angle, _ANGLE_SD, _SHIFT_SD)
        self._tolerance = np.diag((tolerance / fit.deviations) ** 2)
        self._explained = _explained(frames)

    def audit(self) -> Audit:
        """Does it."""
        # As long as nobody knows which frames agree, each one by itself tells how large errors are.
        sizes = self._pooled_sizes(np.flatnonzero(self._explained), 1)
        self._told = [self._tell(one, sizes) for one in self._frames]
        self._surface = sizes.surface
        agreeing = self._agreeing()
        # Contradicting frames no longer make errors seem large.
        sizes = self._pooled_sizes(np.flatnonzero(agreeing), _IN_GROUP)
        self._told = [self._tell(one, sizes) for one in self._frames]
        self._surface = sizes.surface
        agreeing = self._agreeing()
        total = self._sum(agreeing)
        frames = tuple(
            self._audit_frame(k, total.with_frame(told, -1.0) if agreeing[k] else total)
            for k, told in enumerate(self._told)
        )
        kept = np.array([one.finding is None for one in frames])
        return Audit(frames, self._common_findings(kept), sizes)

    def _pooled_sizes(self, which: NDArray[np.intp], together: int) -> ErrorSizes:
        """How large errors are, by groups of some frames, spread over all of them."""
        if not len(which):
            return _UNKNOWN_SIZES
        groups = max(1, min(_GROUPS, len(which) // together))
        count = min(len(which), groups * together)
        spread = which[np.linspace(0, len(which) - 1, count).round().astype(int)]
        sizes = []
        for k in range(groups):
            pictures = [one for i in spread[k::groups] for one in self._frames[i].pictures]
            seen = self._distances(pictures)
            is_angle = np.append(self._is_angle, np.zeros(len(pictures), bool))
            sizes.append(estimate_sizes(seen, is_angle, least_camera=0.0))
        return ErrorSizes(*np.median(np.array(sizes), axis=0).tolist())

    def _distances(self, pictures: Sequence[Picture]) -> Distances:
        """The distances in pictures; their values are what was free, then each picture's width."""
        outlines = self._fit.outlines
        return distances_in_pictures(outlines, with_widths(outlines, pictures))

    def _tell(self, fitted: FrameFit, sizes: ErrorSizes) -> FrameInformation:
        seen = self._distances(fitted.pictures)
        own, widths = np.split(seen.X, [len(self._fit.names)], axis=1)
        X = own * self._fit.deviations
        V = distances_covariance(seen, sizes) + _WIDTH**2 * widths @ widths.T
        PX, Py = np.split(np.linalg.solve(V, np.column_stack([X, seen.y])), [-1], axis=1)
        N, h = X.T @ PX, PX.T @ seen.y
        T, rank = _statistic(h, N)
        left = max(float(seen.y @ Py[:, 0]) - T, 0.0)
        freedom = KNOWN_BEFOREHAND + len(seen.y) - rank
        scale = (KNOWN_BEFOREHAND + left) / freedom
        moves = [one.moves * self._fit.deviations[:, None] for one in fitted.pictures]
        outlines = sum(
            m @ one.A @ np.swapaxes(m, 1, 2) for m, one in zip(moves, fitted.pictures, strict=True)
        )
        return FrameInformation(
            N, h, PX.T @ seen.bends, np.asarray(outlines), fitted.weights, max(scale, 1.0),
            float(freedom),
        )  # fmt: skip

    def _agreeing(self) -> Mask:
        """(frames,) the frames that agree: the likeliest of the sets that some starts lead to."""
        best, least = self._explained & False, np.inf
        starts = [np.zeros(len(self._told), bool), self._explained]
        order = np.flatnonzero(self._explained)
        for k in order[np.linspace(0, len(order) - 1, min(len(order), _ROUNDS)).astype(int)]:
            starts.append(np.arange(len(self._told)) == k)
        for kept in starts:
            for _ in range(_ROUNDS):
                common = self._common(self._sum(kept))
                now = self._explained & [
                    self._p_value_of(told, common) > _SIGNIFICANCE for told in self._told
                ]
                if (now == kept).all():
                    break
                kept = now
            off = self._common(self._sum(kept)).x / _USUAL
            unlikely = _WRONG * np.count_nonzero(~kept) + 0.5 * float(off @ off)
            if unlikely < least:
                best, least = kept, unlikely
        return best

    def _sum(self, kept: Mask) -> _Sum:
        """What some frames tell together."""
        first = self._told[0]
        total = _Sum(0, *(np.zeros_like(one) for one in (first.N, first.h, first.of_surface)))
        for k in np.flatnonzero(kept):
            total = total.with_frame(self._told[k], 1.0)
        return total

    def _common(self, total: _Sum) -> _Common:
        """What some frames have in common; without any, that nothing is off."""
        p = len(total.h)
        Q = total.N + self._surface**2 * total.of_surface @ total.of_surface.T
        # Without other frames what is given is right to within a tolerance.
        prior = np.eye(p) if total.frames else np.linalg.inv(self._tolerance)
        inverse = np.linalg.inv(total.N + prior)
        covariance = inverse @ (Q + prior) @ inverse
        return _Common(inverse @ total.h, covariance, total.N, total.h, Q)

    def _left(self, told: FrameInformation, common: _Common) -> tuple[Array, Array]:
        """A frame's h without what is common, and its covariance."""
        Q = told.scale * told.N + told.N @ (common.covariance + self._tolerance) @ told.N
        return told.h - told.N @ common.x, Q

    def _p_value_of(self, told: FrameInformation, common: _Common) -> float:
        return _p_value(*_statistic(*self._left(told, common), told.N), told.freedom)

    def _audit_frame(self, k: int, others: _Sum) -> FrameAudit:
        told, fitted = self._told[k], self._frames[k]
        r, Q = self._left(told, self._common(others))
        spread = told.scale * np.linalg.inv(told.N + np.eye(len(r)))
        off = FrameDeviation(r, Q, np.asarray(spread @ r / told.scale), np.asarray(spread))
        finding = self._frame_finding(told, off, self._causes(fitted), bool(self._explained[k]))
        return FrameAudit(fitted.name, *fitted.inlier_ratios, _pixels([told], off.x), finding)

    def _frame_finding(
        self, told: FrameInformation, off: FrameDeviation, causes: Sequence[Cause], explained: bool
    ) -> Finding | None:
        """What contradicts the other frames in one of them."""
        T, rank = _statistic(off.r, off.Q, told.N)
        p_value = _p_value(T, rank, told.freedom)
        pixels = _pixels([told], off.x)
        if not explained:
            return self._joints_finding("unexplained", off, p_value, pixels)
        tests = [_Test.of(cause, off.r, told.N, off.Q, told.freedom) for cause in causes]
        # Each of the tests may find something by chance.
        least = min(p_value, *(one.p_value for one in tests)) * (1 + len(tests))
        if least > _SIGNIFICANCE or pixels < _LEAST_PIXELS:
            return None
        sufficing = self._sufficing(tests, [told], off.r, told.N)
        if not sufficing:
            return self._joints_finding("joints", off, p_value, pixels)
        best, *rivals = sufficing
        return self._finding(best, rivals, _pixels([told], best.x))

    def _sufficing(
        self, tests: Sequence[_Test], told: Sequence[FrameInformation], r: Array, N: Array
    ) -> list[_Test]:
        """Causes that leave little of what is off, r, those of fewer numbers first."""
        solve = np.linalg.inv(N + np.eye(len(r)))
        most = max(_LEAST_PIXELS, _EXPLAINED * _pixels(told, solve @ r))
        left = [one for one in tests if _pixels(told, solve @ (r - N @ one.x)) < most]
        return sorted(left, key=lambda one: (one.cause.moves.shape[1], -one.aic_gain))

    def _causes(self, fitted: FrameFit | None) -> list[Cause]:
        """All that may be off by itself; of the cameras those that see a frame."""
        eye = np.eye(len(self._fit.names))
        causes = [Cause("joint", name, eye[:, [k]]) for k, name in enumerate(self._fit.joints)]
        names = self._fit.camera_names
        for c, name in enumerate(names):
            if fitted is None or c in {one.camera for one in fitted.pictures}:
                first = self._joints + c * len(POSE_NAMES)
                causes.append(Cause("camera", name, eye[:, first : first + len(POSE_NAMES)]))
        if len(names) > 1:
            causes.append(Cause(BASE, BASE, self._fit.base_moves()))
        return causes

    def _finding(self, best: _Test, others: Sequence[_Test], pixels: float) -> Finding:
        rivals = [one.cause.name for one in others]
        if (
            any(one.cause.kind == "camera" for one in (best, *others))
            and len(self._fit.camera_names) == 1
        ):
            rivals.append(BASE)
        x = best.amount * best.units(self._fit.deviations)
        sd = np.sqrt(np.diag(best.covariance)) * best.units(self._fit.deviations)
        if best.cause.kind == "joint":
            turns = bool(self._is_angle[self._fit.joints.index(best.cause.name)])
            off = (float(x[0]), 0.0, float(sd[0]), 0.0)
            if not turns:
                off = (0.0, off[0], 0.0, off[2])
        else:
            off = (
                float(np.linalg.norm(x[:3])), float(np.linalg.norm(x[3:])),
                float(np.linalg.norm(sd[:3])), float(np.linalg.norm(sd[3:])),
            )  # fmt: skip
        return Finding(best.cause.kind, best.cause.name, *off, pixels, best.p_value, tuple(rivals))

    def _joints_finding(
        self, kind: str, off: FrameDeviation, p_value: float, pixels: float
    ) -> Finding:
        """What is off in a frame where no cause by itself explains it."""
        joints = (off.x * self._fit.deviations)[: self._joints]
        turns = self._is_angle[: self._joints]
        angle = float(np.abs(joints[turns]).max(initial=0.0))
        shift = float(np.abs(joints[~turns]).max(initial=0.0))
        sure = np.abs(off.x) > _SURE * np.sqrt(np.diag(off.covariance))
        named = {
            name: float(one)
            for name, one, is_sure in zip(self._fit.joints, joints, sure, strict=False)
            if is_sure
        }
        return Finding(kind, "", angle, shift, 0.0, 0.0, pixels, p_value, (), named)

    def _common_findings(self, kept: Mask) -> tuple[Finding, ...]:
        """What is off in all frames that agree."""
        if not kept.any():
            return ()
        told = [self._told[k] for k in np.flatnonzero(kept)]
        common = self._common(self._sum(kept))
        freedom = float(sum(one.freedom for one in told))
        findings: list[Finding] = []
        causes = self._causes(None)
        r, N, Q = common.h, common.N, common.Q + common.N @ self._tolerance @ common.N / len(told)
        while causes:
            tests = [_Test.of(cause, r, N, Q, freedom) for cause in causes]
            sufficing = self._sufficing(tests, told, r, N)
            best, *rivals = sufficing or [max(tests, key=lambda one: one.aic_gain)]
            pixels = _pixels(told, best.x)
            if best.p_value * len(tests) > _SIGNIFICANCE or pixels < _LEAST_PIXELS:
                break
            findings.append(self._finding(best, rivals, pixels))
            # What is left once that was put right.
            M = best.cause.moves
            gain = np.eye(len(r)) - N @ M @ np.linalg.pinv(M.T @ N @ M) @ M.T
            r, Q, N = gain @ r, gain @ Q @ gain.T, gain @ N @ gain.T
            causes = [one for one in causes if one is not best.cause]
        return tuple(findings)


class _Test(NamedTuple):
    """Whether one cause is off: its statistic, rank and chance; by how much, with covariance."""

    cause: Cause
    T: float
    rank: int
    p_value: float
    amount: Array
    covariance: Array

    @classmethod
    def of(cls, cause: Cause, r: Array, N: Array, Q: Array, freedom: float) -> _Test:
        M = cause.moves
        T, rank = _statistic(M.T @ r, M.T @ Q @ M, M.T @ N @ M)
        inverse = np.linalg.inv(M.T @ N @ M + 1e-3 * np.eye(M.shape[1]))
        amount = inverse @ M.T @ r
        return cls(
            cause, T, rank, _p_value(T, rank, freedom), amount, inverse @ M.T @ Q @ M @ inverse
        )

    @property
    def aic_gain(self) -> float:
        """How well the cause explains what is off; more numbers explain more by chance."""
        return self.T - 2.0 * self.rank

    @property
    def x(self) -> Array:
        """(p,) what was free, off by this cause."""
        return np.asarray(self.cause.moves @ self.amount)

    def units(self, deviations: Array) -> Array:
        """(d,) the units of the amount [rad or m]."""
        if self.cause.kind == BASE:
            return np.ones(self.cause.moves.shape[1])
        return np.asarray(np.abs(self.cause.moves).T @ deviations)


def _statistic(r: Array, Q: Array, N: Array | None = None) -> tuple[float, int]:
    """r^T Q^-1 r in the directions that are told, and how many these are."""
    known, turn = np.linalg.eigh(Q if N is None else N)
    turn = turn[:, known > _TOLD]
    if not turn.shape[1]:
        return 0.0, 0
    along = turn.T @ r
    return float(along @ np.linalg.solve(turn.T @ Q @ turn, along)), turn.shape[1]


def _p_value(T: float, rank: int, freedom: float) -> float:
    """How often a statistic is as large by chance."""
    return float(fisher.sf(T / rank, rank, freedom)) if rank else 1.0


def _pixels(told: Sequence[FrameInformation], x: Array) -> float:
    """How far x moves the outlines of the parts that it moves, root mean square [pixel]."""
    squares = np.sum([np.einsum("p,npq,q->n", x, one.outlines, x) for one in told], axis=0)
    lengths = np.sum([one.lengths for one in told], axis=0)
    moved = squares > 1e-6 * squares.max(initial=0.0)
    return float(np.sqrt(squares[moved].sum() / max(lengths[moved].sum(), 1e-9)))


def _explained(frames: Sequence[FrameFit]) -> Mask:
    """(frames,) whether something within reach explains all its pictures."""
    best = {}
    for name in {name for one in frames for name in one.inlier_ratios[1]}:
        ratios = [one.inlier_ratios[1][name] for one in frames if name in one.inlier_ratios[1]]
        best[name] = float(np.mean(sorted(ratios)[-max(2, len(ratios) // 4) :]))
    least = {name: max(_FITS * ratio, _FITS_AT_ALL) for name, ratio in best.items()}
    return np.array(
        [all(ratio >= least[n] for n, ratio in one.inlier_ratios[1].items()) for one in frames]
    )
