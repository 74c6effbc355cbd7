"""Each frame fitted by itself, its joints and cameras free to move a little from where they are.

What is given is where a fit begins, and its prior. What is left of the distances is linear in what
is given about where the fit ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.errors import MaskError
from drake_pose.fit.camera_sums import Views
from drake_pose.fit.contour_fit import (
    Comparison,
    ContourFit,
    Noise,
    inlier_ratio_of,
    pixels_per_metre,
)
from drake_pose.fit.covariance import Picture
from drake_pose.fit.evidence import (
    NO_EDGE,
    Evidence,
    find_edge_points,
    pack_evidence,
    widened,
)
from drake_pose.fit.frames_fit import FramesFit
from drake_pose.fit.kernel import COST, WEIGHT
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.fit.parameters import CAMERA_NAMES, CameraParameters
from drake_pose.fit.unknowns import choose
from drake_pose.registration.calibration_fit import TOLD_APART
from drake_pose.registration.camera_fit import POSE_NAMES
from drake_pose.silhouette.areas.outline import Outline

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROUNDS = tuple(
    AnnealingStage(scale, 0.02) for scale in (0.12, 0.09, 0.07, 0.05, 0.04, 0.03, 0.025)
)
_STEPS = StepSettings(longest=0.2, damping=1e-3, even_damping=1e-6)
# From one point of a silhouette's edge to the next [root of the silhouettes' area].
_SPACING = 1.0 / 100.0
# Where given values cost no more than so many times what they do once they are freed, distances are
# linear about them: what hardly shows may have moved far.
_FITS_ALREADY = 1.3
# How far joints, and cameras about the body, may be off: standard deviations [rad, m].
_ANGLE, _SHIFT, _CAMERA_TURN, _CAMERA_SHIFT = 0.1, 0.02, 0.05, 0.05
# Silhouettes may be as much too wide on all sides, or too narrow [pixel].
_WIDTHS = np.linspace(-3.0, 3.0, 5)
# What a fit's unknowns are held by: contours err by about so much along about so much [pixel].
_POINT_ERROR, _ERROR_LENGTH = 4.0, 100.0


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """A frame: values (m,) of the pose tree [rad or m], and the silhouettes (H, W) by camera."""

    name: str
    values: Array
    masks: Mapping[str, Mask]


@dataclass(frozen=True, eq=False)
class FrameFit:
    """A frame whose joints and cameras were fitted.

    Args:
        pictures: the contours compared with each camera's silhouette where the fit ended, and told
            as distances from what is given; their values are the joints' and POSE_NAMES of each
            camera.
        cameras: of the pictures.
        inlier_ratios: before and after, by camera.
        weights: (nodes,) how much of the contours of each node was compared [pixel].
    """

    name: str
    pictures: tuple[Picture, ...]
    cameras: tuple[str, ...]
    inlier_ratios: tuple[Mapping[str, float], Mapping[str, float]]
    weights: Array


class PerFrameFit:
    """Fits frames, each by itself, with all that is given free to move.

    Attributes:
        names: of the p values that move: the joints, and POSE_NAMES of each camera.
        deviations: (p,) how far what is given may be off: standard deviations [rad or m].

    Args:
        outlines: a surface for each node: of few triangles, with which frames are fitted, and all,
            with which they are compared in the end.
        cameras: the cameras, where they are said to stand.
        frames: some frames, which tell how large silhouettes are, and where the body is.

    Raises:
        MaskError: a mask of another size than its camera's picture, or no mask shows the body.
    """

    def __init__(
        self,
        kinematics: TreeKinematics,
        outlines: tuple[Sequence[Outline], Sequence[Outline]],
        cameras: Sequence[Camera],
        frames: Sequence[SeenFrame],
    ) -> None:
        self._cameras = tuple(cameras)
        self._size = common_size(cameras, frames)
        noise = Noise(deviation=1.0, correlation=0.5 / self._size**3)
        self._few, self.contours = (
            ContourFit(kinematics, one, noise, _STEPS, pixels=self._size) for one in outlines
        )
        places = [kinematics.poses(frame.values)[:, :3, 3].mean(axis=0) for frame in frames]
        pivot = np.mean(places, axis=0)
        self._parameters = CameraParameters(cameras, pivot)
        joints = np.flatnonzero(kinematics.lower < kinematics.upper)
        self.camera_names = tuple(camera.name for camera in cameras)
        self.joints = tuple(kinematics.names[k] for k in joints)
        looks = tuple(f"{camera.name}.{name}" for camera in cameras for name in POSE_NAMES)
        self.names = (*self.joints, *looks)
        worth = _POINT_ERROR * np.sqrt(_ERROR_LENGTH)
        of_joints = np.where(kinematics.is_angle[joints], _ANGLE, _SHIFT)
        turns = [name.startswith("turn") for name in POSE_NAMES]
        self.is_angle = np.concatenate([kinematics.is_angle[joints], *([turns] * len(cameras))])
        of_camera = [_CAMERA_TURN] * 3 + [_CAMERA_SHIFT] * 3
        self.deviations = np.concatenate([of_joints, *([of_camera] * len(cameras))])
        body = self._few.body
        unknown = choose(
            [*body.names, *self._parameters.names],
            self.names,
            deviation=self.deviations / worth,
        )
        self._entries = unknown.entries
        self._fit = FramesFit(
            body, cameras, unknown, pivot=pivot, noise=noise, steps=_STEPS, pixels=self._size
        )

    def fit(self, frame: SeenFrame) -> FrameFit:
        """Fits a frame.

        Raises:
            MaskError: a mask of another size than its camera's picture.
        """
        evidence = self._evidence(frame)
        held, change = self._held(frame), np.zeros((1, len(self.names)))
        theta, widths = held, np.zeros(len(self._cameras))
        for rounds in (_ROUNDS, _ROUNDS[-2:]):
            found = self._fit.fit(
                [widened(evidence, -widths)],
                frame.values[None],
                change,
                np.zeros(0),
                rounds,
                expected=(np.zeros_like(change), np.zeros(0)),
            )
            change, theta = found.own, found.parameters[0]
            widths = self._widths(evidence, theta)
        own = self._widths(evidence, held)
        before = self._compare(widened(evidence, -own), held)
        after = self._compare(widened(evidence, -widths), theta)
        told = after
        if _cost(before) <= _FITS_ALREADY * _cost(after):
            theta, told, change, widths = held, before, np.zeros_like(change), own
        return FrameFit(
            frame.name,
            *self._pictures(told, theta, change[0]),
            (self._inlier_ratios(before, frame), self._inlier_ratios(after, frame)),
            _weights(told),
        )

    def _inlier_ratios(self, compared: Comparison, frame: SeenFrame) -> dict[str, float]:
        return {
            camera.name: inlier_ratio_of(compared.sums[c])
            for c, camera in enumerate(self._cameras)
            if camera.name in frame.masks
        }

    def _widths(self, evidence: Evidence, theta: Array) -> Array:
        """(c,) by how much the silhouettes are wider on all sides than the body [pixel]."""
        costs = np.array(
            [
                self._compare(
                    widened(evidence, np.full(len(self._cameras), -one)), theta, self._few
                )
                .sums[:, :, COST]
                .sum(axis=1)
                for one in _WIDTHS
            ]
        )
        best = np.clip(costs.argmin(axis=0), 1, len(_WIDTHS) - 2)
        low, middle, high = (np.take_along_axis(costs, (best + k)[None], 0)[0] for k in (-1, 0, 1))
        bend = low - 2.0 * middle + high
        step = np.where(bend > 0.0, 0.5 * (low - high) / np.where(bend > 0.0, bend, 1.0), 0.0)
        return _WIDTHS[best] + np.clip(step, -1.0, 1.0) * (_WIDTHS[1] - _WIDTHS[0])

    def base_moves(self) -> Array:
        """(p, 6) how what is free follows a turn [rad] and shift [m] of the base, in deviations.

        All cameras see the base move about their common pivot.
        """
        moves = np.zeros((len(self.names), 6))
        for c, camera in enumerate(self._cameras):
            first = len(self.joints) + 6 * c
            R_CW = camera.X_CW[:3, :3]
            moves[first : first + 3, :3] = R_CW
            moves[first + 3 : first + 6, 3:] = R_CW
        return np.asarray(moves / self.deviations[:, None])

    def _held(self, frame: SeenFrame) -> Array:
        theta = np.zeros(len(self._fit.names))
        theta[: len(frame.values)] = frame.values
        return theta

    def _evidence(self, frame: SeenFrame) -> Evidence:
        spacing = max(1.0, round(_SPACING * self._size))
        edges = []
        for camera in self._cameras:
            mask = frame.masks.get(camera.name)
            if mask is not None:
                _check_size(camera, frame.name, mask)
            edges.append(NO_EDGE if mask is None else find_edge_points(mask, spacing))
        return pack_evidence(edges)

    def _compare(
        self, evidence: Evidence, theta: Array, contours: ContourFit | None = None
    ) -> Comparison:
        size = len(self.contours.body.names)
        X_CW, kernel, _ = self._parameters.place(theta[size:])
        values = theta[: len(self.contours.kinematics.names)]
        views = Views((X_CW, kernel), evidence)
        return (contours or self.contours).compare(views, values, TOLD_APART)

    def _pictures(
        self, compared: Comparison, theta: Array, change: Array
    ) -> tuple[tuple[Picture, ...], tuple[str, ...]]:
        """The comparison with each camera's silhouette, and the cameras that have one."""
        size, X_WN = len(self.contours.body.names), compared.placement.X_WN
        X_CW, kernel, motions = self._parameters.place(theta[size:])
        values = len(self.contours.kinematics.names)
        moves = np.zeros((len(X_WN), len(theta), 12))
        moves[:, :values] = compared.placement.dense(values)
        metres = 1.0 / pixels_per_metre((X_CW, kernel), X_WN[:, :3, 3].mean(axis=0))
        pictures, names = [], []
        for c, camera in enumerate(self._cameras):
            if not compared.A[c].any():
                continue
            own = moves.copy()
            first = size + c * len(CAMERA_NAMES)
            own[:, first : first + 6] = motions[c, :6]
            own = own[:, self._entries]
            A = compared.A[c]
            whole = np.tril(A) + np.swapaxes(np.tril(A, -1), -1, -2)
            moved = np.einsum("npk,p->nk", own, change)
            b = compared.b[c] + np.einsum("nkl,nl->nk", whole, moved)
            pictures.append(Picture(whole, b, X_WN, X_CW[c], own, float(metres[c])))
            names.append(camera.name)
        return tuple(pictures), tuple(names)


def common_size(cameras: Sequence[Camera], frames: Sequence[SeenFrame]) -> float:
    """The root of the silhouettes' median area [pixel]."""
    areas = []
    for frame in frames:
        for camera in cameras:
            if camera.name in frame.masks:
                _check_size(camera, frame.name, frame.masks[camera.name])
                areas.append(np.count_nonzero(frame.masks[camera.name]))
    if not any(areas):
        raise MaskError("no mask shows the body; give masks in which it is white")
    return float(np.sqrt(np.median([area for area in areas if area])))


def _check_size(camera: Camera, frame: str, mask: Mask) -> None:
    if mask.shape != (camera.height, camera.width):
        raise MaskError(
            f"camera '{camera.name}', frame '{frame}': a mask of {camera.width} x {camera.height} "
            f"pixels is expected, not {mask.shape[1]} x {mask.shape[0]}"
        )


def _cost(compared: Comparison) -> float:
    return float(compared.sums[:, :, COST].sum())


def _weights(compared: Comparison) -> Array:
    """(nodes,) how much contour was compared; edges are shared out among the nodes."""
    weights = compared.sums[:, :, WEIGHT].sum(axis=0)
    own = max(float(weights[:-1].sum()), 1e-9)
    return np.asarray(weights[:-1] * weights.sum() / own)
