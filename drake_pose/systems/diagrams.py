"""Camera registration as a system, and diagrams of matching and registration.

A diagram connects simulated cameras or recorded masks to an estimator, Meshcat and logs.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.geometry import Meshcat, RenderEngineVtkParams, SceneGraph
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import TrajectorySource
from pydrake.systems.sensors import ImageLabel16I
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
from drake_pose.search import PoseSearch
from drake_pose.silhouette.pictures.label_renderer import label_image_to_mask
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.bodies import add_posed_plant, show_in_meshcat
from drake_pose.systems.cameras import MaskPlayer, add_sensors
from drake_pose.systems.ports import (
    BeliefSystem,
    camera_port,
    connect_matching_ports,
    require_period,
)
from drake_pose.systems.silhouette_matcher import SilhouetteMatcher, SilhouetteTracker

REGISTRATION = ("keyframes", "outliers", "moves", "mean_iou")
"""Names of the elements of the output port ``registration`` of CameraRegistration."""

# Largest fraction of the image that a body may cover.
_MAX_COVERAGE = 0.6


class CameraRegistration(BeliefSystem[OnlineState]):
    """Finds a camera's pose from a body at measured positions, and detects its displacement.

    .. pydrake_system::

        name: CameraRegistration
        input_ports: [label_image, measured_positions]
        output_ports: [X_WC, covariance, status, registration]

    No initial guess is needed. A periodic update keeps frames in which the body's pose differs and
    searches for the camera when there are enough; output ports read the result. Then the pose is
    fitted again with each new kept frame, the oldest ones are dropped, and a camera that was moved
    is searched again. All state is in the context.

    Input ports:
        label_image (ImageLabel16I): an image that is not connected, or without the body, is
            ignored. The body's render labels are those of its model if made of a plant
            (``ArticulatedModel.from_plant``), else all but Drake's reserved ones.
        measured_positions (nq): of the body, synchronised with the image [rad or m]; ignored if not
            finite.

    Output ports:
        X_WC (RigidTransform): the camera's pose in the plant's world, as last found; its
            translation is NaN before.
        covariance (6 x 6, row by row): of the pose's error, a rotation vector [rad] and a
            translation [m] in world axes. Infinite unless the status is 1. If all that is seen and
            not round turns with a first joint, it allows for half a degree of that joint's zero.
        status (1): 0 before the camera is found; 1 while the pose is valid; 2 while the last frames
            are outliers, because the camera was moved or the body is occluded. X_WC must then not
            be used; the status returns to 1 when a frame fits or the camera is found elsewhere.
        registration (4): see ``REGISTRATION``. Number of kept frames; number of consecutive outlier
            frames; number of times that the camera was found elsewhere; mean intersection over
            union of body and mask over the kept frames, NaN before the camera is found.

    ``registration``: the method, with the body, and the camera with its intrinsics. ``period``:
    time between two updates [s].

    Raises SettingsError: the period is not positive; MaskError: in a simulation, if the body's
    labels cover more than 60 % of the image.
    """

    def __init__(self, registration: OnlineRegistration, period: float) -> None:
        super().__init__()
        require_period("registration", period)
        self._registration = registration
        self._tree, camera = registration.body.tree, registration.camera
        self.add_input("label_image", ImageLabel16I(camera.width, camera.height))
        self.add_input("measured_positions", len(self._tree.model.position_names))
        self.declare_belief(
            OnlineState(),
            period,
            X_WC=(RigidTransform(), _X_WC),
            covariance=(36, self._covariance),
            status=(1, lambda known: [float(registration.status(known))]),
            registration=(len(REGISTRATION), _registration_numbers),
        )

    def registered_camera(self, context: Context) -> PinholeCamera | None:
        """Return the camera at its pose in the plant's world; None unless the status is 1."""
        valid = self._valid_camera(self.belief(context))
        return None if valid is None else valid.camera

    def next_belief(self, context: Context, last: OnlineState) -> OnlineState:
        """Return the state after the context's image and positions; see the class for MaskError."""
        image = self.eval_input(context, "label_image")
        if image is None:
            return last
        q = np.array(self.GetInputPort("measured_positions").Eval(context))
        if not np.isfinite(q).all():
            return last
        values = np.concatenate(self._tree.values_from_positions(q))
        mask = label_image_to_mask(image, self._tree.model.labels)
        covered = float(mask.mean())
        if covered > _MAX_COVERAGE:
            raise MaskError(
                f"{self.get_name()}: labels of the body cover {covered:.0%} of the image of "
                f"camera '{self._registration.camera.name}' ({_MAX_COVERAGE:.0%} at most); "
                "they may include the ground; use a model from ArticulatedModel.from_plant, which "
                "has the body's own labels"
            )
        return self._registration.next(last, PosedFrame(f"{context.get_time():g} s", values, mask))

    def _valid_camera(self, known: OnlineState) -> RegisteredCamera | None:
        """Return the camera as it was found; None unless the status is 1."""
        is_believed = self._registration.status(known) is CameraStatus.REGISTERED
        return known.registered if is_believed else None

    def _covariance(self, known: OnlineState) -> Array:
        """Return the output ``covariance`` (36,)."""
        valid = self._valid_camera(known)
        covariance = np.diag(np.full(6, np.inf)) if valid is None else valid.covariance
        return covariance.ravel()


def _X_WC(known: OnlineState) -> RigidTransform:
    """Return the camera's pose as it was last found; its translation is NaN before."""
    if known.registered is None:
        return RigidTransform(np.full(3, np.nan))
    return RigidTransform(known.registered.camera.X_WC)


def _registration_numbers(known: OnlineState) -> list[float]:
    """Return the elements of REGISTRATION."""
    iou = np.nan
    if known.registered is not None:
        iou = float(np.mean([frame.iou for frame in known.registered.frames]))
    return [len(known.keyframes), known.outlier_count, known.moves, iou]


def build_recorded_matching(
    scene: Scene,
    search: PoseSearch,
    cameras: Sequence[Camera],
    frames: Sequence[str] | None = None,
    root_positions: Mapping[str, np.ndarray] | None = None,
    tracking: TrackingSettings | None = None,
    starts: Mapping[str, np.ndarray] | None = None,
) -> tuple[Diagram, SilhouetteMatcher]:
    """Build a diagram that estimates poses in recorded masks; return it and its estimator.

    It contains a MaskPlayer and a SilhouetteMatcher or SilhouetteTracker. Frame k is matched at
    time k times the player's period. The tracker's search has no time limit, so that results are
    repeatable.

    Args:
        scene: the recorded masks.
        search: the search for the poses of a body.
        cameras: the cameras to use, matched together.
        frames: names of the frames to play; None: all.
        root_positions: the root's position (3,) in the world [m] by name of the frame; None: as in
            the pose tree.
        tracking: settings of a SilhouetteTracker; None: a SilhouetteMatcher matches each frame on
            its own.
        starts: approximate positions (nq,) [rad or m] by name of the frame: a track starts there
            without a search, also after a loss. None: none are known.
    """
    player = MaskPlayer(scene, cameras, frames, positions=starts, root_positions=root_positions)
    matcher = SilhouetteMatcher(search, cameras, player.period)
    if tracking is not None:
        matcher = SilhouetteTracker(
            search, cameras, player.period, tracking=tracking, color_cameras=player.color_cameras,
            search_time=None,
        )  # fmt: skip
    builder = DiagramBuilder()
    builder.AddNamedSystem("mask_player", player)
    builder.AddNamedSystem("silhouette_matcher", matcher)
    connect_matching_ports(builder, player, matcher)
    return builder.Build(), matcher


def build_simulation(
    estimator: SilhouetteMatcher | CameraRegistration,
    model: ParsedModel,
    cameras: Sequence[Camera],
    true_positions: Trajectory | np.ndarray,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """Build a diagram in which an estimator sees a simulated body in rendered images.

    RgbdSensors ``camera_<name>`` see a body that moves on a trajectory. A CameraRegistration gets
    its true positions as the measured ones.

    Args:
        estimator: a matcher, a tracker or a registration.
        model: the body.
        cameras: the estimator's cameras; the registered camera is here at its true pose.
        true_positions: the true body's positions (nq,) [rad or m], constant or over time.
        meshcat: where to show the body (path ``true``), and a second one at a matcher's
            ``last_positions`` (``estimated``); None: nowhere.
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    builder.AddNamedSystem("estimator", estimator)
    truth, images = add_simulated_cameras(builder, scene_graph, model, cameras, true_positions)
    for camera, image in zip(cameras, images, strict=True):
        builder.Connect(image, estimator.GetInputPort(camera_port("label_image", camera, cameras)))
    if isinstance(estimator, CameraRegistration):
        builder.Connect(truth, estimator.GetInputPort("measured_positions"))
    elif meshcat is not None:
        # Of its own SceneGraph, so that the sensors do not see it.
        shown = builder.AddNamedSystem("estimate_scene_graph", SceneGraph())
        estimate = estimator.GetOutputPort("last_positions")
        add_posed_plant(builder, shown, model, estimate, "estimated")
        show_in_meshcat(builder, scene_graph, meshcat, model, truth, "true")
        show_in_meshcat(builder, shown, meshcat, model, estimate, "estimated")
        meshcat.SetProperty("estimated", "modulated_opacity", 0.5)
    return builder.Build()


def add_simulated_cameras(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    model: ParsedModel,
    cameras: Sequence[Camera],
    true_positions: Trajectory | np.ndarray,
) -> tuple[OutputPort, list[OutputPort]]:
    """Add a body at given positions, and RgbdSensors that see it, to a diagram.

    Args:
        builder: the diagram.
        scene_graph: a system of the diagram.
        model: the body.
        cameras: the cameras to simulate.
        true_positions: the body's positions (nq,) [rad or m], constant or over time.

    Returns the port of the positions, and that of each camera's label image.
    """
    if isinstance(true_positions, np.ndarray):
        true_positions = PiecewisePolynomial(true_positions.reshape(-1, 1))
    source = builder.AddNamedSystem("true_positions", TrajectorySource(true_positions))
    truth = source.get_output_port()
    labels = {name: label for label, name in enumerate(model.link_names)}
    add_posed_plant(builder, scene_graph, model, truth, "true", labels)
    # Pinhole cameras see to 1 km; the depths of parallel ones must be tight.
    ranges = {
        one.name: _depth_range(one, model, true_positions)
        for one in cameras
        if not isinstance(one, PinholeCamera)
    }
    named = {one.name: one for one in cameras}
    sensors = add_sensors(builder, scene_graph, named, ranges, RenderEngineVtkParams())
    return truth, [sensor.label_image_output_port() for sensor in sensors.values()]


def _depth_range(
    camera: Camera, model: ParsedModel, true_positions: Trajectory
) -> tuple[float, float]:
    """Return the nearest and farthest depth [m] of a moving body in a camera.

    Both have a margin of 0.5 m and a tenth of the range, because the body is sampled at 100 times.
    """
    tree, depths = build_pose_tree(model), []
    # A constant trajectory has infinite times.
    ends = np.array([true_positions.start_time(), true_positions.end_time()])
    start, end = np.where(np.isfinite(ends), ends, 0.0).tolist()
    for time in np.linspace(start, end, 100):
        values = tree.values_from_positions(true_positions.value(time).ravel())
        for node, taken, X_WN in zip(tree.nodes, values, tree.node_poses(values), strict=True):
            p_N = node.surface(taken).vertices
            depths.append(camera.project(p_N @ X_WN[:3, :3].T + X_WN[:3, 3])[1])
    low, high = np.min(np.concatenate(depths)), np.max(np.concatenate(depths))
    margin = 0.5 + 0.1 * (high - low)
    return float(low - margin), float(high + margin)
