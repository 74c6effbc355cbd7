"""Pictures as Drake's images, recorded masks as a system, and simulated cameras.

An image without pixels (0 x 0) means that a camera has no picture.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import cv2
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams, Role, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import PassThrough, TrajectorySource
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U, RgbdSensor
from pydrake.trajectories import Trajectory

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import ParsedModel, captured_warnings, labelled_meshes, require_registered
from drake_pose.camera.exchange import camera_from_drake, camera_to_drake
from drake_pose.camera.models import Camera, PinholeCamera, camera_tuple
from drake_pose.errors import CameraError, ModelError, UnknownNameError
from drake_pose.silhouette.outline import outline_from_mesh, pack
from drake_pose.silhouette.pictures.label_renderer import (
    EMPTY,
    label_image_to_mask,
    mask_to_label_image,
)
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.silhouette.span_kernel import paint_labels
from drake_pose.systems.bodies import add_posed_plant
from drake_pose.systems.ports import PortedSystem, camera_port


def picture_to_colour_image(picture: Picture | None) -> ImageRgba8U:
    """Return a picture (H, W, 3), red, green, blue, as ImageRgba8U; None: one without pixels."""
    image = ImageRgba8U()
    if picture is not None:
        fill_colour_image(image, picture)
    return image


def fill_colour_image(image: ImageRgba8U, picture: Picture) -> None:
    """Resize an ImageRgba8U to a picture (H, W, 3), red, green, blue, and copy it."""
    image.resize(picture.shape[1], picture.shape[0])
    cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA, dst=image.mutable_data)


def colour_image_to_picture(image: ImageRgba8U) -> Picture:
    """Return the picture (H, W, 3), red, green, blue, of an image; (0, 0, 3) without pixels."""
    if not image.size():
        return np.empty((0, 0, 3), dtype=np.uint8)
    return np.asarray(cv2.cvtColor(image.data, cv2.COLOR_RGBA2RGB))


DEFAULT_FRAME_RATE_HZ = 1.0
"""Frame rate of a scene that has none, such as stills [Hz]."""


class MaskPlayer(PortedSystem):
    """Plays the masks of a recorded scene as label images.

    .. pydrake_system::

        name: MaskPlayer
        output_ports: [label_image, color_image (of cameras with pictures), measured_positions
          (where given), root_position (where given), frame_index]

    Output ports depend on time alone. Frame k is shown for one period from time k * period on; the
    first and the last frame also before and after. With several cameras, the image ports are
    ``label_image_<camera>`` and ``color_image_<camera>``.

    Output ports:
        label_image (ImageLabel16I): the mask; all background if the camera has no mask of the
            frame, which a matcher ignores.
        color_image (ImageRgba8U): the picture; without pixels if there is none of the frame.
        measured_positions (nq): NaN if not given for the frame [rad or m].
        root_position (3): NaN if not given for the frame [m].
        frame_index (1): index of the frame in ``frames``.

    Args:
        scene: the recorded masks and pictures.
        cameras: the cameras to play, in the order of the output ports.
        frames: names of the frames to play; None: all of the scene's.
        positions: (nq,) [rad or m] by name of the frame, for ``measured_positions``; None: no such
            port.
        root_positions: (3,) [m] by name of the frame, for ``root_position``; None: no such port.

    Attributes:
        frames: names of the frames played.
        period: time between two frames [s].
        color_cameras: names of the cameras that have pictures (``Scene.images``), and so a port.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera] | Mapping[str, Camera],
        frames: Sequence[str] | None = None,
        positions: Mapping[str, Array] | None = None,
        root_positions: Mapping[str, Array] | None = None,
    ) -> None:
        super().__init__()
        cameras = camera_tuple(cameras)
        self._scene = scene
        self.frames = tuple(scene.frames if frames is None else frames)
        self.period = 1.0 / (scene.frame_rate_hz or DEFAULT_FRAME_RATE_HZ)
        self.color_cameras = tuple(
            camera.name
            for camera in cameras
            if any((camera.name, frame) in scene.images for frame in self.frames)
        )
        every = [camera.name for camera in cameras]
        for kind, image, read, names in (
            ("label_image", ImageLabel16I(), self._label_image, every),
            ("color_image", ImageRgba8U(), self._color_image, self.color_cameras),
        ):
            for camera in cameras:
                if camera.name in names:
                    self._play(camera_port(kind, camera, cameras), image, partial(read, camera))
        given = {"measured_positions": positions, "root_position": root_positions}
        for name, values in given.items():
            if values:
                unknown = np.full(len(next(iter(values.values()))), np.nan)
                shown = {frame: values.get(frame, unknown) for frame in self.frames}
                self._play(name, len(unknown), shown.__getitem__)
        self.add_output(
            "frame_index",
            1,
            lambda context: [self.frame_index(context.get_time())],
            {self.time_ticket()},
        )

    def frame_index(self, time: float) -> int:
        """Return the index in ``frames`` of the frame shown at a time [s]."""
        # The offset of 5e-7 periods keeps k * period on frame k in spite of rounding.
        index = int(np.floor(time / self.period + 5e-7))
        return min(max(index, 0), len(self.frames) - 1)

    def _play(self, port: str, model_value: Any, read: Callable[[str], Any]) -> None:
        """Declare an output ``read`` of the shown frame's name; a model value or a size."""
        self.add_output(
            port,
            model_value,
            lambda context: read(self.frames[self.frame_index(context.get_time())]),
            {self.time_ticket()},
        )

    def _label_image(self, camera: Camera, frame: str) -> ImageLabel16I:
        """Return the mask of a frame; all background if there is none."""
        if (camera.name, frame) in self._scene.masks:
            return mask_to_label_image(self._scene.read(camera.name, frame))
        return mask_to_label_image(np.zeros((camera.height, camera.width), dtype=bool))

    def _color_image(self, camera: Camera, frame: str) -> ImageRgba8U:
        """Return the picture of a frame; an image without pixels if there is none."""
        is_there = (camera.name, frame) in self._scene.images
        picture = self._scene.read_image(camera.name, frame) if is_there else None
        return picture_to_colour_image(picture)


_System = TypeVar("_System", bound=System)


@dataclass(frozen=True, eq=False)
class CameraRig:
    """A diagram of a body and the cameras that see it.

    The body is posed by the input port ``positions`` (nq) or by a trajectory. The output ports
    ``color_image_<camera>`` and ``label_image_<camera>`` render when they are evaluated. Render in
    one thread only: Drake's engine gives wrong images in another thread.
    """

    diagram: Diagram  # The diagram.
    cameras: Mapping[str, PinholeCamera]  # The cameras by name.

    def set_positions(self, context: Context, q: Array) -> None:
        """Fix the body's positions q (nq,) [rad or m] in a context of the diagram."""
        self.diagram.GetInputPort("positions").FixValue(context, q)

    def picture(self, context: Context, camera: str) -> Picture:
        """Return the colour image (H, W, 3), red, green, blue, of a camera, by its name.

        ``context``: the diagram's. Raises UnknownNameError: the rig has no such camera.
        """
        return colour_image_to_picture(self._port("color_image", camera).Eval(context))

    def mask(self, context: Context, camera: str) -> Mask:
        """Return the body's silhouette (H, W) in a camera; see ``picture``."""
        return label_image_to_mask(self._port("label_image", camera).Eval(context))

    def _port(self, kind: str, camera: str) -> OutputPort:
        """Return the diagram's output port ``<kind>_<camera>``."""
        if camera not in self.cameras:
            raise UnknownNameError("camera", camera, self.cameras, "the rig")
        return self.diagram.GetOutputPort(f"{kind}_{camera}")


def build_camera_rig(
    model: ParsedModel,
    cameras: Mapping[str, PinholeCamera],
    true_positions: Trajectory | None = None,
) -> CameraRig:
    """Build a diagram of a body and the cameras that see it.

    ``model``: the body. ``cameras``: cameras by name, from circle_of_cameras or load_cameras.
    ``true_positions``: positions (nq,) [rad or m] over time; None: the diagram has the input port
    ``positions``. Raises CameraError: there is no camera, or one is not a pinhole camera.
    """
    if not cameras:
        raise CameraError("a rig needs at least one camera")
    for name, camera in cameras.items():
        if not isinstance(camera, PinholeCamera):
            raise CameraError(f"camera '{name}': a rig needs pinhole cameras, not parallel ones")
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    source: System
    if true_positions is None:
        source = builder.AddNamedSystem("positions", PassThrough(model.plant.num_positions()))
        builder.ExportInput(source.get_input_port(), "positions")
    else:
        source = builder.AddNamedSystem("true_positions", TrajectorySource(true_positions))
    add_posed_plant(builder, scene_graph, model, source.get_output_port())
    # Within the range of 16-bit depth images in millimetres, which is 65 m.
    ranges = {name: (camera.near, 60.0) for name, camera in cameras.items()}
    parameters = RenderEngineVtkParams(default_clear_color=np.array([0.55, 0.58, 0.62]))
    sensors = add_sensors(builder, scene_graph, cameras, ranges, parameters)
    for name, sensor in sensors.items():
        builder.ExportOutput(sensor.color_image_output_port(), f"color_image_{name}")
        builder.ExportOutput(sensor.label_image_output_port(), f"label_image_{name}")
    return CameraRig(builder.Build(), dict(cameras))


def add_sensors(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    cameras: Mapping[str, Camera],
    depth_ranges: Mapping[str, tuple[float, float]],
    parameters: RenderEngineVtkParams,
) -> dict[str, RgbdSensor]:
    """Add a renderer, and an RgbdSensor ``camera_<name>`` for each camera; return these by name.

    Call it after the models are added, because the renderer checks their files when it is added.

    Args:
        builder: the diagram to which the sensors are added.
        scene_graph: a system of the diagram; it gets the renderer.
        cameras: cameras by name.
        depth_ranges: nearest and farthest depth [m] by name of the camera, see camera_to_drake.
        parameters: settings of the renderer.
    """
    renderer = "rig_renderer"
    scene_graph.AddRenderer(renderer, MakeRenderEngineVtk(parameters))
    sensors = {}
    for name, camera in cameras.items():
        color, depth, X_WC = camera_to_drake(
            camera, renderer_name=renderer, depth_range=depth_ranges.get(name)
        )
        # A parallel camera becomes a distant tele camera, beyond the range of depth images; Drake
        # warns, but they are not used.
        with captured_warnings():
            sensor = RgbdSensor(scene_graph.world_frame_id(), X_WC, color, depth)
        sensors[name] = builder.AddNamedSystem(f"camera_{name}", sensor)
        builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    return sensors


def cameras_from_drake(
    diagram: Diagram | DiagramBuilder, names: Collection[str] | None = None
) -> dict[str, PinholeCamera]:
    """Return the cameras of a diagram's RgbdSensors at their default poses, by system name.

    The prefix ``rgbd_sensor_``, which Drake adds to a Scenario's cameras, is removed.

    Args:
        diagram: the diagram, searched recursively, or its builder.
        names: the cameras to take; None: all.

    Raises:
        CameraError: there is no camera, or one is attached to a link that moves.
        UnknownNameError: there is no camera of a name.
    """
    found = {
        sensor.get_name().removeprefix("rgbd_sensor_"): sensor
        for sensor in _systems_of(diagram, RgbdSensor)
    }
    if not found:
        raise CameraError("the diagram has no RgbdSensor")
    for name in names or ():
        if name not in found:
            raise UnknownNameError("camera", name, found, "the diagram")
    plants = list(_systems_of(diagram, MultibodyPlant))
    cameras = {}
    for name in found if names is None else names:
        sensor = found[name]
        frame, X_WP = sensor.default_parent_frame_id(), RigidTransform()
        if frame != SceneGraph.world_frame_id():
            carriers = [(plant, plant.GetBodyFromFrameId(frame)) for plant in plants]
            plant, body = next((pair for pair in carriers if pair[1] is not None), (None, None))
            if plant is None or body is None:
                raise CameraError(
                    f"camera '{name}' is attached to a frame of no plant in the diagram"
                )
            if body not in plant.GetBodiesWeldedTo(plant.world_body()):
                raise CameraError(
                    f"camera '{name}' is attached to link '{body.name()}', which moves, so that "
                    "it has no fixed pose; names=[...] leaves it out"
                )
            X_WP = plant.EvalBodyPoseInWorld(plant.CreateDefaultContext(), body)
        core = sensor.default_color_render_camera().core()
        cameras[name] = camera_from_drake(name, core, X_WP @ sensor.default_X_PB())
    return cameras


def _systems_of(diagram: Diagram | DiagramBuilder, kind: type[_System]) -> Iterator[_System]:
    """Yield all systems of the type ``kind`` in a diagram, recursively."""
    for system in diagram.GetSystems():
        if isinstance(system, kind):
            yield system
        elif isinstance(system, Diagram):
            yield from _systems_of(system, kind)


class SilhouetteCamera(PortedSystem):
    """Renders label images of a plant's bodies without VTK, OpenGL or a display.

    .. pydrake_system::

        name: SilhouetteCamera
        input_ports: [body_poses]
        output_ports: [label_image, body_pose_in_world, image_time]

    The system is continuous and has no state, as an RgbdSensor.

    Input ports:
        body_poses: the plant's output port of that name.

    Output ports:
        label_image (ImageLabel16I): at each pixel the render label of the nearest body at the
            pixel's centre, RenderLabel.kEmpty if there is none. Links occlude each other.
        body_pose_in_world (RigidTransform): the camera's pose X_WC.
        image_time (1): the context's time [s].

    Surfaces are the plant's visual geometry (perception role) at full detail, read at construction.
    Geometry of other sources and half spaces (ground planes) are invisible. There is a near plane,
    but no far one. Unlike an RgbdSensor, the camera may be a parallel camera.

    Args:
        plant: finalized, and registered with ``scene_graph``.
        camera: its X_WC is the pose in the parent's frame.
        parent: body that carries the camera; None: the world.

    Raises:
        ModelError: the plant is not finalized, is not registered with the SceneGraph or has no
            visual geometry; a link has geometry that cannot be drawn; geometry is deformable. On
            evaluation: a body's pose is not finite.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        camera: Camera,
        parent: RigidBody | None = None,
    ) -> None:
        super().__init__()
        require_registered(plant, scene_graph)
        inspector = scene_graph.model_inspector()
        deformable = [
            inspector.GetName(geometry)
            for geometry in inspector.GetAllDeformableGeometryIds()
            if inspector.GetProperties(geometry, Role.kPerception) is not None
        ]
        if deformable:
            raise ModelError(
                f"geometry '{deformable[0]}' is deformable, which a SilhouetteCamera does not "
                "draw; use an RgbdSensor"
            )
        bodies = [plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())]
        found = [
            (index, label, outline_from_mesh(mesh))
            for index, body in enumerate(bodies)
            for label, mesh in labelled_meshes(plant, scene_graph, body).items()
            if not mesh.is_empty and label != EMPTY
        ]
        if not found:
            raise ModelError("the plant has no visual geometry")
        self.camera = camera
        self._names = [body.name() for body in bodies]
        self._parent = 0 if parent is None else int(parent.index())
        self._drawn = np.array([index for index, _, _ in found])
        self._labels = np.array([label for _, label, _ in found], dtype=np.int16)
        self._closed = np.array([outline.is_closed for _, _, outline in found])
        self._packed = pack(tuple(outline for _, _, outline in found))
        self._parameters, self._X_CP = camera.kernel_parameters(), camera.X_CW
        bodies_posed = self.add_input("body_poses", [RigidTransform()] * len(bodies))
        self.DeclareAbstractOutputPort(
            "label_image",
            AbstractValue.Make(ImageLabel16I(camera.width, camera.height)).Clone,
            self._calc_image,
            {bodies_posed.ticket()},
        )
        self.add_output(
            "body_pose_in_world",
            RigidTransform(),
            lambda context: bodies_posed.Eval(context)[self._parent] @ RigidTransform(camera.X_WC),
        )
        time = {self.time_ticket()}
        self.add_output("image_time", 1, lambda context: [context.get_time()], time)

    def _calc_image(self, context: Context, output: AbstractValue) -> None:
        """Write the label image at the context's body poses to an ImageLabel16I."""
        listed = self.GetInputPort("body_poses").Eval(context)
        if len(listed) != len(self._names):
            raise ModelError(
                f"{self.get_name()}: body_poses holds {len(listed)} poses, but the plant has "
                f"{len(self._names)} bodies"
            )
        X_WB = np.array([pose.GetAsMatrix4() for pose in listed])
        for name, X in zip(self._names, X_WB, strict=True):
            if not np.isfinite(X).all():
                raise ModelError(f"{self.get_name()}: the pose of link '{name}' is not finite")
        X_CW = self._X_CP
        if self._parent:
            X_CW = X_CW @ np.linalg.inv(X_WB[self._parent])
        X_CB = np.ascontiguousarray((X_CW @ X_WB[self._drawn])[:, :3])
        labels = output.get_mutable_value().mutable_data[:, :, 0]
        paint_labels(
            self._packed, self._labels, self._closed, X_CB, self._parameters, EMPTY, labels
        )
