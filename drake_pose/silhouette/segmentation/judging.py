"""Whether a mask can be that of one object, whatever it came from."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

# A second patch of so much of the largest one's area may be another object.
_SECOND = 0.25
# Beyond so much of the picture there is no surrounding to be seen.
_FULL = 0.98
# Of the picture's border; an object that is cut off covers less of it, the background more.
_BORDER = 0.6


class Judgement(NamedTuple):
    """What is wrong with a mask.

    Attributes:
        refusal: why it cannot be used; "" where it can.
        warnings: what its user should look at.
    """

    refusal: str = ""
    warnings: tuple[str, ...] = ()


def judge_mask(mask: Mask) -> Judgement:
    """Refuses a mask (H, W) that is empty or full; warns of one that may show something else."""
    area = int(np.count_nonzero(mask))
    if area == 0:
        return Judgement("the object is not found: the mask is empty")
    if area >= _FULL * mask.size:
        return Judgement("the mask fills the picture: nothing tells the object from the rest")
    warnings = []
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    if border.mean() > _BORDER:
        warnings.append(
            f"the mask covers {border.mean():.0%} of the picture's border: is it the background?"
        )
    _, _, statistics, middles = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    order = 1 + np.argsort(-statistics[1:, cv2.CC_STAT_AREA], kind="stable")
    if len(order) > 1:
        sizes = statistics[order[:2], cv2.CC_STAT_AREA]
        if sizes[1] > _SECOND * sizes[0]:
            (x0, y0), (x1, y1) = np.rint(middles[order[:2]]).astype(int)
            warnings.append(
                f"there are two patches, of {sizes[0]} pixels about ({x0}, {y0}) and of {sizes[1]} "
                f"about ({x1}, {y1}): two objects? --largest keeps the larger one"
            )
    return Judgement("", tuple(warnings))


def largest_patch(mask: Mask) -> Mask:
    """The largest connected patch of a mask (H, W); what is empty stays so."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    if count <= 2:
        return mask
    return np.asarray(labels == 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA])))
