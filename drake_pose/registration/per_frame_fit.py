"""Each frame fitted by itself, its joints and cameras free to move a little from where they are.

What is given is where a fit begins, and its prior. What is left of the distances is linear in what
is given about where the fit ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.fit.contour_fit import Comparison, Noise, inlier_ratio_of
from drake_pose.fit.covariance import ComparedMask
from drake_pose.fit.evidence import Evidence
from drake_pose.fit.frames_fit import FramesFit, parameter_names
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.fit.parameters import POSE_NAMES, BodyParameters
from drake_pose.fit.unknowns import choose
from drake_pose.registration.posed_frames import SeenFrame, common_size, middle_of
from drake_pose.registration.shared_fit import TOLD_APART
from drake_pose.silhouette.areas.outline import Outline

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
class FrameFit:
    """A frame whose joints and cameras were fitted.

    Args:
        pictures: the contours compared with each camera's silhouette where the fit ended, and told
            as distances from what is given; their values are the joints' and POSE_NAMES of each
            camera.
        inlier_ratios: before and after, by camera.
        weights: (nodes,) how much of the contours of each node was compared [pixel].
    """

    name: str
    pictures: tuple[ComparedMask, ...]
    inlier_ratios: tuple[Mapping[str, float], Mapping[str, float]]
    weights: Array


class PerFrameFit:
    """Fits frames, each by itself, with all that is given free to move.

    Attributes:
        outlines: all of the surfaces.
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
        self._cameras, self.outlines = tuple(cameras), outlines[1]
        self._size = common_size(cameras, frames)
        joints = np.flatnonzero(kinematics.lower < kinematics.upper)
        self.camera_names = tuple(camera.name for camera in cameras)
        self.joints = tuple(kinematics.names[k] for k in joints)
        looks = tuple(f"{camera.name}.{name}" for camera in cameras for name in POSE_NAMES)
        self.names = (*self.joints, *looks)
        turns = np.tile([name.startswith("turn") for name in POSE_NAMES], len(cameras))
        self.is_angle = np.concatenate([kinematics.is_angle[joints], turns])
        of_joints = np.where(kinematics.is_angle[joints], _ANGLE, _SHIFT)
        of_cameras = np.where(turns, _CAMERA_TURN, _CAMERA_SHIFT)
        self.deviations = np.concatenate([of_joints, of_cameras])
        worth = _POINT_ERROR * np.sqrt(_ERROR_LENGTH)
        bodies = [BodyParameters(kinematics, one) for one in outlines]
        self._middle = middle_of(kinematics, frames)
        unknowns = choose(
            parameter_names(bodies[0], cameras), self.names, deviation=self.deviations / worth
        )
        self._few, self._all = (
            FramesFit(
                body, cameras, unknowns, pivot=self._middle,
                noise=Noise.of_a_pixel(self._size), steps=_STEPS, pixels=self._size,
            )
            for body in bodies
        )  # fmt: skip

    def fit(self, frame: SeenFrame) -> FrameFit:
        """Fits a frame.

        Raises MaskError: a mask of another size than its camera's picture.
        """
        evidence = frame.edges(self._cameras, _SPACING * self._size)
        held, change = np.zeros(len(self._all.names)), np.zeros((1, len(self.names)))
        held[: len(frame.values)] = frame.values
        base, given = held, (change, np.zeros(0))
        for rounds in (_ROUNDS, _ROUNDS[-2:]):
            found = self._few.fit(
                [evidence], base[None], change, np.zeros(0), rounds, expected=given
            )
            change, theta = found.own, self._with_widths(evidence, found.parameters[0])
            base = np.append(held[: -len(self._cameras)], theta[-len(self._cameras) :])
        held = self._with_widths(evidence, held)
        before, after = (self._all.compare(evidence, one, TOLD_APART)[0] for one in (held, theta))
        told = after
        costs = [float(one.sums[:, :, Sum.COST].sum()) for one in (before, after)]
        if costs[0] <= _FITS_ALREADY * costs[1]:
            theta, told, change = held, before, given[0]
        return FrameFit(
            frame.name,
            tuple(
                one._replace(b=one.b + np.einsum("nkl,npl,p->nk", one.A, one.moves, change[0]))
                for one in self._all.pictures([evidence], theta[None], TOLD_APART)
            ),
            (self._inlier_ratios(before, frame), self._inlier_ratios(after, frame)),
            _weights(told),
        )

    def _inlier_ratios(self, compared: Comparison, frame: SeenFrame) -> dict[str, float]:
        sums = zip(self.camera_names, compared.sums, strict=True)
        return {name: inlier_ratio_of(one) for name, one in sums if name in frame.masks}

    def _with_widths(self, evidence: Evidence, theta: Array) -> Array:
        """All parameters (n,), the silhouettes as much wider on all sides as fits best [pixel]."""
        found, costs = theta.copy(), np.full((len(_WIDTHS), len(self._cameras)), np.inf)
        inner = range(1, len(_WIDTHS) - 1)
        for k in (*inner, 0, len(_WIDTHS) - 1):
            # The narrowest and the widest are looked at where it goes on falling that way.
            if k in inner or (np.argmin(costs, axis=0) == min(max(k, 1), len(_WIDTHS) - 2)).any():
                found[-len(self._cameras) :] = _WIDTHS[k]
                compared, _ = self._few.compare(evidence, found, TOLD_APART)
                costs[k] = compared.sums[:, :, Sum.COST].sum(axis=1)
        best = np.clip(np.argmin(costs, axis=0), 1, len(_WIDTHS) - 2)
        low, middle, high = (np.choose(best + k, costs) for k in (-1, 0, 1))
        bend = low - 2.0 * middle + high
        step = np.where(bend > 0.0, 0.5 * (low - high) / np.where(bend > 0.0, bend, 1.0), 0.0)
        by = np.clip(step, -1.0, 1.0) * (_WIDTHS[1] - _WIDTHS[0])
        found[-len(self._cameras) :] = _WIDTHS[best] + by
        return found

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

    def center_moves(self, cameras: Sequence[int]) -> Array:
        """(p, 2) as base_moves, of a pixel by which principal points are shifted along x and y.

        At depth z a body is seen shifted by z over the focal length: a shift, and a turn, but for
        what the turn changes of the depth.
        """
        moves = np.zeros((len(self.names), 2))
        for c in cameras:
            kind, focal_x, focal_y = self._cameras[c].kernel_parameters()[:3]
            first, z = len(self.joints) + 6 * c, self._depth(c)
            of_x, of_y = moves[first : first + 6].T
            of_x[3], of_y[4] = ((1.0 if kind == 1.0 else z) / focal for focal in (focal_x, focal_y))
            of_x[1], of_y[0] = (0.0, 0.0) if kind == 1.0 else (1.0 / focal_x, -1.0 / focal_y)
        return np.asarray(moves / self.deviations[:, None])

    def focal_moves(self, cameras: Sequence[int]) -> Array:
        """(p, 1) as base_moves, of focal lengths that are larger by all of themselves.

        A body is seen as it would be if it were nearer by that share of its depth; to a parallel
        camera it is as near as ever.
        """
        moves = np.zeros((len(self.names), 1))
        for c in cameras:
            if self._cameras[c].kernel_parameters()[0] != 1.0:
                moves[len(self.joints) + 6 * c + 5] = -self._depth(c)
        return np.asarray(moves / self.deviations[:, None])

    def _depth(self, camera: int) -> float:
        """How far the body's middle is before a camera [m]."""
        X_CW = self._cameras[camera].X_CW
        return float(X_CW[2, :3] @ self._middle + X_CW[2, 3])


def _weights(compared: Comparison) -> Array:
    """(nodes,) how much contour was compared; edges are shared out among the nodes."""
    weights = compared.sums[:, :, Sum.WEIGHT].sum(axis=0)
    own = max(float(weights[:-1].sum()), 1e-9)
    return np.asarray(weights[:-1] * weights.sum() / own)
