"""Recorded masks as a Drake system."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.camera.models import Camera
from drake_pose.silhouette.pictures.label_images import mask_to_label_image
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.colour_images import picture_to_colour_image
from drake_pose.systems.estimators.silhouette_matcher import camera_port

DEFAULT_FRAME_RATE_HZ = 1.0
"""Where a scene says nothing, as stills do."""


class MaskPlayer(LeafSystem):
    """Plays the masks of a recorded scene as label images.

    .. pydrake_system::

        name: MaskPlayer
        output_ports: [label_image, color_image (of cameras with pictures), measured_positions
          (where they are given), frame_index]

    With several cameras the output ports are ``label_image_<camera>``. Frame k is shown from k
    periods on for one period; before the first and after the last, the nearest one. Where a camera
    has no mask of a frame, its image is all background, which a matcher leaves out.

    Args:
        cameras: the cameras to play, in the order of the output ports.
        frames: the frames to play; all of the scene's where not given.
        period: time between two frames [s]; by the scene's frame rate where not given.
        positions: (nq,) by frame, given out as ``measured_positions``; NaN in other frames.

    Attributes:
        color_cameras: the names of the cameras that have pictures (``Scene.images``) and so a port
            ``color_image_<camera>``, or ``color_image`` if there is one camera. An image of no
            pixels is given out where there is no picture.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        frames: Sequence[str] | None = None,
        period: float | None = None,
        positions: Mapping[str, NDArray[np.float64]] | None = None,
    ) -> None:
        super().__init__()
        self._scene = scene
        self.frames = tuple(scene.frames if frames is None else frames)
        rate = scene.frame_rate_hz or DEFAULT_FRAME_RATE_HZ
        self.period = 1.0 / rate if period is None else period
        for camera in cameras:
            image = ImageLabel16I(camera.width, camera.height)
            self.DeclareAbstractOutputPort(
                camera_port("label_image", camera, cameras),
                lambda image=image: AbstractValue.Make(image),
                self._calc_label_image(camera),
                {self.time_ticket()},
            )
        self.color_cameras = tuple(
            camera.name
            for camera in cameras
            if any((camera.name, frame) in scene.images for frame in self.frames)
        )
        for camera in cameras:
            if camera.name in self.color_cameras:
                self.DeclareAbstractOutputPort(
                    camera_port("color_image", camera, cameras),
                    lambda: AbstractValue.Make(ImageRgba8U()),
                    self._calc_color_image(camera),
                    {self.time_ticket()},
                )
        if positions:
            self._declare_positions(positions)
        self.DeclareVectorOutputPort("frame_index", 1, self._calc_frame_index, {self.time_ticket()})

    def frame_index(self, time: float) -> int:
        """Which of ``frames`` is shown at a time [s]."""
        # Half a millionth of a period keeps k * period on frame k in spite of rounding.
        index = int(np.floor(time / self.period + 5e-7))
        return min(max(index, 0), len(self.frames) - 1)

    def _calc_label_image(self, camera: Camera) -> Callable[[Context, AbstractValue], None]:
        def calc(context: Context, output: AbstractValue) -> None:
            frame = self.frames[self.frame_index(context.get_time())]
            if (camera.name, frame) in self._scene.masks:
                mask = self._scene.read(camera.name, frame)
            else:
                mask = np.zeros((camera.height, camera.width), dtype=bool)
            output.set_value(mask_to_label_image(mask))

        return calc

    def _calc_color_image(self, camera: Camera) -> Callable[[Context, AbstractValue], None]:
        def calc(context: Context, output: AbstractValue) -> None:
            frame = self.frames[self.frame_index(context.get_time())]
            picture = None
            if (camera.name, frame) in self._scene.images:
                picture = self._scene.read_image(camera.name, frame)
            output.set_value(picture_to_colour_image(picture))

        return calc

    def _declare_positions(self, positions: Mapping[str, NDArray[np.float64]]) -> None:
        """The port of positions that are known in some frames."""
        unknown = np.full(len(next(iter(positions.values()))), np.nan)

        def calc(context: Context, output: BasicVector) -> None:
            frame = self.frames[self.frame_index(context.get_time())]
            output.SetFromVector(positions.get(frame, unknown))

        self.DeclareVectorOutputPort("measured_positions", len(unknown), calc, {self.time_ticket()})

    def _calc_frame_index(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self.frame_index(context.get_time())])
