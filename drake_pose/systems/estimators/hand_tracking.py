"""Tracking by segments' axes in silhouettes: a camera, what measures, the filter.

label image -> AxisSensor or HandSensor <-> TruncatedEkf; AxisSensor -> logs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink
from pydrake.systems.sensors import ImageLabel16I
from pydrake.trajectories import Trajectory

from drake_pose.arrays import Array, Mask
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.filtering.axes import AxisObservation, Ends
from drake_pose.filtering.contour import ContourObservation
from drake_pose.filtering.contour_tracker import ContourTracker, TrackingSettings
from drake_pose.filtering.couplings import model_inequalities
from drake_pose.filtering.hand_silhouette import HandMeasurement, HandSilhouette
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.search.estimates import View
from drake_pose.search.scoring import PoseSearch
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.estimators.diagrams import (
    ESTIMATE_COLOUR,
    add_simulated_cameras,
    show_estimate,
)
from drake_pose.systems.estimators.mask_player import MaskPlayer
from drake_pose.systems.estimators.truncated_ekf import STATISTICS, TruncatedEkf
from drake_pose.systems.ports import PortedSystem, connect_same

# Table 2 gives the scale of the first frame.
_FIRST_SCALE = 1.0
# The body is not where it was predicted if so large a share of the silhouette differs.
_ASTRAY = 0.3


class AxisSensor(PortedSystem):
    """Measures segments' axes in a silhouette, beside the prediction of the filter that uses them.

    .. pydrake_system::

        name: AxisSensor
        input_ports: [label_image, estimated_state, covariance, statistics]
        output_ports: [measurement, measurement_covariance, restart, matched_state,
          estimated_positions, position_deviations]

    The inputs but the image come from the ``TruncatedEkf`` that takes the first four outputs, the
    last of them as its ``reset_state``. Of the label image only the silhouette is used, all that
    has a label; an image that is not connected shows nothing.

    ``restart`` is 1 at the filter's first step, while it says that the track is lost, and where
    the silhouette differs by a third from the predicted one. Then the axes are
    measured beside ``matched_state`` (n), a state at rest that the search finds, NaN where it finds
    none; the search is asked at no other time. Where the first pictures are blank, the filter
    begins with its own start instead, and asks when that proves wrong; a gap later is bridged by
    the prediction. ``estimated_positions`` and ``position_deviations`` (nq) are the filter's belief
    as positions of the plant; deviations are NaN where a position is held.

    Args:
        transition: (n, n) one step of the filter's prediction.

    Raises:
        SettingsError: a transition of another size than the state's, or a search that is made for
            another tree than that of the observation's body.
    """

    def __init__(
        self, observation: AxisObservation, transition: Array, search: PoseSearch, camera: Camera
    ) -> None:
        super().__init__()
        self._body = body = observation.body
        n, m = len(body.layout), len(observation.names)
        if transition.shape != (n, n):
            raise SettingsError(f"the transition must be {(n, n)}, not {transition.shape}")
        if search.tree is not body.tree:
            raise SettingsError("the search and the observation must share one pose tree")
        self._observation, self._transition = observation, transition
        self._search, self._camera = search, camera
        image = self.add_input("label_image", ImageLabel16I(camera.width, camera.height))
        state = self.add_input("estimated_state", n)
        covariance = self.add_input("covariance", n * n)
        self.add_input("statistics", len(STATISTICS))
        measured = self.add_cache("measured", self._measure)

        def row(k: int) -> Callable[[Context], Array]:
            return lambda context: measured.Eval(context)[k]

        sizes = {"measurement": m, "measurement_covariance": m * m, "restart": 1}
        for k, (name, size) in enumerate(sizes.items()):
            self.add_output(name, size, row(k))
        self._matched = self.add_output("matched_state", n, self._match, {image.ticket()})
        nq = len(body.tree.model.position_names)
        # What shows the estimated body must not seem to depend on the image that it is beside.
        self.add_output(
            "estimated_positions",
            nq,
            lambda context: body.positions(state.Eval(context))[0],
            {state.ticket()},
        )
        self.add_output("position_deviations", nq, self._deviations, {covariance.ticket()})

    def _measure(self, context: Context) -> tuple[Array, Array, Array]:
        mask, m = self._see(context), len(self._observation.names)
        if mask is None:
            return np.full(m, np.nan), np.full(m * m, np.nan), np.zeros(1)
        statistics = dict(zip(STATISTICS, self.given(context, "statistics"), strict=True))
        x = self._transition @ self.given(context, "estimated_state")
        wrong, area = self._body.difference(x, [(self._camera, mask)])
        restart = statistics["step"] == 0 or statistics["lost"] > 0 or wrong > _ASTRAY * area
        matched = self._matched.Eval(context) if restart else None
        if matched is not None and np.isfinite(matched).all():
            x = matched
        y, covariance = self._observation.measure(mask, x)
        return y, covariance.ravel(), np.array([float(restart)])

    def _see(self, context: Context) -> Mask | None:
        """(H, W) the silhouette; None where there is no image, or nothing in it."""
        image = self.given(context, "label_image")
        mask = None if image is None else label_image_to_mask(image)
        return mask if mask is not None and mask.any() else None

    def _match(self, context: Context) -> Array:
        """The state at rest (n,) that the search finds."""
        mask = self._see(context)
        if mask is not None:
            result = self._search.match([View(self._camera, mask)])
            if result.found:
                return self._body.state(result.q, result.X_WB)
        return np.full(len(self._body.layout), np.nan)

    def _deviations(self, context: Context) -> Array:
        layout, model = self._body.layout, self._body.tree.model
        P = self.given(context, "covariance").reshape(len(layout), len(layout))
        seen = [*layout.moving, *layout.constant]
        deviations = np.full(len(model.position_names), np.nan)
        own = [model.position_index(name) for name in seen]
        deviations[own] = np.sqrt(np.diag(P)[layout.indices(seen)])
        return deviations


class HandSensor(PortedSystem):
    """Measures a hand's axes and tips in a silhouette, lengths unknown: figure 17.

    .. pydrake_system::

        name: HandSensor
        input_ports: [label_image, estimated_state, covariance, statistics]
        output_ports: [measurement, measurement_covariance, rough_state, difference]

    The inputs but the image come from the ``TruncatedEkf`` that takes the first two outputs. Of the
    label image only the silhouette is used; an image that is not connected, or blank, shows
    nothing. ``rough_state`` (n) and ``difference`` (1) are as of ``HandMeasurement``.

    Args:
        silhouette: measures; its filter is the ``TruncatedEkf``'s.
    """

    def __init__(self, silhouette: HandSilhouette) -> None:
        super().__init__()
        self._silhouette = silhouette
        n = len(silhouette.belief_filter.layout)
        m = len(silhouette.belief_filter.observation.names)
        self.add_input("label_image", ImageLabel16I(silhouette.width, silhouette.height))
        self.add_input("estimated_state", n)
        self.add_input("covariance", n * n)
        self.add_input("statistics", len(STATISTICS))
        measured = self.add_cache("measured", self._measure)

        def show(name: str, size: int, read: Callable[[HandMeasurement], Array]) -> None:
            self.add_output(name, size, lambda context: read(measured.Eval(context)))

        show("measurement", m, lambda one: one.y)
        show("measurement_covariance", m * m, lambda one: one.covariance.ravel())
        show("rough_state", n, lambda one: one.rough)
        show("difference", 1, lambda one: np.array([one.difference]))

    def _measure(self, context: Context) -> HandMeasurement:
        image, mean = self.given(context, "label_image"), self.given(context, "estimated_state")
        covariance = self.given(context, "covariance").reshape(len(mean), len(mean))
        begun = self.given(context, "statistics")[STATISTICS.index("step")] > 0
        belief = Belief(mean, covariance)
        silhouette = self._silhouette
        if image is None:
            mask = np.zeros((silhouette.height, silhouette.width), dtype=np.bool_)
        else:
            mask = label_image_to_mask(image)
        if begun:
            return silhouette.measure(mask, silhouette.belief_filter.predicted(belief))
        return silhouette.measure(mask, belief, _FIRST_SCALE)


def build_hand_estimation(
    model: ParsedModel,
    camera: Camera,
    silhouette: HandSilhouette,
    start: Belief,
    true_positions: Trajectory,
    period: float,
) -> tuple[Diagram, TruncatedEkf, HandSensor]:
    """Plant, Drake's renderer, ``HandSensor``, ``TruncatedEkf``: angles, lengths from pictures.

    Args:
        model: the hand that is seen, in the plant's positions over time.
        start: the belief before the first picture.
        period: time between two pictures [s].
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    _, images = add_simulated_cameras(builder, scene_graph, model, [camera], true_positions)
    return _add_hand_filter(builder, images[0], silhouette, start, period)


def build_recorded_hand_estimation(
    scene: Scene, silhouette: HandSilhouette, start: Belief
) -> tuple[Diagram, TruncatedEkf, HandSensor]:
    """The same of a scene's recorded silhouettes: ``MaskPlayer``, ``HandSensor``, ``TruncatedEkf``.

    Args:
        scene: of one camera.
        start: the belief before the first picture.
    """
    builder, player = DiagramBuilder(), MaskPlayer(scene, scene.cameras)
    builder.AddNamedSystem("mask_player", player)
    image = player.GetOutputPort("label_image")
    return _add_hand_filter(builder, image, silhouette, start, player.period)


def _add_hand_filter(
    builder: DiagramBuilder, image: OutputPort, silhouette: HandSilhouette, start: Belief,
    period: float,
) -> tuple[Diagram, TruncatedEkf, HandSensor]:  # fmt: skip
    ekf = TruncatedEkf(silhouette.belief_filter, start, period)
    builder.AddNamedSystem("truncated_ekf", ekf)
    sensor = builder.AddNamedSystem("hand_sensor", HandSensor(silhouette))
    builder.Connect(image, sensor.GetInputPort("label_image"))
    connect_same(builder, sensor, ekf)
    connect_same(builder, ekf, sensor)
    return builder.Build(), ekf, sensor


@dataclass(frozen=True)
class HandTracking:
    """The parts of a tracking diagram that one asks afterwards.

    Attributes:
        ekf: the filter; its ports give the hypotheses and the active limits.
        sensor: gives the estimated positions and their standard deviations.
        positions_log, deviations_log: log them once a period; 2 sigma is twice the latter.
        statistics_log, restart_log: log the filter's ``statistics`` and the sensor's ``restart``.
    """

    ekf: TruncatedEkf
    sensor: AxisSensor
    positions_log: VectorLogSink
    deviations_log: VectorLogSink
    statistics_log: VectorLogSink
    restart_log: VectorLogSink


def build_hand_tracking(
    search: PoseSearch,
    camera: Camera,
    axes: Mapping[str, Ends],
    true_positions: Trajectory | np.ndarray,
    period: float,
    meshcat: Meshcat | None = None,
    tracking: TrackingSettings | None = None,
) -> tuple[Diagram, HandTracking]:
    """A simulated hand, or any body, and its camera, whose label images a filter gets.

    The filter is of all free positions, inside the model's limits and couplings.

    Args:
        search: asked in the first frame, and when the track is lost; its tree says what is free.
        axes: start and end of each segment's axis (3,), (3,) in its link's frame, by name [m].
        true_positions: the true body's positions (nq,), constant or over time.
        period: time between two frames [s].
        meshcat: where to show the true and the estimated body.
        tracking: how the body may move; its ``root_moves`` and what is about contours is not used.

    Raises:
        SettingsError: a period that is not positive, no axes, or a tree without free values.
        UnknownNameError: there is no segment of such a name.
    """
    builder, model = DiagramBuilder(), search.tree.model
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    _, images = add_simulated_cameras(builder, scene_graph, model, [camera], true_positions)
    body = ContourObservation(search.tree, [camera])
    middle = (0.5 * (camera.width - 1), 0.5 * (camera.height - 1))
    observation = AxisObservation(body, camera, axes, middle)
    belief_filter, transition, start = _axis_filter(
        observation, period, tracking or TrackingSettings()
    )
    ekf = builder.AddNamedSystem("truncated_ekf", TruncatedEkf(belief_filter, start, period))
    sensor = AxisSensor(observation, transition, search, camera)
    builder.AddNamedSystem("axis_sensor", sensor)
    builder.Connect(images[0], sensor.GetInputPort("label_image"))
    builder.Connect(sensor.GetOutputPort("matched_state"), ekf.GetInputPort("reset_state"))
    connect_same(builder, sensor, ekf)
    connect_same(builder, ekf, sensor)
    estimate = sensor.GetOutputPort("estimated_positions")
    if meshcat is not None:
        show_estimate(builder, scene_graph, model, estimate, meshcat, ESTIMATE_COLOUR)

    def log(port: OutputPort) -> VectorLogSink:
        return LogVectorOutput(port, builder, publish_period=period)

    parts = HandTracking(
        ekf=ekf,
        sensor=sensor,
        positions_log=log(estimate),
        deviations_log=log(sensor.GetOutputPort("position_deviations")),
        statistics_log=log(ekf.GetOutputPort("statistics")),
        restart_log=log(sensor.GetOutputPort("restart")),
    )
    return builder.Build(), parts


def _axis_filter(
    observation: AxisObservation, period: float, tracking: TrackingSettings
) -> tuple[TruncatedFilter, Array, Belief]:
    """A filter of a body's free positions that measures axes, its transition, its first belief."""
    body = observation.body
    layout, model = body.layout, body.tree.model
    tracker = ContourTracker(body, period, tracking)
    # The filter truncates its start where that is; here it is not known yet.
    start = tracker.start_belief(body.state(model.default_positions))
    transition = layout.transition(math.exp(-period / tracking.memory))
    belief_filter = TruncatedFilter(
        layout,
        observation,
        model_inequalities(model).only_of(layout.names),
        layout.process_noise({n: period**2 * tracker.acceleration(n) for n in layout.moving}),
        FilterSettings(),
        transition,
    )
    return belief_filter, transition, start
