"""Several cameras around a moving body, as RgbdSensors in a ready diagram, or in yours."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from pydrake.geometry import FrameId, MakeRenderEngineVtk, RenderEngineVtkParams, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import PassThrough, TrajectorySource
from pydrake.systems.sensors import RgbdSensor
from pydrake.trajectories import Trajectory

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import ParsedModel, captured_warnings
from drake_pose.camera.drake import camera_from_drake, camera_to_drake
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import CameraError, UnknownNameError
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.systems.bodies import add_posed_plant
from drake_pose.systems.images import colour_image_to_picture

_RENDERER = "rig_renderer"
# What 16 bits of millimetres can hold; nothing of a room is farther away [m].
_FARTHEST = 60.0
# Red, green, blue of the empty picture, 0 to 1.
_BACKGROUND = (0.55, 0.58, 0.62)

_System = TypeVar("_System", bound=System)


@dataclass(frozen=True, eq=False)
class CameraRig:
    """A diagram of a body and the cameras around it.

    The diagram's input ``positions`` (nq) poses the body, or a trajectory does. Its outputs are
    ``color_image_<camera>``, ``label_image_<camera>`` and ``depth_image_<camera>``; an image is
    rendered when it is asked for. Render in one thread only: an engine first used in another thread
    gives wrong images.
    """

    diagram: Diagram
    cameras: Mapping[str, PinholeCamera]
    sensors: Mapping[str, RgbdSensor]

    def set_positions(self, context: Context, q: Array) -> None:
        """Pose the body: (nq,) the plant's positions [rad or m]."""
        self.diagram.GetInputPort("positions").FixValue(context, q)

    def picture(self, context: Context, camera: str) -> Picture:
        """What a camera sees: (H, W, 3) red, green, blue; UnknownNameError: there is none such."""
        return colour_image_to_picture(self._port("color_image", camera).Eval(context))

    def mask(self, context: Context, camera: str) -> Mask:
        """Where a camera sees the body: (H, W); UnknownNameError: there is none such."""
        return label_image_to_mask(self._port("label_image", camera).Eval(context))

    def _port(self, kind: str, camera: str) -> OutputPort:
        if camera not in self.cameras:
            raise UnknownNameError("camera", camera, self.cameras, "the rig")
        return self.diagram.GetOutputPort(f"{kind}_{camera}")


def build_camera_rig(
    model: ParsedModel,
    cameras: Mapping[str, PinholeCamera],
    true_positions: Trajectory | None = None,
) -> CameraRig:
    """Wire a body and the cameras that see it.

    Args:
        cameras: any number, anywhere: from circle_of_cameras or load_cameras.
        true_positions: the body's positions (nq,) over time; where not given, the diagram has the
            input ``positions``.

    Raises:
        CameraError: there is no camera, or one of parallel rays.
    """
    if not cameras:
        raise CameraError("a rig needs at least one camera")
    for name, camera in cameras.items():
        if not isinstance(camera, PinholeCamera):
            raise CameraError(f"camera '{name}': a rig's sensors are pinholes, not parallel")
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    source: System
    if true_positions is None:
        source = builder.AddNamedSystem("positions", PassThrough(model.plant.num_positions()))
        builder.ExportInput(source.get_input_port(), "positions")
    else:
        source = builder.AddNamedSystem("true_positions", TrajectorySource(true_positions))
    add_posed_plant(builder, scene_graph, model, source.get_output_port(), "geometry_pose")
    ranges = {name: (camera.near, _FARTHEST) for name, camera in cameras.items()}
    parameters = RenderEngineVtkParams(default_clear_color=np.array(_BACKGROUND))
    sensors = add_sensors(builder, scene_graph, cameras, ranges, parameters)
    for name, sensor in sensors.items():
        builder.ExportOutput(sensor.color_image_output_port(), f"color_image_{name}")
        builder.ExportOutput(sensor.label_image_output_port(), f"label_image_{name}")
        builder.ExportOutput(sensor.depth_image_32F_output_port(), f"depth_image_{name}")
    return CameraRig(builder.Build(), dict(cameras), sensors)


def add_sensors(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    cameras: Mapping[str, Camera],
    depth_ranges: Mapping[str, tuple[float, float]],
    parameters: RenderEngineVtkParams,
) -> dict[str, RgbdSensor]:
    """Add a renderer, and an RgbdSensor ``camera_<name>`` for each camera, returned by name.

    Call it after the models are added: the renderer refuses OBJ files without normals when it is.

    Args:
        depth_ranges: as of camera_to_drake, by camera that has its own [m].
    """
    scene_graph.AddRenderer(_RENDERER, MakeRenderEngineVtk(parameters))
    sensors = {}
    for name, camera in cameras.items():
        color, depth, X_WC = camera_to_drake(
            camera, renderer_name=_RENDERER, depth_range=depth_ranges.get(name)
        )
        # A parallel camera is a tele camera far beyond what depth images hold, which nobody reads.
        with captured_warnings():
            sensor = RgbdSensor(scene_graph.world_frame_id(), X_WC, color, depth)
        sensors[name] = builder.AddNamedSystem(f"camera_{name}", sensor)
        builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    return sensors


def cameras_from_drake(
    diagram: Diagram | DiagramBuilder, names: Collection[str] | None = None
) -> dict[str, PinholeCamera]:
    """The cameras of the RgbdSensors in a diagram, by the systems' names, at their default poses.

    A Scenario's cameras (``rgbd_sensor_<name>``) have the name that they have there.

    Args:
        diagram: looked through with all diagrams in it; or the builder of one.
        names: the cameras to take; None: all.

    Raises:
        CameraError: there is none, or one rides on a link that moves, so that it is nowhere fixed.
        UnknownNameError: there is no camera of a name.
    """
    found = {
        sensor.get_name().removeprefix("rgbd_sensor_"): sensor
        for sensor in _systems_of(diagram, RgbdSensor)
    }
    if not found:
        raise CameraError("there is no RgbdSensor in the diagram whose cameras were asked for")
    for name in names or ():
        if name not in found:
            raise UnknownNameError("camera", name, found, "the diagram")
    plants = _systems_of(diagram, MultibodyPlant)
    cameras = {}
    for name in found if names is None else names:
        sensor = found[name]
        X_WP = _fixed_pose(plants, sensor.default_parent_frame_id(), name)
        core = sensor.default_color_render_camera().core()
        cameras[name] = camera_from_drake(name, core, X_WP @ sensor.default_X_PB())
    return cameras


def _systems_of(diagram: Diagram | DiagramBuilder, kind: type[_System]) -> list[_System]:
    """All systems of a kind in a diagram and in those inside it."""
    found: list[_System] = []
    for system in diagram.GetSystems():
        if isinstance(system, kind):
            found.append(system)
        elif isinstance(system, Diagram):
            found += _systems_of(system, kind)
    return found


def _fixed_pose(plants: Sequence[MultibodyPlant], frame: FrameId, camera: str) -> RigidTransform:
    """Where a frame is in the world, if it cannot move; CameraError: it can."""
    if frame == SceneGraph.world_frame_id():
        return RigidTransform()
    for plant in plants:
        body = plant.GetBodyFromFrameId(frame)
        if body is None:
            continue
        if body not in plant.GetBodiesWeldedTo(plant.world_body()):
            raise CameraError(
                f"camera '{camera}' rides on link '{body.name()}', which moves, so that it stands "
                "elsewhere at each time; names=[...] leaves it out"
            )
        return plant.EvalBodyPoseInWorld(plant.CreateDefaultContext(), body)
    raise CameraError(f"camera '{camera}' rides on a frame of no plant in the diagram")
