"""Where a person is in a camera's picture, as a Drake system, and who gives it its images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, DiagramBuilder, InputPort, System
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.arrays import Mask, Picture
from drake_pose.camera.models import Camera
from drake_pose.errors import CameraError, SettingsError
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.segmentation.background import Background, person_region
from drake_pose.systems.images import colour_image_to_picture
from drake_pose.systems.ports import PortedSystem


class PersonRegion(PortedSystem):
    """Finds the person's region in one camera's picture.

    .. pydrake_system::

        name: PersonRegion
        input_ports: [color_image, label_image]
        output_ports: [region]

    The region, a mask (H, W), is that of ``label_image``, where not connected that of the
    background model; None where the image that tells it is unconnected or has no pixels: then the
    camera gave no picture at that moment.

    Attributes:
        wanted: the inputs that tell the region.

    Args:
        background: what it sees when nobody is there; None where ``label_image`` is connected.

    Raises:
        SettingsError: the background's size is not the camera's. When evaluated: there is neither a
            background nor a label image.
        CameraError: when evaluated: an image has another size than the camera's.
    """

    def __init__(self, camera: Camera, background: Background | None = None) -> None:
        super().__init__()
        size = camera.width, camera.height
        if background is not None and background.mean.shape[1::-1] != size:
            width, height = background.mean.shape[1::-1]
            raise SettingsError(
                f"camera '{camera.name}' has {size[0]} x {size[1]} pixels (width x height), but "
                f"its background {width} x {height}"
            )
        self._camera, self._background = camera, background
        self.wanted: tuple[str, ...] = ("label_image",) if background is None else ("color_image",)
        self.add_input("color_image", ImageRgba8U(*size))
        self.add_input("label_image", ImageLabel16I(*size))
        self.picture = self.add_cache("picture", self._picture)
        self.region = self.add_output("region", None, self._region)

    def _picture(self, context: Context) -> Picture | None:
        """The picture (H, W, 3); None while the camera has stopped."""
        image = self.given(context, "color_image")
        if image is None or not image.size():
            return None
        picture = colour_image_to_picture(image)
        self._require_size(picture, "color image")
        return picture

    def _region(self, context: Context) -> Mask | None:
        """Where the person is (H, W); None while the camera has stopped."""
        image = self.given(context, "label_image")
        if image is not None:
            if not image.size():
                return None
            mask = label_image_to_mask(image)
            self._require_size(mask, "label image")
            return mask
        image = self.given(context, "color_image")
        if image is None or not image.size():
            return None
        self._require_size(image.data, "color image")
        if self._background is None:
            raise SettingsError(
                f"camera '{self._camera.name}': nothing tells the person from what is behind; give "
                "a background model or connect label_image"
            )
        # Most of it is not looked at: it is copied without its fourth channel piece by piece.
        return person_region(image.data, self._background)

    def _require_size(self, image: NDArray[np.generic], kind: str) -> None:
        camera = self._camera
        if image.shape[:2] != (camera.height, camera.width):
            raise CameraError(
                f"camera '{camera.name}': its {kind} has {image.shape[1]} x {image.shape[0]} "
                f"pixels (width x height), but it was calibrated with {camera.width} x "
                f"{camera.height}"
            )


def connect_images(
    builder: DiagramBuilder, source: System | None, wanted: Mapping[str, Sequence[InputPort]]
) -> None:
    """Connects images by the names of a source's outputs, or as inputs of the diagram.

    Raises SettingsError where the source lacks one.
    """
    for name, ports in wanted.items():
        if source is None:
            builder.ExportInput(ports[0], name)
            for port in ports[1:]:
                builder.ConnectInput(name, port)
            continue
        if not source.HasOutputPort(name):
            kind, camera = name[:11], name[12:]
            background = " (or a background in the setup)" if kind == "label_image" else ""
            known = [source.get_output_port(k).get_name() for k in range(source.num_output_ports())]
            raise SettingsError(
                f"camera '{camera}': the source needs an output port {name}{background}; it has: "
                + ", ".join(known)
            )
        for port in ports:
            builder.Connect(source.GetOutputPort(name), port)
