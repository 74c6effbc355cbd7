"""The pose of a camera at which a body's contours fit the silhouettes' edges in all frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera import PinholeCamera
from drake_pose.matching.fit.camera_sums import Views
from drake_pose.matching.fit.contour_fit import FINEST_SCALE, ContourFit, Noise, pack_cameras
from drake_pose.matching.fit.frames_fit import FramesFit
from drake_pose.matching.fit.levenberg_marquardt import Round, StepSettings
from drake_pose.matching.fit.parameters import CAMERA_NAMES, CameraParameters
from drake_pose.matching.fit.unknowns import choose
from drake_pose.registration.posed_frames import PosedFrames

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

POSE_NAMES = CAMERA_NAMES[:6]
"""A camera's turn [rad] and shift [m] along its axes about the middle of the bodies."""

_STEPS = StepSettings(longest=0.3, damping=1e-2, even_damping=1e-6)


@dataclass(frozen=True, eq=False)
class FittedCamera:
    """A camera's pose that was fitted.

    Args:
        X_CW: (4, 4) the world's pose in the camera.
        costs: (frames,) what does not fit [pixel of contour].
        shares: (frames,) of both contours' lengths, what fits.
    """

    X_CW: Array
    costs: Array
    shares: Array


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

    def fit(
        self, X_CW: Array, rounds: Sequence[Round], which: Indices | None = None
    ) -> FittedCamera:
        """Fits the pose.

        Args:
            X_CW: (4, 4) where to start.
            rounds: the parts of the fit.
            which: the frames that count; None: all.
        """
        index = np.arange(len(self.values)) if which is None else which
        camera = self._camera(X_CW)
        found = self._frames_fit(camera).fit(
            [self._evidence[k] for k in index],
            self.values[index],
            np.zeros((len(index), 0)),
            np.zeros(len(POSE_NAMES)),
            rounds,
        )
        scale = max(FINEST_SCALE, rounds[-1].scale * self.frames.size)
        return FittedCamera(
            self.moved(X_CW, found.shared), found.costs[:, 0] / scale**2, found.shares[:, 0]
        )

    def views(self, X_CW: Array) -> list[Views]:
        """What the camera sees in each frame, from a pose."""
        packed = pack_cameras([self._camera(X_CW)])
        return [Views(packed, evidence) for evidence in self._evidence]

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
