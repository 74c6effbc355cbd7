"""The capture by all silhouettes at once as a ready diagram: pictures in, poses out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pydrake.systems.framework import DiagramBuilder, OutputPort

from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.person.recordings.person_capture import EDGE_POINTS
from drake_pose.person.silhouette_tracker import SilhouetteTracker
from drake_pose.silhouette.segmentation.background import Background
from drake_pose.systems.person.person_tracker import PersonTracker
from drake_pose.systems.person.silhouette_sensor import SilhouetteSensor
from drake_pose.systems.staged_diagram import StagedDiagram


@dataclass(frozen=True, eq=False)
class SilhouetteCapture(StagedDiagram):
    """A diagram of the capture, and what follows the person in it.

    Args:
        person: keeps what one frame hands to the next.
    """

    person: PersonTracker


def build_silhouette_capture(
    tracker: SilhouetteTracker,
    cameras: Mapping[str, Camera],
    backgrounds: Mapping[str, Background],
    period: float = 1.0 / 30.0,
    edge_points: float = EDGE_POINTS,
) -> SilhouetteCapture:
    """Wire the cameras' images to their sensors, and these to what follows the person.

    The diagram's inputs are ``color_image_<camera>``, its outputs those of PersonTracker, and its
    stages ``region`` and ``edge``.

    Args:
        tracker: made for the person's pose tree.
        cameras: two calibrated cameras or more.
        backgrounds: of all cameras.
        period: time between two frames [s].
        edge_points: a picture's height over the spacing of the edge points.

    Raises:
        SettingsError: fewer than two cameras, one without a background, or a period that is not
            positive.
    """
    builder = DiagramBuilder()
    person = PersonTracker(tracker, list(cameras.values()), period)
    builder.AddNamedSystem("person_tracker", person)
    stages: dict[str, list[OutputPort]] = {"region": [], "edge": []}
    for name, camera in cameras.items():
        if name not in backgrounds:
            raise SettingsError(
                f"camera '{name}' has no background: give one for each of {', '.join(cameras)}"
            )
        sensor = SilhouetteSensor(camera, backgrounds[name], edge_points)
        builder.AddNamedSystem(f"sensor_{name}", sensor)
        builder.ExportInput(sensor.get_input_port(), f"color_image_{name}")
        region, silhouette = sensor.GetOutputPort("region"), sensor.GetOutputPort("silhouette")
        builder.Connect(silhouette, person.GetInputPort(f"silhouette_{name}"))
        stages["region"].append(region)
        stages["edge"].append(silhouette)
    for index in range(person.num_output_ports()):
        port = person.get_output_port(index)
        builder.ExportOutput(port, port.get_name())
    named = {stage: tuple(ports) for stage, ports in stages.items()}
    return SilhouetteCapture(builder.Build(), named, person)
