"""What cameras elsewhere say of the person, as a Drake system."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DependencyTicket

from drake_pose.camera.models import Camera
from drake_pose.camera.sources.frame_source import FrameSource
from drake_pose.fit.camera_sums import EdgeKeeper
from drake_pose.person.silhouette_view import KeptEdge
from drake_pose.person.view_packing import unpack_view
from drake_pose.systems.pictures.picture_capture import PictureCapture


class RemoteSensors(PictureCapture):
    """Gives the synchronised views of cameras whose pictures stay on other machines.

    .. pydrake_system::

        name: RemoteSensors
        output_ports:
        - silhouette_<camera>
        - time
        - fresh

    As PictureCapture, but its sources deliver packed views (bytes (n,) of pack_view) in place of
    pictures, and its outputs are what SilhouetteSensor gives: a SilhouetteView, or None where the
    camera gave no picture at that moment.

    Args:
        sources: where each camera's packed views come from, opened.
        cameras: the calibrated cameras.
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
                f"silhouette_{name}",
                lambda: AbstractValue.Make(None),
                self._calc_silhouette(name),
                ticket,
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
