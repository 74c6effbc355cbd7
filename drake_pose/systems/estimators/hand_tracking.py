"""Ready diagrams: a camera, the matcher at first and after a loss, axes, the truncated filter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, SceneGraph
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink
from pydrake.trajectories import Trajectory

from drake_pose.camera.models import Camera
from drake_pose.filtering.kalman.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.filtering.measurements.axes import AxisObservation
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.measurements.segment_axes import AxisSettings, Ends
from drake_pose.filtering.state import Belief
from drake_pose.filtering.tracking.contour_tracker import ContourTracker, TrackingSettings
from drake_pose.filtering.truncation.couplings import model_inequalities
from drake_pose.search.scoring import PoseSearch
from drake_pose.systems.estimators.axis_sensor import AxisSensor, BodyBelief, StateMatcher
from drake_pose.systems.estimators.diagrams import (
    ESTIMATE_COLOUR,
    add_posed_body,
    add_simulated_cameras,
)
from drake_pose.systems.estimators.truncated_ekf import TruncatedEkf


@dataclass(frozen=True)
class HandTracking:
    """The parts of a tracking diagram that one asks afterwards.

    Attributes:
        ekf: the filter; its ports give the hypotheses and the active limits.
        belief: the estimated positions and their standard deviations.
        positions_log, deviations_log: log them once a period; 2 sigma is twice the latter.
        statistics_log, restart_log: log the filter's ``statistics`` and the sensor's ``restart``.
    """

    ekf: TruncatedEkf
    belief: BodyBelief
    positions_log: VectorLogSink
    deviations_log: VectorLogSink
    statistics_log: VectorLogSink
    restart_log: VectorLogSink


def add_hand_tracking(
    builder: DiagramBuilder,
    search: PoseSearch,
    camera: Camera,
    axes: Mapping[str, Ends],
    label_image: OutputPort,
    period: float,
    tracking: TrackingSettings | None = None,
    settings: AxisSettings | None = None,
) -> HandTracking:
    """Wire label images to a filter of all free positions, inside the model's limits and couplings.

    label image -> StateMatcher (first frame, and after a loss), AxisSensor -> TruncatedEkf ->
    BodyBelief -> logs.

    Args:
        builder: the diagram under construction.
        search: asked in the first frame, and when the track is lost; its tree says what is free.
        camera: where the images come from.
        axes: start and end of each segment's axis (3,), (3,) in its link's frame, by name [m].
        label_image: the images, labelled by the links' indices.
        period: time between two frames [s].
        tracking: how the body may move; its ``root_moves`` and what is about contours is not used.
        settings: how axes are measured.

    Raises:
        SettingsError: a period that is not positive, no axes, or a tree without free values.
        UnknownNameError: there is no segment of such a name.
    """
    parts = _filter_parts(search, camera, axes, period, tracking or TrackingSettings(), settings)
    observation = parts.observation
    ekf = builder.AddNamedSystem("truncated_ekf", TruncatedEkf(parts.filter, parts.start, period))
    sensor = builder.AddNamedSystem(
        "axis_sensor", AxisSensor(observation, parts.transition, camera)
    )
    matcher = builder.AddNamedSystem("matcher", StateMatcher(search, observation, camera))
    belief = builder.AddNamedSystem("belief", BodyBelief(observation))
    matched = matcher.GetOutputPort("matched_state")
    builder.Connect(label_image, sensor.GetInputPort("label_image"))
    builder.Connect(label_image, matcher.GetInputPort("label_image"))
    builder.Connect(matched, sensor.GetInputPort("matched_state"))
    builder.Connect(matched, ekf.GetInputPort("reset_state"))
    for name in ("measurement", "measurement_variances", "restart"):
        builder.Connect(sensor.GetOutputPort(name), ekf.GetInputPort(name))
    for name in ("estimated_state", "statistics"):
        builder.Connect(ekf.GetOutputPort(name), sensor.GetInputPort(name))
    for name in ("estimated_state", "covariance"):
        builder.Connect(ekf.GetOutputPort(name), belief.GetInputPort(name))

    def log(port: OutputPort) -> VectorLogSink:
        return LogVectorOutput(port, builder, publish_period=period)

    return HandTracking(
        ekf=ekf,
        belief=belief,
        positions_log=log(belief.GetOutputPort("estimated_positions")),
        deviations_log=log(belief.GetOutputPort("position_deviations")),
        statistics_log=log(ekf.GetOutputPort("statistics")),
        restart_log=log(sensor.GetOutputPort("restart")),
    )


class _FilterParts(NamedTuple):
    """A filter of a body's free positions that measures axes. start: its first belief."""

    filter: TruncatedFilter
    observation: AxisObservation
    transition: np.ndarray
    start: Belief


def _filter_parts(
    search: PoseSearch,
    camera: Camera,
    axes: Mapping[str, Ends],
    period: float,
    tracking: TrackingSettings,
    settings: AxisSettings | None,
) -> _FilterParts:
    """What is needed to filter; the arguments are those of add_hand_tracking."""
    body = ContourObservation(search.tree, [camera])
    # The filter truncates its start where that is; here it is not known yet.
    start = ContourTracker(body, period, tracking).start_belief(
        body.state(search.tree.model.default_positions)
    )
    middle = (0.5 * (camera.width - 1), 0.5 * (camera.height - 1))
    observation = AxisObservation(body, camera, axes, middle, settings)
    layout = body.layout
    accelerations = {
        name: period**2
        * (tracking.angle_acceleration if body.is_angle(name) else tracking.length_acceleration)
        for name in layout.moving
    }
    transition = layout.transition(math.exp(-period / tracking.memory))
    belief_filter = TruncatedFilter(
        layout,
        observation,
        model_inequalities(search.tree.model).only_of(layout.names),
        layout.process_noise(accelerations),
        FilterSettings(),
        transition,
    )
    return _FilterParts(belief_filter, observation, transition, start)


def build_hand_tracking(
    search: PoseSearch,
    camera: Camera,
    axes: Mapping[str, Ends],
    true_positions: Trajectory | np.ndarray,
    period: float,
    meshcat: Meshcat | None = None,
    tracking: TrackingSettings | None = None,
    settings: AxisSettings | None = None,
) -> tuple[Diagram, HandTracking]:
    """A simulated hand, or any body, and its camera, tracked by ``add_hand_tracking``.

    Args:
        search: as there, with ``camera``, ``axes``, ``period``, ``tracking`` and ``settings``.
        camera: where the sensor is.
        axes: of the segments.
        true_positions: the true body's positions (nq,), constant or over time.
        period: time between two images [s].
        meshcat: where to show the true and the estimated body; nowhere where not given.
        tracking: how the body may move.
        settings: how axes are measured.

    Returns:
        The diagram, and its parts.

    Raises:
        SettingsError, UnknownNameError: as ``add_hand_tracking``.
    """
    builder, model = DiagramBuilder(), search.tree.model
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    _, images = add_simulated_cameras(builder, scene_graph, model, [camera], true_positions)
    parts = add_hand_tracking(builder, search, camera, axes, images[0], period, tracking, settings)
    if meshcat is not None:
        add_posed_body(builder, scene_graph, model, parts.belief, "estimated", ESTIMATE_COLOUR)
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    return builder.Build(), parts
