"""Which further pose of the body would tell camera poses apart that fit equally well."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.posed_frames import placed_points
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.areas.scoring import draw_mask

Array = NDArray[np.float64]

# Silhouettes are compared in pictures about so wide [pixel].
_WIDTH = 160
# A joint without limits is taken to turn once around.
_TURN = np.pi

Corner = tuple[float, float, float]
Box = tuple[Corner, Corner]
"""The least and the largest corner along the world's axes [m]."""


def suggest_pose(
    body: RegistrationBody,
    camera: PinholeCamera,
    X_WC: Sequence[Array],
    keep_out: Sequence[Box] = (),
    *,
    tried: int = 300,
    seed: int = 0,
) -> tuple[Array, float] | None:
    """The pose, of random ones inside the limits, whose silhouettes differ most.

    Args:
        X_WC: the camera's poses that are to be told apart, (4, 4) each, two or more.
        keep_out: what the body must not touch; points of its surfaces are asked.

    Returns:
        its values (m,) of the pose tree [rad or m], and of the two camera poses that it tells apart
        least the area in which their silhouettes differ, over the mean area of both; None where no
        pose was found that is seen from all camera poses and touches nothing.
    """
    generator, kinematics = np.random.default_rng(seed), body.kinematics
    lower = np.where(np.isfinite(kinematics.lower), kinematics.lower, -_TURN)
    upper = np.where(np.isfinite(kinematics.upper), kinematics.upper, _TURN)
    share = min(1.0, _WIDTH / camera.width)
    size = (max(1, round(share * camera.width)), max(1, round(share * camera.height)))
    cameras = [camera.with_pose(one).resized(*size) for one in X_WC]
    best: tuple[Array, float] | None = None
    for _ in range(tried):
        values = generator.uniform(lower, upper)
        X_WN = kinematics.poses(values)
        points = placed_points(body.very_few, X_WN)
        if any(np.all((points >= low) & (points <= high), axis=1).any() for low, high in keep_out):
            continue
        masks = [draw_mask(body.very_few, one.X_CW @ X_WN, one) for one in cameras]
        if not all(mask.any() for mask in masks):
            continue
        difference = min(
            2.0 * np.count_nonzero(a != b) / (np.count_nonzero(a) + np.count_nonzero(b))
            for a, b in combinations(masks, 2)
        )
        if best is None or difference > best[1]:
            best = values, float(difference)
    return best
