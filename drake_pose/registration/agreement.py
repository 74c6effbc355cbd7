"""Which frames of a camera agree with one another, and which contradict the rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.registration.calibration_fit import Calibration, CalibrationFit

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TOLD_APART = AnnealingStage(0.025, 0.01)
"""At this scale frames are told apart that agree and that contradict."""

# A frame agrees of which this share fits of what fits in the two that fit best.
_AGREES = 0.7


def frame_shares(fit: CalibrationFit, found: Calibration, camera: int = 0) -> Array:
    """(frames,) of both contours' lengths, what fits in each frame of a camera."""
    own = fit.fits[camera]
    return np.array(
        [
            own.compare(
                found.X_CW[camera],
                k,
                TOLD_APART,
                float(width),
                fit.values(found, camera, k),
                float(found.log_focal[camera]),
            ).inlier_ratio
            for k, width in enumerate(found.widths[camera])
        ]
    )


def agreeing(shares: Array) -> Mask:
    """(frames,) which frames fit nearly as well as the two that fit best."""
    return np.asarray(shares >= _AGREES * np.sort(shares)[-2:].mean())
