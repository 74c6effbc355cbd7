import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.filtering.hand import HAND_STATE
from drake_pose.filtering.state import Belief
from drake_pose.papers.shimada import experiment_filter
from drake_pose.papers.shimada_sequences import make_sequence
from drake_pose.systems.truncated_ekf import STATISTICS, TruncatedEkf
from tests.systems.bench import Bench

PERIOD = 1 / 30


@pytest.fixture(scope="module")
def sequence():
    _, observation = experiment_filter()
    return make_sequence(35.0, "full", observation, np.random.default_rng(5))


def simulate(ekf, measurements, **more):
    """One update a measurement; outputs after each, by name: (steps, size); and the bench."""
    run, found = Bench(ekf), {name: [] for name in ("estimated_state", "statistics")}
    found["active_limits"] = []
    for t, y in enumerate(measurements):
        run.update(PERIOD * t, measurement=y, **{name: rows[t] for name, rows in more.items()})
        for name, rows in found.items():
            rows.append(run[name])
    return {name: np.array(rows) for name, rows in found.items()}, run


def test_in_a_diagram_it_gives_what_the_filter_gives(sequence):
    """Also where a camera is late, and where a view lasts: its offsets are part of the state."""
    f, observation = experiment_filter()
    rows = sequence.measurements[:24].copy()
    rows[6:8] = np.nan
    noise = np.sqrt(observation.variances)
    rows[16:] = rows[16] + noise * np.random.default_rng(0).normal(size=rows[16:].shape)
    rows[17:, -1] = np.nan
    logs, run = simulate(TruncatedEkf(f, sequence.guess, PERIOD), rows)
    state, counts = f.start(sequence.guess), []
    for t, y in enumerate(rows):
        state = f.update(f.predict(state) if t else state, y)
        counts.append(state.view.count)
        np.testing.assert_allclose(logs["estimated_state"][t], state.best.mean)
        cut = np.isin(f.inequalities.rows, state.hypotheses[0].active)
        np.testing.assert_array_equal(logs["active_limits"][t], cut)
    assert max(counts[:17]) < counts[-1] == run.system.filter_state(run.context).view.count
    covariance = run["covariance"].reshape(len(HAND_STATE), -1)
    np.testing.assert_allclose(covariance, state.best.covariance)
    weights = run["hypothesis_weights"]
    assert weights.sum() == pytest.approx(1.0)
    states = run["hypothesis_states"].reshape(4, -1)
    np.testing.assert_array_equal(np.isnan(states).all(axis=1), weights == 0)
    assert logs["active_limits"].any()
    statistics = dict(zip(STATISTICS, run["statistics"], strict=True))
    assert (statistics["step"], statistics["lost"]) == (len(rows), 0)
    assert statistics["distance"] == state.distance
    inside = f.inequalities.b - logs["estimated_state"] @ f.inequalities.phi.T
    assert inside.min() > -1e-9


def test_a_loss_is_said_and_a_reset_mends_it(sequence):
    """A hand that jumps is lost, then started again at the reset state."""
    f, _ = experiment_filter()
    moved = sequence.measurements[:20].copy()
    # The hand jumps in every frame, which no constant velocity explains.
    moved[8:14, :2] += np.where(np.arange(8, 14) % 2, 150.0, -150.0)[:, None]
    ekf = TruncatedEkf(f, sequence.guess, PERIOD)
    logs, run = simulate(ekf, moved, reset_state=sequence.states)
    lost = logs["statistics"][:, STATISTICS.index("lost")]
    # Three unlikely ones in a row, by default, make a loss.
    np.testing.assert_array_equal(lost[:11], [*np.zeros(10), 1])
    assert lost[-1] == 0
    np.testing.assert_allclose(run["estimated_state"][:2], sequence.states[19, :2], atol=3)


def test_restart_starts_again_although_nothing_is_lost(sequence):
    f, _ = experiment_filter()
    run, moved = Bench(TruncatedEkf(f, sequence.guess, PERIOD)), sequence.states[0].copy()
    wanted = moved[0]
    for time, restart, x in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 1.0, 100.0)):
        # The hand moves on at its rate; the reset state is elsewhere.
        moved[0] = wanted + 100.0 * (time > 0.0)
        run.update(time, restart=np.array([restart]), reset_state=moved)
        assert run["estimated_state"][0] == pytest.approx(wanted + x, abs=10.0)
    assert run["estimated_state"][0] == pytest.approx(wanted + 100.0)


def test_a_frame_can_bring_its_own_noise(sequence):
    """The same measurement, once as sure as the model says and once ten times less."""
    f, observation = experiment_filter()
    deviations = []
    for factor in (None, 1.0, 100.0):
        run = Bench(TruncatedEkf(f, sequence.guess, PERIOD))
        if factor is not None:
            run.give(measurement_covariance=np.diag(factor * observation.variances).ravel())
        run.update(measurement=sequence.measurements[0])
        deviations.append(np.sqrt(np.diag(run["covariance"].reshape(len(HAND_STATE), -1))))
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
    run = Bench(TruncatedEkf(experiment_filter()[0], sequence.guess, PERIOD))
    run.update(0.0).update(1.0)
    with pytest.raises(SettingsError, match=r"backwards, from 1 s to 0\.5 s"):
        run.update(0.5)
    run.system.SetDefaultContext(run.context)
    run.update(0.5)
