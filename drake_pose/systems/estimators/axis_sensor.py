"""Segment axes from label images, and where to begin: the eyes of a truncated filter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem, ValueProducer
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.filtering.measurements.axes import AxisObservation
from drake_pose.search.estimates import View
from drake_pose.search.scoring import PoseSearch
from drake_pose.silhouette.pictures.label_images import EMPTY, label_data, label_image_to_mask
from drake_pose.systems.estimators.truncated_ekf import STATISTICS

Array = NDArray[np.float64]

# A segment of fewer pixels in the picture is not missed.
_FEWEST_PIXELS = 30


class AxisSensor(LeafSystem):
    """Measures segments' axes in a label image, beside the filter's prediction.

    .. pydrake_system::

        name: AxisSensor
        input_ports:
        - label_image
        - estimated_state
        - statistics
        - matched_state (optional)
        output_ports:
        - measurement
        - measurement_variances
        - restart

    ``estimated_state`` and ``statistics`` come from the ``TruncatedEkf`` that takes the outputs,
    whose ports have the same names; ``restart`` goes there, too. The label image's labels are the
    indices of the links, as Drake's renderer gives them to a plant that holds the body alone; an
    image that is not connected shows nothing.

    ``restart`` is 1 at the filter's first step, while it says that the track is lost, and where
    fewer than half of the segments in the picture are where they were predicted. Then the axes are
    measured beside ``matched_state`` (n), which the filter must take for its ``reset_state``; it is
    evaluated at no other time. Where the first pictures are blank, the filter begins with its own
    start instead, and asks when that proves wrong; a gap later is bridged by the prediction.

    Args:
        observation: what is measured.
        transition: (n, n) one step of the filter's prediction.
        camera: where the images come from.

    Raises:
        SettingsError: a transition of another size than the state's.
    """

    def __init__(self, observation: AxisObservation, transition: Array, camera: Camera) -> None:
        super().__init__()
        n, m = len(observation.body.layout), len(observation.names)
        if transition.shape != (n, n):
            raise SettingsError(f"the transition must be {(n, n)}, not {transition.shape}")
        self._observation, self._transition = observation, transition
        model = observation.body.tree.model
        self._labels = [model.link_index(link) for link in observation.links]
        self._image = _declare_image(self, camera)
        self._estimate = self.DeclareVectorInputPort("estimated_state", n)
        self._statistics = self.DeclareVectorInputPort("statistics", len(STATISTICS))
        self._matched = self.DeclareVectorInputPort("matched_state", n)
        measured = self.DeclareCacheEntry(
            "measured", ValueProducer(lambda: AbstractValue.Make([]), self._calc)
        )
        for row, (name, size) in enumerate(
            (("measurement", m), ("measurement_variances", m), ("restart", 1))
        ):

            def calculate(context: Context, output: BasicVector, row: int = row) -> None:
                output.SetFromVector(measured.Eval(context)[row])

            self.DeclareVectorOutputPort(name, size, calculate, {measured.ticket()})

    def _calc(self, context: Context, output: AbstractValue) -> None:
        nothing = np.full(len(self._observation.names), np.nan)
        labels = self._see(context)
        if labels is None:
            output.set_value([nothing, nothing, np.zeros(1)])
            return
        statistics = dict(zip(STATISTICS, self._statistics.Eval(context), strict=True))
        x = self._transition @ self._estimate.Eval(context)
        y, variances = self._observation.measure(labels, x)
        visible = sum(np.count_nonzero(labels == k) >= _FEWEST_PIXELS for k in self._labels)
        astray = 2 * np.count_nonzero(np.isfinite(y[::2])) < visible
        restart = statistics["step"] == 0 or statistics["lost"] > 0 or astray
        if restart and self._matched.HasValue(context):
            matched = np.array(self._matched.Eval(context))
            if np.isfinite(matched).all():
                y, variances = self._observation.measure(labels, matched)
        output.set_value([y, variances, np.array([float(restart)])])

    def _see(self, context: Context) -> NDArray[np.int16] | None:
        """(H, W) the label image; None where there is none, or none of the body."""
        if not self._image.HasValue(context):
            return None
        labels = label_data(self._image.Eval(context))
        if not np.isin(labels, self._labels).any():
            return None
        return np.where(labels == EMPTY, np.int16(-1), labels)


class StateMatcher(LeafSystem):
    """Matches a body's silhouette whenever its output is asked for, and never else.

    .. pydrake_system::

        name: StateMatcher
        input_ports:
        - label_image
        output_ports:
        - matched_state

    ``SilhouetteMatcher`` matches once a period; this one costs nothing while a filter tracks.
    ``matched_state`` (n) is a state at rest; NaN where no pose is found.

    Args:
        search: the search, made for the pose tree of the observation's body.
        observation: says what a state is.
        camera: where the images come from.

    Raises:
        SettingsError: the search is made for another tree.
    """

    def __init__(self, search: PoseSearch, observation: AxisObservation, camera: Camera) -> None:
        super().__init__()
        if search.tree is not observation.body.tree:
            raise SettingsError("the search and the observation must share one pose tree")
        self._search, self._body, self._camera = search, observation.body, camera
        self._image = _declare_image(self, camera)
        self.DeclareVectorOutputPort(
            "matched_state", len(self._body.layout), self._match, {self._image.ticket()}
        )

    def _match(self, context: Context, output: BasicVector) -> None:
        state = np.full(len(self._body.layout), np.nan)
        if self._image.HasValue(context):
            mask = label_image_to_mask(self._image.Eval(context))
            if mask.any():
                result = self._search.match([View(self._camera, mask)])
                if result.found:
                    state = self._body.state(result.q, result.X_WB)
        output.SetFromVector(state)


class BodyBelief(LeafSystem):
    """A filter's belief as positions of the plant, with their standard deviations.

    .. pydrake_system::

        name: BodyBelief
        input_ports:
        - estimated_state
        - covariance
        output_ports:
        - estimated_positions
        - position_deviations

    ``position_deviations`` (nq) are NaN where a position is held.

    Args:
        observation: says what a state is.
    """

    def __init__(self, observation: AxisObservation) -> None:
        super().__init__()
        self._body = observation.body
        layout, model = self._body.layout, self._body.tree.model
        seen = [*layout.moving, *layout.constant]
        self._from = layout.indices(seen)
        self._to = [model.position_index(name) for name in seen]
        n, self._count = len(layout), len(model.position_names)
        self._state = self.DeclareVectorInputPort("estimated_state", n)
        self._covariance = self.DeclareVectorInputPort("covariance", n * n)
        self.DeclareVectorOutputPort(
            "estimated_positions", self._count, self._calc_positions, {self._state.ticket()}
        )
        self.DeclareVectorOutputPort(
            "position_deviations", self._count, self._calc_deviations, {self._covariance.ticket()}
        )

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._body.positions(np.array(self._state.Eval(context)))[0])

    def _calc_deviations(self, context: Context, output: BasicVector) -> None:
        deviations = np.full(self._count, np.nan)
        n = len(self._body.layout)
        P = np.array(self._covariance.Eval(context)).reshape(n, n)
        deviations[self._to] = np.sqrt(np.diag(P)[self._from])
        output.SetFromVector(deviations)


def _declare_image(system: LeafSystem, camera: Camera) -> InputPort:
    image = ImageLabel16I(camera.width, camera.height)
    return system.DeclareAbstractInputPort("label_image", AbstractValue.Make(image))
