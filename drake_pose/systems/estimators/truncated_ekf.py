"""The truncated filter as a Drake system: measurements in, a belief within limits out."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State
from scipy.special import chdtri

from drake_pose.errors import SettingsError
from drake_pose.filtering.kalman.truncated_filter import FilterState, TruncatedFilter
from drake_pose.filtering.kalman.update import with_variances
from drake_pose.filtering.state import Belief, make_belief
from drake_pose.systems.shared_value import SharedValue, require_time_forward

Array = NDArray[np.float64]

STATISTICS = ("step", "hypotheses", "distance", "count", "lost")
"""What the elements of the output ``statistics`` are."""

_LOSS_PROBABILITY = 1e-6


@dataclass(frozen=True, eq=False)
class _Known(SharedValue):
    """What is known after an update: how many there were, and unlikely ones in a row; time [s]."""

    state: FilterState
    step: int = 0
    unlikely: int = 0
    lost: bool = False
    time: float = -math.inf


class TruncatedEkf(LeafSystem):
    """Estimates a state from measurements, inside linear inequalities.

    .. pydrake_system::

        name: TruncatedEkf
        input_ports: [measurement (optional), measurement_variances (optional), reset_state
          (optional), restart (optional)]
        output_ports: [estimated_state, covariance, hypothesis_weights, hypothesis_states,
          active_limits, statistics]

    A periodic update predicts and uses the measurement: NaN where something is occluded; all NaN,
    or an unconnected port, where a camera is late or missing, which leaves the prediction.
    ``measurement_variances`` are those of this one's noise, finite where it is; the observation
    model's own where the port is not connected.

    - ``estimated_state`` (n), ``covariance`` (n x n, row by row): of the heaviest hypothesis.
    - ``hypothesis_weights`` (cap), ``hypothesis_states`` (cap x n, row by row): the heaviest first,
      weights 0 and states NaN where there are fewer.
    - ``active_limits`` (K): 1 where that row of ``filter.inequalities`` cut the best belief.
    - ``statistics``: see ``STATISTICS``. ``lost`` is 1 while measurements have been as unlikely as
      one in a million for several steps.

    At the first update, while the track is lost, and whenever ``restart`` (1) is not 0, the filter
    starts again from ``reset_state`` (n), for example from a matcher, if all its elements are
    finite; with the covariance of the belief given here.

    Args:
        start: the belief before the first measurement.
        period, offset: time between two updates, one step of the prediction; of the first one [s].
        patience: how many unlikely measurements in a row make a loss.

    Raises:
        SettingsError: a start that does not fit, a period or patience that is not positive; and, in
            a simulation, time that runs backwards.
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
        self.filter, self._patience = belief_filter, patience
        self._start = make_belief(start.mean, start.covariance)
        n, cap = len(belief_filter.layout), belief_filter.settings.hypothesis_cap
        measured = len(belief_filter.observation.names)
        self._measurement, self._variances, self._reset, self._restart = (
            self.DeclareVectorInputPort(name, size)
            for name, size in (
                ("measurement", measured),
                ("measurement_variances", measured),
                ("reset_state", n),
                ("restart", 1),
            )
        )
        first = _Known(belief_filter.start(self._start))
        self._state = self.DeclareAbstractState(AbstractValue.Make(first))
        ticket = {self.abstract_state_ticket(self._state)}
        for name, size, calculate in (
            ("estimated_state", n, self._calc_state),
            ("covariance", n * n, self._calc_covariance),
            ("hypothesis_weights", cap, self._calc_weights),
            ("hypothesis_states", cap * n, self._calc_states),
            ("active_limits", max(len(belief_filter.inequalities), 1), self._calc_active),
            ("statistics", len(STATISTICS), self._calc_statistics),
        ):
            self.DeclareVectorOutputPort(name, size, calculate, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, offset, self._update)
        self.DeclareForcedUnrestrictedUpdateEvent(self._update)

    def filter_state(self, context: Context) -> FilterState:
        """The filter's state in a context."""
        return self._known(context).state

    def _known(self, context: Context) -> _Known:
        known: _Known = context.get_abstract_state(int(self._state)).get_value()
        return known

    def _update(self, context: Context, state: State) -> EventStatus:
        known = self._known(context)
        require_time_forward(self, context, known.time)
        now, unlikely, is_fresh = known.state, known.unlikely, known.step == 0
        is_wanted = is_fresh or known.lost
        if self._restart.HasValue(context):
            is_wanted = is_wanted or self._restart.Eval(context)[0] != 0
        if is_wanted and self._reset.HasValue(context):
            mean = np.array(self._reset.Eval(context))
            if np.isfinite(mean).all():
                now = self.filter.start(Belief(mean, self._start.covariance))
                is_fresh, unlikely = True, 0
        if not is_fresh:
            now = self.filter.predict(now)
        y, model = np.full(self._measurement.size(), np.nan), None
        if self._measurement.HasValue(context):
            y = np.array(self._measurement.Eval(context))
            if self._variances.HasValue(context):
                variances = np.array(self._variances.Eval(context))
                model = with_variances(self.filter.observation, y, variances)
        now = self.filter.update(now, y, model)
        if now.count:
            is_unlikely = now.distance > chdtri(now.count, _LOSS_PROBABILITY)
            unlikely = unlikely + 1 if is_unlikely else 0
        lost = unlikely >= self._patience
        updated = _Known(now, known.step + 1, unlikely, lost, context.get_time())
        state.get_mutable_abstract_state(int(self._state)).set_value(updated)
        return EventStatus.Succeeded()

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self.filter_state(context).best.mean)

    def _calc_covariance(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self.filter_state(context).best.covariance.ravel())

    def _calc_weights(self, context: Context, output: BasicVector) -> None:
        weights = np.zeros(output.size())
        hypotheses = self.filter_state(context).hypotheses
        weights[: len(hypotheses)] = [one.weight for one in hypotheses]
        output.SetFromVector(weights)

    def _calc_states(self, context: Context, output: BasicVector) -> None:
        states = np.full((self.filter.settings.hypothesis_cap, len(self.filter.layout)), np.nan)
        hypotheses = self.filter_state(context).hypotheses
        states[: len(hypotheses)] = [one.belief.mean for one in hypotheses]
        output.SetFromVector(states.ravel())

    def _calc_active(self, context: Context, output: BasicVector) -> None:
        names = self.filter.inequalities.rows
        known = self._known(context)
        active = np.zeros(output.size())
        if known.step and names:
            active[:] = np.isin(names, known.state.hypotheses[0].active)
        output.SetFromVector(active)

    def _calc_statistics(self, context: Context, output: BasicVector) -> None:
        known = self._known(context)
        state = known.state
        values = known.step, len(state.hypotheses), state.distance, state.count, known.lost
        output.SetFromVector(np.array(values, dtype=float))
