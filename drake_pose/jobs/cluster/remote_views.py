"""The sensors of a live capture on workers: each opens the sources of its cameras itself."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import Context, DependencyTicket, DiagramBuilder, OutputPort

from drake_pose.camera.models import Camera
from drake_pose.camera.sources.frame_source import Clock, FrameSource
from drake_pose.jobs.cluster.camera_groups import WatchedSource, Watchers
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.person.views import KeptEdge, SilhouetteView, edge_spacing, unpack_view
from drake_pose.systems.person.live_capture import LiveSensors

if TYPE_CHECKING:
    from distributed import Client


class ClusterSensors(LiveSensors):
    """Gives the synchronised views of cameras that workers look through, each its own group.

    .. pydrake_system::

        name: ClusterSensors
        output_ports: [silhouette_<camera>, time, fresh]

    A worker says in a few kilobytes what its cameras see, and adds up what they say of a pose, as
    often as a fit asks. A worker that dies costs the others nothing; another one, or itself when it
    was started again, goes on with its cameras.

    Args:
        live: whether the computer's clock decides; where not given, if a camera is live.
        tolerance: how far apart the pictures of one moment may be [s].
        clock: the one of live cameras' time stamps; machines share none but that of the day.

    Raises:
        SceneError: a source cannot be opened.
        SettingsError: the tolerance cannot be.
        ClusterError: there is no worker, or they do not get ready.
    """

    def __init__(
        self,
        client: Client,
        scene: LiveScene,
        live: bool | None = None,
        tolerance: float | None = None,
        clock: Clock = time.time,
    ) -> None:
        given = scene.specifications
        spacings = {name: edge_spacing(camera) for name, camera in scene.cameras.items()}
        by_clock = any(one.live for one in given.values()) if live is None else live
        self.watchers = Watchers(client, list(given.values()), spacings, waits=not by_clock)
        groups = {name: group for group in self.watchers.groups for name in group.specifications}
        self._keepers = {name: group.keeper for name, group in groups.items()}
        sources = {
            name: WatchedSource(one, groups[name], self.watchers) for name, one in given.items()
        }
        super().__init__(sources, scene.cameras, {}, live=live, tolerance=tolerance, clock=clock)
        if self.live:
            self.watchers.overdue = self._overdue

    def add(self, builder: DiagramBuilder) -> dict[str, OutputPort]:
        """Adds itself to a diagram; by camera the port of a view or None."""
        builder.AddNamedSystem("remote_sensors", self)
        return {
            name: self.GetOutputPort(f"silhouette_{name}")
            for group in self.watchers.groups
            for name in group.specifications
        }

    def take_reports(self) -> list[str]:
        """What the user should know and was not told yet."""
        reports, self.watchers.reports = self.watchers.reports, []
        return reports + super().take_reports()

    def close(self) -> None:
        """Lets go of the cameras."""
        self.watchers.close()

    def _declare_outputs(self, cameras: Mapping[str, Camera], ticket: DependencyTicket) -> None:
        for name in self._sources:
            self.add_output(f"silhouette_{name}", None, partial(self._view, name), {ticket})

    def _overdue(self, camera: str) -> float:
        """The time stamp up to which a camera's pictures come too late [s]."""
        return -np.inf if self.moment is None else self._origins[camera] + self.moment.time

    def _feed(self, name: str, source: FrameSource, now: float) -> None:
        """Hands on the views of a camera that are due; one that is silent is waited for."""
        self._feed_due(name, source, now)

    def _view(self, name: str, _: Context) -> SilhouetteView | None:
        one = None if self.moment is None else self.moment.items.get(name)
        if one is None:
            return None
        return unpack_view(one.picture.tobytes(), KeptEdge(self._keepers[name], name, one.time))
