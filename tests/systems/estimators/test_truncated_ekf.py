import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia, UnitInertia
from scipy.integrate import solve_ivp

from drake_pose.errors import SettingsError
from drake_pose.filtering.hand import HAND_STATE
from drake_pose.filtering.inequalities import from_bounds
from drake_pose.filtering.motion import constant_velocity
from drake_pose.filtering.state import Belief, StateLayout
from drake_pose.filtering.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.filtering.update import FunctionObservation
from drake_pose.papers.shimada import experiment_filter
from drake_pose.papers.shimada_sequences import make_sequence
from drake_pose.systems.truncated_ekf import STATISTICS, TruncatedEkf, plant_motion
from tests.systems.bench import Bench

PERIOD = 1 / 30


@pytest.fixture(scope="module")
def sequence():
    _, observation = experiment_filter()
    return make_sequence(35.0, "full", observation, np.random.default_rng(5))


def simulate(ekf, measurements, **more):
    """Make an update for each measurement; return outputs (steps, size) by name, and the bench."""
    run, found = Bench(ekf), {name: [] for name in ("estimated_state", "statistics")}
    found["active_limits"] = []
    for t, y in enumerate(measurements):
        run.update(PERIOD * t, measurement=y, **{name: rows[t] for name, rows in more.items()})
        for name, rows in found.items():
            rows.append(run[name])
    return {name: np.array(rows) for name, rows in found.items()}, run


def test_a_diagram_equals_the_filter(sequence):
    """Also without a measurement, and in static views, whose offsets are part of the state."""
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
        counts.append(state.view[1])
        np.testing.assert_allclose(logs["estimated_state"][t], state.best.mean)
        cut = np.isin(f.inequalities.rows, state.hypotheses[0].active)
        np.testing.assert_array_equal(logs["active_limits"][t], cut)
    assert max(counts[:17]) < counts[-1] == run.system.filter_state(run.context).view[1]
    covariance = run["covariance"].reshape(len(HAND_STATE), -1)
    np.testing.assert_allclose(covariance, state.estimate.covariance)
    weights = run["hypothesis_weights"]
    assert weights.sum() == pytest.approx(1.0)
    states = run["hypothesis_states"].reshape(8, -1)
    np.testing.assert_array_equal(np.isnan(states).all(axis=1), weights == 0)
    # The overall moments equal those of the mixture of the hypotheses.
    covariances = run["hypothesis_covariances"].reshape(8, len(HAND_STATE), -1)
    second = sum(
        weights[k] * (covariances[k] + np.outer(states[k], states[k]))
        for k in np.flatnonzero(weights)
    )
    mean = run["overall_state"]
    overall = run["overall_covariance"].reshape(len(HAND_STATE), -1)
    np.testing.assert_allclose(mean, weights[weights > 0] @ states[weights > 0], rtol=1e-9)
    np.testing.assert_allclose(overall + np.outer(mean, mean), second, rtol=1e-6, atol=1e-9)
    assert logs["active_limits"].any()
    statistics = dict(zip(STATISTICS, run["statistics"], strict=True))
    assert statistics["step"] == len(rows)
    assert statistics["distance"] == state.distance
    inside = f.inequalities.b - logs["estimated_state"] @ f.inequalities.phi.T
    assert inside.min() > -1e-9


def test_a_loss_is_reported_and_a_reset_ends_it(sequence):
    """A hand that jumps is lost, and the filter restarts from the reset state."""
    f, _ = experiment_filter()
    moved = sequence.measurements[:20].copy()
    # The hand jumps in each frame, which contradicts a constant velocity.
    moved[8:14, :2] += np.where(np.arange(8, 14) % 2, 150.0, -150.0)[:, None]
    ekf = TruncatedEkf(f, sequence.guess, PERIOD)
    logs, run = simulate(ekf, moved, reset_state=sequence.states)
    lost = logs["statistics"][:, STATISTICS.index("lost")]
    # By default the track is lost after three consecutive unlikely measurements.
    np.testing.assert_array_equal(lost[:11], [*np.zeros(10), 1])
    assert lost[-1] == 0
    np.testing.assert_allclose(run["estimated_state"][:2], sequence.states[19, :2], atol=3)


def test_restart_works_without_a_loss(sequence):
    f, _ = experiment_filter()
    run, moved = Bench(TruncatedEkf(f, sequence.guess, PERIOD)), sequence.states[0].copy()
    wanted = moved[0]
    for time, restart, x in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 1.0, 100.0)):
        # The hand continues at its rate; the reset state is elsewhere.
        moved[0] = wanted + 100.0 * (time > 0.0)
        run.update(time, restart=np.array([restart]), reset_state=moved)
        assert run["estimated_state"][0] == pytest.approx(wanted + x, abs=10.0)
    assert run["estimated_state"][0] == pytest.approx(wanted + 100.0)


def test_a_measurement_can_have_its_own_noise(sequence):
    """The model's noise, ten times larger noise, and NaN in either where nothing is measured."""
    f, observation = experiment_filter()
    y, R, deviations = sequence.measurements[0], np.diag(observation.variances), []
    hidden, unknown = y.copy(), R.copy()
    hidden[:9], unknown[:9], unknown[:, :9] = np.nan, np.nan, np.nan
    for seen, noise in ((y, None), (y, R), (y, 100.0 * R), (hidden, R), (y, unknown)):
        run = Bench(TruncatedEkf(f, sequence.guess, PERIOD))
        if noise is not None:
            run.give(measurement_covariance=noise.ravel())
        run.update(measurement=seen)
        deviations.append(np.sqrt(np.diag(run["covariance"].reshape(len(HAND_STATE), -1))))
    np.testing.assert_array_equal(deviations[0], deviations[1])
    assert (deviations[2][:2] > 2 * deviations[1][:2]).all()
    np.testing.assert_array_equal(deviations[3], deviations[4])


LAYOUT = StateLayout(("swing",), ("length",))
LIMITS = from_bounds(["swing", "length"], [-2.0, 0.2], [2.0, 2.0])
ABOUT = Belief(np.array([0.5, 0.0, 1.0]), np.diag([0.2, 0.2, 0.1]) ** 2)


def swinging(period=0.1, **settings):
    """Return a filter for a swinging rod whose end one camera measures."""
    end = FunctionObservation(
        ("u", "v"), 0.02, lambda x: x[2] * np.array([np.sin(x[0]), -np.cos(x[0])])
    )
    motion = constant_velocity(LAYOUT, {"swing": 0.5}, period)
    return TruncatedFilter(LAYOUT, end, LIMITS, motion, FilterSettings(**settings))


def test_a_contexts_parameters_set_the_filter():
    """As in a filter constructed with them; more hypotheses than the ports hold are refused."""
    run, rows = Bench(TruncatedEkf(swinging(), ABOUT)), np.array([[0.5, -0.8], [0.6, -0.7]])
    settings = FilterSettings(linearisation="tangent", iterations=5)
    run.context.get_mutable_abstract_parameter(0).set_value(settings)
    other = Bench(TruncatedEkf(swinging(**vars(settings)), ABOUT))
    plain = Bench(TruncatedEkf(swinging(), ABOUT))
    for t, y in enumerate(rows):
        for one in (run, other, plain):
            one.update(0.1 * t, measurement=y)
    for port in ("estimated_state", "covariance", "hypothesis_covariances"):
        np.testing.assert_array_equal(run[port], other[port])
    assert np.abs(run["covariance"] - plain["covariance"]).max() > 1e-6
    np.testing.assert_array_equal(plain["hypothesis_covariances"][:9], plain["covariance"])
    assert np.isnan(plain["hypothesis_covariances"][9:]).all()
    # Its patience is set only in the context.
    run.context.get_mutable_numeric_parameter(0).SetFromVector([1.0, 0.5])
    run.update(0.3, measurement=rows[0] + 1.0)
    assert run["statistics"][STATISTICS.index("lost")] == 1
    for index, value, word in (
        (0, FilterSettings(hypothesis_cap=9), "8 hypotheses"),
        (0, "joint", "not str"),
    ):
        run.context.get_mutable_abstract_parameter(index).set_value(value)
        with pytest.raises(SettingsError, match=word):
            run.update(0.4)


def test_the_period_is_the_motions():
    """Updates at 0, 0.02, ... s; the one at the end of the simulation is pending, unless later."""
    for offset, steps in ((0.0, 5), (0.019, 5), (0.021, 4)):
        run = Bench(TruncatedEkf(swinging(0.02), ABOUT, offset=offset)).advance(0.1)
        assert run["statistics"][0] == steps


def pendulum(time_step):
    """Return a plant with a point mass of 1 kg 0.8 m below a joint."""
    plant = MultibodyPlant(time_step)
    rod = plant.AddRigidBody(
        "rod", SpatialInertia(1.0, [0.0, 0.0, -0.8], UnitInertia(0.64, 0.64, 0.0))
    )
    hinge = RevoluteJoint("swing", plant.world_frame(), rod.body_frame(), [0.0, 1.0, 0.0])
    plant.AddJoint(hinge)
    plant.Finalize()
    return plant


@pytest.mark.parametrize("time_step", [0.0, 1e-3])
def test_plant_motion_integrates_the_differential_equation(time_step):
    motion = plant_motion(pendulum(time_step), LAYOUT, 1e-6 * np.eye(3), 0.1)
    for x in ([0.5, -1.0, 0.3], [2.5, 3.0, 0.3]):
        expected = solve_ivp(
            lambda t, z: [z[1], -9.81 / 0.8 * np.sin(z[0])], (0.0, 0.1), x[:2], rtol=1e-10
        ).y[:, -1]
        found, slope = motion.predict(np.array(x))
        # A discrete plant's steps of 1 ms cause an error of that order.
        np.testing.assert_allclose(found[:2], expected, atol=0.01 if time_step else 1e-5)
        assert found[2] == x[2]
        assert np.isfinite(slope).all()
    TruncatedFilter(LAYOUT, swinging().observation, LIMITS, motion).start(ABOUT)
    with pytest.raises(SettingsError, match="swing; the state's moving elements are turn"):
        plant_motion(pendulum(time_step), StateLayout(("turn",), ()), np.eye(2), 0.1)
    if time_step:
        with pytest.raises(SettingsError, match="multiple"):
            plant_motion(pendulum(time_step), LAYOUT, np.eye(3), 0.1005)


def test_invalid_settings_are_refused(sequence):
    (f, _), rod = experiment_filter(), swinging()
    for given, word in (
        ((f, sequence.guess, 0.0), "period"),
        ((f, sequence.guess, 0.1, 0), "patience"),
        ((f, Belief(np.full(37, np.nan), np.eye(37)), 0.1), "NaN"),
        ((f, ABOUT), "per step"),
        ((rod, ABOUT, 0.5), r"the motion's period is 0\.1 s, not 0\.5"),
        ((LAYOUT, ABOUT), "a TruncatedFilter, not StateLayout"),
        ((rod, Belief(np.zeros(2), np.eye(2))), "3 elements"),
    ):
        with pytest.raises(SettingsError, match=word):
            TruncatedEkf(*given)


def test_time_running_backwards_is_refused(sequence):
    run = Bench(TruncatedEkf(experiment_filter()[0], sequence.guess, PERIOD))
    run.update(0.0).update(1.0)
    with pytest.raises(SettingsError, match=r"backwards, from 1 s to 0\.5 s"):
        run.update(0.5)
    run.system.SetDefaultContext(run.context)
    run.update(0.5)
