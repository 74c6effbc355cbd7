"""One camera's share of following a person: the edge of the person's region."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.camera.models import Camera
from drake_pose.person.recordings.person_capture import EDGE_POINTS
from drake_pose.person.silhouette_view import SilhouetteView, see_silhouette
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.segmentation.background import Background, person_region
from drake_pose.systems.colour_images import colour_image_to_picture

# The edge of a person's region is longer than this share of the picture's height.
_LEAST_EDGE = 0.15


def edge_spacing(camera: Camera, edge_points: float = EDGE_POINTS) -> float:
    """From edge point to edge point in a camera's pictures [pixel]."""
    return max(2.0, camera.height / edge_points)


def shows_somebody(view: SilhouetteView | None) -> bool:
    """Whether a view has more to show than a speck: to search a person in specks takes seconds."""
    if view is None:
        return False
    return bool(view.edge_length >= _LEAST_EDGE * view.height)


class SilhouetteSensor(LeafSystem):
    """What one camera's picture says of the person.

    .. pydrake_system::

        name: SilhouetteSensor
        input_ports:
        - label_image
        output_ports:
        - region
        - silhouette

    With a background the input port is ``color_image`` instead. The outputs are abstract: the
    person's region (H, W), and a SilhouetteView of it; None where the port is not connected or the
    image has no pixels: then the camera gave no picture at that moment.

    Args:
        camera: the camera.
        background: what it sees of the empty room; None: the input is a label image.
        edge_points: the picture's height over the spacing of the edge points.
    """

    def __init__(
        self,
        camera: Camera,
        background: Background | None = None,
        edge_points: float = EDGE_POINTS,
    ) -> None:
        super().__init__()
        self._background = background
        self._spacing = edge_spacing(camera, edge_points)
        if background is None:
            name, image = "label_image", ImageLabel16I(camera.width, camera.height)
        else:
            name, image = "color_image", ImageRgba8U(camera.width, camera.height)
        self._image = self.DeclareAbstractInputPort(name, AbstractValue.Make(image))
        self._region = self.DeclareAbstractOutputPort(
            "region", _allocate, self._calc_region, {self._image.ticket()}
        )
        self.DeclareAbstractOutputPort(
            "silhouette", _allocate, self._calc_silhouette, {self._image.ticket()}
        )

    def _calc_region(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._person(context))

    def _calc_silhouette(self, context: Context, output: AbstractValue) -> None:
        region = self._region.Eval(context)
        output.set_value(None if region is None else see_silhouette(region, self._spacing))

    def _person(self, context: Context) -> NDArray[np.bool_] | None:
        if not self._image.HasValue(context):
            return None
        image = self._image.Eval(context)
        if image.size() == 0:
            return None
        if self._background is None:
            return label_image_to_mask(image)
        return person_region(colour_image_to_picture(image), self._background)


def _allocate() -> AbstractValue:
    return AbstractValue.Make(None)
