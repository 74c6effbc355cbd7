"""A person captured live: cameras' pictures in, poses out, the sensors here or elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort

from drake_pose.camera.models import Camera
from drake_pose.person.recordings.person_capture import EDGE_POINTS
from drake_pose.person.silhouette_tracker import SilhouetteTracker
from drake_pose.silhouette.segmentation.background import Background
from drake_pose.systems.bodies.posed_geometry import add_avatar
from drake_pose.systems.person.person_tracker import PersonTracker
from drake_pose.systems.person.silhouette_sensor import SilhouetteSensor
from drake_pose.systems.pictures.picture_capture import CameraCount, PictureCapture


class SensorPorts(NamedTuple):
    """What the sensors of all cameras give, wherever they are.

    Attributes:
        silhouettes: by camera, the port of a SilhouetteView or None.
        time: the port of the pictures' time stamp (1) [s].
    """

    silhouettes: Mapping[str, OutputPort]
    time: OutputPort


class LiveSensors(Protocol):
    """The sensors of all cameras: here, as LocalSensors, or on other machines.

    Attributes:
        period: time between two looks at the cameras [s].
        live: whether the pictures come by the computer's clock; else by the simulation's time.
    """

    period: float
    live: bool

    @property
    def skipped(self) -> int:
        """How many moments were not shown, as newer ones had come."""

    def add(self, builder: DiagramBuilder) -> SensorPorts:
        """Adds the systems that see to a diagram under construction."""

    def take_reports(self) -> list[str]:
        """What the user should know and was not told yet."""

    def counts(self) -> dict[str, CameraCount]:
        """How each camera did so far."""

    def close(self) -> None:
        """Lets go of files, cameras and workers."""


class LocalSensors:
    """Sensors in this process: a PictureCapture, and a SilhouetteSensor each; see LiveSensors.

    Args:
        capture: gives the pictures.
        cameras: the calibrated cameras.
        backgrounds: of the cameras whose sources do not deliver masks.
        edge_points: a picture's height over the spacing of the edge points.
    """

    def __init__(
        self,
        capture: PictureCapture,
        cameras: Mapping[str, Camera],
        backgrounds: Mapping[str, Background],
        edge_points: float = EDGE_POINTS,
    ) -> None:
        self.capture = capture
        self.period, self.live = capture.period, capture.live
        self._cameras, self._backgrounds = cameras, backgrounds
        self._edge_points = edge_points

    @property
    def skipped(self) -> int:
        """How many moments were not shown, as newer ones had come."""
        return self.capture.skipped

    def add(self, builder: DiagramBuilder) -> SensorPorts:
        """Adds the systems that see to a diagram under construction."""
        builder.AddNamedSystem("picture_capture", self.capture)
        silhouettes = {}
        for name, camera in self._cameras.items():
            background = self._backgrounds.get(name)
            sensor = SilhouetteSensor(camera, background, self._edge_points)
            builder.AddNamedSystem(f"sensor_{name}", sensor)
            port = f"{'label' if background is None else 'color'}_image_{name}"
            builder.Connect(self.capture.GetOutputPort(port), sensor.get_input_port())
            silhouettes[name] = sensor.GetOutputPort("silhouette")
        return SensorPorts(silhouettes, self.capture.GetOutputPort("time"))

    def take_reports(self) -> list[str]:
        """What the user should know and was not told yet."""
        return self.capture.take_reports()

    def counts(self) -> dict[str, CameraCount]:
        """How each camera did so far."""
        return self.capture.counts()

    def close(self) -> None:
        """Lets go of files and cameras."""
        self.capture.close()


def add_person_tracker(
    builder: DiagramBuilder,
    tracker: SilhouetteTracker,
    cameras: Mapping[str, Camera],
    sensors: SensorPorts,
    period: float,
    with_deviations: bool = False,
) -> PersonTracker:
    """Add what follows a person with sensors.

    Args:
        builder: the diagram under construction.
        tracker: made for the person's pose tree.
        cameras: two calibrated cameras or more.
        sensors: what LiveSensors.add gave.
        period: time between two looks at the sensors [s].
        with_deviations: whether the positions' standard deviations are an output.

    Raises:
        SettingsError: fewer than two cameras, or a period that is not positive.
    """
    system = PersonTracker(tracker, list(cameras.values()), period, with_deviations)
    builder.AddNamedSystem("person_tracker", system)
    for name, port in sensors.silhouettes.items():
        builder.Connect(port, system.GetInputPort(f"silhouette_{name}"))
    builder.Connect(sensors.time, system.GetInputPort("time"))
    return system


def build_live_capture(
    tracker: SilhouetteTracker,
    cameras: Mapping[str, Camera],
    sensors: LiveSensors,
    meshcat: Meshcat | None = None,
    with_deviations: bool = False,
) -> Diagram:
    """Cameras' pictures, or what workers elsewhere make of them, to a person's poses.

    The diagram's outputs are those of PersonTracker: ``estimated_positions``, ``last_positions``,
    ``share``, ``time``, ``seen``, ``others``, and where wanted ``deviations``; and
    ``silhouette_<camera>``, its inputs.

    Args:
        tracker: made for the person's pose tree.
        cameras: two calibrated cameras or more.
        sensors: those of the cameras, here or elsewhere.
        meshcat: where the avatar is shown; None: nowhere.
        with_deviations: whether the positions' standard deviations are an output.

    Raises:
        SettingsError: fewer than two cameras, or a period that is not positive.
    """
    builder = DiagramBuilder()
    ports = sensors.add(builder)
    system = add_person_tracker(builder, tracker, cameras, ports, sensors.period, with_deviations)
    for name, port in ports.silhouettes.items():
        builder.ExportOutput(port, f"silhouette_{name}")
    for index in range(system.num_output_ports()):
        port = system.get_output_port(index)
        builder.ExportOutput(port, port.get_name())
    if meshcat is not None:
        positions = system.GetOutputPort("last_positions")
        model = tracker.fit.tree.model
        add_avatar(builder, model, positions, meshcat, "avatar", sensors.period)
    return builder.Build()
