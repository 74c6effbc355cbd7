"""Which pose of an arm or leg would fill what nothing else explains in the pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.compiled import compiled
from drake_pose.silhouette.areas.outline import Outline
from drake_pose.silhouette.areas.scoring import draw_mask

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Worth = NDArray[np.int8]


def worth_of_pixels(
    cameras: Sequence[Camera],
    regions: Sequence[Mask],
    outlines: Sequence[Outline],
    X_WN: Array,
) -> list[Worth]:
    """What it is worth to show a limb in each pixel (H, W), by camera.

    1 in the person's region where the other parts do not show, 0 where they do, -1 outside.

    Args:
        cameras: the cameras; one that sees nobody has no say.
        regions: (H, W) the person.
        outlines: the other parts' surfaces.
        X_WN: (n, 4, 4) their poses.
    """
    found = []
    for camera, region in zip(cameras, regions, strict=True):
        worth = np.zeros(region.shape, dtype=np.int8)
        if region.any():
            worth[:] = np.where(region, 1, -1)
            worth[region & draw_mask(outlines, camera.X_CW @ X_WN, camera)] = 0
        found.append(worth)
    return found


def score_limb_placements(
    samples: Array, weights: Array, cameras: Sequence[Camera], worth: Sequence[Worth]
) -> Array:
    """How well limb poses fill what is unexplained.

    Args:
        samples: (n, m, 3) points along each limb pose in the world [m].
        weights: (n, m) what each point counts.
        cameras: the cameras.
        worth: from worth_of_pixels.

    Returns:
        (n,) the points' worth, weighed, mean over the cameras; out of the picture it is 0.
    """
    total = np.zeros(len(samples))
    for camera, values in zip(cameras, worth, strict=True):
        total += _score(
            samples, weights, camera.kernel_parameters(), np.ascontiguousarray(camera.X_CW), values
        )
    return total / len(cameras)


@compiled
def _score(samples: Array, weights: Array, camera: Array, X_CW: Array, worth: Worth) -> Array:
    """score_limb_placements for one camera."""
    height, width = worth.shape
    scores, p = np.zeros(samples.shape[0]), np.empty(3)
    for n in range(samples.shape[0]):
        for m in range(samples.shape[1]):
            for r in range(3):
                p[r] = X_CW[r, 3]
                for c in range(3):
                    p[r] += X_CW[r, c] * samples[n, m, c]
            depth = p[2] if camera[0] == 0.0 else 1.0
            if depth <= 0.0 or depth < camera[5]:
                continue
            column = int(np.floor(camera[1] * p[0] / depth + camera[3] + 0.5))
            row = int(np.floor(camera[2] * p[1] / depth + camera[4] + 0.5))
            if 0 <= row < height and 0 <= column < width:
                scores[n] += weights[n, m] * worth[row, column]
    return scores
