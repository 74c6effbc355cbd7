"""A person captured by all silhouettes at once as ready diagrams: pictures in, poses out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.trajectories import Trajectory

from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.views import EDGE_POINTS
from drake_pose.silhouette.segmentation.background import Background
from drake_pose.systems.bodies.posed_geometry import add_avatar
from drake_pose.systems.person.person_tracker import PersonTracker
from drake_pose.systems.person.silhouette_sensor import SilhouetteSensor
from drake_pose.systems.pictures.camera_rig import build_camera_rig
from drake_pose.systems.pictures.picture_capture import CameraCount, PictureCapture
from drake_pose.systems.staged_diagram import StagedDiagram


class SensorPorts(NamedTuple):
    """By camera the port of a SilhouetteView or None, and that of the pictures' time stamp [s]."""

    silhouettes: Mapping[str, OutputPort]
    time: OutputPort


class LiveSensors(Protocol):
    """The sensors of all cameras, here (LocalSensors) or elsewhere, looked at each period [s].

    Attributes:
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
        backgrounds: of the cameras whose sources do not deliver masks.
    """

    def __init__(
        self,
        capture: PictureCapture,
        cameras: Mapping[str, Camera],
        backgrounds: Mapping[str, Background],
    ) -> None:
        self.capture = capture
        self.period, self.live = capture.period, capture.live
        self._cameras, self._backgrounds = cameras, backgrounds

    @property
    def skipped(self) -> int:
        """How many moments were not shown, as newer ones had come."""
        return self.capture.skipped

    def add(self, builder: DiagramBuilder) -> SensorPorts:
        """Adds the systems that see to a diagram under construction."""
        builder.AddNamedSystem("picture_capture", self.capture)
        sensors = _add_sensors(builder, self._cameras, self._backgrounds)
        for name, sensor in sensors.items():
            image = f"{sensor.get_input_port().get_name()}_{name}"
            builder.Connect(self.capture.GetOutputPort(image), sensor.get_input_port())
        silhouettes = {k: sensor.GetOutputPort("silhouette") for k, sensor in sensors.items()}
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


def _add_sensors(
    builder: DiagramBuilder,
    cameras: Mapping[str, Camera],
    backgrounds: Mapping[str, Background],
    edge_points: float = EDGE_POINTS,
) -> dict[str, SilhouetteSensor]:
    return {
        name: builder.AddNamedSystem(
            f"sensor_{name}", SilhouetteSensor(camera, backgrounds.get(name), edge_points)
        )
        for name, camera in cameras.items()
    }


def add_person_tracker(
    builder: DiagramBuilder,
    tracker: PersonPoseTracker,
    cameras: Mapping[str, Camera],
    silhouettes: Mapping[str, OutputPort],
    period: float,
    time: OutputPort | None = None,
    meshcat: Meshcat | None = None,
    with_deviations: bool = False,
) -> PersonTracker:
    """Add what follows a person with sensors.

    Args:
        cameras: two calibrated cameras or more.
        period: time between two looks at the sensors [s].
        time: the pictures' time stamp; None: every period brings new pictures.
        with_deviations: whether the positions' standard deviations are an output.

    Raises:
        SettingsError: fewer than two cameras, or a period that is not positive.
    """
    system = PersonTracker(tracker, list(cameras.values()), period, with_deviations)
    builder.AddNamedSystem("person_tracker", system)
    for name, port in silhouettes.items():
        builder.Connect(port, system.GetInputPort(f"silhouette_{name}"))
    if time is not None:
        builder.Connect(time, system.GetInputPort("time"))
    if meshcat is not None:
        positions = system.GetOutputPort("last_positions")
        add_avatar(builder, tracker.fit.tree.model, positions, meshcat, "avatar", period)
    return system


def _export_outputs(builder: DiagramBuilder, system: PersonTracker) -> None:
    for index in range(system.num_output_ports()):
        port = system.get_output_port(index)
        builder.ExportOutput(port, port.get_name())


def build_live_capture(
    tracker: PersonPoseTracker,
    cameras: Mapping[str, Camera],
    sensors: LiveSensors,
    meshcat: Meshcat | None = None,
    with_deviations: bool = False,
) -> Diagram:
    """Cameras' pictures, or what workers elsewhere make of them, to a person's poses.

    The diagram's outputs are those of PersonTracker, and ``silhouette_<camera>``, its inputs; the
    arguments but the sensors are those of add_person_tracker.

    Raises:
        SettingsError: fewer than two cameras, or a period that is not positive.
    """
    builder = DiagramBuilder()
    ports = sensors.add(builder)
    system = add_person_tracker(
        builder,
        tracker,
        cameras,
        ports.silhouettes,
        sensors.period,
        ports.time,
        meshcat,
        with_deviations,
    )
    for name, port in ports.silhouettes.items():
        builder.ExportOutput(port, f"silhouette_{name}")
    _export_outputs(builder, system)
    return builder.Build()


@dataclass(frozen=True, eq=False)
class SilhouetteCapture(StagedDiagram):
    """A diagram of the capture. person: keeps what one frame hands to the next."""

    person: PersonTracker


def build_silhouette_capture(
    tracker: PersonPoseTracker,
    cameras: Mapping[str, Camera],
    backgrounds: Mapping[str, Background],
    period: float = 1.0 / 30.0,
    edge_points: float = EDGE_POINTS,
) -> SilhouetteCapture:
    """Wire the cameras' images to their sensors, and these to what follows the person.

    The diagram's inputs are ``color_image_<camera>``, its outputs those of PersonTracker, and its
    stages ``region`` and ``edge``.

    Args:
        backgrounds: of all cameras, two or more.
        period: time between two frames [s].
        edge_points: a picture's height over the spacing of the edge points.

    Raises:
        SettingsError: fewer than two cameras, one without a background, or a period that is not
            positive.
    """
    for name in cameras:
        if name not in backgrounds:
            raise SettingsError(
                f"camera '{name}' has no background: give one for each of {', '.join(cameras)}"
            )
    builder = DiagramBuilder()
    sensors = _add_sensors(builder, cameras, backgrounds, edge_points)
    for name, sensor in sensors.items():
        builder.ExportInput(sensor.get_input_port(), f"color_image_{name}")
    edges = {name: sensor.GetOutputPort("silhouette") for name, sensor in sensors.items()}
    person = add_person_tracker(builder, tracker, cameras, edges, period)
    _export_outputs(builder, person)
    regions = tuple(sensor.GetOutputPort("region") for sensor in sensors.values())
    stages = {"region": regions, "edge": tuple(edges.values())}
    return SilhouetteCapture(builder.Build(), stages, person)


def build_person_capture(
    model: ArticulatedModel,
    cameras: Mapping[str, PinholeCamera],
    true_positions: Trajectory,
    period: float = 1.0 / 30.0,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """A simulated person, the cameras around it, what follows it, and the avatar in the browser.

    The diagram's outputs are ``estimated_positions`` and ``share``.

    Args:
        model: the person, with landmarks.yaml beside its file.
        cameras: two or more.
        true_positions: the person's positions (nq,) over time.
        period: time between two frames [s].

    Raises:
        SettingsError: fewer than two cameras, or a period that is not positive.
        ModelError: the model has no landmarks of trunk, arms and legs.
    """
    builder = DiagramBuilder()
    rig = builder.AddNamedSystem(
        "camera_rig", build_camera_rig(model, cameras, true_positions).diagram
    )
    sensors = _add_sensors(builder, cameras, {})
    for name, sensor in sensors.items():
        builder.Connect(rig.GetOutputPort(f"label_image_{name}"), sensor.get_input_port())
    edges = {name: sensor.GetOutputPort("silhouette") for name, sensor in sensors.items()}
    tracker = PersonPoseTracker(ContourFit(model.pose_tree()))
    system = add_person_tracker(builder, tracker, cameras, edges, period, meshcat=meshcat)
    for name in ("estimated_positions", "share"):
        builder.ExportOutput(system.GetOutputPort(name), name)
    return builder.Build()
