"""A person captured by all silhouettes at once as ready diagrams: pictures in, poses out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort, System
from pydrake.trajectories import Trajectory

from drake_pose.body import ArticulatedModel
from drake_pose.camera.frame_source import FrameSource
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.views import EDGE_POINTS, SilhouetteView, edge_spacing, see_silhouette
from drake_pose.silhouette.segmentation.background import Background
from drake_pose.systems.bodies import add_avatar
from drake_pose.systems.cameras import build_camera_rig
from drake_pose.systems.person.person_tracker import PersonTracker
from drake_pose.systems.picture_capture import PersonRegion, PictureCapture, connect_images
from drake_pose.systems.ports import StagedDiagram, export_outputs


class SilhouetteSensor(PersonRegion):
    """What one camera's picture says of the person.

    .. pydrake_system::

        name: SilhouetteSensor
        input_ports: [color_image, label_image]
        output_ports: [region, silhouette]

    ``silhouette`` is a SilhouetteView of the region (see PersonRegion), or None.

    Args:
        edge_points: the picture's height over the spacing of the edge points.
    """

    def __init__(
        self, camera: Camera, background: Background | None = None, edge_points: float = EDGE_POINTS
    ) -> None:
        super().__init__(camera, background)
        spacing = edge_spacing(camera, edge_points)

        def view(context: Context) -> SilhouetteView | None:
            seen = self.region.Eval(context)
            return None if seen is None else see_silhouette(seen, spacing)

        self.silhouette = self.add_output("silhouette", None, view)


def _add_sensors(
    builder: DiagramBuilder,
    source: System | None,
    cameras: Mapping[str, Camera],
    backgrounds: Mapping[str, Background],
    edge_points: float = EDGE_POINTS,
) -> dict[str, SilhouetteSensor]:
    """A sensor a camera, which gets its images from a source, or from outside."""
    sensors = {
        name: SilhouetteSensor(camera, backgrounds.get(name), edge_points)
        for name, camera in cameras.items()
    }
    for name, sensor in sensors.items():
        builder.AddNamedSystem(f"sensor_{name}", sensor)
        wanted = {f"{kind}_{name}": [sensor.GetInputPort(kind)] for kind in sensor.wanted}
        connect_images(builder, source, wanted)
    return sensors


class LiveSensors(PictureCapture):
    """A PictureCapture and what sees with it, looked at each period: a SilhouetteSensor a camera.

    Args:
        backgrounds: of the cameras whose sources do not deliver masks.
        how: the further arguments of PictureCapture.
    """

    def __init__(
        self,
        sources: Mapping[str, FrameSource],
        cameras: Mapping[str, Camera],
        backgrounds: Mapping[str, Background],
        **how: Any,
    ) -> None:
        super().__init__(sources, cameras, **how)
        self._cameras, self._backgrounds = cameras, backgrounds

    def add(self, builder: DiagramBuilder) -> dict[str, OutputPort]:
        """Adds itself and the sensors to a diagram; by camera the port of a view or None."""
        builder.AddNamedSystem("picture_capture", self)
        sensors = _add_sensors(builder, self, self._cameras, self._backgrounds)
        return {name: sensor.silhouette for name, sensor in sensors.items()}


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


def build_live_capture(
    tracker: PersonPoseTracker,
    cameras: Mapping[str, Camera],
    sensors: LiveSensors,
    with_deviations: bool = False,
) -> Diagram:
    """Cameras' pictures to a person's poses.

    The diagram's outputs are those of PersonTracker, and ``silhouette_<camera>``, its inputs; the
    arguments but the sensors are those of add_person_tracker, as are the errors.
    """
    builder = DiagramBuilder()
    silhouettes = sensors.add(builder)
    for name, port in silhouettes.items():
        builder.ExportOutput(port, f"silhouette_{name}")
    period, time = sensors.period, sensors.GetOutputPort("time")
    person = add_person_tracker(
        builder, tracker, cameras, silhouettes, period, time, with_deviations=with_deviations
    )
    export_outputs(builder, person)
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
    source: System | None = None,
    meshcat: Meshcat | None = None,
) -> SilhouetteCapture:
    """Wire the cameras' images to their sensors, and these to what follows the person.

    The diagram's inputs are ``color_image_<camera>``, its outputs those of PersonTracker, and its
    stages ``region`` and ``edge``.

    Args:
        backgrounds: of all cameras, two or more, unless a source gives label images.
        period: time between two frames [s].
        edge_points: a picture's height over the spacing of the edge points.
        source: what has ``color_image_<camera>``, or ``label_image_<camera>`` of a camera without
            background, in place of the inputs.
        meshcat: where to show the person.

    Raises:
        SettingsError: fewer than two cameras, one without a background, or a period that is not
            positive.
    """
    for name in cameras:
        if source is None and name not in backgrounds:
            raise SettingsError(
                f"camera '{name}' has no background: give one for each of {', '.join(cameras)}"
            )
    builder = DiagramBuilder()
    if source is not None:
        builder.AddNamedSystem("source", source)
    sensors = _add_sensors(builder, source, cameras, backgrounds, edge_points)
    edges = {name: sensor.silhouette for name, sensor in sensors.items()}
    person = add_person_tracker(builder, tracker, cameras, edges, period, meshcat=meshcat)
    export_outputs(builder, person)
    regions = tuple(sensor.region for sensor in sensors.values())
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

    The diagram's outputs are those of PersonTracker.

    Args:
        model: the person, with landmarks.yaml beside its file.
        cameras: two or more.
        true_positions: the person's positions (nq,) over time.
        period: time between two frames [s].

    Raises:
        SettingsError: fewer than two cameras, or a period that is not positive.
        ModelError: the model has no landmarks of trunk, arms and legs.
    """
    rig = build_camera_rig(model, cameras, true_positions).diagram
    tracker = PersonPoseTracker(ContourFit(model.pose_tree()))
    return build_silhouette_capture(
        tracker, cameras, {}, period, source=rig, meshcat=meshcat
    ).diagram
