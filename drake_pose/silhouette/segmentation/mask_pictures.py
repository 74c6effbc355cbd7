"""Masks of other tools in pictures: classes in a palette, transparency, probabilities."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drake_pose.arrays import Mask
from drake_pose.camera.models import LARGEST_SIDE
from drake_pose.camera.picture_files import read_picture_file
from drake_pose.errors import MaskError

Layer = NDArray[np.integer]

PixelMeaning = Literal["auto", "classes", "alpha", "probability"]

ALL = "all"
"""Stands for every class but the background."""

# A grey picture that has no more values, and is no mask, may hold classes as well.
_FEW_VALUES = 16
# More classes than this are not listed.
_LISTED = 10


def read_mask_picture(
    path: Path, meaning: PixelMeaning = "auto", classes: Sequence[str] = ()
) -> Mask:
    """Reads where an object is from a PNG or JPEG picture that another tool wrote.

    - ``classes``: a palette's index, or a grey value of 8 or 16 bits, is the pixel's class; 0 is
      the background.
    - ``alpha``: the object is where the picture is not transparent, from one half on.
    - ``probability``: of a grey picture of 8 or 16 bits; the object is where it is one half or more
      of the largest value that such a picture can have.
    - ``auto``: a palette has classes; an alpha channel that is not the same everywhere tells the
      object; a grey picture of two values is a mask, and so is a colour picture of black and one
      other colour; a grey picture of many values has probabilities. What may be either is refused.

    Args:
        classes: the numbers of the classes that are the object; ``all``: each but 0. Where none is
            given, the only class that there is.

    Returns:
        (H, W), which may be empty.

    Raises:
        MaskError: names the file; when it cannot be read, or is not of this kind.
    """
    picture = _open(path)
    if meaning == "auto":
        meaning = _guess(picture, path, classes)
    if meaning == "alpha":
        alpha = _alpha(picture)
        if alpha is None:
            raise MaskError(
                f"{path}: has no alpha channel that tells an object from its surroundings"
            )
        return np.asarray(alpha >= 128)
    layer = _single_layer(picture, path)
    if meaning == "probability":
        if picture.mode == "P":
            raise MaskError(f"{path}: has a palette, so its pixels are classes, not probabilities")
        return np.asarray(layer > np.iinfo(layer.dtype).max // 2)
    return _select_classes(layer, path, classes)


def mask_of_video_picture(picture: NDArray[np.uint8], where: str) -> Mask:
    """The mask (H, W) in a video's picture (H, W, 3): what is light.

    Raises MaskError, which names the picture by ``where``: much is neither dark nor light.
    """
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    between = float(((grey > 64) & (grey < 192)).mean())
    if between > 0.1:
        raise MaskError(
            f"{where}: {between:.0%} of it is neither dark nor light: no mask but a picture; say "
            "how its object is to be found"
        )
    return np.asarray(grey >= 128)


def _open(path: Path) -> Image.Image:
    data = read_picture_file(path, MaskError)
    try:
        picture = Image.open(io.BytesIO(data))
        if max(picture.size) > LARGEST_SIDE:
            raise MaskError(f"{path}: has more than {LARGEST_SIDE} pixels a side")
        picture.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise MaskError(f"{path}: not a whole PNG or JPEG picture") from error
    return picture


def _guess(picture: Image.Image, path: Path, classes: Sequence[str]) -> PixelMeaning:
    if picture.mode == "P" or classes:
        return "classes"
    if _alpha(picture) is not None:
        return "alpha"
    values = np.unique(_single_layer(picture, path))
    if picture.format == "JPEG":
        return "probability"
    if len(values) <= 2 and values[0] == 0:
        return "classes"
    if len(values) <= _FEW_VALUES:
        raise MaskError(
            f"{path}: its {len(values)} grey values, {_listed(values)}, may be classes or "
            "probabilities; name the object's class (--class), or say --pixels probability"
        )
    return "probability"


def _alpha(picture: Image.Image) -> Layer | None:
    """The alpha channel (H, W) of 8 bits; None where there is none, or it says nothing."""
    if picture.mode not in ("LA", "RGBA", "PA") and "transparency" not in picture.info:
        return None
    alpha = np.asarray(picture.convert("RGBA"))[:, :, 3]
    return alpha if np.ptp(alpha) > 0 else None


def _single_layer(picture: Image.Image, path: Path) -> Layer:
    """The one value (H, W) of each pixel, of 8 or 16 bits."""
    layers = np.asarray(picture)
    if layers.ndim == 2:
        # Pillow reads grey pictures of 16 bits as 32, too.
        return layers.astype(np.uint8 if layers.dtype in (np.uint8, np.bool_) else np.uint16)
    colours = layers[:, :, : 1 if picture.mode in ("LA", "PA") else 3]
    if (colours == colours[:, :, :1]).all():
        return np.asarray(colours[:, :, 0])
    first = colours[tuple(np.argwhere(colours.any(axis=2))[0])]
    inside = (colours == first).all(axis=2)
    if (inside | ~colours.any(axis=2)).all():
        return inside.astype(np.uint8)
    raise MaskError(
        f"{path}: is a colour picture, but a mask has a palette, grey values, an alpha channel, or "
        "black and one colour; where it is a photograph, say how its object is to be found"
    )


def _select_classes(layer: Layer, path: Path, classes: Sequence[str]) -> Mask:
    """Where the pixel's class is one of those."""
    present = np.unique(layer[layer > 0])
    if not classes and len(present) > 1:
        raise MaskError(
            f"{path}: has the classes {_listed(present)}; say which are the object: "
            f"--class {present[0]}, or --class all"
        )
    if not classes or ALL in classes:
        return np.asarray(layer > 0)
    for name in classes:
        if not name.isdecimal():
            raise MaskError(
                f"{path}: its classes are numbers ({_listed(present)}), not names: '{name}'"
            )
    return np.isin(layer, [int(name) for name in classes])


def _listed(values: NDArray[np.integer]) -> str:
    """A few numbers."""
    some = ", ".join(str(value) for value in values[:_LISTED])
    return f"{some} and more" if len(values) > _LISTED else some or "none"
