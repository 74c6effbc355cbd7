"""Whether the zeros of joints are right: constants added to the encoders' readings in all frames.

They are fitted together with the cameras' poses. What turns with the camera, such as the zero of a
first joint whose base looks alike from all sides, cannot be told, and is named instead of guessed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

from drake_pose.camera import PinholeCamera
from drake_pose.errors import RegistrationError, UnknownNameError
from drake_pose.matching.fit.levenberg_marquardt import Round
from drake_pose.registration.agreement import agreeing, frame_shares
from drake_pose.registration.calibration_fit import (
    ZERO_DEVIATION,
    Calibration,
    CalibrationFit,
    start_calibration,
)
from drake_pose.registration.camera_fit import CameraFit
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import RegisteredCamera, RegistrationBody
from drake_pose.registration.uncertainty import calibration_uncertainty, pose_covariance

Array = NDArray[np.float64]

_ROUNDS = (
    *(Round(scale, 0.02) for scale in (0.12, 0.09, 0.07, 0.05, 0.03, 0.02)),
    Round(0.01, 0.01),
    Round(0.005, 0.005, 6),
)
_SPACING = 1.0 / 300.0
_AGAIN = 2
# A zero that is no better known than this share of what it was beforehand is not determined.
_DETERMINED = 0.2
# What a zero goes with is correlated with it by more.
_GOES_WITH = 0.9
# Each picture tells how large errors are by so many motions.
_PICTURE_MOTIONS = 6
_LEVEL = 0.05


@dataclass(frozen=True)
class JointZero:
    """What is added to an encoder's positions.

    Args:
        name: of the position.
        value: what is to be added [rad or m]; 0 where it is not determined.
        deviation: its standard deviation [rad or m]; infinite where it is not determined.
        low, high: the ends of its 95 % interval.
        significant: whether it is not 0: by chance one or more of all that were asked for would
            seem so in one of twenty calibrations.
        gauge: what it cannot be told from; empty where it is determined.
    """

    name: str
    value: float
    deviation: float
    low: float
    high: float
    significant: bool
    gauge: tuple[str, ...] = ()

    @property
    def determined(self) -> bool:
        """Whether the silhouettes tell it."""
        return math.isfinite(self.deviation)


@dataclass(frozen=True, eq=False)
class JointCalibration:
    """Zeros, and the cameras with them.

    Args:
        zeros: of the joints that were asked for.
        cameras: with the poses and focal lengths that fit these zeros.
        covariances: (cameras, 6, 6) of their poses' errors: a rotation vector [rad] and a shift [m]
            in the world.
        focal_deviations: (cameras,) standard deviations of focal lengths, as shares of them; 0
            where they were held.
        gains: (cameras,) by how much the share of the contours that fits grew.
    """

    zeros: tuple[JointZero, ...]
    cameras: tuple[PinholeCamera, ...]
    covariances: Array
    focal_deviations: Array
    gains: Array


def calibrate_joints(
    body: RegistrationBody,
    cameras: Sequence[RegisteredCamera],
    frames: Sequence[Sequence[PosedFrame]],
    names: Sequence[str],
    focal: bool = False,
) -> JointCalibration:
    """The zeros of some joints, fitted together with the cameras' poses.

    Args:
        body: the body.
        cameras: as they were registered with zeros of 0.
        frames: what each of them sees.
        names: of the positions whose zeros are asked for.
        focal: whether the cameras' focal lengths are asked for, too.

    Raises:
        UnknownNameError: a name that is no position of the body's.
        RegistrationError: no camera, or fewer frames than zeros.
    """
    known = body.kinematics.names
    for name in names:
        if name not in known:
            raise UnknownNameError("joint", name, known, str(body.tree.model.path))
    count = sum(len(one) for one in frames)
    if not cameras or count < 2 or count < len(names):
        raise RegistrationError(
            f"{len(names)} joints' zeros need as many frames of differing poses, and two or more; "
            f"there are {count}: give more frames, or name fewer joints"
        )
    fits = [
        CameraFit(PosedFrames(body.kinematics, body.all, one.camera, own), _SPACING)
        for one, own in zip(cameras, frames, strict=True)
    ]
    X_CW = [one.camera.X_CW for one in cameras]
    zeros = [known.index(name) for name in names]
    undetermined: dict[str, JointZero] = {}
    while True:
        fit, found, before = _fit(fits, X_CW, zeros, focal)
        calibration = _describe(fit, found, before)
        open_ones = {one.name: one for one in calibration.zeros if not one.determined}
        if not open_ones:
            break
        # The cameras shall fit what is answered: zeros of 0 where they cannot be told.
        undetermined |= open_ones
        zeros = [k for k in zeros if known[k] not in open_ones]
    told = {one.name: one for one in calibration.zeros} | undetermined
    return replace(calibration, zeros=tuple(told[name] for name in names))


def _fit(
    fits: Sequence[CameraFit], X_CW: Sequence[Array], zeros: Sequence[int], focal: bool
) -> tuple[CalibrationFit, Calibration, list[Array]]:
    """The last fit, what it found, and the shares that fitted before."""
    found = start_calibration(fits, X_CW, len(zeros))
    # Zeros that are off let good frames contradict, so all count at first.
    fit = CalibrationFit(fits, [np.arange(len(one.values)) for one in fits], zeros, focal)
    before = _shares(fit, found)
    for k in range(_AGAIN):
        if k > 0:
            which = [np.flatnonzero(agreeing(one)) for one in _shares(fit, found)]
            fit = CalibrationFit(fits, which, zeros, focal)
        found = fit.fit(found, _ROUNDS)
    return fit, found, before


def _shares(fit: CalibrationFit, found: Calibration) -> list[Array]:
    """For each camera (frames,) what fits."""
    return [frame_shares(fit, found, c) for c in range(len(fit.fits))]


def _describe(fit: CalibrationFit, found: Calibration, before: Sequence[Array]) -> JointCalibration:
    """The zeros with their intervals, and the cameras."""
    covariance = calibration_uncertainty(fit, found).covariance
    first = len(fit.names) - len(fit.zeros)
    pictures = sum(len(which) for which in fit.which)
    freedom = max(1, _PICTURE_MOTIONS * pictures - len(fit.names))
    zeros = [_zero(fit, found, covariance, first + k, freedom) for k in range(len(fit.zeros))]
    cameras, covariances, focal = [], [], np.zeros(len(fit.fits))
    for c, own in enumerate(fit.fits):
        at = slice(c * fit.per_camera, c * fit.per_camera + 6)
        covariances.append(pose_covariance(own, found.X_CW[c], covariance[at, at]))
        cameras.append(own.placed(found.X_CW[c], float(found.log_focal[c])))
        if fit.per_camera > 6:
            focal[c] = math.sqrt(covariance[c * fit.per_camera + 6, c * fit.per_camera + 6])
    after = _shares(fit, found)
    gains = [b.mean() - a.mean() for a, b in zip(before, after, strict=True)]
    return JointCalibration(
        tuple(zeros), tuple(cameras), np.array(covariances), focal, np.array(gains)
    )


def _zero(
    fit: CalibrationFit, found: Calibration, covariance: Array, index: int, freedom: int
) -> JointZero:
    """One zero, its interval, and what it goes with where that is all."""
    k = index - (len(fit.names) - len(fit.zeros))
    name, deviation = fit.names[index], math.sqrt(covariance[index, index])
    if deviation > _DETERMINED * ZERO_DEVIATION:
        along = covariance[:, index] / np.sqrt(np.diag(covariance)) / deviation
        gauge = [n for j, n in enumerate(fit.names) if j != index and abs(along[j]) > _GOES_WITH]
        return JointZero(name, 0.0, math.inf, -math.inf, math.inf, False, tuple(gauge))
    value = float(found.zeros[k])
    width = float(stdtrit(freedom, 1.0 - 0.5 * _LEVEL)) * deviation
    chance = 2.0 * float(stdtr(freedom, -abs(value) / deviation)) * len(fit.zeros)
    return JointZero(name, value, deviation, value - width, value + width, chance < _LEVEL)
