"""Pictures to and from Drake's colour images.

A camera that has nothing to show gives an image of no pixels: a port of images cannot be silent.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import cv2
import numpy as np
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageRgba8U

from drake_pose.arrays import Picture
from drake_pose.camera.models import Camera
from drake_pose.errors import UnknownNameError
from drake_pose.systems.ports import PortedSystem


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


class ColourPorts:
    """The input ports for colour images of some of a system's cameras.

    Attributes:
        cameras: the names of the cameras that have a port.

    Args:
        wanted: the names of these cameras; UnknownNameError: one is no camera's.
        port: the name of a camera's port.
    """

    def __init__(
        self,
        system: PortedSystem,
        cameras: Sequence[Camera],
        wanted: Collection[str],
        port: Callable[[Camera], str],
    ) -> None:
        known = {camera.name: camera for camera in cameras}
        for name in wanted:
            if name not in known:
                raise UnknownNameError("camera", name, known, "color_cameras")
        self.cameras = tuple(name for name in known if name in wanted)
        self._given = system.add_camera_inputs(
            {name: port(known[name]) for name in self.cameras},
            lambda name: ImageRgba8U(known[name].width, known[name].height),
        )

    def pictures(self, context: Context) -> dict[str, Picture]:
        """The pictures (H, W, 4) that are there, by camera: valid until the context changes.

        They are the images' own, as kernels take them, which are for arrays that can be written.
        """
        images = self._given(context).items()
        return {name: image.mutable_data for name, image in images if image.size()}
