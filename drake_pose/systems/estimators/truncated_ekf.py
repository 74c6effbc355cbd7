"""The truncated filter as a Drake system: measurements in, a belief within limits out."""

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, EventStatus, LeafSystem
from scipy.special import chdtri

from drake_pose.errors import SettingsError
from drake_pose.filtering.kalman.truncated_filter import FilterState, TruncatedFilter
from drake_pose.filtering.kalman.update import ObservationModel, with_variances
from drake_pose.filtering.state import Belief, make_belief
from drake_pose.systems.estimators.filter_packing import (
    HEAD,
    FilterPacking,
    require_time_forward,
)

Array = NDArray[np.float64]

STATISTICS = ("step", "hypotheses", "distance", "count", "lost")
"""What the elements of the output ``statistics`` are."""

_LOSS_PROBABILITY = 1e-6


class TruncatedEkf(LeafSystem):
    """Estimates a state from measurements, inside linear inequalities.

    .. pydrake_system::

        name: TruncatedEkf
        input_ports:
        - measurement (optional)
        - measurement_variances (optional)
        - reset_state (optional)
        - restart (optional)
        output_ports:
        - estimated_state
        - covariance
        - hypothesis_weights
        - hypothesis_states
        - active_limits
        - statistics

    A periodic update predicts and uses the measurement: NaN where something is occluded; all NaN,
    or an unconnected port, where a camera is late or missing, which leaves the prediction.
    ``measurement_variances`` are those of this one's noise, finite where it is; the observation
    model's own where the port is not connected.

    - ``estimated_state`` (n), ``covariance`` (n x n, row by row): of the heaviest hypothesis.
    - ``hypothesis_weights`` (cap), ``hypothesis_states`` (cap x n, row by row): the heaviest
      first, weights 0 and states NaN where there are fewer.
    - ``active_limits`` (K): 1 where that row of ``filter.inequalities`` cut the best belief.
    - ``statistics``: see ``STATISTICS``. ``lost`` is 1 while measurements have been as unlikely
      as one in a million for several steps.

    At the first update, while the track is lost, and whenever ``restart`` (1) is not 0, the filter
    starts again from ``reset_state`` (n), for example from a matcher, if all its elements are
    finite; with the covariance of the belief given here.

    Args:
        belief_filter: says what is estimated, from what, and inside which limits.
        start: the belief before the first measurement.
        period: time between two updates [s]; one step of the filter's prediction.
        offset: time of the first update [s].
        patience: how many unlikely measurements in a row make a loss.

    Raises:
        SettingsError: a start that does not fit, a period or patience that is not positive; and,
            in a simulation, time that runs backwards.
    """

    def __init__(
        self,
        belief_filter: TruncatedFilter,
        start: Belief,
        period: float,
        offset: float = 0.0,
        patience: int = 3,
    ) -> None:
        super().__init__()
        if not 0 < period < math.inf:
            raise SettingsError(f"the filter's period must be positive, not {period}")
        if patience < 1:
            raise SettingsError(f"patience must be 1 or more, not {patience}")
        self.filter = belief_filter
        self._start = make_belief(start.mean, start.covariance)
        self._patience = patience
        self._packing = FilterPacking(belief_filter, len(belief_filter.observation.names))
        self._n, self._cap = self._packing.n, self._packing.cap
        packed = self._packing.pack(belief_filter.start(self._start))
        self._declare_measurement()
        self._reset = self.DeclareVectorInputPort("reset_state", self._n)
        self._restart = self.DeclareVectorInputPort("restart", 1)
        self._belief, self._stare, self._view = (self.DeclareDiscreteState(p) for p in packed)
        # The statistics, how many unlikely measurements there were in a row, the last time.
        self._record = self.DeclareDiscreteState(np.r_[0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -math.inf])
        self._active = self.DeclareDiscreteState(np.zeros(max(len(belief_filter.inequalities), 1)))
        self._declare_outputs()
        self.DeclarePeriodicDiscreteUpdateEvent(period, offset, self._update)

    def _declare_measurement(self) -> None:
        size = len(self.filter.observation.names)
        self._measurement = self.DeclareVectorInputPort("measurement", size)
        self._variances = self.DeclareVectorInputPort("measurement_variances", size)

    def _measure(self, context: Context) -> tuple[Array, ObservationModel | None]:
        """What is measured now, and with what model if not the filter's own."""
        if not self._measurement.HasValue(context):
            return np.full(len(self.filter.observation.names), np.nan), None
        y = np.array(self._measurement.Eval(context))
        if not self._variances.HasValue(context):
            return y, None
        variances = np.array(self._variances.Eval(context))
        return y, with_variances(self.filter.observation, y, variances)

    def _declare_outputs(self) -> None:
        n = self._n
        belief = {self.discrete_state_ticket(self._belief)}
        for name, size, calculate in (
            ("estimated_state", n, self._calc_state),
            ("covariance", n * n, self._calc_covariance),
            ("hypothesis_weights", self._cap, self._calc_weights),
            ("hypothesis_states", self._cap * n, self._calc_states),
        ):
            self.DeclareVectorOutputPort(name, size, calculate, belief)
        self.DeclareVectorOutputPort(
            "active_limits",
            max(len(self.filter.inequalities), 1),
            self._calc_active,
            {self.discrete_state_ticket(self._active)},
        )
        self.DeclareVectorOutputPort(
            "statistics",
            len(STATISTICS),
            self._calc_statistics,
            {self.discrete_state_ticket(self._record)},
        )

    def filter_state(self, context: Context) -> FilterState:
        """The filter's state in a context, without its rejections."""
        step, _, distance, count = context.get_discrete_state(self._record).value()[:4]
        beliefs, repeated_views, view = (
            np.array(context.get_discrete_state(index).value())
            for index in (self._belief, self._stare, self._view)
        )
        return self._packing.unpack(
            beliefs, repeated_views, view, int(step), float(distance), int(count)
        )

    def _rows(self, context: Context) -> Array:
        return np.array(context.get_discrete_state(self._belief).value()).reshape(self._cap, -1)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        state = self.filter_state(context)
        record = context.get_discrete_state(self._record).value()
        require_time_forward(self, context, record[6])
        first, lost, unlikely = record[0] == 0, record[4] > 0, int(record[5])
        fresh = first
        wanted = first or lost
        if self._restart.HasValue(context):
            wanted = wanted or self._restart.Eval(context)[0] != 0
        if wanted and self._reset.HasValue(context):
            mean = np.array(self._reset.Eval(context))
            if np.isfinite(mean).all():
                state = self.filter.start(Belief(mean, self._start.covariance))
                fresh, unlikely = True, 0
        if not fresh:
            state = self.filter.predict(state)
        y, model = self._measure(context)
        state = self.filter.update(state, y, model)
        if state.count:
            limit = chdtri(state.count, _LOSS_PROBABILITY)
            unlikely = unlikely + 1 if state.distance > limit else 0
        packed = self._packing.pack(state)
        for index, vector in zip((self._belief, self._stare, self._view), packed, strict=True):
            discrete_state.set_value(index, vector)
        discrete_state.set_value(
            self._record,
            np.array(
                [
                    record[0] + 1,
                    len(state.hypotheses),
                    state.distance,
                    state.count,
                    float(unlikely >= self._patience),
                    unlikely,
                    context.get_time(),
                ]
            ),
        )
        names = self.filter.inequalities.rows
        active = np.isin(names, state.hypotheses[0].active) if names else np.zeros(1)
        discrete_state.set_value(self._active, active.astype(np.float64))
        return EventStatus.Succeeded()

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._rows(context)[0, HEAD : HEAD + self._n])

    def _calc_covariance(self, context: Context, output: BasicVector) -> None:
        start = HEAD + self._n
        output.SetFromVector(self._rows(context)[0, start : start + self._n**2])

    def _calc_weights(self, context: Context, output: BasicVector) -> None:
        rows = self._rows(context)
        output.SetFromVector(np.where(rows[:, 0] > 0, np.exp(rows[:, 1]), 0.0))

    def _calc_states(self, context: Context, output: BasicVector) -> None:
        rows = self._rows(context)
        states = rows[:, HEAD : HEAD + self._n]
        states[rows[:, 0] == 0] = np.nan
        output.SetFromVector(states.ravel())

    def _calc_active(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._active).value())

    def _calc_statistics(self, context: Context, output: BasicVector) -> None:
        record = context.get_discrete_state(self._record).value()
        output.SetFromVector(record[: len(STATISTICS)])
