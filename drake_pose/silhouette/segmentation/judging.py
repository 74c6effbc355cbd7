"""Whether a mask can be that of one object, whatever it came from."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

# A second patch of this fraction of the largest one's area may be another object.
_SECOND = 0.25
# Beyond this fraction of the picture no surroundings are seen.
_FULL = 0.98
# Of the picture's border; an object that is cut off covers less of it, the background more.
_BORDER = 0.6


def refuse_mask(mask: Mask) -> str:
    """Why a mask (H, W) cannot be used: it is empty or full; "" where it can."""
    if not mask.any():
        return "the object is not found: the mask is empty"
    if mask.mean() >= _FULL:
        return "the mask fills the picture: nothing tells the object from the rest"
    return ""


def doubt_mask(mask: Mask) -> list[str]:
    """Why a mask (H, W) that is not empty may show something else."""
    warnings = []
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()
    if border > _BORDER:
        warnings.append(
            f"the mask covers {border:.0%} of the picture's border: is it the background?"
        )
    _, _, statistics, middles = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    areas = statistics[1:, cv2.CC_STAT_AREA]
    first, second = [*np.argsort(-areas, kind="stable"), 0][:2]
    if len(areas) > 1 and areas[second] > _SECOND * areas[first]:
        (x0, y0), (x1, y1) = np.rint(middles[[1 + first, 1 + second]]).astype(int)
        warnings.append(
            f"there are two patches, of {areas[first]} pixels about ({x0}, {y0}) and of "
            f"{areas[second]} about ({x1}, {y1}): two objects? --largest keeps the larger one"
        )
    return warnings


def largest_patch(mask: Mask) -> Mask:
    """The largest connected patch of a mask (H, W); what is empty stays so."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    if count <= 2:
        return mask
    return np.asarray(labels == 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA])))
