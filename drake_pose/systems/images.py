"""Pictures to and from Drake's colour images, and recorded masks as a Drake system.

An image without pixels (0 x 0) means that a camera has no picture.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.arrays import Array, Picture
from drake_pose.camera.models import Camera, camera_tuple
from drake_pose.errors import UnknownNameError
from drake_pose.silhouette.pictures.label_images import mask_to_label_image
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.ports import PortedSystem, camera_port


def picture_to_colour_image(picture: Picture | None) -> ImageRgba8U:
    """Return a picture (H, W, 3), red, green, blue, as ImageRgba8U; None: one without pixels."""
    if picture is None:
        return ImageRgba8U()
    image = ImageRgba8U()
    fill_colour_image(image, picture)
    return image


def fill_colour_image(image: ImageRgba8U, picture: Picture) -> None:
    """Resize an ImageRgba8U to a picture (H, W, 3), red, green, blue, and copy it."""
    image.resize(picture.shape[1], picture.shape[0])
    cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA, dst=image.mutable_data)


def colour_image_to_picture(image: ImageRgba8U) -> Picture:
    """Return the picture (H, W, 3), red, green, blue, of an image; (0, 0, 3) without pixels."""
    if not image.size():
        return np.empty((0, 0, 3), dtype=np.uint8)
    return np.asarray(cv2.cvtColor(image.data, cv2.COLOR_RGBA2RGB))


class ColourPorts:
    """Input ports for the colour images of some of a system's cameras.

    Args:
        system: the system that gets the ports.
        cameras: all cameras of the system.
        wanted: names of the cameras that get a port.
        port: maps a camera to its port's name.

    Attributes:
        cameras: names of the cameras that have a port, in the order of all cameras.

    Raises:
        UnknownNameError: a name in ``wanted`` is no camera's.
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
        """Return the available pictures (H, W, 4) by name of the camera.

        ``context`` is the system's. The pictures are views of the images' writable data, as
        compiled kernels require, and are valid until the context changes.
        """
        images = self._given(context).items()
        return {name: image.mutable_data for name, image in images if image.size()}


DEFAULT_FRAME_RATE_HZ = 1.0
"""Frame rate of a scene that has none, such as stills [Hz]."""


class MaskPlayer(PortedSystem):
    """Plays the masks of a recorded scene as label images.

    .. pydrake_system::

        name: MaskPlayer
        output_ports: [label_image, color_image (of cameras with pictures), measured_positions
          (where given), root_position (where given), frame_index]

    Output ports depend on time alone. Frame k is shown for one period from time k * period on; the
    first and the last frame also before and after. With several cameras, the image ports are
    ``label_image_<camera>`` and ``color_image_<camera>``.

    Output ports:
        label_image (ImageLabel16I): the mask; all background if the camera has no mask of the
            frame, which a matcher ignores.
        color_image (ImageRgba8U): the picture; without pixels if there is none of the frame.
        measured_positions (nq): NaN if not given for the frame [rad or m].
        root_position (3): NaN if not given for the frame [m].
        frame_index (1): index of the frame in ``frames``.

    Args:
        scene: the recorded masks and pictures.
        cameras: the cameras to play, in the order of the output ports.
        frames: names of the frames to play; None: all of the scene's.
        positions: (nq,) [rad or m] by name of the frame, for ``measured_positions``; None: no such
            port.
        root_positions: (3,) [m] by name of the frame, for ``root_position``; None: no such port.

    Attributes:
        frames: names of the frames played.
        period: time between two frames [s].
        color_cameras: names of the cameras that have pictures (``Scene.images``), and so a port.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera] | Mapping[str, Camera],
        frames: Sequence[str] | None = None,
        positions: Mapping[str, Array] | None = None,
        root_positions: Mapping[str, Array] | None = None,
    ) -> None:
        super().__init__()
        cameras = camera_tuple(cameras)
        self._scene = scene
        self.frames = tuple(scene.frames if frames is None else frames)
        self.period = 1.0 / (scene.frame_rate_hz or DEFAULT_FRAME_RATE_HZ)
        self.color_cameras = tuple(
            camera.name
            for camera in cameras
            if any((camera.name, frame) in scene.images for frame in self.frames)
        )
        every = [camera.name for camera in cameras]
        for kind, image, read, names in (
            ("label_image", ImageLabel16I(), self._label_image, every),
            ("color_image", ImageRgba8U(), self._color_image, self.color_cameras),
        ):
            for camera in cameras:
                if camera.name in names:
                    self._play(camera_port(kind, camera, cameras), image, partial(read, camera))
        given = {"measured_positions": positions, "root_position": root_positions}
        for name, values in given.items():
            if values:
                unknown = np.full(len(next(iter(values.values()))), np.nan)
                self._play(name, len(unknown), partial(_value_at, values, unknown))
        self.add_output(
            "frame_index",
            1,
            lambda context: [self.frame_index(context.get_time())],
            {self.time_ticket()},
        )

    def frame_index(self, time: float) -> int:
        """Return the index in ``frames`` of the frame shown at a time [s]."""
        # The offset of 5e-7 periods keeps k * period on frame k in spite of rounding.
        index = int(np.floor(time / self.period + 5e-7))
        return min(max(index, 0), len(self.frames) - 1)

    def _play(self, port: str, model_value: Any, read: Callable[[str], Any]) -> None:
        """Declare an output ``read`` of the shown frame's name; a model value or a size."""
        self.add_output(
            port,
            model_value,
            lambda context: read(self.frames[self.frame_index(context.get_time())]),
            {self.time_ticket()},
        )

    def _label_image(self, camera: Camera, frame: str) -> ImageLabel16I:
        """Return the mask of a frame; all background if there is none."""
        if (camera.name, frame) in self._scene.masks:
            return mask_to_label_image(self._scene.read(camera.name, frame))
        return mask_to_label_image(np.zeros((camera.height, camera.width), dtype=bool))

    def _color_image(self, camera: Camera, frame: str) -> ImageRgba8U:
        """Return the picture of a frame; an image without pixels if there is none."""
        is_there = (camera.name, frame) in self._scene.images
        picture = self._scene.read_image(camera.name, frame) if is_there else None
        return picture_to_colour_image(picture)


def _value_at(values: Mapping[str, Array], unknown: Array, frame: str) -> Array:
    """Return the value of a frame, given values by name of the frame; ``unknown`` without one."""
    return values.get(frame, unknown)
