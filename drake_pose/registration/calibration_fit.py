"""Cameras' poses, and what all frames share beside them, fitted together with the masks' widths.

A mask that is too wide on all sides makes its body seem nearer. Each frame's width is unknown, too:
thin links and their distances from one another tell the two apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.model import OBJECT_POSITIONS
from drake_pose.fit.contour_fit import Comparison
from drake_pose.fit.kernel import COST, WEIGHT
from drake_pose.fit.levenberg_marquardt import AnnealingStage, Equations, StepSettings, minimise
from drake_pose.fit.parameters import CAMERA_NAMES
from drake_pose.registration.camera_fit import POSE_NAMES, CameraFit

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

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

# A frame agrees whose inlier ratio is this share of that of the two that fit best.
_AGREES = 0.7
_STEPS = StepSettings(longest=0.3, damping=1e-2, even_damping=1e-6)
# Masks are wider or narrower by no more [pixel], and their width is varied by this.
_WIDEST, _WIDTH_STEP = 6.0, 0.25
# A pose has six parameters; with the focal length a camera has seven.
_POSE = len(POSE_NAMES)
# What is known beforehand of zeros [rad or m] and the logarithms of lengths, and of the logarithms
# of focal lengths: deviations.
CONSTANT_DEVIATION, FOCAL_DEVIATION = 0.2, 0.1
# And of where an object stands, once it was found [m, rad].
_OBJECT_DEVIATION = 1.0


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is unknown of cameras and of a body.

    Args:
        X_CW: (cameras, 4, 4).
        widths: for each camera (frames,) by how much each silhouette is too wide on all sides
            [pixel]; 0 for frames that did not count.
        log_focal: (cameras,) the logarithms of the focal lengths' growth.
        constants: (k,) added in all frames to some joints' positions [rad or m] and to the
            logarithms of some links' lengths.
    """

    X_CW: Array
    widths: tuple[Array, ...]
    log_focal: Array
    constants: Array


def start_calibration(
    fits: Sequence[CameraFit], X_CW: Sequence[Array], constants: int = 0
) -> Calibration:
    """Cameras at some poses, all else as it is given."""
    return Calibration(
        np.array(X_CW),
        tuple(np.zeros(len(fit.values)) for fit in fits),
        np.zeros(len(fits)),
        np.zeros(constants),
    )


class CalibrationFit:
    """Fits what frames of several cameras share.

    Attributes:
        per_camera: so many unknowns each camera has.
        names: of the shared unknowns: those of each camera, then the constants.

    Args:
        which: for each camera the frames that count.
        constants: (k,) the body's parameters to which an unknown constant is added in all frames:
            values of the pose tree, and lengths.
        focal: whether the cameras' focal lengths are unknown.
    """

    def __init__(
        self,
        fits: Sequence[CameraFit],
        which: Sequence[Indices],
        constants: Sequence[int] = (),
        focal: bool = False,
    ) -> None:
        self.fits, self.which = tuple(fits), tuple(which)
        self.constants = np.array(constants, dtype=np.intp)
        self.per_camera = _POSE + focal
        self.names = (
            *(
                f"{fit.frames.camera.name}.{name}"
                for fit in fits
                for name in CAMERA_NAMES[: self.per_camera]
            ),
            *(self.fits[0].names[k] for k in self.constants),
        )
        cameras = [FOCAL_DEVIATION**-2 * (k == _POSE) for k in range(self.per_camera)] * len(
            self.fits
        )
        known = [
            _OBJECT_DEVIATION if self.fits[0].names[k] in OBJECT_POSITIONS else CONSTANT_DEVIATION
            for k in self.constants
        ]
        self.information = np.array([*cameras, *(one**-2 for one in known)])

    def fit(self, start: Calibration, rounds: Sequence[AnnealingStage]) -> Calibration:
        """Fits all from where it starts."""
        rows = self._rows()
        count = 1 + len(self.names)
        lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
        lower[0], upper[0] = -_WIDEST, _WIDEST
        widths = np.array([start.widths[c][k] for c, k in rows]).reshape(-1, 1)
        evaluate = partial(self.equations, start)
        found = minimise(evaluate, widths, np.zeros(count - 1), (lower, upper), rounds, _STEPS)
        now = self._moved(start, found.shared)
        fitted = [np.zeros(len(fit.values)) for fit in self.fits]
        for (c, k), width in zip(rows, found.own[:, 0], strict=True):
            fitted[c][k] = width
        return Calibration(now.X_CW, tuple(fitted), now.log_focal, now.constants)

    def equations(
        self, start: Calibration, own: Array, shared: Array, step: AnnealingStage
    ) -> Equations:
        """The normal equations, what is known beforehand in those of the first frame.

        Args:
            start: from where the unknowns count.
            own: (frames that count, 1) their widths [pixel].
            shared: (u,) what is shared.
        """
        now = self._moved(start, shared)
        parts = [
            self._equations(now, c, k, float(width), step)
            for (c, k), width in zip(self._rows(), own[:, 0], strict=True)
        ]
        H, g, costs = (list(part) for part in zip(*parts, strict=True))
        off = self._off(now)
        H[0][1:, 1:] += np.diag(self.information)
        g[0][1:] += self.information * off
        known = float(self.information @ off**2)
        return Equations(np.array(H), np.array(g), float(sum(costs)) + known)

    def _rows(self) -> list[tuple[int, int]]:
        """Camera and frame of all that counts."""
        return [(c, int(k)) for c, frames in enumerate(self.which) for k in frames]

    def bend(self, found: Calibration, by: Array, step: AnnealingStage) -> tuple[float, float]:
        """How much the cost bends upwards as what is shared moves by (u,), by slopes and by H."""
        less, more = (self._moved(found, sign * by) for sign in (-1.0, 1.0))
        bends, said = 0.0, 0.0
        for c, k in self._rows():
            width = float(found.widths[c][k])
            said += float(by @ self._equations(found, c, k, width, step)[0][1:, 1:] @ by)
            slopes = [self._equations(one, c, k, width, step)[1][1:] for one in (less, more)]
            bends += 0.5 * float(by @ (slopes[1] - slopes[0]))
        return bends, said

    def motions(self, now: Calibration, camera: int, dense: Array) -> Array:
        """(nodes, u, 12) the affine motions that the shared unknowns give to the nodes.

        dense: (nodes, n, 12) those that the body's parameters give.
        """
        fit = self.fits[camera]
        found = np.zeros((len(dense), len(self.names), 12))
        own = fit.motions(now.X_CW[camera], now.log_focal[camera])
        first = camera * self.per_camera
        found[:, first : first + self.per_camera] = own[: self.per_camera]
        found[:, len(self.fits) * self.per_camera :] = dense[:, self.constants]
        return found

    def values(self, now: Calibration, camera: int, frame: int) -> Array:
        """(n,) the body's parameters in a frame, constants added."""
        values = self.fits[camera].values[frame].copy()
        values[self.constants] += now.constants
        return values

    def _moved(self, start: Calibration, by: Array) -> Calibration:
        cameras = by[: len(self.fits) * self.per_camera].reshape(len(self.fits), self.per_camera)
        poses = [
            fit.moved(X_CW, part[:_POSE])
            for fit, X_CW, part in zip(self.fits, start.X_CW, cameras, strict=True)
        ]
        focal = start.log_focal + (cameras[:, _POSE] if self.per_camera > _POSE else 0.0)
        constants = start.constants + by[cameras.size :]
        return Calibration(np.array(poses), start.widths, focal, constants)

    def _off(self, now: Calibration) -> Array:
        """(u,) how far the shared unknowns are from what is known beforehand."""
        cameras = np.zeros((len(self.fits), self.per_camera))
        if self.per_camera > _POSE:
            cameras[:, _POSE] = now.log_focal
        return np.concatenate([cameras.ravel(), now.constants])

    def compare(
        self, now: Calibration, camera: int, frame: int, width: float, step: AnnealingStage
    ) -> Comparison:
        """A frame's contours compared with its silhouette, which is too wide by a width."""
        values, focal = self.values(now, camera, frame), float(now.log_focal[camera])
        return self.fits[camera].compare(now.X_CW[camera], frame, step, width, values, focal)

    def _equations(
        self, now: Calibration, camera: int, frame: int, width: float, step: AnnealingStage
    ) -> tuple[Array, Array, float]:
        """H, g and cost of a frame: its width first, then what is shared.

        What follows the width is told by differences: edges that are shifted along their normals.
        """
        less, here, more = (
            self.compare(now, camera, frame, width + off, step)
            for off in (-_WIDTH_STEP, 0.0, _WIDTH_STEP)
        )
        motions = self.motions(
            now, camera, here.placement.dense(len(self.fits[camera].values[frame]))
        )
        A = np.tril(here.A[0]) + np.swapaxes(np.tril(here.A[0], -1), -1, -2)
        count = 1 + len(self.names)
        H, g = np.empty((count, count)), np.empty(count)
        H[1:, 1:] = np.einsum("nux,nxy,nvy->uv", motions, A, motions, optimize=True)
        g[1:] = -np.einsum("nux,nx->u", motions, here.b[0])
        g[0] = (_sum(more, COST) - _sum(less, COST)) / (4.0 * _WIDTH_STEP)
        H[0, 0] = _sum(here, WEIGHT)
        pulled = np.einsum("nux,nx->u", motions, less.b[0] - more.b[0])
        H[0, 1:] = H[1:, 0] = pulled / (2.0 * _WIDTH_STEP)
        return H, g, _sum(here, COST)


def _sum(compared: Comparison, column: int) -> float:
    return float(compared.sums[..., column].sum())


def inlier_ratios(fit: CalibrationFit, found: Calibration, camera: int = 0) -> Array:
    """(frames,) of both contours' lengths, what fits in each frame of a camera."""
    return np.array(
        [
            fit.compare(found, camera, k, float(width), TOLD_APART).inlier_ratio
            for k, width in enumerate(found.widths[camera])
        ]
    )


def agreeing(ratios: Array) -> NDArray[np.bool_]:
    """(frames,) which frames fit nearly as well as the two that fit best."""
    return np.asarray(ratios >= _AGREES * np.sort(ratios)[-2:].mean())
