"""A person captured by all silhouettes at once as ready diagrams: pictures in, poses out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U
from pydrake.trajectories import Trajectory

from drake_pose.arrays import Mask
from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.camera.sources.frame_source import FrameSource
from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.views import EDGE_POINTS, SilhouetteView, edge_spacing, see_silhouette
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.segmentation.background import Background, person_region
from drake_pose.systems.bodies.posed_geometry import add_avatar
from drake_pose.systems.colour_images import colour_image_to_picture
from drake_pose.systems.person.person_tracker import PersonTracker
from drake_pose.systems.pictures.camera_rig import build_camera_rig
from drake_pose.systems.pictures.picture_capture import PictureCapture
from drake_pose.systems.ports import PortedSystem, StagedDiagram, export_outputs


class SilhouetteSensor(PortedSystem):
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
        spacing, size = edge_spacing(camera, edge_points), (camera.width, camera.height)
        if background is None:
            port = self.add_input("label_image", ImageLabel16I(*size))
        else:
            port = self.add_input("color_image", ImageRgba8U(*size))

        def see(context: Context) -> Mask | None:
            image = self.given(context, port.get_name())
            if image is None or image.size() == 0:
                return None
            if background is None:
                return label_image_to_mask(image)
            return person_region(colour_image_to_picture(image), background)

        region = self.add_output("region", None, see)

        def view(context: Context) -> SilhouetteView | None:
            seen = region.Eval(context)
            return None if seen is None else see_silhouette(seen, spacing)

        self.add_output("silhouette", None, view)


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
        sensors = _add_sensors(builder, self._cameras, self._backgrounds)
        for name, sensor in sensors.items():
            image = f"{sensor.get_input_port().get_name()}_{name}"
            builder.Connect(self.GetOutputPort(image), sensor.get_input_port())
        return {name: sensor.GetOutputPort("silhouette") for name, sensor in sensors.items()}


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
    silhouettes = sensors.add(builder)
    for name, port in silhouettes.items():
        builder.ExportOutput(port, f"silhouette_{name}")
    return _build(
        builder, tracker, cameras, silhouettes, sensors.period, sensors.GetOutputPort("time"),
        meshcat, with_deviations,
    )[0]  # fmt: skip


def _build(builder: DiagramBuilder, *of_tracker: Any) -> tuple[Diagram, PersonTracker]:
    """The diagram with a person tracker, whose outputs are its own."""
    system = add_person_tracker(builder, *of_tracker)
    export_outputs(builder, system)
    return builder.Build(), system


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
    regions = tuple(sensor.GetOutputPort("region") for sensor in sensors.values())
    diagram, person = _build(builder, tracker, cameras, edges, period)
    stages = {"region": regions, "edge": tuple(edges.values())}
    return SilhouetteCapture(diagram, stages, person)


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
    builder = DiagramBuilder()
    rig = build_camera_rig(model, cameras, true_positions).diagram
    builder.AddNamedSystem("camera_rig", rig)
    sensors = _add_sensors(builder, cameras, {})
    for name, sensor in sensors.items():
        builder.Connect(rig.GetOutputPort(f"label_image_{name}"), sensor.get_input_port())
    edges = {name: sensor.GetOutputPort("silhouette") for name, sensor in sensors.items()}
    tracker = PersonPoseTracker(ContourFit(model.pose_tree()))
    return _build(builder, tracker, cameras, edges, period, None, meshcat)[0]
