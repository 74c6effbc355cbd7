"""One camera's share of following a person, here or on another machine, as Drake systems."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DependencyTicket, LeafSystem
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.camera.models import Camera
from drake_pose.camera.sources.frame_source import FrameSource
from drake_pose.fit.camera_sums import EdgeKeeper
from drake_pose.person.views import (
    EDGE_POINTS,
    KeptEdge,
    edge_spacing,
    see_silhouette,
    unpack_view,
)
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.segmentation.background import Background, person_region
from drake_pose.systems.colour_images import colour_image_to_picture
from drake_pose.systems.pictures.picture_capture import PictureCapture


class SilhouetteSensor(LeafSystem):
    """What one camera's picture says of the person.

    .. pydrake_system::

        name: SilhouetteSensor
        input_ports: [label_image]
        output_ports: [region, silhouette]

    With a background the input port is ``color_image`` instead. The outputs are abstract: the
    person's region (H, W), and a SilhouetteView of it; None where the port is not connected or the
    image has no pixels: then the camera gave no picture at that moment.

    Args:
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
        tickets = {self._image.ticket()}
        self._region = self.DeclareAbstractOutputPort(
            "region", _allocate, self._calc_region, tickets
        )
        self.DeclareAbstractOutputPort("silhouette", _allocate, self._calc_silhouette, tickets)

    def _calc_region(self, context: Context, output: AbstractValue) -> None:
        image = self._image.Eval(context) if self._image.HasValue(context) else None
        if image is None or image.size() == 0:
            output.set_value(None)
        elif self._background is None:
            output.set_value(label_image_to_mask(image))
        else:
            output.set_value(person_region(colour_image_to_picture(image), self._background))

    def _calc_silhouette(self, context: Context, output: AbstractValue) -> None:
        region = self._region.Eval(context)
        output.set_value(None if region is None else see_silhouette(region, self._spacing))


class RemoteSensors(PictureCapture):
    """Gives the synchronised views of cameras whose pictures stay on other machines.

    .. pydrake_system::

        name: RemoteSensors
        output_ports: [silhouette_<camera>, time, fresh]

    As PictureCapture, but its sources deliver packed views (bytes (n,) of pack_view) in place of
    pictures, and its outputs are what SilhouetteSensor gives: a SilhouetteView, or None where the
    camera gave no picture at that moment.

    Args:
        sources: where each camera's packed views come from, opened.
        keepers: by camera, who has the edges of its pictures and compares contours with them; the
            process itself does where nobody has.
        others: the further arguments of PictureCapture.
    """

    def __init__(
        self,
        sources: Mapping[str, FrameSource],
        cameras: Mapping[str, Camera],
        *,
        keepers: Mapping[str, EdgeKeeper] | None = None,
        **others: Any,
    ) -> None:
        super().__init__(sources, cameras, **others)
        self._keepers = dict(keepers or {})

    def _declare_outputs(
        self, cameras: Mapping[str, Camera], ticket: set[DependencyTicket]
    ) -> None:
        for name in self._sources:
            self.DeclareAbstractOutputPort(
                f"silhouette_{name}", _allocate, self._calc_silhouette(name), ticket
            )

    def overdue(self, camera: str) -> float:
        """The time stamp up to which a camera's pictures come too late [s]."""
        return -np.inf if self.moment is None else self._origins[camera] + self.moment.time

    def _feed(self, name: str, source: FrameSource, now: float) -> None:
        """Hands on the views of a camera that are due; one that is silent is waited for."""
        self._feed_due(name, source, now)

    def _calc_silhouette(self, name: str) -> Callable[[Context, AbstractValue], None]:
        def calc(context: Context, output: AbstractValue) -> None:
            one = None if self.moment is None else self.moment.items.get(name)
            if one is None:
                output.set_value(None)
                return
            keeper = self._keepers.get(name)
            kept = None if keeper is None else KeptEdge(keeper, name, one.time)
            output.set_value(unpack_view(one.picture.tobytes(), kept))

        return calc


def _allocate() -> AbstractValue:
    return AbstractValue.Make(None)
