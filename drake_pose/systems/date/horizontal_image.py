"""One camera's share of the paper's capture (Date et al., 3.1.1) as a Drake system."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem, ValueProducer
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.camera.models import Camera
from drake_pose.errors import CameraError, SettingsError
from drake_pose.person.date.capture import see_person
from drake_pose.person.date.skin_blobs import SkinColour
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.segmentation.background import Background, person_region
from drake_pose.systems.colour_images import colour_image_to_picture

Picture = NDArray[np.uint8]


class HorizontalImage(LeafSystem):
    """Finds the person in one camera's picture: region, skin-coloured blobs in it, contour.

    .. pydrake_system::

        name: HorizontalImage
        input_ports:
        - color_image
        - label_image (optional)
        output_ports:
        - region
        - person_view

    The paper's horizontal image processing module. Where ``label_image`` is connected it gives the
    person's region; otherwise the background model does. Outputs: ``region``, a mask (H, W), and
    ``person_view``, a ``person.date.capture.PersonView``; both are None while the camera is lost:
    ``color_image`` is unconnected, or an image of no pixels.

    Args:
        camera: the camera.
        background: what it sees when nobody is there; None where ``label_image`` is connected.
        skin: which colours are skin.

    Raises:
        SettingsError: the background's size is not the camera's. When evaluated: there is neither a
            background nor a label image.
        CameraError: when evaluated: an image has another size than the camera's.
    """

    def __init__(
        self, camera: Camera, background: Background | None = None, skin: SkinColour | None = None
    ) -> None:
        super().__init__()
        size = camera.width, camera.height
        if background is not None and background.mean.shape[1::-1] != size:
            width, height = background.mean.shape[1::-1]
            raise SettingsError(
                f"camera '{camera.name}' has {size[0]} x {size[1]} pixels (width x height), but "
                f"its background {width} x {height}"
            )
        self._camera, self._background, self._skin = camera, background, skin or SkinColour()
        self._color = self.DeclareAbstractInputPort(
            "color_image", AbstractValue.Make(ImageRgba8U(*size))
        )
        self._label = self.DeclareAbstractInputPort(
            "label_image", AbstractValue.Make(ImageLabel16I(*size))
        )
        color, label = self._color.ticket(), self._label.ticket()
        self._picture = self.DeclareCacheEntry(
            "picture", ValueProducer(_allocate, self._calc_picture), {color}
        )
        self._region = self.DeclareAbstractOutputPort(
            "region", _allocate, self._calc_region, {color, label}
        )
        self.DeclareAbstractOutputPort("person_view", _allocate, self._calc_view, {color, label})

    def _calc_picture(self, context: Context, output: AbstractValue) -> None:
        """The picture (H, W, 3); None while the camera has stopped."""
        output.set_value(None)
        if self._color.HasValue(context):
            picture = colour_image_to_picture(self._color.Eval(context))
            if picture.size:
                self._require_size(picture, "color image")
                output.set_value(picture)

    def _calc_region(self, context: Context, output: AbstractValue) -> None:
        picture = self._picture.Eval(context)
        if picture is None:
            output.set_value(None)
        elif self._label.HasValue(context):
            mask = label_image_to_mask(self._label.Eval(context))
            self._require_size(mask, "label image")
            output.set_value(mask)
        elif self._background is not None:
            output.set_value(person_region(picture, self._background))
        else:
            raise SettingsError(
                f"camera '{self._camera.name}': nothing tells the person from what is behind; give "
                "a background model or connect label_image"
            )

    def _calc_view(self, context: Context, output: AbstractValue) -> None:
        picture, region = self._picture.Eval(context), self._region.Eval(context)
        seen = None if picture is None else see_person(picture, region, self._skin)
        output.set_value(seen)

    def _require_size(self, image: NDArray[np.generic], kind: str) -> None:
        camera = self._camera
        if image.shape[:2] != (camera.height, camera.width):
            raise CameraError(
                f"camera '{camera.name}': its {kind} has {image.shape[1]} x {image.shape[0]} "
                f"pixels (width x height), but it was calibrated with {camera.width} x "
                f"{camera.height}"
            )


def _allocate() -> AbstractValue:
    return AbstractValue.Make(None)
