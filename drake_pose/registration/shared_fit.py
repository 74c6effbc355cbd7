"""Cameras, and what all frames share beside them, fitted together with the masks' widths.

A mask that is too wide on all sides makes its body seem nearer. Each mask's width is unknown, too:
thin links and their distances from one another tell the two apart.

How sure what is shared is: contours do not err point by point. There are the noise of points, the
surface of a part in all frames alike, its edge in one mask, and each frame as a whole
(``fit.covariance``). How large these are is told by what is left of the distances at the scale of
the fit; frames' pulls scatter as these say, or by a factor more. What is off alike in all frames
and is not fitted, zeros, lengths and lenses, moves what is fitted: its size is told so, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body.model import OBJECT_POSITIONS
from drake_pose.body.tree.tree_kinematics import JointOffset
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.contour_fit import Noise
from drake_pose.fit.covariance import (
    Distances,
    ErrorSizes,
    distances_covariance,
    distances_in_masks,
    doubted_covariance,
    estimate_sizes,
    values_covariance,
)
from drake_pose.fit.evidence import FrameEvidence
from drake_pose.fit.frames_fit import FramesFit, parameter_names
from drake_pose.fit.lengthened_body import LengthenedBody, length_name, lengthened_joints
from drake_pose.fit.levenberg_marquardt import AnnealingStage, Equations, StepSettings
from drake_pose.fit.parameters import CAMERA_NAMES, POSE_NAMES
from drake_pose.fit.unknowns import choose, join
from drake_pose.registration.posed_frames import PosedFrames
from drake_pose.workers import map_ordered

ROUNDS_WITH_CONSTANTS = (
    *(AnnealingStage(scale, 0.02) for scale in (0.12, 0.09, 0.07, 0.05, 0.03, 0.02)),
    AnnealingStage(0.01, 0.01),
    # Again and again, for what hardly shows, such as a zero that turns with the camera, gains so
    # little in a step that a round ends before it is there.
    *(AnnealingStage(0.005, 0.005, 6) for _ in range(5)),
)
"""Parts of a fit that has constants to find beside cameras."""

TOLD_APART = AnnealingStage(0.025, 0.01)
"""At this scale frames are told apart that agree and that contradict."""

CONSTANT_DEVIATION, FOCAL_DEVIATION = 0.2, 0.1
"""What is known beforehand of zeros [rad or m] and the logarithms of lengths, and of the logarithms
of focal lengths: deviations."""

KNOWN_BEFOREHAND = 20
"""The scale of frames' errors is known beforehand as well as so many distances tell it."""

STEPS = StepSettings(longest=0.3, damping=1e-2, even_damping=1e-6)

# And of where an object stands, once it was found [m, rad].
_OBJECT_DEVIATION = 1.0
# A frame agrees whose inlier ratio is this share of that of the two that fit best.
_AGREES = 0.7
# Masks are wider or narrower by no more [pixel].
_WIDEST = 6.0
# At this scale cameras were fitted in the end.
_FITTED = AnnealingStage(0.005, 0.005)
# Sizes of errors are known beforehand to a factor of twenty; frames tell them.
PRIOR_DEVIATION = 3.0
# What a picture tells of a direction is nothing below this share of what it tells best.
_TOLD = 1e-3
# What may be off, and is not fitted: groups, and units [rad, m, 1, 1, share of the focal length].
_ZEROS, _LENGTHS, _LENSES = "zeros", "lengths", "lenses"
_ZERO, _SLID, _LENGTH, _FOCAL, _CENTER = np.radians(0.5), 0.002, 0.01, 0.01, 0.005
# What is known of anything at least, that equations can be solved.
_LEAST = 1e-9
# Where parts err by so much [pixel], a calibration is no better than this [pixel].
_PARTS_ERR, _NO_BETTER = 0.2, 1.0


def agreeing_share(ratios: Array) -> float:
    """The least inlier ratio of a mask that agrees with the others of its camera, (n,) ratios."""
    return float(_AGREES * np.sort(ratios)[-2:].mean())


class Shared(NamedTuple):
    """What was found.

    shared: (u,) by the names of a fit; widths: (rows,) of masks [pixel], 0 where they do not count.
    """

    shared: Array
    widths: Array


class SharedFit:
    """Fits what the frames of several cameras share.

    Attributes:
        seen: what each camera sees.
        rows: (rows,) the how manieth camera each mask is of, one camera's after another's.
        names: of the u shared unknowns: those of each camera, then the constants.
        per_camera: so many of them each camera has.
        constants: names of the body's parameters to which an unknown constant is added in all
            frames: values of the pose tree, and lengths.

    Args:
        X_CW: (4, 4) for each camera, where a fit begins.
        offsets: joints whose places on their links are unknown.
        looks: so many of CAMERA_NAMES are unknown of each camera, its pose among them.
        widths: whether the masks' are.
    """

    def __init__(
        self,
        seen: Sequence[PosedFrames],
        X_CW: Sequence[Array],
        constants: Sequence[str] = (),
        *,
        offsets: Sequence[JointOffset] = (),
        looks: int = len(POSE_NAMES),
        widths: bool = True,
    ) -> None:
        self.seen, self.constants, self._X_CW = tuple(seen), tuple(constants), tuple(X_CW)
        self._options: dict[str, Any] = {"offsets": offsets, "looks": looks, "widths": widths}
        first, body = seen[0], seen[0].body
        if offsets:
            body = LengthenedBody(first.kinematics, first.outlines, offsets)
        self.rows = np.repeat(np.arange(len(seen)), [len(one.frames) for one in seen])
        self._values = np.array([frame.values for one in seen for frame in one.frames])
        each = [one.evidence(c, len(seen)) for c, one in enumerate(seen)]
        self._evidence = [evidence for own in each for evidence in own]
        cameras = [
            one.camera.with_pose(np.linalg.inv(X)) for one, X in zip(seen, X_CW, strict=True)
        ]
        self.per_camera = looks
        names = [f"{camera.name}.{name}" for camera in cameras for name in CAMERA_NAMES[:looks]]
        self.names = (*names, *constants)
        deviations = {one: CONSTANT_DEVIATION for one in constants}
        deviations |= dict.fromkeys(OBJECT_POSITIONS, _OBJECT_DEVIATION)
        deviations |= {f"{one.name}.{CAMERA_NAMES[6]}": FOCAL_DEVIATION for one in cameras}
        known = np.array([deviations.get(name, np.inf) for name in self.names])
        every = parameter_names(body, cameras)
        unknowns = choose(every, self.names, shared=True, deviation=known)
        if widths:
            own = choose(every, every[-len(cameras) :], lower=-_WIDEST, upper=_WIDEST)
            unknowns = join(own, unknowns)
        sizes = np.array([one.size for one in seen])
        self._fit = FramesFit(
            body, cameras, unknowns, pivot=np.array([one.middle for one in seen]),
            noise=Noise.of_a_pixel(sizes), steps=STEPS, pixels=sizes,
        )  # fmt: skip

    @property
    def start(self) -> Shared:
        """All as it is given."""
        return Shared(np.zeros(len(self.names)), np.zeros(len(self.rows)))

    def fit(
        self,
        rounds: Sequence[AnnealingStage],
        start: Shared | None = None,
        which: Mask | None = None,
    ) -> Shared:
        """Fits all from where it starts to those of the masks (rows,) that count."""
        given, expected, which = self._at(start or self.start, which)
        found = self._fit.fit(*given, rounds, expected=expected)
        widths = np.zeros(len(self.rows))
        widths[which] = found.own.sum(axis=1)
        return Shared(found.shared, widths)

    def from_found(self, found: Shared) -> tuple[SharedFit, Shared]:
        """The same fit, whose cameras' unknowns count from where they were found."""
        X_CW = [camera.X_CW for camera in self.cameras(found)]
        count = self.per_camera * len(X_CW)
        shared = found.shared.copy()
        shared[:count].reshape(len(X_CW), -1)[:, : len(POSE_NAMES)] = 0.0
        fit = SharedFit(self.seen, X_CW, self.constants, **self._options)
        return fit, Shared(shared, found.widths)

    def equations(self, at: Shared, step: AnnealingStage, which: Mask | None = None) -> Equations:
        """The normal equations of the masks (rows,) that count, own unknowns first."""
        given, expected, _ = self._at(at, which)
        return self._fit.equations(*given, step, expected)

    def bend(
        self, found: Shared, by: Array, step: AnnealingStage, which: Mask | None = None
    ) -> tuple[float, float]:
        """How much the cost bends upwards as what is shared moves by (u,), by slopes and by H."""
        p = self._fit.unknowns.own_count
        less, here, more = (
            self.equations(Shared(found.shared + sign * by, found.widths), step, which)
            for sign in (-1.0, 0.0, 1.0)
        )
        known = float(self._fit.unknowns.information[p:] @ by**2)
        slopes = (more.g - less.g).sum(axis=0)[p:]
        said = float(by @ here.H.sum(axis=0)[p:, p:] @ by)
        return 0.5 * float(by @ slopes) - known, said - known

    def inlier_ratios(self, found: Shared) -> Array:
        """(rows,) of both contours' lengths, what fits."""

        def ratio(mask: tuple[FrameEvidence, Array]) -> float:
            return self._fit.compare(*mask, TOLD_APART)[0].inlier_ratio

        masks = zip(self._evidence, self._parameters(found), strict=True)
        return np.array(map_ordered(ratio, masks))

    def agreeing(self, ratios: Array) -> Mask:
        """(rows,) which masks fit nearly as well as the two of their camera that fit best."""
        own = [ratios[self.rows == c] for c in range(len(self.seen))]
        return np.concatenate([one >= agreeing_share(one) for one in own])

    def piece_costs(self, found: Shared, side: float) -> Array:
        """(rows, k, k) costs by squares of the pictures of a side [pixel]."""

        def costs(mask: tuple[FrameEvidence, Array, int]) -> Array:
            return self._fit.piece_costs(*mask[:2], TOLD_APART, side)[mask[2]]

        masks = zip(self._evidence, self._parameters(found), self.rows.tolist(), strict=True)
        return np.array(map_ordered(costs, masks))

    def cameras(self, found: Shared) -> list[PinholeCamera]:
        """The cameras as they were found."""
        X_CW, kernel, _ = self._fit.places(self._parameters(found)[0])
        return [
            replace(one.camera, X_WC=np.linalg.inv(X), focal_x=float(k[1]), focal_y=float(k[2]))
            for one, X, k in zip(self.seen, X_CW, kernel, strict=True)
        ]

    def covariances(self, found: Shared, which: Mask | None = None) -> tuple[Array, Array]:
        """(u, u) each: of the errors of what is shared, told by the masks (rows,) that count.

        Of contours that err, and what is off alike in all frames adds.
        """
        seen = self._doubted_distances(found, _FITTED, which)
        is_angle = np.zeros(seen.X.shape[1], bool)
        sizes = estimate_sizes(seen, is_angle, 0.0, PRIOR_DEVIATION)
        doubted, seen = doubted_covariance(seen, sizes, is_angle)
        covariance = values_covariance(seen, sizes, np.arange(len(is_angle)), is_angle)
        covariance *= _scatter(seen, sizes, len(self.names))
        trusted = _calibration_error(self._doubted_distances(found, TOLD_APART, which))
        for c, camera in enumerate(self.cameras(found)):
            unseen = _unseen_errors(self.seen[c], camera.X_CW, trusted)[: self.per_camera]
            at = np.arange(len(unseen)) + c * len(unseen)
            doubted[at, at] += unseen**2
        own = slice(len(self.names))
        return covariance[own, own], doubted[own, own]

    def growth(
        self, found: Shared, name: str, weights: Array, which: Mask, covariance: Array
    ) -> tuple[float, float]:
        """How a constant grows with what the masks that count weigh, were it to grow.

        One Gauss-Newton step of a further unknown, whose derivatives are in each mask the
        constant's times the mask's weight, beside all others; and its standard deviation.

        Args:
            weights: of the masks that count.
            covariance: (u, u) of what is shared.
        """
        p, at = self._fit.unknowns.own_count, self.names.index(name)
        equations = self.equations(found, _FITTED, which)
        H, g = equations.H, equations.g
        more = np.einsum("f,fi->fi", weights, H[:, p + at])
        own = weights**2 * H[:, p + at, p + at]
        H = np.block([[H, more[:, :, None]], [more[:, None, :], own[:, None, None]]])
        g = np.column_stack([g, weights * g[:, p + at]])
        gains = np.linalg.solve(H[:, :p, :p] + _LEAST * np.eye(p), H[:, :p, p:])
        S = (H[:, p:, p:] - np.einsum("fpi,fpj->fij", H[:, :p, p:], gains)).sum(axis=0)
        S += _LEAST * np.eye(len(S))
        left = (g[:, p:] - np.einsum("fpi,fp->fi", gains, g[:, :p])).sum(axis=0)
        inverse = np.linalg.inv(S)
        said = np.linalg.inv(S[:-1, :-1])[at, at]
        scale = covariance[at, at] / said
        return -float(inverse[-1] @ left), float(np.sqrt(scale * inverse[-1, -1]))

    def camera_covariances(self, found: Shared, covariance: Array) -> Array:
        """(cameras, 6, 6) of the poses' errors in the world, covariance being of what is shared."""
        X_CW, _, motions = self._fit.places(self._parameters(found)[0])
        own = [slice(k, k + 6) for k in self.per_camera * np.arange(len(X_CW))]
        several = zip(X_CW, motions, own, strict=True)
        return np.array([pose_covariance(X, J[:6], covariance[k, k]) for X, J, k in several])

    def _at(
        self, at: Shared, which: Mask | None
    ) -> tuple[tuple[list[FrameEvidence], Array, Array, Array], tuple[Array, Array], Mask]:
        """Masks that count as ``FramesFit`` takes them: what is seen and held, both unknowns.

        Then what these are expected to be, and which masks (rows,) those are.
        """
        which = np.ones(len(self.rows), bool) if which is None else which
        own, evidence = self._own(at)[which], [self._evidence[k] for k in np.flatnonzero(which)]
        expected = np.zeros_like(own), np.zeros(len(self.names))
        return (evidence, self._values[which], own, at.shared), expected, which

    def _own(self, at: Shared) -> Array:
        """(rows, own unknowns): of each mask the width of its camera's."""
        own = np.zeros((len(self.rows), self._fit.unknowns.own_count))
        if own.size:
            own[np.arange(len(own)), self.rows] = at.widths
        return own

    def _parameters(self, at: Shared) -> Array:
        """(rows, n) all parameters."""
        held = np.zeros((len(self.rows), len(self._fit.names)))
        held[:, : self._values.shape[1]] = self._values
        rows = zip(held, self._own(at), strict=True)
        return np.array([self._fit.unknowns.parameters(one, own, at.shared) for one, own in rows])

    def _doubted_distances(
        self, found: Shared, step: AnnealingStage, which: Mask | None
    ) -> Distances:
        """The distances in all masks that count; values are what is shared, then the widths.

        Doubted are, where they are not among it: zeros, lengths, each and all alike, and lenses.
        """
        whole, names = self._doubting, self._doubting.names
        shared = np.zeros(len(names))
        own = [names.index(name) for name in self.names]
        shared[own] = found.shared
        seen = whole._distances(Shared(shared, found.widths), step, which)
        units, groups = whole._doubt_units(), []
        for kind in (_ZEROS, _LENGTHS, _LENSES):
            doubted = [k for k, name in enumerate(names) if k not in own and units[name][0] == kind]
            Z = seen.X[:, doubted] * [units[names[k]][1] for k in doubted]
            # Lengths may all be off alike, too.
            alike = kind == _LENGTHS
            groups.append(np.column_stack([Z, Z.sum(axis=1)]) if alike else Z)
        values = np.array([*own, *range(len(names), seen.X.shape[1])])
        return seen._replace(
            X=seen.X[:, values],
            information=seen.information[np.ix_(values, values)],
            doubts=tuple(Z for Z in groups if Z.any()),
        )

    @cached_property
    def _doubting(self) -> SharedFit:
        """The same fit, all unknown that is doubted."""
        kinematics = self.seen[0].kinematics
        offsets = lengthened_joints(kinematics.tree)
        free = np.flatnonzero(kinematics.lower < kinematics.upper)
        zeros = [name for name in (kinematics.names[k] for k in free) if name not in self.constants]
        lengths = dict.fromkeys(length_name(one.link) for one in offsets)
        names = [*self.constants, *zeros, *(one for one in lengths if one not in self.constants)]
        options = self._options | {"offsets": offsets, "looks": len(CAMERA_NAMES)}
        return SharedFit(self.seen, self._X_CW, names, **options)

    def _doubt_units(self) -> dict[str, tuple[str, float]]:
        """Of each name the group in which it is doubted, "" where not, and by how much."""
        kinematics, units = self.seen[0].kinematics, dict.fromkeys(self.names, (_LENGTHS, _LENGTH))
        for name, is_angle in zip(kinematics.names, kinematics.is_angle, strict=True):
            units[name] = "" if name in OBJECT_POSITIONS else _ZEROS, _ZERO if is_angle else _SLID
        for camera in (one.camera for one in self.seen):
            own = [("", 1.0)] * 6 + [(_LENSES, _FOCAL)] + [(_LENSES, _CENTER * camera.focal_x)] * 2
            units |= zip((f"{camera.name}.{name}" for name in CAMERA_NAMES), own, strict=True)
        return units

    def _distances(self, found: Shared, step: AnnealingStage, which: Mask | None) -> Distances:
        """The distances in all masks that count; values are what is shared, then the widths."""
        (evidence, *_), _, which = self._at(found, which)
        pictures = self._fit.pictures(evidence, self._parameters(found)[which], step)
        outlines = self._fit.body.outlines
        return distances_in_masks(outlines, pictures, widths=True)


def fit_pose(seen: PosedFrames, X_CW: Array, rounds: Sequence[AnnealingStage]) -> Array:
    """X_CW (4, 4) fitted to all frames from where it starts; silhouettes keep their widths."""
    fit = SharedFit([seen], [X_CW], widths=False)
    return fit.cameras(fit.fit(rounds))[0].X_CW


def pose_covariance(X_CW: Array, motions: Array, covariance: Array) -> Array:
    """(6, 6) of a camera's error in the world: a rotation vector [rad], a shift [m].

    Args:
        X_CW: (4, 4) of the camera.
        motions: (6, 12) of all that it sees, as of ``CameraParameters.place``.
        covariance: (6, 6) of these.
    """
    # Where all that it sees moves one way, it moves the other way.
    by = -motions.reshape(6, 3, 4)
    p_WC = -X_CW[:3, :3].T @ X_CW[:3, 3]
    turns = np.stack([by[:, 2, 1], by[:, 0, 2], by[:, 1, 0]])
    J = np.vstack([turns, (by[:, :, :3] @ p_WC + by[:, :, 3]).T])
    return np.asarray(J @ covariance @ J.T)


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
    sizes = estimate_sizes(seen, np.zeros(seen.X.shape[1], bool), 0.0, PRIOR_DEVIATION)
    return min(_NO_BETTER, _NO_BETTER * (sizes.surface**2 + sizes.mask**2) / _PARTS_ERR**2)


def _unseen_errors(seen: PosedFrames, X_CW: Array, pixels: float) -> Array:
    """(7,) by how much a camera's turn, shift and focal length are off then: deviations."""
    depth = float(X_CW[2, :3] @ seen.middle + X_CW[2, 3])
    size = pixels * depth / seen.camera.focal_x
    turn = size / seen.extent
    return np.array([turn, turn, turn, size, size, size * depth / seen.extent, turn])
