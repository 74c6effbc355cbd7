"""Input ports of what several cameras saw, any of which may have stopped."""

from __future__ import annotations

from collections.abc import Sequence

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem

from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.person.date.capture import PersonView


class ViewPorts:
    """The input ports ``person_view_<camera>`` of a system.

    Attributes:
        tickets: of all these ports.

    Args:
        system: gets the ports.
        cameras: in the order of the ports.

    Raises:
        SettingsError: fewer than two cameras, or two of one name.
    """

    def __init__(self, system: LeafSystem, cameras: Sequence[Camera]) -> None:
        names = [camera.name for camera in cameras]
        if len(names) < 2 or len(set(names)) != len(names):
            raise SettingsError(f"two or more different cameras are needed, not: {names}")
        self._cameras = tuple(cameras)
        self._ports = [
            system.DeclareAbstractInputPort(f"person_view_{name}", AbstractValue.Make(None))
            for name in names
        ]
        self.tickets = {port.ticket() for port in self._ports}

    def evaluate(self, context: Context) -> tuple[list[Camera], list[PersonView]]:
        """The cameras that go, and what they saw; unconnected ones and None are left out."""
        pairs = [
            (camera, port.Eval(context))
            for camera, port in zip(self._cameras, self._ports, strict=True)
            if port.HasValue(context)
        ]
        seen = [(camera, view) for camera, view in pairs if view is not None]
        return [camera for camera, _ in seen], [view for _, view in seen]
