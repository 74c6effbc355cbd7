"""What cameras elsewhere say of the person, as a Drake system."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context

from drake_pose.camera import Camera
from drake_pose.camera.frame_sources import FrameSource
from drake_pose.multiview.view_packing import unpack_view
from drake_pose.systems.picture_capture import PictureCapture

# A recorded camera's views are read so many ahead of its slowest neighbour's.
_AHEAD = 8


class RemoteEyes(PictureCapture):
    """Gives the synchronised views of cameras whose pictures stay on other machines.

    .. pydrake_system::

        name: RemoteEyes
        output_ports:
        - silhouette_<camera>
        - time
        - fresh

    As PictureCapture, but its sources deliver packed views (bytes (n,) of pack_view) in place of
    pictures, and its outputs are what SilhouetteEye gives: a SilhouetteView, or None where the
    camera gave no picture at that moment.
    """

    def _declare_outputs(self, cameras: Mapping[str, Camera]) -> None:
        ticket = {self.discrete_state_ticket(self._state)}
        for name in self._sources:
            self.DeclareAbstractOutputPort(
                f"silhouette_{name}",
                lambda: AbstractValue.Make(None),
                self._calc_silhouette(name),
                ticket,
            )
        self.DeclareVectorOutputPort("time", 1, self._calc_time, ticket)
        self.DeclareVectorOutputPort("fresh", 1, self._calc_fresh, ticket)

    def overdue(self, camera: str) -> float:
        """The time stamp up to which a camera's pictures come too late [s]."""
        return -np.inf if self.moment is None else self._origins[camera] + self.moment.time

    def _feed(self, name: str, source: FrameSource, now: float) -> None:
        """Hands on the views of a camera that are due; one that is silent is waited for."""
        while self.live or self._synchroniser.waiting(name) < _AHEAD:
            one = self._pending[name]
            if one is None:
                one = self._pending[name] = source.read()
            if one is None:
                # A recording has waited long enough itself.
                if source.ended or not self.live:
                    self._synchroniser.finish(name)
                return
            if one.time - self._origins[name] > now:
                return
            self._synchroniser.add(name, one.time - self._origins[name], one)
            self._pending[name] = None

    def _calc_silhouette(self, name: str) -> Callable[[Context, AbstractValue], None]:
        def calc(context: Context, output: AbstractValue) -> None:
            packed = self._picture(name)
            output.set_value(None if packed is None else unpack_view(packed.tobytes()))

        return calc
