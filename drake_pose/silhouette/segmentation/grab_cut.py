"""An object in a still, told by a box: GrabCut (Rother et al., SIGGRAPH 2004)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Mask, Picture
from drake_pose.errors import SettingsError

# GrabCut draws its first clusters at random.
_SEED = 1


def cut_box(picture: Picture, box: Sequence[float]) -> Mask:
    """The object (H, W) in a picture (H, W, 3) and a box x, y, width, height [pixel] around it.

    Raises SettingsError where the box lies outside the picture, or is all of it.
    """
    height, width = picture.shape[:2]
    x, y, w, h = box
    left, right = (int(np.clip(np.rint(value), 0, width)) for value in (x, x + w))
    top, bottom = (int(np.clip(np.rint(value), 0, height)) for value in (y, y + h))
    if right - left < 2 or bottom - top < 2:
        raise SettingsError(
            f"the box {x:g},{y:g},{w:g},{h:g} (x, y, width, height) lies outside the picture, "
            f"{width} x {height} pixels"
        )
    if (right - left, bottom - top) == (width, height):
        raise SettingsError("the box is the whole picture: leave some of the surroundings out")
    labels = np.full((height, width), cv2.GC_BGD, dtype=np.uint8)
    labels[top:bottom, left:right] = cv2.GC_PR_FGD
    return cut(picture, labels)


def cut(picture: Picture, labels: NDArray[np.uint8], iterations: int = 6) -> Mask:
    """The object (H, W) by the labels (H, W) of OpenCV's GrabCut, which are left as they are."""
    found = labels.copy()
    if np.isin(labels, (cv2.GC_PR_FGD, cv2.GC_PR_BGD)).any():
        cv2.setRNGSeed(_SEED)
        colours = np.zeros((1, 65)), np.zeros((1, 65))
        nowhere = (0, 0, 0, 0)
        picture = np.ascontiguousarray(picture)
        cv2.grabCut(picture, found, nowhere, *colours, iterations, cv2.GC_INIT_WITH_MASK)
    return np.asarray((found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD))
