"""Which frames, cameras or joints contradict the rest, where all of them are given.

Each frame, fitted by itself (``per_frame_fit``), gives N x = h for the error x of what is given,
with h's covariance Q by ``fit.covariance``. What all frames that agree are off alike is the
fault of a joint's zero, a camera or the base; a frame is at fault that is significantly off from
the others: r^T Q^-1 r, r = h - N x_common, follows Fisher's distribution where nothing is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc, fdtri

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.fit.covariance import (
    ComparedMask,
    Distances,
    ErrorSizes,
    distances_covariance,
    distances_in_masks,
    estimate_sizes,
)
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.registration.per_frame_fit import FrameFit, PerFrameFit
from drake_pose.registration.shared_fit import SHARED

BASE = "base"

# Sizes of errors are estimated from at most so many groups of so many frames.
_SIZE_GROUPS, _FRAMES_PER_GROUP = 5, 4
# Directions with less information than this, in units of the priors, are left out.
_LEAST_INFORMATION = 1.0
# A frame is explained whose inlier ratio is this share of the best frames', and at least this.
_SHARE_OF_BEST, _LEAST_INLIER_RATIO = 0.75, 0.5
# A cause suffices that leaves less than this share of the residual, or what would not be named.
_SUFFICIENT_SHARE = 0.25
# The log-likelihood that each outlying frame costs; what is given is usually off by this share of
# its deviation.
_OUTLIER_COST, _USUAL_DEVIATION = 3.0, 0.4
_MAX_ITERATIONS = 10
# A joint is named that is off by so many standard deviations.
_NAMED_DEVIATIONS = 3.0
# Without a frame to estimate it from, contours err by about a pixel.
_UNKNOWN_SIZES = ErrorSizes(1.0, 0.0, 1.0, 1.0, 1.0)
# A silhouette's width was put right to within this [pixel].
_WIDTH_SD = 2.0
# What is right is named by chance this often, and not where it moves outlines by less [pixel]; of
# joints in all frames that agree, whatever cameras are off by.
SIGNIFICANCE, _LEAST_PIXELS, LEAST_OF_JOINTS = 1e-4, 1.0, 0.3
# What is so many deviations more is named 19 times of 20.
_NEARLY = 1.645
# What is nearer to half a pixel than this is that [pixel].
_NEAR_HALF = 0.25
# Joints, or sliding ones and the base, may be off by so much in each frame by itself [rad; m].
_ANGLE_SD, _SHIFT_SD = np.radians(0.1), 0.001


@dataclass(frozen=True)
class Finding:
    """By how much something is off.

    Args:
        kind: "joint", "camera", "base", "focal", "center", "clock", "rate" of a clock, "joints"
            where several are off, or "unexplained" where nothing within reach explains a frame.
        name: of the joint, or the camera: "" where it is all of them.
        angle, shift: [rad, m]; of joints the largest; of focal lengths the shift is their share, of
            principal points [pixel], of a camera's clock by how much later its pictures'
            joints are in the log [s], of its rate how much faster the log's runs [s/s].
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


class HalfPixel(NamedTuple):
    """By how much principal points are off, half a pixel along x and y, and standard deviations."""

    offset: list[float]
    sd: list[float]


def _half_pixel(offset: Array, covariance: Array) -> HalfPixel | None:
    """What is off by half a pixel along both axes, and not by chance; None: nothing is.

    Args:
        offset: (2,) by how much principal points are off [pixel]; covariance: (2, 2).
    """
    half = np.copysign(0.5, offset.sum())
    T = float(offset @ np.linalg.solve(covariance, offset))
    if chdtrc(2, T) > SIGNIFICANCE or np.abs(offset - half).max() > _NEAR_HALF:
        return None
    return HalfPixel(offset.tolist(), np.sqrt(np.diag(covariance)).tolist())


@dataclass(frozen=True)
class Audit:
    """What contradicts the rest: of each frame; in all that agree; sizes of errors [pixel].

    ``center``: all principal points are off by half a pixel; None: they are not. ``noticed_from``:
    of each joint that is not named how far it must be off in all frames to be [rad or m].
    """

    frames: tuple[FrameAudit, ...]
    common: tuple[Finding, ...]
    sizes: ErrorSizes
    center: HalfPixel | None = None
    noticed_from: Mapping[str, float] = field(default_factory=dict)

    @property
    def contradicting(self) -> tuple[str, ...]:
        """The frames that contradict the others."""
        return tuple(one.frame for one in self.frames if one.finding is not None)


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

    @classmethod
    def none(cls, count: int, nodes: int) -> _Information:
        """That of no frame; so many values were free."""
        squares, surfaces = np.zeros((count, count)), np.zeros((count, 12 * nodes))
        outlines = np.zeros((nodes, count, count))
        return cls(squares, np.zeros(count), surfaces, outlines, np.zeros(nodes), 1.0, 0.0)

    def plus(self, info: _Information, sign: float = 1.0) -> _Information:
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
    rank: of causes that explain alike those of a lower one are likelier.
    """

    kind: str
    name: str
    moves: Array
    units: Array
    rank: float


class _CauseTest(NamedTuple):
    """Whether one cause is off: by how much, with covariance; with what chance; Akaike's gain."""

    cause: _Cause
    amount: Array
    covariance: Array
    p_value: float
    gain: float

    @property
    def x(self) -> Array:
        """(p,) what was free, off by this cause."""
        return np.asarray(self.cause.moves @ self.amount)


class _Residual(NamedTuple):
    """The residual r (p,) of N x = r, and its covariance Q."""

    info: _Information
    N: Array
    r: Array
    Q: Array

    def solved(self, r: Array) -> Array:
        """(p,) x of another r, zero where there is no information."""
        return np.asarray(np.linalg.solve(self.N + np.eye(len(r)), r))

    def pixels(self, without: Array | None = None) -> float:
        """How far outlines are off [pixel]; without x (p,)."""
        left = self.r if without is None else self.r - self.N @ without
        return self.info.pixels(self.solved(left))

    @property
    def p_value(self) -> float:
        """How often a residual is as large by chance."""
        return _p_value(*_statistic(self.r, self.Q, self.N), self.info.freedom)

    def test(self, cause: _Cause) -> _CauseTest:
        """Whether a cause is off."""
        M = cause.moves
        N, r, Q = M.T @ self.N @ M, M.T @ self.r, M.T @ self.Q @ M
        T, rank = _statistic(r, Q, N)
        inverse = np.linalg.inv(N + 1e-3 * np.eye(len(r)))
        p_value = _p_value(T, rank, self.info.freedom)
        # More numbers explain more by chance.
        return _CauseTest(cause, inverse @ r, inverse @ Q @ inverse, p_value, T - 2.0 * rank)

    def sufficient(self, tests: Sequence[_CauseTest], least: float) -> list[_CauseTest]:
        """Causes that leave little of what is off, likelier ones first; less than least [pixel]."""
        most = max(least, _SUFFICIENT_SHARE * self.pixels())
        enough = [one for one in tests if self.pixels(one.x) < most]
        return sorted(enough, key=lambda one: (one.cause.rank, -one.gain))

    def without(self, cause: _Cause) -> _Residual:
        """The residual once a cause was put right."""
        M, N = cause.moves, self.N
        gain = np.eye(len(N)) - N @ M @ np.linalg.pinv(M.T @ N @ M) @ M.T
        return _Residual(self.info, gain @ N @ gain.T, gain @ self.r, gain @ self.Q @ gain.T)


def audit_frames(fit: PerFrameFit, frames: Sequence[FrameFit]) -> Audit:
    """Finds what contradicts the rest in frames that were fitted, in time linear in them."""
    return _Auditor(fit, frames).audit()


class _Auditor:
    """An audit under way."""

    def __init__(self, fit: PerFrameFit, frames: Sequence[FrameFit]) -> None:
        self._fit, self._frames = fit, frames
        tolerance = np.where(fit.is_angle, _ANGLE_SD, _SHIFT_SD)
        self._tolerance = np.diag((tolerance / fit.deviations) ** 2)
        self._explained = _explained(frames)
        self._seen = dict[str, Distances]()
        self._nothing = _Information.none(len(fit.names), len(fit.outlines))

    def audit(self) -> Audit:
        """Does it."""
        # As long as nobody knows which frames agree, sizes of errors come from each by itself.
        agreeing, together = self._explained, 1
        for _ in range(2):
            sizes = self._pooled_sizes(np.flatnonzero(agreeing), together)
            self._info = [self._info_of(one, sizes) for one in self._frames]
            self._surface = sizes.surface
            # Contradicting frames no longer make errors seem large.
            agreeing, together = self._agreeing(), _FRAMES_PER_GROUP
        total = self._sum(agreeing)
        frames = tuple(
            self._audit_frame(k, total.plus(info, -1.0) if agreeing[k] else total)
            for k, info in enumerate(self._info)
        )
        kept = np.array([one.finding is None for one in frames])
        common, center, noticed_from = self._common_findings(kept) if kept.any() else ((), None, {})
        return Audit(frames, common, sizes, center, noticed_from)

    def _pooled_sizes(self, which: Indices, together: int) -> ErrorSizes:
        """How large errors are, by groups of some frames, spread over all of them."""
        if not len(which):
            return _UNKNOWN_SIZES
        groups = max(1, min(_SIZE_GROUPS, len(which) // together))
        count = min(len(which), groups * together)
        spread = which[np.linspace(0, len(which) - 1, count).round().astype(int)]
        sizes = []
        for k in range(groups):
            pictures = [one for i in spread[k::groups] for one in self._frames[i].pictures]
            seen = self._distances(pictures)
            is_angle = np.append(self._fit.is_angle, np.zeros(len(pictures), bool))
            sizes.append(estimate_sizes(seen, is_angle, least_camera=0.0)[:5])
        return ErrorSizes(*np.median(np.array(sizes), axis=0).tolist())

    def _distances(self, pictures: Sequence[ComparedMask]) -> Distances:
        """The distances in pictures; their values are what was free, then each picture's width."""
        outlines = self._fit.outlines
        return distances_in_masks(outlines, pictures, widths=True)

    def _info_of(self, fitted: FrameFit, sizes: ErrorSizes) -> _Information:
        if not fitted.pictures:
            known = float(SHARED.known_beforehand)
            return self._nothing._replace(lengths=fitted.weights, freedom=known)
        if fitted.name not in self._seen:
            self._seen[fitted.name] = self._distances(fitted.pictures)
        seen = self._seen[fitted.name]
        own, widths = np.split(seen.X, [len(self._fit.names)], axis=1)
        X = own * self._fit.deviations
        V = distances_covariance(seen, sizes) + _WIDTH_SD**2 * widths @ widths.T
        PX, Py = np.split(np.linalg.solve(V, np.column_stack([X, seen.y])), [-1], axis=1)
        N, h = X.T @ PX, PX.T @ seen.y
        T, rank = _statistic(h, N)
        residual = max(float(seen.y @ Py[:, 0]) - T, 0.0)
        freedom = float(SHARED.known_beforehand + len(seen.y) - rank)
        scale = max((SHARED.known_beforehand + residual) / freedom, 1.0)
        outlines = self._nothing.outlines.copy()
        for one in fitted.pictures:
            moves = one.moves * self._fit.deviations[:, None]
            outlines += moves @ one.A @ np.swapaxes(moves, 1, 2)
        return _Information(N, h, PX.T @ seen.bends, outlines, fitted.weights, scale, freedom)

    def _agreeing(self) -> Mask:
        """(frames,) the frames that agree: the likeliest of the sets that some starts lead to."""
        best, least = self._explained & False, np.inf
        starts = [np.zeros(len(self._info), bool), self._explained]
        order = np.flatnonzero(self._explained)
        count = min(len(order), _MAX_ITERATIONS)
        for k in order[np.linspace(0, len(order) - 1, count).astype(int)]:
            starts.append(np.arange(len(self._info)) == k)
        for kept in starts:
            for _ in range(_MAX_ITERATIONS):
                common = self._common(self._sum(kept))
                residuals = [self._residual(info, *common) for info in self._info]
                likely = [one.p_value > SIGNIFICANCE for one in residuals]
                now = self._explained & likely
                if (now == kept).all():
                    break
                kept = now
            off = self._common(self._sum(kept))[0] / _USUAL_DEVIATION
            unlikely = _OUTLIER_COST * np.count_nonzero(~kept) + 0.5 * float(off @ off)
            if unlikely < least:
                best, least = kept, unlikely
        return best

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

    def _audit_frame(self, k: int, others: _Information) -> FrameAudit:
        """A frame beside the others."""
        fitted = self._frames[k]
        residual = self._residual(self._info[k], *self._common(others))
        tests = [residual.test(cause) for cause in self._causes(fitted)]
        # Each of the tests may find something by chance.
        least = min(residual.p_value, *(one.p_value for one in tests)) * (1 + len(tests))
        finding, pixels = None, residual.pixels()
        if not self._explained[k]:
            finding = self._joints_finding("unexplained", residual)
        elif least <= SIGNIFICANCE and pixels >= _LEAST_PIXELS:
            sufficient = residual.sufficient(tests, _LEAST_PIXELS)
            finding = (
                self._finding(sufficient, residual.info.pixels(sufficient[0].x))
                if sufficient
                else self._joints_finding("joints", residual)
            )
        return FrameAudit(fitted.name, *fitted.inlier_ratios, pixels, finding)

    def _causes(self, fitted: FrameFit | None) -> list[_Cause]:
        """All that may be off by itself; of the cameras those that see a frame."""
        p, deviations = len(self._fit.names), self._fit.deviations
        joints, six = len(self._fit.joints), len(POSE_NAMES)
        eye = np.eye(p)
        causes = [
            _Cause("joint", name, eye[:, [k]], deviations[[k]], 1)
            for k, name in enumerate(self._fit.joints)
        ]
        for c, name in enumerate(self._fit.camera_names):
            if fitted is None or c in {one.camera for one in fitted.pictures}:
                own = slice(joints + c * six, joints + (c + 1) * six)
                causes.append(_Cause("camera", name, eye[:, own], deviations[own], six))
        if len(self._fit.camera_names) > 1:
            causes.append(_Cause(BASE, BASE, self._fit.base_moves(), np.ones(six), six))
        return causes if fitted is not None else causes + self._lens_causes()

    def _lens_causes(self) -> list[_Cause]:
        """Focal lengths and principal points that are off in all frames: of all cameras, of each.

        A single camera was rather moved than has its principal point elsewhere.
        """
        names, causes = self._fit.camera_names, []
        groups = [("", [*range(len(names))])] if len(names) > 1 else []
        groups += [(f" of camera '{name}'", [c]) for c, name in enumerate(names)]
        for where, group in groups:
            many, rank = ("", 6.5) if where else ("s", 2.0)
            focal, center = self._fit.focal_moves(group), self._fit.center_moves(group)
            if focal.any():
                text = f"focal length{many}{where}"
                causes.append(_Cause("focal", text, focal, np.ones(1), 1))
            text = f"principal point{many}{where}"
            causes.append(_Cause("center", text, center, np.ones(2), rank))
        return causes

    def _finding(self, sufficient: Sequence[_CauseTest], pixels: float) -> Finding:
        """The first of the causes that suffice, and its rivals."""
        best, *others = sufficient
        rivals = [one.cause.name for one in others]
        seen_by_one = len(self._fit.camera_names) == 1
        if seen_by_one and any(one.cause.kind == "camera" for one in sufficient):
            rivals.append(BASE)
        kind, name, _, units, _ = best.cause
        x, sd = best.amount * units, np.sqrt(np.diag(best.covariance)) * units
        # Poses turn and shift; a joint does one of them; the rest is shifts.
        turns = len(x) // 2 if kind in ("camera", BASE) else 0
        if kind == "joint":
            turns = int(self._fit.is_angle[self._fit.joints.index(name)])
        return Finding(
            kind, name, _size(x[:turns]), _size(x[turns:]), _size(sd[:turns]), _size(sd[turns:]),
            pixels, best.p_value, tuple(rivals),
        )  # fmt: skip

    def _joints_finding(self, kind: str, residual: _Residual) -> Finding:
        """What is off in a frame where no cause by itself explains it."""
        x, names = residual.solved(residual.r), self._fit.joints
        sd = np.sqrt(residual.info.scale * np.diag(np.linalg.inv(residual.N + np.eye(len(x)))))
        joints = (x * self._fit.deviations)[: len(names)]
        turns = self._fit.is_angle[: len(names)]
        angle = float(np.abs(joints[turns]).max(initial=0.0))
        shift = float(np.abs(joints[~turns]).max(initial=0.0))
        sure = np.flatnonzero((np.abs(x) > _NAMED_DEVIATIONS * sd)[: len(names)])
        named = {names[k]: float(joints[k]) for k in sure}
        off = (angle, shift, 0.0, 0.0)
        return Finding(kind, "", *off, residual.pixels(), residual.p_value, (), named)

    def _common_findings(
        self, kept: Mask
    ) -> tuple[tuple[Finding, ...], HalfPixel | None, dict[str, float]]:
        """What is off in all frames that agree, and what would be seen, as Audit has it."""
        info, count = self._sum(kept), np.count_nonzero(kept)
        Q = self._covariance(info) + info.N @ self._tolerance @ info.N / count
        residual = _Residual(info, info.N, info.h, Q)
        causes = self._causes(None)
        every = range(len(self._fit.camera_names))
        shifted = residual.test(_Cause("center", "", self._fit.center_moves(every), np.ones(2), 2))
        center = _half_pixel(shifted.amount, shifted.covariance)
        others = [residual.test(one).gain for one in causes if one.kind != "center"]
        if center and shifted.gain > max(others):
            residual = residual.without(shifted.cause)
        else:
            center = None
        whole, (residual, found) = residual, self._name(residual, causes, _LEAST_PIXELS)
        # A joint's zero moves little beside what calibrations are off by: these are free now.
        named, joints, freed = [one[0].cause.name for one in found], list[_Cause](), list[_Cause]()
        for cause in causes:
            if cause.kind == "camera":
                residual = residual.without(cause)
                freed.append(cause)
            elif cause.kind == "joint" and cause.name not in named:
                joints.append(cause)
        residual, zeros = self._name(residual, joints, LEAST_OF_JOINTS)
        named = [one[0].cause.name for one in zeros]
        joints = [one for one in joints if one.name not in named]
        findings = self._together(whole, [*found, *zeros], freed if zeros else [])
        return findings, center, self._noticed_from(residual, joints)

    def _name(
        self, residual: _Residual, causes: Sequence[_Cause], least: float
    ) -> tuple[_Residual, list[list[_CauseTest]]]:
        """What causes, one after the other, are off, and the residual without them.

        With each stand those that suffice in its place. least: how far they move outlines at least
        [pixel].
        """
        left, named = list(causes), list[list[_CauseTest]]()
        while left:
            # What is named is off by itself, and so are its rivals.
            tests = [
                one
                for one in map(residual.test, left)
                if one.p_value * len(left) <= SIGNIFICANCE and residual.info.pixels(one.x) >= least
            ]
            if not tests:
                break
            most = max(tests, key=lambda one: one.gain)
            named.append(residual.sufficient(tests, least) or [most])
            best = named[-1][0].cause
            residual = residual.without(best)
            left = [one for one in left if one is not best]
        return residual, named

    def _together(
        self, residual: _Residual, named: Sequence[list[_CauseTest]], freed: Sequence[_Cause]
    ) -> tuple[Finding, ...]:
        """Findings of causes, by how much they are off together; others that are free beside."""
        if not named:
            return ()
        own = [best.cause for best, *_ in named]
        names = {(one.kind, one.name) for one in own}
        others = [one for one in freed if (one.kind, one.name) not in names]
        moves = np.hstack([one.moves for one in (*own, *others)])
        found = residual.test(_Cause("", "", moves, np.ones(0), 0))
        findings, first = [], 0
        for best, *rivals in named:
            k = slice(first, first + len(best.amount))
            first = k.stop
            better = best._replace(amount=found.amount[k], covariance=found.covariance[k, k])
            findings.append(self._finding([better, *rivals], residual.info.pixels(better.x)))
        return tuple(findings)

    def _noticed_from(self, residual: _Residual, causes: Sequence[_Cause]) -> dict[str, float]:
        """How far joints must be off to be named nearly always [rad or m]; inf: never."""
        critical = fdtri(1, residual.info.freedom, 1.0 - SIGNIFICANCE / max(1, len(causes)))
        found = {}
        for cause in causes:
            along = cause.moves[:, 0]
            sd = np.sqrt(max(float(along @ residual.Q @ along), 0.0))
            information = max(float(along @ residual.N @ along), 1e-9)
            amount = (np.sqrt(critical) + _NEARLY) * sd / information
            pixels = max(residual.info.pixels(along), 1e-9)
            is_told = information > _LEAST_INFORMATION
            least = max(amount, LEAST_OF_JOINTS / pixels) if is_told else np.inf
            found[cause.name] = float(least * cause.units[0])
        return found


def _size(part: Array) -> float:
    """A single number with its sign, or the norm of several."""
    return float(part[0]) if len(part) == 1 else float(np.linalg.norm(part))


def _statistic(r: Array, Q: Array, N: Array | None = None) -> tuple[float, int]:
    """r^T Q^-1 r in the directions with information, and how many these are."""
    known, turn = np.linalg.eigh(Q if N is None else N)
    turn = turn[:, known > _LEAST_INFORMATION]
    if not turn.shape[1]:
        return 0.0, 0
    along = turn.T @ r
    return float(along @ np.linalg.solve(turn.T @ Q @ turn, along)), turn.shape[1]


def _p_value(T: float, rank: int, freedom: float) -> float:
    """How often a statistic is as large by chance."""
    return float(fdtrc(rank, freedom, max(T, 0.0) / rank)) if rank else 1.0


def _explained(frames: Sequence[FrameFit]) -> Mask:
    """(frames,) whether something within reach explains all its pictures."""
    fitted = [one.inlier_ratios[1] for one in frames]
    least = {}
    for name in {name for one in fitted for name in one}:
        ratios = sorted(one[name] for one in fitted if name in one)
        best = float(np.mean(ratios[-max(2, len(ratios) // 4) :]))
        least[name] = max(_SHARE_OF_BEST * best, _LEAST_INLIER_RATIO)
    return np.array([all(ratio >= least[name] for name, ratio in one.items()) for one in fitted])
