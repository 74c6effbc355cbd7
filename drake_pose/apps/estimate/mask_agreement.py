"""How a frame's silhouettes and the body that was found agree, camera by camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class MaskAgreement:
    """How a frame's silhouettes and body agree.

    Args:
        E_total: the area where they differ over the silhouettes' area; NaN without a silhouette.
        ious: by camera, intersection over union.
    """

    E_total: float
    ious: Mapping[str, float]


def compare_masks(
    masks: Mapping[str, np.ndarray], bodies: Mapping[str, np.ndarray]
) -> MaskAgreement:
    """Compares masks (H, W) bool with the body's, both by camera."""
    wrong, area = 0, 0
    ious: dict[str, float] = {}
    for camera, mask in masks.items():
        either = int(np.count_nonzero(mask | bodies[camera]))
        both = int(np.count_nonzero(mask & bodies[camera]))
        wrong, area = wrong + either - both, area + int(np.count_nonzero(mask))
        ious[camera] = both / either if either else 1.0
    return MaskAgreement(wrong / area if area else float("nan"), ious)
