"""An object in a still, told by a box or by strokes: GrabCut (Rother et al., SIGGRAPH 2004)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SettingsError

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Line = Sequence[Sequence[float]]

_ITERATIONS = 6
# GrabCut draws its first clusters at random.
_SEED = 1


@dataclass(frozen=True)
class Strokes:
    """What a user marks in a picture.

    Args:
        box: x, y, width and height [pixel] of a box around the whole object; None: there is none.
        object: lines of points (x, y) [pixel] on the object.
        background: lines beside it.
        width: of the lines [pixel].
    """

    box: tuple[float, ...] | None = None
    object: tuple[Line, ...] = ()
    background: tuple[Line, ...] = ()
    width: float = 5.0


def cut_out(picture: Picture, strokes: Strokes) -> Mask:
    """The object in a picture.

    Args:
        picture: (H, W, 3).
        strokes: what is marked: a box, or a line on the object, or both.

    Returns:
        (H, W).

    Raises:
        SettingsError: nothing is marked as the object, or as its surroundings.
    """
    labels = mark(picture.shape[:2], strokes)
    return cut(picture, labels)


def mark(shape: tuple[int, int], strokes: Strokes) -> NDArray[np.uint8]:
    """The labels (H, W) of OpenCV's GrabCut that strokes stand for.

    Raises:
        SettingsError: nothing is marked as the object, or as its surroundings.
    """
    height, width = shape
    labels = np.full(shape, cv2.GC_PR_BGD, dtype=np.uint8)
    if strokes.box is not None:
        x, y, w, h = strokes.box
        left, right = (int(np.clip(np.rint(value), 0, width)) for value in (x, x + w))
        top, bottom = (int(np.clip(np.rint(value), 0, height)) for value in (y, y + h))
        if right - left < 2 or bottom - top < 2:
            raise SettingsError(
                f"the box {x:g},{y:g},{w:g},{h:g} (x, y, width, height) lies outside the picture, "
                f"{width} x {height} pixels"
            )
        labels[:] = cv2.GC_BGD
        labels[top:bottom, left:right] = cv2.GC_PR_FGD
    thick = max(1, round(strokes.width))
    for lines, label in ((strokes.background, cv2.GC_BGD), (strokes.object, cv2.GC_FGD)):
        for line in lines:
            points = np.rint(np.asarray(line, dtype=np.float64)).astype(np.int32).reshape(-1, 1, 2)
            cv2.polylines(labels, [points], False, int(label), thick)
    is_object = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    if not is_object.any():
        raise SettingsError("nothing is marked as the object: give a box, or a line on it")
    if is_object.all():
        raise SettingsError("the box is the whole picture: leave some of the surroundings out")
    return labels


def cut(picture: Picture, labels: NDArray[np.uint8], iterations: int = _ITERATIONS) -> Mask:
    """The object (H, W) by the labels (H, W) of OpenCV's GrabCut, which are left as they are."""
    if not np.isin(labels, (cv2.GC_PR_FGD, cv2.GC_PR_BGD)).any():
        return np.asarray(labels == cv2.GC_FGD)
    cv2.setRNGSeed(_SEED)
    colours = np.zeros((1, 65)), np.zeros((1, 65))
    picture = np.ascontiguousarray(picture)
    found = labels.copy()
    nowhere = (0, 0, 0, 0)
    cv2.grabCut(picture, found, nowhere, *colours, iterations, cv2.GC_INIT_WITH_MASK)
    return np.asarray((found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD))
