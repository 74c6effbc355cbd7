"""A hand's angles and lengths from its silhouettes: what measures, and the filter.

label image -> HandSensor <-> TruncatedEkf.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.sensors import ImageLabel16I
from pydrake.trajectories import Trajectory

from drake_pose.arrays import Array
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.camera.models import Camera
from drake_pose.filtering.hand_silhouette import HandMeasurement, HandSilhouette
from drake_pose.filtering.state import Belief
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.estimators.diagrams import add_simulated_cameras
from drake_pose.systems.estimators.mask_player import MaskPlayer
from drake_pose.systems.estimators.truncated_ekf import STATISTICS, TruncatedEkf
from drake_pose.systems.ports import PortedSystem, connect_same

# Table 2 gives the scale of the first frame.
_FIRST_SCALE = 1.0


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
