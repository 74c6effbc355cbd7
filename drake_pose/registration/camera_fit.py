"""The pose of a camera at which a body's contours fit the silhouettes' edges in all frames.

A mask that is too wide on all sides makes its body seem nearer. Each frame's width is unknown, too:
thin links and their distances from one another tell the two apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera import PinholeCamera
from drake_pose.matching.fit.camera_sums import Views
from drake_pose.matching.fit.contour_fit import Comparison, ContourFit, Noise, pack_cameras
from drake_pose.matching.fit.evidence import Evidence
from drake_pose.matching.fit.frames_fit import FramesFit
from drake_pose.matching.fit.kernel import COST, WEIGHT
from drake_pose.matching.fit.levenberg_marquardt import Equations, Round, StepSettings, minimise
from drake_pose.matching.fit.parameters import CAMERA_NAMES, CameraParameters
from drake_pose.matching.fit.unknowns import choose
from drake_pose.registration.posed_frames import PosedFrames

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

POSE_NAMES = CAMERA_NAMES[:6]
"""A camera's turn [rad] and shift [m] along its axes about the middle of the bodies."""

_STEPS = StepSettings(longest=0.3, damping=1e-2, even_damping=1e-6)
# Masks are wider or narrower by no more [pixel], and their width is varied by this.
_WIDEST, _WIDTH_STEP = 6.0, 0.25


@dataclass(frozen=True, eq=False)
class FittedCamera:
    """A camera's pose that was fitted.

    Args:
        X_CW: (4, 4) the world's pose in the camera.
        widths: (frames,) by how much each frame's silhouette is too wide on all sides [pixel]; 0
            for frames that did not count.
    """

    X_CW: Array
    widths: Array


class CameraFit:
    """Fits a camera's pose; rounds' lengths are in the root of the silhouettes' median area.

    Attributes:
        frames: what the camera sees.
        values: (frames, m) of the pose tree.
        noise: what a point of contour is worth: a pixel of it counts one.
        contours: compares contours and edges.

    Args:
        frames: what the camera sees.
        spacing: from one point of a silhouette's edge to the next [root of the area].
    """

    def __init__(self, frames: PosedFrames, spacing: float) -> None:
        self.frames = frames
        self.values = np.array([frame.values for frame in frames.frames])
        self.noise = Noise(deviation=1.0, correlation=0.5 / frames.size**3)
        self.contours = ContourFit(
            frames.kinematics, frames.outlines, self.noise, _STEPS, pixels=frames.size
        )
        self._evidence = frames.evidence(max(1.0, round(spacing * frames.size)))

    def fit(self, X_CW: Array, rounds: Sequence[Round]) -> Array:
        """X_CW (4, 4) fitted to all frames from where it starts, silhouettes as wide as they are.

        Args:
            X_CW: (4, 4) where to start.
            rounds: the parts of the fit.
        """
        found = self._frames_fit(self._camera(X_CW)).fit(
            self._evidence,
            self.values,
            np.zeros((len(self.values), 0)),
            np.zeros(len(POSE_NAMES)),
            rounds,
        )
        return self.moved(X_CW, found.shared)

    def fit_with_widths(
        self, start: FittedCamera, rounds: Sequence[Round], which: Indices
    ) -> FittedCamera:
        """The pose and the widths of some frames' silhouettes fitted.

        Args:
            start: where to start.
            rounds: the parts of the fit.
            which: the frames that count.
        """

        def evaluate(own: Array, shared: Array, step: Round) -> Equations:
            X_CW = self.moved(start.X_CW, shared)
            motions = self.motions(X_CW)
            parts = [
                self._width_equations(X_CW, motions, int(k), float(width), step)
                for k, width in zip(which, own[:, 0], strict=True)
            ]
            H, g, costs = zip(*parts, strict=True)
            return Equations(np.array(H), np.array(g), float(sum(costs)))

        size = 1 + len(POSE_NAMES)
        limits = np.full(size, -np.inf), np.full(size, np.inf)
        limits[0][0], limits[1][0] = -_WIDEST, _WIDEST
        found = minimise(
            evaluate, start.widths[which, None], np.zeros(size - 1), limits, rounds, _STEPS
        )
        widths = np.zeros(len(self.values))
        widths[which] = found.own[:, 0]
        return FittedCamera(self.moved(start.X_CW, found.shared), widths)

    def _width_equations(
        self, X_CW: Array, motions: Array, frame: int, width: float, step: Round
    ) -> tuple[Array, Array, float]:
        """H (7, 7), g (7,) and cost of a frame: the width first, then POSE_NAMES.

        What follows the width is told by differences: edges that are shifted along their normals.
        """
        compared = [
            self.compare(X_CW, frame, step, width + off) for off in (-_WIDTH_STEP, 0.0, _WIDTH_STEP)
        ]
        less, here, more = (one.total for one in compared)
        A = here.A.sum(axis=0)
        A = np.tril(A) + np.tril(A, -1).T
        H, g = np.empty((7, 7)), np.empty(7)
        H[1:, 1:], g[1:] = motions @ A @ motions.T, -motions @ here.b.sum(axis=0)
        sums = [one.sums.sum(axis=0) for one in (less, here, more)]
        g[0] = (sums[2][COST] - sums[0][COST]) / (4.0 * _WIDTH_STEP)
        H[0, 0] = sums[1][WEIGHT]
        pulled = motions @ (less.b - more.b).sum(axis=0) / (2.0 * _WIDTH_STEP)
        H[0, 1:] = H[1:, 0] = pulled
        return H, g, float(sums[1][COST])

    def compare(self, X_CW: Array, frame: int, step: Round, width: float = 0.0) -> Comparison:
        """A frame's contours compared with its edges, these shifted inwards by a width [pixel]."""
        return self.contours.compare_views(
            self._views(X_CW, frame, width), self.values[frame], step
        )

    def piece_costs(self, fitted: FittedCamera, step: Round, side: float) -> Array:
        """(frames, k, k) costs by squares of the pictures of a side [pixel]."""
        return np.array(
            [
                self.contours.piece_costs(self._views(fitted.X_CW, k, width), values, step, side)[0]
                for k, (width, values) in enumerate(zip(fitted.widths, self.values, strict=True))
            ]
        )

    def _views(self, X_CW: Array, frame: int, width: float) -> Views:
        uv, normals, lengths, starts = self._evidence[frame]
        if width:
            uv = uv - width * normals
            order = np.argsort(uv[:, 1])
            uv, normals, lengths = uv[order], normals[order], lengths[order]
        evidence = Evidence(uv, normals, lengths, starts)
        return Views(pack_cameras([self._camera(X_CW)]), evidence)

    def motions(self, X_CW: Array) -> Array:
        """(6, 12) the affine motions that POSE_NAMES amount to for all that the camera sees."""
        return self._parameters(self._camera(X_CW)).place(np.zeros(7))[2][0, :6]

    def moved(self, X_CW: Array, by: Array) -> Array:
        """X_CW (4, 4) after a motion by POSE_NAMES (6,)."""
        return self._parameters(self._camera(X_CW)).place(np.append(by, 0.0))[0][0]

    def _camera(self, X_CW: Array) -> PinholeCamera:
        return self.frames.camera.with_pose(np.linalg.inv(X_CW))

    def _parameters(self, camera: PinholeCamera) -> CameraParameters:
        return CameraParameters([camera], self.frames.middle)

    def _frames_fit(self, camera: PinholeCamera) -> FramesFit:
        names = [*self.contours.body.names, *self._parameters(camera).names]
        unknown = [f"{camera.name}.{name}" for name in POSE_NAMES]
        return FramesFit(
            self.contours.body,
            [camera],
            choose(names, unknown, shared=True),
            pivot=self.frames.middle,
            noise=self.noise,
            steps=_STEPS,
            pixels=self.frames.size,
        )
