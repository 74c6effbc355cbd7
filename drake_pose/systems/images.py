"""Pictures to and from Drake's colour images, and recorded masks as a Drake system.

A camera that has nothing to show gives an image of no pixels: a port of images cannot be silent.
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


DEFAULT_FRAME_RATE_HZ = 1.0
"""Where a scene says nothing, as stills do."""


class MaskPlayer(PortedSystem):
    """Plays the masks of a recorded scene as label images.

    .. pydrake_system::

        name: MaskPlayer
        output_ports: [label_image, color_image (of cameras with pictures), measured_positions
          (where they are given), root_position (where it is given), frame_index]

    With several cameras the output ports are ``label_image_<camera>``. Frame k is shown from k
    periods on for one period; before the first and after the last, the nearest one. Where a camera
    has no mask of a frame, its image is all background, which a matcher leaves out.

    Args:
        cameras: the cameras to play, in the order of the output ports.
        frames: the frames to play; all of the scene's where not given.
        positions: (nq,) by frame, given out as ``measured_positions``; NaN in other frames.
        root_positions: (3,) by frame [m], given out as ``root_position``; NaN in other frames.

    Attributes:
        period: time between two frames [s], by the scene's frame rate.
        color_cameras: the names of the cameras that have pictures (``Scene.images``) and so a port
            ``color_image_<camera>``, or ``color_image`` if there is one camera. An image of no
            pixels is given out where there is no picture.
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
                self._play(name, len(unknown), partial(_known, values, unknown))
        self.add_output(
            "frame_index",
            1,
            lambda context: [self.frame_index(context.get_time())],
            {self.time_ticket()},
        )

    def frame_index(self, time: float) -> int:
        """Which of ``frames`` is shown at a time [s]."""
        # Half a millionth of a period keeps k * period on frame k in spite of rounding.
        index = int(np.floor(time / self.period + 5e-7))
        return min(max(index, 0), len(self.frames) - 1)

    def _play(self, port: str, like: Any, read: Callable[[str], Any]) -> None:
        """An output of what a function says of the frame that is shown."""
        self.add_output(
            port,
            like,
            lambda context: read(self.frames[self.frame_index(context.get_time())]),
            {self.time_ticket()},
        )

    def _label_image(self, camera: Camera, frame: str) -> ImageLabel16I:
        if (camera.name, frame) in self._scene.masks:
            return mask_to_label_image(self._scene.read(camera.name, frame))
        return mask_to_label_image(np.zeros((camera.height, camera.width), dtype=bool))

    def _color_image(self, camera: Camera, frame: str) -> ImageRgba8U:
        is_there = (camera.name, frame) in self._scene.images
        picture = self._scene.read_image(camera.name, frame) if is_there else None
        return picture_to_colour_image(picture)


def _known(values: Mapping[str, Array], unknown: Array, frame: str) -> Array:
    return values.get(frame, unknown)
