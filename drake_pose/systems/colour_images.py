"""Pictures to and from Drake's colour images.

A camera that has nothing to show gives an image of no pixels: a port of images cannot be silent.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.sensors import ImageRgba8U

Picture = NDArray[np.uint8]


def picture_to_colour_image(picture: Picture | None) -> ImageRgba8U:
    """A picture (H, W, 3) in red, green, blue as a colour image; None becomes one of no pixels."""
    if picture is None:
        return ImageRgba8U()
    image = ImageRgba8U()
    fill_colour_image(image, picture)
    return image


def fill_colour_image(image: ImageRgba8U, picture: Picture) -> None:
    """Makes a colour image that of a picture (H, W, 3) in red, green, blue, in its size."""
    image.resize(picture.shape[1], picture.shape[0])
    cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA, dst=image.mutable_data)


def colour_image_to_picture(image: ImageRgba8U) -> Picture:
    """Returns the picture (H, W, 3) in red, green, blue of a colour image; (0, 0, 3): no pixels."""
    if not image.size():
        return np.empty((0, 0, 3), dtype=np.uint8)
    return np.asarray(cv2.cvtColor(image.data, cv2.COLOR_RGBA2RGB))
