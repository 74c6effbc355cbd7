"""The sensors of a live capture on workers: each opens the sources of its cameras itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from pydrake.systems.framework import DiagramBuilder

from drake_pose.camera.sources.frame_source import Clock
from drake_pose.jobs.cluster.camera_groups import WatchedSource, Watchers
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.person.views import edge_spacing
from drake_pose.systems.person.live_capture import LocalSensors, SensorPorts
from drake_pose.systems.person.silhouette_sensor import RemoteSensors

if TYPE_CHECKING:
    from distributed import Client


def opener(client: Client, tolerance: float | None = None) -> Callable[[LiveScene], ClusterSensors]:
    """What opens the sensors of a scene on the workers of a cluster."""
    return lambda scene: ClusterSensors(client, scene, tolerance=tolerance)


class ClusterSensors(LocalSensors):
    """Sensors on the workers of a cluster, one worker for each group of cameras; see LiveSensors.

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
        specifications = scene.specifications
        spacings = {name: edge_spacing(camera) for name, camera in scene.cameras.items()}
        by_clock = any(one.live for one in specifications.values()) if live is None else live
        self.watchers = Watchers(
            client, list(specifications.values()), spacings, waits=not by_clock
        )
        groups = {name: group for group in self.watchers.groups for name in group.specifications}
        sources = {
            name: WatchedSource(one, groups[name], self.watchers)
            for name, one in specifications.items()
        }
        keepers = {name: group.keeper for name, group in groups.items()}
        capture = RemoteSensors(
            sources, scene.cameras, keepers=keepers, live=live, tolerance=tolerance, clock=clock
        )
        super().__init__(capture, scene.cameras, {})
        if self.live:
            self.watchers.overdue = capture.overdue

    def add(self, builder: DiagramBuilder) -> SensorPorts:
        """Adds the systems that see to a diagram under construction."""
        builder.AddNamedSystem("remote_sensors", self.capture)
        silhouettes = {
            name: self.capture.GetOutputPort(f"silhouette_{name}")
            for group in self.watchers.groups
            for name in group.specifications
        }
        return SensorPorts(silhouettes, self.capture.GetOutputPort("time"))

    def take_reports(self) -> list[str]:
        """What the user should know and was not told yet."""
        reports, self.watchers.reports = self.watchers.reports, []
        return reports + self.capture.take_reports()

    def close(self) -> None:
        """Lets go of the cameras."""
        self.watchers.close()
