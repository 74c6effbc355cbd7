import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import VectorLogSink

from drake_pose.errors import SettingsError
from drake_pose.filtering.hand import HAND_STATE
from drake_pose.filtering.state import Belief
from drake_pose.papers.shimada import experiment_filter
from drake_pose.papers.shimada_motion import make_sequence
from drake_pose.systems.estimators.truncated_ekf import STATISTICS, TruncatedEkf

PERIOD = 1 / 30


class Player(LeafSystem):
    """Plays the rows of an array, one a period."""

    def __init__(self, rows):
        super().__init__()
        self.rows = rows
        self.DeclareVectorOutputPort("row", rows.shape[1], self._calc)

    def _calc(self, context, output: BasicVector):
        index = min(int(context.get_time() / PERIOD + 0.5), len(self.rows) - 1)
        output.SetFromVector(self.rows[index])


@pytest.fixture(scope="module")
def sequence():
    _, observation = experiment_filter()
    return make_sequence(35.0, "full", observation, np.random.default_rng(5))


def simulate(ekf, measurements, reset=None):
    """Run one update a measurement; the logs (steps, size) of state, statistics, limits."""
    builder = DiagramBuilder()
    builder.AddSystem(ekf)
    if measurements is not None:
        player = builder.AddSystem(Player(measurements))
        builder.Connect(player.get_output_port(), ekf.GetInputPort("measurement"))
    if reset is not None:
        resetter = builder.AddSystem(Player(reset))
        builder.Connect(resetter.get_output_port(), ekf.GetInputPort("reset_state"))
    steps = len(measurements) if measurements is not None else 5
    sinks = {}
    for name in ("estimated_state", "statistics", "active_limits", "hypothesis_weights"):
        port = ekf.GetOutputPort(name)
        sinks[name] = builder.AddSystem(VectorLogSink(port.size(), PERIOD))
        builder.Connect(port, sinks[name].get_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo((steps - 0.5) * PERIOD)
    context = ekf.GetMyContextFromRoot(simulator.get_context())
    logs = {name: sink.FindLog(simulator.get_context()).data().T for name, sink in sinks.items()}
    return logs, context


@pytest.mark.parametrize("seen", ["all", "late", "static"])
def test_in_a_diagram_it_gives_what_the_filter_gives(sequence, seen):
    """Also where a camera is late, or a view lasts: its offsets are part of the state."""
    f, observation = experiment_filter()
    rows = sequence.measurements.copy()
    if seen == "late":
        rows[20:24] = np.nan
    elif seen == "static":
        noise = np.sqrt(observation.variances)
        rows[:] = rows[0] + noise * np.random.default_rng(0).normal(size=rows.shape)
        rows[1:, -1] = np.nan
    ekf = TruncatedEkf(f, sequence.guess, PERIOD)
    logs, context = simulate(ekf, rows)
    state = f.start(sequence.guess)
    for t, y in enumerate(rows):
        state = f.update(f.predict(state) if t else state, y)
    assert ekf.filter_state(context).view.count == state.view.count
    np.testing.assert_allclose(ekf.GetOutputPort("estimated_state").Eval(context), state.best.mean)
    covariance = ekf.GetOutputPort("covariance").Eval(context).reshape(len(HAND_STATE), -1)
    np.testing.assert_allclose(covariance, state.best.covariance)
    weights = ekf.GetOutputPort("hypothesis_weights").Eval(context)
    assert weights.sum() == pytest.approx(1.0)
    states = ekf.GetOutputPort("hypothesis_states").Eval(context).reshape(4, -1)
    np.testing.assert_array_equal(np.isnan(states).all(axis=1), weights == 0)
    named = [f.inequalities.rows[k] for k in np.flatnonzero(logs["active_limits"].any(axis=0))]
    assert named
    statistics = dict(zip(STATISTICS, ekf.GetOutputPort("statistics").Eval(context), strict=True))
    assert statistics["step"] == 55
    assert statistics["lost"] == 0
    inside = f.inequalities.b - logs["estimated_state"] @ f.inequalities.phi.T
    assert inside.min() > -1e-9


def test_a_loss_is_said_and_a_reset_mends_it(sequence):
    """Another hand elsewhere from frame 25 on: lost, then started again at the reset state."""
    f, _ = experiment_filter()
    moved = sequence.measurements.copy()
    # The hand jumps in every frame, which no constant velocity explains.
    jumps = np.where(np.arange(55) % 2, 150.0, -150.0)
    moved[20:30, :2] += jumps[20:30, None]
    reset = sequence.states.copy()
    ekf = TruncatedEkf(f, sequence.guess, PERIOD)
    logs, context = simulate(ekf, moved, reset)
    lost = logs["statistics"][:, STATISTICS.index("lost")]
    assert lost[20:35].max() == 1
    assert lost[-1] == 0
    estimate = ekf.GetOutputPort("estimated_state").Eval(context)
    np.testing.assert_allclose(estimate[:2], sequence.states[-1, :2], atol=3)


def test_restart_starts_again_although_nothing_is_lost(sequence):
    f, _ = experiment_filter()
    ekf = TruncatedEkf(f, sequence.guess, PERIOD)
    context = ekf.CreateDefaultContext()
    wanted, moved = sequence.states[0][0], sequence.states[0].copy()

    def step(t, restart):
        context.SetTime(t)
        ekf.GetInputPort("restart").FixValue(context, [restart])
        ekf.GetInputPort("reset_state").FixValue(context, moved)
        ekf.ExecuteForcedEvents(context)
        return ekf.GetOutputPort("estimated_state").Eval(context)[0]

    assert step(0.0, 0.0) == pytest.approx(wanted)
    # The hand moves on at its rate.
    moved[0] += 100.0
    assert step(1.0, 0.0) == pytest.approx(wanted, abs=10.0)
    assert step(2.0, 1.0) == pytest.approx(wanted + 100.0)


def test_a_frame_can_bring_its_own_noise(sequence):
    """The same measurement, once as sure as the model says and once ten times less."""
    f, observation = experiment_filter()
    deviations = []
    for factor in (None, 1.0, 100.0):
        ekf = TruncatedEkf(f, sequence.guess, PERIOD)
        context = ekf.CreateDefaultContext()
        ekf.GetInputPort("measurement").FixValue(context, sequence.measurements[0])
        if factor is not None:
            port = ekf.GetInputPort("measurement_variances")
            port.FixValue(context, factor * observation.variances)
        ekf.ExecuteForcedEvents(context)
        covariance = ekf.GetOutputPort("covariance").Eval(context).reshape(len(HAND_STATE), -1)
        deviations.append(np.sqrt(np.diag(covariance)))
    np.testing.assert_array_equal(deviations[0], deviations[1])
    assert (deviations[2][:2] > 2 * deviations[1][:2]).all()


def test_bad_settings_are_refused(sequence):
    f, _ = experiment_filter()
    with pytest.raises(SettingsError, match="period"):
        TruncatedEkf(f, sequence.guess, 0.0)
    with pytest.raises(SettingsError, match="patience"):
        TruncatedEkf(f, sequence.guess, 0.1, patience=0)
    with pytest.raises(SettingsError, match="NaN"):
        TruncatedEkf(f, Belief(np.full(37, np.nan), np.eye(37)), 0.1)


def test_time_that_runs_backwards_is_refused(sequence):
    f, _ = experiment_filter()
    ekf = TruncatedEkf(f, sequence.guess, PERIOD)
    context = ekf.CreateDefaultContext()
    for t in (0.0, 1.0):
        context.SetTime(t)
        ekf.ExecuteForcedEvents(context)
    context.SetTime(0.5)
    with pytest.raises(SettingsError, match=r"backwards, from 1 s to 0\.5 s"):
        ekf.ExecuteForcedEvents(context)
    ekf.SetDefaultContext(context)
    ekf.ExecuteForcedEvents(context)
