"""Ready diagrams: a simulated camera or recorded masks, an estimator, the estimated body, logs."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import (
    IllustrationProperties,
    Meshcat,
    MeshcatVisualizer,
    RenderEngineVtkParams,
    Rgba,
    Role,
    RoleAssign,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource, VectorLogSink
from pydrake.systems.sensors import ImageLabel16I, RgbdSensor
from pydrake.trajectories import PiecewisePolynomial, Trajectory

from drake_pose.arrays import Array
from drake_pose.body import ParsedModel, build_pose_tree
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import MaskError
from drake_pose.filtering.contour_tracker import TrackingSettings
from drake_pose.registration.online_registration import (
    CameraStatus,
    OnlineRegistration,
    OnlineState,
)
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import RegisteredCamera
from drake_pose.search import PoseEstimate, PoseSearch
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.bodies import add_meshcat_skin, add_posed_plant, add_skin
from drake_pose.systems.cameras import add_sensors
from drake_pose.systems.images import MaskPlayer
from drake_pose.systems.ports import BeliefSystem, camera_port, connect_same, require_period
from drake_pose.systems.silhouette_matcher import SilhouetteMatcher, SilhouetteTracker

REGISTRATION = ("keyframes", "contradictions", "moves", "mean_iou")
"""What the elements of the output ``registration`` of CameraRegistration are."""


class CameraRegistration(BeliefSystem[OnlineState]):
    """Finds where a camera stands from a body at measured positions, and whether it was moved.

    .. pydrake_system::

        name: CameraRegistration
        input_ports: [label_image, measured_positions]
        output_ports: [X_WC, covariance, status, registration]

    No guess of the pose is needed. A periodic update keeps frames in which the body stands
    differently, and searches when there are enough of them; from then on the pose is fitted anew
    whenever another one is kept, the oldest are forgotten, and a camera that was moved is found
    again. See ``labels`` for the pixels that belong to the body. An image that is not
    connected or shows nothing of the body says nothing, nor do positions that are not finite. Image
    and positions must be of the same moment.

    - ``X_WC``: a RigidTransform, the camera's pose in the world of the body's plant. Until it is
      found its translation is nan; later it is the last one found.
    - ``covariance`` (6 x 6, row by row): of the pose's error, a rotation vector [rad] and a shift
      [m] along the world's axes, in this order. Infinite unless the status is 1.
    - ``status``: 0 while the camera is not found yet; 1 while the pose holds; 2 while the last
      frames contradict it, because the camera has been moved, or the body is hidden: then X_WC must
      not be used. It is 1 again as soon as a frame agrees, or the camera is found elsewhere.
    - ``registration``: see ``REGISTRATION``. How many frames are kept; how many frames in a row
      contradict the pose; how often the camera was found elsewhere; and intersection over union of
      body and mask, the mean over the kept frames, nan until the camera is found.

    All that is known is state of the context; copies share it.

    Args:
        period: time between two updates [s].
        labels: the labels that belong to the body; None: those of its model where that was made of
            a plant (``ArticulatedModel.from_plant``), else all but Drake's reserved ones.
        most_covered: largest fraction of the picture that the body may cover.

    Raises:
        SettingsError: a period that is not positive.
        MaskError: in a simulation, when the body's labels cover more of the picture.
    """

    def __init__(
        self,
        registration: OnlineRegistration,
        period: float,
        labels: Collection[int] | None = None,
        most_covered: float = 0.6,
    ) -> None:
        super().__init__()
        require_period("registration", period)
        self._registration, self._most_covered = registration, most_covered
        self._tree, camera = registration.body.tree, registration.camera
        labels = self._tree.model.labels if labels is None else labels
        self._labels = None if labels is None else frozenset(labels)
        self.add_input("label_image", ImageLabel16I(camera.width, camera.height))
        self.add_input("measured_positions", len(self._tree.model.position_names))
        self.keep_belief(OnlineState(), period)
        self.show("X_WC", RigidTransform(), _X_WC)
        self.show("covariance", 36, self._covariance)
        self.show("status", 1, lambda known: [float(registration.status(known))])
        self.show("registration", len(REGISTRATION), _numbers)

    def registered_camera(self, context: Context) -> PinholeCamera | None:
        """The camera with its pose, for searches and estimators; None unless the status is 1."""
        believed = self._believed(self.belief(context))
        return None if believed is None else believed.camera

    def next_belief(self, context: Context, last: OnlineState) -> OnlineState:
        """What is known with one frame more."""
        image = self.given(context, "label_image")
        if image is None:
            return last
        q = np.array(self.GetInputPort("measured_positions").Eval(context))
        if not np.isfinite(q).all():
            return last
        values = np.concatenate(self._tree.values_from_positions(q))
        mask = label_image_to_mask(image, self._labels)
        covered = float(mask.mean())
        if covered > self._most_covered:
            raise MaskError(
                f"{self.get_name()}: labels of the body cover {covered:.0%} of the picture of "
                f"camera '{self._registration.camera.name}' ({self._most_covered:.0%} at most): "
                "does the ground count? Name the body's own labels (labels=), or use a model of "
                "ArticulatedModel.from_plant"
            )
        return self._registration.next(last, PosedFrame(f"{context.get_time():g} s", values, mask))

    def _believed(self, known: OnlineState) -> RegisteredCamera | None:
        """The camera as it was found; None unless the status is 1."""
        is_believed = self._registration.status(known) is CameraStatus.REGISTERED
        return known.registered if is_believed else None

    def _covariance(self, known: OnlineState) -> Array:
        believed = self._believed(known)
        covariance = np.diag(np.full(6, np.inf)) if believed is None else believed.covariance
        return covariance.ravel()


def _X_WC(known: OnlineState) -> RigidTransform:
    """The camera's pose as it was last found."""
    if known.registered is None:
        return RigidTransform(np.full(3, np.nan))
    return RigidTransform(known.registered.camera.X_WC)


def _numbers(known: OnlineState) -> list[float]:
    """REGISTRATION."""
    iou = np.nan
    if known.registered is not None:
        iou = float(np.mean([frame.iou for frame in known.registered.frames]))
    return [len(known.keyframes), known.outlier_count, known.moves, iou]


ESTIMATE_COLOUR = Rgba(0.0, 0.45, 0.70, 0.6)


@dataclass(frozen=True)
class MatchingDiagram:
    """A diagram that matches silhouettes, and the parts of it that one asks afterwards.

    Args:
        positions_log, error_log: log ``estimated_positions`` and ``error`` once a period.
        player: what plays the masks; None where a camera is simulated.
    """

    diagram: Diagram
    matcher: SilhouetteMatcher
    positions_log: VectorLogSink
    error_log: VectorLogSink
    player: MaskPlayer | None = None

    def estimate(self, context: Context) -> PoseEstimate | None:
        """The last update's estimate; None: nothing was seen. context: the diagram's."""
        own = self.matcher.GetMyContextFromRoot(context)
        estimate: PoseEstimate | None = self.matcher.GetOutputPort("pose_estimate").Eval(own)
        return estimate

    def was_tracked(self, context: Context) -> bool:
        """Whether the last update's pose was tracked, no search asked. context: the diagram's."""
        own = self.matcher.GetMyContextFromRoot(context)
        tracks = isinstance(self.matcher, SilhouetteTracker)
        return tracks and bool(self.matcher.GetOutputPort("track").Eval(own)[0])

    def with_intervals(self, context: Context) -> PoseEstimate:
        """The last update's pose, which was tracked, with what its contours say of each joint."""
        assert isinstance(self.matcher, SilhouetteTracker)
        return self.matcher.with_intervals(self.matcher.GetMyContextFromRoot(context))


def build_recorded_matching(
    scene: Scene,
    search: PoseSearch,
    cameras: Sequence[Camera],
    frames: Sequence[str] | None = None,
    root_positions: Mapping[str, np.ndarray] | None = None,
    meshcat: Meshcat | None = None,
    tracking: TrackingSettings | None = None,
    starts: Mapping[str, np.ndarray] | None = None,
) -> MatchingDiagram:
    """Wire recorded masks to the matcher: MaskPlayer -> SilhouetteMatcher -> logs, Meshcat.

    Args:
        cameras: the cameras to use, matched together.
        frames: the frames to play; all where not given.
        root_positions: the root's position (3,) in the world for each frame [m]; the pose tree's
            own where not given.
        meshcat: where to show the estimated body.
        tracking: how the body moves from frame to frame: it is matched in the first one, tracked
            from there, and matched again after a loss. Every frame is matched where not given.
        starts: (nq,) by frame where the body is known to be: a track begins there, also after a
            loss, without a search.

    Returns:
        The diagram; frame k is matched at time k times the player's period.
    """
    player = MaskPlayer(scene, cameras, frames, positions=starts, root_positions=root_positions)
    matcher = _matcher(search, cameras, player.period, tracking, player.color_cameras)
    builder = DiagramBuilder()
    builder.AddNamedSystem("mask_player", player)
    builder.AddNamedSystem("silhouette_matcher", matcher)
    connect_same(builder, player, matcher)
    if meshcat is not None:
        scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
        estimate = matcher.GetOutputPort("estimated_positions")
        show_estimate(builder, scene_graph, search.tree.model, estimate, meshcat)
    return _finish(builder, matcher, player.period, player)


def build_simulated_matching(
    search: PoseSearch,
    cameras: Sequence[Camera],
    true_positions: Trajectory | np.ndarray,
    period: float,
    meshcat: Meshcat | None = None,
    tracking: TrackingSettings | None = None,
) -> MatchingDiagram:
    """Wire a simulated body and camera to the matcher, and show the estimate beside the truth.

    The true body moves on a given trajectory; RgbdSensors see it; the matcher's estimate poses a
    second body in the same SceneGraph, which the sensors do not see.

    Args:
        true_positions: the true body's positions (nq,), constant or over time.
        period: time between two images, and two matches [s].
        meshcat: where to show both bodies.
        tracking: as for ``build_recorded_matching``.
    """
    builder = DiagramBuilder()
    model = search.tree.model
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    matcher = _matcher(search, cameras, period, tracking)
    builder.AddNamedSystem("silhouette_matcher", matcher)
    truth, images = add_simulated_cameras(builder, scene_graph, model, cameras, true_positions)
    for camera, image in zip(cameras, images, strict=True):
        builder.Connect(image, matcher.GetInputPort(camera_port("label_image", camera, cameras)))
    if meshcat is not None:
        estimate = matcher.GetOutputPort("estimated_positions")
        show_estimate(builder, scene_graph, model, estimate, meshcat, ESTIMATE_COLOUR)
        # The visualizer begins by clearing its part of Meshcat's tree.
        add_meshcat_skin(builder, meshcat, model, truth, "true")
    return _finish(builder, matcher, period, None)


def add_simulated_cameras(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    model: ParsedModel,
    cameras: Sequence[Camera],
    true_positions: Trajectory | np.ndarray,
) -> tuple[OutputPort, list[OutputPort]]:
    """Add a body at positions (nq,), constant or over time, and RgbdSensors that see it.

    Returns:
        The port of the positions, and that of each camera's label image.
    """
    if isinstance(true_positions, np.ndarray):
        true_positions = PiecewisePolynomial(true_positions.reshape(-1, 1))
    source = builder.AddNamedSystem("true_positions", TrajectorySource(true_positions))
    truth = source.get_output_port()
    add_posed_plant(builder, scene_graph, model, truth, "true_geometry_pose", "true")
    labels = {name: label for label, name in enumerate(model.link_names)}
    add_skin(builder, scene_graph, model, truth, "true", labels)
    ranges = {}
    for camera in cameras:
        nearest, farthest = _depth_range(camera, model, true_positions)
        if isinstance(camera, PinholeCamera):
            # Beyond the body there is nothing; a farther plane than this is a warning of Drake's.
            # A pinhole's pictures end 60 m away at least.
            nearest, farthest = camera.near, max(60.0, farthest)
        ranges[camera.name] = nearest, farthest
    sensors = add_sensors(
        builder, scene_graph, {one.name: one for one in cameras}, ranges, RenderEngineVtkParams()
    )
    return truth, [sensor.label_image_output_port() for sensor in sensors.values()]


def _depth_range(
    camera: Camera, model: ParsedModel, true_positions: Trajectory
) -> tuple[float, float]:
    """The depths about a moving body [m]: a parallel camera is drawn as a tele camera, clipped."""
    start, end = true_positions.start_time(), true_positions.end_time()
    # A constant has no end.
    times = np.linspace(start, end, 100) if np.isfinite([start, end]).all() else np.zeros(1)
    tree = build_pose_tree(model)
    depths = []
    for time in times:
        values = tree.values_from_positions(true_positions.value(time).ravel())
        for node, taken, X_WN in zip(tree.nodes, values, tree.node_poses(values), strict=True):
            p_N = node.surface(taken).vertices
            depths.append(camera.project(p_N @ X_WN[:3, :3].T + X_WN[:3, 3])[1])
    everything = np.concatenate(depths)
    # A body that moves fast may reach further between the times looked at.
    margin = 0.5 + 0.1 * float(np.ptp(everything))
    return float(everything.min()) - margin, float(everything.max()) + margin


def _matcher(
    search: PoseSearch,
    cameras: Sequence[Camera],
    period: float,
    tracking: TrackingSettings | None,
    color_cameras: Sequence[str] = (),
) -> SilhouetteMatcher:
    if tracking is None:
        return SilhouetteMatcher(search, cameras, period)
    # What is recorded or simulated waits: its answer depends on no clock.
    return SilhouetteTracker(
        search, cameras, period, tracking=tracking, color_cameras=color_cameras, search_time=None
    )


def show_estimate(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    model: ParsedModel,
    positions: OutputPort,
    meshcat: Meshcat,
    colour: Rgba | None = None,
) -> None:
    """Show a SceneGraph in Meshcat, with a body at estimated positions that no sensor sees.

    Args:
        colour: in place of the body's own colours.
    """
    plant = add_posed_plant(
        builder, scene_graph, model, positions, "estimated_geometry_pose", "estimated"
    )
    source, inspector = plant.get_source_id(), scene_graph.model_inspector()
    for index in range(plant.num_bodies()):
        frame = plant.GetBodyFrameIdOrThrow(BodyIndex(index))
        for geometry in inspector.GetGeometries(frame):
            # Other bodies' skin hangs on the world's frame, too.
            if not inspector.BelongsToSource(geometry, source):
                continue
            if inspector.GetPerceptionProperties(geometry) is not None:
                scene_graph.RemoveRole(source, geometry, Role.kPerception)
            if colour is not None and inspector.GetIllustrationProperties(geometry) is not None:
                properties = IllustrationProperties()
                properties.AddProperty("phong", "diffuse", colour)
                scene_graph.AssignRole(source, geometry, properties, RoleAssign.kReplace)
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    add_meshcat_skin(builder, meshcat, model, positions, "estimated", colour)


def _finish(
    builder: DiagramBuilder, matcher: SilhouetteMatcher, period: float, player: MaskPlayer | None
) -> MatchingDiagram:
    """Add the logs and build."""
    # A log samples just before the update of the same time: sample k + 1 holds frame k's estimate.
    positions_log = LogVectorOutput(
        matcher.GetOutputPort("estimated_positions"), builder, publish_period=period
    )
    error_log = LogVectorOutput(matcher.GetOutputPort("error"), builder, publish_period=period)
    return MatchingDiagram(builder.Build(), matcher, positions_log, error_log, player)


@dataclass(frozen=True)
class RegistrationDiagram:
    """A diagram that registers a simulated camera, and the parts of it that one asks afterwards.

    Args:
        sensor: the simulated camera; ``sensor.SetX_PB(context, X_WC)`` moves it.
        status_log: logs ``status`` once a period.
    """

    diagram: Diagram
    registration: CameraRegistration
    sensor: RgbdSensor
    status_log: VectorLogSink


def build_simulated_registration(
    registration: OnlineRegistration,
    camera: PinholeCamera,
    true_positions: Trajectory | np.ndarray,
    period: float,
    meshcat: Meshcat | None = None,
) -> RegistrationDiagram:
    """Wire a simulated body and camera to the registration, which is not told the camera's pose.

    Args:
        true_positions: the body's positions (nq,), constant or over time, measured without an
            error.
        period: time between two images, and two updates [s].
        meshcat: where to show the body.
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    system = builder.AddNamedSystem("camera_registration", CameraRegistration(registration, period))
    model = registration.body.tree.model
    truth, images = add_simulated_cameras(builder, scene_graph, model, [camera], true_positions)
    builder.Connect(images[0], system.GetInputPort("label_image"))
    builder.Connect(truth, system.GetInputPort("measured_positions"))
    if meshcat is not None:
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    status_log = LogVectorOutput(system.GetOutputPort("status"), builder, publish_period=period)
    diagram = builder.Build()
    sensor = diagram.GetSubsystemByName(f"camera_{camera.name}")
    return RegistrationDiagram(diagram, system, sensor, status_log)
