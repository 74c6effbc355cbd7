"""The pose of a camera at which a body's contours fit the silhouettes' edges in all frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.joint_offsets import JointOffset
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.camera_sums import Views
from drake_pose.fit.contour_fit import Comparison, ContourFit, Noise, pack_cameras
from drake_pose.fit.evidence import widened
from drake_pose.fit.frames_fit import FramesFit
from drake_pose.fit.lengthened_body import LengthenedBody
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.fit.parameters import CAMERA_NAMES, CameraParameters
from drake_pose.fit.unknowns import choose
from drake_pose.registration.posed_frames import PosedFrames

Array = NDArray[np.float64]

POSE_NAMES = CAMERA_NAMES[:6]
"""A camera's turn [rad] and shift [m] along its axes about the middle of the bodies."""

_STEPS = StepSettings(longest=0.3, damping=1e-2, even_damping=1e-6)


class CameraFit:
    """Fits a camera's pose; rounds' lengths are in the root of the silhouettes' median area.

    Attributes:
        values: (frames, n) of the pose tree; and lengths of links, which are 0.
        names: of these n parameters of the body.
        noise: what a point of contour is worth: a pixel of it counts one.

    Args:
        spacing: from one point of a silhouette's edge to the next [root of the area].
        offsets: joints whose places on their links are unknown.
    """

    def __init__(
        self, frames: PosedFrames, spacing: float, offsets: Sequence[JointOffset] = ()
    ) -> None:
        self.frames = frames
        body = LengthenedBody(frames.kinematics, frames.outlines, offsets) if offsets else None
        self.names = frames.kinematics.names if body is None else body.names
        self.values = np.zeros((len(frames.frames), len(self.names)))
        self.values[:, : len(frames.kinematics.names)] = [one.values for one in frames.frames]
        self.noise = Noise(deviation=1.0, correlation=0.5 / frames.size**3)
        self.contours = ContourFit(
            frames.kinematics, frames.outlines, self.noise, _STEPS, frames.size, body
        )
        self._evidence = frames.evidence(max(1.0, round(spacing * frames.size)))

    def fit(self, X_CW: Array, rounds: Sequence[AnnealingStage]) -> Array:
        """X_CW (4, 4) fitted to all frames from where it starts; silhouettes keep their widths."""
        found = self._frames_fit(self.placed(X_CW)).fit(
            self._evidence,
            self.values,
            np.zeros((len(self.values), 0)),
            np.zeros(len(POSE_NAMES)),
            rounds,
        )
        return self.moved(X_CW, found.shared)

    def compare(
        self,
        X_CW: Array,
        frame: int,
        step: AnnealingStage,
        width: float = 0.0,
        values: Array | None = None,
        log_focal: float = 0.0,
    ) -> Comparison:
        """A frame's contours compared with its edges.

        Args:
            width: the silhouette is too wide by so much on all sides [pixel].
            values: (n,) the body's parameters; None: the frame's own.
            log_focal: the logarithm of the focal length's growth.
        """
        views = self._views(X_CW, frame, width, log_focal)
        values = self.values[frame] if values is None else values
        return self.contours.compare(views, values, step)

    def piece_costs(self, X_CW: Array, widths: Array, step: AnnealingStage, side: float) -> Array:
        """(frames, k, k) costs by squares of the pictures of a side [pixel].

        Args:
            widths: (frames,) by which silhouettes are too wide on all sides [pixel].
            side: of the squares.
        """
        return np.array(
            [
                self.contours.piece_costs(self._views(X_CW, k, width), values, step, side)[0]
                for k, (width, values) in enumerate(zip(widths, self.values, strict=True))
            ]
        )

    def _views(self, X_CW: Array, frame: int, width: float, log_focal: float = 0.0) -> Views:
        evidence = self._evidence[frame]
        if width:
            evidence = widened(evidence, np.array([-width]))
        return Views(pack_cameras([self.placed(X_CW, log_focal)]), evidence)

    def motions(self, X_CW: Array, log_focal: float = 0.0) -> Array:
        """(7, 12) the affine motions that CAMERA_NAMES amount to for all that the camera sees."""
        camera = self.placed(X_CW, log_focal)
        return self._parameters(camera).place(np.zeros(len(CAMERA_NAMES)))[2][0]

    def moved(self, X_CW: Array, by: Array) -> Array:
        """X_CW (4, 4) after a motion by POSE_NAMES (6,)."""
        return self._parameters(self.placed(X_CW)).place(np.append(by, 0.0))[0][0]

    def placed(self, X_CW: Array, log_focal: float = 0.0) -> PinholeCamera:
        """The camera at a pose (4, 4), its focal length grown by exp(log_focal)."""
        camera, growth = self.frames.camera, math.exp(log_focal)
        return replace(
            camera,
            X_WC=np.linalg.inv(X_CW),
            focal_x=growth * camera.focal_x,
            focal_y=growth * camera.focal_y,
        )

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
