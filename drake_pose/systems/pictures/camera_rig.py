"""Several cameras around a moving body, as RgbdSensors in a ready diagram."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import PassThrough, TrajectorySource
from pydrake.systems.sensors import RgbdSensor
from pydrake.trajectories import Trajectory

from drake_pose.body.parsed_model import ParsedModel
from drake_pose.camera.drake import camera_to_drake
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError, UnknownNameError
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.systems.bodies.posed_geometry import pose_plant
from drake_pose.systems.colour_images import colour_image_to_picture

_RENDERER = "rig_renderer"
# What 16 bits of millimetres can hold; nothing of a room is farther away [m].
_FARTHEST = 60.0


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

    def set_positions(self, context: Context, q: NDArray[np.float64]) -> None:
        """Pose the body: (nq,) the plant's positions [rad or m]."""
        self.diagram.GetInputPort("positions").FixValue(context, q)

    def picture(self, context: Context, camera: str) -> NDArray[np.uint8]:
        """What a camera sees: (H, W, 3) red, green, blue; UnknownNameError: there is none such."""
        return colour_image_to_picture(self._port("color_image", camera).Eval(context))

    def mask(self, context: Context, camera: str) -> NDArray[np.bool_]:
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
    background: tuple[float, float, float] = (0.55, 0.58, 0.62),
) -> CameraRig:
    """Wire a body and the cameras that see it.

    Args:
        cameras: any number, anywhere: from circle_of_cameras or load_cameras.
        true_positions: the body's positions (nq,) over time; where not given, the diagram has the
            input ``positions``.
        background: red, green, blue of the empty picture, 0 to 1.

    Raises:
        CameraError: there is no camera, or one of parallel rays.
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    plant = MultibodyPlant(0.0)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    model.add_to(plant, scene_graph)
    # After the model: Drake's renderer refuses an OBJ file without normals when it is parsed.
    sensors = _add_cameras(builder, scene_graph, cameras, background)
    if true_positions is None:
        entrance = builder.AddNamedSystem("positions", PassThrough(model.plant.num_positions()))
        builder.ExportInput(entrance.get_input_port(), "positions")
        positions = entrance.get_output_port()
    else:
        source = builder.AddNamedSystem("true_positions", TrajectorySource(true_positions))
        positions = source.get_output_port()
    pose_plant(builder, scene_graph, plant, positions, "geometry_pose")
    return CameraRig(builder.Build(), dict(cameras), sensors)


def _add_cameras(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    cameras: Mapping[str, PinholeCamera],
    background: tuple[float, float, float],
) -> dict[str, RgbdSensor]:
    """Add a renderer and a sensor for each camera, whose images the diagram exports."""
    if not cameras:
        raise CameraError("a rig needs at least one camera")
    parameters = RenderEngineVtkParams(default_clear_color=np.array(background))
    scene_graph.AddRenderer(_RENDERER, MakeRenderEngineVtk(parameters))
    sensors = {}
    for name, camera in cameras.items():
        if not isinstance(camera, PinholeCamera):
            raise CameraError(f"camera '{name}': a rig's sensors are pinholes, not parallel")
        color, depth, X_WC = camera_to_drake(
            camera, renderer_name=_RENDERER, depth_range=(camera.near, _FARTHEST)
        )
        sensor = builder.AddNamedSystem(
            f"camera_{name}", RgbdSensor(scene_graph.world_frame_id(), X_WC, color, depth)
        )
        builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
        builder.ExportOutput(sensor.color_image_output_port(), f"color_image_{name}")
        builder.ExportOutput(sensor.label_image_output_port(), f"label_image_{name}")
        builder.ExportOutput(sensor.depth_image_32F_output_port(), f"depth_image_{name}")
        sensors[name] = sensor
    return sensors
